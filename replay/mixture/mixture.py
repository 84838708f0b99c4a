"""A mixture: which transitions a learner is fed, in which shares, as a TOML file.

Only what the file says happens: unknown keys are refused with their path, and every default is
visible in `restock mix --dry-run`. `docs/mixture.md` explains each key.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Literal

import msgspec

from restock.errors import ConfigError
from restock.replay.mixture.schedules import Schedule
from restock.replay.mixture.sources import Sources, check

Timing = Literal["pre", "post"]
Share = float | Literal["natural", "equal"] | Schedule
Correction = Literal["none", "beta", "full", "clipped", "density_ratio"]
Shortfall = Literal["refuse", "redistribute", "shrink"]
Unit = Literal["step", "episode"]
Within = Literal["uniform", "without_replacement", "per", "lap"]


class PlannedUse(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How much will be drawn, as far as `restock mix` can know; a run puts its own in its place."""

    updates: int = 20_000
    batch_size: int = 128

    def __post_init__(self) -> None:
        check(self.updates > 0 and self.batch_size > 0, "planned: both must be above 0")


class HeldOut(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Episodes kept out of the panel, whole: `share` of the rows, chosen by `by`."""

    by: Literal["episode", "recording", "time", "none"] = "episode"
    share: float = 0.1

    def __post_init__(self) -> None:
        check(0 <= self.share < 1, f"held_out.share must be in [0, 1), got {self.share:g}")


class Safety(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Rows that nobody is to learn from."""

    unsafe: str  # SQL predicate over `transitions`
    leave_out: Literal["rows", "episodes"] = "rows"  # those alone, or all of their episode


class CorrectionRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Importance weights against the boost of strata, by what their condition may look at."""

    pre: Correction = "none"  # chosen on the state: the fixed point stays where it is
    post: Correction = "full"  # chosen on the outcome: uncorrected, Q is biased
    beta: float = 0.5  # exponent of the weights where the rule is "beta"
    clip: float = 4.0  # largest weight of "clipped" (and smallest inverse) and "density_ratio"

    def __post_init__(self) -> None:
        check(0 <= self.beta <= 1, f"correction.beta must be in [0, 1], got {self.beta:g}")
        check(self.clip >= 1, f"correction.clip must be at least 1, got {self.clip:g}")


class Prioritised(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The numbers of `within = "per"` (arXiv:1511.05952) and `"lap"` (arXiv:2007.06049)."""

    per_alpha: float = 0.6  # exponent of |TD|
    per_beta: float = 0.4  # exponent of the importance weights, to begin with
    per_beta_batches: int = 100_000  # after which it is 1
    per_epsilon: float = 1e-3  # added to |TD|
    lap_alpha: float = 0.4  # exponent of max(|TD|, 1)

    def __post_init__(self) -> None:
        for name in ("per_alpha", "per_beta", "lap_alpha"):
            value = getattr(self, name)
            check(0 <= value <= 1, f"prioritised.{name} must be in [0, 1], got {value:g}")
        check(
            self.per_epsilon > 0 and self.per_beta_batches >= 1,
            "prioritised.per_epsilon and per_beta_batches must be above 0",
        )


class Adaptive(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Shares that follow the TD error: group DRO (arXiv:1911.08731) over the strata of the logs."""

    step_size: float = 0.05  # of the exponent, a step; |TD| is taken in units of its mean
    floor: float = 0.01  # the least share of a stratum that has rows
    ceiling: float = 0.6  # the largest
    every_updates: int = 100  # one step
    after_updates: int = 1_000  # none before: first errors say more of the network than of rows

    def __post_init__(self) -> None:
        check(self.step_size > 0, f"adaptive.step_size must be above 0, got {self.step_size:g}")
        check(0 <= self.floor < self.ceiling <= 1, "adaptive needs 0 <= floor < ceiling <= 1")
        check(
            self.every_updates >= 1 and self.after_updates >= 0,
            "adaptive.every_updates must be at least 1, after_updates at least 0",
        )


class StratumRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one stratum gets. A row goes to the matching stratum of the lowest priority number."""

    name: str  # a condition's name or "nominal", unless `where` says otherwise
    where: str | None = None  # SQL predicate over `transitions`
    unit: Unit = "step"  # or all rows of the episodes that it holds in
    min_steps: int = 1  # of an episode in which it must hold
    share: Share = "natural"  # of its source's part of a batch
    floor: float = 0.0
    cap: float = 1.0
    priority: int | None = None  # default: the condition's; `where` strata 50; nominal 1000
    timing: Timing | None = None  # default: the condition's; "post" for a `where` stratum
    correction: Correction | None = None  # default: the mixture's rule for its timing
    within: Within | None = None  # default: the mixture's
    min_rows: int = 1
    min_episodes: int = 1
    max_rows_per_episode: int | None = None  # default: the mixture's
    max_rows_per_recording: int | None = None  # default: the mixture's

    def __post_init__(self) -> None:
        _check_share(self.name, self.share, self.floor, self.cap)
        _check_unit(self.name, self.unit, self.min_steps)


class EachCondition(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A stratum for every condition of the store (and nominal) that `strata` does not name."""

    share: Literal["natural", "equal"] = "natural"
    unit: Unit = "step"  # of the conditions; nominal is what is left
    min_steps: int = 1
    floor: float = 0.0
    cap: float = 1.0
    correction: Correction | None = None
    within: Within | None = None
    min_rows: int = 1
    min_episodes: int = 1
    max_rows_per_episode: int | None = None
    max_rows_per_recording: int | None = None

    def __post_init__(self) -> None:
        _check_share("each_condition", self.share, self.floor, self.cap)
        _check_unit("each_condition", self.unit, self.min_steps)


def _check_share(name: str, share: Share, floor: float, cap: float) -> None:
    if isinstance(share, int | float):
        check(0 <= share <= 1, f"share of {name!r} must be in [0, 1], got {share:g}")
    check(0 <= floor <= cap <= 1, f"{name!r} needs 0 <= floor <= cap <= 1")


def _check_unit(name: str, unit: Unit, min_steps: int) -> None:
    check(min_steps >= 1, f"min_steps of {name!r} must be at least 1, got {min_steps}")
    check(
        unit == "episode" or min_steps == 1,
        f'min_steps of {name!r} is of episodes: it needs unit = "episode"',
    )


class Mixture(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file. See `docs/mixture.md`."""

    doc: str = ""
    seed: int = 0
    # How rows are packed.
    discount: float = 0.97  # gamma of one step
    n_step: int = 1  # steps of a log row's return, cut at episode ends
    cut_at_off_policy: bool = True  # and where the behaviour policy or its version changes
    return_to_go: bool = False  # pack each row's discounted return to the end of its episode
    sampling: Literal["memory", "chunked"] = "memory"  # chunked: for panels larger than memory
    held_out: HeldOut = HeldOut()
    # Which rows may be drawn.
    where: str | None = None  # SQL predicate: only these transitions
    safety: Safety | None = None
    max_age_days: float | None = None  # against the newest transition of the store
    max_versions_behind: int | None = None  # of its behaviour policy's newest; 0: only that one
    max_age_env_steps: int | None = None  # of fresh rows
    max_rows_per_episode: int | None = None  # of one stratum
    max_rows_per_recording: int | None = None
    unlabelled: Literal["refuse", "drop", "nominal"] = "refuse"  # rows without a condition
    unlisted: Literal["refuse", "drop"] = "refuse"  # rows that belong to no stratum
    # In which shares.
    sources: Sources = Sources()
    planned: PlannedUse = PlannedUse()
    strata: tuple[StratumRule, ...] = ()
    each_condition: EachCondition | None = None
    max_replays_per_row: float | None = None  # a run's learner holds it
    shortfall: Shortfall = "redistribute"
    adaptive: Adaptive | None = None
    # And how, within a stratum.
    within: Within = "without_replacement"
    prioritised: Prioritised = Prioritised()
    correction: CorrectionRule = CorrectionRule()

    def __post_init__(self) -> None:
        check(0 <= self.discount <= 1, f"discount must be in [0, 1], got {self.discount:g}")
        check(self.n_step >= 1, f"n_step must be at least 1, got {self.n_step}")
        for name in ("max_age_days", "max_versions_behind", "max_age_env_steps"):
            value = getattr(self, name)
            check(value is None or value >= 0, f"{name} must be at least 0, got {value}")
        for rule in (self, self.each_condition, *self.strata):
            for name in ("max_rows_per_episode", "max_rows_per_recording"):
                value = getattr(rule, name, None)
                check(value is None or value >= 1, f"{name} must be at least 1, got {value}")
        check(
            self.max_replays_per_row is None or self.max_replays_per_row >= 1,
            f"max_replays_per_row must be at least 1, got {self.max_replays_per_row}",
        )
        check(
            bool(self.strata) or self.each_condition is not None,
            "no strata: list some under [[strata]], or give [each_condition]",
        )
        rules: list[Mixture | EachCondition | StratumRule] = [self, *self.strata]
        if self.each_condition is not None:
            rules.append(self.each_condition)
        check(
            self.sampling == "memory"
            or all(rule.within in (None, "without_replacement") for rule in rules),
            'sampling = "chunked" shuffles by itself: within must be "without_replacement"',
        )
        check(
            self.adaptive is None
            or all(isinstance(rule.share, int | float | str) for rule in self.strata),
            "a stratum's share cannot follow both a schedule and [adaptive]",
        )
        names = [rule.name for rule in self.strata]
        check(len(set(names)) == len(names), f"strata named twice: {sorted(names)}")
        check(not any("/" in name for name in names), "a stratum's name cannot hold a /")
        given = sum(rule.share for rule in self.strata if isinstance(rule.share, int | float))
        check(given <= 1 + 1e-6, f"shares of strata sum to {given:g}, above 1")


def shipped_mixtures() -> list[str]:
    """Names of the mixtures that come with Restock."""
    found = (entry.name for entry in (files("restock.replay.mixture") / "mixtures").iterdir())
    return sorted(name.removesuffix(".toml") for name in found if name.endswith(".toml"))


def load_mixture(name_or_path: str | Path) -> Mixture:
    """A shipped mixture by name, or a TOML file.

    Raises:
        ConfigError: no such name or file, no TOML, an unknown key or a value that cannot be.
    """
    name = str(name_or_path)
    path = Path(name)
    if name in shipped_mixtures():
        text = (files("restock.replay.mixture") / "mixtures" / f"{name}.toml").read_text(
            encoding="utf-8"
        )
    elif path.is_file():
        text = path.read_text(encoding="utf-8")
    else:
        raise ConfigError(
            f"no mixture {name!r}",
            remedy=f"give a TOML file, or one of {', '.join(shipped_mixtures())}",
        )
    return parse_mixture(text, where=name)


def parse_mixture(text: str, *, where: str = "mixture") -> Mixture:
    """A mixture from TOML text. Raises ConfigError with the path of what is wrong."""
    try:
        return msgspec.toml.decode(text, type=Mixture)
    except (msgspec.ValidationError, msgspec.DecodeError, ValueError) as error:
        raise ConfigError(
            str(error).replace("Object contains", "it has an"),
            where=where,
            remedy="docs/mixture.md lists every key",
        ) from error
