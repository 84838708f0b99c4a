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

Timing = Literal["pre", "post"]
Share = float | Literal["natural", "equal"]
Correction = Literal["none", "beta", "full", "clipped"]


def _check(ok: bool, message: str) -> None:
    if not ok:
        raise ValueError(message)


class Sources(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Shares of a batch by source; they sum to 1."""

    logs: float = 0.5
    fresh: float = 0.5

    def __post_init__(self) -> None:
        _check(self.logs > 0 and self.fresh >= 0, "sources: logs must be above 0, fresh at least 0")
        _check(
            abs(self.logs + self.fresh - 1) < 1e-6,
            f"sources must sum to 1, got {self.logs + self.fresh:g}",
        )


class PlannedUse(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How much will be drawn: what `max_replays_per_row` is worked out from."""

    updates: int = 20_000
    batch_size: int = 128

    def __post_init__(self) -> None:
        _check(self.updates > 0 and self.batch_size > 0, "planned: both must be above 0")


class HeldOut(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Episodes kept out of the panel, whole: `share` of the rows, chosen by `by`."""

    by: Literal["episode", "recording", "time", "none"] = "episode"
    share: float = 0.1

    def __post_init__(self) -> None:
        _check(0 <= self.share < 1, f"held_out.share must be in [0, 1), got {self.share:g}")


class CorrectionRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Importance weights against the boost of strata, by what their condition may look at."""

    pre: Correction = "none"  # chosen on the state: the fixed point stays where it is
    post: Correction = "full"  # chosen on the outcome: uncorrected, Q is biased
    beta: float = 0.5  # exponent of the weights where the rule is "beta"
    clip: float = 4.0  # largest weight, and smallest inverse, where the rule is "clipped"

    def __post_init__(self) -> None:
        _check(0 <= self.beta <= 1, f"correction.beta must be in [0, 1], got {self.beta:g}")
        _check(self.clip >= 1, f"correction.clip must be at least 1, got {self.clip:g}")


class StratumRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one stratum gets. A row goes to the matching stratum of the lowest priority number."""

    name: str  # a condition's name or "nominal", unless `where` says otherwise
    where: str | None = None  # SQL predicate over `transitions`
    share: Share = "natural"  # of the logs' part of a batch
    floor: float = 0.0
    cap: float = 1.0
    priority: int | None = None  # default: the condition's; `where` strata 50; nominal 1000
    timing: Timing | None = None  # default: the condition's; "post" for a `where` stratum
    correction: Correction | None = None  # default: the mixture's rule for its timing
    min_rows: int = 1
    min_episodes: int = 1

    def __post_init__(self) -> None:
        _check_share(self.name, self.share, self.floor, self.cap)


class EachCondition(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A stratum for every condition of the store (and nominal) that `strata` does not name."""

    share: Share = "natural"
    floor: float = 0.0
    cap: float = 1.0
    correction: Correction | None = None
    min_rows: int = 1
    min_episodes: int = 1

    def __post_init__(self) -> None:
        _check_share("each_condition", self.share, self.floor, self.cap)


def _check_share(name: str, share: Share, floor: float, cap: float) -> None:
    if not isinstance(share, str):
        _check(0 <= share <= 1, f"share of {name!r} must be in [0, 1], got {share:g}")
    _check(0 <= floor <= cap <= 1, f"{name!r} needs 0 <= floor <= cap <= 1")


class Mixture(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file. See `docs/mixture.md`."""

    doc: str = ""
    seed: int = 0
    discount: float = 0.97  # gamma of one step
    n_step: int = 1  # steps of a log row's return, cut at episode ends and handovers
    sources: Sources = Sources()
    planned: PlannedUse = PlannedUse()
    where: str | None = None  # SQL predicate: only these transitions
    max_age_days: float | None = None  # against the newest transition of the store
    strata: tuple[StratumRule, ...] = ()
    each_condition: EachCondition | None = None
    unlisted: Literal["refuse", "drop"] = "refuse"  # rows that belong to no stratum
    max_replays_per_row: float | None = None  # expected, over the planned updates
    shortfall: Literal["refuse", "redistribute", "shrink"] = "redistribute"
    correction: CorrectionRule = CorrectionRule()
    held_out: HeldOut = HeldOut()

    def __post_init__(self) -> None:
        _check(0 <= self.discount <= 1, f"discount must be in [0, 1], got {self.discount:g}")
        _check(self.n_step >= 1, f"n_step must be at least 1, got {self.n_step}")
        _check(
            bool(self.strata) or self.each_condition is not None,
            "no strata: list some under [[strata]], or give [each_condition]",
        )
        names = [rule.name for rule in self.strata]
        _check(len(set(names)) == len(names), f"strata named twice: {sorted(names)}")
        given = sum(rule.share for rule in self.strata if not isinstance(rule.share, str))
        _check(given <= 1 + 1e-6, f"shares of strata sum to {given:g}, above 1")


def shipped_mixtures() -> list[str]:
    """Names of the mixtures that come with Restock."""
    found = (entry.name for entry in (files("restock.replay") / "mixtures").iterdir())
    return sorted(name.removesuffix(".toml") for name in found if name.endswith(".toml"))


def load_mixture(name_or_path: str | Path) -> Mixture:
    """A shipped mixture by name, or a TOML file.

    Raises:
        ConfigError: no such name or file, no TOML, an unknown key or a value that cannot be.
    """
    name = str(name_or_path)
    path = Path(name)
    if name in shipped_mixtures():
        text = (files("restock.replay") / "mixtures" / f"{name}.toml").read_text(encoding="utf-8")
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
