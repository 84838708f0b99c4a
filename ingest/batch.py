"""Several recordings: one after the other, in several processes, or on a Ray cluster.

A process that dies (killed, or out of memory) costs the recording it was reading, by name; the
others go on, and another process takes its place. Processes are forked from a server that has
imported what they need once: forking this process, with its threads, would not be safe. It imports
that while this process does, so nothing here is imported before it is needed.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Generic, Literal, TypeVar, Union

from restock.errors import RecordingError, RestockError

if TYPE_CHECKING:
    from restock.ingest.containers.storage import Watch
    from restock.ingest.pipeline import IngestResult, OnRepeat
    from restock.ingest.profile.profile import Profile

Result = tuple[Path, Union["IngestResult", RestockError]]
Engine = Literal["processes", "ray"]
T = TypeVar("T")
PATIENCE_S = 10  # for a worker that was told to stop, before it is killed
AGAIN = "run it again: what is in the store already is left alone"


@dataclass(frozen=True)
class IngestJob:
    """What to do with every recording. `store` None is a dry run."""

    profile: Profile
    store: str | Path | None
    force: bool = False
    salvage: bool = False
    typestore: str | None = None
    repeated: OnRepeat = "keep"  # a recording that is in the store under another id
    tags: Mapping[str, str] = field(default_factory=dict)  # of every recording

    def run(self, path: Path, watch: Watch | None = None) -> Result:
        """Ingest one recording; an error is returned, so that the others continue."""
        from restock.ingest.pipeline import ingest
        from restock.ingest.store.writer import StoreWriter

        try:
            return path, ingest(
                path,
                self.profile,
                store=StoreWriter(self.store) if self.store is not None else None,
                force=self.force,
                salvage=self.salvage,
                typestore=self.typestore,
                repeated=self.repeated,
                tags=self.tags,
                watch=watch,
            )
        except RestockError as error:
            return path, error
        except MemoryError:
            return path, out_of_memory(path)
        except Exception as error:  # noqa: BLE001  (a defect costs its recording, not all of them)
            at = traceback.extract_tb(error.__traceback__)[-1]
            return path, RecordingError(
                f"a defect of Restock: {type(error).__name__}: {error}"
                f" ({Path(at.filename).name}, line {at.lineno})",
                where=str(path),
                remedy="please report it; the recording is not in the store, the others are",
            )


def ingest_all(
    paths: Sequence[Path],
    job: IngestJob,
    *,
    workers: int = 1,
    engine: Engine = "processes",
    watch: Watch | None = None,
) -> Iterator[Result]:
    """Each recording's outcome or error, in the order of `paths`.

    With several workers each recording is read and committed by one of them; commits that collide
    are tried again, so the store is the same as after one worker. With Ray, `workers` is how many
    it may start at once where it starts on this machine. `watch` is told how far a recording is,
    where they are read one after the other.

    Raises:
        ConfigError: Ray is to be used and is not installed, or its cluster does not answer.
    """
    if engine == "ray":
        from restock.ingest.on_ray import run_on_ray

        yield from run_on_ray(job, paths, workers=workers)
    elif min(workers, len(paths)) <= 1:
        for path in paths:
            yield job.run(path, watch)
    else:
        yield from side_by_side(job.run, paths, min(workers, len(paths)), died=_died)


def out_of_memory(path: Path) -> RecordingError:
    """The error of a recording for which memory did not suffice."""
    return RecordingError(
        "memory ran out", where=str(path), remedy=f"with fewer --workers, or more memory, {AGAIN}"
    )


def _died(path: Path, code: int) -> Result:
    how = f"was killed ({signal.Signals(-code).name})" if code < 0 else f"ended with code {code}"
    return path, RecordingError(
        f"the process that read it {how}",
        where=str(path),
        remedy=f"where memory ran out, take fewer --workers; {AGAIN}",
    )


@dataclass
class _Worker(Generic[T]):
    process: BaseProcess
    pipe: Connection
    at_hand: int | None = None  # place of its recording


def side_by_side(
    work: Callable[[Path], T],
    paths: Sequence[Path],
    workers: int,
    *,
    died: Callable[[Path, int], T],
) -> Iterator[T]:
    """What `work` gives for each path, in their order; `died(path, exit code)` where it died.

    The largest recordings are begun first, so that no process is left alone with one at the end.
    When the caller stops early, or Ctrl-C does, no work goes on.
    """
    ahead = deque(sorted(range(len(paths)), key=lambda place: -_size(paths[place])))
    pool: list[_Worker[T]] = []
    done: dict[int, T] = {}
    context = _context()

    def begin(worker: _Worker[T]) -> None:
        """Hand it its next recording, or let it go."""
        worker.at_hand = ahead.popleft() if ahead else None
        if worker.at_hand is None:
            worker.pipe.close()
            pool.remove(worker)
        else:
            worker.pipe.send(paths[worker.at_hand])

    def hire() -> None:
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, work), daemon=True)
        process.start()
        theirs.close()
        pool.append(_Worker(process, ours))
        begin(pool[-1])

    try:
        for place in range(len(paths)):
            while place not in done:
                while ahead and len(pool) < workers:
                    hire()
                ready = wait([worker.pipe for worker in pool])
                for worker in [worker for worker in pool if worker.pipe in ready]:
                    assert worker.at_hand is not None
                    try:
                        done[worker.at_hand] = worker.pipe.recv()
                    except (EOFError, ConnectionError):
                        worker.process.join()
                        path, code = paths[worker.at_hand], worker.process.exitcode or 0
                        done[worker.at_hand] = died(path, code)
                        worker.pipe.close()
                        pool.remove(worker)
                    else:
                        begin(worker)
            yield done.pop(place)
    finally:
        for worker in pool:
            worker.process.terminate()
        for worker in pool:
            worker.process.join(PATIENCE_S)
            worker.process.kill()


def warm_up() -> None:
    """Let the server of processes import what they need, while this process does."""
    if isinstance(_context(), ForkServerContext):
        forkserver.ensure_running()


def _serve(pipe: Connection, work: Callable[[Path], T]) -> None:
    """A worker: one recording after the other, until there are no more, or the parent is gone."""
    from restock.ingest.containers.mcap_group import ChunkReader

    ChunkReader.ahead = False  # the other workers have the other cores
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the parent decides
    signal.signal(signal.SIGTERM, _stop)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    try:
        while True:
            pipe.send(work(pipe.recv()))
    except (EOFError, KeyboardInterrupt):
        pipe.close()


def _stop(*_: object) -> None:
    """Stop as Ctrl-C would: between two steps of the work, which then cleans up."""
    raise KeyboardInterrupt


def _end_with(parent: int) -> None:
    """End when the parent has: its results are no longer read."""
    wait([parent])
    os._exit(1)


def _context() -> ForkServerContext | SpawnContext:
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["restock.ingest.batch", "restock.ingest.pipeline"])
    return context


def _size(path: Path) -> int:
    """Bytes of a recording, a folder's files together; 0 where it is gone."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())
