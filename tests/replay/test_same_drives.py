"""Recordings of the same drive, compared with plain loops."""

from collections import defaultdict
from itertools import combinations
from statistics import median_low

import duckdb
from hypothesis import given, settings
from hypothesis import strategies as st

from restock.replay.store.definitions import definitions

FEW, MIN_ROWS, MIN_SHARE, WITHIN_NS = 5, 2, 0.1, 100_000_000
Row = tuple[int, int, int]  # recording, content, stamp


def find_by_loop(rows: list[Row]) -> set[tuple[str, str, int, float, float]]:
    found: dict[tuple[int, int], list[int]] = defaultdict(list)
    for recording, content, stamp in rows:
        found[recording, content].append(stamp)
    single = {key: stamps[0] for key, stamps in found.items() if len(stamps) == 1}
    distinctive: dict[int, int] = defaultdict(int)
    holders: dict[int, list[int]] = defaultdict(list)
    for recording, content in sorted(single):
        distinctive[recording] += 1
        holders[content].append(recording)
    later: dict[tuple[int, int], list[int]] = defaultdict(list)
    for content, recordings in holders.items():
        for one, other in combinations(recordings, 2):
            if one == recordings[0] or len(recordings) <= FEW:
                later[one, other].append(single[other, content] - single[one, content])
    pairs = set()
    for (one, other), gaps in later.items():
        shift = median_low(gaps)
        same = sum(abs(gap - shift) <= WITHIN_NS for gap in gaps)
        share = same / min(distinctive[one], distinctive[other])
        if same >= MIN_ROWS and share >= MIN_SHARE:
            pairs.add((f"r{one}", f"r{other}", same, share, shift / 1e9))
    return pairs


@settings(max_examples=100)
@given(
    st.lists(
        st.tuples(
            st.integers(0, 7), st.integers(1, 12), st.integers(0, 6).map(lambda n: n * 10**8 // 2)
        ),
        max_size=60,
    )
)
def test_same_drives_match_plain_loop(rows):
    columns = "recording, content, stamp_ns"
    with duckdb.connect() as connection:
        connection.execute(f"CREATE TABLE given ({columns.replace(',', ' BIGINT,')} BIGINT)")
        if rows:
            connection.executemany("INSERT INTO given VALUES (?, ?, ?)", rows)
        connection.execute(
            "CREATE VIEW transitions AS SELECT 'r' || recording AS recording_id, stamp_ns,"
            " 0.1 AS command_speed_mps, 0 AS command_yaw_rate_radps,"
            " content / 10 AS wheel_speed_mps, 0 AS wheel_yaw_rate_radps FROM given"
        )
        connection.execute(definitions(["same_drives.sql"]))
        found = connection.sql(
            "SELECT recording_id, same_as, rows, share, later_s FROM same_drives"
        ).fetchall()
    assert len(found) == len(set(found))
    assert set(found) == find_by_loop(rows)
