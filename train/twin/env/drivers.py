"""Scripted drivers, each with a name and a version that are logged.

A policy's `act(env, observation)` returns actions (N,) and their probabilities (N,). A small share
of its actions is random, so that the log covers more than its habits. `acting` (N,) are the names
of the drivers that chose the last actions; they differ from `name` after a handover. Policies draw
from their own seeded generator.

The operator is privileged: it reads the true places of pallets, people and wet floor. At every step
it simulates each action for the next 1.2 s. It scores how near the robot comes to racks, pallets
and people (assumed to keep walking), and how far it gets along a plan around the pallets. Near
pallets, and where the robot was stuck, it simulates pairs of actions and chooses by the remaining
time to the goal in a state lattice, which accounts for the heading that a gap requires. On and
before slippery floor, all but gentle actions score less. A few percent of the actions are random.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.ingest.task.surroundings import view_route
from restock.state import Stateful
from restock.train.twin.env.interface import Policy, epsilon_greedy
from restock.train.twin.env.navigation import PathFollower
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import PALLET_HALF_M, pallet_half_m
from restock.train.twin.floors.planner import PLAN_POINTS
from restock.train.twin.floors.state_lattice import (
    Motion,
    StateLattice,
    Window,
    lattice_around,
    near_gap,
    rectangle,
)
from restock.train.twin.physics.scenery import RETREATING, WALKING

STUCK_STEPS = 15
SLIP_STEPS = 4
MIN_STEPS_BETWEEN_HANDOVERS = 15


class BehaviourPolicy(Policy, Protocol):
    """A policy that reports who chose each of its last actions."""

    acting: NDArray[np.str_]  # (N,) names
    acting_version: NDArray[np.str_]  # (N,)


class SoftPolicy:
    """A policy that takes a random action with probability `epsilon`."""

    name = "soft"
    version = "1"

    def __init__(self, *, epsilon: float, seed: int = 0) -> None:
        self.epsilon = epsilon
        self._rng = np.random.default_rng([seed, sum(self.name.encode())])
        self.acting = np.array([], "U16")
        self.acting_version = np.array([], "U16")

    def choose(self, env: WarehouseVectorEnv) -> Ints:
        """Return the actions (N,) without exploration."""
        raise NotImplementedError

    def certain(self, env: WarehouseVectorEnv) -> Bools:
        """Return for which robots (N,) the policy never explores; none by default."""
        return np.zeros(env.num_envs, np.bool_)

    def act(self, env: WarehouseVectorEnv, observation: F32) -> tuple[Ints, F32]:
        """Return actions (N,), some of them random, and their probabilities (N,)."""
        chosen = self.choose(env)
        epsilon = np.where(self.certain(env), 0.0, self.epsilon)
        self.acting = np.full(env.num_envs, self.name, "U16")
        self.acting_version = np.full(env.num_envs, self.version, "U16")
        return epsilon_greedy(chosen, len(env.task.actions), epsilon, self._rng)


class RandomPolicy(SoftPolicy):
    """A policy that takes every action with the same probability."""

    name = "random"

    def __init__(self, *, seed: int = 0) -> None:
        super().__init__(epsilon=1.0, seed=seed)

    def choose(self, env: WarehouseVectorEnv) -> Ints:
        """Return action 0 everywhere; exploration makes the choice."""
        return np.zeros(env.num_envs, np.int64)


class PlannerFollower(SoftPolicy):
    """A driver that follows the plan, slows for turns and obstacles, and stops before them.

    Apart from random actions, it drives what the navigation stack proposes (the signals `nav_*`).
    """

    name = "planner"
    stop_m = 0.30
    slow_m = 0.80

    def __init__(self, *, epsilon: float = 0.02, seed: int = 0) -> None:
        super().__init__(epsilon=epsilon, seed=seed)

    def choose(self, env: WarehouseVectorEnv) -> Ints:
        """Return the action whose velocity is nearest to the plan's."""
        return self._follower(env).choose(env.signals)

    def certain(self, env: WarehouseVectorEnv) -> Bools:
        """Return for which robots (N,) the policy never explores: those near an obstacle."""
        return self._follower(env).near(env.signals)

    def _follower(self, env: WarehouseVectorEnv) -> PathFollower:
        return PathFollower(env.task, stop_m=self.stop_m, slow_m=self.slow_m)


class Handover:
    """A pair of drivers: the operator takes over from the planner in trouble, then hands back.

    Trouble is what the robot itself can detect: no movement for 3 s, the bumper, or wheels that
    disagree with the localisation or the gyroscope.
    """

    version = "1"

    def __init__(self, planner: BehaviourPolicy, operator: Operator) -> None:
        self.planner, self.operator = planner, operator
        self.name = f"{planner.name}+{operator.name}"
        self.acting = np.array([], "U16")
        self.acting_version = np.array([], "U16")
        self._prepare(0)

    def _prepare(self, count: int) -> None:
        self._by_operator = np.zeros(count, np.bool_)
        self._since_handover = np.zeros(count, np.int64)  # steps
        self._still = np.zeros(count, np.int64)  # steps without movement
        self._slipping = np.zeros(count, np.int64)
        self._anchor = np.zeros((count, 3))

    def act(self, env: WarehouseVectorEnv, observation: F32) -> tuple[Ints, NDArray[Any]]:
        """Return the actions of each robot's current driver, and their probabilities."""
        if len(self._by_operator) != env.num_envs:
            self._prepare(env.num_envs)
        self._choose_drivers(env)
        action, probability = self.planner.act(env, observation)
        if self._by_operator.any():
            operator_action, operator_probability = self.operator.act(env, observation)
            action = np.where(self._by_operator, operator_action, action)
            probability = np.where(self._by_operator, operator_probability, probability)
        names = self.planner.name, self.operator.name
        self.acting = np.where(self._by_operator, names[1], names[0]).astype("U16")
        versions = self.planner.version, self.operator.version
        self.acting_version = np.where(self._by_operator, versions[1], versions[0]).astype("U16")
        return action, probability

    def _choose_drivers(self, env: WarehouseVectorEnv) -> None:
        """Decide for each robot who drives."""
        signals = env.signals
        begun = env.steps == 0
        self._by_operator[begun] = False
        self._since_handover[begun] = self._still[begun] = self._slipping[begun] = 0
        pose = np.stack(
            [signals["pose_x_m"], signals["pose_y_m"], signals["pose_yaw_rad"]], axis=-1
        )
        moved = np.abs(pose - self._anchor)
        moved[:, 2] = np.minimum(moved[:, 2], 2 * np.pi - moved[:, 2])
        away = (moved > (0.25, 0.25, 0.6)).any(axis=1) | begun
        self._anchor[away] = pose[away]
        self._still = np.where(away, 0, self._still + 1)
        slip = np.abs(signals["wheel_speed_mps"] - signals["localised_speed_mps"]) > 0.3
        slip |= np.abs(signals["wheel_yaw_rate_radps"] - signals["gyro_yaw_rate_radps"]) > 0.5
        self._slipping = np.where(slip, self._slipping + 1, np.maximum(self._slipping - 1, 0))
        self._since_handover += 1
        trouble = (self._still >= STUCK_STEPS) | (self._slipping >= SLIP_STEPS)
        self._pass((trouble | signals["bumped"]) & ~self._by_operator, to_operator=True)
        clear = (
            ~(signals["clearance_m"] <= 0.2)  # true for NaN, too: clearance not known
            & (self._slipping == 0)
            & ~signals["bumped"]
            & (self._since_handover >= MIN_STEPS_BETWEEN_HANDOVERS)
            & ~self.operator.sees_trouble(env)
        )
        self._pass(clear & self._by_operator, to_operator=False)

    def _pass(self, robots: Bools, *, to_operator: bool) -> None:
        """Hand robots (N,) over to the operator or to the planner."""
        self._by_operator[robots] = to_operator
        self._since_handover[robots] = self._still[robots] = 0


# Clearance below TOUCH_M counts as a hit; below ROOMY_M, it lowers an action's score. Both are for
# robots at least WIDTH_M wide, and are scaled down for narrower ones.
TOUCH_M, ROOMY_M, WIDTH_M = 0.05, 0.12, 0.5
PERSON_MARGIN_M = 0.4  # distance to keep from people who move
STANDING_MARGIN_M = 0.2  # distance to keep from people who stand


def simulate(env: WarehouseVectorEnv, ids: Ints, pose: F64, commands: F64) -> tuple[F64, F64]:
    """Predict poses (n, A, T, 3) and speeds (n, A, T) of robots under commands (n, A, T, 2)."""
    period = env.task.control_period_s
    shape = commands.shape[:3]
    x, y, yaw = (np.broadcast_to(pose[:, axis, None], shape[:2]) for axis in range(3))
    velocity = np.broadcast_to(env.simulation.controller.set_point[ids][:, None], (*shape[:2], 2))
    ends = np.empty((*shape, 3))
    speed = np.empty(shape)
    for step in range(shape[2]):
        velocity = velocity + 0.8 * (commands[:, :, step] - velocity)
        middle = yaw + velocity[..., 1] * period / 2
        x = x + velocity[..., 0] * np.cos(middle) * period
        y = y + velocity[..., 0] * np.sin(middle) * period
        yaw = yaw + velocity[..., 1] * period
        for axis, place in enumerate((x, y, yaw)):
            ends[:, :, step, axis] = place
        speed[:, :, step] = velocity[..., 0]
    return ends, speed


def _outlines(poses: F64, outline: F64) -> tuple[F64, F64]:
    """Return x and y (..., K) of the points of an outline (K, 2) at poses (..., 3)."""
    cos, sin = np.cos(poses[..., 2, None]), np.sin(poses[..., 2, None])
    return (
        poses[..., 0, None] + cos * outline[:, 0] - sin * outline[:, 1],
        poses[..., 1, None] + sin * outline[:, 0] + cos * outline[:, 1],
    )


def room_of(env: WarehouseVectorEnv, ids: Ints, ends: F64) -> tuple[F64, F64]:
    """Return clearances (n, A, T) to racks, walls and pallets, and to people's future places.

    The first are exact below `ROOMY_M`; larger ones all count the same.
    """
    outline = outline_of(env, points=3)
    beyond_m = float(np.hypot(*outline.T).max()) + ROOMY_M  # from here on, clearance is ample
    room = np.full(ends.shape[:3], ROOMY_M)
    on, pallets = env.layout[ids], env.simulation.pallets[ids]
    boxes = np.concatenate([pallets[..., :2], pallet_half_m(pallets[..., 2])], axis=-1)
    boxes[pallets[..., 0] <= 0, :2] = np.inf  # pallets that are not on the floor
    for index in set(on.tolist()):
        rows = np.flatnonzero(on == index)
        floor, pose = env.floors[index], ends[rows]
        close = near_gap(floor, boxes[rows], pose[..., 0], pose[..., 1], beyond_m) < beyond_m
        robot, *plan = np.nonzero(close)
        outlines = _outlines(pose[close], outline)
        gap = near_gap(floor, boxes[rows[robot]], *outlines, ROOMY_M)
        room[rows[robot], *plan] = gap.min(axis=1)
    people = np.full(ends.shape[:3], 9.0)
    traffic = env.simulation.traffic
    rows = np.flatnonzero(traffic.active[ids])
    if len(rows):
        about = ids[rows]
        later = (np.arange(ends.shape[2]) + 1) * env.task.control_period_s
        arrived = traffic.travelled_m[about] >= traffic.length_m[about]
        walking = (traffic.state[about] == WALKING) & ~arrived
        sign = np.where(walking, 1.0, np.where(traffic.state[about] == RETREATING, -0.6, 0.0))
        walked = (traffic.speed_mps[about] * sign)[..., None] * later  # (n, G, T)
        heading = traffic.heading_rad[about][..., None]
        px = traffic.position_m[about, :, 0, None] + np.cos(heading) * walked
        py = traffic.position_m[about, :, 1, None] + np.sin(heading) * walked
        x, y = _outlines(ends[rows], outline)
        gap = np.hypot(x[:, None] - px[:, :, None, :, None], y[:, None] - py[:, :, None, :, None])
        gap = gap.min(axis=4) - traffic.radius_m[None, :, None, None]
        standing = sign == 0.0  # robots may pass nearer to people who stand
        gap += np.where(standing, PERSON_MARGIN_M - STANDING_MARGIN_M, 0.0)[:, :, None, None]
        people[rows] = gap.min(axis=1)
    return room, people


def steps_of(env: WarehouseVectorEnv, seconds: float) -> int:
    """Convert seconds to control periods, at least one."""
    return max(round(seconds / env.task.control_period_s), 1)


def margins_of(env: WarehouseVectorEnv) -> tuple[float, float]:
    """Return `TOUCH_M` and `ROOMY_M` scaled to this robot."""
    smaller = min(env.task.body.width_m / WIDTH_M, 1.0)
    return TOUCH_M * smaller, ROOMY_M * smaller


def outline_of(env: WarehouseVectorEnv, points: int) -> F64:
    """Return points on the body's outline, (K, 2), relative to its axle."""
    body = env.task.body
    return rectangle(body.length_m, body.width_m, env.simulation.robot.axle_x_m, points)


BACK_S = (2.4, 3.2)  # shortest and longest time of backing off
_LOOK_M = tuple(0.3 * step for step in range(14))
HORIZON_S = 1.2
CAREFUL_M = 1.8  # a person is near if the robot's and the person's centres are this close
GENTLE_MPS, GENTLE_RADPS = 0.45, 1.0
STANDING_MPS = 0.12
STILL_S = 1.0  # a robot that has not moved for longer is stuck
PATIENCE_S = 4.0  # with a person near, a robot waits this long, then moves about to be let pass
# Changes of position (m) and heading (rad) that count as movement. They are scaled down for robots
# that cannot move by MOVED_STEP in a control period.
MOVED = np.array([0.1, 0.2])
MOVED_STEP = np.array([1.0, 1.2]) * 0.2
WINDOW_M = 2.3  # how far a lattice reaches around the centres of pallets
# Near pallets, a plan is one action for FIRST_S, then another until PAIR_S. The last step's plan is
# kept unless another is better by BETTER_S: else replanning can postpone a turn for ever.
PAIR_S, FIRST_S, NEXT_S, BETTER_S = 1.6, 0.6, 0.4, 0.1


def harsh_actions(table: F64) -> Bools:
    """Return which actions (A, 2), in m/s and rad/s, are too fast for slippery floor.

    A fast robot's slowest forward speed and slowest turn are always allowed: without them it would
    never get across.
    """
    speed, turn = np.abs(table).T
    ahead = table[:, 0][table[:, 0] > 0]
    gentle_mps = max(GENTLE_MPS, float(ahead.min()) if len(ahead) else 0.0)
    gentle_radps = max(GENTLE_RADPS, float(turn[turn > 0].min()) if (turn > 0).any() else 0.0)
    return np.asarray((speed > gentle_mps) | (turn > gentle_radps), np.bool_)


class Operator(SoftPolicy, Stateful):
    """A privileged driver that reads the simulation's state and plans a path for each robot."""

    name = "operator"
    # Version 1 had no lattice, 2 backed off from people who had just let it pass, and 3 used the
    # stand-in's look-ahead and clearances for every robot.
    version = "4"
    STATE: ClassVar[tuple[str, ...]] = (
        *("_rng", "_ways", "_episode", "_began", "_plan", "_anchor", "_still", "_waiting"),
        *("_backing", "_stuck_m"),
    )

    def __init__(self, *, epsilon: float = 0.03, seed: int = 0) -> None:
        super().__init__(epsilon=epsilon, seed=seed)
        self._prepare(0, 0)

    def _prepare(self, count: int, pair_steps: int) -> None:
        self._ways = np.zeros((count, PLAN_POINTS, 2))
        self._episode = np.full(count, -1)
        self._began = np.zeros((count, 2))  # where each robot's episode began
        self._plan = np.zeros((count, pair_steps), np.int64)  # next actions of the kept plan
        self._anchor = np.zeros((count, 3))
        self._still = np.zeros(count, np.int64)
        self._waiting = np.zeros(count, np.bool_)
        self._backing = np.zeros(count, np.int64)
        self._stuck_m = np.full((count, 2), np.nan)  # where it was last stuck, per robot
        self._lattices: dict[int, tuple[int, StateLattice | None]] = {}  # robot -> episode, lattice

    def restored(self) -> None:
        """Drop the lattices after a state was restored; they are rebuilt when needed."""
        self._lattices = {}

    def choose(self, env: WarehouseVectorEnv) -> Ints:
        """Return the actions (N,) that get farthest along the way and keep enough clearance."""
        pose = env.simulation.pose()
        self._find_ways(env, pose)
        table = np.asarray(env.task.actions, np.float64)
        count, actions = env.num_envs, len(table)
        everyone = np.arange(count)
        horizon = steps_of(env, HORIZON_S)
        touch_m, roomy_m = margins_of(env)
        held = np.broadcast_to(table[:, None], (count, actions, horizon, 2))
        ends, speed = simulate(env, everyone, pose, held)  # (N, A, T, 3), (N, A, T)
        room, people = room_of(env, everyone, ends)  # (N, A, T)
        people = np.where(np.abs(speed) < STANDING_MPS, 9.0, people)  # people stop if robots stand
        arrived = self._arrived(env, everyone, ends)
        room[arrived] = people[arrived] = 9.0  # what comes after the goal does not matter
        flat = ends[:, :, -1].reshape(-1, 3)
        ways = np.repeat(self._ways, actions, axis=0)
        view = view_route(ways, flat[:, 0], flat[:, 1], flat[:, 2], (0.6,))
        ahead = view.look_ahead_m[:, 0]
        bearing = np.abs(np.arctan2(ahead[:, 1], ahead[:, 0]))
        score = -(view.remaining_m + 1.2 * view.offset_m + 0.5 * np.minimum(bearing, 2.0))
        score = score.reshape(count, actions)
        nearest = room.min(axis=2)
        score -= 2.0 * np.clip(roomy_m - nearest, 0.0, roomy_m) / roomy_m * (room[:, :, 0] > 0)
        score -= 8.0 * np.clip(PERSON_MARGIN_M - people.min(axis=2), 0.0, 1.0)
        when = np.argmax(np.minimum(room, people) < touch_m, axis=2)
        hits = (np.minimum(room, people) < touch_m).any(axis=2)
        score -= np.where(hits, 20.0 + 30.0 * (horizon - when) / horizon, 0.0)
        icy = self._icy(env, pose)
        score -= np.where(icy[:, None] & harsh_actions(table)[None, :], 3.0, 0.0)
        score += 1.0 * arrived.any(axis=2)
        alone = people.min(axis=(1, 2)) > 0.6
        score[alone, 0] -= 0.2  # action 0 is to stop, but there is nobody to wait for
        # A robot that has stood for a while backs off, or tries another action that hits nothing.
        tries = self._rng.random(score.shape) * 0.5 - 10.0 * hits
        tries[:, 0] -= 1.0
        tries[:, table[:, 0] < 0] += 1.0
        backs = self._backing_off(env, pose) & (alone | (self._still > steps_of(env, PATIENCE_S)))
        score[backs] = tries[backs]
        self._note_stuck(env, pose, np.flatnonzero(backs & alone & ~icy & (self._still > 0)))
        action = np.asarray(score.argmax(axis=1), np.int64)
        ids = self._near_pallets(env, pose)
        ids = ids[~backs[ids] & alone[ids] & ~icy[ids]]
        if len(ids):
            action[ids] = self._past_pallets(env, ids, pose[ids], table)
        return action

    def _past_pallets(self, env: WarehouseVectorEnv, ids: Ints, pose: F64, table: F64) -> Ints:
        """Return the first action of the best pair of actions for robots (n,) with a lattice.

        The best pair leaves the least time to the goal and hits nothing.
        """
        first, then = (part.ravel() for part in np.indices((len(table),) * 2))
        horizon, begun = steps_of(env, PAIR_S), steps_of(env, FIRST_S)
        touch_m, roomy_m = margins_of(env)
        pairs = np.where(np.arange(horizon) < begun, first[:, None], then[:, None])  # (P, T)
        plans = np.broadcast_to(pairs, (len(ids), *pairs.shape))
        plans = np.concatenate([plans, self._plan[ids][:, None]], axis=1)  # (n, P + 1, T)
        ends, _ = simulate(env, ids, pose, table[plans])
        room, people = room_of(env, ids, ends)
        room = np.minimum(room, people)
        arrived = self._arrived(env, ids, ends)
        room[arrived] = 9.0
        touched = np.logical_or.accumulate(room < touch_m, axis=2)
        left_s = np.zeros(room.shape)
        for row, index in enumerate(ids.tolist()):
            lattice = self._lattices[index][1]
            assert lattice is not None
            left_s[row, :, begun:] = lattice.time_s(ends[row, :, begun:])
        steps = (np.arange(horizon) + 1) * env.task.control_period_s
        score = -np.where(arrived, 0.0, left_s) - 0.5 * steps - 50.0 * touched
        score = score[:, :, begun:].max(axis=2)
        nearest = room[:, :, : begun + steps_of(env, NEXT_S)].min(axis=2)
        score -= np.clip(roomy_m - nearest, 0.0, roomy_m) / roomy_m * (room[:, :, 0] > 0)
        score[plans[:, :, 0] == 0] -= 0.3  # action 0 is to stop, with nobody to wait for
        score[:, -1] += BETTER_S
        chosen = plans[np.arange(len(ids)), score.argmax(axis=1)]  # (n, T)
        self._plan[ids] = np.append(chosen[:, 1:], chosen[:, -1:], axis=1)
        return np.asarray(chosen[:, 0], np.int64)

    def _near_pallets(self, env: WarehouseVectorEnv, pose: F64) -> Ints:
        """Return the robots (n,) that are in the window of their episode's lattice."""
        guided = np.zeros(len(pose), np.bool_)
        for index in range(len(pose)):
            lattice = self._lattice(env, index)
            if lattice is not None:
                guided[index] = lattice.window.covers(*pose[index, :2])
        return np.flatnonzero(guided)

    def _lattice(self, env: WarehouseVectorEnv, index: int) -> StateLattice | None:
        """Return the lattice of a robot's episode, around pallets and the place where it was stuck.

        Return None without pallets and such a place, or if the robot cannot turn on the spot.
        """
        episode = int(self._episode[index])
        kept, lattice = self._lattices.get(index, (-1, None))
        if kept == episode:
            return lattice
        pallets = _pallets(env, index)
        stuck = self._stuck_m[index : index + 1]
        places = np.concatenate([pallets[:, :2], stuck[np.isfinite(stuck[:, 0])]])
        motion = _motion(env) if len(places) else None
        lattice = None
        if motion is not None:
            goal_x, goal_y = env.navigation.goals_m[index].tolist()
            goal = (goal_x, goal_y)
            planner = env.navigation.planner_of(index)
            x, y = self._began[index].tolist()
            lattice = lattice_around(
                planner.warehouse,
                planner.graph_around(x, y, goal, pallets, PALLET_HALF_M[:2]),
                pallets[:, :2],
                pallet_half_m(pallets[:, 2]),
                goal,
                env.task.goal_radius_m,
                motion,
                Window.around(places, WINDOW_M, planner.shape),
            )
        self._lattices[index] = episode, lattice
        return lattice

    def _note_stuck(self, env: WarehouseVectorEnv, pose: F64, ids: Ints) -> None:
        """Build new lattices for stuck robots (n,) that are outside their current lattices."""
        for index in ids.tolist():
            lattice = self._lattice(env, index)
            if lattice is None or not lattice.window.covers(*pose[index, :2]):
                self._stuck_m[index] = pose[index, :2]
                del self._lattices[index]
                self._ways[index] = self._way(env, index, pose[index])

    def certain(self, env: WarehouseVectorEnv) -> Bools:
        """Return for which robots (N,) the policy never explores: those beside people."""
        return _somebody_near(env, env.simulation.pose())

    def sees_trouble(self, env: WarehouseVectorEnv) -> Bools:
        """Return the robots (N,) that have pallets ahead, or people or slippery floor near."""
        pose = env.simulation.pose()
        plans = env.navigation.plans_m
        view = view_route(plans, pose[:, 0], pose[:, 1], np.zeros(len(pose)), _LOOK_M)
        ahead = view.look_ahead_m + pose[:, None, :2]  # in the map frame, since heading is 0
        gap = np.abs(ahead[:, :, None] - env.simulation.pallets[:, None, :, :2])
        half = pallet_half_m(env.simulation.pallets[:, None, :, 2])
        in_way = (gap < half + 0.35).all(axis=-1)
        traffic = env.simulation.traffic
        people = traffic.position_m - pose[:, None, :2]
        near = in_way.reshape(len(pose), -1).any(axis=1)
        near |= (np.hypot(people[..., 0], people[..., 1]) < 1.5).any(axis=1)
        return np.asarray(near | self._icy(env, pose), np.bool_)

    def _arrived(self, env: WarehouseVectorEnv, ids: Ints, ends: F64) -> Bools:
        """Return the steps (n, A, T) at which a robot is at its goal or has been there."""
        gap = ends[..., :2] - env.navigation.goals_m[ids][:, None, None]
        at_goal = np.hypot(gap[..., 0], gap[..., 1]) < env.task.goal_radius_m - 0.05
        return np.asarray(np.logical_or.accumulate(at_goal, axis=2), np.bool_)

    def _backing_off(self, env: WarehouseVectorEnv, pose: F64) -> Bools:
        """Return the robots (N,) that back off: they do so for some time after being stuck.

        Robots that wait for people back off only after `PATIENCE_S`.
        """
        near = _somebody_near(env, pose)
        let_pass = self._waiting & ~near
        self._waiting = near
        moved = (np.abs(pose - self._anchor) > _movement_limits(env)).any(axis=1) | (env.steps == 0)
        self._anchor[moved] = pose[moved]
        self._still = np.where(moved | let_pass, 0, self._still + 1)
        least, most = (steps_of(env, seconds) for seconds in BACK_S)
        self._backing = np.where(
            self._still > steps_of(env, STILL_S),
            self._rng.integers(least, max(most, least + 1), size=len(pose)),
            np.maximum(self._backing - 1, 0),
        )
        waits = near & (self._still <= steps_of(env, PATIENCE_S))
        self._backing[waits | let_pass | (env.steps == 0)] = 0
        return self._backing > 0

    def _find_ways(self, env: WarehouseVectorEnv, pose: F64) -> None:
        """Plan past the pallets when an episode starts, and again if a robot is off its plan."""
        if len(self._ways) != env.num_envs:
            self._prepare(env.num_envs, steps_of(env, PAIR_S))
        serial = env.episodes_begun
        stale = self._episode != serial
        offset = view_route(self._ways, pose[:, 0], pose[:, 1], pose[:, 2], ()).offset_m
        for index in np.flatnonzero(stale | (offset > 0.5)):
            if stale[index]:
                self._episode[index], self._began[index] = serial[index], pose[index, :2]
                self._stuck_m[index] = np.nan
            self._ways[index] = self._way(env, int(index), pose[index])

    def _way(self, env: WarehouseVectorEnv, index: int, pose: F64) -> F64:
        """Return a robot's plan (PLAN_POINTS, 2) past the pallets, from a pose (3,)."""
        x, y, yaw = pose.tolist()
        goal_x, goal_y = env.navigation.goals_m[index].tolist()
        planner = env.navigation.planner_of(index)
        lattice = self._lattice(env, index)
        if lattice is not None:
            way = lattice.plan(x, y, yaw)
        else:
            way = planner.plan_around(
                x, y, (goal_x, goal_y), _pallets(env, index), PALLET_HALF_M[:2]
            )
        return planner.plan(x, y, (goal_x, goal_y)) if way is None else way

    def _icy(self, env: WarehouseVectorEnv, pose: F64) -> Bools:
        """Return whether (N,) slippery floor is under the robot or within .9 m of its centre."""
        patches = env.simulation.patches
        gap = np.abs(pose[:, None, :2] - patches[:, :, :2]) - patches[:, :, 2:4]
        distance = np.hypot(np.maximum(gap[..., 0], 0), np.maximum(gap[..., 1], 0))
        return np.asarray((distance < 0.9).any(axis=1), np.bool_)


def _pallets(env: WarehouseVectorEnv, index: int) -> F64:
    """Return the pallets (K, 3) on a robot's floor."""
    pallets = env.simulation.pallets[index]
    return np.asarray(pallets[pallets[:, 0] > 0])


def _somebody_near(env: WarehouseVectorEnv, pose: F64) -> Bools:
    """Return which robots (N,) have a person or forklift centre within `CAREFUL_M`."""
    people = env.simulation.traffic.position_m - pose[:, None, :2]
    near = np.hypot(people[..., 0], people[..., 1]) < CAREFUL_M
    return np.asarray(near.any(axis=1), np.bool_)


def _movement_limits(env: WarehouseVectorEnv) -> F64:
    """Return the changes of x, y (m) and yaw (rad) above which a robot counts as moving.

    They are scaled down for slow robots by their highest speeds: else a robot that creeps, or that
    has only just started, would count as stuck.
    """
    fastest = np.abs(np.asarray(env.task.actions, np.float64)).max(axis=0)
    slower = np.minimum(fastest * env.task.control_period_s / MOVED_STEP, 1.0)
    return np.asarray(MOVED[[0, 0, 1]] * slower[[0, 0, 1]])


def _motion(env: WarehouseVectorEnv) -> Motion | None:
    """Return a robot's motion for a lattice; None if the robot cannot turn on the spot."""
    table = np.asarray(env.task.actions, np.float64)
    turn = float(np.abs(table[table[:, 0] == 0.0, 1]).max(initial=0.0))
    ahead, back = float(table[:, 0].max()), float(-table[:, 0].min())
    if turn == 0.0 or ahead <= 0.0:
        return None
    return Motion(outline_of(env, points=5), ahead, max(back, 0.0), turn)
