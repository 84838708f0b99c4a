"""Tracks of people and forklifts that move near the robot, from past and present scans.

    tracker = Tracker(task, robots=1)
    tracker.begin(np.array([0]), signals, scan_m, scan_stamp_ns)  # the first step of an episode
    tracks = tracker.update(signals, scan_m, scan_stamp_ns)  # each later step: TRACK_SIGNALS

A return is **moving** if an earlier scan saw farther in its direction: the place was free .4 or 1 s
ago. It is **static** if an earlier scan had a return there. Otherwise it is new, for example behind
a corner. Neighbouring returns that are not static form a detection. Detections and tracks are
matched by distance, nearest first. Each track is a Kalman filter with constant velocity, and its
own uncertainty along and across the line of sight. A track is reported once it was seen moving in
several scans and has covered some distance. It is dropped if it is lost or stands for some time.

Positions are in the odometry frame: wheels and gyroscope, or the localised speed if the wheels
slip. The same code runs on logs, live and in the twin, for all robots at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.ingest.task.task import TRACK_SIGNALS, Signals, Task
from restock.state import Stateful

SECTORS = 240  # sectors of bearing, 1.5 degrees each; the nearest return of each is kept
AROUND = 3  # a place is compared with this many sectors to either side (two beams of 5 degrees)
RANGE_M = 5.0  # nothing farther is tracked
LAGS_S = (0.4, 1.0)  # ages of the earlier scans that a return is compared with
FREE_M = 0.25  # a place was free if an earlier scan saw farther by more than this
SAME_M = 0.2  # largest distance from an earlier return of the same object
APART_M = 0.35  # largest gap between returns of one object, beyond the spacing of the beams
LEFT_M, SMALL_M = 0.9, 1.0  # who walks away is this near to the place left, and this narrow
WIDEST_M = 3.0  # widest detection; wider ones are walls or errors of the odometry
INSIDE_M = 0.2  # distance from a person's visible side to their middle
MANY = 0.5  # if more than this share of a scan's returns moves, the odometry is wrong
ACCEL_MPS2 = 1.0  # standard deviation of people's acceleration
SPEED_MPS = 1.0  # standard deviation of a new track's speed
FASTEST_MPS = 3.0
GATE_M, WIDEST_GATE_M = 0.4, 1.0
CONFIRM_SCANS, CONFIRM_S, CONFIRM_M = 3, 0.4, 0.25  # scans in motion, age, way that confirm a track
HIDDEN_S, LOST_S = 0.5, 0.8  # time unseen after which a track is not reported, and dropped
STANDING_S = 3.0  # time without motion after which a track is dropped
STANDING_MPS = 0.3  # a track that is faster, and not static, counts as moving
STOPPED_MPS = 0.5  # a track that is slower may be matched with static returns
SLIP_MPS = 0.15  # if wheel and localised speed differ by more, the wheels slip

# Columns of the array of tracks: the robot, position and velocity (odometry frame), variances of
# position and velocity and their covariance along the line of sight and across it, seconds since
# it was first seen, last seen and last moving, scans in which it moved, its first position, and
# whether it is confirmed.
_COLUMNS = 18
(_ROBOT, _X, _Y, _VX, _VY, _PR, _CR, _WR, _PT, _CT, _WT, _AGE, _MISSED, _STILL, _HITS, _X0, _Y0) = (
    range(_COLUMNS - 1)
)
_SURE = _COLUMNS - 1

_WIDTH_RAD = 2 * np.pi / SECTORS
_BEARINGS = (np.arange(SECTORS) + 0.5) * _WIDTH_RAD - np.pi


class Lidar:
    """The beams of a lidar, which reduces its scans to the nearest return of each sector."""

    def __init__(self, bearings_rad: F64, from_m: tuple[float, float] = (0.0, 0.0)) -> None:
        """Take the beams' bearings (B,) in the body's frame.

        `from_m` is the lidar's position, ahead and left of the point that sectors are seen from.
        """
        self._bearings, self._from_m = bearings_rad, from_m
        self._sector = _sector(bearings_rad)
        self._alone = len(set(self._sector.tolist())) == len(bearings_rad)

    def scan(self, ranges_m: F64, range_min_m: float) -> F64:
        """Reduce ranges (N, B) to the nearest return of each sector (N, SECTORS), m; inf: none."""
        with np.errstate(invalid="ignore"):
            ranges = np.where(ranges_m >= range_min_m, ranges_m, np.inf)  # NaN becomes inf, too
        scan_m = np.full((len(ranges), SECTORS), np.inf)
        if self._alone and not any(self._from_m):
            scan_m[:, self._sector] = ranges
            return scan_m
        row, beam = np.nonzero(ranges < np.inf)
        distance, sector = ranges[row, beam], self._sector[beam]
        if any(self._from_m):
            x = self._from_m[0] + distance * np.cos(self._bearings)[beam]
            y = self._from_m[1] + distance * np.sin(self._bearings)[beam]
            distance, sector = np.hypot(x, y), _sector(np.arctan2(y, x))
        np.minimum.at(scan_m, (row, sector), distance)
        return scan_m


def _sector(bearing_rad: F64) -> NDArray[np.intp]:
    return ((bearing_rad + np.pi) / _WIDTH_RAD).astype(np.intp) % SECTORS


@dataclass(frozen=True)
class _Detections:
    """D detected objects, in the odometry frame."""

    robot: Ints  # (D,)
    x_m: F64  # (D,) middle of the object: the mean of its returns, moved INSIDE_M farther away
    y_m: F64
    along_x: F64  # (D,) unit vector of the line of sight
    along_y: F64
    across_m: F64  # (D,) standard deviation of the position across the line of sight
    moving: Ints  # (D,) number of returns that move
    still: Bools  # (D,) whether the object consists of static returns

    def at(self, of: Bools) -> _Detections:
        """Select detections by a mask (D,)."""
        return _Detections(
            *(self.robot[of], self.x_m[of], self.y_m[of], self.along_x[of], self.along_y[of]),
            *(self.across_m[of], self.moving[of], self.still[of]),
        )


class Tracker(Stateful):
    """The tracks of N robots."""

    STATE = (
        *("tracks", "pose", "rates", "stamp_ns", "scan_stamp_ns", "scan_m", "low", "high"),
        "seen_from",
    )

    def __init__(self, task: Task, robots: int = 1) -> None:
        self.task, self.count = task, task.tracks or 0
        self._steps = [max(round(lag / task.control_period_s), 1) - 1 for lag in LAGS_S]
        steps = self._steps[-1] + 1
        self.tracks = np.zeros((0, _COLUMNS))
        self.pose = np.zeros((robots, 3))  # x, y, yaw by odometry
        self.rates = np.zeros((robots, 3))  # forward and sideways speed, yaw rate
        self.stamp_ns = np.zeros(robots, np.int64)
        self.scan_stamp_ns = np.zeros(robots, np.int64)
        # For each earlier step, newest first: each sector's nearest return, the nearest and
        # farthest return around it, and the pose that they were seen from.
        self.scan_m = [np.full((robots, SECTORS), np.inf) for _ in range(steps)]
        self.low = [np.full((robots, SECTORS), np.inf) for _ in range(steps)]
        self.high = [np.full((robots, SECTORS), -np.inf) for _ in range(steps)]
        self.seen_from = [np.zeros((robots, 3)) for _ in range(steps)]

    def begin(self, ids: Ints, now: Signals, scan_m: F64, scan_stamp_ns: Ints) -> Signals:
        """Begin episodes of robots `ids` (n,) with their signals and scans; return no tracks."""
        self.tracks = self.tracks[~np.isin(self.tracks[:, _ROBOT], ids)]
        self.pose[ids] = 0.0
        self.rates[ids] = _rates(now)
        self.stamp_ns[ids], self.scan_stamp_ns[ids] = now["stamp_ns"], scan_stamp_ns
        for scan, low, high in zip(self.scan_m, self.low, self.high, strict=True):
            scan[ids], low[ids], high[ids] = np.inf, np.inf, -np.inf
        self.scan_m[0][ids], (self.low[0][ids], self.high[0][ids]) = scan_m, _around(scan_m)
        self.seen_from[0][ids] = self._scanned_at(ids, scan_stamp_ns)
        return {name: np.full((len(ids), self.count), np.nan) for name in TRACK_SIGNALS}

    def update(self, now: Signals, scan_m: F64, scan_stamp_ns: Ints) -> Signals:
        """Add the next step of all N robots; return their nearest tracks (N, K), NaN if fewer.

        Args:
            now: the signals at the step.
            scan_m: (N, SECTORS) the latest scans, from `Lidar.scan`.
            scan_stamp_ns: (N,) when they were measured, at or before `stamp_ns`.
        """
        self._drive(now)
        fresh = scan_stamp_ns > self.scan_stamp_ns
        elapsed_s = (scan_stamp_ns - self.scan_stamp_ns) * 1e-9
        self.scan_stamp_ns = np.maximum(scan_stamp_ns, self.scan_stamp_ns)
        seen_from = self._scanned_at(np.arange(len(fresh)), self.scan_stamp_ns)
        low, high = _around(scan_m)
        if not fresh.all():  # lidars slower than the steps repeat their scans
            old = ~fresh
            low[old], high[old] = self.low[0][old], self.high[0][old]
            scan_m, seen_from[old] = scan_m.copy(), self.seen_from[0][old]
            scan_m[old] = self.scan_m[0][old]
        if fresh.any():
            found, still = self._detect(scan_m, low, seen_from, fresh)
            self._predict(np.where(fresh, elapsed_s, 0.0))
            self._match(found, still, seen_from)
        for kept, latest in (
            *((self.scan_m, scan_m), (self.low, low)),
            *((self.high, high), (self.seen_from, seen_from)),
        ):
            kept.insert(0, latest)
            kept.pop()
        return self._nearest()

    def _drive(self, now: Signals) -> None:
        """Move the robots by odometry to the time of `now`."""
        rates = _rates(now)
        elapsed_s = (now["stamp_ns"] - self.stamp_ns) * 1e-9
        self.pose = _moved(self.pose, (self.rates + rates) / 2, elapsed_s)
        self.rates, self.stamp_ns = rates, now["stamp_ns"].copy()

    def _scanned_at(self, ids: Ints, scan_stamp_ns: Ints) -> F64:
        """Return the robots' poses when their scans were measured, (n, 3)."""
        ago_s = (self.stamp_ns[ids] - scan_stamp_ns) * 1e-9
        return _moved(self.pose[ids], self.rates[ids], -ago_s)

    def _detect(
        self, scan_m: F64, low: F64, seen_from: F64, fresh: Bools
    ) -> tuple[_Detections, F64]:
        """Return detections in scans (N, SECTORS), and robot, x and y of static returns (P, 3)."""
        robot, sector, x, y = self._places(scan_m, seen_from, fresh)
        distance = scan_m[robot, sector]
        moving, static = np.zeros((2, len(robot)), np.bool_)
        unknown = np.arange(len(robot))
        for step in reversed(self._steps):  # scan of 1 s ago; if that is undecided, of .4 s ago
            low_m, high_m, then_m = self._seen(
                *(robot[unknown], x[unknown], y[unknown]),
                *(self.low[step], self.high[step], self.seen_from[step]),
            )
            free = (low_m > then_m + FREE_M) & (low_m < np.inf)
            same = (low_m < then_m + SAME_M) & (high_m > then_m - SAME_M)
            moving[unknown[free]], static[unknown[same]] = True, True
            unknown = unknown[~free & ~same]
        # If most returns seem to move, the odometry is wrong: treat all as static.
        total = np.bincount(robot, minlength=len(scan_m))
        astray = np.bincount(robot[moving], minlength=len(scan_m)) > MANY * np.maximum(total, 8)
        if astray.any():
            static |= astray[robot]
            moving &= ~static
        fixed = np.stack([robot[static], x[static], y[static]], axis=1)
        kept = ~static
        spacing = np.full(len(robot), SECTORS)
        apart = np.where(robot[1:] == robot[:-1], sector[1:] - sector[:-1], SECTORS)
        spacing[1:], spacing[:-1] = apart, np.minimum(spacing[:-1], apart)
        spacing = np.minimum(spacing, SECTORS // 45)  # wider gaps hold missing returns
        apart_m = APART_M + spacing * _WIDTH_RAD * distance
        joined = np.zeros(len(robot), np.bool_)
        joined[1:] = kept[1:] & kept[:-1] & (robot[1:] == robot[:-1])
        joined[1:] &= np.hypot(x[1:] - x[:-1], y[1:] - y[:-1]) < np.minimum(apart_m[1:], 0.8)
        kind = np.cumsum(~joined)[kept]
        if not len(kind):
            none: F64 = np.zeros(0)
            nobody = _Detections(robot[:0], none, none, none, none, none, robot[:0], moving[:0])
            return nobody, fixed
        robot, x, y, moving = robot[kept], x[kept], y[kept], moving[kept]
        starts = np.flatnonzero(np.diff(kind, prepend=-1))
        size = np.diff(starts, append=len(kind))
        ends = starts + size - 1
        wide = np.hypot(x[ends] - x[starts], y[ends] - y[starts])
        middle_x = np.add.reduceat(x, starts) / size
        middle_y = np.add.reduceat(y, starts) / size
        of = robot[starts]
        along_x = middle_x - seen_from[of, 0]
        along_y = middle_y - seen_from[of, 1]
        away = np.maximum(np.hypot(along_x, along_y), 1e-6)
        along_x, along_y = along_x / away, along_y / away
        few = wide < WIDEST_M
        moves = np.add.reduceat(moving.astype(np.int64), starts)
        if (moves == 0).any():  # if such an object walks away, the place it left is free now
            left = self._vacated(low, seen_from, fresh)
            from_it = np.hypot(middle_x[:, None] - left[:, 1], middle_y[:, None] - left[:, 2])
            near = (from_it < LEFT_M) & (of[:, None] == left[:, 0])
            moves += (wide < SMALL_M) * near.sum(axis=1)
        across = 0.35 * spacing[kept][starts] * _WIDTH_RAD * away + 0.04
        inside_x, inside_y = middle_x + INSIDE_M * along_x, middle_y + INSIDE_M * along_y
        found = _Detections(of, inside_x, inside_y, along_x, along_y, across, moves, ~few)
        return found.at(few), fixed

    def _places(self, scan_m: F64, seen_from: F64, of: Bools) -> tuple[Ints, Ints, F64, F64]:
        """Return robot, sector, x and y of the returns in range of robots selected by `of` (N,)."""
        robot, sector = np.nonzero((scan_m < RANGE_M) & of[:, None])
        distance, pose = scan_m[robot, sector], seen_from[robot]
        cos, sin = np.cos(seen_from[:, 2])[robot], np.sin(seen_from[:, 2])[robot]
        ahead = distance * _COS[sector] + self.task.body.lidar_x_m
        left = distance * _SIN[sector]
        x, y = pose[:, 0] + cos * ahead - sin * left, pose[:, 1] + sin * ahead + cos * left
        return robot, sector, x, y

    def _seen(
        self, robot: Ints, x: F64, y: F64, low: F64, high: F64, seen_from: F64
    ) -> tuple[F64, F64, F64]:
        """Return a scan's nearest and farthest return toward each place, and the place's distance.

        Each is (P,), for places (P,) in the odometry frame.
        """
        cos, sin = np.cos(seen_from[:, 2])[robot], np.sin(seen_from[:, 2])[robot]
        off_x, off_y = x - seen_from[robot, 0], y - seen_from[robot, 1]
        ahead = cos * off_x + sin * off_y - self.task.body.lidar_x_m
        left = -sin * off_x + cos * off_y
        sector = _sector(np.arctan2(left, ahead))
        return low[robot, sector], high[robot, sector], np.hypot(ahead, left)

    def _vacated(self, low: F64, seen_from: F64, fresh: Bools) -> F64:
        """Return robot, x and y (V, 3) of returns of 1 s ago that the current scan sees past."""
        robot, _, x, y = self._places(self.scan_m[-1], self.seen_from[-1], fresh)
        low_m, _, now_m = self._seen(robot, x, y, low, low, seen_from)
        gone = (low_m > now_m + FREE_M) & (low_m < np.inf)
        return np.stack([robot[gone], x[gone], y[gone]], axis=1)

    def _predict(self, elapsed_s: F64) -> None:
        tracks = self.tracks
        dt = elapsed_s[tracks[:, _ROBOT].astype(np.int64)]
        tracks[:, _X] += dt * tracks[:, _VX]
        tracks[:, _Y] += dt * tracks[:, _VY]
        noise = ACCEL_MPS2**2
        for position, both, speed in ((_PR, _CR, _WR), (_PT, _CT, _WT)):
            tracks[:, position] += dt * (2 * tracks[:, both] + dt * tracks[:, speed])
            tracks[:, position] += noise * dt**4 / 4
            tracks[:, both] += dt * tracks[:, speed] + noise * dt**3 / 2
            tracks[:, speed] += noise * dt**2
        tracks[:, [_AGE, _MISSED, _STILL]] += dt[:, None]

    def _match(self, found: _Detections, still: F64, seen_from: F64) -> None:
        """Correct tracks by the nearest detections, drop lost tracks, and add new ones."""
        tracks = self.tracks
        of = tracks[:, _ROBOT].astype(np.int64)
        gate = np.sqrt(np.maximum(tracks[:, _PR], tracks[:, _PT]))
        gate = np.minimum(GATE_M + 2 * gate, WIDEST_GATE_M)
        away = np.hypot(
            tracks[:, _X, None] - found.x_m[None], tracks[:, _Y, None] - found.y_m[None]
        )
        near = (of[:, None] == found.robot[None]) & (away < gate[:, None])
        track, thing = np.nonzero(near)
        order = np.argsort(away[track, thing], kind="stable")
        taken, used = set[int](), set[int]()
        pairs = []
        for row, detection in zip(track[order].tolist(), thing[order].tolist(), strict=True):
            if row not in taken and detection not in used:
                taken.add(row)
                used.add(detection)
                pairs.append((row, detection))
        if pairs:
            rows, things = np.array(pairs).T
            self._correct(rows, found, things)
        self._correct_standing(sorted(set(range(len(tracks))) - taken), still, seen_from)
        # Unmatched detections near a track are part of its object, and start no track.
        free = np.ones(len(found.robot), np.bool_)
        free[sorted(used)] = False
        if len(tracks):
            free &= ~near.any(axis=0)
        new = np.flatnonzero(free & (found.moving > 0))
        self._drop()
        if len(new):
            self._add(new, found)

    def _correct(self, rows: Ints, found: _Detections, things: Ints) -> None:
        tracks = self.tracks
        off_x, off_y = found.x_m[things] - tracks[rows, _X], found.y_m[things] - tracks[rows, _Y]
        along_x, along_y = found.along_x[things], found.along_y[things]
        moved_x, moved_y, faster_x, faster_y = np.zeros((4, len(rows)))
        for position, both, speed, way_x, way_y, noise_m in (
            (_PR, _CR, _WR, along_x, along_y, 0.06),
            (_PT, _CT, _WT, -along_y, along_x, found.across_m[things]),
        ):
            off = off_x * way_x + off_y * way_y
            total = tracks[rows, position] + noise_m**2
            gain, gain_speed = tracks[rows, position] / total, tracks[rows, both] / total
            moved_x, moved_y = moved_x + gain * off * way_x, moved_y + gain * off * way_y
            faster_x = faster_x + gain_speed * off * way_x
            faster_y = faster_y + gain_speed * off * way_y
            tracks[rows, speed] -= gain_speed * tracks[rows, both]
            tracks[rows, both] *= 1 - gain
            tracks[rows, position] *= 1 - gain
        tracks[rows, _X] += moved_x
        tracks[rows, _Y] += moved_y
        speed_x, speed_y = tracks[rows, _VX] + faster_x, tracks[rows, _VY] + faster_y
        slower = FASTEST_MPS / np.maximum(np.hypot(speed_x, speed_y), FASTEST_MPS)
        tracks[rows, _VX], tracks[rows, _VY] = speed_x * slower, speed_y * slower
        tracks[rows, _MISSED] = 0.0
        moves = found.moving[things] > 0
        tracks[rows[moves], _HITS] += 1
        # Someone who walks away is never seen at a place that was free: speed is motion, too.
        moves |= ~found.still[things] & (np.hypot(speed_x, speed_y) > STANDING_MPS)
        tracks[rows[moves], _STILL] = 0.0

    def _correct_standing(self, rows: list[int], still: F64, seen_from: F64) -> None:
        """Correct unmatched slow tracks by static returns: these are people who stopped."""
        for row in rows:
            robot, x, y, vx, vy = self.tracks[row, :5].tolist()
            if not self.tracks[row, _SURE] or np.hypot(vx, vy) > STOPPED_MPS:
                continue
            own = still[still[:, 0] == robot, 1:]
            near = own[np.hypot(own[:, 0] - x, own[:, 1] - y) < APART_M]
            if len(near):
                place = near.mean(axis=0)
                along = place - seen_from[int(robot), :2]
                along /= max(float(np.hypot(*along)), 1e-6)
                place = place + INSIDE_M * along
                x_m, y_m, along_x, along_y, across_m = np.array([[*place, *along, 0.1]]).T
                whose, moves = np.array([int(robot)]), np.array([0])
                thing = _Detections(
                    whose, x_m, y_m, along_x, along_y, across_m, moves, np.array([True])
                )
                self._correct(np.array([row]), thing, np.array([0]))

    def _drop(self) -> None:
        tracks = self.tracks
        if not len(tracks):
            return
        moved_m = np.hypot(tracks[:, _X] - tracks[:, _X0], tracks[:, _Y] - tracks[:, _Y0])
        sure = (tracks[:, _HITS] >= CONFIRM_SCANS) & (tracks[:, _AGE] >= CONFIRM_S)
        tracks[sure & (moved_m >= CONFIRM_M), _SURE] = 1.0
        unsure = tracks[:, _SURE] == 0
        lost = (tracks[:, _MISSED] > LOST_S) | (tracks[:, _STILL] > STANDING_S)
        lost |= unsure & ((tracks[:, _MISSED] > LOST_S / 3) | (tracks[:, _STILL] > LOST_S))
        self.tracks = tracks[~lost]

    def _add(self, new: Ints, found: _Detections) -> None:
        added = np.zeros((len(new), _COLUMNS))
        added[:, _ROBOT] = found.robot[new]
        added[:, _X] = added[:, _X0] = found.x_m[new]
        added[:, _Y] = added[:, _Y0] = found.y_m[new]
        added[:, _PR], added[:, _PT] = 0.06**2, found.across_m[new] ** 2
        added[:, _WR] = added[:, _WT] = SPEED_MPS**2
        added[:, _HITS] = 1
        self.tracks = np.concatenate([self.tracks, added])

    def _nearest(self) -> Signals:
        """Return each robot's nearest confirmed tracks (N, K), in its body frame at the step."""
        count = len(self.pose)
        signals = {name: np.full((count, self.count), np.nan) for name in TRACK_SIGNALS}
        tracks = self.tracks
        shown = tracks[(tracks[:, _SURE] > 0) & (tracks[:, _MISSED] <= HIDDEN_S)]
        if not len(shown):
            return signals
        of = shown[:, _ROBOT].astype(np.int64)
        since_s = (self.stamp_ns - self.scan_stamp_ns)[of] * 1e-9
        x = shown[:, _X] + since_s * shown[:, _VX] - self.pose[of, 0]
        y = shown[:, _Y] + since_s * shown[:, _VY] - self.pose[of, 1]
        order = np.lexsort([np.hypot(x, y), of])
        of, x, y, shown = of[order], x[order], y[order], shown[order]
        place = np.arange(len(of)) - np.searchsorted(of, of)
        kept = place < self.count
        of, place, x, y, shown = of[kept], place[kept], x[kept], y[kept], shown[kept]
        cos, sin = np.cos(self.pose[of, 2]), np.sin(self.pose[of, 2])
        speed_x, speed_y = shown[:, _VX], shown[:, _VY]
        values = (
            *(cos * x + sin * y, -sin * x + cos * y),
            *(cos * speed_x + sin * speed_y, -sin * speed_x + cos * speed_y),
            shown[:, _AGE] + since_s[order][kept],
        )
        for name, value in zip(TRACK_SIGNALS, values, strict=True):
            signals[name][of, place] = value
        return signals


_COS, _SIN = np.cos(_BEARINGS), np.sin(_BEARINGS)


def _rates(now: Signals) -> F64:
    """Return forward and sideways speed and yaw rate of robots, (n, 3)."""
    wheels, localised = now["wheel_speed_mps"], now["localised_speed_mps"]
    lateral = now["localised_lateral_mps"]
    slips = np.abs(wheels - localised) > SLIP_MPS
    forward = np.where(slips, localised, wheels)
    sideways = np.where(np.abs(lateral) > SLIP_MPS, lateral, 0.0)
    return np.stack([forward, sideways, now["gyro_yaw_rate_radps"]], axis=1)


def _moved(pose: F64, rates: F64, elapsed_s: NDArray[Any]) -> F64:
    """Return poses (n, 3) after `elapsed_s` at constant rates, moved along the mean heading."""
    forward, left, turn = (rates * elapsed_s[:, None]).T
    heading = pose[:, 2] + turn / 2
    cos, sin = np.cos(heading), np.sin(heading)
    moved = pose.copy()
    moved[:, 0] += cos * forward - sin * left
    moved[:, 1] += sin * forward + cos * left
    moved[:, 2] += turn
    return moved


def _around(scan_m: F64) -> tuple[F64, F64]:
    """Return the nearest and farthest return (N, SECTORS) within AROUND sectors of each sector."""
    padded = np.concatenate([scan_m[:, -AROUND:], scan_m, scan_m[:, :AROUND]], axis=1)
    low, high = padded, np.where(padded < np.inf, padded, -np.inf)
    width = 1
    while width < 2 * AROUND + 1:  # widen the windows by joining two that overlap or touch
        step = min(width, 2 * AROUND + 1 - width)
        low = np.minimum(low[:, :-step], low[:, step:])
        high = np.maximum(high[:, :-step], high[:, step:])
        width += step
    return low, high
