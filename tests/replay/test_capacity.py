"""Capacity by task diversity: against a naive count over the newest rows."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
import pytest
from support.stores import recording_transitions, write_store

from restock import cli
from restock.replay.store.capacity import recommend_capacity
from restock.replay.store.store import Store


def newest_first(transitions: pa.Table) -> list[dict[str, object]]:
    columns = ["stamp_ns", "transition_id", "condition", "zone", "action", "episode_id"]
    rows: list[dict[str, object]] = transitions.select(columns).to_pylist()
    return sorted(rows, key=lambda r: (r["stamp_ns"], r["transition_id"]), reverse=True)  # type: ignore[arg-type, return-value]


def cells(rows: list[dict[str, object]]) -> int:
    return len({(row["condition"], row["zone"], row["action"]) for row in rows})


def test_the_curve_and_the_recommendation_are_those_of_a_naive_count(
    store_path: Path, transitions: pa.Table
) -> None:
    rows = newest_first(transitions)
    with Store(store_path) as store:
        found = recommend_capacity(store.connection, 0.9)
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


def test_whether_coverage_is_saturated_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    growing = write_store(tmp_path / "growing", [recording_transitions(1)])
    with Store(growing) as store:
        found = recommend_capacity(store.connection)
    assert found.half_share == found.curve[-2]["cells_share"] < 0.95
    assert not found.saturated
    assert cli.main(["audit", str(growing), "--capacity"]) == 0
    assert "more recordings will show more" in capsys.readouterr().out
    rows = recording_transitions(1)
    for name, value in (("condition", "nominal"), ("zone", "cross"), ("action", 1)):
        place = rows.schema.get_field_index(name)
        same = pa.array([value] * len(rows), rows.schema.field(place).type)
        rows = rows.set_column(place, rows.schema.field(place), same)
    with Store(write_store(tmp_path / "flat", [rows])) as store:
        assert recommend_capacity(store.connection).saturated


def test_the_verb_recommends(store_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["audit", str(store_path), "--capacity", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)["capacity"]
    assert document["curve"][-1]["capacity"] == document["rows"]
    assert document["curve"][-1]["cells_share"] == 1.0
    assert cli.main(["audit", str(store_path), "--capacity"]) == 0
    assert f"{document['recommended']:,} of" in capsys.readouterr().out
