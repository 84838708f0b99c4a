"""`restock coverage diff` of panels: rows, mixture, shares and weights."""

import json

import msgspec
import pytest
from support.panels import EVERY, NO_SPLIT, panel_of
from support.stores import TASK, recording_transitions, write_store

from restock.cli import main
from restock.replay.fleet.panel_difference import key_differences

HALF = "[[strata]]\nname = 'wheel_slip'\nshare = 0.5\n" + EVERY + NO_SPLIT


def test_rows_shares_and_keys_that_differ(tmp_path, capsys):
    store = write_store(tmp_path / "store", [recording_transitions(1), recording_transitions(2)])
    panel_of(store, EVERY + NO_SPLIT, tmp_path / "a")
    panel_of(store, "where = \"zone = 'cross'\"\n" + HALF, tmp_path / "b")
    assert main(["coverage", "diff", str(tmp_path / "a"), str(tmp_path / "b"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    zones = [row["zone"] for n in (1, 2) for row in recording_transitions(n).to_pylist()]
    cross = zones.count("cross")
    rows = found["rows"]
    assert (rows["in"], rows["out"], rows["both"]) == (0, len(zones) - cross, cross)
    keys = {row["key"]: (row["a"], row["b"]) for row in found["mixture"]}
    assert keys["where"] == (None, "zone = 'cross'")
    assert keys["strata[wheel_slip].share"] == (None, 0.5)
    slip = next(row for row in found["strata"] if row["stratum"] == "wheel_slip")
    assert slip["wanted_share_b"] == 0.5
    assert slip["share_a"] == pytest.approx(slip["natural_share_a"])
    assert found["weights"]["rows_changed"] > 0
    assert main(["coverage", "diff", str(tmp_path / "a"), str(tmp_path / "b")]) == 0
    assert "strata[wheel_slip].share" in capsys.readouterr().out
    assert main(["coverage", "diff", str(tmp_path / "a"), str(tmp_path / "a"), "--exit-code"]) == 0


def test_two_tasks_and_two_kinds_of_places_are_refused(tmp_path, capsys):
    other = msgspec.structs.replace(TASK, actions=TASK.actions[:3])
    first = write_store(tmp_path / "first", [recording_transitions(1)])
    second = write_store(tmp_path / "second", [recording_transitions(1, task=other)], task=other)
    panel_of(first, EVERY, tmp_path / "a")
    panel_of(second, EVERY, tmp_path / "b")
    for one, two in ((tmp_path / "a", tmp_path / "b"), (first, second)):
        assert main(["coverage", "diff", str(one), str(two)]) == 2
        message = capsys.readouterr().err
        assert TASK.hash in message
        assert other.hash in message
    assert "--profile" in message  # of stores: their recordings can be ingested again
    assert main(["coverage", "diff", str(tmp_path / "a"), str(first)]) == 2
    assert "is a panel" in capsys.readouterr().err
    assert main(["coverage", "diff", str(first), str(tmp_path / "none")]) == 2
    assert "no such store" in capsys.readouterr().err


def test_keys_are_compared_below_lists_by_name():
    a = {"strata": [{"name": "x", "share": 1}], "seed": 1, "same": [1]}
    b = {"strata": [{"name": "y"}, {"name": "x", "share": 2}], "seed": 1, "same": [1]}
    assert key_differences(a, b) == [
        {"key": "strata[x].share", "a": 1, "b": 2},
        {"key": "strata[y].name", "a": None, "b": "y"},
    ]
