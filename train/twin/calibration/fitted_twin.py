"""The result of a fit: parameters, how well a log identifies them, and TOML for training.

Intervals come from a bootstrap over episodes and from profiles of the cost. Each parameter is
reported with its interval, or with the reason why it keeps the base's value. One fit makes a
perturbation. Several fits, to recordings of different robots, make a schedule.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64
from restock.errors import ConfigError, StoreError
from restock.files import write_text
from restock.stats import cluster_counts
from restock.toml import toml_value
from restock.train.twin.calibration.fit_solver import (
    BASE,
    PARAMETERS,
    FitProblem,
    FitSolution,
    ReplayResiduals,
    cost,
    weights,
)
from restock.train.twin.calibration.open_loop import replay_segments
from restock.train.twin.physics.perturbation import Perturbation, Schedule


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter: its value, its 95 % interval, and whether the log identified it."""

    name: str
    unit: str
    value: float
    low: float | None
    high: float | None
    fitted: bool  # False: it has the base's value, for the reason in `note`
    note: str = ""


@dataclass(frozen=True)
class HeldOutGap:
    """The distance in metres between replayed and logged end positions of held-out segments."""

    horizon_s: float
    segments: int
    before_m: float  # median over the segments, with the base
    after_m: float  # median over the segments, with the fitted perturbation
    low_m: float  # 95 % interval of `after_m`, from a bootstrap over segments
    high_m: float


@dataclass(frozen=True)
class FittedTwin:
    """The parameters of a log's robot, as far as the log identifies them."""

    perturbation: Perturbation
    recordings: tuple[str, ...]
    estimates: tuple[ParameterEstimate, ...]
    warnings: tuple[str, ...]
    held_out: tuple[HeldOutGap, ...]
    noise: dict[str, dict[str, Any]]  # channel -> unit, median deviations before and after fit
    segments: int  # number of fitted segments
    clusters: int  # number of episodes, or segments, that the bootstrap draws from
    left_out: dict[str, int] = field(default_factory=dict)  # reason -> how many left out

    def describe(self) -> dict[str, Any]:
        """Return the fit as plain values for JSON."""
        return {
            **vars(self),
            "perturbation": msgspec.to_builtins(self.perturbation),
            "estimates": [vars(item) for item in self.estimates],
            "held_out": [vars(item) for item in self.held_out],
        }

    def toml(self) -> str:
        """Return the perturbation as TOML for training, with each value's uncertainty."""
        estimates = {item.name: item for item in self.estimates}
        lines = [
            f"# Effective parameters, fitted to {', '.join(self.recordings)}",
            f"# at a timestep of {BASE.timestep_s:g} s: {self.segments} segments.",
        ]
        lines += [f"# {warning}" for warning in self.warnings]
        for name, value in msgspec.to_builtins(self.perturbation).items():
            note = ""
            if name in estimates and estimates[name].fitted:
                note = f"  # 95 %: {estimates[name].low:.4g} to {estimates[name].high:.4g}"
            elif name in estimates:
                note = "  # not fitted"
            lines.append(f"{name} = {toml_value(value)}{note}")
        return "\n".join(lines) + "\n"


def fleet_schedule(fits: Sequence[FittedTwin]) -> Schedule:
    """Return a schedule that draws each parameter between its smallest and largest fitted value.

    A parameter that some recording does not identify keeps the base's value.
    """
    fitted = [{item.name for item in fit.estimates if item.fitted} for fit in fits]
    shared = [
        item.name for item in fits[0].estimates if all(item.name in names for names in fitted)
    ]
    values = {name: [getattr(fit.perturbation, name) for fit in fits] for name in shared}
    middle = {name: float(np.mean(each)) for name, each in values.items()}
    return Schedule(
        ranges={name: (min(each), max(each)) for name, each in values.items()},
        base=msgspec.structs.replace(BASE, name="fleet", **middle),
        name="fleet",
    )


def write_fit(path: Path | str, fits: Sequence[FittedTwin]) -> None:
    """Write the perturbation of one fit, or the schedule of several, atomically.

    Raises:
        ConfigError: `path` already exists.
        StoreError: `path` cannot be written.
    """
    text = fits[0].toml() if len(fits) == 1 else _schedule_toml(fits)
    try:
        write_text(Path(path), text, exclusive=True)
    except FileExistsError as error:
        raise ConfigError(
            "already exists", where=str(path), remedy="choose another --out"
        ) from error
    except OSError as error:
        raise StoreError(
            f"cannot be written: {error.strerror}", where=str(path), remedy="check the folder"
        ) from error


def _schedule_toml(fits: Sequence[FittedTwin]) -> str:
    made = fleet_schedule(fits)
    lines = [
        f"# Fitted to {len(fits)} recordings, each separately, at {BASE.timestep_s:g} s.",
        f"name = {toml_value(made.name)}",
        "",
        "[ranges]",
        *(f"{name} = {toml_value(ends)}" for name, ends in made.ranges.items()),
        "",
        "[base]",
    ]
    for name, value in msgspec.to_builtins(made.base).items():
        if value != getattr(BASE, name):
            lines.append(f"{name} = {toml_value(value)}")
    return "\n".join(lines) + "\n"


RESAMPLES = 1000
FEW_CLUSTERS = 8
PROFILE_POINTS = 12
CHI_SQUARE_95 = 3.84  # 95 % point of chi-square with one degree of freedom
SLIDES_MPS = 0.05  # a wheel slides if it is faster than this over the floor
CONFOUNDED = 0.95  # warn if two estimates have at least this correlation


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of n parameters, in coordinates of the unit cube."""

    half: F64  # (n,) half widths of the 95 % intervals
    correlation: F64  # (n, n) correlations between the estimates
    clusters: int  # number of episodes, or of segments if there are few episodes


def measure_uncertainty(solution: FitSolution, episode: NDArray[np.str_], seed: int) -> Uncertainty:
    """Compute intervals by a bootstrap over episodes, linearised at the solution.

    `episode` (S,) is the episode of each segment. Errors within an episode are correlated, as
    localisation drifts, so whole episodes are drawn; with fewer than 8 episodes, segments are. Each
    draw moves the parameters by the Gauss-Newton step of its residuals. Half widths are Student's t
    times the spread of these steps.
    """
    from scipy.stats import t as student  # imported here because it is slow to import

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
    inside = (solution.z > 1e-9) & (solution.z < 1 - 1e-9)  # at the ends, gradients may not be 0
    gradient = np.where(inside, gradient - gradient.mean(axis=0), gradient)

    # A tiny ridge: else a parameter without information would make all intervals infinite.
    ridge = np.diag(1e-6 / useful**2)
    rng = np.random.Generator(np.random.PCG64(seed))
    drawn = cluster_counts(count, RESAMPLES, rng)
    h = np.einsum("bc,cij->bij", drawn, hessian) + ridge
    g = drawn @ gradient
    moved = -np.linalg.solve(h, g[..., None])[..., 0]
    spread = 1.4826 * np.median(np.abs(moved - np.median(moved, axis=0)), axis=0)
    inverse = np.linalg.inv(whole + ridge)
    deviation = np.sqrt(np.diag(inverse))
    # Use `deviation` if it is larger: without an effect on residuals, the bootstrap's spread is 0.
    half = student.ppf(0.975, max(count - 1, 1)) * np.maximum(spread, deviation)
    return Uncertainty(
        half=half,
        correlation=inverse / np.outer(deviation, deviation),
        clusters=count,
    )


def cost_profile(problem: FitProblem, solution: FitSolution, index: int) -> tuple[float, float]:
    """Return the range of z (low, high) in which a parameter explains the log within 95 %.

    The parameter is set to values over its whole range. At each value the other parameters make one
    Gauss-Newton step, and twice the increase of the cost is compared with chi-square.
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
    """Interpolate the z, outside the last point that fits, at which `rise` reaches chi-square."""
    outer = inner + way
    if not 0 <= outer < len(grid):
        return float(grid[inner])
    share = (CHI_SQUARE_95 - rise[inner]) / max(rise[outer] - rise[inner], 1e-12)
    return float(grid[inner] + share * (grid[outer] - grid[inner]))


def unidentified(
    residuals: ReplayResiduals, solution: FitSolution, uncertainty: Uncertainty
) -> ParameterEstimate | None:
    """Return the least identified of the parameters to keep at their base values, or None.

    A poorly identified parameter is kept at base if the base value fits the log as well, or if the
    parameter has no effect at the end of its range.
    """
    width = uncertainty.half / solution.coordinates.useful
    for index in np.argsort(-width):
        if width[index] > 1:
            kept = _keep_at_base(residuals, solution, uncertainty, int(index))
            if kept is not None:
                return kept
    return None


def _keep_at_base(
    residuals: ReplayResiduals, solution: FitSolution, uncertainty: Uncertainty, index: int
) -> ParameterEstimate | None:
    """Return a poorly identified parameter at base, with the reason; None if it is to be fitted."""
    coordinates = solution.coordinates
    parameter = coordinates.parameters[index]
    problem = FitProblem(residuals, coordinates, solution.scale)
    low, high = cost_profile(problem, solution, index)
    ends = [_value(solution, index, end) for end in (low, high)]
    start = coordinates.point(BASE)[index]
    base_fits = low - 1e-9 <= start <= high + 1e-9 or high - low > 0.9
    # If the search ended at an end of the range, where residuals do not depend on the parameter,
    # the value is arbitrary, even if the cost jumps between that end and the base value.
    lost = uncertainty.half[index] > 1 and not 1e-9 < solution.z[index] < 1 - 1e-9
    if not base_fits and not lost:
        return None
    unit = f" {parameter.unit}" if parameter.unit else ""
    reason = f"{ends[0]:.3g} to {ends[1]:.3g}{unit} explain the log as well"
    if not base_fits:
        reason = "at the end of its range, where it has no effect on the log"
    if parameter.name in ("friction_scale", "left_friction_scale"):
        fitted = coordinates.perturbation(solution.z)
        replayed = replay_segments(residuals.segments, [fitted], nthread=residuals.nthread)
        share = float((replayed.sliding_mps > SLIDES_MPS).mean())
        reason += f" (wheels slide in {share:.1%} of the steps)"
    else:
        other = _confounded_with(uncertainty.correlation, index)
        if other is not None:
            correlation = uncertainty.correlation[index, other]
            reason += f" (its correlation with {coordinates.names[other]} is {correlation:.2f})"
    return as_in_base(parameter.name, reason, *ends)


def _confounded_with(correlation: F64, index: int) -> int | None:
    """Return the parameter with the highest correlation with this one; None below 0.8."""
    others = np.abs(correlation[index]).copy()
    others[index] = 0.0
    at = int(np.argmax(others)) if len(others) > 1 else index
    return at if others[at] > 0.8 else None


def as_in_base(
    name: str, reason: str, low: float | None = None, high: float | None = None
) -> ParameterEstimate:
    """Return the estimate of a parameter that keeps the base's value, for this reason."""
    value, unit = float(getattr(BASE, name)), PARAMETERS[name].unit
    return ParameterEstimate(name, unit, value, low, high, False, reason)


def estimates(solution: FitSolution, uncertainty: Uncertainty) -> list[ParameterEstimate]:
    """Return the estimates of all fitted parameters."""
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
    return lines
