"""Schedules: a share that changes over a run's environment steps.

A share is a number, or one of these; `value_at` reads either. Before the first environment step
(offline) and after a schedule's end its value stays where it began and where it ended.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from typing import Annotated, Literal

from msgspec import Meta

from restock.toml import Checked

Fraction = Annotated[float, Meta(ge=0, le=1)]
EnvSteps = Annotated[int, Meta(ge=0)]


class Linear(Checked, frozen=True, tag_field="schedule", tag="linear"):
    """From `start` to `end` in a straight line."""

    start: Fraction
    end: Fraction
    to_env_steps: EnvSteps  # step at which it ends
    from_env_steps: EnvSteps = 0  # step at which it begins

    def check(self) -> None:
        _check_span(self)

    def at(self, env_steps: float) -> float:
        return self.start + (self.end - self.start) * _part(self, env_steps)


class Cosine(Checked, frozen=True, tag_field="schedule", tag="cosine"):
    """From `start` to `end` along half a cosine: slow at both ends."""

    start: Fraction
    end: Fraction
    to_env_steps: EnvSteps
    from_env_steps: EnvSteps = 0

    def check(self) -> None:
        _check_span(self)

    def at(self, env_steps: float) -> float:
        part = (1.0 - math.cos(math.pi * _part(self, env_steps))) / 2.0
        return self.start + (self.end - self.start) * part


class Piecewise(Checked, frozen=True, tag_field="schedule", tag="piecewise"):
    """Through points `[env_steps, share]`, in order: joined by lines, or held until the next."""

    points: tuple[tuple[EnvSteps, Fraction], ...]
    between: Literal["line", "hold"] = "line"

    def check(self) -> None:
        steps = [step for step, _ in self.points]
        if not steps or any(b <= a for a, b in itertools.pairwise(steps)):
            raise ValueError(
                f"points must be [env_steps, share] with rising env_steps, got {steps}"
            )

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
Portion = Fraction | Schedule


def value_at(portion: Portion, env_steps: float) -> float:
    """Return the share at a step."""
    return portion if isinstance(portion, int | float) else portion.at(env_steps)


def knots(portion: Portion) -> list[int]:
    """Return the steps where a schedule begins, bends or ends; none for a number."""
    if isinstance(portion, int | float):
        return []
    if isinstance(portion, Piecewise):
        return [step for step, _ in portion.points]
    return [portion.from_env_steps, portion.to_env_steps]


def mean_over(portion: Portion, begin: float, end: float) -> float:
    """Return the mean share over [begin, end] environment steps, by a fine rule of midpoints."""
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


def _check_span(ramp: Linear | Cosine) -> None:
    if ramp.from_env_steps >= ramp.to_env_steps:
        raise ValueError(
            f"to_env_steps must be above from_env_steps, which is {ramp.from_env_steps:,}, got"
            f" {ramp.to_env_steps:,}"
        )
