"""Ingest of several recordings, one after the other or in several worker processes.

If a worker dies (killed, or out of memory), the error names the recording it was reading, and a new
worker replaces it. The workers write files and this process commits them, several recordings at
once: otherwise each recording would take two commits. Workers are forked from a server process,
because forking this process, which has threads, would not be safe. The server imports the libraries
once, in parallel with this process.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar, Union

from restock.errors import TRACEBACK, RecordingError, RestockError, print_traceback
from restock.process import alone, in_step

if TYPE_CHECKING:
    from restock.ingest.containers.storage import Watch
    from restock.ingest.pipeline import CommitGroup, IngestResult, OnRepeat, Prepared
    from restock.ingest.profile.profile import Profile
    from restock.ingest.store.writer import StoreWriter

Result = tuple[Path, Union["IngestResult", RestockError]]
A = TypeVar("A")
T = TypeVar("T")
D = TypeVar("D")
# Limits of the short recordings that are labelled together: their number and total size.
MAX_BUNDLE, MAX_BUNDLE_BYTES = 16, 64 << 20
STOP_TIMEOUT_S = 10  # a worker that was asked to stop is killed after this time
RERUN = "run it again: recordings that are already in the store are skipped"


@dataclass(frozen=True)
class IngestJob:
    """The options of an ingest, the same for all its recordings. `store` None is a dry run."""

    profile: Profile
    store: str | Path | None
    force: bool = False
    salvage: bool = False
    definitions: str | None = None
    repeated: OnRepeat = "keep"  # what to do with a drive that is stored under another id
    tags: Mapping[str, str] = field(default_factory=dict)  # given to every recording

    @cached_property
    def writer(self) -> StoreWriter | None:
        """Return the store's writer, created once per job; a copy by `replace` creates its own."""
        from restock.ingest.store.writer import StoreWriter

        return StoreWriter(self.store) if self.store is not None else None

    def prepare(
        self,
        path: Path,
        watch: Watch | None = None,
        settle: Callable[[str], None] = lambda recording_id: None,
    ) -> Prepared | RestockError:
        """Read one recording and write its files; return errors, so that other recordings go on."""
        from restock.ingest.pipeline import preparing

        try:
            options = {**self.options, "watch": watch, "settle": settle}
            return alone(preparing(path, self.profile, **options))
        except RestockError as error:
            return error
        except MemoryError:
            return out_of_memory(path)
        except Exception as error:  # noqa: BLE001  (a bug must fail one recording, not all)
            print_traceback(error)
            if isinstance(error, OSError) and error.strerror:  # a disk or network error, no bug
                return RecordingError(
                    f"cannot be read or written: {error.strerror}",
                    where=str(path if error.filename is None else error.filename),
                    remedy="check its disk and the free space; this recording was not added to the "
                    "store, the others were",
                )
            at = traceback.extract_tb(error.__traceback__)[-1]
            return RecordingError(
                f"a bug in Restock: {type(error).__name__}: {error}"
                f" ({Path(at.filename).name}, line {at.lineno})",
                where=str(path),
                remedy=f"please report it ({TRACEBACK}=1 shows the traceback); this recording was "
                "not added to the store, the others were",
            )

    def prepare_several(
        self, paths: Sequence[Path], **more: Any
    ) -> Iterator[tuple[int, Prepared | RestockError]]:
        """Prepare recordings together; yield the index and result of each when it is done.

        Their labels and summaries are computed together. A recording for which that fails is
        prepared again alone.
        """
        from restock.ingest.pipeline import Prepared, preparing

        left, ids = dict(enumerate(paths)), set[str]()
        settle = more.get("settle", ids.add)

        def settle_first(recording_id: str) -> None:
            if recording_id in ids:
                raise LookupError  # the same recording again: the last loop prepares it alone
            settle(recording_id)
            ids.add(recording_id)

        with suppress(Exception):  # after an error in a shared call, the last loop does the rest
            options = {**self.options, **more, "settle": settle_first}
            works = [preparing(path, self.profile, **options) for path in paths if len(paths) > 1]
            for place, outcome in in_step(works):
                if isinstance(outcome, Prepared | RestockError):
                    del left[place]
                    yield place, outcome
        for place, path in left.items():
            yield place, self.prepare(path, **more)

    def prepare_list(self, paths: Sequence[Path]) -> list[Prepared | RestockError]:
        """Return the result of `prepare` for each path, in the order of `paths`."""
        return [one for _, one in sorted(self.prepare_several(paths), key=itemgetter(0))]

    @property
    def options(self) -> dict[str, Any]:
        """Return the arguments of `preparing` that are the same for every recording."""
        names = ("force", "salvage", "definitions", "repeated", "tags")
        return {"store": self.writer, **{name: getattr(self, name) for name in names}}


def ingest_all(
    paths: Sequence[Path | str],
    job: IngestJob,
    *,
    workers: int = 1,
    watch: Watch | None = None,
) -> Iterator[Result]:
    """Ingest recordings; yield each path with its result or error, in order, after its commit.

    A worker reads a recording and writes its files. Only this process commits: every few seconds,
    all files that are ready. So the store does not depend on the number of workers. `watch` is
    called with the progress within a recording, but only with one worker. If the caller stops
    early, recordings that are not yet committed are discarded.
    """
    from restock.ingest.pipeline import CommitGroup

    recordings = [Path(path) for path in paths]
    own_job = replace(job)  # a copy to create a writer in: `job` itself is sent to the workers
    group = CommitGroup(own_job.writer)
    processes = min(workers, len(recordings))
    if processes > 1:
        outcomes = _prepare_in_workers(job, recordings, processes, group)
    else:
        outcomes = _prepare_serially(own_job, recordings, group, watch)
    next_up = 0
    try:
        with closing(outcomes):
            for arrived in outcomes:
                if arrived is None:
                    group.commit_if_due()
                else:
                    group.add(*arrived)
                while next_up in group.results:
                    yield recordings[next_up], group.results.pop(next_up)
                    next_up += 1
        group.commit()
        for place in range(next_up, len(recordings)):
            yield recordings[place], group.results.pop(place)
    finally:
        group.discard()


def _prepare_serially(
    job: IngestJob, paths: Sequence[Path], group: CommitGroup, watch: Watch | None
) -> Generator[tuple[int, Prepared | RestockError]]:
    """Prepare the recordings in this process, and commit waiting ones while a long one is read."""

    def watched(what: str, done: int, of: int) -> None:
        group.commit_if_due()
        if watch is not None:
            watch(what, done, of)

    for bundle in _bundles(paths, MAX_BUNDLE):
        several = [paths[place] for place in bundle]
        for at, outcome in job.prepare_several(several, watch=watched, settle=group.settle):
            yield bundle[at], outcome


def _prepare_in_workers(
    job: IngestJob, paths: Sequence[Path], workers: int, group: CommitGroup
) -> Generator[tuple[int, Prepared | RestockError] | None]:
    """Prepare recordings in several processes; if one dies, read its recordings again singly."""

    def died(bundle: Sequence[Path], code: int) -> list[Prepared | RestockError]:
        return [_died_error(path, code) for path in bundle if len(bundle) == 1]

    left = _bundles(paths, min(MAX_BUNDLE, max(len(paths) // (4 * workers), 1)))
    while left:
        bundles, left = left, []
        several = [[paths[place] for place in bundle] for bundle in bundles]
        for arrived in run_in_workers(
            job.prepare_list, several, workers, died=died, wait_s=group.due_in_s
        ):
            if arrived is None:
                yield None
                continue
            bundle, found = bundles[arrived[0]], arrived[1]
            left += [[place] for place in bundle if not found]
            yield from zip(bundle, found, strict=False)


def _bundles(paths: Sequence[Path], most: int) -> list[list[int]]:
    """Bundle consecutive paths, as indices: at most `most` and MAX_BUNDLE_BYTES in a bundle."""
    bundles: list[list[int]] = []
    total = 0
    for place, path in enumerate(paths):
        size = _size(path)
        if not bundles or len(bundles[-1]) >= most or total + size > MAX_BUNDLE_BYTES:
            bundles.append([])
            total = 0
        bundles[-1].append(place)
        total += size
    return bundles


def out_of_memory(path: Path) -> RecordingError:
    """Return the error of a recording that ran out of memory."""
    return RecordingError(
        "out of memory", where=str(path), remedy=f"use fewer --workers or more memory, then {RERUN}"
    )


def _died_error(path: Path, code: int) -> RecordingError:
    ending = f"was killed ({signal.Signals(-code).name})" if code < 0 else f"ended with code {code}"
    return RecordingError(
        f"the process that read it {ending}",
        where=str(path),
        remedy=f"if out of memory, use fewer --workers; then {RERUN}",
    )


@dataclass
class _Worker(Generic[T]):
    process: BaseProcess
    pipe: Connection
    index: int | None = None  # index of the recording it works on


def run_in_workers(
    work: Callable[[A], T],
    paths: Sequence[A],
    workers: int,
    *,
    died: Callable[[A, int], D],
    wait_s: Callable[[], float | None] = lambda: None,
) -> Generator[tuple[int, T | D] | None]:
    """Call `work` on each element in worker processes; yield its index and result when it is done.

    An element is a path or a sequence of paths. If its process died, the result is `died(element,
    exit code)`. Yields None if no result came for `wait_s()` seconds, evaluated at each wait.
    The largest recordings begin first, so that none of them runs alone at the end. If the caller or
    Ctrl-C stops early, all workers end.
    """
    ahead = deque(sorted(range(len(paths)), key=lambda place: -_size(paths[place])))
    pool: list[_Worker[T]] = []
    context = _context()

    def begin(worker: _Worker[T]) -> None:
        """Give the worker the next recording, or end it if none is left."""
        worker.index = ahead.popleft() if ahead else None
        if worker.index is None:
            worker.pipe.close()
            pool.remove(worker)
        else:
            worker.pipe.send(paths[worker.index])

    def hire() -> None:
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, work), daemon=True)
        process.start()
        theirs.close()
        pool.append(_Worker(process, ours))
        begin(pool[-1])

    try:
        while ahead or pool:
            while ahead and len(pool) < workers:
                hire()
            ready = wait([worker.pipe for worker in pool], wait_s())
            if not ready:
                yield None
            for worker in [worker for worker in pool if worker.pipe in ready]:
                place = worker.index
                assert place is not None
                try:
                    found: T | D = worker.pipe.recv()
                except (EOFError, ConnectionError):
                    worker.process.join()
                    found = died(paths[place], worker.process.exitcode or 0)
                    worker.pipe.close()
                    pool.remove(worker)
                else:
                    begin(worker)
                yield place, found
    finally:
        for worker in pool:
            worker.process.terminate()
        for worker in pool:
            worker.process.join(STOP_TIMEOUT_S)
            worker.process.kill()


def warm_up() -> None:
    """Start the fork server, which imports the libraries while this process does."""
    if isinstance(_context(), ForkServerContext):
        forkserver.ensure_running()


def _serve(pipe: Connection, work: Callable[[A], T]) -> None:
    """Run a worker: call `work` on what arrives, until the parent closes the pipe or is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent decides
    signal.signal(signal.SIGTERM, _interrupt)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_exit_with_parent, args=(parent.sentinel,), daemon=True).start()
    try:
        while True:
            pipe.send(work(pipe.recv()))
    except (EOFError, KeyboardInterrupt):
        pipe.close()


def _interrupt(*_: object) -> None:
    """Handle SIGTERM like Ctrl-C: raise KeyboardInterrupt, so that the work cleans up."""
    raise KeyboardInterrupt


def _exit_with_parent(parent: int) -> None:
    """End this process when its parent ends, as nobody reads its results any more."""
    wait([parent])
    os._exit(1)


def _context() -> ForkServerContext | SpawnContext:
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    used = ["restock.ingest.batch", "restock.ingest.pipeline", "duckdb", "pyarrow.compute"]
    context.set_forkserver_preload(used)
    return context


def _size(path: object) -> int:
    """Return the size in bytes of a file, a folder or a sequence of them; 0 if it is gone."""
    if not isinstance(path, Path):
        return sum(map(_size, path if isinstance(path, Sequence) else ()))
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())
