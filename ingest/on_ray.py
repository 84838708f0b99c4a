"""Recordings on a Ray cluster, one task each. Needs the extra: `pip install 'restock[ray]'`.

The cluster is that of RAY_ADDRESS, or one that is started on this machine and stopped again. Its
machines must have Restock installed, and see recordings and store by the same paths: a shared file
system, or a store on S3.
"""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from restock.errors import ConfigError, RecordingError
from restock.imports import import_extra
from restock.ingest.batch import AGAIN, out_of_memory

if TYPE_CHECKING:
    from restock.errors import RestockError
    from restock.ingest.batch import IngestJob
    from restock.ingest.prepared import Prepared

CONNECT_S = 5
ENVIRONMENT = "AWS_"  # what the tasks are given of this process's environment


def prepare_on_ray(
    job: IngestJob,
    paths: Sequence[Path],
    *,
    workers: int = 1,
    patience_s: Callable[[], float | None] = lambda: None,
) -> Generator[tuple[int, Prepared | RestockError] | None]:
    """What was made of each recording, with its place in `paths`, as it comes; None where nothing
    came for `patience_s()` seconds. Nothing of it is committed.

    Raises:
        ConfigError: Ray is not installed, or the cluster does not answer.
    """
    with cluster(workers) as ray:
        # A task that died may have written files: it is not tried again unasked.
        task = ray.remote(_task).options(num_cpus=1, max_retries=0)
        aws = {name: value for name, value in os.environ.items() if name.startswith(ENVIRONMENT)}
        begun = {
            task.remote(job, path, str(Path.cwd()), aws): place for place, path in enumerate(paths)
        }
        while begun:
            ready, _ = ray.wait(list(begun), timeout=patience_s())
            if not ready:
                yield None
            for result in ready:
                place = begun.pop(result)
                yield place, _answer(ray, result, paths[place])


def _answer(ray: Any, result: Any, path: Path) -> Prepared | RestockError:
    try:
        answer: Prepared | RestockError = ray.get(result)
    except ray.exceptions.OutOfMemoryError:
        return out_of_memory(path)
    except ray.exceptions.RayError as error:
        return RecordingError(
            f"the process that read it died ({type(error).__name__})",
            where=str(path),
            remedy=AGAIN,
        )
    return answer


@contextmanager
def cluster(workers: int) -> Iterator[Any]:
    """Ray, with a cluster to give tasks to."""
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # or Ray warns of it
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no usage reports
    ray = import_extra("ray", "ray", "--engine ray needs Ray")
    if ray.is_initialized():  # by the caller
        yield ray
        return
    address = os.environ.get("RAY_ADDRESS")
    _expect(address)
    quiet: dict[str, Any] = {"logging_level": "error", "log_to_driver": False}
    try:
        if address:
            ray.init(address=address, **quiet)
        else:
            ray.init(address="local", num_cpus=max(workers, 1), include_dashboard=False, **quiet)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise ConfigError(
            f"no Ray cluster at {address}: {str(error).splitlines()[0]}"
            if address
            else f"Ray does not start: {str(error).splitlines()[0]}",
            remedy="check RAY_ADDRESS, or unset it to start one here" if address else None,
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _expect(address: str | None) -> None:
    """Knock at a cluster's door: Ray itself would wait for minutes."""
    match = re.fullmatch(r"(?:ray://)?([^:/]+):(\d+)", address or "")
    if match is None:  # none, or a word like "auto"
        return
    try:
        socket.create_connection((match[1], int(match[2])), timeout=CONNECT_S).close()
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"no Ray cluster at {address}: {error}",
            remedy="check RAY_ADDRESS, or unset it to start one here",
        ) from error


def _task(
    job: IngestJob, path: Path, folder: str, environment: dict[str, str]
) -> Prepared | RestockError:
    """One recording, on whatever machine."""
    from restock.ingest.containers.mcap_group import ChunkReader

    ChunkReader.ahead = False  # the task was given one core
    os.environ.update(environment)
    try:
        os.chdir(folder)
    except OSError:
        return RecordingError(
            f"the worker machine has no folder {folder}",
            where=str(path),
            remedy="put the recordings in a folder that all machines of the cluster can read",
        )
    return job.prepare(path)
