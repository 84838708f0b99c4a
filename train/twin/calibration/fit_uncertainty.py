"""How well a log identifies each parameter: intervals, what is confounded with what, profiles.

From these, what is reported of each: its value with its interval, or why it stays as in the base.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64
from restock.stats import cluster_counts
from restock.train.twin.calibration.fit_parameters import PARAMETERS
from restock.train.twin.calibration.fit_solver import (
    FitProblem,
    FitSolution,
    ReplayResiduals,
    cost,
    weights,
)
from restock.train.twin.calibration.fitted_twin import ParameterEstimate
from restock.train.twin.calibration.open_loop import replay_segments
from restock.train.twin.physics.perturbation import Perturbation

RESAMPLES = 1000
FEW_CLUSTERS = 8
PROFILE_POINTS = 12
CHI_SQUARE_95 = 3.84  # of one degree of freedom
SLIDES_MPS = 0.05  # a wheel faster than this over the floor slides
CONFOUNDED = 0.95  # correlation of two estimates
ILL_CONDITIONED = 1e6  # condition number of the information


@dataclass(frozen=True)
class Uncertainty:
    """Of n parameters, in the coordinates of the unit cube."""

    half: F64  # (n,) of the 95 % intervals; inf where the log says nothing
    correlation: F64  # (n, n) of the estimates
    condition_number: float  # of the information, parameters in units of `Parameter.useful`
    clusters: int  # episodes, or segments where there are few episodes


def measure_uncertainty(solution: FitSolution, episode: NDArray[np.str_], seed: int) -> Uncertainty:
    """Intervals from a bootstrap over episodes (S,), linearised at the solution.

    Steps of a segment and segments of an episode err together (localisation drifts), so whole
    episodes are drawn; with fewer than 8 of them, segments. Each draw moves the parameters by one
    Gauss-Newton step of its own residuals; half widths are Student's t times the spread of that.
    """
    from scipy.stats import t as student  # here: it is slow to import

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
        part = jacobian[rows]
        gradient[index] = part.T @ (weight[rows] * solution.residual[rows])
        hessian[index] = part.T @ (weight[rows, None] * part)
    useful = solution.coordinates.useful
    whole = hessian.sum(axis=0)
    inside = (solution.z > 1e-9) & (solution.z < 1 - 1e-9)  # at an end the gradient may stay
    gradient = np.where(inside, gradient - gradient.mean(axis=0), gradient)
    in_units = whole * np.outer(useful, useful)
    eigenvalues = np.linalg.eigvalsh(in_units)
    condition_number = float(eigenvalues[-1] / max(eigenvalues[0], 1e-300))

    # A parameter without any information would make every other infinite: a hair's breadth of it.
    ridge = np.diag(1e-6 / useful**2)
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
        condition_number=condition_number,
        clusters=count,
    )


def cost_profile(problem: FitProblem, solution: FitSolution, index: int) -> tuple[float, float]:
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
        weighted = weight[:, at, None] * others
        hessian = others.T @ weighted + 1e-9 * np.eye(others.shape[1])
        gradient = weighted.T @ residual[:, at]
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


def unidentified(
    residuals: ReplayResiduals, solution: FitSolution, uncertainty: Uncertainty
) -> ParameterEstimate | None:
    """The parameter that is known least of those that stay as in the base, if there is one.

    One stays that is known too little, and whose value in the base explains the log as well.
    """
    width = uncertainty.half / solution.coordinates.useful
    for index in np.argsort(-width):
        if width[index] > 1:
            kept = _kept_as_in_base(residuals, solution, uncertainty, int(index))
            if kept is not None:
                return kept
    return None


def _kept_as_in_base(
    residuals: ReplayResiduals, solution: FitSolution, uncertainty: Uncertainty, index: int
) -> ParameterEstimate | None:
    """A parameter that is known little, with the reason why it stays; None where it does not."""
    coordinates = solution.coordinates
    parameter = coordinates.parameters[index]
    problem = FitProblem(residuals, coordinates, solution.scale)
    low, high = cost_profile(problem, solution, index)
    ends = [_value(solution, index, end) for end in (low, high)]
    start = coordinates.point(coordinates.base)[index]
    base_fits = low - 1e-9 <= start <= high + 1e-9 or high - low > 0.9
    # At an end of its range, and the residuals there do not move with it: where it got to is the
    # search's doing, whatever the jumps of the cost on the way to the base say.
    lost = uncertainty.half[index] > 1 and not 1e-9 < solution.z[index] < 1 - 1e-9
    if not base_fits and not lost:
        return None
    unit = f" {parameter.unit}" if parameter.unit else ""
    reason = f"{ends[0]:.3g} to {ends[1]:.3g}{unit} explain the log as well"
    if not base_fits:
        reason = "at the end of its range, where it has no effect on the log"
    if parameter.name in ("friction_scale", "left_friction_scale"):
        fitted = coordinates.perturbation(solution.z)
        sliding = replay_segments(
            residuals.segments, [fitted], timestep_s=residuals.timestep_s, nthread=residuals.nthread
        ).sliding_mps
        share = float((sliding > SLIDES_MPS).mean())
        reason += f" (wheels slide in {share:.1%} of the steps)"
    else:
        other = _confounded_with(uncertainty.correlation, index)
        if other is not None:
            correlation = uncertainty.correlation[index, other]
            reason += f" (its correlation with {coordinates.names[other]} is {correlation:.2f})"
    return as_in_base(parameter.name, coordinates.base, reason, *ends)


def _confounded_with(correlation: F64, index: int) -> int | None:
    """Which other parameter this one is confounded with most, if with any."""
    others = np.abs(correlation[index]).copy()
    others[index] = 0.0
    at = int(np.argmax(others)) if len(others) > 1 else index
    return at if others[at] > 0.8 else None


def as_in_base(
    name: str, base: Perturbation, reason: str, low: float | None = None, high: float | None = None
) -> ParameterEstimate:
    """A parameter that is not fitted."""
    value, unit = float(getattr(base, name)), PARAMETERS[name].unit
    return ParameterEstimate(name, unit, value, low, high, False, reason)


def estimates(solution: FitSolution, uncertainty: Uncertainty) -> list[ParameterEstimate]:
    """Of every parameter that was fitted."""
    made = []
    for index, parameter in enumerate(solution.coordinates.parameters):
        z, half = solution.z[index], uncertainty.half[index]
        low, middle, high = (_value(solution, index, end) for end in (z - half, z, z + half))
        made.append(ParameterEstimate(parameter.name, parameter.unit, middle, low, high, True))
    return made


def _value(solution: FitSolution, index: int, z: float) -> float:
    point = solution.z.copy()
    point[index] = min(max(z, 0.0), 1.0)
    return float(solution.coordinates.values(point)[index])


def fit_warnings(solution: FitSolution, uncertainty: Uncertainty) -> list[str]:
    lines = []
    coordinates, z = solution.coordinates, solution.z
    for index, name in enumerate(coordinates.names):
        if z[index] < 1e-6 or z[index] > 1 - 1e-6:
            lines.append(
                f"{name} is at the end of its range, {_value(solution, index, z[index]):g}"
            )
        if uncertainty.half[index] > coordinates.useful[index]:
            lines.append(f"{name} is poorly identified: see its interval")
        for other in range(index):
            correlation = uncertainty.correlation[index, other]
            if abs(correlation) > CONFOUNDED:
                lines.append(
                    f"{coordinates.names[other]} and {name} are confounded: their correlation is"
                    f" {correlation:.2f}"
                )
    if not solution.converged:
        lines.append("least squares had not converged: the intervals are too narrow")
    if uncertainty.condition_number > ILL_CONDITIONED:
        lines.append(
            "ill-conditioned: the information's condition number is"
            f" {uncertainty.condition_number:.1e}"
        )
    return lines
