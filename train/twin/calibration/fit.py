"""Calibration: the effective parameters under which the twin does what a log's robot did.

Commands of the log are driven open loop and the motion is compared
(`restock.train.twin.calibration.open_loop`, `restock.train.twin.calibration.mismatch`). The search
is coarse in one batch over the whole ranges, then least squares. A parameter that the log does not
tell stays as it was, with the reason. Values are effective: they hold for the timestep at which
they were fitted, which is the one training uses.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError, StoreError
from restock.replay.store.store import Store
from restock.stats import bootstrap, median
from restock.train.twin.calibration.fit_estimates import estimate, untold, warnings
from restock.train.twin.calibration.fit_parameters import DEFAULT, PARAMETERS, Coordinates
from restock.train.twin.calibration.fit_result import Estimate, Fit, Gap
from restock.train.twin.calibration.fit_scope import HELD_OUT, Scope, cuts, scope, sides, usable
from restock.train.twin.calibration.fit_solver import Problem, Solution, noise, search, solve
from restock.train.twin.calibration.fit_uncertainty import uncertainty
from restock.train.twin.calibration.logged_steps import LoggedSteps, logged_steps
from restock.train.twin.calibration.mismatch import CHANNELS, Mismatch, position_gap_m
from restock.train.twin.calibration.open_loop import replay_segments
from restock.train.twin.calibration.segments import log_segments
from restock.train.twin.physics.perturbation import Perturbation

F64 = NDArray[np.float64]

HORIZON_S = 3.0
FEWEST = 8  # segments
SMALL = 16  # segments of the coarse search
HELD_OUT_S = (1.0, 3.0, 6.0)


def fit(
    store: Store,
    *,
    parameters: Sequence[str] = DEFAULT,
    base: Perturbation | None = None,
    recordings: Sequence[str] = (),
    task_hash: str | None = None,
    timestep_s: float | None = None,
    horizon_s: float = HORIZON_S,
    held_out: float = HELD_OUT,
    search_points: int = 64,
    most_segments: int = 200,
    seed: int = 0,
    nthread: int = 1,
    name: str = "fitted",
    on_progress: Callable[[str], None] | None = None,
) -> Fit:
    """Fit `parameters` to the recordings of a store (all, if none is named).

    `base` holds what is not fitted, and is what "before" means. `held_out` is the share of the
    log that is kept from the fit, to measure the gap on. Of more than `most_segments`, as many are
    drawn. The same arguments give the same result.

    Raises:
        ConfigError: no such parameter or recording, or none that this log could tell.
        StoreError: no rows, rows of several tasks, or too few segments of ordinary driving.
    """
    begun = time.perf_counter()
    say = on_progress or (lambda text: None)
    base = base or Perturbation()
    step_s = base.timestep_s if timestep_s is None else timestep_s
    for parameter in parameters:
        if parameter not in PARAMETERS:
            raise ConfigError(f"{parameter!r} cannot be fitted", where="parameters",
                              remedy=f"name some of {', '.join(PARAMETERS)}")  # fmt: skip
    task = store.task(task_hash)
    found = scope(store, task, parameters, recordings)
    if not found.names:
        raise ConfigError(
            "none of these parameters can be told by this log: "
            + "; ".join(f"{key}: {why}" for key, why in found.refused.items()),
            where=str(store.path),
            remedy="name others with --parameters, or use another log",
        )
    steps = logged_steps(store, task_hash, recordings)
    every = log_segments(steps, horizon_s)
    if not len(every):
        raise StoreError(
            f"no stretch of {horizon_s:g} s: {every.left_out}", where=str(store.path),
            remedy="give a shorter horizon, or ingest more driving",
        )  # fmt: skip
    cut = cuts(every, held_out, seed)
    good, left = usable(every)
    before, _ = sides(good, cut)
    chosen = np.flatnonzero(before)
    if len(chosen) < FEWEST:
        counts = {"held out": len(good) - len(chosen), **left}
        raise StoreError(
            f"{len(chosen)} segments of {horizon_s:g} s to fit, fewer than {FEWEST} (of"
            f" {len(every)}: {', '.join(f'{count} {why}' for why, count in counts.items())})",
            where=str(store.path),
            remedy="ingest more driving, or give a shorter horizon",
        )
    rng = np.random.Generator(np.random.PCG64(seed))
    if len(chosen) > most_segments:
        left["more than are used"] = len(chosen) - most_segments
        chosen = np.sort(rng.permutation(chosen)[:most_segments])
    used = good.take(chosen)
    left |= {f"steps: {reason}": count for reason, count in every.left_out.items()}

    mismatch = Mismatch(used, found.channels, timestep_s=step_s, nthread=nthread)
    small = Mismatch(
        used.take(rng.permutation(len(used))[:SMALL]),
        found.channels,
        timestep_s=step_s,
        nthread=nthread,
    )
    coordinates = Coordinates(found.names, base, task)
    z = _coarse(small, coordinates, search_points, seed, say)
    kept: list[Estimate] = []
    while True:
        solution = _fine(mismatch, coordinates, z, say)
        known = uncertainty(solution, used.episode_id, seed)
        lost = untold(mismatch, solution, known)
        if lost is None:
            break
        say(f"{lost.name} is not told by this log")
        kept.append(lost)
        at = coordinates.names.index(lost.name)
        coordinates, z = coordinates.without(lost.name), np.delete(solution.z, at)
        if not len(coordinates):
            raise ConfigError(
                f"this log does not tell {lost.name}: {lost.note}",
                where=str(store.path),
                remedy="log more driving with changes of speed and direction",
            )
    perturbation = msgspec.structs.replace(
        coordinates.perturbation(solution.z), name=name, timestep_s=step_s
    )
    estimates = [estimate(solution, known, index) for index in range(len(coordinates))]
    warned = list(found.notes)
    warned += [f"{key} is not fitted: {why}" for key, why in found.refused.items()]
    warned += [f"{item.name} is not fitted: {item.note}" for item in kept]
    warned += warnings(solution, known)
    refused = [
        Estimate(key, PARAMETERS[key].unit, getattr(base, key), None, None, False, why)
        for key, why in found.refused.items()
    ]
    order = list(parameters)
    return Fit(
        perturbation=perturbation,
        base=base,
        timestep_s=step_s,
        recordings=tuple(str(item) for item in np.unique(every.recording_id)),
        estimates=tuple(
            sorted([*estimates, *kept, *refused], key=lambda item: order.index(item.name))
        ),
        warnings=tuple(warned),
        held_out=_held_out(steps, cut, found, base, perturbation, step_s, nthread, seed, say)
        if held_out
        else (),
        noise=_noise(mismatch, base, perturbation),
        segments=len(used),
        clusters=known.clusters,
        condition=known.condition,
        left_out=left,
        replays=mismatch.replays + small.replays,
        work_s=time.perf_counter() - begun,
    )


def _coarse(
    small: Mismatch, coordinates: Coordinates, points: int, seed: int, say: Callable[[str], None]
) -> F64:
    """The best point (n,) of a search over the whole ranges, on few segments."""
    say(f"searching {points} points on {len(small.segments)} segments")
    problem = Problem(small, coordinates, {name: CHANNELS[name][1] for name in small.channels})
    starts = search(problem, points, best=3, seed=seed)
    ends = [solve(problem, start, iterations=6) for start in starts]
    return min(ends, key=lambda end: end[1])[0]


def _fine(
    mismatch: Mismatch, coordinates: Coordinates, z: F64, say: Callable[[str], None]
) -> Solution:
    """Least squares on all segments: twice, for the noise is known only after the first."""
    for iterations in (10, 15):
        scale = noise(mismatch.of([coordinates.perturbation(z)]))
        problem = Problem(mismatch, coordinates, scale)
        z, value, converged = solve(problem, z, iterations)
        say(f"least squares on {len(mismatch.segments)} segments: cost {value:.1f}")
    return Solution(
        coordinates=coordinates,
        z=z,
        residual=problem.residual(z[:, None])[:, 0],
        jacobian=problem.jacobian(z[:, None], np.zeros(0)),
        segment=problem.segment,
        scale=scale,
        converged=converged,
    )


def _held_out(
    steps: LoggedSteps, cut: dict[str, int], found: Scope, base: Perturbation, fitted: Perturbation,
    timestep_s: float, nthread: int, seed: int, say: Callable[[str], None],
) -> tuple[Gap, ...]:  # fmt: skip
    """The gap of position on what the fit has not seen, at 1, 3 and 6 s."""
    gaps = []
    if "position" not in found.channels:
        return ()
    say("replaying what was held out")
    period_s = steps.task.control_period_s
    for wanted_s in HELD_OUT_S:
        horizon_s = max(round(wanted_s / period_s), 1) * period_s
        every = log_segments(steps, horizon_s)
        good, _ = usable(every)
        _, after = sides(good, cut) if len(good) else (None, np.zeros(0, np.bool_))
        if not after.any():
            continue
        held = good.take(after)
        replayed = replay_segments(held, [base, fitted], timestep_s=timestep_s, nthread=nthread)
        end = position_gap_m(held, replayed)[:, :, -1]
        rng = np.random.Generator(np.random.PCG64(seed))
        interval = bootstrap([end[1]], median, rng=rng, resamples=1000)
        before, now = (median(item) for item in end)
        gaps.append(Gap(round(horizon_s, 6), len(held), before, now, *interval))
    return tuple(gaps)


def _noise(mismatch: Mismatch, base: Perturbation, fitted: Perturbation) -> dict[str, Any]:
    """Median deviations of each channel before and after."""
    found = mismatch.of([base, fitted])
    return {
        name: {
            "unit": CHANNELS[name][0],
            "before": float(np.median(np.abs(found[name][0]))),
            "after": float(np.median(np.abs(found[name][1]))),
        }
        for name in mismatch.channels
    }


__all__ = ["Estimate", "Fit", "Gap", "fit"]
