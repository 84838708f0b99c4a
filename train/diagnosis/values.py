"""Do the values of observations lie where the twin's do, and does the lidar look where it should?

Ranges and spreads differ between floors and drivers, so only what no floor explains counts: values
far beyond any of the twin's, or a sensor that never changes; and of fewer than five episodes, which
are one floor and one driver, they are never sure. As the robot drives straight on, what
lies ahead comes nearer and what lies behind goes away: by this each sector's bearing is told.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from restock.arrays import F64, Bools
from restock.stats import (
    ConfidenceInterval,
    cluster_counts,
    clustered_quantiles,
    percentiles,
)
from restock.train.diagnosis.evidence import Comparison, judged, not_run, share_judged
from restock.train.diagnosis.fed_rows import FedRows
from restock.train.diagnosis.response import MIN_CLUSTERS, RESAMPLES, ratio_of

BEYOND = 0.02  # of the rows
SPREAD = 10.0  # of logs over the twin's, or its inverse
TURNED_DEG = 20.0
LIDAR_SCALE = 1.5  # of logs over the twin's, or its inverse
MEASURED = (
    *("wheel_speed", "localised_speed", "lateral_speed", "gyro_yaw_rate", "accel_x"),
    "goal_distance",
)
CLEARANCES = "clearances"  # of all sectors in the mean
_MAY_BE_STILL = ("lateral_speed",)  # a robot that does not slide has none
_WIDER = 1.0  # of the twin's range, on each side
_STRAIGHT_RADPS = 0.15
_DRIVING_MPS = 0.25
_FAR = 0.97  # of the lidar's range


def values(logs: FedRows, twin: FedRows | None, seed: int = 0) -> Iterator[Comparison]:
    """Ranges and spreads of what is measured, then the lidar's bearing and scale."""
    if twin is None:
        yield not_run("range", "values against the twin's", "no twin to compare with")
    else:
        few = len(np.unique(logs.episode)) < MIN_CLUSTERS
        for name in (*MEASURED, CLEARANCES) if logs.task.lidar else MEASURED:
            for row in _entry(name, logs, twin, np.random.default_rng([seed, 4])):
                yield replace(row, status="undecided") if few and row.off else row
    yield from _lidar(logs, twin, np.random.default_rng([seed, 3]))


def _entry(
    name: str, logs: FedRows, twin: FedRows, rng: np.random.Generator
) -> Iterator[Comparison]:
    of_logs, of_twin = (
        rows.sectors().mean(axis=1) if name == CLEARANCES else rows.now(name)
        for rows in (logs, twin)
    )
    low, high = float(of_twin.min()), float(of_twin.max())
    room = _WIDER * (high - low)
    if room <= 0:
        return
    beyond = (of_logs < low - room) | (of_logs > high + room)
    yield share_judged(
        f"range: {name}", f"{name} is far beyond any of the twin's", int(beyond.sum()), len(logs),
        BEYOND, note=f"{float(of_logs.min()):.3g} to {float(of_logs.max()):.3g}, in the twin"
        f" {low:.3g} to {high:.3g}",
    )  # fmt: skip
    least, most = clustered_quantiles(
        of_logs, logs.cluster, (0.05, 0.95), rng=rng, resamples=RESAMPLES
    )
    expected = float(np.subtract(*np.quantile(of_twin, [0.95, 0.05])))
    spread = ConfidenceInterval(
        (most.value - least.value) / expected,
        (most.low - least.high) / expected,
        (most.high - least.low) / expected,
    )
    yield judged(
        f"spread: {name}", f"spread of {name} against the twin's", "ratio", spread,
        logs=most.value - least.value, twin=expected,
        least=0.0 if name in _MAY_BE_STILL else 1 / SPREAD, most=SPREAD,
        logs_rows=len(logs), twin_rows=len(twin),
    )  # fmt: skip


def _lidar(logs: FedRows, twin: FedRows | None, rng: np.random.Generator) -> Iterator[Comparison]:
    """By how many degrees the logs' sectors are turned against the twin's (or a cosine), and how
    much nearer things come for each metre driven, compared with the twin."""
    what = "bearing in which things come nearer when driving on"
    if not logs.task.lidar:
        yield not_run("lidar bearing", what, "the robot has no lidar")
        return
    task, width = logs.task, 360 / logs.task.sectors
    found = _approach(logs, rng)
    expected = _approach(twin, rng) if twin is not None else None
    if expected is not None:
        shape = expected[0]
    else:
        shape = np.cos(np.radians((np.arange(task.sectors) + 0.5) * width - 180))
    if found is None or (twin is not None and expected is None):
        yield not_run("lidar bearing", what, "too few rows of driving straight on")
        return
    turns = np.arange(task.sectors)
    turned = np.stack([np.roll(shape, turn) for turn in turns])  # (turns, sectors)
    fits = found @ turned.T  # (1 + R, turns): how alike, at each turn
    best = fits.argmax(axis=1)
    degrees = np.where(best > task.sectors // 2, best - task.sectors, best) * width
    low, high = percentiles(degrees[1:])
    rows, twin_rows = len(logs), len(twin) if twin is not None else 0
    yield judged(
        "lidar bearing", what, "degrees", ConfidenceInterval(float(degrees[0]), low, high),
        logs=float(degrees[0]), twin=0.0, least=-TURNED_DEG, most=TURNED_DEG,
        logs_rows=rows, twin_rows=twin_rows,
    )  # fmt: skip
    if expected is not None and twin is not None:
        nearer, of_twin = fits.max(axis=1), expected @ shape
        fewer = min(len(np.unique(one.cluster)) for one in (logs, twin))
        at = float(nearer[0]), float(of_twin[0])
        norm = float(shape @ shape)
        yield judged(
            "lidar scale", "how much nearer things come for a metre driven", "ratio",
            ratio_of(nearer[1:], of_twin[1:], at, fewer), logs=at[0] / norm, twin=at[1] / norm,
            least=1 / LIDAR_SCALE, most=LIDAR_SCALE,
            logs_rows=rows, twin_rows=twin_rows,
        )  # fmt: skip


def _approach(rows: FedRows, rng: np.random.Generator) -> F64 | None:
    """How much nearer each sector comes for each metre driven, (1 + R, sectors), bootstrapped."""
    task = rows.task
    now, after = rows.sectors() ** 2 * task.range_max_m, rows.sectors(after=True) ** 2
    after = after * task.range_max_m
    driven = rows.after("localised_speed") * task.control_period_s
    straight = np.abs(rows.after("gyro_yaw_rate")) < _STRAIGHT_RADPS
    straight &= np.abs(driven) > _DRIVING_MPS * task.control_period_s
    most = _FAR**2 * task.range_max_m
    seen: Bools = straight[:, None] & (now < most) & (after < most) & (np.abs(after - now) < 0.5)
    place = np.unique(rows.cluster, return_inverse=True)[1].reshape(-1)
    clusters = int(place.max(initial=-1)) + 1
    if clusters < MIN_CLUSTERS or seen.sum() < 100:
        return None
    above, below = np.zeros((2, clusters, task.sectors))
    np.add.at(above, place, np.where(seen, (now - after) * driven[:, None], 0.0))
    np.add.at(below, place, np.where(seen, driven[:, None] ** 2, 0.0))
    counts = np.concatenate([np.ones((1, clusters)), cluster_counts(clusters, RESAMPLES, rng)])
    bottom = counts @ below
    slope = np.where(bottom > 1e-9, (counts @ above) / np.maximum(bottom, 1e-9), 0.0)
    return np.asarray(slope - slope.mean(axis=1, keepdims=True))


__all__ = ["values"]
