"""A study: the arms and seeds of its TOML file, and the runs to make of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec

from restock.errors import ConfigError, RunError
from restock.files import read_json
from restock.renamed import STUDY_KEYS
from restock.toml import Checked, read_toml, typed
from restock.train.dqn.config import (
    EvaluationConfig,
    ScheduleConfig,
    apply_overrides,
    as_overrides,
    parse_config,
    refuse_untaught,
)
from restock.train.evaluation.eval_run import FIRST_SEED, refuse_unknown, wrong_seed
from restock.train.judge.comparability import Treatment
from restock.train.study.contrasts import unknown_measure
from restock.train.twin.missions import KINDS


class ArmConfig(Checked, frozen=True):
    """One method: settings, and a panel, a mixture of the study's store, or neither."""

    name: str
    mixture: str | None = None  # name of a shipped mixture, or a TOML file
    panel: str | None = None  # path of an existing panel
    settings: dict[str, Any] = msgspec.field(default_factory=dict)  # keys of `restock train --set`
    treatment: Treatment | None = None  # None: the study's treatment
    baseline: str | None = None  # arm to compare with; None: the first

    def check(self) -> None:
        if not self.name or not all(c.isalnum() or c in "._-" for c in self.name):
            raise ValueError(f"name must be letters, digits, . _ or -, got {self.name!r}")
        if not self.name[0].isalnum():  # not "..", a hidden folder or an option
            raise ValueError(f"name must begin with a letter or a digit, got {self.name!r}")
        if self.mixture is not None and self.panel is not None:
            raise ValueError("panel must not be given beside mixture: choose one")


Count = Annotated[int, msgspec.Meta(ge=1)]


class StudyEvaluation(Checked, frozen=True):
    """The episodes that each run's policy drives after training, and planner and operator once."""

    # Episodes per kind of mission, or a table by kind; kinds that it leaves out are not driven.
    episodes: Count | dict[str, Count] = 40
    perturbations: tuple[str, ...] = ("none",)

    def check(self) -> None:
        kinds = list(self.episodes) if isinstance(self.episodes, dict) else []
        if unknown := [kind for kind in kinds if kind not in KINDS]:
            raise ValueError(
                f"episodes: there is no {unknown[0]!r}; choose from {', '.join(KINDS)}"
            )

    @property
    def episodes_by_kind(self) -> Mapping[str, int]:
        """Return the number of episodes by kind."""
        if isinstance(self.episodes, dict):
            return self.episodes
        return dict.fromkeys(KINDS, self.episodes)


class Primary(Checked, frozen=True):
    """The one contrast that a study tests, chosen before its runs."""

    arm: str  # name of the arm that is compared with its baseline
    measure: str


@dataclass(frozen=True)
class Pair:
    """An arm and the baseline that a study compares it with."""

    arm: ArmConfig
    baseline: ArmConfig
    treatment: Treatment


class Study(Checked, frozen=True):
    """The content of a study's TOML file."""

    arms: tuple[ArmConfig, ...]  # the first is the baseline of arms that name none
    doc: str = ""
    store: str | None = None  # store from which mixtures are made
    seeds: tuple[int, ...] = (0, 1, 2)
    treatment: Treatment = "mixture"  # treatment of arms that name none
    settings: dict[str, Any] = msgspec.field(default_factory=dict)  # settings of all arms
    evaluation: StudyEvaluation = StudyEvaluation()
    primary: Primary | None = None
    # Measures of the other contrasts, whose p values are adjusted for their number.
    measures: tuple[str, ...] = ("auc_rare", "success_rare", "success_nominal")

    def check(self) -> None:
        names = [arm.name for arm in self.arms]
        if len(names) < 2 or len(set(names)) != len(names):
            raise ValueError(f"arms must be two or more, each with its own name, got {names}")
        for arm in self.arms:
            if arm.baseline is not None and arm.baseline not in names:
                raise ValueError(f"baseline {arm.baseline!r} is not one of the arms {names}")
            if arm.baseline == arm.name:
                raise ValueError(f"arm {arm.name!r} is its own baseline")
        if self.base.treatment is not None or self.base.baseline is not None:
            raise ValueError(
                f"arm {self.base.name!r} is the first, the study's baseline: it cannot have a "
                "treatment or a baseline"
            )
        self._check_seeds()
        if self.store is None and any(arm.mixture for arm in self.arms):
            raise ValueError("an arm gives a mixture, but the study has no store")
        if any(
            "seed" in settings for settings in (self.settings, *(a.settings for a in self.arms))
        ):
            raise ValueError("the study sets the seeds: `settings` must not set seed")
        self._check_contrasts(names)

    def _check_seeds(self) -> None:
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise ValueError(
                f"seeds must be at least one, without repetition; got {list(self.seeds)}"
            )
        for wrong in filter(None, map(wrong_seed, self.seeds)):
            raise ValueError(f"seeds {wrong}")

    def _check_contrasts(self, names: list[str]) -> None:
        measures = (*self.measures, *((self.primary.measure,) if self.primary else ()))
        for wrong in filter(None, map(unknown_measure, measures)):
            raise ValueError(wrong)
        if self.primary is not None and self.primary.arm not in names[1:]:
            raise ValueError(
                f"primary: {self.primary.arm!r} is not one of the arms after the first {names[1:]}"
            )

    @property
    def base(self) -> ArmConfig:
        """Return the arm that the others are compared with, unless they name another."""
        return self.arms[0]

    @property
    def pairs(self) -> list[Pair]:
        """Return the comparisons, one per arm after the first, in the order of the arms."""
        return [
            Pair(
                arm,
                self._arm(arm.baseline) if arm.baseline is not None else self.base,
                arm.treatment or self.treatment,
            )
            for arm in self.arms[1:]
        ]

    def _arm(self, name: str) -> ArmConfig:
        return next(arm for arm in self.arms if arm.name == name)


def load_study(path: Path | str) -> Study:
    """Load a study from a TOML file.

    Raises:
        ConfigError: the file is missing or not TOML, a key is unknown or a value invalid; names it.
    """
    remedy = "docs/compare.md lists every key with its meaning"
    document = read_toml(Path(path))
    study = typed(document, Study, where=str(path), remedy=remedy, renamed=STUDY_KEYS)
    _refuse_unknown_names(study.evaluation, str(path))
    for arm in study.arms:
        sets = [*as_overrides(study.settings), *as_overrides(arm.settings)]
        config = parse_config(apply_overrides({}, sets), where=str(path))
        _refuse_shared_episodes(arm, config.evaluation, study.evaluation, str(path))
        _refuse_without_updates(arm, config.schedule, str(path))
        refuse_untaught(config, within=f"{path}: arm {arm.name!r}: ")
    return study


def _refuse_without_updates(arm: ArmConfig, schedule: ScheduleConfig, where: str) -> None:
    """Raise ConfigError if the runs of an arm would make no update."""
    has_logs = arm.mixture is not None or arm.panel is not None
    if (has_logs and schedule.offline_updates) or schedule.env_steps > schedule.warmup_env_steps:
        return
    raise ConfigError(
        f"arm {arm.name!r} would make no update: its schedule.env_steps ({schedule.env_steps:,})"
        f" end within schedule.warmup_env_steps ({schedule.warmup_env_steps:,})"
        + (", and schedule.offline_updates is 0" if has_logs else ", and it has no logs"),
        where=where,
        remedy="set schedule.env_steps above schedule.warmup_env_steps",
    )


def _refuse_unknown_names(evaluation: StudyEvaluation, where: str) -> None:
    """Raise ConfigError if the evaluation names an unknown perturbation."""
    names = evaluation.perturbations
    refuse_unknown("perturbations", names, where=f"{where}: evaluation.perturbations")


def _refuse_shared_episodes(
    arm: ArmConfig, chosen: EvaluationConfig, evaluation: StudyEvaluation, where: str
) -> None:
    """Raise ConfigError if an arm's policy would be judged on the episodes that select it."""
    judged = FIRST_SEED, FIRST_SEED + max(evaluation.episodes_by_kind.values())
    if chosen.seed < judged[1] and judged[0] < chosen.seed + chosen.episodes:
        raise ConfigError(
            f"arm {arm.name!r} would be evaluated on seeds {judged[0]} to {judged[1] - 1}, which "
            f"include those that choose its policy (from {chosen.seed})",
            where=where,
            remedy="set evaluation.seed in the settings to another range",
        )


DONE = "study.json"  # file in a run that was trained and evaluated as the study requests


@dataclass(frozen=True)
class StudyJob:
    """One run of a study."""

    arm: ArmConfig
    seed: int
    path: Path

    @property
    def done(self) -> Path:
        """Return the file that exists once the run is trained and evaluated as requested."""
        return self.path / DONE


@dataclass(frozen=True)
class StudyPlan:
    """A study with its folders."""

    study: Study
    folder: Path  # the TOML file's folder; paths in the file are relative to it
    out: Path

    @property
    def jobs(self) -> list[StudyJob]:
        """Return the jobs seed by seed: an interrupted study then has all arms of some seeds."""
        return [
            StudyJob(arm, seed, self.out / "runs" / f"{arm.name}-{seed}")
            for seed in self.study.seeds
            for arm in self.study.arms
        ]

    def runs(self, arm: ArmConfig) -> list[Path]:
        """Return the run directories of an arm, one per seed."""
        return [job.path for job in self.jobs if job.arm.name == arm.name]

    def panel(self, arm: ArmConfig) -> Path | None:
        """Return the path of an arm's panel; None without logs."""
        if arm.panel is not None:
            return self.folder / arm.panel
        return self.out / "panels" / arm.name if arm.mixture is not None else None

    def settings(self, arm: ArmConfig, seed: int) -> list[str]:
        """Return a run's settings as `key=value`."""
        return [*as_overrides(self.study.settings), *as_overrides(arm.settings), f"seed={seed}"]

    def fingerprint(self, job: StudyJob) -> str:
        """Return what a job requests, as JSON, for the run's `study.json`."""
        return json.dumps(self._request(job), indent=1) + "\n"

    def _request(self, job: StudyJob) -> dict[str, Any]:
        """Return what a job requests; the panel's path is relative, as a study may be moved."""
        own = None if job.arm.mixture is None else f"panels/{job.arm.name}"
        return {
            "settings": self.settings(job.arm, job.seed),
            "panel": own if job.arm.panel is None else job.arm.panel,
            "evaluation": msgspec.to_builtins(self.study.evaluation),
        }


def check_jobs(plan: StudyPlan) -> None:
    """Raise RunError if a finished run has other settings, ConfigError if a panel is missing."""
    for job in plan.jobs:
        if not job.done.exists():
            if job.arm.panel and not (plan.folder / job.arm.panel / "panel.json").is_file():
                raise ConfigError(
                    f"arm {job.arm.name!r}: there is no panel here",
                    where=str(plan.folder / job.arm.panel),
                    remedy="give a panel that `restock mix` made: paths are relative to the file",
                )
            continue
        made = read_json(job.done, error=RunError, remedy=f"remove {job.path}")
        requested = json.loads(plan.fingerprint(job))
        if made != requested:
            raise RunError(
                "was trained with other settings than the study now gives: then "
                f"{_difference(made, requested)}, now {_difference(requested, made)}",
                where=str(job.path),
                remedy="remove it, or give the study another --out",
            )


def _difference(request: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Describe the items of `request` that `other` lacks or has with another value."""
    settings = request.get("settings", ())
    reported = [text for text in settings if text not in other.get("settings", ())]
    reported += [
        f"{key} = {json.dumps(value)}"
        for key, value in request.items()
        if key != "settings" and other.get(key) != value
    ]
    return ", ".join(reported) or "the default"
