"""Calibration: fit the parameters with which the twin moves as the robot did in a log.

The log's commands are driven open loop, and the motion is compared with the log's
(`restock.train.twin.calibration.open_loop`, `restock.train.twin.calibration.fit_solver`). A coarse
search over the whole ranges comes first, then least squares. A parameter that the log does not
identify keeps its value, with the reason. Values are effective: they hold only for the timestep at
which they were fitted, which is that of training.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from restock.arrays import F64
from restock.errors import ConfigError, StoreError, counted
from restock.replay.store.store import Store
from restock.stats import bootstrap, median
from restock.train.twin.calibration.fit_solver import (
    BASE,
    CHANNELS,
    DEFAULT,
    PARAMETERS,
    Coordinates,
    FitProblem,
    FitScope,
    FitSolution,
    ReplayResiduals,
    channel_noise,
    fit_scope,
    position_gap_m,
    search,
    solve,
)
from restock.train.twin.calibration.fitted_twin import (
    FittedTwin,
    HeldOutGap,
    ParameterEstimate,
    Uncertainty,
    as_in_base,
    estimates,
    fit_warnings,
    measure_uncertainty,
    unidentified,
)
from restock.train.twin.calibration.logged_steps import LoggedSteps, logged_steps, robot_of_store
from restock.train.twin.calibration.open_loop import (
    LoggedSegments,
    held_out_from,
    log_segments,
    ordinary_driving,
    replay_segments,
    split_at,
)
from restock.train.twin.physics.perturbation import Perturbation

Report = Callable[[str], None]

MIN_SEGMENTS = 8
COARSE_SEGMENTS = 16
HELD_OUT_HORIZONS_S = (1.0, 3.0, 6.0)


@dataclass(frozen=True)
class FitConfig:
    """Settings of a fit. The same values give the same result. Raises ConfigError if invalid."""

    parameters: tuple[str, ...] = DEFAULT
    recordings: tuple[str, ...] = ()  # IDs of the recordings to fit; empty: all of the store
    task_hash: str | None = None  # needed if the store has rows of several tasks
    horizon_s: float = 3.0  # length of the fitted segments
    held_out: float = 0.25  # share of the log that is not fitted, but used to measure the gap
    search_points: int = 64  # number of points that the coarse search tries
    max_segments: int = 200  # if the log has more, this many are drawn at random
    seed: int = 0
    nthread: int = 1  # 0: every core
    name: str = "fitted"

    def __post_init__(self) -> None:
        for name in self.parameters or ("",):
            if name not in PARAMETERS:
                raise ConfigError(
                    f"{name!r} cannot be fitted",
                    where="fit of the twin",
                    remedy=f"choose from {', '.join(PARAMETERS)}",
                )
        if self.horizon_s <= 0 or self.max_segments < 1 or not 0 <= self.held_out < 1:
            raise ConfigError(
                f"got a horizon of {self.horizon_s:g} s, {self.max_segments} segments and a share"
                f" of {self.held_out:g} held out",
                where="fit of the twin",
                remedy="give a horizon above 0, at least one segment and a share in [0, 1)",
            )


@dataclass(frozen=True)
class _FitData:
    """The data of a fit: the steps, the segments to fit, and where each held-out part begins."""

    steps: LoggedSteps
    recordings: tuple[str, ...]  # IDs of the recordings that have segments
    segments: LoggedSegments  # the segments to fit
    held_out_from_ns: dict[str, int]  # recording -> time from which it is held out
    left_out: dict[str, int]  # reason -> number of segments or steps left out


def fit(
    store: Store, config: FitConfig | None = None, *, on_progress: Report | None = None
) -> FittedTwin:
    """Fit a twin to the recordings of a store.

    Raises:
        ConfigError: there is no such recording, or the log identifies none of the parameters.
        StoreError: there are no rows, rows of several tasks, or too few segments of ordinary
            driving.
    """
    config, report = config or FitConfig(), on_progress or (lambda text: None)
    rng = np.random.Generator(np.random.PCG64(config.seed))
    task = store.task(config.task_hash)
    robot = robot_of_store(store, task.hash)
    scope = fit_scope(store, task, config.parameters, config.recordings, robot)
    data = _fit_data(store, config, rng)
    few = data.segments.take(rng.permutation(len(data.segments))[:COARSE_SEGMENTS])
    coarse, fine = (
        ReplayResiduals(segments, scope.channels, nthread=config.nthread)
        for segments in (few, data.segments)
    )
    coordinates = Coordinates(scope.names)
    start = _search(coarse, coordinates, config, report)
    solution, uncertainty, dropped = _identify(fine, coordinates, start, config, store, report)
    refused = [as_in_base(name, reason) for name, reason in scope.refused.items()]
    kept = [*refused, *dropped]
    perturbation = msgspec.structs.replace(
        solution.coordinates.perturbation(solution.z), name=config.name
    )
    return FittedTwin(
        perturbation=perturbation,
        recordings=data.recordings,
        estimates=tuple(
            sorted(
                [*estimates(solution, uncertainty), *kept],
                key=lambda item: config.parameters.index(item.name),
            )
        ),
        warnings=(
            *scope.notes,
            *(f"{item.name} is not fitted: {item.note}" for item in kept),
            *fit_warnings(solution, uncertainty),
        ),
        held_out=_held_out_gaps(data, scope, config, perturbation, report),
        noise=_deviations(fine, perturbation),
        segments=len(data.segments),
        clusters=uncertainty.clusters,
        left_out=data.left_out,
    )


def _fit_data(store: Store, config: FitConfig, rng: np.random.Generator) -> _FitData:
    """Cut segments; draw at most `max_segments` with ordinary driving that are not held out."""
    steps = logged_steps(store, config.task_hash, config.recordings)
    segments = log_segments(steps, config.horizon_s)
    if not len(segments):
        why = ", ".join(f"{steps} {reason}" for reason, steps in segments.left_out.items())
        raise StoreError(
            f"no segment of {config.horizon_s:g} s, of {len(steps)} steps: {why}",
            where=str(store.path),
            remedy="give a shorter horizon, or ingest more driving",
        )
    stamps = held_out_from(segments, config.held_out, config.seed)
    ordinary, left_out = ordinary_driving(segments)
    chosen = np.flatnonzero(split_at(ordinary, stamps)[0])
    if len(chosen) < MIN_SEGMENTS:
        counts = {"held out": len(ordinary) - len(chosen), **left_out}
        raise StoreError(
            f"{counted(len(chosen), 'segment')} of {config.horizon_s:g} s to fit,"
            " fewer than"
            f" {MIN_SEGMENTS} (of {len(segments)}:"
            f" {', '.join(f'{count} {reason}' for reason, count in counts.items())})",
            where=str(store.path),
            remedy="ingest more driving, or give a shorter horizon",
        )
    if len(chosen) > config.max_segments:
        left_out["more than are used"] = len(chosen) - config.max_segments
        chosen = np.sort(rng.permutation(chosen)[: config.max_segments])
    left_out |= {f"steps: {reason}": count for reason, count in segments.left_out.items()}
    recordings = tuple(str(name) for name in np.unique(segments.recording_id))
    return _FitData(steps, recordings, ordinary.take(chosen), stamps, left_out)


def _search(
    residuals: ReplayResiduals, coordinates: Coordinates, config: FitConfig, report: Report
) -> F64:
    """Search the whole ranges of the parameters with few segments; return the best point (n,)."""
    report(f"searching {config.search_points} points on {len(residuals.segments)} segments")
    scale = {name: CHANNELS[name][1] for name in residuals.channels}
    problem = FitProblem(residuals, coordinates, scale)
    starts = search(problem, config.search_points, best=3, seed=config.seed)
    ends = [solve(problem, start, iterations=6) for start in starts]
    return min(ends, key=lambda end: end[1])[0]


def _identify(
    residuals: ReplayResiduals, coordinates: Coordinates, start: F64, config: FitConfig,
    store: Store, report: Report,
) -> tuple[FitSolution, Uncertainty, list[ParameterEstimate]]:  # fmt: skip
    """Fit by least squares, and again without each parameter that turns out unidentified."""
    dropped: list[ParameterEstimate] = []
    while True:
        solution = _least_squares(residuals, coordinates, start, report)
        uncertainty = measure_uncertainty(solution, residuals.segments.episode_id, config.seed)
        lost = unidentified(residuals, solution, uncertainty)
        if lost is None:
            return solution, uncertainty, dropped
        report(f"this log does not identify {lost.name}")
        dropped.append(lost)
        start = np.delete(solution.z, coordinates.names.index(lost.name))
        coordinates = coordinates.without(lost.name)
        if not len(coordinates):
            raise ConfigError(
                f"this log does not identify {lost.name}: {lost.note}",
                where=str(store.path),
                remedy="log more driving with changes of speed and direction",
            )


def _least_squares(
    residuals: ReplayResiduals, coordinates: Coordinates, z: F64, report: Report
) -> FitSolution:
    """Fit all segments twice, since the noise is known only after the first fit."""
    for iterations in (10, 15):
        scale = channel_noise(residuals.of([coordinates.perturbation(z)]))
        problem = FitProblem(residuals, coordinates, scale)
        z, value, converged = solve(problem, z, iterations)
        report(f"least squares on {len(residuals.segments)} segments: cost {value:.1f}")
    return FitSolution(
        coordinates=coordinates,
        z=z,
        residual=problem.residual(z[:, None])[:, 0],
        jacobian=problem.jacobian(z[:, None], np.zeros(0)),
        segment=problem.segment,
        scale=scale,
        converged=converged,
    )


def _held_out_gaps(
    data: _FitData, scope: FitScope, config: FitConfig, fitted: Perturbation, report: Report
) -> tuple[HeldOutGap, ...]:
    """Measure the position gap on held-out segments of about 1, 3 and 6 s."""
    if "position" not in scope.channels or not config.held_out:
        return ()
    report("driving the held-out segments again")
    gaps, period_s = [], data.steps.task.control_period_s
    for wanted_s in HELD_OUT_HORIZONS_S:
        horizon_s = max(round(wanted_s / period_s), 1) * period_s
        ordinary, _ = ordinary_driving(log_segments(data.steps, horizon_s))
        held_out = ordinary.take(split_at(ordinary, data.held_out_from_ns)[1])
        if not len(held_out):
            continue
        replayed = replay_segments(held_out, [BASE, fitted], nthread=config.nthread)
        before, after = position_gap_m(held_out, replayed)[:, :, -1]
        rng = np.random.Generator(np.random.PCG64(config.seed))
        interval = bootstrap([after], median, rng=rng, resamples=1000)
        gaps.append(
            HeldOutGap(round(horizon_s, 6), len(held_out), median(before), median(after), *interval)
        )
    return tuple(gaps)


def _deviations(residuals: ReplayResiduals, fitted: Perturbation) -> dict[str, dict[str, Any]]:
    """Return each channel's median deviation from the log, before and after the fit."""
    return {
        name: {
            "unit": CHANNELS[name][0],
            "before": float(np.median(np.abs(values[0]))),
            "after": float(np.median(np.abs(values[1]))),
        }
        for name, values in residuals.of([BASE, fitted]).items()
    }
