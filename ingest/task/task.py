"""Signals, and the task that maps them to observation, discrete action, reward and termination.

Signals are named columns with units that logs and the twin both fill. A profile maps a robot's
topics to signals; the twin computes them from MuJoCo. Everything downstream (task, conditions,
store) sees only signals, and so cannot tell a log from a simulation.

Every function is pure and vectorised over its leading axis: the steps of a recording at ingest,
the environments of a step in the twin. `now` holds the signals at time t, `before` those at t - 1
(the same as `now` at the start of an episode), `after` those at t + 1. Observations never depend on
`after`; reward and termination describe what happened in [t, t + 1).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, Final, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.toml import Checked

Signals = dict[str, NDArray[Any]]  # name -> values, (steps, …) or (environments, …)


@dataclass(frozen=True)
class Signal:
    """A column: its name (which ends in its unit), shape per step, type and meaning."""

    name: str
    meaning: str
    dtype: str = "float64"
    per_sector: bool = False  # shape (sectors,) instead of ()
    stored: bool = True  # kept as a column of the transition table
    optional: bool = False  # may be unknown: NaN here, null in the table
    lidar: bool = False  # measured by the lidar alone: unknown for a robot without one


def _of_lidar(name: str, meaning: str) -> Signal:
    return Signal(name, meaning, optional=True, lidar=True)


SIGNALS: tuple[Signal, ...] = (
    Signal("stamp_ns", "time of the step on the alignment clock", "int64"),
    Signal("pose_x_m", "localised position in the map frame, x"),
    Signal("pose_y_m", "localised position in the map frame, y"),
    Signal("pose_yaw_rad", "localised heading in the map frame, in (-pi, pi]"),
    Signal("pose_stamp_ns", "when that pose was measured; at or before stamp_ns", "int64"),
    Signal("wheel_speed_mps", "forward speed from the wheel encoders"),
    Signal("wheel_yaw_rate_radps", "yaw rate from the wheel encoders"),
    Signal("gyro_yaw_rate_radps", "yaw rate from the gyroscope"),
    Signal("accel_x_mps2", "forward acceleration from the accelerometer"),
    Signal(
        "sector_clearance_m",
        "per sector of bearing: nearest lidar return minus the body's extent in that direction",
        per_sector=True,
        stored=False,
        lidar=True,
    ),
    _of_lidar("clearance_m", "the smallest sector clearance"),
    _of_lidar("clearance_ahead_m", "the smallest sector clearance toward the near waypoint"),
    Signal("waypoint_near_x_m", "near look-ahead point of the plan, body frame, forward"),
    Signal("waypoint_near_y_m", "near look-ahead point of the plan, body frame, left"),
    Signal("waypoint_far_x_m", "far look-ahead point of the plan, body frame, forward"),
    Signal("waypoint_far_y_m", "far look-ahead point of the plan, body frame, left"),
    Signal("route_remaining_m", "length of the plan from the nearest point on it to its end"),
    Signal("goal_distance_m", "straight-line distance from the pose to the goal"),
    Signal("localised_speed_mps", "forward speed from the last two localised poses"),
    Signal("localised_lateral_mps", "sideways speed (left) from the last two localised poses"),
    _of_lidar(
        "came_nearer_m",
        "how much nearer something within 2 m is than at every step of the last second, without"
        " the robot's own motion; 0: nothing came nearer",
    ),
    _of_lidar(
        "plan_return_m",
        "distance along the plan to the first lidar return within half the body's width of it;"
        " range_max_m if there is none",
    ),
    _of_lidar(
        "plan_gap_m",
        "distance from the plan just ahead (its first 1.4 * near_m) to the nearest lidar return;"
        " range_max_m if there is none",
    ),
    Signal("bumped", "the bumper was pressed since the step before", "bool"),
    Signal("command_speed_mps", "commanded forward speed in force until the next step"),
    Signal("command_yaw_rate_radps", "commanded yaw rate in force until the next step"),
    Signal("nav_speed_mps", "forward speed that navigation proposes, or unknown", optional=True),
    Signal("nav_yaw_rate_radps", "yaw rate that navigation proposes, or unknown", optional=True),
)

# Extra signals of a task with K tracks, (K,) per step and not stored; NaN if fewer are tracked:
# positions in the body frame, ground velocity along the body's axes, seconds since first seen.
TRACK_SIGNALS = ("track_x_m", "track_y_m", "track_vx_mps", "track_vy_mps", "track_age_s")

OBSERVED: Final = "observed"  # key of the task's own observation entries, see `task_sql.py`
OWN_LIMIT = 20.0  # the task's own observation entries are clipped to +- this

STORED_SIGNALS: tuple[Signal, ...] = tuple(signal for signal in SIGNALS if signal.stored)
OPTIONAL_SIGNALS = frozenset(signal.name for signal in SIGNALS if signal.optional)
# Signals that depend on the outline of the robot.
OUTLINE_SIGNALS = frozenset({"clearance_m", "clearance_ahead_m", "plan_return_m"})
PLAN_SIGNALS = frozenset({"plan_return_m", "plan_gap_m"})  # show obstacles on the plan
LIDAR_SIGNALS = frozenset(signal.name for signal in SIGNALS if signal.lidar)


def localised_velocity(
    now: Signals, before: Signals
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return forward and lateral speed (m/s) from two localised poses, in the body frame of `now`.

    If no new pose has arrived since the step before, the wheels are the only evidence of motion, so
    the wheel speed is returned: a missing pose must not look like slip.
    """
    elapsed_s = (now["pose_stamp_ns"] - before["pose_stamp_ns"]) * 1e-9
    fresh = elapsed_s > 1e-6
    elapsed_s = np.where(fresh, elapsed_s, 1.0)
    vx = (now["pose_x_m"] - before["pose_x_m"]) / elapsed_s
    vy = (now["pose_y_m"] - before["pose_y_m"]) / elapsed_s
    # Use the heading half-way between the poses: a turn must not read as sideways motion.
    turn = wrap_angle(now["pose_yaw_rad"] - before["pose_yaw_rad"])
    heading = now["pose_yaw_rad"] - turn / 2
    cos, sin = np.cos(heading), np.sin(heading)
    forward = np.where(fresh, cos * vx + sin * vy, now["wheel_speed_mps"])
    lateral = np.where(fresh, -sin * vx + cos * vy, 0.0)
    return forward, lateral


def wrap_angle(angle_rad: NDArray[Any]) -> NDArray[Any]:
    """Return the same angle in [-pi, pi)."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def yaw_of(
    x: NDArray[Any], y: NDArray[Any], z: NDArray[Any], w: NDArray[Any]
) -> NDArray[np.float64]:
    """Return the yaw of quaternions (N,) in (-pi, pi], REP 103: about z, counter-clockwise.

    Quaternions are normalised. One of length 0 was not filled in: its yaw is NaN.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # NaN stays NaN
        length = np.sqrt(x * x + y * y + z * z + w * w)
        scale = np.where((length > 1e-9) & (length < np.inf), 1 / length, np.nan)
        scale[np.abs(length - 1) < 1e-3] = 1.0
        x, y, z, w = (part * scale for part in (x, y, z, w))
        return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), np.float64)


class Noise(Checked, frozen=True):
    """The `[noise]` of a profile: standard deviations of the sensors, for probabilities.

    The SQL of conditions names them `lidar_noise_m`, and so on.
    """

    lidar_m: Annotated[float, Meta(gt=0)] = 0.015  # standard deviation of a range
    localiser_m: Annotated[float, Meta(gt=0)] = 0.01  # error of the way between two poses, per axis
    wheels_mps: Annotated[float, Meta(gt=0)] = 0.003  # standard deviation of the wheel speed
    gyro_radps: Annotated[float, Meta(gt=0)] = 0.01  # deviation of the yaw rate, including bias

    @property
    def constants(self) -> dict[str, float]:
        """Return the values by their names in SQL: `lidar_m` is `lidar_noise_m` there."""
        named = msgspec.structs.asdict(self)
        return {"_noise_".join(name.rsplit("_", 1)): value for name, value in named.items()}


class Body(Checked, frozen=True):
    """The robot's rectangular outline and where its lidar sits, in the base frame (x forward)."""

    length_m: Annotated[float, Meta(gt=0)]
    width_m: Annotated[float, Meta(gt=0)]
    lidar_x_m: float = 0.0  # position of the lidar ahead of the outline's centre
    lidar_yaw_rad: float = 0.0  # angle of the scan's zero to the robot's forward axis


# Version of the code that computes observation and reward. Raise it when their values change, so
# that rows made by different code are never mixed unnoticed.
TASK_CODE_VERSION = 2

MAX_PERIOD_S = 10.0
SLIP_MPS = 0.15  # slipping wheels differ more from ground speed, at a top speed of 1 m/s or more


class Rewards(Checked, frozen=True):
    """Reward of each event in a step: the `[task.rewards]` of a profile."""

    progress_per_m: float = 1.0  # along the plan in force at t; at most +-1 m per step counts
    step: float = -0.02
    action_change: float = -0.01
    tight: float = -0.05  # if the clearance at t + 1 is below tight_clearance_m
    tight_clearance_m: float = 0.15
    harsh: float = -0.05  # if wheel speed changed faster than harsh_mps2
    harsh_mps2: float = 3.0
    slip_per_mps: float = -0.1  # for each m/s of |wheel speed - localised speed| above 0.2 m/s
    goal: float = 5.0
    bump: float = -6.0  # if a contact began; once per contact


class Task(Checked, frozen=True):
    """The definition of the task for one kind of robot: the `[task]` table of a profile."""

    body: Body
    actions: tuple[tuple[float, float], ...]  # (speed m/s, yaw rate rad/s); action 0 must be stop
    goal: Literal["route", "none"] = "route"
    control_period_s: Annotated[float, Meta(gt=0)] = 0.2
    sectors: Annotated[int, Meta(ge=0)] = 36  # even, at least 4; 0: the robot has no lidar
    range_min_m: Annotated[float, Meta(ge=0)] = 0.05
    range_max_m: float = 4.0
    near_m: Annotated[float, Meta(gt=0)] = 1.0  # distance of the near waypoint along the plan
    far_m: Annotated[float, Meta(gt=0)] = 2.2
    goal_radius_m: Annotated[float, Meta(gt=0)] = 0.4
    time_limit_steps: Annotated[int, Meta(ge=1)] = 240
    # Number of tracks in the observation, nearest first. Unset: none, and not in the task's hash.
    tracks: Annotated[int, Meta(ge=1, le=16)] | msgspec.UnsetType = msgspec.UNSET
    bump_terminates: bool = False  # a bump ends the episode (protective stop)
    rewards: Rewards = Rewards()
    # The profile's own reward terms: name -> (weight, SQL); see `restock.ingest.task.task_sql`.
    reward_terms: dict[str, tuple[float, str]] | msgspec.UnsetType = msgspec.UNSET
    observed: dict[str, str] | msgspec.UnsetType = msgspec.UNSET  # extra observations: name -> SQL

    def check(self) -> None:
        if not self.actions or self.actions[0] != (0.0, 0.0):
            raise ValueError("actions must start with the stop action [0, 0]")
        if self.control_period_s > MAX_PERIOD_S:
            raise ValueError(
                f"control_period_s is in seconds, at most {MAX_PERIOD_S:g}, got"
                f" {self.control_period_s:g}: is that milliseconds?"
            )
        if self.sectors % 2 or self.sectors == 2:
            raise ValueError(f"sectors must be even and 4 or more, or 0, got {self.sectors}")
        if self.tracks and not self.sectors:
            raise ValueError("tracks needs a lidar: leave it out, or name scans in [inputs.scan]")
        if self.range_max_m <= self.range_min_m:
            raise ValueError(
                f"range_max_m must be above range_min_m, got {self.range_max_m:g} and"
                f" {self.range_min_m:g}"
            )
        taken = {"reward_terms": Rewards.__struct_fields__, "observed": self._shipped_names}
        for table, names in taken.items():
            for name in getattr(self, table) or {}:
                if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
                    raise ValueError(f"{table}: a name is letters, digits and _, got {name!r}")
                if name in names:
                    raise ValueError(f"{table}: {name!r} is one of Restock's: choose another name")

    @property
    def lidar(self) -> bool:
        """Return whether the robot has a lidar; without one, clearance is not observed."""
        return self.sectors > 0

    @property
    def observation_names(self) -> list[str]:
        """Return the name of every entry of the observation, in order."""
        return [*self._shipped_names, *(self.observed or ())]

    @property
    def _shipped_names(self) -> list[str]:
        bearings = (np.arange(self.sectors) + 0.5) * (360 / max(self.sectors, 1)) - 180
        return [
            *("near_sin", "near_cos", "far_sin", "far_cos", "goal_distance"),
            *("wheel_speed", "gyro_yaw_rate", "localised_speed", "slip_speed", "slip_yaw_rate"),
            *("lateral_speed", "accel_x"),
            *(f"previous_action_{index}" for index in range(len(self.actions))),
            *(f"clearance_{bearing:+.0f}deg" for bearing in bearings),
            *(f"closing_{bearing:+.0f}deg" for bearing in bearings),
            *("nav_known", "nav_speed", "nav_yaw_rate"),
            *(
                f"track_{entry}_{place}"
                for entry in ("x", "y", "vx", "vy", "age", "known")
                for place in range(self.tracks or 0)
            ),
        ]

    @property
    def observation_size(self) -> int:
        own = len(self.observed or ())
        return 12 + len(self.actions) + 2 * self.sectors + 3 + 6 * (self.tracks or 0) + own

    @property
    def scaled_actions(self) -> NDArray[np.float64]:
        """Return the actions (A, 2), each axis divided by its largest value, as in observations."""
        return np.asarray(self.actions, np.float64) / _fastest(self.actions)

    @property
    def action_names(self) -> list[str]:
        """Return the actions' names for people, such as `drive 0.8 left 0.7`."""
        return [_action_name(*action) for action in self.actions]

    @property
    def slip_limit_mps(self) -> float:
        """Return the difference of wheel and ground speed from which wheels count as slipping."""
        return SLIP_MPS * min(self._fastest_mps, 1.0)

    @property
    def _fastest_mps(self) -> float:
        return max(abs(speed) for speed, _ in self.actions) or 1.0

    @property
    def condition_limits(self) -> dict[str, float]:
        """Return the task's constants that the SQL of conditions may name."""
        return {
            "tight_clearance_m": self.rewards.tight_clearance_m,
            "body_width_m": self.body.width_m,
            "slip_limit_mps": self.slip_limit_mps,
            "fastest_mps": self._fastest_mps,
            "control_period_s": self.control_period_s,
        }

    @property
    def hash(self) -> str:
        """Return a hash of the task's values and `TASK_CODE_VERSION`, 12 hex digits."""
        content = msgspec.json.encode([TASK_CODE_VERSION, self])
        return hashlib.blake2b(content, digest_size=6).hexdigest()


STAND_IN_LIMITS = {  # `condition_limits` of the twin's stand-in robot
    "tight_clearance_m": 0.15,
    "body_width_m": 0.5,
    "slip_limit_mps": SLIP_MPS,
    "fastest_mps": 1.0,
    "control_period_s": 0.2,
}

# Entries of an observation whose sign changes when left and right are exchanged.
_ODD = ("near_sin", "far_sin", "gyro_yaw_rate", "slip_yaw_rate", "lateral_speed", "nav_yaw_rate")


@dataclass(frozen=True)
class Mirror:
    """Observations and actions of a task with left and right exchanged."""

    source: Ints  # (D,) index of the entry that each mirrored entry is copied from
    sign: F32  # (D,) factor of the copied entry: 1 or -1
    opposite: Ints  # (A,) index of the action at the same speed and the opposite yaw rate

    @classmethod
    def of(cls, task: Task) -> Mirror:
        """Build the mirror image of a task.

        Raises:
            ValueError: an action has no opposite turn, or the task has observation entries of its
                own, whose mirror image is unknown.
        """
        if task.observed:
            raise ValueError("the mirror image of its [task.observed] is unknown")
        table = np.asarray(task.actions, np.float64)
        gap = np.abs(table[:, None] - table[None] * (1, -1)).max(axis=2)
        opposite = gap.argmin(axis=1)
        lonely = np.flatnonzero(gap.min(axis=1) > 1e-6)
        if len(lonely):
            index, name = lonely[0], task.action_names[lonely[0]]
            raise ValueError(f"action {index}, {name}, has no opposite among the task's actions")
        names = task.observation_names
        source = np.arange(len(names))
        at = names.index("previous_action_0")
        source[at : at + len(table)] = at + opposite
        at += len(table)
        for begin in (at, at + task.sectors):  # reverse the sectors of clearance and closing
            source[begin : begin + task.sectors] = source[begin : begin + task.sectors][::-1]
        odd = [name in _ODD or name.startswith(("track_y", "track_vy")) for name in names]
        sign = np.where(odd, -1.0, 1.0).astype(np.float32)
        return cls(source, sign, opposite)

    def observation(self, observation: F32) -> F32:
        """Return the mirror image of observations, (..., D)."""
        mirrored: F32 = observation[..., self.source] * self.sign
        return mirrored

    def action(self, action: Ints) -> Ints:
        """Return the mirrored actions (N,); negative values mean "no action" and stay."""
        return np.where(action < 0, action, self.opposite[action])


def observe(task: Task, now: Signals, before: Signals, previous_action: Ints) -> F32:
    """Compute the observation at t, (N, D) float32, from signals at t, t - 1 and the last action.

    `before` needs only `sector_clearance_m`. The task's own entries (N, E) are `now[OBSERVED]`.
    """
    near = np.arctan2(now["waypoint_near_y_m"], now["waypoint_near_x_m"])
    far = np.arctan2(now["waypoint_far_y_m"], now["waypoint_far_x_m"])
    routed = 1.0 if task.goal == "route" else 0.0  # without a goal these entries are all zero
    clearance = _nearness(now["sector_clearance_m"], task.range_max_m)
    closing = clearance - _nearness(before["sector_clearance_m"], task.range_max_m)
    scalars = (
        np.sin(near) * routed,
        np.cos(near) * routed,
        np.sin(far) * routed,
        np.cos(far) * routed,
        now["route_remaining_m"].clip(0.0, 10.0) / 10.0 * routed,
        now["wheel_speed_mps"],
        now["gyro_yaw_rate_radps"],
        now["localised_speed_mps"],
        now["wheel_speed_mps"] - now["localised_speed_mps"],
        now["wheel_yaw_rate_radps"] - now["gyro_yaw_rate_radps"],
        now["localised_lateral_mps"],
        now["accel_x_mps2"].clip(-10.0, 10.0) / 5.0,
    )
    one_hot = np.eye(len(task.actions))[previous_action]
    parts = [*_entries(*scalars), one_hot, clearance, closing, *_entries(*_proposed(task, now))]
    if task.tracks:
        parts.append(_tracked(task, now))
    if task.observed:
        parts.append(now[OBSERVED])
    return np.concatenate(parts, axis=-1).astype(np.float32)


def nearest_action(
    task: Task, speed_mps: NDArray[Any], yaw_rate_radps: NDArray[Any]
) -> tuple[Ints, NDArray[np.float64]]:
    """Return the discrete action nearest to each command, (N,), and its distance (N,).

    Speed and yaw rate are divided by their largest values among the actions. Ties go to the first.
    """
    command = np.stack([speed_mps, yaw_rate_radps], axis=-1) / _fastest(task.actions)
    distance = np.linalg.norm(command[:, None, :] - task.scaled_actions[None], axis=-1)
    action = np.argmin(distance, axis=1)
    return action.astype(np.int64), distance[np.arange(len(action)), action]


def reached_goal(task: Task, after: Signals) -> Bools:
    """Return whether the robot is within the goal radius at t + 1, (N,)."""
    if task.goal == "none":
        return np.zeros(len(after["goal_distance_m"]), np.bool_)
    reached: Bools = after["goal_distance_m"] <= task.goal_radius_m
    return reached


def terminated(task: Task, after: Signals) -> Bools:
    """Return whether the episode terminates at t + 1, (N,): do not bootstrap there."""
    terminates = reached_goal(task, after)
    if task.bump_terminates:
        terminates = terminates | after["bumped"].astype(np.bool_)
    return terminates


def reward(
    task: Task,
    now: Signals,
    after: Signals,
    progress_m: NDArray[Any],
    action: Ints,
    previous_action: Ints,
) -> F32:
    """Compute the reward of [t, t + 1), (N,) float32.

    `progress_m` (N,) is how much shorter the plan in force at t became (with a goal), or how far
    the robot moved forward (without one).
    """
    parts = reward_parts(task, now, after, progress_m, action, previous_action)
    return np.asarray(sum(parts.values()), np.float32)


def reward_parts(
    task: Task,
    now: Signals,
    after: Signals,
    progress_m: NDArray[Any],
    action: Ints,
    previous_action: Ints,
) -> dict[str, NDArray[Any]]:
    """Compute the reward of each event in [t, t + 1), (N,) each, by the names of `Rewards`.

    `tight` is 0 if clearance is unknown (NaN): the robot has no lidar.
    """
    weight = task.rewards
    harsh = np.abs(after["wheel_speed_mps"] - now["wheel_speed_mps"]) / task.control_period_s
    slip = np.abs(after["wheel_speed_mps"] - after["localised_speed_mps"])
    progress = weight.progress_per_m * progress_m.clip(-1.0, 1.0)
    return {
        "progress_per_m": progress,
        "step": np.full_like(progress, weight.step),
        "action_change": weight.action_change * (action != previous_action),
        "tight": weight.tight * (after["clearance_m"] < weight.tight_clearance_m),
        "harsh": weight.harsh * (harsh > weight.harsh_mps2),
        "slip_per_mps": weight.slip_per_mps * (slip - 0.2).clip(0.0, 2.0),
        "goal": weight.goal * reached_goal(task, after),
        "bump": weight.bump * (after["bumped"] & ~now["bumped"].astype(np.bool_)),
    }


def clearance_ahead(
    task: Task, sector_clearance_m: NDArray[Any], waypoint_x_m: Any, waypoint_y_m: Any
) -> NDArray[np.float64]:
    """Return the smallest clearance (N,) of the three sectors around the near waypoint's bearing.

    NaN without a lidar.
    """
    if not task.sectors:
        return np.full(len(sector_clearance_m), np.nan)
    bearing = np.arctan2(waypoint_y_m, waypoint_x_m)
    middle = ((bearing + np.pi) * (task.sectors / (2 * np.pi))).astype(np.int64)
    around = (middle[:, None] + np.array([-1, 0, 1])) % task.sectors
    nearest = sector_clearance_m[np.arange(len(around))[:, None], around]
    return np.asarray(np.minimum.reduce(nearest, axis=1), np.float64)


def _entries(*values: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Yield each array (N,) as an entry of an observation, (N, 1)."""
    return (value[..., None] for value in values)


def _proposed(task: Task, now: Signals) -> tuple[NDArray[Any], ...]:
    """Return the navigation stack's command: whether it is known, speed and yaw rate, each (N,).

    Speed and yaw rate are divided by the fastest action on their axis and clipped to +-2; all are
    0 if the command is unknown.
    """
    speed, yaw_rate = now["nav_speed_mps"], now["nav_yaw_rate_radps"]
    known = np.isfinite(speed) & np.isfinite(yaw_rate)
    fastest = _fastest(task.actions)
    return known, *(
        (np.where(known, value, 0.0) / most).clip(-2.0, 2.0)
        for value, most in zip((speed, yaw_rate), fastest, strict=True)
    )


def _tracked(task: Task, now: Signals) -> NDArray[np.float64]:
    """Return the observation entries of K tracks (N, 6 K); all 0 for a missing track.

    Positions are divided by `range_max_m` and clipped to +-2.
    """
    x, y, *rest = (now[name] for name in TRACK_SIGNALS)
    known = np.isfinite(x)
    near = [np.clip(place / task.range_max_m, -2.0, 2.0) for place in (x, y)]
    speed = [np.clip(value, -3.0, 3.0) for value in rest[:2]]
    entries = [*near, *speed, np.minimum(rest[2], 2.0) / 2.0]
    return np.concatenate([*(np.where(known, entry, 0.0) for entry in entries), known], axis=-1)


def proposal_reader(task: Task) -> tuple[F64, F64, F64]:
    """Return W (A, D), b (A,) and k (D,), which read the proposed action from an observation (D,).

    The action nearest to navigation's command has the largest value of W @ observation + b.
    k @ observation is 1 if navigation proposes a command, else 0.
    """
    scaled, names = task.scaled_actions, task.observation_names
    near = np.zeros((len(scaled), len(names)))
    near[:, names.index("nav_speed")], near[:, names.index("nav_yaw_rate")] = 2 * scaled.T
    known = np.zeros(len(names))
    known[names.index("nav_known")] = 1.0
    return near, -(scaled**2).sum(axis=1), known


@lru_cache(maxsize=64)
def _fastest(actions: tuple[tuple[float, float], ...]) -> NDArray[np.float64]:
    """Return the largest speed (m/s) and yaw rate (rad/s) among the actions, (2,)."""
    largest = np.abs(np.asarray(actions, np.float64)).max(axis=0)
    return np.asarray(np.maximum(largest, 1e-9), np.float64)


def _nearness(clearance_m: NDArray[Any], range_max_m: float) -> NDArray[Any]:
    """Scale clearance to [0, 1], with more resolution close by."""
    nearness: NDArray[Any] = np.sqrt((clearance_m / range_max_m).clip(0.0, 1.0))
    return nearness


def nearness_of(task: Task, observation: NDArray[Any]) -> F64:
    """Return the clearance entries (N, K) of observations (N, D): in [0, 1], ordered by bearing."""
    names = enumerate(task.observation_names)
    first = next((place for place, name in names if name.startswith("clearance_")), 0)
    nearness: F64 = observation[:, first : first + task.sectors].astype(np.float64)
    return nearness


def clearances_of(task: Task, observation: NDArray[Any]) -> F64:
    """Return the clearance of each sector (N, K), in metres, from observations (N, D)."""
    return nearness_of(task, observation) ** 2 * task.range_max_m


def _action_name(speed_mps: float, yaw_rate_radps: float) -> str:
    """Name an action as the view `actions` of a store does; see replay/store/views.sql."""
    if speed_mps == 0 and yaw_rate_radps == 0:
        return "stop"
    turn = f"{'left' if yaw_rate_radps > 0 else 'right'} {_three_places(yaw_rate_radps)}"
    if speed_mps == 0:
        return f"turn {turn}"
    drive = f"{'drive' if speed_mps > 0 else 'back'} {_three_places(speed_mps)}"
    return f"{drive} {turn}" if yaw_rate_radps else drive


def _three_places(value: float) -> str:
    return f"{round(abs(value), 3):.10g}"
