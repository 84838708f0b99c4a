"""What answers to what on a robot, in rows of any source: the pairs that are compared.

Each relation has two ends, each of one sensor or of the commands. A sensor whose readings are
scaled, turned round or late shows in every relation that it takes part in, and in no other: so the
end that is at fault can be named (`restock.train.diagnosis.causes`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.train.diagnosis.fed_rows import FedRows
from restock.train.diagnosis.response import Response, fit_response, lagged

ACTION_SPEED, ACTION_TURN = "action (speed)", "action (turn)"
WHEEL_SPEED, WHEEL_TURN = "wheels (speed)", "wheels (turn)"
POSE, GYROSCOPE, ACCELEROMETER, PLAN, LIDAR = "pose", "gyroscope", "accelerometer", "plan", "lidar"
COMMANDS = np.arange(-4, 8)  # lags of commands: robots answer late, logs may be wrong either way
SENSORS = np.arange(-3, 4)
NOW = np.zeros(1, np.int64)
_JUMP_RAD = 0.8  # a plan was replaced, not turned
_SLOW_MPS = 0.3  # slower than this a waypoint's bearing changes by turning, not by driving past it
_JUMP_M = 0.6
_AHEAD = 0.5  # sine of the waypoint's bearing, at most, for the way to be what is driven
_MOST = 0.5  # of what moves
_CLEAN = 0.1  # of what moves in a recording, in episodes without slip, for slip to be the floor's
_MIN_EPISODES = 5  # of a recording that is judged by itself
_NEAR_STEPS = 5
_FAR = 0.97  # of the lidar's range: nothing was seen
SlipLeftOut = Literal["episodes", "rows", "none"]


@dataclass(frozen=True)
class Relation:
    """`y` answers to `x`; each end has a name that says whose it is."""

    name: str
    x: str
    y: str
    lags: Ints
    of: Callable[[FedRows], tuple[F64, F64]]  # x and y of the rows, (N,) each; or (N, S)
    gain: float | None = 1.0  # by definition, where there is no twin to ask

    def fit(
        self, rows: FedRows, rng: np.random.Generator, leave_out: SlipLeftOut = "none"
    ) -> Response | None:
        """None where the rows say too little."""
        x, y = self.of(rows)
        y = y.copy()
        y[_left_out(rows, _motion(x, y), leave_out)] = np.nan
        if x.ndim == 2:
            cluster = np.repeat(rows.cluster, x.shape[1])
            return fit_response(x.reshape(-1, 1), y.reshape(-1), cluster, NOW, rng)
        before = [rows.before(int(lag)) for lag in self.lags]
        return fit_response(lagged(x, before), y, rows.cluster, self.lags, rng)

    def slip_to_leave_out(self, rows: FedRows) -> SlipLeftOut:
        """What of logs to leave out so that a floor does not count as a fault of the robot.

        Where wheels slip, how a robot moves is the floor's, also in the rows around those that are
        labelled: so whole episodes, as long as others remain. But a sensor that is wrong looks
        like slip too, all the time: then nearly every episode of its recording is so labelled.
        """
        moves = _motion(*self.of(rows))
        if _on_ice(rows, moves).any():
            return "episodes"
        return "rows" if moves[~_near_slip(rows)].sum() >= _MOST * moves.sum() else "none"


def _motion(x: F64, y: F64) -> F64:
    """How much each row says of a relation, (N,)."""
    moves = np.where(np.isfinite(y), x, 0.0) ** 2
    return moves if moves.ndim == 1 else np.asarray(moves.sum(axis=1))


def _left_out(rows: FedRows, moves: F64, what: SlipLeftOut) -> Bools:
    if what == "episodes":
        return _on_ice(rows, moves)
    return _near_slip(rows) if what == "rows" else np.zeros(len(rows), np.bool_)


def _slips(rows: FedRows) -> Bools:
    return np.asarray(rows.condition == "wheel_slip", np.bool_)


def _near_slip(rows: FedRows) -> Bools:
    """Rows (N,) labelled as slipping, and those a few steps from them."""
    slips = _slips(rows)
    near = slips.copy()
    for lag in (*range(-_NEAR_STEPS, 0), *range(1, _NEAR_STEPS + 1)):
        place, known = rows.before(lag)
        near |= slips[place] & known
    return near


def _on_ice(rows: FedRows, moves: F64) -> Bools:
    """The rows (N,) of episodes with slip, in recordings that move without slip as well; those of
    few episodes are judged together."""
    if not len(rows):
        return np.zeros(0, np.bool_)
    _, first, episode = np.unique(rows.episode, return_index=True, return_inverse=True)
    slipped = np.bincount(episode, _slips(rows)) > 0  # (E,)
    recording = np.unique(rows.recording[first], return_inverse=True)[1] + 1  # (E,)
    recording[np.bincount(recording)[recording] < _MIN_EPISODES] = 0
    moved = np.bincount(episode, moves)
    clean = np.bincount(recording, moved * ~slipped)  # (R,)
    ice = clean >= np.maximum(_CLEAN * np.bincount(recording, moved), 1e-12)
    return np.asarray((slipped & ice[recording])[episode], np.bool_)


def _speed(rows: FedRows) -> F64:
    return rows.after("wheel_speed")


def _gyro(rows: FedRows) -> F64:
    return rows.after("gyro_yaw_rate")


def _wheel_turn(rows: FedRows) -> F64:
    return rows.after("slip_yaw_rate") + rows.after("gyro_yaw_rate")


def _pose_speed(rows: FedRows) -> F64:
    return rows.after("localised_speed")


def _gained(rows: FedRows) -> F64:
    """How much wheels speeded up over the step, m/s2."""
    change = rows.after("wheel_speed") - rows.now("wheel_speed")
    return np.asarray(change / rows.task.control_period_s)


def _turned_waypoint(rows: FedRows) -> F64:
    """The yaw rate that the near waypoint's bearing shows, rad/s; NaN where driving or the plan
    moved it."""
    now = np.arctan2(rows.now("near_sin"), rows.now("near_cos"))
    after = np.arctan2(rows.after("near_sin"), rows.after("near_cos"))
    change = (after - now + np.pi) % (2 * np.pi) - np.pi
    driving = np.abs(rows.after("localised_speed")) > _SLOW_MPS
    change[(np.abs(change) > _JUMP_RAD) | driving] = np.nan
    return np.asarray(-change / rows.task.control_period_s)


def _route_speed(rows: FedRows) -> F64:
    """How fast the way to go became shorter, m/s; NaN where the plan jumped or reads its most, and
    where the robot is not headed along it: whoever drives elsewhere does not shorten it."""
    now, after = rows.now("goal_distance"), rows.after("goal_distance")
    shorter = 10.0 * (now - after)
    aside = (np.abs(rows.now("near_sin")) > _AHEAD) | (rows.now("near_cos") < 0.0)
    shorter[(np.abs(shorter) > _JUMP_M) | (now >= 1.0) | (after >= 1.0) | aside] = np.nan
    return np.asarray(shorter / rows.task.control_period_s)


def _scan_flow(rows: FedRows, turn: F64) -> tuple[F64, F64]:
    """How sectors changed (N, S), and how they would by a turn (rad/s, (N,)) on the spot."""
    now, after = rows.sectors(), rows.sectors(after=True)
    width = 2 * np.pi / max(rows.task.sectors, 1)
    slope = (np.roll(now, -1, axis=1) - np.roll(now, 1, axis=1)) / (2 * width)
    expected = slope * (turn * rows.task.control_period_s)[:, None]
    changed = after - now
    unseen = (now > _FAR) | (after > _FAR)
    unseen |= np.roll(unseen, 1, axis=1) | np.roll(unseen, -1, axis=1)
    unseen |= np.abs(slope) > 1.0  # an edge: what lies behind it comes into view
    unseen |= (np.abs(turn) < 0.2)[:, None]
    return expected, np.where(unseen, np.nan, changed)


RELATIONS = (
    Relation("speed of the wheels to the action", ACTION_SPEED, WHEEL_SPEED, COMMANDS,
             lambda rows: (rows.command()[:, 0], _speed(rows))),
    Relation("speed of the pose to the action", ACTION_SPEED, POSE, COMMANDS,
             lambda rows: (rows.command()[:, 0], _pose_speed(rows))),
    Relation("yaw rate of the gyroscope to the action", ACTION_TURN, GYROSCOPE, COMMANDS,
             lambda rows: (rows.command()[:, 1], _gyro(rows))),
    Relation("yaw rate of the wheels to the action", ACTION_TURN, WHEEL_TURN, COMMANDS,
             lambda rows: (rows.command()[:, 1], _wheel_turn(rows))),
    Relation("speed of the pose to the wheels", WHEEL_SPEED, POSE, SENSORS,
             lambda rows: (_speed(rows), _pose_speed(rows))),
    Relation("yaw rate of the wheels to the gyroscope", GYROSCOPE, WHEEL_TURN, SENSORS,
             lambda rows: (_gyro(rows), _wheel_turn(rows))),
    Relation("acceleration to the wheels", WHEEL_SPEED, ACCELEROMETER, SENSORS,
             lambda rows: (_gained(rows), 5.0 * rows.after("accel_x")), None),
    Relation("bearing of the waypoint to the gyroscope", GYROSCOPE, PLAN, NOW,
             lambda rows: (_gyro(rows), _turned_waypoint(rows)), None),
    Relation("way to go to the speed of the pose", POSE, PLAN, SENSORS,
             lambda rows: (_pose_speed(rows), _route_speed(rows)), None),
    Relation("what the lidar sees to the gyroscope", GYROSCOPE, LIDAR, NOW,
             lambda rows: _scan_flow(rows, _gyro(rows)), None),
    Relation("what the lidar sees to the turn of the wheels", WHEEL_TURN, LIDAR, NOW,
             lambda rows: _scan_flow(rows, _wheel_turn(rows)), None),
)  # fmt: skip


__all__ = ["RELATIONS", "Relation", "SlipLeftOut"]
