"""A study's runs on a Ray cluster, one task each. Needs the extra: `pip install 'restock[ray]'`.

The cluster is that of RAY_ADDRESS, or one that is started on this machine and stopped again. Its
machines must have Restock installed, and see the study's directory by the same path.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from restock.errors import RestockError, RunError
from restock.ingest.on_ray import cluster
from restock.train.study.study import Job, Plan
from restock.train.study.study_run import Say, run_job


def run_on_ray(plan: Plan, jobs: Sequence[Job], *, workers: int, say: Say) -> None:
    """Train and evaluate every run; the first failure is raised when all others have ended.

    Raises:
        ConfigError: Ray is not installed, or the cluster does not answer.
        RunError: a run's task died.
        RestockError: a run failed; its log says why.
    """
    with cluster(workers) as ray:
        task = ray.remote(_task).options(num_cpus=1, max_retries=0)
        waiting = {task.remote(plan, job, str(Path.cwd())): job for job in jobs}
        failed: RestockError | None = None
        while waiting:
            (ended, *_), _ = ray.wait(list(waiting), num_returns=1)
            job = waiting.pop(ended)
            try:
                error = ray.get(ended)
            except ray.exceptions.RayError as died:
                error = RunError(
                    f"the process that made it died ({type(died).__name__})",
                    where=str(job.path),
                    remedy="run the study again: what is done is kept",
                )
            if error is None:
                say(f"{job.path.name}: trained and evaluated")
            else:
                failed = failed or error
        if failed is not None:
            raise failed


def _task(plan: Plan, job: Job, folder: str) -> RestockError | None:
    """One run, on whatever machine."""
    try:
        os.chdir(folder)
    except OSError:
        return RunError(
            f"the machine that was to make it has no folder {folder}",
            where=str(job.path),
            remedy="put the study where every machine of the cluster sees it",
        )
    try:
        run_job(plan, job, lambda line: None)
    except RestockError as error:
        return error
    return None


__all__ = ["run_on_ray"]
