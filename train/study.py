"""A study: arms x seeds, each a run of its own, ending in one comparison through the gate.

A study is a TOML file and a directory. What is there already is not done again: a panel that was
built, a run that has ended, an evaluation that was driven. So a study that was interrupted, or got
another seed or arm, goes on where it was.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec

from restock.errors import ConfigError, RestockError, RunError
from restock.train.arms import Treatment
from restock.train.compare import Comparison, compare
from restock.train.config import as_overrides
from restock.train.library_arm import DONE, Library, LibraryArm, check_installed, resolve
from restock.train.run import write_text

Say = Callable[[str], None]
Engine = Literal["processes", "ray"]


class ArmConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One method: a panel (or a mixture of the study's store, or none) and settings."""

    name: str
    mixture: str | None = None  # of the study's store: a shipped name or a TOML file
    panel: str | None = None  # one that is there already
    settings: dict[str, Any] = msgspec.field(default_factory=dict)  # of `restock train --set`
    library: Library | None = None  # whose algorithm learns, in the same twin; None: Restock's
    arguments: dict[str, Any] = msgspec.field(default_factory=dict)  # that algorithm's own

    def __post_init__(self) -> None:
        if not self.name or not all(c.isalnum() or c in "._-" for c in self.name):
            raise ValueError(f"arms.name must be letters, digits, . _ or -, got {self.name!r}")
        if self.mixture is not None and self.panel is not None:
            raise ValueError(f"arm {self.name!r} names a mixture and a panel: choose one")
        if self.library is None and self.arguments:
            raise ValueError(f"arm {self.name!r} has arguments, and no library to take them")
        if self.library is not None and (self.mixture is not None or self.panel is not None):
            raise ValueError(f"arm {self.name!r} is a library's, which learns from no logs here")


class StudyEvaluation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    episodes: int = 40  # per kind
    perturbations: tuple[str, ...] = ("none",)
    seed: int = 10_000


class Study(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    arms: tuple[ArmConfig, ...]
    doc: str = ""
    store: str | None = None  # that mixtures are of
    seeds: tuple[int, ...] = (0, 1, 2)
    treatment: Treatment = "mixture"
    baseline: str | None = None  # the arm the others are compared with; None: the first
    settings: dict[str, Any] = msgspec.field(default_factory=dict)  # of every arm
    evaluation: StudyEvaluation = StudyEvaluation()

    def __post_init__(self) -> None:
        names = [arm.name for arm in self.arms]
        if len(names) < 2 or len(set(names)) != len(names):
            raise ValueError(f"arms must be two or more, each with its own name, got {names}")
        if self.baseline is not None and self.baseline not in names:
            raise ValueError(f"baseline {self.baseline!r} is none of the arms {names}")
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise ValueError(f"seeds must be one or more, each once, got {list(self.seeds)}")
        if self.store is None and any(arm.mixture for arm in self.arms):
            raise ValueError("an arm names a mixture, and the study no store")
        if any(
            "seed" in settings for settings in (self.settings, *(a.settings for a in self.arms))
        ):
            raise ValueError("seeds are the study's: `settings` must not set seed")

    @property
    def base(self) -> ArmConfig:
        return next((a for a in self.arms if a.name == self.baseline), self.arms[0])


def load_study(path: Path) -> Study:
    """A study from a TOML file.

    Raises:
        ConfigError: no such file, no TOML, an unknown key or a value that cannot be; names the key.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
        return msgspec.convert(document, Study)
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", where=str(path)) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"is not TOML: {error}", where=str(path)) from error
    except msgspec.ValidationError as error:
        raise ConfigError(
            str(error).replace("Object ", ""),
            where=str(path),
            remedy="docs/study.md lists every key with its meaning",
        ) from error


@dataclass(frozen=True)
class Job:
    """One run of a study."""

    arm: ArmConfig
    seed: int
    path: Path

    @property
    def done(self) -> Path:
        """There when the run was trained and evaluated as the study asks."""
        return self.path / "study.json"


@dataclass(frozen=True)
class Plan:
    """What there is to do."""

    study: Study
    folder: Path  # of the TOML: its paths are relative to it
    out: Path

    @property
    def jobs(self) -> list[Job]:
        """Seeds first: a study that is cut has fewer seeds of all arms, not fewer arms."""
        return [
            Job(arm, seed, self.out / "runs" / f"{arm.name}-{seed}")
            for seed in self.study.seeds
            for arm in self.study.arms
        ]

    def panel(self, arm: ArmConfig) -> Path | None:
        """Where an arm's panel is, or will be."""
        if arm.panel is not None:
            return self.folder / arm.panel
        return self.out / "panels" / arm.name if arm.mixture is not None else None

    def settings(self, arm: ArmConfig, seed: int) -> list[str]:
        """`key=value` of a run."""
        return [*as_overrides(self.study.settings), *as_overrides(arm.settings), f"seed={seed}"]

    def fingerprint(self, job: Job) -> str:
        """What a finished run was asked for, as JSON: another question makes another run."""
        panel = self.panel(job.arm)
        asked = {
            "settings": self.settings(job.arm, job.seed),
            "panel": str(panel) if panel is not None else None,
            "evaluation": msgspec.to_builtins(self.study.evaluation),
        }
        if job.arm.library is not None:
            asked |= {"library": job.arm.library, "arguments": job.arm.arguments}
        return json.dumps(asked, indent=1) + "\n"


def run_study(
    plan: Plan,
    *,
    workers: int = 1,
    engine: Engine = "processes",
    say: Say = lambda line: None,
) -> list[Comparison]:
    """Do what is not done yet, then compare every arm with the baseline, in the order of the arms.

    `engine` "ray" gives each run to a Ray cluster: see `restock.train.study_on_ray`.

    Raises:
        RunError: a run failed (its log says why), or was made by another version of the study.
        ConfigError: a library that an arm trains with, or Ray, is not installed.
    """
    for arm in plan.study.arms:
        if arm.library is not None:
            check_installed()
            resolve(tuple(plan.settings(arm, plan.study.seeds[0])), arm.library)
    for job in plan.jobs:
        if job.done.exists() and job.done.read_text(encoding="utf-8") != plan.fingerprint(job):
            raise RunError(
                "was made for other settings than the study now has",
                where=str(job.path),
                remedy="remove it, or give the study another --out",
            )
    for arm in plan.study.arms:
        _build(plan, arm, say)
    todo = [job for job in plan.jobs if not job.done.exists()]
    say(f"{len(plan.jobs) - len(todo)} of {len(plan.jobs)} runs are there already")
    if engine == "ray":
        from restock.train.study_on_ray import run_on_ray

        run_on_ray(plan, todo, workers=workers, say=say)
    else:
        _run_here(plan, todo, workers, say)
    runs = {
        arm.name: [job.path for job in plan.jobs if job.arm.name == arm.name]
        for arm in plan.study.arms
    }
    base = plan.study.base
    return [
        compare(runs[base.name], runs[arm.name], treatment=plan.study.treatment)
        for arm in plan.study.arms
        if arm.name != base.name
    ]


def _run_here(plan: Plan, todo: Sequence[Job], workers: int, say: Say) -> None:
    with ThreadPoolExecutor(max_workers=workers) as pool:
        futures = [pool.submit(run_job, plan, job, say) for job in todo]
        try:
            for future in futures:
                future.result()
        finally:  # after a failure or Ctrl-C nothing more is begun; what runs checkpoints and ends
            for future in futures:
                future.cancel()


def _build(plan: Plan, arm: ArmConfig, say: Say) -> None:
    """An arm's panel, if it is a mixture that has not been packed yet."""
    out = plan.panel(arm)
    if out is None or out.exists() or arm.mixture is None or plan.study.store is None:
        return
    store = plan.study.store
    if "://" not in store:
        store = str(plan.folder / store)
    mixture = plan.folder / arm.mixture
    name = str(mixture) if mixture.is_file() else arm.mixture
    say(f"packing {name} for {arm.name}")
    out.parent.mkdir(parents=True, exist_ok=True)
    _restock(["mix", store, "--mixture", name, "--out", str(out)], plan.out / "logs" / "mix.log")


def run_job(plan: Plan, job: Job, say: Say) -> None:
    """Train and evaluate one run; taken up from its checkpoint if it has one."""
    log = plan.out / "logs" / f"{job.path.name}.log"
    if job.arm.library is not None:
        _train_library(plan, job, job.arm.library, log, say)
    else:
        _train(plan, job, log, say)
    asked = plan.study.evaluation
    perturbations = ",".join(asked.perturbations)
    say(f"{job.path.name}: evaluating")
    _restock(
        [
            *("eval", str(job.path), "--policies", "agent", "--perturbations", perturbations),
            *("--episodes", str(asked.episodes), "--seed", str(asked.seed)),
        ],
        log,
    )
    write_text(job.done, plan.fingerprint(job))


def _train_library(plan: Plan, job: Job, library: Library, log: Path, say: Say) -> None:
    """Another library keeps no checkpoint to go on from: a run that was cut begins anew."""
    if (job.path / DONE).exists():
        return
    if job.path.exists():
        shutil.rmtree(job.path)
    settings = tuple(plan.settings(job.arm, job.seed))
    asked = LibraryArm(str(job.path), library, settings, job.arm.arguments)
    say(f"{job.path.name}: training with {library}")
    _command("restock.train.library_arm", [msgspec.json.encode(asked).decode()], log)


def _train(plan: Plan, job: Job, log: Path, say: Say) -> None:
    panel = plan.panel(job.arm)
    checkpoint = job.path / "checkpoints" / "latest.safetensors"
    if (job.path / "config.json").exists() and not checkpoint.exists():
        shutil.rmtree(job.path)  # cut before its first checkpoint: nothing to go on from
    if checkpoint.exists():
        arguments = ["train", "--resume", str(job.path)]
    else:
        sets = [word for setting in plan.settings(job.arm, job.seed) for word in ("--set", setting)]
        arguments = ["train", "--out", str(job.path), *sets]
        arguments += ["--panel", str(panel)] if panel is not None else []
    say(f"{job.path.name}: training")
    _restock(arguments, log)


def _restock(arguments: Sequence[str], log: Path) -> None:
    """One verb in a process of its own, its words in a log."""
    _command("restock", arguments, log)


def _command(module: str, arguments: Sequence[str], log: Path) -> None:
    what = f"{module} {arguments[0]}" if module == "restock" else module
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as file:
        file.write(f"$ {module} {' '.join(arguments)}\n")
        file.flush()
        ended = subprocess.run(
            [sys.executable, "-m", module, *arguments],
            stdout=file,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env={**os.environ, "NO_COLOR": "1"},
            check=False,
        )
    if ended.returncode == 130:
        raise KeyboardInterrupt
    if ended.returncode not in (0, 3):
        last = [line for line in log.read_text(encoding="utf-8").splitlines() if line.strip()][-3:]
        raise RestockError(
            f"`{what}` failed with exit code {ended.returncode}: " + " / ".join(last),
            where=str(log),
            remedy="mend it and run the study again: what is done is kept",
        )


__all__ = ["ArmConfig", "Engine", "Job", "Plan", "Study", "load_study", "run_job", "run_study"]
