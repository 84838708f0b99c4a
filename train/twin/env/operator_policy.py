"""The operator: someone who stands by and sees pallets, people and wet floor as they are.

Every .2 s each action is thought through for the next second and a half: where the robot would
be, how near to racks, pallets and people that comes (who are taken to walk on as they do), and
how far along a way that knows the pallets. On and before slippery floor only gentle actions
count. A few percent of the actions are mistakes.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.ingest.task.route import view_route
from restock.state import Stateful
from restock.train.twin.env.policies import SoftPolicy
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.planner import PLAN_POINTS
from restock.train.twin.physics.model import PALLET_HALF_M, pallet_half_m
from restock.train.twin.physics.traffic import RETREATING, WALKING

BACK_STEPS = (12, 16)
_LOOK_M = tuple(0.3 * step for step in range(14))
HORIZON = 6  # steps of the control period
TOUCH_M = 0.05
ROOMY_M = 0.12
PERSON_MARGIN_M = 0.4
STANDING_MARGIN_M = 0.2
CAREFUL_M = 1.8  # from the robot's middle to a person's
GENTLE_MPS, GENTLE_RADPS = 0.45, 1.0
STANDING_MPS = 0.12
PATIENCE_STEPS = 20  # with somebody in the way; then it moves about, to be let pass


def harsh_actions(table: F64) -> Bools:
    """Which actions (A, 2), in m/s and rad/s, are none for slippery floor: the faster ones.

    The slowest ahead and the slowest turn of a fast robot are taken all the same: who drives no
    other would never come over it.
    """
    speed, turn = np.abs(table).T
    ahead = table[:, 0][table[:, 0] > 0]
    gentle_mps = max(GENTLE_MPS, float(ahead.min()) if len(ahead) else 0.0)
    gentle_radps = max(GENTLE_RADPS, float(turn[turn > 0].min()) if (turn > 0).any() else 0.0)
    return np.asarray((speed > gentle_mps) | (turn > gentle_radps), np.bool_)


class Operator(SoftPolicy, Stateful):
    """Privileged: reads the simulation's state. Keeps a way of its own for each robot."""

    name = "operator"
    STATE: ClassVar[tuple[str, ...]] = (
        *("_rng", "_ways", "_episode", "_anchor", "_still", "_backing"),
    )

    def __init__(self, *, epsilon: float = 0.03, seed: int = 0) -> None:
        super().__init__(epsilon=epsilon, seed=seed)
        self._prepare(0)

    def _prepare(self, count: int) -> None:
        self._ways = np.zeros((count, PLAN_POINTS, 2))
        self._episode = np.full(count, -1)
        self._anchor = np.zeros((count, 3))
        self._still = np.zeros(count, np.int64)
        self._backing = np.zeros(count, np.int64)

    def choose(self, env: WarehouseVectorEnv) -> Ints:
        """The action that comes farthest along the way without coming too near to anything."""
        pose = env.simulation.pose()
        self._find_ways(env, pose)
        table = np.asarray(env.task.actions, np.float64)
        count, actions = env.num_envs, len(table)
        ends, speed = self._think(env, pose, table)  # (N, A, T, 3), (N, A, T)
        room, people = self._room(env, ends)  # (N, A, T)
        people = np.where(np.abs(speed) < STANDING_MPS, 9.0, people)  # they stop before who stands
        arrived = self._arrived(env, ends)
        room[arrived] = people[arrived] = 9.0  # what comes after the goal does not matter
        flat = ends[:, :, -1].reshape(-1, 3)
        ways = np.repeat(self._ways, actions, axis=0)
        view = view_route(ways, flat[:, 0], flat[:, 1], flat[:, 2], (0.6,))
        ahead = view.look_ahead_m[:, 0]
        bearing = np.abs(np.arctan2(ahead[:, 1], ahead[:, 0]))
        score = -(view.remaining_m + 1.2 * view.offset_m + 0.5 * np.minimum(bearing, 2.0))
        score = score.reshape(count, actions)
        nearest = room.min(axis=2)
        score -= 2.0 * np.clip(ROOMY_M - nearest, 0.0, ROOMY_M) / ROOMY_M * (room[:, :, 0] > 0)
        score -= 8.0 * np.clip(PERSON_MARGIN_M - people.min(axis=2), 0.0, 1.0)
        when = np.argmax(np.minimum(room, people) < TOUCH_M, axis=2)
        hits = (np.minimum(room, people) < TOUCH_M).any(axis=2)
        score -= np.where(hits, 20.0 + 5.0 * (HORIZON - when), 0.0)
        icy = self._icy(env, pose)
        score -= np.where(icy[:, None] & harsh_actions(table)[None, :], 3.0, 0.0)
        score += 1.0 * arrived.any(axis=2)
        alone = people.min(axis=(1, 2)) > 0.6
        score[alone, 0] -= 0.2  # nobody to wait for
        # Whoever has stood for a while backs off, or tries something else that does not touch.
        tries = self._rng.random(score.shape) * 0.5 - 10.0 * hits
        tries[:, 0] -= 1.0
        tries[:, table[:, 0] < 0] += 1.0
        stood = self._standing(env, pose) & (alone | (self._still > PATIENCE_STEPS))
        score[stood] = tries[stood]
        return np.asarray(score.argmax(axis=1), np.int64)

    def certain(self, env: WarehouseVectorEnv) -> Bools:
        """No mistakes right beside people."""
        people = env.simulation.traffic.position_m - env.simulation.pose()[:, None, :2]
        near = np.hypot(people[..., 0], people[..., 1]) < CAREFUL_M
        return np.asarray(near.any(axis=1), np.bool_)

    def sees_trouble(self, env: WarehouseVectorEnv) -> Bools:
        """Where (N,) pallets, people or slippery floor are still about."""
        pose = env.simulation.pose()
        plans = env.navigation.plans_m
        view = view_route(plans, pose[:, 0], pose[:, 1], np.zeros(len(pose)), _LOOK_M)
        ahead = view.look_ahead_m + pose[:, None, :2]  # heading 0: offsets in the map frame
        gap = np.abs(ahead[:, :, None] - env.simulation.pallets[:, None, :, :2])
        half = pallet_half_m(env.simulation.pallets[:, None, :, 2])
        in_way = (gap < half + 0.35).all(axis=-1)
        traffic = env.simulation.traffic
        people = traffic.position_m - pose[:, None, :2]
        near = in_way.reshape(len(pose), -1).any(axis=1)
        near |= (np.hypot(people[..., 0], people[..., 1]) < 1.5).any(axis=1)
        return np.asarray(near | self._icy(env, pose), np.bool_)

    def _arrived(self, env: WarehouseVectorEnv, ends: F64) -> Bools:
        """From which step on (N, A, T) the robot has been at its goal."""
        gap = ends[..., :2] - env.navigation.goals_m[:, None, None]
        at_goal = np.hypot(gap[..., 0], gap[..., 1]) < env.task.goal_radius_m - 0.05
        return np.asarray(np.logical_or.accumulate(at_goal, axis=2), np.bool_)

    def _standing(self, env: WarehouseVectorEnv, pose: F64) -> Bools:
        """Who has not moved for a second, and for a few steps after."""
        moved = (np.abs(pose - self._anchor) > (0.1, 0.1, 0.2)).any(axis=1) | (env.steps == 0)
        self._anchor[moved] = pose[moved]
        self._still = np.where(moved, 0, self._still + 1)
        self._backing = np.where(
            self._still > 5,
            self._rng.integers(*BACK_STEPS, size=len(pose)),
            np.maximum(self._backing - 1, 0),
        )
        self._backing[env.steps == 0] = 0
        return self._backing > 0

    def _find_ways(self, env: WarehouseVectorEnv, pose: F64) -> None:
        """A way past the pallets at the start of each episode, and again where one has strayed."""
        if len(self._ways) != env.num_envs:
            self._prepare(env.num_envs)
        serial = env.episodes_begun
        stale = self._episode != serial
        offset = view_route(self._ways, pose[:, 0], pose[:, 1], pose[:, 2], ()).offset_m
        for index in np.flatnonzero(stale | (offset > 0.5)):
            goal = env.navigation.goals_m[index]
            x, y = float(pose[index, 0]), float(pose[index, 1])
            target = (float(goal[0]), float(goal[1]))
            pallets = env.simulation.pallets[index]
            pallets = pallets[pallets[:, 0] > 0]
            planner = env.navigation.planner_of(int(index))
            way = (
                planner.plan_around(x, y, target, pallets, PALLET_HALF_M[:2])
                if len(pallets)
                else None
            )
            self._ways[index] = planner.plan(x, y, target) if way is None else way
            self._episode[index] = serial[index]

    def _think(self, env: WarehouseVectorEnv, pose: F64, table: F64) -> tuple[F64, F64]:
        """Where each action, held, brings the robot: poses (N, A, T, 3) and speeds (N, A, T)."""
        period = env.task.control_period_s
        shape = (env.num_envs, len(table))
        x, y, yaw = (np.broadcast_to(pose[:, axis, None], shape) for axis in range(3))
        velocity = np.broadcast_to(env.simulation.controller.set_point[:, None], (*shape, 2))
        ends = np.empty((*shape, HORIZON, 3))
        speed = np.empty((*shape, HORIZON))
        for step in range(HORIZON):
            velocity = velocity + 0.8 * (table - velocity)
            middle = yaw + velocity[..., 1] * period / 2
            x = x + velocity[..., 0] * np.cos(middle) * period
            y = y + velocity[..., 0] * np.sin(middle) * period
            yaw = yaw + velocity[..., 1] * period
            ends[:, :, step] = np.stack([x, y, yaw], axis=-1)
            speed[:, :, step] = velocity[..., 0]
        return ends, speed

    def _room(self, env: WarehouseVectorEnv, ends: F64) -> tuple[F64, F64]:
        """Clearance (N, A, T) to racks, walls and pallets, and to people where they will be."""
        outline = _outline(env.task.body.length_m / 2, env.task.body.width_m / 2)
        outline[:, 0] -= env.simulation.robot.axle_x_m  # of the pose, ahead of the middle
        cos, sin = np.cos(ends[..., 2, None]), np.sin(ends[..., 2, None])
        x = ends[..., 0, None] + cos * outline[:, 0] - sin * outline[:, 1]  # (N, A, T, K)
        y = ends[..., 1, None] + sin * outline[:, 0] + cos * outline[:, 1]
        room = np.empty_like(x)
        for ids, floor in env.by_floor():
            room[ids] = _floor_gap(floor, x[ids], y[ids])
        pallets = env.simulation.pallets
        for column in range(pallets.shape[1]):
            ids = np.flatnonzero(pallets[:, column, 0] > 0)
            if len(ids):
                middle = pallets[ids, column, :2][:, None, None, None]
                half = pallet_half_m(pallets[ids, column, 2])[:, None, None, None]
                gap = _box_gap(
                    x[ids], y[ids], (middle[..., 0], middle[..., 1]), (half[..., 0], half[..., 1])
                )
                room[ids] = np.minimum(room[ids], gap)
        people = np.full(ends.shape[:3], 9.0)
        traffic = env.simulation.traffic
        ids = np.flatnonzero(traffic.active)
        if len(ids):
            later = (np.arange(HORIZON) + 1) * env.task.control_period_s
            arrived = traffic.travelled_m[ids] >= traffic.length_m[ids]
            walking = (traffic.state[ids] == WALKING) & ~arrived
            sign = np.where(walking, 1.0, np.where(traffic.state[ids] == RETREATING, -0.6, 0.0))
            speed = (traffic.speed_mps[ids] * sign)[..., None] * later  # (n, G, T)
            px = (
                traffic.position_m[ids, :, 0, None]
                + np.cos(traffic.heading_rad[ids])[..., None] * speed
            )
            py = (
                traffic.position_m[ids, :, 1, None]
                + np.sin(traffic.heading_rad[ids])[..., None] * speed
            )
            gap = np.hypot(
                x[ids][:, None] - px[:, :, None, :, None], y[ids][:, None] - py[:, :, None, :, None]
            )
            gap = gap.min(axis=4) - traffic.radius_m[None, :, None, None]
            standing = sign == 0.0  # one may pass nearer to who stands
            gap += np.where(standing, PERSON_MARGIN_M - STANDING_MARGIN_M, 0.0)[:, :, None, None]
            people[ids] = gap.min(axis=1)
        return room.min(axis=3), people

    def _icy(self, env: WarehouseVectorEnv, pose: F64) -> Bools:
        """Whether slippery floor lies under the robot or within .9 m of its middle, (N,)."""
        patches = env.simulation.patches
        gap = np.abs(pose[:, None, :2] - patches[:, :, :2]) - patches[:, :, 2:4]
        distance = np.hypot(np.maximum(gap[..., 0], 0), np.maximum(gap[..., 1], 0))
        return np.asarray((distance < 0.9).any(axis=1), np.bool_)


def _outline(half_length: float, half_width: float) -> F64:
    """Points on the body's outline, (K, 2)."""
    x = np.array([1, 1, 1, 0, 0, -1, -1, -1]) * half_length
    y = np.array([-1, 0, 1, -1, 1, -1, 0, 1]) * half_width
    return np.stack([x, y], axis=-1)


def _floor_gap(floor: Warehouse, x: F64, y: F64) -> F64:
    """From points to the nearest rack or wall; negative inside."""
    room = np.minimum(np.minimum(x, floor.width_m - x), np.minimum(y, floor.depth_m - y))
    for rack in floor.racks:
        room = np.minimum(room, _box_gap(x, y, rack.center, rack.half_size))
    return room


def _box_gap(
    x: F64,
    y: F64,
    center: tuple[float | F64, float | F64],
    half: tuple[float | F64, float | F64],
) -> F64:
    """From points to an axis-aligned box; negative inside."""
    dx, dy = np.abs(x - center[0]) - half[0], np.abs(y - center[1]) - half[1]
    outside = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0))
    gap: F64 = outside + np.minimum(np.maximum(dx, dy), 0)
    return gap
