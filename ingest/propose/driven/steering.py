"""Whether the robot steers as a car, by how it turned; and what the turn of a Twist was to it.

A robot with two driven sides turns on the spot; one that steers never does, however it is told to.
So where nothing describes the robot, its drive shows: in turns on the spot; in commands for such
turns that it did not follow, though it drove otherwise; or in turns that stop at one circle, the
same at every speed, where it is told to turn tighter. Where it did neither, and was not told to,
its logs do not tell: a robot that only ever drove in wide circles may have two driven sides.

And to a robot that steers the turn of a Twist is a yaw rate, as the message says, or the angle of
its front wheels, as some drivers take it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.ingest.steps.motion import PoseSeries, motion_at
from restock.ingest.task.robot import USUAL_STEERING_RAD
from restock.ingest.task.signals import wrap_angle

TICK_NS = 100_000_000  # between two looks at the motion
KNOWN_S, UNKNOWN_NS = 1.0, 2_000_000_000  # after a pose: its motion is; it is surely not any more
DELAYS_S = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)  # from a command to the motion
SETTLED_S = 1.0  # a command is no older
ANSWERED_S = 0.5  # after its end in which a turn still answers it
SPOT_M = 0.1  # the circle of a turn on the spot, at most: no car is so small
TURNS_RADPS = 0.15  # less is a slope of noise
MIN_PIVOT_S, MIN_PIVOT_RAD = 0.5, 0.5  # of one turn on the spot, and of all
STANDS_MPS, MUCH = 0.02, 0.3  # of a command to turn on the spot; of the sharpest turn that is told
MIN_ASKED_RAD, MIN_SPELLS, FOLLOWS = 2.0, 2, 0.15  # of such commands, how much was followed
MIN_HALF_RAD = 1.0  # … of which following half is turning on the spot
MIN_DRIVEN_M = 0.05  # else it may not have been able to move
MIN_TIGHT, TIGHTER, AS_ONE, SPEEDS = 20, 1.5, 0.25, 1.5
MIN_TURNS = 20  # moments of driving in a turn
WHEELBASES_M = (0.05, 10.0)  # of what drives
WELL, CLEARLY = 0.5, 0.5  # of the turning, left unexplained; of what the other reading leaves


@dataclass(frozen=True)
class DriveEvidence:
    """What drives show of whether their robot steers as a car; `joined` over several drives."""

    driven_m: float = 0.0
    pivoted_rad: float = 0.0  # in turns on the spot
    asked_rad: float = 0.0  # by commands to turn on the spot
    spells: int = 0  # of such commands
    followed_rad: float = 0.0  # of what they asked for
    curved_rad: float = 0.0  # turned while it drove
    tightest_m: float | None = None  # the circle of its tightest turn
    stops_at_m: float | None = None  # … where it was told to turn tighter, whatever its speed

    @property
    def pivots(self) -> bool:
        """It turns on the spot."""
        turned = self.pivoted_rad >= max(MIN_PIVOT_RAD, FOLLOWS * self.asked_rad)
        half = self.asked_rad >= MIN_HALF_RAD and self.followed_rad >= self.asked_rad / 2
        return turned or half

    @property
    def steers(self) -> bool:
        """It does not, and it shows."""
        return not self.pivots and (self._declined or self.stops_at_m is not None)

    @property
    def _declined(self) -> bool:
        """Told to turn on the spot it did not, though it can move."""
        reported = self.asked_rad >= MIN_ASKED_RAD and self.spells >= MIN_SPELLS
        drove = self.driven_m >= MIN_DRIVEN_M
        return reported and drove and self.followed_rad < FOLLOWS * self.asked_rad

    @property
    def turning_m(self) -> float | None:
        """The tightest circle that it drove, where that is its limit."""
        return self.stops_at_m or self.tightest_m

    @property
    def why(self) -> str:
        """What it showed, as the rest of a sentence about the robot."""
        if self.pivots:
            turned = max(self.pivoted_rad, self.followed_rad)
            return f"it turned on the spot, by {turned:.1f} rad in all"
        requested = (
            f"commanded to turn on the spot, by {self.asked_rad:.1f} rad in all, it turned by"
        )
        requested += f" {max(self.followed_rad, 0.0):.1f}"
        if self._declined:
            return f"{requested}, though it drove {self.driven_m:.1f} m"
        if self.stops_at_m is not None:
            return (
                f"commanded to turn tighter, it stayed on circles of {self.stops_at_m:.2g} m and "
                "more"
            )
        if self.asked_rad:
            return f"{requested}: too little to tell"
        turns = f"{self.curved_rad:.1f} rad of turns in {self.driven_m:.1f} m"
        return f"in {turns} it never turned on the spot, and was never commanded to"

    @staticmethod
    def joined(drives: Sequence[DriveEvidence]) -> DriveEvidence:
        """The evidence of several drives of one robot together."""

        def tightest(circles: Sequence[float | None]) -> float | None:
            return min((circle for circle in circles if circle is not None), default=None)

        return DriveEvidence(
            driven_m=sum(one.driven_m for one in drives),
            pivoted_rad=sum(one.pivoted_rad for one in drives),
            asked_rad=sum(one.asked_rad for one in drives),
            spells=sum(one.spells for one in drives),
            followed_rad=sum(one.followed_rad for one in drives),
            curved_rad=sum(one.curved_rad for one in drives),
            tightest_m=tightest([one.tightest_m for one in drives]),
            stops_at_m=tightest([one.stops_at_m for one in drives]),
        )


def drive_evidence(told_s: F64, told_mps: F64, told_radps: F64, poses: PoseSeries) -> DriveEvidence:
    """What one drive shows of whether its robot steers as a car.

    Args:
        told_s, told_mps, told_radps: of the commands (N,), in order, on the clock of `poses`.
        poses: of the robot, from the same 0.
    """
    if len(told_s) < 2 or len(poses) < 3:
        return DriveEvidence()
    changes = np.flatnonzero((np.diff(poses.x_m) != 0) | (np.diff(poses.yaw_rad) != 0))
    pace_s = float(np.median(np.diff(poses.stamp_ns[changes]))) * 1e-9 if len(changes) > 2 else 0.1
    window_s = float(np.clip(3 * pace_s, 0.3, 2.0))  # a pose that is held is no standing still
    ticks = _looks(poses.stamp_ns)
    motion = motion_at(poses, ticks, window_s, KNOWN_S)
    known = motion.problem == ""
    speed, turn = (np.where(known, c, 0.0) for c in (motion.forward_mps, motion.yaw_rate_radps))
    sideways = np.where(known, motion.lateral_mps, 0.0)
    tick_s = TICK_NS * 1e-9
    way = np.hypot(speed, sideways)
    spot = (np.abs(turn) >= TURNS_RADPS) & (way <= SPOT_M * np.abs(turn))
    spot = _spells_of(spot, round(max(MIN_PIVOT_S, window_s) / tick_s))
    sharp = float(np.percentile(np.abs(told_radps), 98))
    fast = float(np.percentile(np.abs(told_mps), 98))
    requested, spells, followed = _on_the_spot(told_s, told_mps, told_radps, poses, sharp)
    drives = (way >= max(0.05, 0.2 * fast)) & (np.abs(speed) >= 0.9 * way)
    moves = (way >= STANDS_MPS) & ~spot
    curves = drives & (np.abs(turn) >= TURNS_RADPS)
    circles = np.abs(speed[curves] / turn[curves])
    middle_s = np.asarray(ticks, np.float64) * 1e-9 - window_s / 2
    return DriveEvidence(
        driven_m=float(way[moves].sum() * tick_s),
        pivoted_rad=float(np.abs(turn[spot]).sum() * tick_s),
        asked_rad=requested,
        spells=spells,
        followed_rad=followed,
        curved_rad=float(np.abs(turn[curves]).sum() * tick_s),
        tightest_m=float(np.percentile(circles, 5)) if len(circles) >= MIN_TURNS else None,
        stops_at_m=_stops_at(told_s, told_mps, told_radps, middle_s, speed, turn, drives),
    )


def _looks(stamp_ns: Ints) -> Ints:
    """Moments TICK_NS apart from the first pose to the last, but those long after one: a single
    message that is logged at the wrong time may lie years before the others."""
    gaps = np.flatnonzero(np.diff(stamp_ns) > UNKNOWN_NS)
    begins = np.concatenate([stamp_ns[:1], stamp_ns[gaps + 1]]) - stamp_ns[0]
    ends = np.concatenate([stamp_ns[gaps] + UNKNOWN_NS, stamp_ns[-1:]]) - stamp_ns[0]
    spans = zip(-(-begins // TICK_NS), -(-ends // TICK_NS), strict=True)
    numbers = np.concatenate([np.arange(*span) for span in spans])
    looks: Ints = stamp_ns[0] + numbers * TICK_NS
    return looks


def _spells_of(flags: Bools, least: int) -> Bools:
    """Only those (T,) of at least so many one after another."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    kept = np.zeros_like(flags)
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        kept[begin:end] = end - begin >= least
    return kept


def _on_the_spot(
    told_s: F64, told_mps: F64, told_radps: F64, poses: PoseSeries, sharp: float
) -> tuple[float, int, float]:
    """How far it was told to turn on the spot (rad), in how many spells, and how far it did."""
    at = np.asarray(poses.stamp_ns * 1e-9, np.float64)
    heading = np.concatenate([[0.0], np.cumsum(wrap_angle(np.diff(poses.yaw_rad)))])
    side = np.sign(told_radps) * (
        (np.abs(told_mps) <= STANDS_MPS) & (np.abs(told_radps) >= max(MUCH * sharp, TURNS_RADPS))
    )
    hold = np.minimum(np.append(np.diff(told_s), SETTLED_S), SETTLED_S)
    begins = np.flatnonzero(np.append(True, np.diff(side) != 0))
    requested, spells, followed = 0.0, 0, 0.0
    for first, behind in zip(begins, np.append(begins[1:], len(side)), strict=True):
        begin, end = told_s[first], told_s[behind - 1] + hold[behind - 1]
        if not side[first] or begin < at[0] or end > at[-1]:
            continue
        turned = np.diff(np.interp([begin, end + ANSWERED_S], at, heading))[0] * side[first]
        requested += float((np.abs(told_radps) * hold)[first:behind].sum())
        followed += float(turned)
        spells += 1
    return requested, spells, followed


def _stops_at(
    told_s: F64, told_mps: F64, told_radps: F64, at_s: F64, speed: F64, turn: F64, drives: Bools
) -> float | None:
    """The circle (m) that it drove at all speeds where it was told to turn tighter.

    A robot whose yaw rate is limited drives wider circles the faster it is.
    """
    row = np.maximum(np.searchsorted(told_s, at_s - 0.2, "right") - 1, 0)
    told_v, told_w = np.abs(told_mps[row]), np.abs(told_radps[row])
    used = drives & (np.abs(turn) >= TURNS_RADPS) & (told_v > STANDS_MPS)
    used &= (told_s[row] <= at_s) & (at_s - told_s[row] < SETTLED_S)
    curved = np.abs(turn[used]) / np.abs(speed[used])
    tight = told_w[used] >= TIGHTER * curved * told_v[used]
    if tight.sum() < MIN_TIGHT:
        return None
    low, middle, high = np.percentile(curved[tight], (10, 50, 90))
    slow, fast = np.percentile(np.abs(speed[used][tight]), (10, 90))
    sharper = np.percentile(curved, 98) > (1 + AS_ONE) * middle  # so it can turn tighter
    if high - low > AS_ONE * 2 * middle or fast < SPEEDS * slow or sharper:
        return None
    return float(1 / middle)


@dataclass(frozen=True)
class TurnReading:
    """What the turn of a Twist is taken for, of a robot that steers as a car."""

    is_angle: bool = False  # of its front wheels; else a yaw rate
    why: str = "as its message defines it: these logs do not show which it is"
    wheelbase_m: float | None = None  # by which the angles explain it best, where none was given
    problem: str = ""  # neither
    too_tight: int = 0  # commands that turn on a smaller circle than it can, as yaw rates
    least_m: float = 0.0  # that circle


def _answers(told_s: F64, turn: F64, poses: PoseSeries) -> Iterator[tuple[F64, F64, F64]]:
    """At each delay what was told (K,), and the speed and the yaw rate with which it drove then."""
    ticks = _looks(poses.stamp_ns)
    window_s = max(0.3, 4e-9 * float(np.median(np.diff(poses.stamp_ns))))
    motion = motion_at(poses, ticks, window_s, KNOWN_S)
    middle_s, speed, turned = ticks * 1e-9 - window_s / 2, motion.forward_mps, motion.yaw_rate_radps
    for delay_s in DELAYS_S:
        index = np.searchsorted(told_s, middle_s - delay_s, "right") - 1
        reported = turn[np.maximum(index, 0)]
        used = (index >= 0) & (motion.problem == "") & (np.abs(speed) > 0.05)
        used &= (middle_s - told_s[np.maximum(index, 0)] < SETTLED_S) & (np.abs(reported) > 0.03)
        if used.sum() >= MIN_TURNS and (turned[used] ** 2).sum() > 0:
            yield reported[used], speed[used], turned[used]


def _as_angles(
    reported: F64, speed: F64, turned: F64, most_rad: float, wheelbase_m: float | None
) -> tuple[float, float]:
    """The wheelbase by which steering angles (K,) explain best how it turned, where none is given;
    and the part of the squared yaw rates that they leave unexplained."""
    by_angle = speed * np.tan(np.clip(reported, -most_rad, most_rad))
    base_m = wheelbase_m or float((by_angle**2).sum() / (turned @ by_angle))
    by_angle /= base_m if base_m > 0 else np.inf
    return base_m, float(((turned - by_angle) ** 2).sum() / (turned**2).sum())


def shown_wheelbase_m(
    told_s: F64, told_rad: F64, poses: PoseSeries, steering_rad: float | None
) -> float | None:
    """The wheelbase by which steering angles (N,) explain how it turned; None where they do not.

    Args:
        told_s, told_rad: of the commands, in order, on the clock of `poses`.
        steering_rad: the largest angle; None: the usual one.
    """
    most = steering_rad or USUAL_STEERING_RAD
    fits = [_as_angles(*answer, most, None) for answer in _answers(told_s, told_rad, poses)]
    base_m, left = min(fits, key=lambda fit: fit[1], default=(0.0, np.inf))
    return base_m if left < WELL and WHEELBASES_M[0] <= base_m <= WHEELBASES_M[1] else None


def turn_reading(
    told_s: F64,
    told_mps: F64,
    turn: F64,
    poses: PoseSeries,
    wheelbase_m: float | None,
    steering_rad: float | None = None,
    least_m: float | None = None,
) -> TurnReading:
    """What the commanded turns (N,) were to a robot that steers, by how it turned.

    Each reading says how fast it should have turned at the speed that it had, within its steering;
    what is left of the squared yaw rates is how badly it explains them.

    Args:
        told_s, told_mps, turn: of the commands, in order, on the clock of `poses`.
        wheelbase_m, steering_rad: of the robot; the angle is the largest, None: the usual one. A
            wheelbase that is None is the one by which the angles explain best how it turned.
        least_m: its tightest circle, where there is no wheelbase.
    """
    most = steering_rad or USUAL_STEERING_RAD
    best, seen, fitted_m = [np.inf, np.inf], 0, wheelbase_m
    least_m = wheelbase_m / float(np.tan(most)) if wheelbase_m else least_m or SPOT_M
    tight = int((np.abs(turn) * least_m > np.abs(told_mps) * 1.01).sum())
    for reported, speed, turned in _answers(told_s, turn, poses):
        seen = max(seen, len(reported))
        sharpest = np.abs(speed) / least_m
        as_rate = np.clip(reported, -sharpest, sharpest)
        base_m, by_angle = _as_angles(reported, speed, turned, most, wheelbase_m)
        by_rate = float(((turned - as_rate) ** 2).sum() / (turned**2).sum())
        fitted_m = base_m if by_angle < best[1] else fitted_m
        best = [min(best[0], by_rate), min(best[1], by_angle)]
    untold = TurnReading(too_tight=tight, least_m=least_m)
    if not seen:
        return untold
    by_rate, by_angle = best
    if min(best) >= 1:
        return TurnReading(problem="neither a yaw rate nor a steering angle explains how it turned")
    told_by = "which leaves {:.0%} of its turning unexplained, and {} {:.0%}"
    if by_angle < WELL and by_angle < CLEARLY * by_rate:
        why = told_by.format(by_angle, "a yaw rate", by_rate)
        return TurnReading(True, why, None if wheelbase_m else fitted_m)
    if by_rate < WELL and by_rate < CLEARLY * by_angle:
        return replace(untold, why=told_by.format(by_rate, "a steering angle", by_angle))
    return untold
