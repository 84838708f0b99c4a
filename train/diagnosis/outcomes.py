"""Are rewards and ends what the task's definition makes of the observations, as in the twin?

A row's observations hold nearly all that its reward is made of: the way made along the plan, the
speeds, what is near, whether the action changed. So the task's own function is asked, and rewards
are compared with its answer; what observations do not hold (a bump) is missing in the answer for
the twin as well. An episode that arrived must be terminated there.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from restock.arrays import F64, Bools
from restock.ingest.task.signals import STORED_SIGNALS, Signals
from restock.ingest.task.task import reward_parts
from restock.stats import ConfidenceInterval, clustered_quantiles
from restock.train.diagnosis.evidence import (
    Comparison,
    judged,
    not_run,
    share_judged,
    shares_compared,
)
from restock.train.diagnosis.fed_rows import FedRows
from restock.train.diagnosis.response import MIN_CLUSTERS, RESAMPLES

SCALE = 1.2
OTHER = 0.1  # of the rows
LOST = 0.05  # of the ends
_JUMP_M = 0.9  # a plan was replaced
_TOUCHING_M = 0.05
_TELLING = 0.05  # of a reward: more than float32 and a noisy clearance make
_ARRIVED_M = 0.15  # of plan beyond the goal's radius: the plan is never shorter than the way


def implied_reward(rows: FedRows) -> F64:
    """The reward (N,) that the observations come to; NaN where they do not say."""
    task = rows.task
    clearance = np.full(len(rows), np.nan)
    if task.lidar:
        clearance = rows.sectors(after=True).min(axis=1) ** 2 * task.range_max_m
    unknown: Signals = {signal.name: np.zeros(len(rows), signal.dtype) for signal in STORED_SIGNALS}
    now: Signals = unknown | {"wheel_speed_mps": rows.now("wheel_speed")}
    after: Signals = unknown | {
        "wheel_speed_mps": rows.after("wheel_speed"),
        "localised_speed_mps": rows.after("localised_speed"),
        "clearance_m": clearance,
        "goal_distance_m": np.full(len(rows), np.inf),
    }
    progress = _progress(rows)
    parts = reward_parts(task, now, after, progress, rows.action, rows.previous_action())
    implied = np.asarray(sum(parts.values()), np.float64)
    implied[(clearance < _TOUCHING_M) | arrived(rows) | rows.terminated] = np.nan
    return implied


def arrived(rows: FedRows) -> Bools:
    """The rows (N,) after which the robot is at its goal, as far as its plan says."""
    if rows.task.goal == "none":
        return np.zeros(len(rows), np.bool_)
    to_go = 10.0 * rows.after("goal_distance")
    return np.asarray(to_go <= rows.task.goal_radius_m + _ARRIVED_M, np.bool_)


def _progress(rows: FedRows) -> F64:
    if rows.task.goal == "none":
        return rows.after("localised_speed") * rows.task.control_period_s
    now, after = rows.now("goal_distance"), rows.after("goal_distance")
    shorter = 10.0 * (now - after)
    shorter[(now >= 1.0) | (after >= 1.0) | (np.abs(shorter) > _JUMP_M)] = np.nan
    return np.asarray(shorter)


def outcomes(logs: FedRows, twin: FedRows | None, seed: int = 0) -> Iterator[Comparison]:
    """Rewards, then ends."""
    rng = np.random.default_rng([seed, 2])
    yield from _rewards(logs, twin, rng)
    yield from _ends(logs, twin)


def _rewards(logs: FedRows, twin: FedRows | None, rng: np.random.Generator) -> Iterator[Comparison]:
    what = "reward against the task's own, of the same observations"
    implied = implied_reward(logs)
    telling = np.abs(implied) > _TELLING  # False for NaN
    if len(np.unique(logs.cluster[telling])) < MIN_CLUSTERS:
        yield not_run(
            "reward scale", what, "too few rows whose reward follows from their observations"
        )
        return
    ratio = logs.reward[telling] / implied[telling]
    (scale,) = clustered_quantiles(
        ratio, logs.cluster[telling], (0.5,), rng=rng, resamples=RESAMPLES
    )
    yield judged(
        "reward scale", what, "ratio", scale, logs=float(np.median(ratio)), twin=1.0,
        least=1 / SCALE, most=SCALE, logs_rows=int(telling.sum()),
    )  # fmt: skip
    what = "row's reward is not the task's own, whatever its scale"
    found = _unlike(logs, implied, scale.value)
    if twin is None:
        yield share_judged("reward rows", what, *found, OTHER)
    else:
        expected = _unlike(twin, implied_reward(twin), 1.0)
        yield shares_compared("reward rows", what, found, expected, -1.0, OTHER)


def _unlike(rows: FedRows, implied: F64, scale: float) -> tuple[int, int]:
    """Rows whose reward is not the implied one times `scale`, and of how many that is known."""
    known = np.isfinite(implied)
    scale = scale if abs(scale) > _TELLING else 1.0
    off = np.abs(rows.reward[known] / scale - implied[known]) > _TELLING
    return int(off.sum()), int(known.sum())


def _ends(logs: FedRows, twin: FedRows | None) -> Iterator[Comparison]:
    inside = logs.terminated & ~logs.last
    yield share_judged(
        "goes on after its end", "row is terminated and its episode goes on", int(inside.sum()),
        int(logs.terminated.sum()), LOST,
    )  # fmt: skip
    if logs.task.goal == "none":
        for check in ("terminated at the goal", "goal reward"):
            yield not_run(check, "what happens on arrival", "the task has no goal")
        return

    def at_goal(rows: FedRows) -> tuple[int, int]:
        there = arrived(rows) & rows.last
        return int((rows.terminated & there).sum()), int(there.sum())

    what = "of the episodes that end at their goal, those terminated there"
    if twin is not None:
        yield shares_compared(
            "terminated at the goal", what, at_goal(logs), at_goal(twin), -LOST, LOST
        )
    else:
        yield share_judged("terminated at the goal", what, *at_goal(logs), 1.0, least=1 - LOST)
    yield _goal_reward(logs, twin)


def _goal_reward(logs: FedRows, twin: FedRows | None) -> Comparison:
    what = "reward of the last step of episodes that end at their goal"
    there = arrived(logs) & logs.last
    if there.sum() < 5:
        return not_run("goal reward", what, "fewer than 5 episodes end there")
    value = float(np.median(logs.reward[there]))
    expected = logs.task.rewards.goal
    if twin is not None and (arrived(twin) & twin.last).sum() >= 5:
        expected = float(np.median(twin.reward[arrived(twin) & twin.last]))
    if not expected:
        return not_run("goal reward", what, "arriving earns nothing")
    ends = np.quantile(logs.reward[there], [0.25, 0.75]) / expected
    interval = ConfidenceInterval(value / expected, float(ends.min()), float(ends.max()))
    return judged("goal reward", what, "ratio", interval, logs=value, twin=expected,
                  least=1 / SCALE, most=SCALE, logs_rows=int(there.sum()))  # fmt: skip


__all__ = ["arrived", "implied_reward", "outcomes"]
