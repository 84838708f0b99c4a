"""A study: arms x seeds as its TOML file asks for, what there is to do, and the page it ends in."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec

from restock.toml import Checked, read_toml, typed
from restock.train.comparison.arms import Treatment
from restock.train.comparison.compare import LEAST_EPISODES, LEAST_RUNS, Comparison
from restock.train.dqn.config import as_overrides
from restock.train.libraries.library_arm import Library


class ArmConfig(Checked, frozen=True):
    """One method: a panel (or a mixture of the study's store, or none) and settings."""

    name: str
    mixture: str | None = None  # of the study's store: a shipped name or a TOML file
    panel: str | None = None  # one that already exists
    settings: dict[str, Any] = msgspec.field(default_factory=dict)  # of `restock train --set`
    library: Library | None = None  # whose algorithm learns, in the same twin; None: Restock's
    arguments: dict[str, Any] = msgspec.field(default_factory=dict)  # that algorithm's own
    treatment: Treatment | None = None  # of its comparison; None: the study's
    baseline: str | None = None  # the arm it is compared with; None: the study's

    def check(self) -> None:
        if not self.name or not all(c.isalnum() or c in "._-" for c in self.name):
            raise ValueError(f"name must be letters, digits, . _ or -, got {self.name!r}")
        if self.mixture is not None and self.panel is not None:
            raise ValueError("panel must not be given beside mixture: choose one")
        if self.library is None and self.arguments:
            raise ValueError("arguments: there is no library to take them")
        if self.library is not None and (self.mixture is not None or self.panel is not None):
            raise ValueError("library: it learns from no logs here, give no mixture or panel")


class StudyEvaluation(Checked, frozen=True):
    episodes: Annotated[int, msgspec.Meta(ge=1)] = 40  # per kind
    perturbations: tuple[str, ...] = ("none",)
    seed: int = 10_000


@dataclass(frozen=True)
class Pair:
    """One comparison of a study."""

    arm: ArmConfig
    baseline: ArmConfig
    treatment: Treatment


class Study(Checked, frozen=True):
    """The whole file."""

    arms: tuple[ArmConfig, ...]
    doc: str = ""
    store: str | None = None  # that mixtures are of
    seeds: tuple[int, ...] = (0, 1, 2)
    treatment: Treatment = "mixture"  # where an arm names none
    baseline: str | None = None  # where an arm names none; None: the first arm
    settings: dict[str, Any] = msgspec.field(default_factory=dict)  # of every arm
    evaluation: StudyEvaluation = StudyEvaluation()

    def check(self) -> None:
        names = [arm.name for arm in self.arms]
        if len(names) < 2 or len(set(names)) != len(names):
            raise ValueError(f"arms must be two or more, each with its own name, got {names}")
        for baseline in (self.baseline, *(arm.baseline for arm in self.arms)):
            if baseline is not None and baseline not in names:
                raise ValueError(f"baseline {baseline!r} is not one of the arms {names}")
        for arm in self.arms:
            if arm.baseline == arm.name:
                raise ValueError(f"arm {arm.name!r} is its own baseline")
        if self.base.treatment is not None or self.base.baseline is not None:
            raise ValueError(
                f"arm {self.base.name!r} is the study's baseline, and is compared with no other:"
                " it takes neither treatment nor baseline"
            )
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
        """The arm that the others are compared with, unless they name one of their own."""
        return self._arm(self.baseline) if self.baseline is not None else self.arms[0]

    @property
    def pairs(self) -> list[Pair]:
        """What is compared with what, in the order of the arms."""
        return [
            Pair(
                arm,
                self._arm(arm.baseline) if arm.baseline is not None else self.base,
                arm.treatment or self.treatment,
            )
            for arm in self.arms
            if arm.name != self.base.name
        ]

    def _arm(self, name: str) -> ArmConfig:
        return next(arm for arm in self.arms if arm.name == name)


def load_study(path: Path) -> Study:
    """A study from a TOML file.

    Raises:
        ConfigError: no such file, no TOML, an unknown key or an invalid value; names the key.
    """
    remedy = "docs/study.md lists every key with its meaning"
    return typed(read_toml(path), Study, where=str(path), remedy=remedy)


@dataclass(frozen=True)
class StudyJob:
    """One run of a study."""

    arm: ArmConfig
    seed: int
    path: Path

    @property
    def done(self) -> Path:
        """There when the run was trained and evaluated as the study asks."""
        return self.path / "study.json"


@dataclass(frozen=True)
class StudyPlan:
    """A study and its folders: the runs to do."""

    study: Study
    folder: Path  # of the TOML: its paths are relative to it
    out: Path

    @property
    def jobs(self) -> list[StudyJob]:
        """Seeds first: an interrupted study has fewer seeds of all arms, not fewer arms."""
        return [
            StudyJob(arm, seed, self.out / "runs" / f"{arm.name}-{seed}")
            for seed in self.study.seeds
            for arm in self.study.arms
        ]

    def runs(self, arm: ArmConfig) -> list[Path]:
        """The run directories of an arm, one a seed."""
        return [job.path for job in self.jobs if job.arm.name == arm.name]

    def panel(self, arm: ArmConfig) -> Path | None:
        """Where an arm's panel is, or will be."""
        if arm.panel is not None:
            return self.folder / arm.panel
        return self.out / "panels" / arm.name if arm.mixture is not None else None

    def settings(self, arm: ArmConfig, seed: int) -> list[str]:
        """`key=value` of a run."""
        return [*as_overrides(self.study.settings), *as_overrides(arm.settings), f"seed={seed}"]

    def fingerprint(self, job: StudyJob) -> str:
        """What a finished run was asked to be, as JSON: another request makes another run."""
        panel = self.panel(job.arm)
        request = {
            "settings": self.settings(job.arm, job.seed),
            "panel": str(panel) if panel is not None else None,
            "evaluation": msgspec.to_builtins(self.study.evaluation),
        }
        if job.arm.library is not None:
            request |= {"library": job.arm.library, "arguments": job.arm.arguments}
        return json.dumps(request, indent=1) + "\n"


def findings(plan: StudyPlan, comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """The study and every comparison, as JSON values."""
    return {
        "doc": plan.study.doc,
        "seeds": list(plan.study.seeds),
        "runs": {arm.name: [str(path) for path in plan.runs(arm)] for arm in plan.study.arms},
        "comparisons": [
            {"arm": pair.arm.name, "baseline": pair.baseline.name, **comparison.as_json()}
            for pair, comparison in zip(plan.study.pairs, comparisons, strict=True)
        ],
    }


def as_markdown(study: dict[str, Any]) -> str:
    """The same for people."""
    lines = [f"# Study: {', '.join(study['runs'])}", ""]
    lines += [study["doc"], ""] if study["doc"] else []
    lines += [
        f"Seeds of each arm: {', '.join(map(str, study['seeds']))}. All are evaluated on the same"
        " episodes. Intervals are 95 %, over seeds and episodes; bold where they exclude 0. From"
        f" fewer than {LEAST_RUNS} seeds or {LEAST_EPISODES} episodes, and where resamples do not"
        " vary, there are values alone.",
    ]
    for comparison in study["comparisons"]:
        baseline, treatment = comparison["baseline"], comparison["treatment"]
        lines += ["", f"## {comparison['arm']} against {baseline}", ""]
        lines += [f"Compared: the {treatment}.", ""]
        if treatment == "method":
            lines += [_held(comparison), ""]
        if comparison["verdict"] != "comparable":
            lines += [_refusal(comparison)]
            continue
        lines += [
            f"| perturbation | condition | {baseline} | {comparison['arm']} | difference |"
            " P(higher return) |",
            "| --- | --- | --- | --- | --- | --- |",
        ]
        for row in comparison["outcomes"]:
            low, high = row["difference_low"], row["difference_high"]
            known = low is not None
            apart = "**" if known and (low > 0 or high < 0) else ""
            interval = f" [{low:+.2f}, {high:+.2f}]" if known else ""
            lines.append(
                f"| {row['perturbation']} | {row['condition']} | {_cell(row['success'][0], '.2f')}"
                f" | {_cell(row['success'][1], '.2f')} | {apart}{_cell(row['difference'], '+.2f')}"
                f"{interval}{apart} | {row['improvement']:.2f} |"
            )
    return "\n".join(lines) + "\n"


def _cell(value: float | None, form: str) -> str:
    return "no goal" if value is None else format(value, form)


def _refusal(comparison: dict[str, Any]) -> str:
    """Why there are no outcomes."""
    if comparison["refused"]:
        return (
            f"Not compared: they differ in {', '.join(comparison['refused'])}, which"
            f' treatment = "{comparison["treatment"]}" does not allow.'
        )
    verdict = comparison["verdict"]
    names = [check["name"] for check in comparison["checks"] if check["verdict"] == verdict]
    return f"Not compared: {verdict} in {', '.join(dict.fromkeys(names))}."


def _held(comparison: dict[str, Any]) -> str:
    """What a comparison of methods holds fixed, and what it does not."""
    kinds = ("feed", "target", "algorithm")
    differ: dict[str, list[str]] = {kind: [] for kind in kinds}
    for difference in comparison["differences"]:
        name = difference["setting"]
        if name.startswith("library.arguments."):  # its own: one name for all of them
            name = "library.arguments"
        if name not in differ.get(difference["kind"], [name]):
            differ[difference["kind"]].append(name)
    words = {"feed": "replay", "target": "the target rule", "algorithm": "the algorithm"}
    free = [f"{words[kind]} ({', '.join(names)})" for kind, names in differ.items() if names]
    same = [words[kind] for kind in kinds[:2] if not differ[kind]]
    fixed = ", ".join(["the environment and its conditions", "environment steps", *same])
    return f"Held fixed: {fixed} and the evaluation. Not held: {'; '.join(free) or 'nothing'}."


__all__ = [
    "ArmConfig",
    "Pair",
    "Study",
    "StudyEvaluation",
    "StudyJob",
    "StudyPlan",
    "as_markdown",
    "findings",
    "load_study",
]
