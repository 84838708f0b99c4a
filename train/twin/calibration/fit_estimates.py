"""What can be said of each fitted parameter: its value, or why the log does not tell it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from restock.train.twin.calibration.fit_result import Estimate
from restock.train.twin.calibration.fit_solver import Problem, Solution
from restock.train.twin.calibration.fit_uncertainty import Uncertainty, profile
from restock.train.twin.calibration.mismatch import Mismatch
from restock.train.twin.calibration.open_loop import replay_segments

F64 = NDArray[np.float64]

SLIDES_MPS = 0.05
CONFOUNDED = 0.95
ILL_CONDITIONED = 1e6


def untold(mismatch: Mismatch, solution: Solution, known: Uncertainty) -> Estimate | None:
    """The parameter that is known least of those that stay as in the base, if there is one.

    One does that is known too little, and whose value in the base explains the log as well.
    """
    width = known.half / solution.coordinates.known
    for index in np.argsort(-width):
        if width[index] > 1:
            estimate, stays = _unknown(mismatch, solution, known, int(index))
            if stays:
                return estimate
    return None


def _unknown(
    mismatch: Mismatch, solution: Solution, known: Uncertainty, index: int
) -> tuple[Estimate, bool]:
    """What can be said of a parameter that is known little, and whether it stays."""
    coordinates = solution.coordinates
    parameter = coordinates.parameters[index]
    problem = Problem(mismatch, coordinates, solution.scale)
    low, high = profile(problem, solution, index)
    ends = [_value(solution, index, end) for end in (low, high)]
    start = coordinates.point(coordinates.base)[index]
    stays = low - 1e-9 <= start <= high + 1e-9 or high - low > 0.9
    # At an end of its range, and the residuals there do not move with it: where it got to is the
    # search's doing, whatever the jumps of the cost on the way to the base say.
    lost = known.half[index] > 1 and not 1e-9 < solution.z[index] < 1 - 1e-9
    unit = f" {parameter.unit}" if parameter.unit else ""
    reason = f"{ends[0]:.3g} to {ends[1]:.3g}{unit} explain the log as well"
    if lost and not stays:
        reason = "at the end of its range the log does not change with it"
    if parameter.name in ("friction_scale", "left_friction_scale"):
        now = coordinates.perturbation(solution.z)
        sliding = replay_segments(
            mismatch.segments, [now], timestep_s=mismatch.timestep_s, nthread=mismatch.nthread
        ).sliding_mps
        share = float((sliding > SLIDES_MPS).mean())
        reason += f" (wheels slide in {share:.1%} of the steps)"
    else:
        other = _partner(known.correlation, index)
        if other is not None:
            pair, value = coordinates.names[other], known.correlation[index, other]
            reason += f" (its correlation with {pair} is {value:.2f})"
    base = float(getattr(coordinates.base, parameter.name))
    told = Estimate(parameter.name, parameter.unit, base, ends[0], ends[1], False, reason)
    return told, bool(stays or lost)


def _partner(correlation: F64, index: int) -> int | None:
    """Which other parameter this one is confounded with most, if with any."""
    others = np.abs(correlation[index]).copy()
    others[index] = 0.0
    at = int(np.argmax(others)) if len(others) > 1 else index
    return at if others[at] > 0.8 else None


def estimate(solution: Solution, known: Uncertainty, index: int) -> Estimate:
    parameter = solution.coordinates.parameters[index]
    low, middle, high = (
        _value(solution, index, solution.z[index] + way * known.half[index]) for way in (-1, 0, 1)
    )
    return Estimate(parameter.name, parameter.unit, middle, low, high, True)


def _value(solution: Solution, index: int, z: float) -> float:
    point = solution.z.copy()
    point[index] = min(max(z, 0.0), 1.0)
    return float(solution.coordinates.values(point)[index])


def warnings(solution: Solution, known: Uncertainty) -> list[str]:
    found = []
    names, z = solution.coordinates.names, solution.z
    for index, name in enumerate(names):
        value = _value(solution, index, z[index])
        if z[index] < 1e-6 or z[index] > 1 - 1e-6:
            found.append(f"{name} is at the end of its range, {value:g}")
        if known.half[index] > solution.coordinates.known[index]:
            found.append(f"{name} is known little: see its interval")
        for other in range(index):
            if abs(known.correlation[index, other]) > CONFOUNDED:
                found.append(
                    f"{names[other]} and {name} are confounded: their correlation is"
                    f" {known.correlation[index, other]:.2f}"
                )
    if not solution.converged:
        found.append("least squares had not converged: the intervals are too narrow")
    if known.condition > ILL_CONDITIONED:
        found.append(
            f"ill-conditioned: the information's condition number is {known.condition:.1e}"
        )
    return found
