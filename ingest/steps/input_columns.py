"""The inputs of a profile that a recording has, by name: their fields as columns.

Positions are in the fixed frame, relative to the profile's `origin_m`. A pose by latitude and
longitude is projected into that frame, and goals and plans in another frame are transformed by
their `Placement`.

Satellite fixes (NavSatFix, LocationFix) become metres east and north of an origin. Fixes and origin
are converted to earth-centred coordinates on the WGS84 ellipsoid (at height 0), and projected to
the plane that touches it at the origin, x to the east and y to the north (REP 103; NIMA TR8350.2).
Distances within 10 km of the origin are right to 5 mm at that height, and too short by
height / 6,371 km above it: 8 cm per km at 500 m.

A fix has no heading. The heading is that of an IMU, if the profile names one, and otherwise the
direction of the last `track_m` driven. That direction depends only on the past, is held while the
robot stands, and is reversed when the robot backs up.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.errors import RecordingError
from restock.ingest.containers.storage import Fields, Reduction
from restock.ingest.decoding.columns import FieldColumn, Ragged, TopicColumns
from restock.ingest.profile.profile import Profile
from restock.ingest.profile.signal_paths import (
    Convention,
    PathProblem,
    conventions_of,
    element_of,
    factor_of,
    frame_path,
    plain,
    pressed_in,
    read_element,
)
from restock.ingest.profile.tables import Input
from restock.ingest.steps.align import NS
from restock.ingest.steps.clocks import STAMP
from restock.ingest.steps.frames import Placement
from restock.ingest.task.task import yaw_of

EQUATOR_M, FLATTENING = 6_378_137.0, 1 / 298.257223563  # WGS84
COVARIANCES = 9  # entries of a fix's covariance matrix
MAX_STD_M = 5.0  # default limit for a fix's reported standard deviation
TRACK_M = 1.0  # default of `track_m`
_BLOCK = 64
NO_FIX, UNCERTAIN, NOT_DRIVEN, NO_HEADING = (
    *("no fix", "fix too uncertain", "heading unknown until the robot has driven"),
    "no heading yet",
)


@dataclass(frozen=True)
class Fixes:
    """The fixes of one topic (N,), as recorded, in the order of its messages."""

    time_ns: Ints  # log time, which orders the fixes
    latitude_deg: F64
    longitude_deg: F64
    status: F64 | None = None  # below 0: no fix (sensor_msgs/NavSatStatus)
    covariance_m2: F64 | None = None  # (N, 9) matrix over east, north and up, row by row
    covariance_type: F64 | None = None  # 0: unknown
    yaw_rad: F64 | None = None  # yaw by IMU at each fix (NaN: unknown); None: use the track

    def std_m(self) -> F64:
        """Return the larger standard deviation of east and north, (N,); NaN if not reported."""
        std = np.full(len(self.time_ns), np.nan)
        if self.covariance_m2 is not None:
            variance = self.covariance_m2[:, [0, 4]].max(axis=1)
            reported = variance > 0  # False for NaN
            if self.covariance_type is not None:
                reported &= self.covariance_type > 0
            std[reported] = np.sqrt(variance[reported])
        return std

    def problems(self, max_std_m: float) -> NDArray[Any]:
        """Return why each fix is unusable, or "", (N,)."""
        problem = np.full(len(self.time_ns), "", object)
        problem[self.std_m() > max_std_m] = UNCERTAIN
        sane = (np.abs(self.latitude_deg) <= 90) & (np.abs(self.longitude_deg) <= 360)
        sane &= (self.latitude_deg != 0) | (self.longitude_deg != 0)  # 0, 0: no fix
        if self.status is not None:
            sane &= self.status >= 0
        problem[~sane] = NO_FIX
        return problem

    def origin_deg(self, max_std_m: float = MAX_STD_M) -> tuple[float, float] | None:
        """Return latitude and longitude of the first usable fix; None if there is none."""
        good = np.flatnonzero(self.problems(max_std_m) == "")
        if not len(good):
            return None
        first = good[np.argmin(self.time_ns[good])]
        return float(self.latitude_deg[first]), float(self.longitude_deg[first])

    def poses(
        self,
        origin_deg: tuple[float, float] | None = None,
        max_std_m: float | None = None,
        track_m: float | None = None,
    ) -> FixedPoses:
        """Convert the fixes to poses relative to an origin, by default the first usable fix."""
        max_std_m, track_m = max_std_m or MAX_STD_M, track_m or TRACK_M
        problem = self.problems(max_std_m)
        x, y, yaw = np.full((3, len(problem)), np.nan)
        origin = origin_deg or self.origin_deg(max_std_m)
        good = np.flatnonzero(problem == "")
        if origin is not None:
            plane = local_plane_m(self.latitude_deg[good], self.longitude_deg[good], origin)
            x[good], y[good] = plane.T
        if self.yaw_rad is None:
            order = good[np.argsort(self.time_ns[good], kind="stable")]
            yaw[order] = track_yaw(x[order], y[order], track_m)
            problem[good[np.isnan(yaw[good])]] = NOT_DRIVEN
        else:
            yaw[good] = self.yaw_rad[good]
            problem[good[np.isnan(yaw[good])]] = NO_HEADING
        return FixedPoses(x, y, yaw, problem)


def fixes_of(columns: TopicColumns, fields: Mapping[str, str], yaw: F64 | None = None) -> Fixes:
    """Read a topic's fixes from the `fields` of the profile's input; `yaw` is Fixes.yaw_rad."""
    named = {}
    for key, path in fields.items():
        column = columns.fields.get(path)
        if isinstance(column, Ragged) and key == "covariance_m2":  # lists may have any length
            reported = np.flatnonzero(column.lengths == COVARIANCES)
            rows = np.full((len(column), COVARIANCES), np.nan)
            rows[reported] = np.asarray(column.take(reported).values).reshape(-1, COVARIANCES)
            column = rows
        if isinstance(column, np.ndarray):
            named[key] = np.asarray(column, np.float64)
    quality = {key: named.get(key) for key in ("status", "covariance_m2", "covariance_type")}
    latitude, longitude = named["latitude_deg"], named["longitude_deg"]
    return Fixes(columns.log_time_ns, latitude, longitude, **quality, yaw_rad=yaw)


@dataclass(frozen=True)
class FixedPoses:
    """Poses (N,) by fixes or dead reckoning; unknown values are NaN, possibly the yaw alone."""

    x_m: F64  # east of the origin
    y_m: F64  # north of the origin
    yaw_rad: F64  # from the east, counter-clockwise
    problem: NDArray[Any]  # (N,) why the pose is unknown, or ""


def local_plane_m(latitude_deg: F64, longitude_deg: F64, origin_deg: tuple[float, float]) -> F64:
    """Return metres east and north (N, 2) of the origin, on the plane that touches WGS84 there."""
    phi, lam = np.radians(origin_deg)
    away = _earth_centred_m(latitude_deg, longitude_deg) - _earth_centred_m(
        np.array([origin_deg[0]]), np.array([origin_deg[1]])
    )
    east = np.array([-np.sin(lam), np.cos(lam), 0.0])
    north = np.array([-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)])
    return np.stack([away @ east, away @ north], axis=-1)


def _earth_centred_m(latitude_deg: F64, longitude_deg: F64) -> F64:
    """Return coordinates (N, 3) of points on the ellipsoid."""
    phi, lam = np.radians(latitude_deg), np.radians(longitude_deg)
    squared = FLATTENING * (2 - FLATTENING)  # square of the eccentricity
    across = EQUATOR_M / np.sqrt(1 - squared * np.sin(phi) ** 2)
    return np.stack(
        [
            across * np.cos(phi) * np.cos(lam),
            across * np.cos(phi) * np.sin(lam),
            across * (1 - squared) * np.sin(phi),
        ],
        axis=-1,
    )


def track_yaw(x_m: F64, y_m: F64, track_m: float) -> F64:
    """Return the direction of the last `track_m` driven up to each position, (N,), in rad.

    The direction is that from the latest earlier position at least `track_m` away. If there is none
    since the position that gave the last direction, that direction is held. NaN until the robot has
    driven `track_m`. Positions are in order of time.
    """
    # A robot that stands for an hour leaves an hour of near positions. Positions are therefore
    # searched block by block, and a block only if a corner of its bounding box is far enough.
    whole = len(x_m) // _BLOCK * _BLOCK
    boxes = [column[:whole].reshape(-1, _BLOCK) for column in (x_m, y_m)]
    (left, right), (low, high) = ((box.min(axis=1), box.max(axis=1)) for box in boxes)
    yaw = np.full(len(x_m), np.nan)
    held, back = np.nan, 0  # `back` is the position that gave `held`; the search ends there
    for here, (x, y) in enumerate(zip(x_m, y_m, strict=True)):
        first, last = back // _BLOCK, here // _BLOCK
        at = slice(first, last)
        reach = np.hypot(
            np.maximum(x - left[at], right[at] - x), np.maximum(y - low[at], high[at] - y)
        )
        may_be_far = np.flatnonzero(reach >= track_m * (1 - 1e-9)) + first
        for block in (last, *may_be_far[::-1]):
            rows = slice(max(block * _BLOCK, back), min((block + 1) * _BLOCK, here + 1))
            far = np.flatnonzero(np.hypot(x - x_m[rows], y - y_m[rows]) >= track_m)
            if len(far):
                back = rows.start + int(far[-1])
                held = float(np.arctan2(y - y_m[back], x - x_m[back]))
                break
        yaw[here] = held
    return yaw


def reckon(time_ns: Ints, rates: F64, max_gap_s: float) -> FixedPoses:
    """Integrate speed, speed to the left and yaw rate (3, N) to poses (N,), starting at zero.

    Between two messages the robot moves at the mean of their rates; in gaps of more than
    `max_gap_s` it does not move. If a rate of a message is not finite, all its rates count as 0,
    and its pose is NaN.
    """
    order = np.argsort(time_ns, kind="stable")
    known = np.isfinite(rates[:, order]).all(axis=0)
    rates = np.where(known, rates[:, order], 0.0)
    step_s = np.diff(time_ns[order], prepend=time_ns[order][:1]) * 1e-9
    mean = (rates + np.concatenate([rates[:, :1], rates[:, :-1]], axis=1)) / 2
    ahead, aside, turn = mean * np.where(step_s <= max_gap_s, step_s, 0.0)
    yaw = np.cumsum(turn)
    cos, sin = np.cos(yaw - turn / 2), np.sin(yaw - turn / 2)
    poses = np.full((3, len(order)), np.nan)
    found = np.stack(
        [np.cumsum(cos * ahead - sin * aside), np.cumsum(sin * ahead + cos * aside), yaw]
    )
    poses[:, order[known]] = found[:, known]
    return FixedPoses(poses[0], poses[1], poses[2], np.full(len(order), "", object))


class InputColumns:
    """The inputs of a profile that a recording has, and their columns."""

    def __init__(self, profile: Profile, topics: Mapping[str, TopicColumns]) -> None:
        self.topics, self.max_gap_s = topics, profile.clock.max_gap_s
        self.origin_m = np.array(profile.origin_m or (0.0, 0.0))  # origin of all positions
        self.placed: dict[str, Placement] = {}  # input in another frame -> that frame's poses
        self.by_name: dict[str, Input] = {  # inputs whose topic is in the recording
            name: source
            for name, source in profile.sources.items()
            if source.topic in topics and not (source.optional and not len(topics[source.topic]))
        }

    def column(self, name: str, key: str) -> FieldColumn:
        """Return an input's field for `key` as decoded, without conversion of units."""
        source = self.by_name[name]
        fields = self.topics[source.topic].fields
        path, place = element_of(source.fields[key])
        return fields[path] if place is None else read_element(fields, source.fields[key])

    def numbers(self, name: str, key: str) -> F64:
        """Return an input's field for `key`, one number per message (N,), in the unit of `key`."""
        if name == "pose" and key in ("x_m", "y_m"):
            return self._numbers(name, key) - float(self.origin_m["xy".index(key[0])])
        return self._numbers(name, key)

    def _numbers(self, name: str, key: str) -> F64:
        if name == "pose" and self.by_name[name].by_rates and key in ("x_m", "y_m", "yaw_rad"):
            return np.asarray(getattr(self.reckoned, key), np.float64)
        if self.by_name[name].by_fix and key in ("x_m", "y_m", "yaw_rad"):
            return np.asarray(getattr(self.fixed, key), np.float64)
        if key == "yaw_rad" and "orientation" in self.by_name[name].fields:
            return self._yaw(name)
        if key == "yaw_rate_radps" and self.by_name[name].wheelbase_m is not None:
            turn = np.tan(self.numbers(name, "steering_rad")) / self.by_name[name].wheelbase_m
            return self.numbers(name, "speed_mps") * turn
        if key == "pressed":
            return self._pressed(name)
        column = self.column(name, key)
        if isinstance(column, Ragged) or column.ndim != 1 or column.dtype.kind not in "biuf":
            source = self.by_name[name]
            raise RecordingError(
                f"{source.fields[key]!r} of {source.topic} is not one number per message",
                remedy=f"correct `inputs.{name}.fields.{key}` in the profile",
            )
        none = self.no_estimate(name, key)
        column = column * (factor_of(key, self.by_name[name].fields[key]) or 1.0)
        return np.where(none, np.nan, column) if none.any() else np.asarray(column, np.float64)

    def _pressed(self, name: str) -> F64:
        source = self.by_name[name]
        columns = self.topics[source.topic]
        try:
            found = pressed_in(columns.fields, source.fields["pressed"], len(columns))
        except PathProblem as problem:
            raise RecordingError(
                f"{source.fields['pressed']!r} of {source.topic} {problem}",
                remedy=f"correct `inputs.{name}.fields.pressed` in the profile",
            ) from None
        return np.asarray(found, np.float64)

    def no_estimate(self, name: str, key: str) -> Bools:
        """Return which messages (N,) are marked as having no estimate of this field."""
        source = self.by_name[name]
        columns = self.topics[source.topic]
        none = np.zeros(len(columns), np.bool_)
        for rule in _marks(source, source.fields.get(key, "")):
            none |= _flags(columns, rule)
        return none

    def unestimated(self) -> Iterator[tuple[str, str, int, str]]:
        """Yield (input, field, number of messages marked as lacking an estimate, mark in words)."""
        for name, source in self.by_name.items():
            columns = self.topics[source.topic]
            rules = (rule for path in source.fields.values() for rule in _marks(source, path))
            for rule in dict.fromkeys(rules):
                if count := int(_flags(columns, rule).sum()):
                    yield name, rule.values[0], count, rule.words

    def texts(self, name: str) -> list[str]:
        """Return the text of each message of an input."""
        return [str(text) for text in np.asarray(self.column(name, "text"), object)]

    @cached_property
    def fixed(self) -> FixedPoses:
        """Return the pose at each message of [inputs.pose], computed from satellite fixes."""
        source = self.by_name["pose"]
        columns, yaw = self.topics[source.topic], None
        if "heading" in self.by_name:
            yaw = self._heading_at(columns.log_time_ns)
        fixes = fixes_of(columns, source.fields, yaw)
        if (none := self.no_estimate("pose", "latitude_deg")).any():
            fixes = replace(fixes, status=np.where(none, -1.0, 0.0))
        return fixes.poses(source.origin_deg, source.max_std_m, source.track_m)

    @cached_property
    def reckoned(self) -> FixedPoses:
        """Return the pose at each message of [inputs.pose], computed by dead reckoning."""
        columns = self.topics[self.by_name["pose"].topic]
        speed, turn = (self.numbers("pose", key) for key in ("speed_mps", "yaw_rate_radps"))
        aside = np.zeros(len(speed))
        if "sideways_mps" in self.by_name["pose"].fields:
            aside = self.numbers("pose", "sideways_mps")
        time_ns = np.asarray(columns.fields.get(STAMP, columns.log_time_ns), np.int64)
        return reckon(time_ns, np.stack([speed, aside, turn]), self.max_gap_s)

    def _heading_at(self, time_ns: Ints) -> F64:
        """Return the latest heading received at these log times, (N,); NaN if unknown or stale."""
        source = self.by_name["heading"]
        heading_ns, yaw = self.topics[source.topic].log_time_ns, self.numbers("heading", "yaw_rad")
        order = np.argsort(heading_ns, kind="stable")
        heading_ns, yaw = heading_ns[order], yaw[order]
        last = np.searchsorted(heading_ns, time_ns, "right") - 1
        known = last >= 0
        if source.max_age_s is not None and len(heading_ns):
            known &= time_ns - heading_ns[last] <= source.max_age_s * NS
        return np.where(known, yaw[last], np.nan) if len(yaw) else np.full(len(time_ns), np.nan)

    @cached_property
    def plans(self) -> list[F64]:
        """Return the points (P, 2) of each plan; P is 0 if the planner found no plan."""
        x, y = self.column("plan", "x_m"), self.column("plan", "y_m")
        points = [
            np.stack([np.asarray(x[row], np.float64), np.asarray(y[row], np.float64)], axis=-1)
            for row in range(len(x))
        ]
        if "plan" not in self.placed:
            return [plan - self.origin_m for plan in points]
        at = self.placed["plan"]
        return [
            plan @ at.rotation[row, :2, :2].T + at.translation_m[row, :2] - self.origin_m
            for row, plan in enumerate(points)
        ]

    @cached_property
    def goals(self) -> F64:
        """Return the goals (G, 2)."""
        goals = np.stack([self.numbers("goal", axis) for axis in ("x_m", "y_m")], axis=1)
        if "goal" not in self.placed:
            return np.asarray(goals - self.origin_m)
        at = self.placed["goal"]
        turned = np.einsum("nij,nj->ni", at.rotation[:, :2, :2], goals)
        return np.asarray(turned + at.translation_m[:, :2] - self.origin_m)

    def frames_of(self, name: str) -> list[str]:
        """Return the frame of each message of an input; empty if messages do not name one."""
        source = self.by_name.get(name)
        fields = {} if source is None else self.topics[source.topic].fields
        path = None if source is None else frame_path(source, fields)
        if path is None:
            return []
        frames = [str(one) for one in np.asarray(fields[path], object)]
        names = {frame: plain(frame) for frame in set(frames)}
        return [names[frame] for frame in frames]

    def _yaw(self, name: str) -> F64:
        """Return the yaw of an input's quaternions by `yaw_of`, (N,); NaN without an estimate."""
        source = self.by_name[name]
        fields = self.topics[source.topic].fields
        path = source.fields["orientation"]
        x, y, z, w = (np.asarray(fields[f"{path}.{axis}"], np.float64) for axis in "xyzw")
        none = self.no_estimate(name, "orientation")
        return np.where(none, np.nan, yaw_of(x, y, z, w)) if none.any() else yaw_of(x, y, z, w)


def estimate_reduction(sources: Iterable[Input], fields: Collection[str]) -> Reduction | None:
    """Build the reduction that flags messages without an estimate of a field that an input reads.

    None if messages with these `fields` cannot say that they have no estimate.
    """
    rules = list(
        dict.fromkeys(
            rule
            for source in sources
            for path in source.fields.values()
            for rule in _marks(source, path)
            if set(rule.fields) <= set(fields)
        )
    )
    if not rules:
        return None

    def apply(columns: Fields) -> dict[str, FieldColumn]:
        return {_key(rule): rule.flags(columns) for rule in rules}

    return Reduction(tuple(dict.fromkeys(path for rule in rules for path in rule.fields)), apply)


def _marks(source: Input, path: str) -> list[Convention]:
    return [rule for rule in conventions_of(source.type, path) if rule.of_messages]


def _key(rule: Convention) -> str:
    """Return the name of a column of flags; it has spaces, so as not to clash with fields."""
    return f"no estimate of {rule.values[0]}"


def _flags(columns: TopicColumns, rule: Convention) -> Bools:
    """Return which messages (N,) a convention marks; all False if its fields were not read."""
    if _key(rule) in columns.fields:
        return np.asarray(columns.fields[_key(rule)], np.bool_)
    if set(rule.fields) <= columns.fields.keys():  # fields were read, not flags
        return rule.flags(columns.fields)
    return np.zeros(len(columns), np.bool_)
