"""Schedules: a share that changes over a run's environment steps.

A share is a number, or one of these; `value_at` reads either. Before the first environment step
(offline) and after a schedule's end its value stays where it began and where it ended.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from typing import Literal

import msgspec


class Linear(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="schedule", tag="linear"
):
    """From `start` to `end` in a straight line."""

    start: float
    end: float
    to_env_steps: int  # where it ends
    from_env_steps: int = 0  # where it begins

    def __post_init__(self) -> None:
        _check_ramp(self.start, self.end, self.from_env_steps, self.to_env_steps)

    def at(self, env_steps: float) -> float:
        return self.start + (self.end - self.start) * _part(self, env_steps)


class Cosine(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="schedule", tag="cosine"
):
    """From `start` to `end` along half a cosine: slow at both ends."""

    start: float
    end: float
    to_env_steps: int
    from_env_steps: int = 0

    def __post_init__(self) -> None:
        _check_ramp(self.start, self.end, self.from_env_steps, self.to_env_steps)

    def at(self, env_steps: float) -> float:
        part = (1.0 - math.cos(math.pi * _part(self, env_steps))) / 2.0
        return self.start + (self.end - self.start) * part


class Piecewise(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="schedule", tag="piecewise"
):
    """Through points `[env_steps, share]`, in order: joined by lines, or held until the next."""

    points: tuple[tuple[int, float], ...]
    between: Literal["line", "hold"] = "line"

    def __post_init__(self) -> None:
        steps = [step for step, _ in self.points]
        if not steps or steps[0] < 0 or any(b <= a for a, b in itertools.pairwise(steps)):
            raise ValueError(
                f"a piecewise schedule needs points [env_steps, share] in rising order, got {steps}"
            )
        for _, share in self.points:
            _check_share(share)

    def at(self, env_steps: float) -> float:
        after = bisect_right([step for step, _ in self.points], env_steps)
        if after == 0:
            return self.points[0][1]
        step, share = self.points[after - 1]
        if after == len(self.points) or self.between == "hold":
            return share
        next_step, next_share = self.points[after]
        return share + (next_share - share) * (env_steps - step) / (next_step - step)


Schedule = Linear | Cosine | Piecewise
Portion = float | Schedule


def value_at(portion: Portion, env_steps: float) -> float:
    """The share at a step."""
    return portion if isinstance(portion, int | float) else portion.at(env_steps)


def knots(portion: Portion) -> list[int]:
    """The steps where a schedule begins, bends or ends; none for a number."""
    if isinstance(portion, int | float):
        return []
    if isinstance(portion, Piecewise):
        return [step for step, _ in portion.points]
    return [portion.from_env_steps, portion.to_env_steps]


def mean_over(portion: Portion, begin: float, end: float) -> float:
    """The mean share over [begin, end] environment steps, by a fine rule of midpoints."""
    if isinstance(portion, int | float) or end <= begin:
        return value_at(portion, begin)
    edges = sorted({begin, end, *(k for k in knots(portion) if begin < k < end)})
    total = 0.0
    for low, high in itertools.pairwise(edges):
        width = (high - low) / 64
        total += sum(value_at(portion, low + (i + 0.5) * width) for i in range(64)) * width
    return total / (end - begin)


def _part(ramp: Linear | Cosine, env_steps: float) -> float:
    length = ramp.to_env_steps - ramp.from_env_steps
    return min(max((env_steps - ramp.from_env_steps) / length, 0.0), 1.0)


def _check_ramp(start: float, end: float, begin: int, finish: int) -> None:
    _check_share(start)
    _check_share(end)
    if not 0 <= begin < finish:
        raise ValueError(
            f"a schedule needs 0 <= from_env_steps < to_env_steps, got {begin} and {finish}"
        )


def _check_share(share: float) -> None:
    if not 0 <= share <= 1:
        raise ValueError(f"a scheduled share must be in [0, 1], got {share:g}")
