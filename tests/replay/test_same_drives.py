"""Recordings of the same drive, and repeated numbers, compared with plain loops."""

from collections import defaultdict
from itertools import combinations
from statistics import median_low

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from restock.replay.store.same_drives import (
    FEW,
    MARKED,
    MIN_ROWS,
    MIN_SHARE,
    WITHIN_NS,
    MovingRows,
    RepeatFilter,
    occurs_again,
    same_drives,
)

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


@settings(max_examples=300)
@given(
    st.lists(
        st.tuples(
            st.integers(0, 7), st.integers(0, 12), st.integers(0, 6).map(lambda n: n * 10**8 // 2)
        ),
        max_size=60,
    )
)
def test_same_drives_match_plain_loop(rows):
    recording, content, stamp = np.array(rows, np.int64).reshape(-1, 3).T
    table = same_drives(
        MovingRows(
            [f"r{index}" for index in range(8)],
            recording.astype(np.int32),
            content.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15),
            stamp,
        )
    )
    columns = ("recording_id", "same_as", "rows", "share", "later_s")
    found = list(zip(*(table[name].to_pylist() for name in columns), strict=True))
    assert len(found) == len(set(found))
    assert set(found) == find_by_loop(rows)


NUMBERS = st.integers(-(2**63), 2**63 - 1)


@settings(max_examples=200)
@given(st.lists(st.lists(st.one_of(NUMBERS, st.integers(0, 9)), max_size=40), max_size=6))
def test_repeat_filter_misses_no_repeat(parts):
    arrays = [np.array(part, np.int64) for part in parts]
    observed = RepeatFilter(sum(map(len, parts)))
    for part in arrays:
        observed.add(part)
    every = np.concatenate([np.empty(0, np.int64), *arrays])
    maybe = np.concatenate([np.empty(0, np.bool_), *(observed.may_repeat(part) for part in arrays)])
    exact = occurs_again(every)
    assert exact.tolist() == [int((every == value).sum()) > 1 for value in every]
    assert not (exact & ~maybe).any()


def test_repeat_filter_has_few_false_positives():
    count = 20 * MARKED + 5
    values = np.random.default_rng(0).integers(-(2**63), 2**63 - 1, count)
    copies = np.concatenate([values, values[:100], values[MARKED - 3 : MARKED + 3]])
    observed = RepeatFilter(len(copies))
    observed.add(copies)
    maybe = observed.may_repeat(copies)
    assert maybe[occurs_again(copies)].all()
    assert maybe.mean() < 0.25
