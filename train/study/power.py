"""Is a study large enough for its primary contrast: power, the least effect seen, seeds needed.

The spread is that of the paired differences between seeds: of the study's own finished runs where
there are at least `MIN_PAIRS` of both arms, else from the pilots that the study names.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import msgspec

from restock.stats import MIN_PAIRS, paired_t_power
from restock.toml import Checked

ENOUGH = 0.8
MAX_SEEDS = 1000
SUCCESS = 0.7  # that the noise of episodes is reckoned at


class PowerConfig(Checked, frozen=True):
    """What pilots found."""

    # Between seeds, of the primary measure of one arm.
    sd: Annotated[float, msgspec.Meta(gt=0)]
    # Difference that the study should detect; every measure is a share.
    effect: Annotated[float, msgspec.Meta(gt=0, le=1)]
    # Of the two arms' values at the same seed: pairing helps by it.
    correlation: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.0
    # Of a kind, that the pilots were judged on; None: as many as the study's.
    episodes: Annotated[int, msgspec.Meta(ge=1)] | None = None


@dataclass(frozen=True)
class Power:
    """Of the primary contrast, with the seeds and episodes of the study."""

    arm: str
    baseline: str
    measure: str
    seeds: int
    sd: float  # of one paired difference
    spread_from: str
    effect: float | None  # None: the study names none
    power: float | None  # of that effect
    least_effect: float  # that is seen with a probability of ENOUGH
    seeds_needed: int | None  # for the effect; None: no effect named, or more than MAX_SEEDS

    @property
    def too_small(self) -> bool:
        return self.power is not None and self.power < ENOUGH

    def as_json(self) -> dict[str, Any]:
        least = self.least_effect if math.isfinite(self.least_effect) else None
        return {**asdict(self), "least_effect": least, "too_small": self.too_small}


def spread(config: PowerConfig, *, at_end: bool, kinds: int, episodes: int) -> tuple[float, str]:
    """The standard deviation of a paired difference, guessed from pilots, and where it is from.

    Success at the end is measured on `episodes` of each of `kinds` kinds: where the pilots had
    another number, the noise of episodes is exchanged for the study's. An area under the curve is
    taken as the pilots found it.
    """
    variance = 2 * config.sd**2 * (1 - config.correlation)
    text = f"pilots: {config.sd:g} between seeds of an arm"
    if at_end and config.episodes is not None and config.episodes != episodes:
        noise = 2 * SUCCESS * (1 - SUCCESS) / kinds
        variance = max(variance + noise / episodes - noise / config.episodes, noise / episodes)
        text += f", on {config.episodes} episodes of a kind, here {episodes}"
    return math.sqrt(variance), text


def least_effect(sd: float, seeds: int) -> float:
    """The least true difference that is found with a probability of `ENOUGH`; infinity below
    `MIN_PAIRS` seeds, which find none."""
    from scipy.optimize import brentq

    if seeds < MIN_PAIRS:
        return float("inf")
    most = sd
    while paired_t_power(most, sd, seeds) < ENOUGH:
        most *= 2
    return float(brentq(lambda effect: paired_t_power(effect, sd, seeds) - ENOUGH, 0.0, most))


def seeds_needed(effect: float, sd: float) -> int | None:
    """The fewest seeds that find an effect with a probability of `ENOUGH`."""
    tried = range(MIN_PAIRS, MAX_SEEDS + 1)
    place = bisect_left(tried, ENOUGH, key=lambda seeds: paired_t_power(effect, sd, seeds))
    return tried[place] if place < len(tried) else None


def warning(power: Power) -> str:
    """That a study is too small for its contrast, by name."""
    more = (
        f"{power.seeds_needed} seeds would be enough"
        if power.seeds_needed
        else ("no number of seeds would be enough")
    )
    least = (
        f"the least effect that they find with a probability of {ENOUGH:g} is"
        f" {power.least_effect:.3f}"
        if math.isfinite(power.least_effect)
        else f"below {MIN_PAIRS} seeds there is no interval"
    )
    return (
        f"the study is too small for its contrast: {power.measure} of {power.arm} against"
        f" {power.baseline}, a difference of {power.effect:g} is found with a probability of"
        f" {power.power:.2f} with {power.seeds} seeds; {least}; {more}"
    )


__all__ = [
    "ENOUGH",
    "MIN_PAIRS",
    "Power",
    "PowerConfig",
    "least_effect",
    "seeds_needed",
    "spread",
    "warning",
]
