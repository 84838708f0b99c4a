"""How long a command holds, read from what the robot did where the next one was late.

Some drivers stop a robot that hears nothing for half a second; others drive on until they are told
otherwise. Where commands come seldom that decides the row count, so it is read from the poses: of
every gap after a command to move, whether the robot still moved when the gap ended, or since when
it stood. A command to stop holds until the next one whatever the driver does.

And how fast the robot really went where it was commanded to go fastest: a driver scales down or
cuts off what its wheels cannot do. Commands beyond that are no actions of the robot: a twin that
obeyed them would not move as the robot did.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from restock.arrays import F64
from restock.ingest.steps.motion import PoseSeries
from restock.ingest.task.signals import wrap_angle

MIN_GAP_S = 0.4  # shorter ones say little
WITHIN_S = 0.5  # that a robot has moved in, at the end of a gap
MOVES = 0.25  # of what was commanded: less is standing
STANDS_M, STANDS_RAD = 0.05, 0.2  # within a gap after a command to stop
MAX_S = 60.0
MAX_GAP_S = 3600.0  # between two commands; longer: their log times are wrong
SETTLED_S = 1.0  # commanded so fast for so long: latency and ramp are over
NEARLY = 0.8  # of the fastest command counts as it
MIN_SAMPLES = 10
HELD_BACK = 0.67  # of what was commanded: a robot that stays below has reached its limit


@dataclass(frozen=True)
class CommandHold:
    """What a recording shows of how long its robot goes on with a command; in log time."""

    age_s: float | None = None  # None: nothing is known
    stops_hold: bool = False  # a command to stop holds until the next
    comments: tuple[str, ...] = ()


def command_hold(
    time_s: F64, speed_mps: F64, yaw_rate_radps: F64, poses: PoseSeries
) -> CommandHold:
    """What the gaps between commands (N,) show; `poses` are on the same clock, from the same 0."""
    at = np.asarray(poses.stamp_ns * 1e-9, np.float64)
    if not len(time_s) or len(at) < 2:
        return CommandHold()
    turned = np.concatenate([[0.0], np.cumsum(wrap_angle(np.diff(poses.yaw_rad)))])
    # The way, summed up: a robot that comes back to where it was has moved.
    way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(poses.x_m), np.diff(poses.y_m)))])
    within = max(WITHIN_S, 3 * float(np.median(np.diff(at))))
    ends = np.append(time_s[1:], at[-1])
    on, stopped, stood, went = [], [], 0, 0
    for begin, end, speed, turn in zip(time_s, ends, speed_mps, yaw_rate_radps, strict=True):
        if not MIN_GAP_S <= end - begin <= MAX_GAP_S or at[0] > begin or at[-1] < end - within:
            continue
        if speed == 0 and turn == 0:
            settled = min(begin + 1.0, end)  # it brakes first
            moved = [float(np.ptp(np.interp([settled, end], at, c))) for c in (way, turned)]
            still = moved[0] <= STANDS_M and moved[1] <= STANDS_RAD
            stood, went = stood + still, went + (not still)
            continue
        moving = _last_moving(at, way, turned, begin, end, speed, turn, within)
        if moving is None:
            continue  # it never began to: held up, or not this robot's command
        if moving >= end - within / 2:
            on.append(end - begin)
        else:
            stopped.append(moving - begin)
    return _judge(on, stopped, stood, went)


def _last_moving(
    at: F64,
    way: F64,
    turned: F64,
    begin: float,
    end: float,
    speed: float,
    turn: float,
    within: float,
) -> float | None:
    """Until when in a gap the robot did a good part of what the command says; None: never."""
    checked = np.arange(min(begin + within, end), end + 1e-9, within / 4)
    checked = np.append(checked, end)
    since = np.maximum(checked - within, begin)
    span = np.maximum(checked - since, 1e-3)
    gone = (np.interp(checked, at, way) - np.interp(since, at, way)) / span
    spun = (np.interp(checked, at, turned) - np.interp(since, at, turned)) / span
    drives = gone >= MOVES * abs(speed) if speed else spun * np.sign(turn) >= MOVES * abs(turn)
    # Poses that stay away for longer say nothing.
    seen = np.searchsorted(at, checked, "right") > np.searchsorted(at, since, "left")
    moving = np.flatnonzero(drives & seen)
    if not len(moving):
        return None
    # Up to the first break: what it does after that is not this command's (a hand, another driver).
    broken = np.flatnonzero(~drives & seen & (checked > checked[moving[0]]))
    return float(checked[broken[0] - 1] if len(broken) else checked[moving[-1]])


def _judge(on: list[float], stopped: list[float], stood: int, went: int) -> CommandHold:
    comments = []
    age = None
    if on:
        age = min(max(on), MAX_S)
        comments.append(
            f"the robot drove on to the end of {len(on)} of {len(on) + len(stopped)} gaps of"
            f" {MIN_GAP_S:g} s and more between commands, the longest of {max(on):.1f} s"
        )
    if stopped:
        middle = float(np.median(stopped))
        age = middle if age is None else age
        comments.append(f"it stood in {len(stopped)} of them from {middle:.1f} s on (median)")
    holds = went <= stood
    if stood:
        comments.append(f"it stood through {stood} of {stood + went} gaps after a command to stop")
    return CommandHold(age, holds, tuple(comments))


def settled_speeds(told_s: F64, reported: F64, at_s: F64, measured: F64, fastest: float) -> F64:
    """What was measured (K,) where the fastest commands had settled, positive along the command.

    Args:
        told_s, told: time and value of the commands (N,), in order.
        at_s, measured: of the odometry (M,), on the same clock.
        fastest: that was commanded now and then; above 0.
    """
    if not len(reported):
        return np.zeros(0)
    fast = np.abs(reported) >= NEARLY * fastest
    # Since when the commands have been fast, one way, without a break.
    begins = np.append(
        True, (fast[1:] != fast[:-1]) | (np.sign(reported[1:]) != np.sign(reported[:-1]))
    )
    since_s = told_s[np.maximum.accumulate(np.where(begins, np.arange(len(reported)), 0))]
    index = np.searchsorted(told_s, at_s, "right") - 1
    row = np.maximum(index, 0)
    settled = (index >= 0) & fast[row] & (at_s - since_s[row] >= SETTLED_S)
    settled &= at_s - told_s[row] < SETTLED_S  # the command is no old one
    along = (measured * np.sign(reported[row]))[settled]
    return np.asarray(along[np.isfinite(along)], np.float64)


def limit_of(settled: F64, fastest: float) -> float | None:
    """The limit that settled speeds (K,) show; None where the robot does about what it is told.

    Ahead and about share the wheels, so that the quickest tenth is taken, where the other motion
    asked least of them.
    """
    if len(settled) < MIN_SAMPLES:
        return None
    reached = float(np.percentile(settled, 90))
    return float(f"{reached:.3g}") if 0.01 < reached < HELD_BACK * fastest else None
