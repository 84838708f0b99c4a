"""Group commits of several recordings: none is lost, and a failing one does not affect others."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyarrow as pa
import pytest
from deltalake import DeltaTable
from deltalake.transaction import AddAction
from support.long import one_in
from support.paths import ROOT
from support.stores import manifest, one, recording_transitions, shown

from restock.errors import RecordingError, StoreError
from restock.ingest import pipeline
from restock.ingest.pipeline import GROUP_S, CommitGroup, IngestResult, OnRepeat, Prepared
from restock.ingest.store.transitions import replaced
from restock.ingest.store.writer import StoreWriter


def prepared(
    store: StoreWriter,
    recording: tuple[pa.Table, pa.Table],
    repeated: OnRepeat | None = None,
    instead_of: str | None = None,
) -> Prepared:
    staged = store.stage(*recording, instead_of=instead_of)
    return Prepared(IngestResult("x", "written", {}), staged, repeated)


@pytest.fixture
def store(tmp_path: Path) -> StoreWriter:
    return StoreWriter(tmp_path / "s")


@pytest.fixture
def group(store: StoreWriter) -> CommitGroup:
    return CommitGroup(store, clock=lambda: 0.0)


def versions(store: Path) -> list[int]:
    """Return the Delta version of both tables: their number of commits after creation."""
    return [DeltaTable(str(store / name)).version() for name in ("recordings", "transitions")]


def files(store: Path) -> set[str]:
    return {path.relative_to(store).as_posix() for path in store.rglob("*.parquet")}


def test_first_recording_commits_at_once_then_groups(tmp_path):
    store, now = StoreWriter(tmp_path / "s"), [0.0]
    group = CommitGroup(store, clock=lambda: now[0])
    assert group.due_in_s() is None
    group.add(0, prepared(store, one(1)))
    assert list(group.results) == [0]
    for place in (1, 2, 3):
        now[0] += 1.0
        group.add(place, prepared(store, one(place + 1)))
    assert list(group.results) == [0]
    assert group.due_in_s() == GROUP_S - 3.0
    now[0] = GROUP_S
    group.commit_if_due()
    assert {place: result.version for place, result in group.results.items()} == {
        0: 1, 1: 2, 2: 2, 3: 2
    }  # fmt: skip
    assert versions(tmp_path / "s") == [2, 2]
    assert len(shown(tmp_path / "s")) == 4


def test_full_group_is_committed(store, group, tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "MAX_WAITING", 2)
    for place in range(5):
        group.add(place, prepared(store, one(place + 1)))
    assert list(group.results) == [0, 1, 2, 3, 4]
    assert versions(tmp_path / "s") == [3, 3]


def test_discarded_group_leaves_no_files(store, group, tmp_path):
    group.add(0, prepared(store, one(1)))
    before = files(tmp_path / "s")
    group.add(1, prepared(store, one(2)))
    assert files(tmp_path / "s") > before
    group.discard()
    assert files(tmp_path / "s") == before
    assert list(shown(tmp_path / "s")) == ["0000000000000001-a"]


def test_failed_recording_does_not_affect_its_group(store, group, tmp_path):
    group.add(0, prepared(store, one(1, "a")))
    group.add(1, prepared(store, one(2)))
    group.add(2, prepared(store, one(1, "c"), instead_of="b"))  # an ingest that is not in the store
    group.add(3, prepared(store, one(3)))
    group.commit()
    assert isinstance(group.results[2], StoreError)
    assert "ingested again or removed in the meantime" in str(group.results[2])
    kept = {"0000000000000001-a", "0000000000000002-a", "0000000000000003-a"}
    assert set(shown(tmp_path / "s")) == kept


def test_later_ingest_replaces_earlier_one_of_its_group(store, group, tmp_path):
    group.add(0, prepared(store, one(1)))
    group.add(1, prepared(store, one(2, "a")))
    group.add(2, prepared(store, one(2, "b", seed=9)))
    group.commit()
    assert {place: result.version for place, result in group.results.items()} == {0: 1, 1: 2, 2: 3}
    assert set(shown(tmp_path / "s")) == {"0000000000000001-a", "0000000000000002-b"}


@pytest.mark.parametrize("repeated", ["refuse", "keep"])
def test_repeated_drive_in_group_is_detected(store, group, tmp_path, repeated):
    rows = recording_transitions(2, episodes=5)
    copy = replaced(
        rows,
        {
            "recording_id": f"{7:016x}",
            "transition_id": rows["transition_id"].to_numpy() + (1 << 40),
            "ingest_id": "z",
        },
    )
    group.add(0, prepared(store, one(1), repeated))
    group.add(1, prepared(store, (manifest(rows), rows), repeated))
    group.add(2, prepared(store, (manifest(copy), copy), repeated))
    group.commit()
    first, second = group.results[1], group.results[2]
    assert isinstance(first, IngestResult)
    assert first.repeats is None
    if repeated == "refuse":
        assert isinstance(second, RecordingError)
        assert "the same drive twice" in str(second)
        assert not [name for name in files(tmp_path / "s") if f"{7:016x}" in name]
    else:
        assert isinstance(second, IngestResult)
        assert second.repeats is not None
        assert second.repeats.recording_id == f"{2:016x}"
    assert len(shown(tmp_path / "s")) == (2 if repeated == "refuse" else 3)


KILLED_PROCESS = """
import os, signal, sys
from support.stores import one
from restock.ingest.pipeline import CommitGroup, IngestResult, Prepared
from restock.ingest.store.writer import StoreWriter

place, when = sys.argv[1:]
store = StoreWriter(place)
group = CommitGroup(store, clock=lambda: 0.0)
commit, remove = StoreWriter.commit, StoreWriter.remove

def killed(at):
    if at == when and len(group.results) == 1:
        os.kill(os.getpid(), signal.SIGKILL)

def committing(self, name, *rest):
    killed(f"before {name}")
    found = commit(self, name, *rest)
    killed(f"after {name}")
    return found

StoreWriter.commit = committing
for number in (1, 2, 3):
    staged = store.stage(*one(number, "b", seed=number))
    group.add(number, Prepared(IngestResult("x", "written", {}), staged))
killed("waiting")
group.commit()
"""


@pytest.mark.parametrize(
    ("when", "num_committed"),
    one_in(
        2,
        [
            *[("after recordings", 1), ("waiting", 1)],
            *[("after transitions", 3), ("before recordings", 1)],
        ],
    ),
)
def test_killed_process_leaves_complete_groups(tmp_path, when, num_committed):
    place = tmp_path / "s"
    StoreWriter(place).write(*one(3, "old"))  # a recording of the second group replaces it
    child = subprocess.run(
        [sys.executable, "-c", KILLED_PROCESS, str(place), when],
        env={**os.environ, "PYTHONPATH": str(ROOT / "tests")},
    )
    assert child.returncode == -signal.SIGKILL
    before = set(shown(place))
    assert before == (
        {f"{number:016x}-b" for number in (1, 2, 3)}
        if num_committed == 3
        else {f"{1:016x}-b", f"{3:016x}-old"}
    )
    store = StoreWriter(place)
    again = CommitGroup(store, clock=lambda: 0.0)
    for number in (1, 2, 3):
        if f"{number:016x}-b" not in before:
            again.add(number, prepared(store, one(number, "c", seed=number)))
    again.commit()
    assert [name[:16] for name in sorted(shown(place))] == [f"{n:016x}" for n in (1, 2, 3)]
    manifests = store.files("recordings")
    assert store.clean() == []  # another writer may be about to commit these files
    assert store.files("recordings") == manifests
    old = time.time() - 3600
    for path in place.rglob("*.parquet"):
        os.utime(path, (old, old))
    store.clean(retention_hours=0)
    named = {
        f"{name}/{file.path}"
        for name in ("recordings", "transitions")
        for file in store.files(name)
    }
    assert {name for name in files(place) if "_delta_log" not in name} == named
    assert len(named) == 6


def fill_disk(monkeypatch, name: str) -> None:
    """Make commits to a table fail as Delta's library fails on a full disk."""
    transact = StoreWriter.transact

    def full(self, table, actions, *rest):
        if table.table_uri.rstrip("/").endswith(name) and isinstance(actions[0], AddAction):
            causes = ["Unable to copy data to file", "No space left on device (os error 28)"]
            raise OSError("\n  \x1b[31m↳\x1b[0m ".join(["Generic LocalFileSystem error", *causes]))
        return transact(self, table, actions, *rest)

    monkeypatch.setattr(StoreWriter, "transact", full)


@pytest.mark.parametrize("name", one_in(2, ["transitions", "recordings"]))
def test_commit_on_full_disk_leaves_no_files(store, group, tmp_path, monkeypatch, name):
    store.write(*one(1, "old"))
    before, manifests = files(tmp_path / "s"), store.files("recordings")
    with monkeypatch.context() as patched:
        fill_disk(patched, name)
        for place in (1, 2, 3):  # the first one replaces a recording
            group.add(place, prepared(store, one(place)))
        group.commit()
        assert len(group.results) == 3
        for result in group.results.values():
            assert isinstance(result, StoreError)
            assert "there is no space left on its disk" in str(result)
            assert "run the same command again" in str(result)
        assert files(tmp_path / "s") == before
        with pytest.raises(StoreError, match="no space left"):
            store.write_all([one(1), one(2)])
    assert files(tmp_path / "s") == before
    assert store.files("recordings") == manifests
    assert set(shown(tmp_path / "s")) == {f"{1:016x}-old"}
    for place in (1, 2, 3):
        group.add(place, prepared(store, one(place)))
    group.commit()
    assert set(shown(tmp_path / "s")) == {f"{number:016x}-a" for number in (1, 2, 3)}


def test_interrupt_between_tables_leaves_no_files(store, group, tmp_path, monkeypatch):
    store.write(*one(1))
    before = files(tmp_path / "s")
    commit = StoreWriter.commit

    def interrupted(self, name, *rest):
        if name == "transitions":
            raise KeyboardInterrupt
        return commit(self, name, *rest)

    monkeypatch.setattr(StoreWriter, "commit", interrupted)
    with pytest.raises(KeyboardInterrupt):
        group.add(2, prepared(store, one(2)))
    assert files(tmp_path / "s") == before
