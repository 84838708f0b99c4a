"""`restock coverage diff` of stores, versions and panels: rows added, removed and changed."""

from datetime import datetime
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pytest
from deltalake import write_deltalake
from support.panels import EVERY, NO_SPLIT, panel_of
from support.stores import TASK, manifest, one, recording_transitions, write_store

from restock.cli import main
from restock.errors import StoreError
from restock.ingest.store.transitions import replaced
from restock.ingest.store.version import FORMAT, parse_version, split_version
from restock.ingest.store.writer import StoreWriter
from restock.replay.fleet.panel_difference import key_differences
from restock.replay.fleet.store_difference import diff_stores
from restock.replay.store.store import Store


def relabelled(rows: pa.Table, steps: int) -> pa.Table:
    """Return the rows with the first `steps` labelled as wheel slip."""
    condition = rows["condition"].to_pylist()
    condition[:steps] = ["wheel_slip"] * steps
    return replaced(rows, {"condition": condition})


def differences(first: Path, second: Path) -> dict[str, Any]:
    with Store(first) as a, Store(second) as b:
        return diff_stores(a, b)


def test_diff_lists_added_removed_relabelled(tmp_path):
    rows = [recording_transitions(number) for number in range(6)]
    first = write_store(tmp_path / "a", rows[:4])
    again = relabelled(recording_transitions(2, ingest="b"), 20)
    second = write_store(tmp_path / "b", [rows[0], again, *rows[3:]])
    found = differences(first, second)
    changes = {row["source_file"]: row["change"] for row in found["recordings"]}
    assert changes == {
        "logs/1.mcap": "out",
        "logs/2.mcap": "written again",
        "logs/4.mcap": "in",
        "logs/5.mcap": "in",
    }
    episodes = found["episodes"]
    assert [episodes[name] for name in ("in", "out", "changed", "same")] == [24, 12, 0, 36]
    before = rows[2]["condition"].to_pylist()[:20]
    moved = {(row["from"], row["to"]): row["rows"] for row in found["labels"]["changes"]}
    assert moved == {(n, "wheel_slip"): before.count(n) for n in set(before) - {"wheel_slip"}}
    assert found["labels"]["rows_compared"] == len(rows[2])
    slip = next(row for row in found["shares"] if row["value"] == "wheel_slip")
    shares = []
    for side, tables in (("a", rows[:4]), ("b", [rows[0], again, *rows[3:]])):
        labels = pa.concat_tables(tables)["condition"].to_pylist()
        assert slip[f"rows_{side}"] == labels.count("wheel_slip")
        shares.append(labels.count("wheel_slip") / len(labels))
    assert [slip["share_a"], slip["share_b"]] == pytest.approx(shares)
    assert slip["difference"] == pytest.approx(shares[1] - shares[0])
    assert {row["of"] for row in found["shares"]} >= {"primary_condition", "zone"}


def test_unchanged_reingest_gives_empty_diff(tmp_path):
    first = write_store(tmp_path / "a", [recording_transitions(1)])
    second = write_store(tmp_path / "b", [recording_transitions(1, ingest="b")])
    found = differences(first, second)
    assert not found["different"]
    assert found["labels"]["rows_compared"] == len(recording_transitions(1))
    assert all(line["difference"] == 0 for line in found["shares"])


def test_changed_row_marks_episode_as_changed(tmp_path):
    rows, again = recording_transitions(1), recording_transitions(1, ingest="b")
    reward = again["reward"].to_numpy().copy()
    reward[3] += 1
    again = replaced(again, {"reward": reward})
    first, second = (write_store(tmp_path / n, [t]) for n, t in (("a", rows), ("b", again)))
    found = differences(first, second)
    assert [row["change"] for row in found["episodes"]["changes"]] == ["changed"]
    assert found["recordings"][0]["episodes_changed"] == 1


def test_versions_of_store_by_number_and_time(tmp_path, shell):
    writer = StoreWriter(tmp_path / "store")
    for number in (1, 2):
        newest = writer.write(*one(number))
    store = f"{tmp_path}/store"
    before = f"{store}@{newest - 1}"
    found = shell.json("coverage", "diff", before, store)
    assert [row["change"] for row in found["recordings"]] == ["in"]
    assert (found["a"]["version"], found["b"]["version"]) == (newest - 1, newest)
    assert main(["coverage", "diff", store, store, "--exit-code"]) == 0
    assert main(["coverage", "diff", before, store, "--exit-code"]) == 1
    with Store(tmp_path / "store", version=parse_version("2999-01-01T00:00Z")) as store:
        assert store.version == newest
    with pytest.raises(StoreError, match="the first is from"):
        Store(tmp_path / "store", version=parse_version("2001-01-01"))
    with pytest.raises(StoreError, match=f"its newest is {newest}"):
        Store(tmp_path / "store", version=99)
    with Store(tmp_path / "store", version=datetime(2999, 1, 1)) as store:  # taken as UTC
        assert store.version == newest


def test_version_suffix_is_split_unless_folder_exists(tmp_path):
    assert split_version("store@12") == ("store", 12)
    assert split_version("s3://bucket/store@2026-11-01T08:00Z")[0] == "s3://bucket/store"
    assert split_version("me@home/store") == ("me@home/store", None)
    (tmp_path / "store@12").mkdir()
    assert split_version(f"{tmp_path}/store@12") == (f"{tmp_path}/store@12", None)


def test_diff_with_empty_store(tmp_path):
    rows = recording_transitions(1)
    empty = write_store(tmp_path / "a", [])
    write_deltalake(str(empty / "recordings"), manifest(rows).slice(0, 0), description=FORMAT)
    write_deltalake(str(empty / "transitions"), rows.slice(0, 0), description=FORMAT)
    full = write_store(tmp_path / "b", [rows])
    found = differences(empty, full)
    assert found["a"]["rows"] == 0
    assert found["episodes"]["in"] == 12


HALF = "[[strata]]\nname = 'wheel_slip'\nshare = 0.5\n" + EVERY + NO_SPLIT


def test_panel_diff_lists_rows_shares_and_keys(tmp_path, shell):
    store = write_store(tmp_path / "store", [recording_transitions(1), recording_transitions(2)])
    panel_of(store, EVERY + NO_SPLIT, tmp_path / "a")
    panel_of(store, "where = \"zone = 'cross'\"\n" + HALF, tmp_path / "b")
    found = shell.json("coverage", "diff", tmp_path / "a", tmp_path / "b")
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
    assert "strata[wheel_slip].share" in shell.out(
        "coverage", "diff", tmp_path / "a", tmp_path / "b"
    )
    assert main(["coverage", "diff", str(tmp_path / "a"), str(tmp_path / "a"), "--exit-code"]) == 0


def test_diff_of_other_task_or_kind_is_refused(tmp_path, shell):
    other = msgspec.structs.replace(TASK, actions=TASK.actions[:3])
    first = write_store(tmp_path / "first", [recording_transitions(1)])
    second = write_store(tmp_path / "second", [recording_transitions(1, task=other)], task=other)
    panel_of(first, EVERY, tmp_path / "a")
    panel_of(second, EVERY, tmp_path / "b")
    for left, right in ((tmp_path / "a", tmp_path / "b"), (first, second)):
        message = shell.err("coverage", "diff", left, right)
        assert TASK.hash in message
        assert other.hash in message
    assert "--profile" in message  # for stores, whose recordings can be ingested again
    assert "is a panel" in shell.err("coverage", "diff", tmp_path / "a", first)
    assert "no such store" in shell.err("coverage", "diff", first, tmp_path / "none")


def test_list_entries_are_compared_by_name():
    a = {"strata": [{"name": "x", "share": 1}], "seed": 1, "same": [1]}
    b = {"strata": [{"name": "y"}, {"name": "x", "share": 2}], "seed": 1, "same": [1]}
    assert key_differences(a, b) == [
        {"key": "strata[x].share", "a": 1, "b": 2},
        {"key": "strata[y].name", "a": None, "b": "y"},
    ]
