"""Segments of a log: stretches of consecutive steps of a store, as they were commanded and sensed.

The store is the interface: one row a step, sensed as training senses it, so what is compared with
a twin (and a latency that is fitted) counts from the observation at a tick, as in training.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from typing import Any

import duckdb
import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError, StoreError
from restock.ingest.task.task import Task
from restock.replay.store.store import Store

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

WARMUP_S = 1.0  # longer than any latency, and than a stop on friction .2
STILL_MPS = 0.02  # slower than this a robot stands
EVEN = 0.25  # of a control period: how far a tick or a pose may be from where it should be

POSE = ("pose_x_m", "pose_y_m", "pose_yaw_rad")
MOTION = (
    *("wheel_speed_mps", "wheel_yaw_rate_radps", "gyro_yaw_rate_radps", "accel_x_mps2"),
    *("localised_speed_mps", "localised_lateral_mps"),
)
_COMMAND = ("command_speed_mps", "command_yaw_rate_radps")
BEFORE = (
    *("wheel_speed_mps", "wheel_yaw_rate_radps", "gyro_yaw_rate_radps"),
    "localised_speed_mps",
)
LOGGED = ("stamp_ns", "pose_stamp_ns", *POSE, *MOTION, *_COMMAND, "bumped", "clearance_m")


@dataclass(frozen=True)
class Segments:
    """S segments of K steps as they were logged, with the W steps before each.

    `signals` are the stored signals by name, (S, K + 1): at the K ticks and at the end of the
    last. `left_out` counts the steps that begin no segment although they are of the store, by
    reason.
    """

    task: Task
    task_hash: str
    horizon_steps: int  # K
    warmup_steps: int  # W
    transition_id: Ints  # (S,) of the first of the K steps
    recording_id: NDArray[np.str_]  # (S,)
    episode_id: NDArray[np.str_]  # (S,)
    step_index: Ints  # (S,) of the first of the K steps, in its episode
    condition: NDArray[np.str_]  # (S, K) the label of each step
    true_condition: NDArray[np.str_]  # (S, K) of a simulator; "" where not known
    command: F64  # (S, W + K, 2) speed m/s and yaw rate rad/s; stop where nothing was before
    still: NDArray[np.bool_]  # (S,) the robot stood before the first of the W steps
    before: F64  # (S, 4) wheels' speed and yaw rate, gyro and localised speed as the W steps begin
    signals: dict[str, NDArray[Any]]  # (S, K + 1) each
    pose_fresh: NDArray[np.bool_]  # (S, K + 1) the pose was measured at its tick
    left_out: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.transition_id)

    @property
    def pose(self) -> F64:
        """Logged x, y and heading, (S, K + 1, 3)."""
        return np.stack([self.signals[name] for name in POSE], axis=-1)

    def take(self, which: NDArray[Any]) -> Segments:
        """The segments of an index or mask (S,), `left_out` as it was."""
        arrays = {
            name: value[which]
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray)
        }
        signals = {name: value[which] for name, value in self.signals.items()}
        return replace(self, signals=signals, **arrays)


def log_segments(
    store: Store,
    horizon_s: float,
    *,
    stride_s: float | None = None,
    warmup_s: float = WARMUP_S,
    recordings: Sequence[str] = (),
    task_hash: str | None = None,
) -> Segments:
    """Cut a store's episodes into segments of `horizon_s`.

    A segment begins every `stride_s` (default: the horizon, so that none overlap) where its steps
    and those of the warm-up (rounded up to whole steps) are all there, evenly in time, and its
    first pose is fresh. At an episode's start the steps before are not needed if the robot stood
    still. A pose is fresh if its age is the recording's usual one, within a quarter of a control
    period.

    Raises:
        ConfigError: a horizon or stride that is not some control periods, or no such recording.
        StoreError: no rows, or rows of several tasks and no `task_hash`.
    """
    task = store.task(task_hash)
    task_hash = task_hash or task.hash
    horizon = _periods(task, horizon_s, "horizon_s")
    stride = horizon if stride_s is None else _periods(task, stride_s, "stride_s")
    warmup = int(np.ceil(warmup_s / task.control_period_s - 1e-9))
    rows = _read(store, task_hash, recordings)
    period_ns = round(task.control_period_s * 1e9)
    fresh = _fresh(rows, period_ns)

    first = _runs(rows)
    ends = np.append(first[1:], len(rows["step_index"]))
    left: Counter[str] = Counter()
    starts, padded = [], []
    for begin, end in zip(first, ends, strict=True):
        wheels = np.hypot(rows["wheel_speed_mps"][begin], rows["wheel_yaw_rate_radps"][begin])
        lead = 0 if rows["step_index"][begin] == 0 and wheels < STILL_MPS else warmup
        at = np.arange(begin + lead, end - horizon, stride)
        if not len(at):
            left["too short a stretch"] += int(end - begin)
            continue
        left["warm-up"] += lead
        left["end of a stretch"] += max(int(end - begin) - lead - len(at) * stride, 0)
        starts.append(at)
        padded.append(np.full(len(at), begin))
    at = np.concatenate(starts) if starts else np.zeros(0, np.int64)
    begin = np.concatenate(padded) if padded else np.zeros(0, np.int64)

    index = at[:, None] + np.arange(horizon + 1)
    due = rows["stamp_ns"][at][:, None] + np.arange(horizon + 1) * period_ns
    even = (np.abs(rows["stamp_ns"][index] - due) <= EVEN * period_ns).all(axis=1)
    left["ticks not a control period apart"] += int((~even).sum()) * stride
    stale = even & ~fresh[at]
    left["no fresh pose to begin with"] += int(stale.sum()) * stride
    keep = even & ~stale
    at, begin, index = at[keep], begin[keep], index[keep]

    past = at[:, None] + np.arange(-warmup, horizon)
    there = past >= begin[:, None]
    command = np.stack([rows["command_speed_mps"], rows["command_yaw_rate_radps"]], axis=-1)
    lead_row = np.maximum(at - warmup, begin)
    return Segments(
        task=task,
        task_hash=task_hash,
        horizon_steps=horizon,
        warmup_steps=warmup,
        transition_id=rows["transition_id"][at],
        recording_id=rows["recording_id"][at],
        episode_id=rows["episode_id"][at],
        step_index=rows["step_index"][at],
        condition=rows["condition"][index[:, :-1]],
        true_condition=rows["true_condition"][index[:, :-1]],
        command=np.where(there[..., None], command[np.maximum(past, begin[:, None])], 0.0),
        still=at - warmup < begin,
        before=np.stack(
            [rows[name][lead_row] for name in BEFORE],
            axis=-1,
        ),
        signals={name: rows[name][index] for name in LOGGED},
        pose_fresh=fresh[index],
        left_out={reason: count for reason, count in left.items() if count},
    )


def recordings_of(store: Store, wanted: Sequence[str], task_hash: str | None) -> list[str]:
    """The ids of the store's recordings of a task, or those of them that are wanted.

    Raises:
        ConfigError: one that is wanted is not there.
        StoreError: no rows, or rows of several tasks and no `task_hash`.
    """
    task = store.task(task_hash)
    task_hash = task_hash or task.hash
    rows = store.connection.execute(
        "SELECT DISTINCT recording_id FROM transitions WHERE task_hash = ? ORDER BY recording_id",
        [task_hash],
    ).fetchall()
    known = [str(row[0]) for row in rows]
    for name in wanted:
        if name not in known:
            raise ConfigError(
                f"no recording {name!r} of task {task_hash}",
                where=str(store.path),
                remedy='restock sql STORE "FROM recordings" lists them',
            )
    return list(wanted) or known


def _read(store: Store, task_hash: str, recordings: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The steps of the store's episodes, in order, as columns."""
    recordings_of(store, recordings, task_hash)
    text = (
        files("restock.train.twin.calibration")
        .joinpath("log_segments.sql")
        .read_text(encoding="utf-8")
    )
    try:
        found = store.connection.execute(
            text.format(columns=", ".join(LOGGED)),
            {"task_hash": task_hash, "recordings": list(recordings)},
        )
    except duckdb.BinderException as error:
        raise StoreError(
            f"lacks a column: {str(error).splitlines()[0]}",
            where=str(store.path),
            remedy="ingest the recordings again with this version",
        ) from error
    rows: dict[str, NDArray[Any]] = found.fetchnumpy()
    rows = {name: _plain(name, values) for name, values in rows.items()}
    if not len(rows["transition_id"]):
        raise StoreError(
            "no transitions" + (f" of {', '.join(recordings)}" if recordings else ""),
            where=str(store.path),
            remedy="ingest recordings into it",
        )
    return rows


def _plain(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """Without masks: text that is null is empty, other numbers than stamps are float64."""
    if name in ("recording_id", "episode_id", "condition", "true_condition"):
        return np.ma.filled(values, "").astype(np.str_)
    if name == "bumped" or values.dtype.kind in "iu":
        return np.asarray(values)
    return np.asarray(values, np.float64)


def _runs(rows: dict[str, NDArray[Any]]) -> NDArray[np.int64]:
    """Where each run of consecutive steps of one episode begins, ascending."""
    episode, step = rows["episode_id"], rows["step_index"].astype(np.int64)
    broken = (episode[1:] != episode[:-1]) | (step[1:] != step[:-1] + 1)
    return np.concatenate([[0], np.flatnonzero(broken) + 1])


def _fresh(rows: dict[str, NDArray[Any]], period_ns: int) -> NDArray[np.bool_]:
    """Which rows' poses are as old as their recording's usually are."""
    age = rows["stamp_ns"] - rows["pose_stamp_ns"]
    fresh = np.zeros(len(age), np.bool_)
    for recording in np.unique(rows["recording_id"]):
        own = rows["recording_id"] == recording
        fresh[own] = np.abs(age[own] - np.median(age[own])) <= EVEN * period_ns
    return fresh


def _periods(task: Task, seconds: float, name: str) -> int:
    count = round(seconds / task.control_period_s)
    if count < 1 or abs(count * task.control_period_s - seconds) > 1e-6:
        raise ConfigError(
            f"{name} must be a multiple of the control period of {task.control_period_s} s,"
            f" got {seconds}",
            where="segments",
        )
    return count
