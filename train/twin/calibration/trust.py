"""Where the twin should not be trusted: one verdict a condition, by stated limits.

`untrusted` is said where the twin is shown to be off, `trusted` where it is shown to be near, both
by the end of a 95 % interval; `undecided` where the interval holds the limit, and `unknown` where
too little was driven to say.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from restock.stats import ConfidenceInterval

TRUSTED, UNTRUSTED = "trusted", "untrusted"
UNDECIDED, UNKNOWN = "undecided", "unknown"


@dataclass(frozen=True)
class Limits:
    """What a twin must keep to be trusted in a condition."""

    horizon_s: float = 3.0
    position_m: float = 0.2  # nine in ten segments of that horizon end this near
    reward_ratio: float = 1.0  # one-step reward gap over the reward's own spread, see `gap_rows`
    segments: int = 20  # fewer say nothing
    episodes: int = 5


@dataclass(frozen=True)
class Verdict:
    """What is said of one condition, and why."""

    condition: str
    verdict: str
    reasons: tuple[str, ...]
    segments: int
    episodes: int
    position_p90: ConfidenceInterval  # m, at the limits' horizon
    reward_ratio: ConfidenceInterval


def judge(
    condition: str,
    *,
    limits: Limits,
    segments: int,
    episodes: int,
    position_p90: ConfidenceInterval,
    reward_ratio: ConfidenceInterval,
) -> Verdict:
    """The verdict on one condition."""
    off, open_ = [], []
    if segments < limits.segments or episodes < limits.episodes:
        few = (
            f"too few: segments of {limits.horizon_s:g} s {segments} (at least {limits.segments}),"
            f" from episodes {episodes} (at least {limits.episodes})"
        )
        return Verdict(condition, UNKNOWN, (few,), segments, episodes, position_p90, reward_ratio)
    checks = [
        (
            position_p90,
            limits.position_m,
            f"one segment in ten ends {position_p90.value:.2f} m"
            f" [{position_p90.low:.2f}, {position_p90.high:.2f}] or more from the log after"
            f" {limits.horizon_s:g} s; the limit is {limits.position_m:g} m",
        )
    ]
    if not math.isnan(reward_ratio.value):
        checks.append(
            (
                reward_ratio,
                limits.reward_ratio,
                f"its one-step reward is off by {reward_ratio.value:.2f}"
                f" [{reward_ratio.low:.2f}, {reward_ratio.high:.2f}] times the reward's own spread;"
                f" the limit is {limits.reward_ratio:g}",
            )
        )
    for estimate, limit, said in checks:
        if estimate.low > limit:
            off.append(said)
        elif not estimate.high <= limit:
            open_.append(said)
    verdict = UNTRUSTED if off else UNDECIDED if open_ else TRUSTED
    reasons = tuple(off or open_)
    return Verdict(condition, verdict, reasons, segments, episodes, position_p90, reward_ratio)
