"""A watched folder: what is taken, and when; and a process that is killed and started again."""

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
    """Return a bag whose files are named as rosbag2 names them."""
    folder = write_bag(Drive(), tmp_path_factory.mktemp("made") / "bag", storage="mcap")
    (folder / "bag.mcap").rename(folder / "bag_0.mcap")
    metadata = (folder / METADATA).read_text()
    (folder / METADATA).write_text(metadata.replace("bag.mcap", "bag_0.mcap"))
    return folder


class Seen:
    """Looks at a folder as a watch does, at times of the test's own."""

    def __init__(self, folder: Path, **options: bool) -> None:
        self.arrivals, self.now_s = Arrivals([str(folder)], **options), 0.0

    def after(self, wait_s: float) -> list[str]:
        self.now_s += wait_s
        return [path.name for path in self.arrivals.complete(self.now_s)]

    def take(self, path: Path, error: RecordingError | StoreError | None = None) -> bool:
        return self.arrivals.take(path, error, self.now_s)

    @property
    def news(self) -> list[tuple[str, str]]:
        return [(event, why) for event, _, why in self.arrivals.news]


def test_a_file_is_taken_once_its_upload_ended(bag, tmp_path):
    (file,) = bag.glob("*.mcap")
    upload, seen = tmp_path / "run.mcap", Seen(tmp_path)
    upload.write_bytes(file.read_bytes()[:-1000])
    assert seen.after(0) == seen.after(STILL_S - 1) == []
    assert seen.after(1) == []
    assert seen.news == [("waiting", "run.mcap has no MCAP footer yet")]
    assert (seen.after(60), seen.news) == ([], [])  # said once
    upload.write_bytes(file.read_bytes())
    assert seen.after(0) == []
    assert seen.after(STILL_S) == ["run.mcap"]
    seen.take(upload)
    assert seen.after(1000) == []


def test_a_bag_is_taken_once_its_metadata_is_there(bag, tmp_path):
    arrived, seen = tmp_path / "bag", Seen(tmp_path)
    arrived.mkdir()
    shutil.copy(bag / METADATA, arrived)
    seen.after(0)
    assert seen.after(STILL_S) == []
    ((event, why),) = seen.news
    assert event == "waiting"
    assert why.startswith(f"{METADATA} lists ")
    (file,) = bag.glob("*.mcap")
    shutil.copy(file, arrived)
    (arrived / METADATA).unlink()
    seen.after(0)
    assert seen.after(STILL_S) == []
    assert seen.news == [("waiting", f"no {METADATA} yet")]
    shutil.copy(bag / METADATA, arrived)
    seen.after(0)
    assert seen.after(STILL_S) == ["bag"]


def test_what_stays_unfinished_is_taken_only_with_salvage(bag, tmp_path):
    (file,) = bag.glob("*.mcap")
    (tmp_path / "run.mcap").write_bytes(file.read_bytes()[:-1000])
    for salvage in (False, True):
        seen = Seen(tmp_path, salvage=salvage)
        assert seen.after(0) == seen.after(STILL_S) == []
        assert seen.after(SALVAGE_AFTER_S) == ["run.mcap"] * salvage


@pytest.mark.parametrize(
    ("error", "again"),
    [(FULL, True), (StoreError("out of reach"), True), (RecordingError("does not fit"), False)],
    ids=lambda value: str(getattr(value, "what", value)),
)
def test_only_failures_that_may_pass_are_tried_again(error, again, bag, tmp_path):
    shutil.copytree(bag, tmp_path / "bag")
    seen = Seen(tmp_path)
    seen.after(0)
    assert seen.after(STILL_S) == ["bag"]
    assert seen.take(tmp_path / "bag", error)
    assert seen.after(RETRY_S - 1) == []
    assert seen.after(1) == ["bag"] * again
    assert not seen.take(tmp_path / "bag", error)  # said once
    os.utime(tmp_path / "bag" / METADATA, (1, 1))  # it was uploaded again
    seen.after(0)
    assert seen.after(STILL_S) == ["bag"]


def test_a_folder_that_disappears_is_named_once_and_known_again(bag, tmp_path):
    folder = tmp_path / "in"
    shutil.copytree(bag, folder / "bag")
    seen = Seen(folder)
    seen.after(0)
    seen.after(STILL_S)
    seen.take(folder / "bag")
    folder.rename(tmp_path / "away")
    assert (seen.after(1), seen.news) == ([], [("gone", "")])
    assert (seen.after(1), seen.news) == ([], [])
    (tmp_path / "away").rename(folder)
    assert (seen.after(1), seen.news) == ([], [("back", "")])
    assert seen.after(STILL_S) == []


WATCH = """
__file__ = "watch"  # without it DuckDB takes this for a prompt, and draws bars for slow queries
import sys
from restock.cli import main
from restock.cli.data import watch
watch.STILL_S = watch.POLL_S = 0.1
sys.exit(main(sys.argv[1:]))
"""


class Process:
    """A `restock ingest FOLDER --watch` of its own."""

    def __init__(self, folder: Path, store: Path, hook: str) -> None:
        words = ["ingest", str(folder), "--store", str(store), "--json", "--watch", hook]
        self.ended = subprocess.Popen(
            [sys.executable, "-c", WATCH, *words], stdout=subprocess.PIPE, text=True
        )

    def until(self, event: str) -> list[str]:
        """Return the events up to and including the next of this name."""
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


class Other(Drive):
    """A drive between nearer walls, so that it is no part of the first."""

    def topics(self) -> dict[str, Any]:
        found = super().topics()
        tenth = np.arange(0, self.duration_s, 0.1)
        return found | {"/scan": columns(tenth, scans(np.full((len(tenth), BEAMS), 2.5)))}


def test_killed_and_started_again_nothing_is_lost_or_doubled(bag, tmp_path):
    folder, store, told = tmp_path / "in", tmp_path / "store", tmp_path / "told"
    shutil.copytree(bag, folder / "one")
    other = write_bag(Other(), tmp_path / "made" / "two", storage="mcap")
    hook = f"cat >> {told}; echo >> {told}"
    watch = Process(folder, store, hook)
    assert watch.until("hook") == ["watch", "written", "coverage", "audit", "hook"]
    shutil.copytree(other, folder / "two")
    time.sleep(0.3)
    watch.end(signal.SIGKILL)  # before, in or after its ingest
    (folder / "one").rename(folder / "renamed")
    watch = Process(folder, store, hook)
    assert watch.until("hook") == ["watch", "coverage", "audit", "hook"]  # for what was killed
    watch.until("unchanged")
    while len(names_in(store)) < 2:
        watch.until("written")
    assert watch.end(signal.SIGTERM) == 130
    assert sorted(names_in(store)) == ["one", "two"]
    with Store(store) as opened:
        found = opened.sql("SELECT count(*), count(DISTINCT transition_id) FROM transitions")
        ((rows, different),) = found.fetchall()
    assert rows == different
    first = json.loads(told.read_text().splitlines()[0])
    assert [Path(one["path"]).name for one in first["recordings"]] == ["one"]
    assert first["audit"].keys() == {"fail", "warn"}


@pytest.mark.timeout(60)
def test_a_kill_that_a_library_reports_as_an_error_ends_it(bag, tmp_path, monkeypatch):
    """DuckDB makes an error of an interrupt in a Python function that it calls."""
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


def test_a_watch_takes_folders_and_one_command(tmp_path, shell):
    for words, why in (
        ([str(tmp_path / "none"), "--store", "s", "--watch"], "not a folder"),
        ([str(tmp_path), "--dry-run", "--watch"], "takes one command"),
        ([str(tmp_path), "--store", "s", "--watch", "a", "b"], "takes one command"),
    ):
        assert why in shell.err("ingest", *words)
