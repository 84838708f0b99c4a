"""Several recordings, one after the other or in several processes at once."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from restock.errors import RestockError
from restock.ingest.pipeline import Outcome, ingest
from restock.ingest.profile import Profile
from restock.ingest.store import StoreWriter

Result = tuple[Path, "Outcome | RestockError"]


@dataclass(frozen=True)
class Job:
    """What to do with every recording. `store` None is a dry run."""

    profile: Profile
    store: Path | None
    force: bool = False
    salvage: bool = False
    typestore: str | None = None

    def run(self, path: Path) -> Result:
        """Ingest one recording; an error that the user can mend is an answer, too."""
        store = StoreWriter(self.store) if self.store is not None else None
        try:
            return path, ingest(
                path,
                self.profile,
                store=store,
                force=self.force,
                salvage=self.salvage,
                typestore=self.typestore,
            )
        except RestockError as error:
            return path, error


def ingest_all(paths: Sequence[Path], job: Job, *, workers: int = 1) -> Iterator[Result]:
    """Each recording's outcome or error, in the order of `paths`.

    With several workers each recording is read and committed by one process; commits that collide
    are tried again, so the store is the same as after one worker.
    """
    workers = min(workers, len(paths))
    if workers <= 1:
        yield from map(job.run, paths)
        return
    # Forking a process that has threads (DuckDB's, Delta's) is not safe.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=_leave_ctrl_c_to_the_parent) as pool:
        futures = [pool.submit(job.run, path) for path in paths]
        try:
            for future in futures:
                yield future.result()
        except BaseException:
            # The recordings at hand are finished, whole; no other is begun.
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _leave_ctrl_c_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
