"""Watched folders: which files are ingested and when; killing and restarting the process."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.driven_robot import BEAMS, Drive, columns, scans, write_bag

from restock.cli import main
from restock.cli.data.watch import RETRY_S, SALVAGE_AFTER_S, STILL_S, Arrivals
from restock.errors import RecordingError, StoreError
from restock.ingest.containers.open_recording import METADATA
from restock.replay.store.store import Store

FULL = RecordingError("cannot be read or written: No space left on device")


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag whose files have the names that rosbag2 gives them."""
    folder = write_bag(Drive(), tmp_path_factory.mktemp("made") / "bag", storage="mcap")
    (folder / "bag.mcap").rename(folder / "bag_0.mcap")
    metadata = (folder / METADATA).read_text()
    (folder / METADATA).write_text(metadata.replace("bag.mcap", "bag_0.mcap"))
    return folder


class FakeWatch:
    """Watch of a folder at times that the test chooses."""

    def __init__(self, folder: Path, **options: bool) -> None:
        self.arrivals, self.now_s = Arrivals([str(folder)], **options), 0.0

    def complete_after(self, wait_s: float) -> list[str]:
        self.now_s += wait_s
        return [path.name for path in self.arrivals.complete(self.now_s)]

    def take(self, path: Path, error: RecordingError | StoreError | None = None) -> bool:
        return self.arrivals.take(path, error, self.now_s)

    @property
    def news(self) -> list[tuple[str, str]]:
        return [(event, why) for event, _, why in self.arrivals.news]


def test_file_is_ingested_after_its_upload(bag, tmp_path):
    (file,) = bag.glob("*.mcap")
    upload, watch = tmp_path / "run.mcap", FakeWatch(tmp_path)
    upload.write_bytes(file.read_bytes()[:-1000])
    assert watch.complete_after(0) == watch.complete_after(STILL_S - 1) == []
    assert watch.complete_after(1) == []
    assert watch.news == [("waiting", "run.mcap has no MCAP footer yet")]
    assert (watch.complete_after(60), watch.news) == ([], [])  # reported once
    upload.write_bytes(file.read_bytes())
    assert watch.complete_after(0) == []
    assert watch.complete_after(STILL_S) == ["run.mcap"]
    watch.take(upload)
    assert watch.complete_after(1000) == []


def test_bag_is_ingested_once_its_metadata_exists(bag, tmp_path):
    arrived, watch = tmp_path / "bag", FakeWatch(tmp_path)
    arrived.mkdir()
    shutil.copy(bag / METADATA, arrived)
    watch.complete_after(0)
    assert watch.complete_after(STILL_S) == []
    ((event, why),) = watch.news
    assert event == "waiting"
    assert why.startswith(f"{METADATA} lists ")
    (file,) = bag.glob("*.mcap")
    shutil.copy(file, arrived)
    (arrived / METADATA).unlink()
    watch.complete_after(0)
    assert watch.complete_after(STILL_S) == []
    assert watch.news == [("waiting", f"no {METADATA} yet")]
    shutil.copy(bag / METADATA, arrived)
    watch.complete_after(0)
    assert watch.complete_after(STILL_S) == ["bag"]


def test_unfinished_file_is_ingested_only_with_salvage(bag, tmp_path):
    (file,) = bag.glob("*.mcap")
    (tmp_path / "run.mcap").write_bytes(file.read_bytes()[:-1000])
    for salvage in (False, True):
        watch = FakeWatch(tmp_path, salvage=salvage)
        assert watch.complete_after(0) == watch.complete_after(STILL_S) == []
        assert watch.complete_after(SALVAGE_AFTER_S) == ["run.mcap"] * salvage


@pytest.mark.parametrize(
    ("error", "is_retried"),
    [(FULL, True), (StoreError("out of reach"), True), (RecordingError("does not fit"), False)],
    ids=lambda value: str(getattr(value, "what", value)),
)
def test_only_temporary_failures_are_retried(error, is_retried, bag, tmp_path):
    shutil.copytree(bag, tmp_path / "bag")
    watch = FakeWatch(tmp_path)
    watch.complete_after(0)
    assert watch.complete_after(STILL_S) == ["bag"]
    assert watch.take(tmp_path / "bag", error)
    assert watch.complete_after(RETRY_S - 1) == []
    assert watch.complete_after(1) == ["bag"] * is_retried
    assert not watch.take(tmp_path / "bag", error)  # reported once
    os.utime(tmp_path / "bag" / METADATA, (1, 1))  # as if uploaded again
    watch.complete_after(0)
    assert watch.complete_after(STILL_S) == ["bag"]


def test_disappeared_folder_is_reported_and_recognised_later(bag, tmp_path):
    folder = tmp_path / "in"
    shutil.copytree(bag, folder / "bag")
    watch = FakeWatch(folder)
    watch.complete_after(0)
    watch.complete_after(STILL_S)
    watch.take(folder / "bag")
    folder.rename(tmp_path / "away")
    assert (watch.complete_after(1), watch.news) == ([], [("gone", "")])
    assert (watch.complete_after(1), watch.news) == ([], [])
    (tmp_path / "away").rename(folder)
    assert (watch.complete_after(1), watch.news) == ([], [("back", "")])
    assert watch.complete_after(STILL_S) == []


WATCH = """
__file__ = "watch"  # without it DuckDB assumes a prompt and draws progress bars
import sys
from restock.cli import main
from restock.cli.data import watch
watch.STILL_S = watch.POLL_S = 0.1
sys.exit(main(sys.argv[1:]))
"""


class WatchProcess:
    """A `restock ingest FOLDER --watch` in its own process."""

    def __init__(self, folder: Path, store: Path, hook: str) -> None:
        words = ["ingest", str(folder), "--store", str(store), "--json", "--watch", hook]
        self.ended = subprocess.Popen(
            [sys.executable, "-c", WATCH, *words], stdout=subprocess.PIPE, text=True
        )

    def until(self, event: str) -> list[str]:
        """Return the events up to and including the next one of this name."""
        events: list[str] = []
        assert self.ended.stdout is not None
        for line in self.ended.stdout:
            events.append(json.loads(line)["event"])
            if events[-1] == event:
                return events
        raise AssertionError(f"ended after {events}")

    def end(self, number: signal.Signals) -> int:
        self.ended.send_signal(number)
        self.ended.stdout.close()  # type: ignore[union-attr]
        return self.ended.wait(60)


class NearWallsDrive(Drive):
    """Drive between nearer walls, so that it is not taken for part of the first drive."""

    def topics(self) -> dict[str, Any]:
        found = super().topics()
        tenth = np.arange(0, self.duration_s, 0.1)
        return found | {"/scan": columns(tenth, scans(np.full((len(tenth), BEAMS), 2.5)))}


def test_killed_and_restarted_watch_loses_nothing(bag, tmp_path):
    folder, store, hook_log = tmp_path / "in", tmp_path / "store", tmp_path / "told"
    shutil.copytree(bag, folder / "one")
    other = write_bag(NearWallsDrive(), tmp_path / "made" / "two", storage="mcap")
    hook = f"cat >> {hook_log}; echo >> {hook_log}"
    watch = WatchProcess(folder, store, hook)
    assert watch.until("hook") == ["watch", "written", "coverage", "audit", "hook"]
    shutil.copytree(other, folder / "two")
    time.sleep(0.3)
    watch.end(signal.SIGKILL)  # before, during or after the ingest
    (folder / "one").rename(folder / "renamed")
    watch = WatchProcess(folder, store, hook)
    # for the part that was killed
    assert watch.until("hook") == ["watch", "coverage", "audit", "hook"]
    watch.until("unchanged")
    while len(names_in(store)) < 2:
        watch.until("written")
    assert watch.end(signal.SIGTERM) == 130
    assert sorted(names_in(store)) == ["one", "two"]
    with Store(store) as opened:
        found = opened.sql("SELECT count(*), count(DISTINCT transition_id) FROM transitions")
        ((rows, distinct),) = found.fetchall()
    assert rows == distinct
    first = json.loads(hook_log.read_text().splitlines()[0])
    assert [Path(recording["path"]).name for recording in first["recordings"]] == ["one"]
    assert first["audit"].keys() == {"fail", "warn"}


@pytest.mark.timeout(60)
def test_interrupt_reported_as_library_error_ends_watch(bag, tmp_path, monkeypatch):
    """DuckDB converts an interrupt inside a Python function into an error."""
    folder, store = tmp_path / "in", tmp_path / "store"
    shutil.copytree(bag, folder / "one")
    assert main(["ingest", str(folder / "one"), "--store", str(store)]) == 0

    def interrupted(*_: object) -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            raise RuntimeError("KeyboardInterrupt") from None

    monkeypatch.setattr("restock.cli.data.watch.run_audits", interrupted)
    assert main(["ingest", str(folder), "--store", str(store), "--watch"]) == 130


def names_in(store: Path) -> list[str]:
    with Store(store) as opened:
        found = opened.sql("SELECT source_file FROM recordings").fetchall()
    return [Path(name).name for (name,) in found]


def test_watch_arguments_are_checked(tmp_path, shell):
    for words, message in (
        ([str(tmp_path / "none"), "--store", "s", "--watch"], "not a folder"),
        ([str(tmp_path), "--dry-run", "--watch"], "takes one command"),
        ([str(tmp_path), "--store", "s", "--watch", "a", "b"], "takes one command"),
    ):
        assert message in shell.err("ingest", *words)
