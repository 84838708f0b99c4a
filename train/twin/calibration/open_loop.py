"""Open loop: replay logged commands in the twin, without other information from the log.

`drive_open_loop` puts robots into logged states and drives logged commands from there, for one or
more control periods. `replay_segments` uses it for segments of a log. A warm-up of W steps begins
with the logged motion, so that ramps and delayed commands are under way when the K steps of the
segment begin. There the twin's pose is set to the logged one, and the twin drives on its own.

Segments are driven on an empty floor. The log's obstacles are unknown, racks of another floor do
not apply, and a localisation error of 3 cm must not become a collision: the question is how the
robot moves, and the log's signal `bumped` marks steps with contact. Slippery patches are unknown,
too. Without obstacles the motion does not depend on the place, so robots drive in the middle of an
empty hall, and their paths are moved onto the map.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.errors import ConfigError
from restock.ingest.task.task import Signals, Task, localised_velocity, wrap_angle
from restock.train.twin.calibration.logged_steps import COMMAND, LoggedSteps, rows_of
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.physics.episode import Episode, EpisodeSpec
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.physics.robot_model import RobotModel
from restock.train.twin.physics.simulation import Simulation

WARMUP_S = 1.0  # longer than any latency, and than stopping with friction .2
STILL_MPS = 0.02  # a slower robot stands
TOUCHING_M = 0.05  # a robot closer to something may be touching it
EVEN = 0.25  # tolerance of ticks' times and poses' ages, as a share of the control period
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
    """S logged segments of K steps, with the W steps before each.

    `signals` are the stored signals by name, (S, K + 1), at the K ticks and at the end of the last
    step. `left_out` counts the store's steps at which no segment begins, by reason.
    """

    task: Task
    robot: RobotModel | None  # robot of the log's profile; None: the twin's stand-in
    horizon_steps: int  # K
    warmup_steps: int  # W
    row: Ints  # (S,) index of the first of the K steps in the `LoggedSteps`
    recording_id: NDArray[np.str_]  # (S,)
    episode_id: NDArray[np.str_]  # (S,)
    condition: NDArray[np.str_]  # (S, K) the label of each step
    true_condition: NDArray[np.str_]  # (S, K) logged by a simulator; "" if unknown
    command: F64  # (S, W + K, 2) speed m/s and yaw rate rad/s; 0 before an episode begins
    still: NDArray[np.bool_]  # (S,) some of the W steps are missing, but the robot stood there
    before: dict[str, F64]  # the signals of `BEFORE` when the W steps begin, (S,) each
    signals: Signals  # (S, K + 1) each
    pose_fresh: NDArray[np.bool_]  # (S, K + 1) the pose was measured at its tick
    left_out: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.row)

    @property
    def pose(self) -> F64:
        """Return the logged x, y and heading, (S, K + 1, 3)."""
        return np.stack([self.signals[name] for name in POSE], axis=-1)

    def take(self, which: NDArray[Any]) -> LoggedSegments:
        """Return the segments at an index or mask (S,), with `left_out` unchanged."""
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
) -> LoggedSegments:
    """Cut logged episodes into segments of `horizon_s`.

    Segments begin at least `stride_s` apart (None: the horizon, so that none overlap), at ticks
    with a fresh pose. The steps of a segment must be evenly spaced, and those of the warm-up
    (rounded up to whole steps) must precede it, except at an episode's start if the robot stood
    still. A pose is fresh if its age is the recording's median age, within a quarter of a control
    period.

    Raises:
        ConfigError: the horizon or stride is over 5 % off a multiple of the control period.
    """
    task, rows = steps.task, steps.now
    horizon = _periods(task, horizon_s, "horizon_s")
    stride = horizon if stride_s is None else _periods(task, stride_s, "stride_s")
    warmup = warmup_steps(task)
    period_ns = round(task.control_period_s * 1e9)
    fresh = _find_fresh(steps, period_ns)

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
        even = _find_even(rows["stamp_ns"][base:end], horizon, period_ns)
        good = base + np.flatnonzero(even & fresh[base : end - horizon])
        while (following := int(np.searchsorted(good, place))) < len(good):
            start = int(good[following])
            left += _count_passed(even[place - base : start - base])
            starts.append(start)
            place = start + stride
        left += _count_passed(even[place - base :])
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


def _find_even(stamp_ns: Ints, horizon: int, period_ns: int) -> NDArray[np.bool_]:
    """Return whether `horizon` evenly spaced ticks follow each tick, (N - horizon,).

    `stamp_ns` (N,) are the times of one stretch of consecutive steps.
    """
    off = stamp_ns - np.arange(len(stamp_ns)) * period_ns
    windows = np.lib.stride_tricks.sliding_window_view(off, horizon + 1)
    most, begin = EVEN * period_ns, off[: len(windows)]
    even = (windows.max(axis=1) - begin <= most) & (begin - windows.min(axis=1) <= most)
    return np.asarray(even, np.bool_)


def _count_passed(even: NDArray[np.bool_]) -> Counter[str]:
    """Count the reasons why no segment begins at these ticks (N,)."""
    return Counter(
        {
            "ticks not a control period apart": int((~even).sum()),
            "no fresh pose at the start": int(even.sum()),
        }
    )


def ordinary_driving(segments: LoggedSegments) -> tuple[LoggedSegments, dict[str, int]]:
    """Return the segments of ordinary driving, and counts of the others by reason."""
    touched = segments.signals["bumped"].astype(bool).any(axis=1)
    near = ~touched & (segments.signals["clearance_m"] < TOUCHING_M).any(axis=1)
    # True conditions are preferred: if the whole floor is slippery, labels also report slip.
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
    """Return the time (ns) from which on each recording is held out.

    With four or more recordings, whole recordings are held out; else the last part of each.
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
    """Return which segments (S,) end before their recording's time, and which begin after it."""
    at = np.array([stamps[str(name)] for name in segments.recording_id], np.int64)
    ticks = segments.signals["stamp_ns"]
    return ticks[:, -1] <= at, ticks[:, 0] >= at


def _find_fresh(steps: LoggedSteps, period_ns: int) -> NDArray[np.bool_]:
    """Return which rows' poses (N,) have about the median age of their recording."""
    age = steps.now["stamp_ns"] - steps.now["pose_stamp_ns"]
    fresh = np.zeros(len(age), np.bool_)
    for recording in np.unique(steps.recording_id):
        rows = steps.recording_id == recording
        fresh[rows] = np.abs(age[rows] - np.median(age[rows])) <= EVEN * period_ns
    return fresh


def warmup_steps(task: Task) -> int:
    """Return the number of control periods in `WARMUP_S`, rounded up."""
    return int(np.ceil(WARMUP_S / task.control_period_s - 1e-9))


def _periods(task: Task, seconds: float, name: str) -> int:
    """Convert a duration to control periods. Raises ConfigError if that is over 5 % off."""
    period_s = task.control_period_s
    count = max(round(seconds / period_s), 1)
    if abs(count * period_s - seconds) > 0.05 * seconds:
        raise ConfigError(
            f"{name} must be a multiple of the control period of {period_s} s, got {seconds}",
            where="segments",
        )
    return count


ROBOTS = 512  # number of robots that are simulated at a time
SLIP_MPS = 0.2  # if wheel and localised speed differ by more, the robot starts at the localised one
EMPTY_M = 60.0  # side of an empty floor; robots near its wall are moved back to the middle
SENSED = ("wheel_speed_mps", "wheel_yaw_rate_radps", "gyro_yaw_rate_radps", "accel_x_mps2")


@dataclass(frozen=True)
class OpenLoopStart:
    """The initial states of S robots, and their commands from there.

    `motion` are the logged wheel speed and yaw rate, gyroscope, localised speed and lateral speed,
    (S,) each. The base controllers begin in the state to which the `past` commands lead. Without
    `past`, they begin as if the motion of the wheels had always been commanded.
    """

    pose: F64  # (S, 3) x, y and heading
    motion: Signals
    command: F64  # (S, K, 2) speed m/s and yaw rate rad/s
    past: F64 | None = None  # (S, P, 2) the commands of the periods before

    def take(self, which: Ints) -> OpenLoopStart:
        past = None if self.past is None else self.past[which]
        return OpenLoopStart(
            self.pose[which], rows_of(self.motion, which), self.command[which], past
        )


@dataclass(frozen=True)
class OpenLoopResult:
    """The noise-free signals of P twins from S starts: at the start and after each period."""

    signals: dict[str, F64]  # of pose, wheels, gyroscope and accelerometer, (P, S, K + 1) each
    sliding_mps: F64  # (P, S, K + 1) sliding speed along the robot, of the wheel that slides faster
    diverged: Bools  # (P, S) the physics diverged, so the other values are meaningless

    @property
    def pose(self) -> F64:
        """Return x, y and heading, (P, S, K + 1, 3)."""
        return np.stack([self.signals[name] for name in POSE], axis=-1)


def drive_open_loop(
    task: Task,
    start: OpenLoopStart,
    perturbations: Sequence[Perturbation],
    *,
    robot: RobotModel | None = None,
    timestep_s: float = 0.01,
    nthread: int = 1,
) -> OpenLoopResult:
    """Drive every start's commands under every perturbation, on an empty floor: P x S robots.

    `robot` None means the twin's stand-in. The perturbations' `timestep_s` and sensor noise are not
    used. A drive's result depends neither on `nthread` nor on the other starts and perturbations.

    Raises:
        ConfigError: the timestep does not divide .1 s, or the control period is not a whole number
            of timesteps.
    """
    shape = (len(perturbations), len(start.pose))
    jobs, periods = shape[0] * shape[1], start.command.shape[1]
    pose = np.zeros((jobs, periods + 1, 3))
    signals = {name: np.zeros((jobs, periods + 1)) for name in SENSED}
    sliding = np.zeros((jobs, periods + 1))
    diverged = np.zeros(jobs, np.bool_)
    simulation: Simulation | None = None
    for begin in range(0, jobs, ROBOTS):
        ids = np.arange(begin, min(begin + ROBOTS, jobs))
        if simulation is None or simulation.num_envs != len(ids):
            floor = empty_floor()
            simulation = Simulation(len(ids), task, floor, timestep_s, nthread, robot=robot)
        which, number = np.divmod(ids, shape[1])
        twins, part = [perturbations[index] for index in which], start.take(number)
        offset = _place(simulation, part, twins)
        bias = np.array([twin.gyro_bias_radps for twin in twins])
        for step in range(periods + 1):
            if step:
                simulation.drive(part.command[:, step - 1])
                diverged[ids] |= simulation.diverged
            pose[ids, step] = simulation.pose()
            pose[ids, step, :2] += offset
            speed, turn = simulation.robot.body_velocity(*simulation.wheel_speeds().T)
            sensed = (speed, turn, simulation.qvel[:, 5] + bias, simulation.accel[:, 0])
            for name, values in zip(SENSED, sensed, strict=True):
                signals[name][ids, step] = values
            sliding[ids, step] = _sliding(simulation, pose[ids, step, 2])
            offset += _recentre(simulation)
    signals |= {name: pose[..., i] for i, name in enumerate(POSE)}
    return OpenLoopResult(
        signals={name: values.reshape(*shape, -1) for name, values in signals.items()},
        sliding_mps=sliding.reshape(*shape, -1),
        diverged=diverged.reshape(shape),
    )


def empty_floor() -> Warehouse:
    """Make a floor without racks."""
    middle = (EMPTY_M / 2, EMPTY_M / 2)
    return Warehouse(EMPTY_M, EMPTY_M, racks=(), segments=(), goals_m=(middle,), name="empty")


def _place(
    simulation: Simulation, start: OpenLoopStart, perturbations: Sequence[Perturbation]
) -> F64:
    """Give every robot its logged motion, in the middle of the floor with its logged heading.

    Returns map minus simulated position (N, 2).
    """
    middle = (EMPTY_M / 2, EMPTY_M / 2)
    offset, motion = start.pose[:, :2] - middle, start.motion
    for env, perturbation in enumerate(perturbations):
        place = (*middle, float(start.pose[env, 2]))
        episode = Episode(EpisodeSpec("nominal", 0), place, middle, np.array([middle, middle]))
        simulation.reset(env, episode, perturbation)
    wheels = np.asarray(motion["wheel_speed_mps"])
    localised = np.asarray(motion["localised_speed_mps"])
    slips = np.abs(wheels - localised) > SLIP_MPS
    rolled = wheels * simulation.body.radius_m / simulation.robot.wheel_radius_m
    forward = np.where(slips, localised, rolled)
    lateral = np.asarray(motion["localised_lateral_mps"])
    lateral = np.where(np.abs(lateral) > SLIP_MPS, lateral, 0.0)
    cos, sin = np.cos(start.pose[:, 2]), np.sin(start.pose[:, 2])
    simulation.qvel[:, 0] = cos * forward - sin * lateral
    simulation.qvel[:, 1] = sin * forward + cos * lateral
    bias = np.array([twin.gyro_bias_radps for twin in perturbations])
    simulation.qvel[:, 5] = motion["gyro_yaw_rate_radps"] - bias
    turn = motion["wheel_yaw_rate_radps"]
    simulation.roll(wheels, turn)
    controller = simulation.controller
    if start.past is None:
        controller.begin(np.stack([wheels, turn], axis=-1))
        simulation.steer()
        return offset
    for step in range(start.past.shape[1]):  # restores the ramp and the delayed commands
        controller.command(start.past[:, step])
        for block in range(simulation.blocks):
            controller.controls(block * simulation.block_s)
    simulation.steer()
    return offset


def _recentre(simulation: Simulation) -> F64:
    """Move robots far from the middle of an empty floor back to it; return by how much (N, 2)."""
    from_middle = simulation.qpos[:, :2] - EMPTY_M / 2
    away = np.where(np.abs(from_middle) > EMPTY_M / 4, from_middle, 0.0)
    simulation.qpos[:, :2] -= away
    return np.asarray(away)


def _sliding(simulation: Simulation, yaw_rad: F64) -> F64:
    """Return the speed (m/s, (N,)) at which rims slide over the floor, the faster of both sides."""
    velocity = simulation.qvel
    forward = np.cos(yaw_rad) * velocity[:, 0] + np.sin(yaw_rad) * velocity[:, 1]
    turn = velocity[:, 5] * (simulation.robot.track_m / 2)
    ground = np.stack([forward - turn, forward + turn], axis=-1)
    rim = simulation.wheel_speeds() * simulation.body.radius_m[:, None]
    faster: F64 = np.abs(rim - ground).max(axis=1)
    return faster


def replay_segments(
    segments: LoggedSegments,
    perturbations: Sequence[Perturbation],
    *,
    timestep_s: float = 0.01,
    nthread: int = 1,
) -> OpenLoopResult:
    """Drive every segment's commands under every perturbation, on an empty floor.

    The result covers the K steps, not the warm-up, and includes localised speeds. Poses are moved
    so that each segment begins at its logged pose.

    Raises:
        ConfigError: as `drive_open_loop`.
    """
    moving = ~segments.still
    motion = {name: np.where(moving, values, 0.0) for name, values in segments.before.items()}
    motion["localised_lateral_mps"] = np.zeros(len(segments))  # it settles during the warm-up
    start = OpenLoopStart(np.zeros((len(segments), 3)), motion, segments.command)
    driven = drive_open_loop(
        *(segments.task, start, perturbations),
        robot=segments.robot, timestep_s=timestep_s, nthread=nthread,
    )  # fmt: skip
    warmup = segments.warmup_steps
    signals = {name: driven.signals[name][..., warmup:] for name in SENSED}
    forward, lateral = _localised(
        driven.pose, segments.task.control_period_s, signals["wheel_speed_mps"]
    )
    signals["localised_speed_mps"], signals["localised_lateral_mps"] = forward, lateral
    laid = lay_onto(driven.pose[:, :, warmup:], segments.pose[:, 0])
    laid[..., 2] = wrap_angle(laid[..., 2])
    signals |= {name: laid[..., i] for i, name in enumerate(POSE)}
    return replace(driven, signals=signals, sliding_mps=driven.sliding_mps[..., warmup:])


def _localised(pose: F64, period_s: float, wheel_speed: F64) -> tuple[F64, F64]:
    """Compute forward and lateral speeds (m/s), (..., K + 1), from each pose and the one before.

    `pose` (..., W + K + 1, 3) has W warm-up steps; if W is 0, the wheels give the first speed.
    """
    stamp = np.broadcast_to(np.arange(pose.shape[-2]) * round(period_s * 1e9), pose.shape[:-1])
    columns = {name: pose[..., i] for i, name in enumerate(POSE)} | {"pose_stamp_ns": stamp}
    at = np.arange(pose.shape[-2] - wheel_speed.shape[-1], pose.shape[-2])
    now = {name: values[..., at] for name, values in columns.items()}
    before = {name: values[..., np.maximum(at - 1, 0)] for name, values in columns.items()}
    return localised_velocity({**now, "wheel_speed_mps": wheel_speed}, before)


def lay_onto(pose: F64, onto: F64) -> F64:
    """Move poses (..., S, K + 1, 3) rigidly so that each first pose is `onto` (S, 3)."""
    turn = onto[:, 2] - pose[..., 0, 2]
    cos, sin = np.cos(turn)[..., None], np.sin(turn)[..., None]
    x, y = pose[..., 0] - pose[..., :1, 0], pose[..., 1] - pose[..., :1, 1]
    moved = (onto[:, :1] + cos * x - sin * y, onto[:, 1:2] + sin * x + cos * y)
    return np.stack([*moved, pose[..., 2] + turn[..., None]], axis=-1)
