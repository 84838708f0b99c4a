"""Racks, pallets, people and forklifts around the robots, written into the batch.

Racks and walls are geoms, which are moved if an episode is on another floor. Pallets, people and
forklifts are mocap bodies.

A person or forklift moves along a given path once the robot comes near. An attentive one stops .5 m
from the robot. An inattentive one keeps walking toward a robot that drives at it, and stops only
before a robot that stands, turns or backs off. Whoever has waited for 2 s, or was touched, steps
back and lets the robot pass. Movement is kinematic: traffic pushes the robot, not the reverse.

Lidar beams are level, and everything on a floor stands upright: boxes, and cylinders for people. So
ranges are computed in the plane, by compiled code if it is in use (`restock.native`), which tests
each shape only against the beams that may hit it. Otherwise MuJoCo casts every ray against every
shape. The distances are the same up to rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from restock import native
from restock.arrays import F64, Bools, Ints, stacked
from restock.state import Stateful
from restock.train.twin.floors.layout import (
    AGENTS,
    FORKLIFT_HALF_M,
    FORKLIFTS,
    PALLETS,
    PARKED_M,
    PEOPLE,
    PERSON_RADIUS_M,
    WAY_POINTS,
    Walk,
    Warehouse,
)
from restock.train.twin.physics.episode import Episode
from restock.train.twin.physics.model import MOVING_HALF_M, Handles, building_boxes
from restock.train.twin.physics.robot_model import OBSTACLE_GROUP

FORKLIFT_RADIUS_M = 0.5  # radius of the circle that stands for a forklift when gaps are computed
YIELD_M = 0.5  # gap at which an attentive agent stops
STANDING_M = 0.15  # gap at which an inattentive agent stops, unless the robot drives at it
RETREAT_M = 2.0  # distance from the robot at which a retreat ends
DRIVEN_AT_MPS = 0.15  # a robot that closes in faster than this drives at someone
WAIT_S = 2.0  # an agent that a robot has stopped for longer retreats
HIDDEN, WAITING, WALKING, RETREATING = 0, 1, 2, 3
_TRUCK_HALF_M = FORKLIFT_HALF_M[:2]
_EACH = np.arange(AGENTS)
_CORNERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])


class Traffic(Stateful):
    """The people and forklifts of N environments over time. Arrays are (N, AGENTS, ...)."""

    # What changes during an episode. The episode itself has the paths and triggers.
    STATE = (
        *("state", "travelled_m", "waited_s", "position_m", "heading_rad", "attentive"),
        "closest_m",
    )

    def __init__(self, num_envs: int, body_half_m: tuple[float, float]) -> None:
        shape = (num_envs, AGENTS)
        self.body_half_m = np.array(body_half_m)
        self.radius_m = np.array([PERSON_RADIUS_M] * PEOPLE + [FORKLIFT_RADIUS_M] * FORKLIFTS)
        circle_m = [PERSON_RADIUS_M] * PEOPLE + [float(np.hypot(*_TRUCK_HALF_M))] * FORKLIFTS
        self._reach_m = np.array(circle_m) + np.hypot(*body_half_m)  # farther centres: no contact
        # Smallest gap to the robot's outline in the episode so far: inf if nobody is there, NaN if
        # it is not measured, because measuring takes time.
        self.closest_m = np.full(num_envs, np.nan)
        self.way_m = np.zeros((*shape, WAY_POINTS, 2))
        self.length_m = np.ones(shape)
        self.speed_mps = np.zeros(shape)
        self.trigger = np.zeros((*shape, 3))
        self.attentive = np.zeros(shape, np.bool_)
        self.state = np.full(shape, HIDDEN)
        self.travelled_m = np.zeros(shape)
        self.waited_s = np.zeros(shape)
        self.position_m = np.full((*shape, 2), PARKED_M[0])
        self.heading_rad = np.zeros(shape)
        self.active = np.zeros(num_envs, np.bool_)  # whether the environment has any traffic

    def reset(self, env: int, walks: tuple[Walk | None, ...]) -> None:
        """Set the paths of one environment's agents."""
        self.active[env] = any(walk is not None for walk in walks)
        self.state[env] = HIDDEN
        self.closest_m[env] = np.nan
        self.travelled_m[env] = self.waited_s[env] = self.heading_rad[env] = 0.0
        for agent, walk in enumerate(walks):
            if walk is not None:
                self.state[env, agent] = WAITING
                self.way_m[env, agent] = walk.way_m
                self.length_m[env, agent] = np.hypot(*np.diff(walk.way_m, axis=0).T).sum()
                self.speed_mps[env, agent] = walk.speed_mps
                self.trigger[env, agent] = walk.trigger
                self.attentive[env, agent] = walk.attentive
        self._place(np.array([env]))

    def advance(self, robot: F64, velocity: F64, touched: Bools, elapsed_s: float) -> Ints:
        """Move the agents for `elapsed_s`; return the environments where any agent is under way.

        `robot` (N, 3) is x, y, yaw. `velocity` (N, 2) is in the map frame. `touched` (N,) are the
        robots whose bumper was pressed in the previous block.
        """
        (ids,) = self.active.nonzero()
        if not len(ids):
            return ids
        trigger, pose, state = self.trigger[ids], robot[ids], self.state[ids]
        near = np.hypot(trigger[..., 0] - pose[:, :1], trigger[..., 1] - pose[:, 1:2])
        state[(state == WAITING) & (near <= trigger[..., 2])] = WALKING
        self.state[ids] = state
        under_way = (state >= WALKING).any(axis=1)
        ids, pose, state = ids[under_way], pose[under_way], state[under_way]
        if not len(ids):
            return ids
        delta = self.position_m[ids] - pose[:, None, :2]
        gap, attentive = self._gap(delta, pose[:, 2:]), self.attentive[ids]
        heading = self.heading_rad[ids]
        toward = -(np.cos(heading) * delta[..., 0] + np.sin(heading) * delta[..., 1]) > 0
        careless = np.where(_drives_at(delta, velocity[ids, None]), 0.0, STANDING_M)
        look_out = np.where(attentive, YIELD_M, careless)
        walking = state == WALKING
        halted = walking & toward & (gap < look_out)
        waited = np.where(halted, self.waited_s[ids] + elapsed_s, 0.0)
        hit = touched[ids, None] & (gap < 0.2) & (walking | (state == RETREATING))
        self.attentive[ids] = attentive | hit  # an agent that was touched is attentive from then on
        state = np.where((hit & toward) | (waited > WAIT_S), RETREATING, state)
        state[(state == RETREATING) & ((gap > RETREAT_M) | (hit & ~toward))] = WALKING
        retreating, length_m = state == RETREATING, self.length_m[ids]
        pace = np.where(retreating, -0.6, np.where((state == WALKING) & ~halted, 1.0, 0.0))
        travelled = self.travelled_m[ids] + pace * self.speed_mps[ids] * elapsed_s
        # Agents at the end of their path, or back at its start, leave the floor.
        state[((travelled >= length_m) & (gap > 1.0)) | ((travelled <= 0.0) & retreating)] = HIDDEN
        self.state[ids] = state
        self.waited_s[ids] = waited
        self.travelled_m[ids] = np.minimum(np.maximum(travelled, 0.0), length_m)
        self._place(ids)
        return ids

    def gaps_m(self, pose: F64) -> F64:
        """Return gaps from agents' circles to robots' outlines at `pose` (N, 3); inf if absent."""
        gaps = np.full(self.state.shape, np.inf)
        (ids,) = self.active.nonzero()
        if len(ids):
            near = pose[ids]
            gap = self._gap(self.position_m[ids] - near[:, None, :2], near[:, 2:])
            gaps[ids] = np.where(self.state[ids] != HIDDEN, gap, np.inf)
        return gaps

    def _place(self, ids: Ints) -> None:
        """Set positions from how far each agent has gone along its path."""
        shown = self.state[ids] != HIDDEN
        share = self.travelled_m[ids] / self.length_m[ids] * (WAY_POINTS - 1)
        first = share.astype(np.int64).clip(0, WAY_POINTS - 2)
        start = self.way_m[ids[:, None], _EACH, first]
        step = self.way_m[ids[:, None], _EACH, first + 1] - start
        point = start + (share - first)[..., None] * step
        self.position_m[ids] = np.where(shown[..., None], point, PARKED_M[0])
        self.heading_rad[ids] = np.where(shown, np.arctan2(step[..., 1], step[..., 0]), 0.0)

    def note_closest(self, robot: F64) -> None:
        """Update `closest_m` with the agents' gaps to outlines of robots at (N, 3): x, y, yaw."""
        (ids,) = (self.active & ~np.isnan(self.closest_m)).nonzero()
        if not len(ids):
            return
        delta = self.position_m[ids] - robot[ids, None, :2]
        at_least = (np.hypot(delta[..., 0], delta[..., 1]) - self._reach_m).min(axis=1)
        nearer = at_least < self.closest_m[ids]
        if nearer.any():
            ids = ids[nearer]
            gap = self._outline_gap(ids, delta[nearer], robot[ids, 2:])
            self.closest_m[ids] = np.minimum(self.closest_m[ids], gap)

    def _outline_gap(self, ids: Ints, delta: F64, yaw: F64) -> F64:
        """Return the gap (n,) from robots' outlines to the nearest person or forklift.

        Args:
            delta: vectors from the robots' centres to the agents, (n, AGENTS, 2).
            yaw: headings of the robots, (n, 1).
        """
        gap = np.empty(delta.shape[:2])
        outside = _distance_m(_rotate(delta[:, :PEOPLE], -yaw), self.body_half_m)
        gap[:, :PEOPLE] = outside - PERSON_RADIUS_M
        # Two separate rectangles are nearest to each other at a corner of one of them.
        turn, truck = (self.heading_rad[ids, PEOPLE:] - yaw)[..., None], np.array(_TRUCK_HALF_M)
        away = _rotate(delta[:, PEOPLE:], -yaw)[:, :, None]
        corners = away + _rotate(_CORNERS * truck, turn)
        back = _rotate(_CORNERS * self.body_half_m - away, -turn)
        gap[:, PEOPLE:] = np.minimum(
            _distance_m(corners, self.body_half_m).min(axis=-1),
            _distance_m(back, truck).min(axis=-1),
        )
        gap[self.state[ids] == HIDDEN] = np.inf
        return np.asarray(np.maximum(gap.min(axis=1), 0.0), np.float64)

    def _gap(self, delta: F64, yaw: F64) -> F64:
        """Return gaps (n, AGENTS) from agents' circles to outlines; arguments of `_outline_gap`."""
        gap: F64 = _distance_m(_rotate(delta, -yaw), self.body_half_m) - self.radius_m
        return gap


def _drives_at(delta: F64, velocity: F64) -> Bools:
    """Return which agents (n, AGENTS) a robot approaches with its velocity (n, 1, 2)."""
    x, y = delta[..., 0], delta[..., 1]
    closing = (x * velocity[..., 0] + y * velocity[..., 1]) / np.maximum(np.hypot(x, y), 1e-9)
    return np.asarray(closing > DRIVEN_AT_MPS, np.bool_)


def _rotate(vectors: F64, angle_rad: F64) -> F64:
    """Rotate vectors (..., 2) to the left by angles that broadcast against (...)."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    x, y = vectors[..., 0], vectors[..., 1]
    return stacked(cos * x - sin * y, sin * x + cos * y)


def _distance_m(points: F64, half_m: F64) -> F64:
    """Return the distance from a rectangle around the origin to points (..., 2); 0 inside."""
    outside = np.maximum(np.abs(points) - half_m, 0.0)
    return np.asarray(np.hypot(outside[..., 0], outside[..., 1]), np.float64)


class Scenery(Stateful):
    """The scenery of N warehouses. The first axis of arrays is the environment."""

    STATE = ("walked", "traffic")

    def __init__(
        self,
        batch: Any,
        handles: Handles,
        floors: Sequence[Warehouse],
        rack_slots: int,
        robot_half_m: tuple[float, float],
        lidar_z_m: float,
        moves: F64,
    ) -> None:
        """Build the scenery of N warehouses.

        `moves` (N, substeps, 3 * nmocap) are the mocap positions of the next block. The scenery
        writes them, and the simulation reads them.
        """
        num_envs = len(moves)
        self.batch, self.handles, self.moves = batch, handles, moves
        self.traffic = Traffic(num_envs, robot_half_m)
        self.pallets = np.full((num_envs, PALLETS, 3), PARKED_M[0])
        self.walked = np.zeros(0, np.int64)  # environments whose traffic moved in the last block
        self.position_m = batch.bind("mocap_pos")  # (N, nmocap, 3) of pallets, people, forklifts
        self.quat = batch.bind("mocap_quat")
        self.buildings = [building_boxes(floor, rack_slots, lidar_z_m) for floor in floors]
        self.floor = np.zeros(num_envs, np.int64)  # floor whose racks and walls are placed

    def build(self, env: int, floor: int) -> None:
        """Place the racks and walls of a floor."""
        if floor == self.floor[env]:
            return
        self.floor[env] = floor
        where, (middle, half) = self.handles.building, self.buildings[floor]
        self.batch.expand("geom_pos")[env, where] = middle
        self.batch.expand("geom_size")[env, where] = half
        self.batch.expand("geom_aabb")[env, where, 3:] = half
        self.batch.expand("geom_rbound")[env, where] = np.sqrt((half**2).sum(axis=1))

    def reset(self, env: int, episode: Episode) -> None:
        """Place pallets, people and forklifts as an episode begins."""
        self.pallets[env] = episode.pallets
        self.position_m[env, :, :2] = PARKED_M[:2]
        self.position_m[env, :, 2] = MOVING_HALF_M[:, 2]  # they stand on the floor
        self.quat[env, :, :] = (1.0, 0.0, 0.0, 0.0)
        span = self.handles.pallets
        self.position_m[env, span, :2] = episode.pallets[:, :2]
        self.quat[env, span] = quaternion(episode.pallets[:, 2])
        self.traffic.reset(env, episode.walks)
        ids = np.array([env])
        self._show_traffic(ids)
        self.stand_still(ids)

    def walk(self, ids: Ints) -> None:
        """Move the traffic of `ids` to its current positions over the next block.

        It moves a little at every substep: one jump per block would strike the robot like a hammer.
        """
        self.stand_still(self.walked)  # else traffic that stops now would repeat its last moves
        self.walked = ids
        if not len(ids):
            return
        begin = self.position_m[ids][:, None]
        self._show_traffic(ids)
        end = self.position_m[ids][:, None]
        substeps, way = self.moves.shape[1], end - begin
        share = ((np.arange(substeps) + 1) / substeps)[None, :, None, None]
        jumped = (np.abs(way) > 1.0).any(axis=-1, keepdims=True)
        path = np.where(jumped, end, begin + share * way)
        self.moves[ids] = path.reshape(len(ids), substeps, -1)

    def stand_still(self, ids: Ints) -> None:
        """Keep everything in `ids` in place during the next block."""
        self.moves[ids] = self.position_m[ids].reshape(len(ids), 1, self.moves.shape[2])

    def restored(self) -> None:
        """Keep all bodies where the restored physics has them."""
        self.stand_still(np.arange(len(self.moves)))

    def _show_traffic(self, ids: Ints) -> None:
        if len(ids):
            people = slice(self.handles.people.start, self.handles.forklifts.stop)
            self.position_m[ids, people, :2] = self.traffic.position_m[ids]
            self.quat[ids, people] = quaternion(self.traffic.heading_rad[ids])


def quaternion(yaw_rad: F64) -> F64:
    """Return unit quaternions (..., 4), w first, of headings (...)."""
    half = yaw_rad / 2
    zero = np.zeros_like(half)
    return stacked(np.cos(half), zero, zero, np.sin(half))


FAR_AWAY = (1e9, 1e9, 1.0, 0.0, 0.1, 0.1)  # stands for a shape that beams pass over or under


class Lidar:
    """The beams of N lidars, `height_m` above the floor."""

    def __init__(self, batch: Any, scenery: Scenery, bearings_rad: F64, height_m: float) -> None:
        """Set up lidars; `bearings_rad` (beams,) are relative to the robot's heading."""
        self.batch, self.scenery, self.height_m = batch, scenery, height_m
        self._beam = np.stack([np.cos(bearings_rad), np.sin(bearings_rad)], axis=-1)
        self._order = np.argsort(bearings_rad)
        self._bearing = np.ascontiguousarray(bearings_rad[self._order])
        self._groups = np.zeros(6, np.uint8)
        self._groups[OBSTACLE_GROUP] = 1
        standing = [self._cut_boxes(*boxes) for boxes in scenery.buildings]
        self._first = np.cumsum([0, *(len(boxes) for boxes in standing)])
        self._standing = np.concatenate(standing)
        self._half_m = MOVING_HALF_M[:, :2].copy()  # half sizes of pallets, people, forklifts
        self._half_m[scenery.handles.people, 1] = 0.0  # marks a cylinder

    def _cut_boxes(self, middle: F64, half: F64) -> F64:
        """Return the boxes (G, 4) that the beams' plane cuts: x, y and half sizes."""
        cut = np.abs(middle[:, 2] - self.height_m) <= half[:, 2]
        return np.column_stack([middle[cut, :2], half[cut, :2]])

    def ranges(self, ids: Ints, place_m: F64, heading_rad: F64) -> F64:
        """Return distances (n, beams) in metres from lidars at (n, 2); inf if nothing is hit."""
        cos, sin = np.cos(heading_rad), np.sin(heading_rad)
        rays = np.empty((len(ids), len(self._beam), 2))
        rays[..., 0] = cos[:, None] * self._beam[:, 0] - sin[:, None] * self._beam[:, 1]
        rays[..., 1] = sin[:, None] * self._beam[:, 0] + cos[:, None] * self._beam[:, 1]
        if not native.IS_USED:
            return self._cast(ids, place_m, rays)
        ranges = np.empty(rays.shape[:2])
        native.compiled.ranges(
            np.ravel(place_m),
            np.ascontiguousarray(heading_rad),
            rays.reshape(-1),
            self._bearing,
            self._order,
            self.scenery.floor[ids],
            self._first,
            self._standing.reshape(-1),
            self._moving_shapes(ids).reshape(-1),
            ranges.reshape(-1),
        )
        return ranges

    def _moving_shapes(self, ids: Ints) -> F64:
        """Return x, y, cos, sin and half sizes (n, M, 6) of mocap bodies for `compiled.ranges`."""
        position, quat = self.scenery.position_m[ids], self.scenery.quat[ids]
        shapes = np.empty((*position.shape[:2], 6))
        shapes[..., :2] = position[..., :2]
        shapes[..., 2] = quat[..., 0] * quat[..., 0] - quat[..., 3] * quat[..., 3]
        shapes[..., 3] = 2 * (quat[..., 0] * quat[..., 3])
        shapes[..., 4:] = self._half_m
        above = np.abs(position[..., 2] - self.height_m) > MOVING_HALF_M[:, 2]
        shapes[above] = FAR_AWAY
        return shapes

    def _cast(self, ids: Ints, place_m: F64, rays: F64) -> F64:
        """Return the ranges by MuJoCo's ray casting."""
        origin = np.full((len(ids), 1, 3), self.height_m)
        origin[:, 0, :2] = place_m
        level = np.zeros((*rays.shape[:2], 3))
        level[..., :2] = rays
        distance = self.batch.ray(origin, level, self._groups, ids=ids)[0]
        return np.where(distance < 0, np.inf, distance)
