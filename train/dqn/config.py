"""The configuration of a training run: one typed struct, read from TOML, unknown keys refused.

A run's directory keeps the resolved one, so that nothing about a run is a default that may change
later. Every field has its meaning in a comment; `docs/train.md` explains the choices.
"""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from restock.errors import ConfigError
from restock.toml import toml_value
from restock.train.dqn.target import Polyak, TargetRule
from restock.train.jump_start import GuideConfig
from restock.train.twin.env.interface import LinearEpsilon
from restock.train.twin.physics.perturbation import find_perturbation

# Shares of true conditions among the episodes of the twin.
DEFAULT_CONDITIONS = {
    "nominal": 0.4,
    "wheel_slip": 0.2,
    "blocked_aisle": 0.2,
    "near_collision": 0.2,
}


class NetworkConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    hidden: tuple[int, ...] = (256, 256)
    layer_norm: bool = True
    dueling: bool = False
    quantiles: int = 0  # of each action's return (QR-DQN); 0 learns the mean alone
    ensemble: int = 1  # networks: their mean acts, their least is the target's value

    def __post_init__(self) -> None:
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"network.hidden must be positive widths, got {list(self.hidden)}")
        if self.quantiles < 0 or self.quantiles == 1:
            raise ValueError(f"network.quantiles must be 0 or above 1, got {self.quantiles}")
        if self.ensemble < 1:
            raise ValueError(f"network.ensemble must be at least 1, got {self.ensemble}")


class LossConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    discount: float = 0.97  # a step; a panel brings its own, which must agree
    n_step: int = 3  # of fresh rows; the panel's rows bring their own
    double: bool = True
    huber_delta: float = 10.0  # above what errors come to: at 1, rare heavy costs are half unseen
    conservative: float = 0.1  # weight of the CQL term on rows from logs, while offline
    conservative_online: float = 0.0  # … and the weight it goes to, linearly, once online
    conservative_steps: int = 20_000  # environment steps that this takes
    calibrated: bool = False  # Cal-QL: that term stops at the logs' return-to-go
    munchausen: float = 0.0  # weight of the log-policy in the reward (0.9 in the paper); 0: off
    munchausen_temperature: float = 0.03
    munchausen_floor: float = -1.0  # of the log-policy times the temperature
    margin: float = 0.0  # weight of DQfD's large margin on logged rows of `margin_policies`
    margin_size: float = 0.8  # by which their action must be better
    margin_policies: tuple[str, ...] = ("operator",)  # behaviour policies
    margin_strata: tuple[str, ...] = ()  # only in these strata of the logs; none: in all

    def __post_init__(self) -> None:
        if not 0 <= self.munchausen <= 1:
            raise ValueError(f"loss.munchausen must be in [0, 1], got {self.munchausen}")
        if self.munchausen_temperature <= 0 or self.munchausen_floor > 0:
            raise ValueError(
                "loss.munchausen_temperature must be above 0 and munchausen_floor at most 0"
            )
        if min(self.margin, self.margin_size) < 0:
            raise ValueError("loss.margin and loss.margin_size must be at least 0")
        if not 0 <= self.discount < 1:
            raise ValueError(f"loss.discount must be in [0, 1), got {self.discount}")
        if self.n_step < 1:
            raise ValueError(f"loss.n_step must be at least 1, got {self.n_step}")
        if self.huber_delta <= 0:
            raise ValueError(f"loss.huber_delta must be above 0, got {self.huber_delta}")
        if min(self.conservative, self.conservative_online) < 0:
            raise ValueError("loss.conservative and loss.conservative_online must be at least 0")
        if self.conservative_steps < 1:
            raise ValueError(
                f"loss.conservative_steps must be at least 1, got {self.conservative_steps}"
            )


class OptimizerConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    learning_rate: float = 1e-3
    max_grad_norm: float | None = None  # Huber bounds each row's gradient already

    def __post_init__(self) -> None:
        if self.learning_rate <= 0:
            raise ValueError(f"optimizer.learning_rate must be above 0, got {self.learning_rate}")
        if self.max_grad_norm is not None and self.max_grad_norm <= 0:
            raise ValueError(f"optimizer.max_grad_norm must be above 0, got {self.max_grad_norm}")


class ReplayConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    batch_size: int = 128
    logs_share: float | None = None  # of each online batch; None: what the panel's mixture says
    ring_capacity: int = 100_000  # fresh rows kept
    ring_reserved: float = 0.0  # share of them reserved for the conditions, in equal parts

    def __post_init__(self) -> None:
        if self.batch_size < 1:
            raise ValueError(f"replay.batch_size must be at least 1, got {self.batch_size}")
        if self.logs_share is not None and not 0 <= self.logs_share <= 1:
            raise ValueError(f"replay.logs_share must be in [0, 1], got {self.logs_share}")
        if self.ring_capacity < self.batch_size:
            raise ValueError("replay.ring_capacity must hold at least a batch")
        if not 0 <= self.ring_reserved <= 1:
            raise ValueError(f"replay.ring_reserved must be in [0, 1], got {self.ring_reserved}")


class ScheduleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    env_steps: int = 200_000  # the budget, in environment steps of all environments together
    seconds: float | None = None  # stop earlier, after this much training time
    offline_updates: int = 2_000  # on the panel alone, before the first environment step
    warmup_env_steps: int = 2_000  # rollouts before the first online update
    updates_per_env_step: float = 0.125

    def __post_init__(self) -> None:
        if self.env_steps < 0 or self.offline_updates < 0 or self.warmup_env_steps < 0:
            raise ValueError(
                "schedule.env_steps, offline_updates and warmup_env_steps must be at least 0"
            )
        if self.seconds is not None and self.seconds <= 0:
            raise ValueError(f"schedule.seconds must be above 0, got {self.seconds}")
        if self.updates_per_env_step <= 0:
            raise ValueError("schedule.updates_per_env_step must be above 0")


class EnvConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    num_envs: int = 16
    conditions: dict[str, float] = msgspec.field(default_factory=lambda: dict(DEFAULT_CONDITIONS))
    overlap: bool = True  # simulate on one thread while learning on another; same result
    layouts: str = "default"  # floors: generated:train, FILE.toml, map.yaml; docs/layouts.md
    # A ready-made one's name, a TOML file, or its table; of a schedule, one drawn an episode.
    perturbation: str | dict[str, Any] = "nominal"

    def __post_init__(self) -> None:
        if self.num_envs < 1:
            raise ValueError(f"env.num_envs must be at least 1, got {self.num_envs}")
        if not self.conditions or min(self.conditions.values()) < 0:
            raise ValueError("env.conditions must be shares, none below 0")
        if sum(self.conditions.values()) <= 0:
            raise ValueError("env.conditions must have a share above 0")
        if not isinstance(self.perturbation, str):
            find_perturbation(self.perturbation, where="env.perturbation")


class EvaluationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    every_env_steps: int = 20_000
    episodes: int = 10  # per condition
    seed: int = 90_000  # of the first fixed episode; kept away from training seeds
    averaging: float = 0.001  # rate of the average of weights that is evaluated; 1: the last ones
    layouts: str | None = None  # None: env.layouts, with generated:train's validation floors
    off_policy: bool = False  # judge the offline policy on held-out logs before it drives

    def __post_init__(self) -> None:
        if self.every_env_steps < 1 or self.episodes < 1:
            raise ValueError("evaluation.every_env_steps and evaluation.episodes must be above 0")
        if not 0 < self.averaging <= 1:
            raise ValueError(f"evaluation.averaging must be in (0, 1], got {self.averaging}")


class GuardConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    margin: float | None = None  # of success in a condition, below the kept policy's; None: off
    action: Literal["stop", "rollback"] = "stop"
    conditions: tuple[str, ...] = ()  # that are watched; none: all that are evaluated
    rollbacks: int = 3  # after so many the run stops

    def __post_init__(self) -> None:
        if self.margin is not None and not 0 < self.margin <= 1:
            raise ValueError(f"guard.margin must be in (0, 1], got {self.margin}")
        if self.rollbacks < 0:
            raise ValueError(f"guard.rollbacks must be at least 0, got {self.rollbacks}")


class RecordConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    every_updates: int = 500  # one logging interval
    audit_share: float = 0.01  # of all batches, every row of which is recorded
    probe_rows: int = 64  # per condition, held fixed for the whole run
    checkpoint_every_env_steps: int = 40_000
    keep_checkpoints: int = 3  # the latest and those before it; the best is kept besides
    tensorboard: bool = True

    def __post_init__(self) -> None:
        for name in ("every_updates", "checkpoint_every_env_steps", "keep_checkpoints"):
            if getattr(self, name) < 1:
                raise ValueError(f"record.{name} must be at least 1, got {getattr(self, name)}")
        if not 0 <= self.audit_share <= 1:
            raise ValueError(f"record.audit_share must be in [0, 1], got {self.audit_share}")
        if self.probe_rows < 0:
            raise ValueError(f"record.probe_rows must be at least 0, got {self.probe_rows}")


class TrainConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that decides a run, besides the panel."""

    seed: int = 0
    device: Literal["cpu", "cuda"] = "cpu"
    threads: int = 1  # of torch, on the CPU
    profile: str = "warehouse_amr"  # the robot: its task, conditions and zones
    network: NetworkConfig = NetworkConfig()
    loss: LossConfig = LossConfig()
    target: TargetRule = Polyak()
    optimizer: OptimizerConfig = OptimizerConfig()
    replay: ReplayConfig = ReplayConfig()
    schedule: ScheduleConfig = ScheduleConfig()
    epsilon: LinearEpsilon = LinearEpsilon()
    guide: GuideConfig = GuideConfig()
    env: EnvConfig = msgspec.field(default_factory=EnvConfig)
    evaluation: EvaluationConfig = EvaluationConfig()
    guard: GuardConfig = GuardConfig()
    record: RecordConfig = RecordConfig()

    def __post_init__(self) -> None:
        if self.loss.munchausen and self.network.quantiles:
            raise ValueError("loss.munchausen and network.quantiles do not go together: choose one")
        unknown = set(self.guard.conditions) - set(self.env.conditions)
        if unknown:
            raise ValueError(
                f"guard.conditions: {', '.join(sorted(unknown))} is not among env.conditions"
            )


def load_config(path: Path | None, overrides: Sequence[str] = ()) -> TrainConfig:
    """A config from a TOML file (or the defaults), then `key.path=value` overrides.

    Raises:
        ConfigError: no such file, no TOML, an unknown key or a value out of range; names the key.
    """
    document: dict[str, Any] = {}
    if path is not None:
        try:
            document = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ConfigError(
                f"cannot be read: {error.strerror}",
                where=str(path),
                remedy="give --config the path of a TOML file",
            ) from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ConfigError(f"is not TOML: {error}", where=str(path)) from error
    document = apply_overrides(document, overrides)
    return parse_config(document, where=str(path) if path is not None else "--set")


def apply_overrides(document: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """A copy of plain values with `key.path=value` applied; values are TOML, or bare strings."""
    changed = copy.deepcopy(dict(document))
    for override in overrides:
        _apply(changed, override)
    return changed


def as_overrides(document: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Nested settings as `key.path=value`, which `apply_overrides` takes."""
    found = []
    for key, value in document.items():
        # A target rule is one value: half of one and half of another would be none.
        if isinstance(value, Mapping) and prefix + key != "target":
            found += as_overrides(value, f"{prefix}{key}.")
        elif value is not None:
            found.append(f"{prefix}{key}={toml_value(value)}")
    return found


def parse_config(document: dict[str, Any], *, where: str) -> TrainConfig:
    """A typed config from plain values; errors name the key."""
    try:
        return msgspec.convert(document, TrainConfig)
    except msgspec.ValidationError as error:
        raise ConfigError(
            str(error).replace("$.", "").replace("Object ", ""),
            where=where,
            remedy="docs/train.md lists every key with its meaning",
        ) from error


def _apply(document: dict[str, Any], override: str) -> None:
    key, separator, text = override.partition("=")
    if not separator or not key.strip():
        raise ConfigError(
            f"{override!r} is not key=value",
            where="--set",
            remedy="write for example --set optimizer.learning_rate=1e-4",
        )
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text  # a bare word is a string
    *sections, last = key.strip().split(".")
    for section in sections:
        document = document.setdefault(section, {})
        if not isinstance(document, dict):
            raise ConfigError(f"{key!r} goes below a value", where="--set")
    document[last] = value


__all__ = [
    "DEFAULT_CONDITIONS",
    "TrainConfig",
    "apply_overrides",
    "as_overrides",
    "load_config",
    "parse_config",
]
