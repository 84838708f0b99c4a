"""`restock store label`: changed conditions applied to stored signals in one commit."""

import shutil
from pathlib import Path

import pytest
from deltalake import DeltaTable
from support.driven_robot import Drive, write_bag
from support.profile_texts import WAREHOUSE as TEXT

from restock.cli import main
from restock.errors import StoreError
from restock.ingest.relabel import relabel_store
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.conditions import Condition
from restock.replay.store.store import Store

# Looks ahead: the last transition of an episode uses a step that is not a stored row.
SOON = '\n[[condition]]\nname = "soon"\ntiming = "post"\npriority = 1\nsql = "{}"\n'
HALF_WAY = "lead(pose_x_m) OVER episode > 2.55"


@pytest.fixture(scope="module")
def ingested_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return two ingested recordings, one reaching its goal, with a profile that defines `soon`."""
    folder = tmp_path_factory.mktemp("label")
    profile = folder / "amr.toml"
    profile.write_text(TEXT + SOON.format(HALF_WAY))
    for name, goal in (("a", 3.0), ("b", 11.0)):
        write_bag(Drive(goals=[(0.0, goal, 1.0)], truth="soon"), folder / name)
    bags, store = [str(folder / name) for name in "ab"], str(folder / "store")
    assert main(["ingest", *bags, "--store", store, "--profile", str(profile)]) == 0
    return folder


@pytest.fixture
def store(ingested_folder: Path, tmp_path: Path) -> Path:
    shutil.copytree(ingested_folder, tmp_path, dirs_exist_ok=True)
    return tmp_path / "store"


def rows(path: Path, columns: str = "*") -> list[tuple]:
    with Store(path) as opened:
        query = f"SELECT {columns} FROM transitions ORDER BY transition_id"
        return opened.sql(query).fetchall()


def test_changed_conditions_change_only_labels(store, tmp_path, shell):
    others = "* EXCLUDE (primary_condition, conditions, labels_version, ingest_id)"
    before = rows(store, others)
    changed = tmp_path / "changed.toml"
    changed.write_text(TEXT + SOON.format("lead(pose_x_m) OVER episode > 1.95"))
    files = len(DeltaTable(str(store / "transitions")).file_uris())
    version = DeltaTable(str(store / "transitions")).version()
    document = shell.json("store", "label", store, "--profile", changed)
    assert document["version"] == version + 1  # one commit for both recordings
    assert [row["changed"] for row in document["recordings"]] == [6, 6]
    assert len(DeltaTable(str(store / "transitions")).file_uris()) == files
    assert rows(store, others) == before
    for row in document["recordings"]:
        assert row["named"]["soon"] == row["named_before"]["soon"] + 6
        (soon,) = [score for score in row["label_scores"] if score["condition"] == "soon"]
        assert soon["labelled"] == row["named"]["soon"]
    with Store(store) as opened:
        assert "1.95" in next(c.sql for c in opened.conditions() if c.name == "soon")
        assert opened.sql("SELECT count(*) FROM recordings").fetchall() == [(2,)]
    again = shell.json("store", "label", store, "--profile", changed)
    assert again["version"] is None
    assert [row["changed"] for row in again["recordings"]] == [0, 0]


def test_concurrently_ingested_recording_is_not_relabelled(store, tmp_path):
    writer = StoreWriter(store)

    def conditions_of(name: str) -> list[Condition]:
        return [Condition("always", "pre", "true")]

    original = writer.rows

    def rows_after_concurrent_ingest(recording_id: str, ingest_id: str):
        found = original(recording_id, ingest_id)
        bag, profile = str(tmp_path / "a"), str(tmp_path / "amr.toml")
        command = ["ingest", bag, "--store", str(store), "--profile", profile, "--force"]
        assert main(command) == 0
        return found

    writer.rows = rows_after_concurrent_ingest  # type: ignore[method-assign]
    with pytest.raises(StoreError, match="ingested again or removed in the meantime"):
        relabel_store(writer, conditions_of)
    assert {name for (name,) in rows(store, "primary_condition")} == {"nominal", "soon"}


def test_relabelling_needs_a_store_and_episode_ends(store, tmp_path, shell):
    assert "there is no store, or it is empty" in shell.err("store", "label", tmp_path / "none")
    writer = StoreWriter(store)
    original = writer.rows
    writer.rows = lambda *key: original(*key).replace_schema_metadata(None)
    with pytest.raises(StoreError, match="lack the ends of their episodes"):
        relabel_store(writer, lambda name: [Condition("always", "pre", "true")])
