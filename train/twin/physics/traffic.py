"""People and forklifts: each walks a given way once the robot comes near, and may not look out.

An attentive one stops .5 m off the robot. An inattentive one walks on into the way of a robot that
drives at them, and stops only before one that stands, turns or backs off. Whoever has waited for
2 s, or was touched, steps back and lets the robot pass. Movement is kinematic: traffic pushes the
robot, not the reverse.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.state import Stateful
from restock.train.twin.floors.obstacles import (
    AGENTS,
    FORKLIFT_HALF_M,
    FORKLIFTS,
    PARKED_M,
    PEOPLE,
    PERSON_RADIUS_M,
    WAY_POINTS,
    Walk,
)

FORKLIFT_RADIUS_M = 0.5  # of the circle that stands for it when it looks out
YIELD_M = 0.5
STANDING_M = 0.15  # how near an inattentive one comes to a robot that stands or backs off
RETREAT_M = 2.0  # how far off the robot a retreat ends
DRIVEN_AT_MPS = 0.15  # closing speed from which on a robot counts as driving at someone
WAIT_S = 2.0
HIDDEN, WAITING, WALKING, RETREATING = 0, 1, 2, 3
_TRUCK_HALF_M = FORKLIFT_HALF_M[:2]
_CORNERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])


class Traffic(Stateful):
    """The agents of N environments: positions over time. All arrays are (N, AGENTS, ...)."""

    # What changes on the way; ways and triggers are those of the episodes.
    STATE = (
        *("state", "travelled_m", "waited_s", "position_m", "heading_rad", "attentive"),
        "closest_m",
    )

    def __init__(self, num_envs: int, body_half_m: tuple[float, float]) -> None:
        shape = (num_envs, AGENTS)
        self.body_half_m = np.array(body_half_m)
        self.radius_m = np.array([PERSON_RADIUS_M] * PEOPLE + [FORKLIFT_RADIUS_M] * FORKLIFTS)
        circle_m = [PERSON_RADIUS_M] * PEOPLE + [float(np.hypot(*_TRUCK_HALF_M))] * FORKLIFTS
        self._reach_m = np.array(circle_m) + np.hypot(*body_half_m)  # of two middles that may touch
        # In the episode so far, from the robot's outline: infinite where nobody is about, NaN where
        # it is not measured, which takes time.
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
        """Lay out the ways of one environment's agents."""
        self.active[env] = any(walk is not None for walk in walks)
        self.state[env] = HIDDEN
        self.closest_m[env] = np.nan
        self.travelled_m[env] = self.waited_s[env] = self.heading_rad[env] = 0.0
        self.position_m[env] = PARKED_M[0]
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
        """Move the agents for `elapsed_s`; returns the environments where some are under way.

        `robot` (N, 3) is x, y, yaw, `velocity` (N, 2) in the map frame; `touched` (N,) says whose
        bumper was pressed in the time before.
        """
        ids = np.flatnonzero(self.active)
        if not len(ids):
            return ids
        trigger = self.trigger[ids]
        near = np.hypot(
            trigger[..., 0] - robot[ids, None, 0], trigger[..., 1] - robot[ids, None, 1]
        )
        starts = (self.state[ids] == WAITING) & (near <= trigger[..., 2])
        self.state[ids] = np.where(starts, WALKING, self.state[ids])
        ids = ids[(self.state[ids] >= WALKING).any(axis=1)]
        if not len(ids):
            return ids
        pose, state = robot[ids], self.state[ids]
        gap, toward = self._gap(ids, pose)
        careless = np.where(self._driven_at(ids, pose, velocity[ids]), 0.0, STANDING_M)
        look_out = np.where(self.attentive[ids], YIELD_M, careless)
        halted = (state == WALKING) & toward & (gap < look_out)
        waited = np.where(halted, self.waited_s[ids] + elapsed_s, 0.0)
        hit = touched[ids, None] & (gap < 0.2) & ((state == WALKING) | (state == RETREATING))
        self.attentive[ids] |= hit  # having been touched, one looks out
        state = np.where((hit & toward) | (waited > WAIT_S), RETREATING, state)
        state = np.where(
            (state == RETREATING) & ((gap > RETREAT_M) | (hit & ~toward)), WALKING, state
        )
        pace = np.where(state == RETREATING, -0.6, np.where((state == WALKING) & ~halted, 1.0, 0.0))
        travelled = self.travelled_m[ids] + pace * self.speed_mps[ids] * elapsed_s
        # Who is back at the start or at the end of the way leaves the floor, out of sight.
        left = ((travelled >= self.length_m[ids]) & (gap > 1.0)) | (
            (travelled <= 0.0) & (state == RETREATING)
        )
        self.state[ids] = np.where(left, HIDDEN, state)
        self.waited_s[ids] = waited
        self.travelled_m[ids] = np.clip(travelled, 0.0, self.length_m[ids])
        self._place(ids)
        return ids

    def gaps_m(self, pose: F64) -> F64:
        """From each agent's circle to the outline of a robot at `pose` (N, 3); inf: not there."""
        gaps = np.full(self.state.shape, np.inf)
        ids = np.flatnonzero(self.active)
        if len(ids):
            shown = self.state[ids] != HIDDEN
            gaps[ids] = np.where(shown, self._gap(ids, pose[ids])[0], np.inf)
        return gaps

    def _place(self, ids: Ints) -> None:
        """Positions from how far each has travelled along its way."""
        shown = self.state[ids] != HIDDEN
        share = self.travelled_m[ids] / self.length_m[ids] * (WAY_POINTS - 1)
        first = np.clip(share.astype(np.int64), 0, WAY_POINTS - 2)
        way = self.way_m[ids]
        start = np.take_along_axis(way, first[..., None, None], axis=2)[:, :, 0]
        end = np.take_along_axis(way, first[..., None, None] + 1, axis=2)[:, :, 0]
        step = end - start
        point = start + (share - first)[..., None] * step
        self.position_m[ids] = np.where(shown[..., None], point, PARKED_M[0])
        self.heading_rad[ids] = np.where(shown, np.arctan2(step[..., 1], step[..., 0]), 0.0)

    def _driven_at(self, ids: Ints, pose: F64, velocity: F64) -> Bools:
        """Which agents (n, AGENTS) the robot comes nearer to by driving."""
        delta = self.position_m[ids] - pose[:, None, :2]
        distance = np.maximum(np.hypot(delta[..., 0], delta[..., 1]), 1e-9)
        closing = (
            delta[..., 0] * velocity[:, None, 0] + delta[..., 1] * velocity[:, None, 1]
        ) / distance
        return np.asarray(closing > DRIVEN_AT_MPS, np.bool_)

    def note_closest(self, place_m: F64, yaw_of: Callable[[Ints], F64]) -> None:
        """Note how near anyone is to the robots' outlines now, (N, 2) their middles.

        `yaw_of` is asked where somebody may be nearer than ever in the episode.
        """
        ids = np.flatnonzero(self.active & ~np.isnan(self.closest_m))
        if not len(ids):
            return
        delta = self.position_m[ids] - place_m[ids, None]
        at_least = (np.hypot(delta[..., 0], delta[..., 1]) - self._reach_m).min(axis=1)
        nearer = at_least < self.closest_m[ids]
        if nearer.any():
            ids = ids[nearer]
            gap = self._outline_gap(ids, delta[nearer], yaw_of(ids)[:, None])
            self.closest_m[ids] = np.minimum(self.closest_m[ids], gap)

    def _outline_gap(self, ids: Ints, delta: F64, yaw: F64) -> F64:
        """From the robots' outlines to the nearest person, a circle, or forklift, a box, (n,).

        Args:
            delta: from the robots' middles to theirs, (n, AGENTS, 2); yaw: the robots', (n, 1).
        """
        gap = np.empty(delta.shape[:2])
        outside = _outside_m(_turned(delta[:, :PEOPLE], -yaw), self.body_half_m)
        gap[:, :PEOPLE] = outside - PERSON_RADIUS_M
        # Two rectangles apart are nearest at a corner of one of them.
        turn, truck = (self.heading_rad[ids, PEOPLE:] - yaw)[..., None], np.array(_TRUCK_HALF_M)
        away = _turned(delta[:, PEOPLE:], -yaw)[:, :, None]
        corners = away + _turned(_CORNERS * truck, turn)
        back = _turned(_CORNERS * self.body_half_m - away, -turn)
        gap[:, PEOPLE:] = np.minimum(
            _outside_m(corners, self.body_half_m).min(axis=-1), _outside_m(back, truck).min(axis=-1)
        )
        gap[self.state[ids] == HIDDEN] = np.inf
        return np.asarray(np.maximum(gap.min(axis=1), 0.0), np.float64)

    def _gap(self, ids: Ints, pose: F64) -> tuple[F64, Bools]:
        """From each agent's circle to the robot's outline, and whether it walks toward it."""
        delta = self.position_m[ids] - pose[:, None, :2]
        gap = _outside_m(_turned(delta, -pose[:, None, 2]), self.body_half_m) - self.radius_m
        heading = self.heading_rad[ids]
        toward = -(np.cos(heading) * delta[..., 0] + np.sin(heading) * delta[..., 1]) > 0
        return gap, toward


def _turned(vectors: F64, angle_rad: F64) -> F64:
    """Vectors (..., 2) turned to the left by angles that broadcast against (...)."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _outside_m(points: F64, half_m: F64) -> F64:
    """From a rectangle around 0 to points (..., 2); 0 inside."""
    outside = np.maximum(np.abs(points) - half_m, 0.0)
    return np.asarray(np.hypot(outside[..., 0], outside[..., 1]), np.float64)
