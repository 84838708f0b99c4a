"""Several workers: same results, surviving dead workers, and no partial stores."""

import contextlib
import errno
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from support.driven_robot import write_bags
from support.long import one_in

from restock.cli import main
from restock.errors import RecordingError
from restock.ingest.batch import IngestJob, ingest_all, run_in_workers
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task import conditions
from restock.replay.store.store import Store, is_store


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of recordings."""
    return write_bags(tmp_path_factory.mktemp("bags"), 5)


def _length(path: Path) -> int:
    if path.name == "slow":
        time.sleep(0.3)
    if path.name.startswith("killed"):
        os.kill(os.getpid(), signal.SIGKILL)
    if path.name == "gone":
        os._exit(7)
    return len(path.name)


def test_each_path_has_one_result_if_workers_die() -> None:
    names = ["slow", "a", "killed1", "bb", "ccc", "gone", "dddd", "killed2"]
    found = run_in_workers(_length, [Path(name) for name in names], 2, died=lambda path, code: code)
    assert sorted(found) == list(enumerate([4, 1, -9, 2, 3, 7, 4, -9]))


def test_closing_results_early_stops_the_workers() -> None:
    found = run_in_workers(_length, [Path("a"), *[Path("slow")] * 50], 2, died=lambda *_: -1)
    assert next(found) in ((0, 1), (1, 4))
    found.close()
    assert multiprocessing.active_children() == []


class _DyingJob(IngestJob):
    """Job whose process dies at one recording, alone or read together with others."""

    def prepare_several(self, paths, **more):
        if any(path.name == "drive1" for path in paths):
            os.kill(os.getpid(), signal.SIGKILL)
        return super().prepare_several(paths, **more)


def test_recording_of_dead_worker_is_reported_and_exits_3(bags, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("restock.ingest.batch.IngestJob", _DyingJob)
    monkeypatch.setattr("restock.ingest.batch._bundles", lambda paths, most: [[0, 1], [2]])
    drives = [str(bags / f"drive{number}") for number in range(3)]
    code = main(["ingest", *drives, "--store", str(tmp_path / "s"), "--workers", "2", "--json"])
    out, err = capsys.readouterr()
    statuses = {
        Path(recording["path"]).name: recording["status"]
        for recording in json.loads(out)["recordings"]
    }
    assert code == 3
    assert statuses.pop("drive1") == "failed"
    assert list(statuses.values()) == ["written"] * 2
    assert "drive1: the process that read it was killed (SIGKILL)" in err


def test_recordings_read_together_give_same_results(bags, tmp_path, monkeypatch):
    evaluated, evaluate = [], conditions.label_with_probabilities
    monkeypatch.setattr(
        conditions,
        "label_with_probabilities",
        lambda steps, rules: evaluated.append(len(steps)) or evaluate(steps, rules),
    )
    drives, profile = sorted(bags.iterdir())[:3], load_profile("warehouse_amr")
    copy = shutil.copytree(drives[1], tmp_path / "copy")
    (empty := tmp_path / "empty.mcap").touch()
    found = dict(ingest_all([*drives, copy, empty], IngestJob(profile, tmp_path / "s")))
    assert [found[path].status for path in (*drives, copy)] == ["written"] * 3 + ["unchanged"]
    assert isinstance(found[empty], RecordingError)
    assert len(evaluated) == 1
    for path in drives:
        ingest(path, profile, store=StoreWriter(tmp_path / "t"))
    assert len(evaluated) == 4
    assert contents(tmp_path / "s") == contents(tmp_path / "t")


def contents(store: Path) -> dict[str, str]:
    """Return the rows of each recording's files, without columns about the ingest."""
    return {
        str(file.parent.relative_to(store)): str(
            [
                {name: value for name, value in row.items() if not name.startswith("ingest")}
                for row in pq.ParquetFile(file).read().to_pylist()
            ]
        )
        for file in store.rglob("*.parquet")
    }


@pytest.mark.long
def test_unexpected_error_fails_only_its_recording(bags, tmp_path, monkeypatch):
    from restock.ingest import pipeline

    preparing = pipeline.preparing

    def failing(path, *args, **kwargs):
        if path.name == "drive1":
            raise MemoryError
        return preparing(path, *args, **kwargs)

    monkeypatch.setattr(pipeline, "preparing", failing)
    job = IngestJob(load_profile("warehouse_amr"), tmp_path / "s")
    results = dict(ingest_all(sorted(bags.iterdir()), job))
    assert "out of memory\n  use fewer --workers" in str(results.pop(bags / "drive1"))
    assert {result.status for result in results.values()} == {"written"}


def test_disk_error_is_not_reported_as_bug(monkeypatch):
    def failing(*args, **kwargs):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("restock.ingest.pipeline.preparing", failing)
    failed = IngestJob(load_profile("warehouse_amr"), None).prepare(Path("nas/run.mcap"))
    assert "nas/run.mcap: cannot be read or written: Input/output error" in str(failed)


def test_traceback_is_printed_if_requested(bags, monkeypatch, shell):
    monkeypatch.setattr("restock.ingest.pipeline.preparing", lambda path, *_, **__: path.no_such)
    arguments = ["ingest", str(bags / "drive1"), "--dry-run", "--json"]
    stderr = shell.err(*arguments)
    assert "drive1: a bug in Restock: AttributeError" in stderr
    assert "Traceback" not in stderr
    monkeypatch.setenv("RESTOCK_TRACEBACK", "1")
    assert "Traceback (most recent call last)" in shell.err(*arguments)


def command(bags: Path, store: Path, *more: str) -> list[str]:
    return [
        sys.executable, "-m", "restock", "ingest", str(bags), "--store", str(store), "--json", *more
    ]  # fmt: skip


def _alive(pid: int) -> bool:
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
    return stat.rsplit(")", 1)[1].split()[0] != "Z"


def descendants(pid: int) -> list[int]:
    """Return the ids of a process's children and their descendants."""
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a thread that just ended
            for child in map(int, task.read_text().split()):
                found += [child, *descendants(child)]
    return found


def wait_for_store(process: subprocess.Popen[str], store: Path) -> None:
    """Wait until the first recording is stored."""
    while not is_store(store):
        assert process.poll() is None
        time.sleep(0.01)


def rows(store: Path) -> dict[str, int]:
    """Return transitions per source, as a reader sees them."""
    with Store(store) as opened:
        found = opened.sql(
            "SELECT recordings.source_file[-6:], recordings.transitions, count(*)"
            " FROM transitions JOIN recordings USING (ingest_id) GROUP BY ALL"
        ).fetchall()
    assert all(in_manifest == num_rows for _, in_manifest, num_rows in found)
    assert len({name for name, _, _ in found}) == len(found)
    return {name: num_rows for name, _, num_rows in found}


needs_proc = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs Linux' /proc")


@pytest.mark.long
@needs_proc
@pytest.mark.parametrize(("workers", "after_s"), one_in(3, [("2", 0.0), ("1", 0.0), ("2", 0.06)]))
def test_killed_ingest_leaves_complete_recordings(bags, tmp_path, workers, after_s):
    store = tmp_path / "s"
    process = subprocess.Popen(
        command(bags, store, "--workers", workers), text=True, start_new_session=True
    )
    wait_for_store(process, store)
    time.sleep(after_s)
    children = descendants(process.pid)
    process.kill()
    process.wait()
    while any(map(_alive, children)):  # the workers end on their own
        time.sleep(0.01)
    before = rows(store)
    second = subprocess.run(
        command(bags, store, "--workers", workers), capture_output=True, text=True
    )
    assert second.returncode == 0
    recordings = {
        Path(recording["path"]).name: recording
        for recording in json.loads(second.stdout)["recordings"]
    }
    assert len(recordings) == 5
    assert {name: recording["transitions"] for name, recording in recordings.items()} == rows(store)
    unchanged = {
        name for name, recording in recordings.items() if recording["status"] == "unchanged"
    }
    assert unchanged == set(before)


@pytest.mark.long  # 12 s; killed ingests are tested in every run
@needs_proc
def test_ctrl_c_exits_130_and_stops_workers(bags, tmp_path):
    store = tmp_path / "s"
    process = subprocess.Popen(
        command(bags, store, "--workers", "2"),
        text=True,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    wait_for_store(process, store)
    children = descendants(process.pid)
    os.killpg(process.pid, signal.SIGINT)  # to the whole group, as a terminal does
    _, err = process.communicate()
    assert (process.returncode, err) == (130, "restock: interrupted; no partial files were left\n")
    while any(map(_alive, children)):
        time.sleep(0.01)
    rows(store)
