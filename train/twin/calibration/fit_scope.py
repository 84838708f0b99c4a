"""What a log can be asked: which parameters, by which signals, on which segments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import Task
from restock.replay.store.store import Store
from restock.train.twin.calibration.fit_parameters import PARAMETERS
from restock.train.twin.calibration.mismatch import CHANNELS
from restock.train.twin.calibration.segments import BEFORE, POSE, LoggedSegments

TOUCHING_M = 0.05  # nearer to something than this a robot may be touching it
HELD_OUT = 0.25
_ODOMETRY = "nav_msgs/msg/Odometry"
_POSE_TYPES = (
    "PoseWithCovarianceStamped",
    "PoseStamped",
    "TFMessage",
    "Pose",
    "PoseWithCovariance",
)


@dataclass(frozen=True)
class Scope:
    """Parameters and channels that a log can be asked for, and why not the others."""

    names: tuple[str, ...]
    channels: tuple[str, ...]
    refused: dict[str, str]  # parameter -> why it cannot be fitted
    notes: tuple[str, ...]


def scope(store: Store, task: Task, names: Sequence[str], recordings: Sequence[str]) -> Scope:
    """What of `names` the recordings (all, if none is named) can say anything about."""
    refused: dict[str, str] = {}
    notes: list[str] = []
    channels = list(CHANNELS)
    own = load_profile("warehouse_amr").task.body
    if (task.body.length_m, task.body.width_m) != (own.length_m, own.width_m):
        body = f"{task.body.length_m:g} x {task.body.width_m:g} m"
        why = f"the log's robot ({body}) is not the twin's: its mass and its contacts differ"
        refused |= {name: why for name in names if PARAMETERS[name].own_body}
        notes.append(
            f"the log's robot is {body}, the twin's {own.length_m:g} x {own.width_m:g} m with other"
            " wheels, mass and ramps: fitted values are ratios of commanded, wheel and ground"
            " motion, no dimensions of that robot"
        )
    wanted = _recording_filter(recordings)
    stood_in = {row[0] for row in store.sql(
        f"SELECT DISTINCT unnest(stand_ins).input FROM recordings {wanted}"
    ).fetchall()}  # fmt: skip
    if "imu" in stood_in:
        channels.remove("gyro")
        notes.append("no IMU: yaw rate is known from headings alone")
        if "gyro_bias_radps" in names:
            refused["gyro_bias_radps"] = "the log has no gyroscope"
    if _pose_is_odometry(store, wanted):
        channels = [name for name in channels if name not in ("position", "heading")]
        why = "the log's pose is the wheels' odometry: nothing tells the way over ground"
        refused |= {name: why for name in names if name in ("wheel_radius_scale", "friction_scale")}
        notes.append("the pose is odometry: positions and headings are not compared in the fit")
        if "gyro" not in channels and "track_scale" in names:
            refused["track_scale"] = "neither gyroscope nor localisation tells the turn over ground"
    kept = tuple(name for name in names if name not in refused)
    return Scope(kept, tuple(channels), refused, tuple(notes))


def _recording_filter(recordings: Sequence[str]) -> str:
    quoted = ", ".join("'" + name.replace("'", "''") + "'" for name in recordings)
    return f"WHERE recording_id IN ({quoted})" if recordings else ""


def _pose_is_odometry(store: Store, wanted: str) -> bool:
    """Whether, in all recordings, odometry was read and no topic that a localiser publishes."""
    types = [
        {str(kind) for (kind,) in store.sql(
            "SELECT DISTINCT type FROM topics WHERE decoded > 0 AND recording_id ="
            f" '{recording}'"
        ).fetchall()}
        for (recording,) in store.sql(f"SELECT recording_id FROM recordings {wanted}").fetchall()
    ]  # fmt: skip
    return all(
        _ODOMETRY in kinds and not any(kind.endswith(_POSE_TYPES) for kind in kinds - {_GOAL})
        for kinds in types
    )


_GOAL = "geometry_msgs/msg/PoseStamped"  # a goal's type as often as a localiser's


def usable(segments: LoggedSegments) -> tuple[LoggedSegments, dict[str, int]]:
    """Segments that ordinary driving explains, and how many were left out, by reason."""
    touched = segments.signals["bumped"].astype(bool).any(axis=1)
    near = ~touched & (segments.signals["clearance_m"] < TOUCHING_M).any(axis=1)
    # A label is about what the wheels did, also on a floor that is slippery all over.
    told = segments.true_condition != ""
    slips = np.where(told, segments.true_condition, segments.condition) == "wheel_slip"
    slippery = ~touched & ~near & slips.any(axis=1)
    needed = [segments.command.reshape(len(segments), -1)]
    needed += [segments.signals[name] for name in (*POSE, *BEFORE)]
    none = ~np.isfinite(np.concatenate(needed, axis=1)).all(axis=1)
    reasons = {
        "bumped into something": touched,
        f"within {TOUCHING_M:g} m of something": near,
        "on a slippery patch": slippery,
        "signals missing": none & ~touched & ~near & ~slippery,
    }
    left = {reason: int(mask.sum()) for reason, mask in reasons.items() if mask.any()}
    return segments.take(~np.any(list(reasons.values()), axis=0)), left


def cuts(segments: LoggedSegments, share: float, seed: int) -> dict[str, int]:
    """From which stamp on each recording is held out, in ns.

    Of four recordings or more, whole ones; else the last part of each.
    """
    names = np.unique(segments.recording_id)
    never, always = np.iinfo(np.int64).max, np.iinfo(np.int64).min
    if not share:
        return {str(name): never for name in names}
    if len(names) >= 4:
        rng = np.random.Generator(np.random.PCG64(seed))
        held = set(rng.permutation(names)[: max(round(share * len(names)), 1)])
        return {str(name): always if name in held else never for name in names}
    stamps = segments.signals["stamp_ns"]
    found = {}
    for name in names:
        own = stamps[segments.recording_id == name]
        found[str(name)] = int(np.quantile(own[:, 0], 1 - share, method="higher"))
    return found


def sides(
    segments: LoggedSegments, cut: dict[str, int]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which segments (S,) lie wholly before the cut of their recording, and which after it."""
    at = np.array([cut[str(name)] for name in segments.recording_id], np.int64)
    stamps = segments.signals["stamp_ns"]
    return stamps[:, -1] <= at, stamps[:, 0] >= at
