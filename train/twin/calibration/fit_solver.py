"""The search for parameters: coarse in one batch, then `mujoco.minimize.least_squares`.

Residuals are counted in units of their channel's noise and beyond some of them by their size, not
its square (soft L1), so that a wheel over a cable does not move the fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from mujoco import minimize
from numpy.typing import NDArray
from scipy.stats import qmc

from restock.train.twin.calibration.fit_parameters import Coordinates
from restock.train.twin.calibration.mismatch import Mismatch

F64 = NDArray[np.float64]

ENOUGH = 0.02  # of the cost: what a parameter costs a fifth of its standard deviation away
FREE = 0.01  # of the regulariser, where the Hessian's diagonal is about 1
SOFT = 2.0  # noises from which on a residual counts by its size
# Least noise of each channel: an exact simulator's residuals are those of the timestep.
LEAST = {
    "wheel speed": 0.001,
    "wheel yaw rate": 0.003,
    "gyro": 0.003,
    "position": 0.002,
    "heading": 0.001,
}


class SoftL1(minimize.Norm):  # type: ignore[misc]  # mujoco has no types
    """SOFT^2 (sqrt(1 + (r / SOFT)^2) - 1): r^2 / 2 for small residuals, SOFT |r| for large."""

    def value(self, r: F64) -> np.float64:
        """Of residuals (R, 1)."""
        return np.float64(cost(r[:, 0]))

    def grad_hess(self, r: F64, proj: F64) -> tuple[F64, F64]:
        """Gradient (n, 1) and Gauss-Newton Hessian (n, n) under a projection (R, n)."""
        weight = weights(r)
        return proj.T @ (weight * r), proj.T @ (weight * proj)


def cost(r: F64) -> F64:
    """Soft L1 of residuals (R, ...), summed over the first axis."""
    found: F64 = SOFT**2 * (np.sqrt(1 + (r / SOFT) ** 2) - 1).sum(axis=0)
    return found


def weights(r: F64) -> F64:
    """Of each residual: the derivative of the norm is weight times residual."""
    found: F64 = 1 / np.sqrt(1 + (r / SOFT) ** 2)
    return found


@dataclass(frozen=True)
class Solution:
    """Where the search ended, with what uncertainty and warnings are made of."""

    coordinates: Coordinates
    z: F64  # (n,)
    residual: F64  # (R,) in units of noise
    jacobian: F64  # (R, n)
    segment: NDArray[np.int64]  # (R,) of the residual
    scale: dict[str, float]  # noise of each channel, its correlation along the segment included
    converged: bool


class Problem:
    """Residuals and their derivatives as functions of a point, for the solver."""

    def __init__(
        self, mismatch: Mismatch, coordinates: Coordinates, scale: Mapping[str, float]
    ) -> None:
        self.mismatch, self.coordinates, self.scale = mismatch, coordinates, dict(scale)

    def residual(self, z: F64) -> F64:
        """Residuals (R, k) in units of noise, at points (n, k)."""
        found = self.mismatch.of([self.coordinates.perturbation(point) for point in z.T])
        parts = [found[name] / self.scale[name] for name in self.mismatch.channels]
        return np.concatenate([part.reshape(z.shape[1], -1) for part in parts], axis=1).T

    @property
    def segment(self) -> NDArray[np.int64]:
        """The segment (R,) of each residual."""
        steps, num = self.mismatch.segments.horizon_steps + 1, len(self.mismatch.segments)
        widths = [2 * steps if name == "position" else steps for name in self.mismatch.channels]
        return np.concatenate([np.repeat(np.arange(num), width) for width in widths])

    def jacobian(self, z: F64, residual: F64) -> F64:
        """Difference quotients (R, n) at z (n, 1), at the nearest latency that can be driven.

        A wheel that breaks loose does so at a physics step, so wheel speeds jump as friction or
        payload change. A jump is no slope: of these two, quotients are taken to both sides, and the
        smaller one counts, or none where they disagree in sign.
        """
        del residual  # it is between two latencies; this is at one
        size, steps = len(self.coordinates), self.coordinates.steps
        at = self.coordinates.drivable(z.reshape(-1), self.mismatch.timestep_s)
        # Of the latency, to the side on which z lies: residuals are interpolated there.
        forward = (at + steps <= 1.0) & (z.reshape(-1) >= at - 1e-9)
        forward |= at - steps < 0.0
        step = np.where(forward, steps, -steps)
        both = [
            index
            for index, item in enumerate(self.coordinates.parameters)
            if item.own_body and steps[index] <= at[index] <= 1.0 - steps[index]
        ]
        moves = [np.zeros((size, 1)), np.diag(step), -np.diag(step)[:, both]]
        found = self.residual(at[:, None] + np.hstack(moves))
        slope: F64 = (found[:, 1 : size + 1] - found[:, :1]) / step
        back = (found[:, :1] - found[:, size + 1 :]) / step[both]
        ahead = slope[:, both]
        smaller = np.where(np.abs(ahead) < np.abs(back), ahead, back)
        slope[:, both] = np.where(ahead * back > 0, smaller, 0.0)
        return slope


def search(problem: Problem, points: int, best: int, seed: int) -> F64:
    """The best (best, n) of the base and `points` points of a Sobol sequence."""
    sampler = qmc.Sobol(len(problem.coordinates), scramble=True, rng=seed)
    found = sampler.random(points) if points else np.zeros((0, len(problem.coordinates)))
    start = problem.coordinates.point(problem.coordinates.base)
    timestep_s = problem.mismatch.timestep_s
    trial = np.array([problem.coordinates.drivable(z, timestep_s) for z in (start, *found)])
    value = np.concatenate([cost(problem.residual(part.T)) for part in _batches(trial, 16)])
    return trial[np.argsort(value, kind="stable")[:best]]


def solve(problem: Problem, start: F64, iterations: int) -> tuple[F64, float, bool]:
    """The least-squares solution (n,) from a start (n,), its cost, and whether it converged."""
    size = len(problem.coordinates)
    steps: list[minimize.IterLog] = []

    def watch(trace: list[minimize.IterLog]) -> None:
        steps[:] = trace
        free = trace[-1].regularizer <= FREE  # a held back step gains little anywhere
        if free and 0 < trace[-1].reduction < ENOUGH and len(trace) > 1:
            raise _GoodEnough

    try:
        found, steps[:] = minimize.least_squares(
            start,
            problem.residual,
            bounds=[np.zeros(size), np.ones(size)],
            jacobian=problem.jacobian,
            norm=SoftL1(),
            x_scale="jac",
            xtol=1e-3,
            gtol=1e-3,
            mu_factor=4.0,
            mu_max=1e3,
            max_iter=iterations,
            verbose=minimize.Verbosity.SILENT,
            iter_callback=watch,
        )
    except _GoodEnough:
        found = steps[-1].candidate.reshape(start.shape)
        return found, float(steps[-1].objective), True
    return found, float(steps[-1].objective), len(steps) <= iterations


class _GoodEnough(Exception):
    """A step gained less than what a log can tell: the one way out of the solver."""


def noise(found: Mapping[str, F64], position_parts: int = 2) -> dict[str, float]:
    """Each channel's noise from residuals (1, S, R) at a solution.

    The median deviation, times what the correlation of neighbouring steps takes away: n residuals
    with correlation c say as much as n (1 - c) / (1 + c) without.
    """
    scale = {}
    for name, residual in found.items():
        rows = residual[0]
        runs = (
            np.concatenate(np.split(rows, position_parts, axis=1)) if name == "position" else rows
        )
        spread = max(1.4826 * float(np.median(np.abs(runs))), LEAST[name])
        clipped = np.clip(runs, -4 * spread, 4 * spread)
        square = float((clipped**2).mean())
        together = float((clipped[:, 1:] * clipped[:, :-1]).mean()) / max(square, 1e-18)
        together = min(max(together, 0.0), 0.95)
        scale[name] = spread * float(np.sqrt((1 + together) / (1 - together)))
    return scale


def _batches(points: F64, size: int) -> list[F64]:
    return [points[begin : begin + size] for begin in range(0, len(points), size)]
