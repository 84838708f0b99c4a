"""A study as its TOML file asks for it: arms x seeds, and what each arm is compared with."""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from restock.errors import ConfigError
from restock.train.comparison.arms import Treatment
from restock.train.dqn.config import as_overrides
from restock.train.libraries.library_arm import Library


class ArmConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One method: a panel (or a mixture of the study's store, or none) and settings."""

    name: str
    mixture: str | None = None  # of the study's store: a shipped name or a TOML file
    panel: str | None = None  # one that is there already
    settings: dict[str, Any] = msgspec.field(default_factory=dict)  # of `restock train --set`
    library: Library | None = None  # whose algorithm learns, in the same twin; None: Restock's
    arguments: dict[str, Any] = msgspec.field(default_factory=dict)  # that algorithm's own
    treatment: Treatment | None = None  # of its comparison; None: the study's
    baseline: str | None = None  # the arm it is compared with; None: the study's

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


@dataclass(frozen=True)
class Pair:
    """One comparison of a study."""

    arm: ArmConfig
    baseline: ArmConfig
    treatment: Treatment


class Study(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    arms: tuple[ArmConfig, ...]
    doc: str = ""
    store: str | None = None  # that mixtures are of
    seeds: tuple[int, ...] = (0, 1, 2)
    treatment: Treatment = "mixture"  # where an arm names none
    baseline: str | None = None  # where an arm names none; None: the first arm
    settings: dict[str, Any] = msgspec.field(default_factory=dict)  # of every arm
    evaluation: StudyEvaluation = StudyEvaluation()

    def __post_init__(self) -> None:
        names = [arm.name for arm in self.arms]
        if len(names) < 2 or len(set(names)) != len(names):
            raise ValueError(f"arms must be two or more, each with its own name, got {names}")
        for baseline in (self.baseline, *(arm.baseline for arm in self.arms)):
            if baseline is not None and baseline not in names:
                raise ValueError(f"baseline {baseline!r} is none of the arms {names}")
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


__all__ = ["ArmConfig", "Job", "Pair", "Plan", "Study", "StudyEvaluation", "load_study"]
