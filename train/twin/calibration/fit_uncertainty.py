"""How well a log knows each parameter: intervals, what is confounded with what, profiles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from restock.stats import cluster_counts
from restock.train.twin.calibration.fit_solver import Problem, Solution, cost, weights

F64 = NDArray[np.float64]

RESAMPLES = 1000
FEW_CLUSTERS = 8
PROFILE_POINTS = 12
CHI_SQUARE_95 = 3.84  # of one degree of freedom


@dataclass(frozen=True)
class Uncertainty:
    """Of n parameters, in the coordinates of the unit cube."""

    half: F64  # (n,) of the 95 % intervals; inf where the log says nothing
    correlation: F64  # (n, n) of the estimates
    condition: float  # of the information, each parameter in units of `Parameter.known`
    clusters: int  # episodes, or segments where there are few episodes


def uncertainty(solution: Solution, episode: NDArray[np.str_], seed: int) -> Uncertainty:
    """Intervals from a bootstrap over episodes (S,), linearised at the solution.

    Steps of a segment and segments of an episode err together (localisation drifts), so whole
    episodes are drawn; with fewer than 8 of them, segments. Each draw moves the parameters by one
    Gauss-Newton step of its own residuals; half widths are Student's t times the spread of that.
    """
    names = np.unique(episode)
    by_segment = len(names) < FEW_CLUSTERS
    key = np.arange(len(episode)) if by_segment else np.searchsorted(names, episode)
    cluster = key[solution.segment]
    count = int(key.max()) + 1
    weight = weights(solution.residual)
    jacobian = solution.jacobian
    size = jacobian.shape[1]
    gradient, hessian = np.zeros((count, size)), np.zeros((count, size, size))
    for index in range(count):
        rows = cluster == index
        own = jacobian[rows]
        gradient[index] = own.T @ (weight[rows] * solution.residual[rows])
        hessian[index] = own.T @ (weight[rows, None] * own)
    known = solution.coordinates.known
    whole = hessian.sum(axis=0)
    inside = (solution.z > 1e-9) & (solution.z < 1 - 1e-9)  # at an end the gradient may stay
    gradient = np.where(inside, gradient - gradient.mean(axis=0), gradient)
    in_units = whole * np.outer(known, known)
    eigenvalues = np.linalg.eigvalsh(in_units)
    condition = float(eigenvalues[-1] / max(eigenvalues[0], 1e-300))

    # A parameter without any information would make every other infinite: a hair's breadth of it.
    ridge = np.diag(1e-6 / known**2)
    rng = np.random.Generator(np.random.PCG64(seed))
    drawn = cluster_counts(count, RESAMPLES, rng)
    h = np.einsum("bc,cij->bij", drawn, hessian) + ridge
    g = drawn @ gradient
    moved = -np.linalg.solve(h, g[..., None])[..., 0]
    spread = 1.4826 * np.median(np.abs(moved - np.median(moved, axis=0)), axis=0)
    inverse = np.linalg.inv(whole + ridge)
    deviation = np.sqrt(np.diag(inverse))
    # A bootstrap of residuals that do not move with a parameter has no spread either.
    half = student.ppf(0.975, max(count - 1, 1)) * np.maximum(spread, deviation)
    return Uncertainty(
        half=half,
        correlation=inverse / np.outer(deviation, deviation),
        condition=condition,
        clusters=count,
    )


def profile(problem: Problem, solution: Solution, index: int) -> tuple[float, float]:
    """Between which z a parameter explains the log as well, within 95 %: (low, high).

    The parameter is put to values over its whole range; at each the others make one Gauss-Newton
    step, and twice the rise of the cost is compared with chi-square.
    """
    grid = np.sort(np.append(np.linspace(0.0, 1.0, PROFILE_POINTS), solution.z[index]))
    points = np.tile(solution.z[:, None], (1, len(grid)))
    points[index] = grid
    residual = problem.residual(points)  # (R, P)
    weight = weights(residual)
    others = np.delete(solution.jacobian, index, axis=1)  # (R, n - 1)
    value = cost(residual)
    for at in range(len(grid)):
        own = weight[:, at, None] * others
        hessian = others.T @ own + 1e-9 * np.eye(others.shape[1])
        gradient = own.T @ residual[:, at]
        value[at] -= 0.5 * gradient @ np.linalg.solve(hessian, gradient)
    rise = 2 * (value - value.min())
    fits = rise <= CHI_SQUARE_95
    low, high = int(np.argmax(fits)), len(grid) - 1 - int(np.argmax(fits[::-1]))
    return _crossing(grid, rise, low, -1), _crossing(grid, rise, high, 1)


def _crossing(grid: F64, rise: F64, inner: int, way: int) -> float:
    """Where the rise passes chi-square between a point that fits and the next that does not."""
    outer = inner + way
    if not 0 <= outer < len(grid):
        return float(grid[inner])
    share = (CHI_SQUARE_95 - rise[inner]) / max(rise[outer] - rise[inner], 1e-12)
    return float(grid[inner] + share * (grid[outer] - grid[inner]))
