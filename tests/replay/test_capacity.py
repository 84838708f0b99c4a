"""Recommended capacity by task diversity, compared with a naive count over the newest rows."""

from collections import Counter

import pyarrow as pa
import pytest
from support.stores import recording_transitions, write_store

from restock.errors import ConfigError
from restock.ingest.store.transitions import replaced
from restock.replay.store.audit import recommend_capacity
from restock.replay.store.store import Store


def newest_first(transitions: pa.Table) -> list[dict[str, object]]:
    columns = ["stamp_ns", "transition_id", "condition", "zone", "action", "episode_id"]
    rows: list[dict[str, object]] = transitions.select(columns).to_pylist()
    return sorted(rows, key=lambda r: (r["stamp_ns"], r["transition_id"]), reverse=True)  # type: ignore[arg-type, return-value]


def cells(rows: list[dict[str, object]]) -> int:
    return len({(row["condition"], row["zone"], row["action"]) for row in rows})


def test_recommendation_matches_naive_count(store_path, transitions):
    rows = newest_first(transitions)
    with Store(store_path) as store:
        found = recommend_capacity(store.connection, 0.9, effective_episodes=0)
    assert found.rows == len(rows)
    assert found.cells == cells(rows)
    for point in found.curve:
        kept = rows[: point["capacity"]]
        assert point["cells"] == cells(kept)
        assert point["conditions"] == len({row["condition"] for row in kept})
        assert point["episodes"] == len({row["episode_id"] for row in kept})
        assert 1 <= point["effective_episodes"] <= point["episodes"]
    assert cells(rows[: found.recommended]) >= 0.9 * found.cells
    assert cells(rows[: found.recommended - 1]) < 0.9 * found.cells


def effective_episodes_of(rows: list[dict[str, object]]) -> float:
    counts = Counter(row["episode_id"] for row in rows)
    return sum(counts.values()) ** 2 / sum(n * n for n in counts.values())


def test_recommendation_reaches_effective_episodes(store_path, transitions):
    rows = newest_first(transitions)
    half = effective_episodes_of(rows) / 2
    with Store(store_path) as store:
        found = recommend_capacity(store.connection, 0.01, effective_episodes=half)
        too_many = recommend_capacity(store.connection, 0.01, effective_episodes=1e6)
    needed = found.rows_for_episodes
    assert needed is not None
    assert found.recommended == max(needed, found.rows_for_cells)
    assert effective_episodes_of(rows[:needed]) >= half > effective_episodes_of(rows[: needed - 1])
    assert too_many.rows_for_episodes is None
    assert too_many.recommended == len(rows)
    assert "all of them are worth less than 1e+06" in too_many.reason


def test_saturation_of_coverage_is_reported(tmp_path, shell):
    growing = write_store(tmp_path / "growing", [recording_transitions(1)])
    with Store(growing) as store:
        found = recommend_capacity(store.connection)
    assert found.half_share == found.curve[-2]["cells_share"] < 0.95
    assert not found.saturated
    assert "more recordings will add more" in shell.out("audit", growing, "--capacity")
    rows = recording_transitions(1)
    alike = {"condition": "nominal", "zone": "cross", "action": 1}
    rows = replaced(rows, {name: [value] * len(rows) for name, value in alike.items()})
    with Store(write_store(tmp_path / "flat", [rows])) as store:
        assert recommend_capacity(store.connection).saturated


def test_audit_verb_recommends_capacity(store_path, shell):
    document = shell.json("audit", store_path, "--capacity")["capacity"]
    assert document["curve"][-1]["capacity"] == document["rows"]
    assert document["curve"][-1]["cells_share"] == 1.0
    assert f"{document['recommended']:,} rows: " in shell.out("audit", store_path, "--capacity")


@pytest.mark.parametrize(("share", "episodes"), [(2.0, 50.0), (0.9, -1.0), (float("nan"), 50.0)])
def test_invalid_shares_and_episode_counts_are_refused(store_path, share, episodes):
    with Store(store_path) as store, pytest.raises(ConfigError, match=r"cells_share must be in"):
        recommend_capacity(store.connection, share, episodes)
