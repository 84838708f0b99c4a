"""Several recordings: one after the other, in several processes, or on a Ray cluster."""

from __future__ import annotations

import signal
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from restock.errors import RecordingError, RestockError
from restock.ingest.pipeline import Outcome, ingest
from restock.ingest.profile.profile import Profile
from restock.ingest.store.writer import StoreWriter
from restock.ingest.workers import side_by_side

Result = tuple[Path, "Outcome | RestockError"]
Engine = Literal["processes", "ray"]
AGAIN = "run it again: what is in the store already is left alone"


@dataclass(frozen=True)
class Job:
    """What to do with every recording. `store` None is a dry run."""

    profile: Profile
    store: str | Path | None
    force: bool = False
    salvage: bool = False
    typestore: str | None = None

    def run(self, path: Path) -> Result:
        """Ingest one recording. What goes wrong with it is an answer, too: the others go on."""
        try:
            return path, ingest(
                path,
                self.profile,
                store=StoreWriter(self.store) if self.store is not None else None,
                force=self.force,
                salvage=self.salvage,
                typestore=self.typestore,
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
    paths: Sequence[Path], job: Job, *, workers: int = 1, engine: Engine = "processes"
) -> Iterator[Result]:
    """Each recording's outcome or error, in the order of `paths`.

    With several workers each recording is read and committed by one of them; commits that collide
    are tried again, so the store is the same as after one worker. With Ray, `workers` is how many
    it may start at once where it starts on this machine.

    Raises:
        ConfigError: Ray is asked for and is not installed, or its cluster does not answer.
    """
    if engine == "ray":
        from restock.ingest.on_ray import run_on_ray

        yield from run_on_ray(job, paths, workers=workers)
    elif min(workers, len(paths)) <= 1:
        yield from map(job.run, paths)
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
