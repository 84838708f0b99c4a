"""One process at a time writes a run; it may be read meanwhile.

Two that train the same run replace each other's tables and checkpoints, and none can go on from
what they leave. The lock is the operating system's, on a file in the run: it ends with the process,
however that is killed. Where a file system has no locks, the run goes on without one.
"""

from __future__ import annotations

import fcntl
import os
import platform
from pathlib import Path

from restock.errors import RunError

LOCK = ".lock"  # in a run; says who writes it: process and machine


class RunLock:
    """Taken when it is made, until `release`."""

    def __init__(self, run: Path) -> None:
        """Raises RunError: another process trains this run; names it."""
        run.mkdir(parents=True, exist_ok=True)
        self._path = run / LOCK
        self._file: int | None = None
        while self._file is None:
            file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                holder = os.read(file, 256).decode("utf-8", "replace")
                os.close(file)
                raise _refused(run, holder) from error
            except OSError:  # a file system without locks
                os.close(file)
                self._path.unlink(missing_ok=True)
                return
            if _is_at(file, self._path):
                self._file = file
            else:  # whoever held it has removed the file since it was opened
                os.close(file)
        os.ftruncate(self._file, 0)
        os.write(self._file, f"{os.getpid()} {platform.node()}".encode())

    def release(self) -> None:
        """Let others write the run. Does nothing the second time."""
        if self._file is not None:
            self._path.unlink(missing_ok=True)
            os.close(self._file)
            self._file = None


def _is_at(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except FileNotFoundError:
        return False


def _refused(run: Path, holder: str) -> RunError:
    process, _, machine = holder.partition(" ")
    here = machine == platform.node()
    named = f"process {process}{'' if here else f' on {machine}'}" if process else "another process"
    kill = f" (Ctrl-C, or `kill {process}`{'' if here else ' there'})" if process else ""
    return RunError(
        f"is being trained by {named}",
        where=str(run),
        remedy=f"wait until it has ended, or stop it{kill}; then run the same command again",
    )


__all__ = ["LOCK", "RunLock"]
