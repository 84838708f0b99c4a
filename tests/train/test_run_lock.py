"""Check that a run has one writer, stays readable, and is unlocked if its writer is killed."""

import errno
import fcntl
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from restock.errors import RunError
from restock.train.run.run import LOCK, Run, RunLock, check_free

HOLDS = "import pathlib, sys, time; from restock.train.run.run import RunLock;"
HOLDS += "lock = RunLock(pathlib.Path(sys.argv[1])); print(flush=True); time.sleep(600)"


def test_lock_is_free_after_its_holder_is_killed(tmp_path: Path) -> None:
    run = tmp_path / "run"
    holder = subprocess.Popen([sys.executable, "-c", HOLDS, str(run)], stdout=subprocess.PIPE)
    with holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        for _ in range(2):  # a rejected writer changes nothing
            with pytest.raises(RunError) as refused:
                RunLock(run)
            assert f"{run}: is being trained by process {holder.pid}\n" in str(refused.value)
            assert f"`kill {holder.pid}`" in str(refused.value)
        holder.kill()
    assert (run / LOCK).exists()  # left by the killed process
    check_free(run)
    RunLock(run).release()
    assert not (run / LOCK).exists()


def test_locked_run_is_readable_but_not_writable(tmp_path: Path) -> None:
    lock = RunLock(tmp_path)
    Run.create(tmp_path, {})
    assert Run.open(tmp_path).table("audit").num_rows == 0
    with pytest.raises(RunError, match=f"is being trained by process {os.getpid()}"):
        RunLock(tmp_path)
    (tmp_path / LOCK).write_text("77 elsewhere")
    with pytest.raises(RunError, match="by process 77 on elsewhere") as refused:
        RunLock(tmp_path)
    assert "`kill 77` there" in str(refused.value)
    lock.release()
    lock.release()
    with_another = RunLock(tmp_path)
    assert (tmp_path / LOCK).read_text() == f"{os.getpid()} {platform.node()}"
    with_another.release()


def test_file_system_without_locks_is_accepted(tmp_path, monkeypatch):
    def refuse(*_: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    first, second = RunLock(tmp_path), RunLock(tmp_path)
    first.release()
    second.release()
    assert not list(tmp_path.iterdir())
