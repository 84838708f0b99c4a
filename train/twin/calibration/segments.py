"""Segments of a log: stretches of consecutive steps, as they were commanded and sensed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Ints
from restock.errors import ConfigError
from restock.ingest.task.signals import Signals
from restock.ingest.task.task import Task
from restock.train.twin.calibration.logged_steps import COMMAND, LoggedSteps, rows_of
from restock.train.twin.physics.robot_model import RobotModel

WARMUP_S = 1.0  # longer than any latency, and than a stop on friction .2
STILL_MPS = 0.02  # slower than this a robot stands
TOUCHING_M = 0.05  # nearer to something than this a robot may be touching it
EVEN = 0.25  # of a control period: how far a tick or a pose may be from where it should be

POSE = ("pose_x_m", "pose_y_m", "pose_yaw_rad")
MOTION = (
    *("wheel_speed_mps", "wheel_yaw_rate_radps", "gyro_yaw_rate_radps", "accel_x_mps2"),
    *("localised_speed_mps", "localised_lateral_mps"),
)
BEFORE = (
    *("wheel_speed_mps", "wheel_yaw_rate_radps", "gyro_yaw_rate_radps"),
    "localised_speed_mps",
)
LOGGED = ("stamp_ns", "pose_stamp_ns", *POSE, *MOTION, *COMMAND, "bumped", "clearance_m")


@dataclass(frozen=True)
class LoggedSegments:
    """S segments of K steps as they were logged, with the W steps before each.

    `signals` are the stored signals by name, (S, K + 1): at the K ticks and at the end of the
    last. `left_out` counts the steps that begin no segment although they are of the store, by
    reason.
    """

    task: Task
    robot: RobotModel | None  # whose logs they are; None: the twin's stand-in
    horizon_steps: int  # K
    warmup_steps: int  # W
    row: Ints  # (S,) of the first of the K steps, in the `LoggedSteps`
    transition_id: Ints  # (S,) likewise
    recording_id: NDArray[np.str_]  # (S,)
    episode_id: NDArray[np.str_]  # (S,)
    condition: NDArray[np.str_]  # (S, K) the label of each step
    true_condition: NDArray[np.str_]  # (S, K) of a simulator; "" where not known
    command: F64  # (S, W + K, 2) speed m/s and yaw rate rad/s; stop where nothing was before
    still: NDArray[np.bool_]  # (S,) the robot stood before the first of the W steps
    before: dict[str, F64]  # the signals of `BEFORE` as the W steps begin, (S,) each
    signals: Signals  # (S, K + 1) each
    pose_fresh: NDArray[np.bool_]  # (S, K + 1) the pose was measured at its tick
    left_out: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.transition_id)

    @property
    def pose(self) -> F64:
        """Logged x, y and heading, (S, K + 1, 3)."""
        return np.stack([self.signals[name] for name in POSE], axis=-1)

    def take(self, which: NDArray[Any]) -> LoggedSegments:
        """The segments of an index or mask (S,), `left_out` as it was."""
        arrays = {
            name: value[which]
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray)
        }
        before, signals = rows_of(self.before, which), rows_of(self.signals, which)
        return replace(self, before=before, signals=signals, **arrays)


def log_segments(
    steps: LoggedSteps,
    horizon_s: float,
    *,
    stride_s: float | None = None,
    warmup_s: float = WARMUP_S,
) -> LoggedSegments:
    """Cut logged episodes into segments of `horizon_s`.

    A segment begins `stride_s` (default: the horizon, so that none overlap) after the one before
    or at the first tick from there on where its steps and those of the warm-up (rounded up to whole
    steps) are all there, evenly in time, and its first pose is fresh. At an episode's start the
    steps before are not needed if the robot stood still. A pose is fresh if its age is the
    recording's usual one, within a quarter of a control period.

    Raises:
        ConfigError: a horizon or stride that is not some control periods.
    """
    task, rows = steps.task, steps.now
    horizon = _periods(task, horizon_s, "horizon_s")
    stride = horizon if stride_s is None else _periods(task, stride_s, "stride_s")
    warmup = int(np.ceil(warmup_s / task.control_period_s - 1e-9))
    period_ns = round(task.control_period_s * 1e9)
    fresh = _fresh(steps, period_ns)

    first = np.flatnonzero(steps.begins)
    ends = np.append(first[1:], len(steps))
    left: Counter[str] = Counter()
    starts: list[int] = []
    for begin, end in zip(first.tolist(), ends.tolist(), strict=True):
        wheels = np.hypot(rows["wheel_speed_mps"][begin], rows["wheel_yaw_rate_radps"][begin])
        lead = 0 if steps.step_index[begin] == 0 and wheels < STILL_MPS else warmup
        base = place = begin + lead
        if place >= end - horizon:
            left["too short a stretch"] += end - begin
            continue
        left["warm-up"] += lead
        even = _evenly(rows["stamp_ns"][base:end], horizon, period_ns)
        good = base + np.flatnonzero(even & fresh[base : end - horizon])
        while (following := int(np.searchsorted(good, place))) < len(good):
            start = int(good[following])
            left += _passed_over(even[place - base : start - base])
            starts.append(start)
            place = start + stride
        left += _passed_over(even[place - base :])
        left["end of a stretch"] += max(end - max(place, end - horizon), 0)
    at = np.array(starts, np.int64)
    index = at[:, None] + np.arange(horizon + 1)

    lead_row = np.maximum(at - warmup, steps.first[at])
    return LoggedSegments(
        task=task,
        robot=steps.robot,
        horizon_steps=horizon,
        warmup_steps=warmup,
        row=at,
        transition_id=steps.transition_id[at],
        recording_id=steps.recording_id[at],
        episode_id=steps.episode_id[at],
        condition=steps.condition[index[:, :-1]],
        true_condition=steps.true_condition[index[:, :-1]],
        command=steps.commands(at, warmup, horizon),
        still=at - warmup < steps.first[at],
        before={name: rows[name][lead_row] for name in BEFORE},
        signals={name: rows[name][index] for name in LOGGED},
        pose_fresh=fresh[index],
        left_out={reason: count for reason, count in left.items() if count},
    )


def _evenly(stamp_ns: Ints, horizon: int, period_ns: int) -> NDArray[np.bool_]:
    """Of the ticks (N,) of a stretch, which of the first N - horizon have `horizon` more, each
    where it is due."""
    off = stamp_ns - np.arange(len(stamp_ns)) * period_ns
    windows = np.lib.stride_tricks.sliding_window_view(off, horizon + 1)
    most, begin = EVEN * period_ns, off[: len(windows)]
    even = (windows.max(axis=1) - begin <= most) & (begin - windows.min(axis=1) <= most)
    return np.asarray(even, np.bool_)


def _passed_over(even: NDArray[np.bool_]) -> Counter[str]:
    """Why no segment begins at these ticks (N,)."""
    return Counter(
        {
            "ticks not a control period apart": int((~even).sum()),
            "no fresh pose at the start": int(even.sum()),
        }
    )


def ordinary_driving(segments: LoggedSegments) -> tuple[LoggedSegments, dict[str, int]]:
    """Segments that ordinary driving explains, and how many were left out, by reason."""
    touched = segments.signals["bumped"].astype(bool).any(axis=1)
    near = ~touched & (segments.signals["clearance_m"] < TOUCHING_M).any(axis=1)
    # A label is about what the wheels did, also on a floor that is slippery all over.
    known = segments.true_condition != ""
    truth = np.char.find(np.char.add(segments.true_condition, ","), "wheel_slip,") >= 0
    slips = np.where(known, truth, segments.condition == "wheel_slip")
    slippery = ~touched & ~near & slips.any(axis=1)
    needed = [segments.command.reshape(len(segments), -1)]
    needed += [segments.signals[name] for name in (*POSE, *BEFORE)]
    missing = ~np.isfinite(np.concatenate(needed, axis=1)).all(axis=1)
    reasons = {
        "bumped into something": touched,
        f"within {TOUCHING_M:g} m of something": near,
        "on a slippery patch": slippery,
        "signals missing": missing & ~touched & ~near & ~slippery,
    }
    left = {reason: int(mask.sum()) for reason, mask in reasons.items() if mask.any()}
    return segments.take(~np.any(list(reasons.values()), axis=0)), left


def held_out_from(segments: LoggedSegments, share: float, seed: int) -> dict[str, int]:
    """From which stamp on each recording is held out, in ns.

    Of four recordings or more, whole ones; else the last part of each.
    """
    names = np.unique(segments.recording_id)
    never, always = np.iinfo(np.int64).max, np.iinfo(np.int64).min
    if not share:
        return {str(name): never for name in names}
    if len(names) >= 4:
        rng = np.random.Generator(np.random.PCG64(seed))
        held_out = set(rng.permutation(names)[: max(round(share * len(names)), 1)])
        return {str(name): always if name in held_out else never for name in names}
    begin = segments.signals["stamp_ns"][:, 0]
    return {
        str(name): int(
            np.quantile(begin[segments.recording_id == name], 1 - share, method="higher")
        )
        for name in names
    }


def split_at(
    segments: LoggedSegments, stamps: Mapping[str, int]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which segments (S,) lie wholly before their recording's stamp, and which wholly after it."""
    at = np.array([stamps[str(name)] for name in segments.recording_id], np.int64)
    ticks = segments.signals["stamp_ns"]
    return ticks[:, -1] <= at, ticks[:, 0] >= at


def _fresh(steps: LoggedSteps, period_ns: int) -> NDArray[np.bool_]:
    """Which rows' poses are as old as their recording's usually are."""
    age = steps.now["stamp_ns"] - steps.now["pose_stamp_ns"]
    fresh = np.zeros(len(age), np.bool_)
    for recording in np.unique(steps.recording_id):
        rows = steps.recording_id == recording
        fresh[rows] = np.abs(age[rows] - np.median(age[rows])) <= EVEN * period_ns
    return fresh


def whole_periods_s(task: Task, seconds: float) -> float:
    """The nearest length that is some control periods; `seconds` itself where that is more than
    a twentieth away."""
    period_s = task.control_period_s
    whole = round(max(round(seconds / period_s), 1) * period_s, 6)
    return whole if abs(whole - seconds) <= 0.05 * seconds else seconds


def _periods(task: Task, seconds: float, name: str) -> int:
    count = round(seconds / task.control_period_s)
    if count < 1 or abs(count * task.control_period_s - seconds) > 1e-6:
        raise ConfigError(
            f"{name} must be a multiple of the control period of {task.control_period_s} s,"
            f" got {seconds}",
            where="segments",
        )
    return count
