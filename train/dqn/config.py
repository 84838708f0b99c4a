"""The configuration of a training run: one typed struct, read from TOML, unknown keys refused.

A run's directory keeps the resolved config, so that no run depends on a default that may change
later. Every field has its meaning in a comment; `docs/train.md` explains the choices.
"""

from __future__ import annotations

import copy
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from restock.errors import ConfigError
from restock.renamed import TRAINING_KEYS
from restock.replay.fleet.missions_file import MissionOrder
from restock.toml import Checked, changed, read_toml, toml_value, typed
from restock.train.twin.env.interface import LinearEpsilon
from restock.train.twin.missions import DEFAULT_CONDITIONS
from restock.train.twin.physics.perturbation import find_perturbation

GIVEN = "given"  # `teacher.source` of a teacher that Python code passed in
PLANNER = "planner"  # `teacher.source` if the teacher is navigation's proposal in the observation

Count = Annotated[int, Meta(ge=1)]
Share = Annotated[float, Meta(ge=0, le=1)]
NonNegative = Annotated[float, Meta(ge=0)]
Positive = Annotated[float, Meta(gt=0)]
NonNegativeInt = Annotated[int, Meta(ge=0)]
LAST_SEED = 2**31 - 1  # the largest seed that all generators of the twin and libraries accept
Seed = Annotated[int, Meta(ge=0, le=LAST_SEED)]


class NetworkConfig(Checked, frozen=True):
    hidden: tuple[Count, ...] = (256, 256)  # widths of the layers
    layer_norm: bool = True

    def check(self) -> None:
        if not self.hidden:
            raise ValueError("hidden must name the width of at least one layer, got []")


class LossConfig(Checked, frozen=True):
    algorithm: str = "dqn"  # or your own, as module:name; docs/extending.md
    discount: Annotated[float, Meta(ge=0, lt=1)] = 0.99  # per step; must equal the panel's
    n_step: Count = 3  # steps per return of fresh rows; logged rows keep the panel's
    double: bool = True
    huber_delta: Positive = 10.0  # larger than most errors, so that rare high costs count
    # Weight of the CQL term on logged rows while offline; online it falls linearly to 0.
    conservative: NonNegative = 0.1
    margin: NonNegative = 0.0  # weight of DQfD's large margin on logged rows of `teacher.policies`


class Hard(Checked, frozen=True, tag_field="rule", tag="hard"):
    """A target that copies the online network at every `every`-th update (arXiv:1312.5602)."""

    every: Annotated[int, Meta(ge=1)] = 1000

    @property
    def effective_lag(self) -> float:
        """Return the mean age of the target in updates: every / 2."""
        return self.every / 2

    def __str__(self) -> str:
        return f"hard every {self.every}"


class Polyak(Checked, frozen=True, tag_field="rule", tag="polyak"):
    """A target that adds tau * (online - target) after every update (arXiv:1509.02971)."""

    tau: Annotated[float, Meta(gt=0, le=1)] = 0.005

    @property
    def effective_lag(self) -> float:
        """Return the mean age of the target's weights in updates: 1 / tau."""
        return 1 / self.tau

    def __str__(self) -> str:
        return f"polyak tau {self.tau:g}"


TargetRule = Hard | Polyak


def describe(rule: TargetRule) -> dict[str, Any]:
    """Return the rule as `config.json` has it, with the target's mean age in updates."""
    return {**msgspec.to_builtins(rule), "effective_lag_updates": rule.effective_lag}


class OptimizerConfig(Checked, frozen=True):
    learning_rate: Positive = 1e-3


class ReplayConfig(Checked, frozen=True):
    batch_size: Count = 128
    logs_share: Share | None = None  # logged rows' share of online batches; None: the mixture's
    ring_capacity: int = 100_000  # most fresh rows that the ring holds
    ring_reserved: Share = 0.0  # share of the ring reserved for conditions, in equal parts

    def check(self) -> None:
        if self.ring_capacity < self.batch_size:
            raise ValueError(
                f"ring_capacity must hold at least a batch of {self.batch_size},"
                f" got {self.ring_capacity}"
            )


class ScheduleConfig(Checked, frozen=True):
    env_steps: NonNegativeInt = 200_000  # budget in steps, summed over all environments
    seconds: Positive | None = None  # budget of training time; the first budget to run out ends it
    offline_updates: NonNegativeInt = 2_000  # updates on the panel alone, before any driving
    warmup_env_steps: NonNegativeInt = 2_000  # rollouts before the first online update
    updates_per_env_step: Annotated[float, Meta(gt=0, le=1_000)] = 0.25


class TeacherConfig(Checked, frozen=True):
    """The teacher, and how far the policy may deviate from its actions."""

    # "operator": the twin's operator. "planner": navigation's proposal, unless Q of another action
    # is larger by more than `margin`. "logs": only the cloned rows. "none". Or your own teacher, as
    # module:name. None: "operator" if the task has a goal, else "none".
    source: str | None = None
    margin: NonNegative = 0.2  # another action is taken if its Q exceeds the proposal's by more
    ratio: Share = 0.3  # an action is plausible if G(a|s) >= ratio * max G
    policies: tuple[str, ...] = ("operator",)  # drivers to clone, and to apply loss.margin to
    # Also clone episodes that reached their goal and that no driver of `policies` drove: until the
    # first environment step, or in the whole run if no teacher is queried in the twin.
    # None: true if goals are logged and no teacher is queried in the twin.
    successes: bool | None = None
    # Updates of the behaviour network on cloned rows, before the critic's first update.
    # None: `schedule.offline_updates`, times cloned rows / 5,000 (at least 1, at most 10).
    offline_updates: NonNegativeInt | None = None
    # Mirror half of the behaviour network's rows, left to right. This suits only a teacher without
    # a preferred side. None: true if the twin's operator teaches and each action has its opposite.
    mirror: bool | None = None

    @property
    def has_filter(self) -> bool:
        """Return whether there is a behaviour network."""
        return self.source not in (None, "none", PLANNER)

    @property
    def queried(self) -> bool:
        """Return whether a teacher is queried in the twin."""
        return self.source not in (None, "none", "logs", PLANNER)

    def check(self) -> None:
        named = (None, "none", "logs", "operator", PLANNER, GIVEN)
        if self.source not in named and not re.fullmatch(r"[\w.]+:\w+", str(self.source)):
            raise ValueError(
                "source must be none, operator, planner, logs, or your own teacher as module:name,"
                f" got {self.source!r}"
            )


class EnvConfig(Checked, frozen=True):
    twin: bool = True  # false: train on logs alone, keep the last policy
    num_envs: Count = 32
    # Relative shares of the twin's episodes by condition, which is the kind of mission.
    conditions: dict[str, NonNegative] = msgspec.field(
        default_factory=lambda: dict(DEFAULT_CONDITIONS)
    )
    # A missions file, or its [[missions]], for `missions_share` of the episodes; docs/train.md.
    missions: str | tuple[MissionOrder, ...] | None = None
    missions_share: Share = 0.5
    layouts: str = "default"  # floors: generated:train, FILE.toml, map.yaml; docs/layouts.md
    # Name of a ready-made perturbation, a TOML file or its table; a schedule draws one per episode.
    perturbation: str | dict[str, Any] = "nominal"

    def check(self) -> None:
        if sum(self.conditions.values()) <= 0:
            raise ValueError(f"conditions must have a share above 0, got {self.conditions}")
        if not isinstance(self.perturbation, str):
            find_perturbation(self.perturbation, where="env.perturbation")


class PracticeConfig(Checked, frozen=True):
    """How the twin's next missions are chosen: see `restock.train.feed.practice`."""

    rule: Literal["natural", "even", "success"] = "natural"


class EvaluationConfig(Checked, frozen=True):
    every_env_steps: Count = 20_000
    episodes: Count = 10  # episodes per condition
    seed: Seed = 90_000  # seed of the first fixed episode; not used in training
    layouts: str | None = None  # None: env.layouts, or the validation floors of generated:train
    off_policy: bool = False  # evaluate the policy on held-out logs before it drives


class RecordConfig(Checked, frozen=True):
    every_updates: Count = 500  # updates per logging interval
    audit_share: Share = 0.01  # share of batches whose rows are all recorded
    checkpoint_every_env_steps: Count = 40_000
    trackers: tuple[Literal["tensorboard", "wandb", "mlflow"], ...] = ("tensorboard",)  # for curves


class TrainConfig(Checked, frozen=True):
    """All settings of a run, except the panel."""

    seed: Seed = 0
    device: Literal["cpu", "cuda"] = "cpu"
    threads: Annotated[int, Meta(ge=1, le=1_024)] = 1  # threads of torch on the CPU
    profile: str = "warehouse_amr"  # the robot: its task, conditions and zones
    network: NetworkConfig = NetworkConfig()
    loss: LossConfig = LossConfig()
    target: TargetRule = Polyak()
    optimizer: OptimizerConfig = OptimizerConfig()
    replay: ReplayConfig = ReplayConfig()
    schedule: ScheduleConfig = ScheduleConfig()
    epsilon: LinearEpsilon = LinearEpsilon()
    teacher: TeacherConfig = TeacherConfig()
    env: EnvConfig = msgspec.field(default_factory=EnvConfig)
    practice: PracticeConfig = msgspec.field(default_factory=PracticeConfig)
    evaluation: EvaluationConfig = EvaluationConfig()
    record: RecordConfig = RecordConfig()

    def check(self) -> None:
        capacity, waiting = self.replay.ring_capacity, self.env.num_envs * self.loss.n_step
        if capacity < waiting:
            raise ValueError(
                f"replay.ring_capacity must be at least env.num_envs x loss.n_step = {waiting:,}"
                f" rows, got {capacity:,}"
            )


def has_effect(config: TrainConfig, key: str) -> bool:
    """Return whether `teacher.<key>` has an effect in this config."""
    if key == "policies" and config.loss.margin:
        return True
    source = config.teacher.source
    return source != "none" and (key == "margin") == (source == PLANNER)


def refuse_untaught(config: TrainConfig, *, within: str = "") -> None:
    """Raise ConfigError if the config sets a key of the teacher that its source does not use."""
    source = config.teacher.source
    given = changed(config.teacher, source=source)
    if idle := [key for key in given if not has_effect(config, key)]:
        named = "not given" if source is None else f'"{source}"'
        raise ConfigError(
            f"has no effect if teacher.source is {named}",
            where=f"{within}teacher.{idle[0]}",
            remedy="leave it out, or set teacher.source",
        )


def load_config(path: Path | None, overrides: Sequence[str] = ()) -> TrainConfig:
    """Load a config from a TOML file (or the defaults), then apply `key.path=value` overrides.

    Raises:
        ConfigError: the file is missing or not TOML, or a key is unknown or its value out of range;
            names the key.
    """
    if path is None:
        return parse_config(apply_overrides({}, overrides), where="--set")
    document = read_toml(path, remedy="give the path of a TOML file with --config")
    applied = apply_overrides(document, overrides)
    try:
        return parse_config(applied, where=f"{path} and --set")
    except ConfigError:  # if the file or --set is wrong by itself, raise its error instead
        parse_config(document, where=str(path))
        parse_config(apply_overrides({}, overrides), where="--set")
        raise


def apply_overrides(document: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return a copy of plain values with `key.path=value` applied.

    A value that is not TOML is taken as a string.
    """
    applied = copy.deepcopy(dict(document))
    for override in overrides:
        _apply(applied, override)
    return applied


def as_overrides(document: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Return nested settings as a list of `key.path=value` for `apply_overrides`."""
    overrides = []
    for key, value in document.items():
        # Keep a target rule as one value: keys of two rules must not be merged.
        if isinstance(value, Mapping) and prefix + key != "target":
            overrides += as_overrides(value, f"{prefix}{key}.")
        elif value is not None:
            overrides.append(f"{prefix}{key}={toml_value(value)}")
    return overrides


def parse_config(document: Mapping[str, Any], *, where: str) -> TrainConfig:
    """Parse a typed config from plain values.

    Raises:
        ConfigError: an unknown or renamed key, or a value out of range; names the key.
    """
    _refuse_other_rule(document.get("target"), where)
    remedy = "docs/train.md lists every key with its meaning"
    return typed(document, TrainConfig, where=where, remedy=remedy, renamed=TRAINING_KEYS)


def _refuse_other_rule(target: Any, where: str) -> None:
    """Raise ConfigError if a setting of one target rule is given under the other."""
    if not isinstance(target, Mapping):
        return
    for key, rule, other in (("every", "hard", "polyak"), ("tau", "polyak", "hard")):
        if key in target and target.get("rule") == other:
            raise ConfigError(
                f'`target.{key}` is a setting of target.rule = "{rule}", the rule is "{other}"',
                where=where,
                remedy=f'set target.rule = "{rule}" too, or leave it out',
            )


def _apply(document: dict[str, Any], override: str) -> None:
    key, separator, text = override.partition("=")
    if not separator or not key.strip():
        raise ConfigError(
            f"{override!r} is not of the form key=value",
            where="--set",
            remedy="write for example --set optimizer.learning_rate=1e-4",
        )
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text  # a bare word is a string
    *sections, last = key.strip().split(".")
    if sections == ["target"]:  # a key of the default rule, if no rule is given
        document.setdefault("target", {"rule": msgspec.to_builtins(TrainConfig().target)["rule"]})
    for section in sections:
        document = document.setdefault(section, {})
        if not isinstance(document, dict):
            raise ConfigError(f"{key!r} is below a key with a single value", where="--set")
    document[last] = value
