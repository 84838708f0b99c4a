"""Navigation of N robots, and the truth of their steps: plans, conditions and `info`.

A robot replans when it strays from its plan, or when `BlockFinder` sees in its lidar scans that an
aisle is wholly blocked. The block is remembered for the rest of the episode.

`Truth` computes the true conditions of every step from the simulator, so that labels can be scored
against them. They are the physical truth over [t, t + 1), with the names of the task's conditions:

- wheel_slip: a wheel stood on a slippery patch and moved over the floor by more than the task's
  `slip_limit_mps`;
- near_collision: at t + 1 something was nearer to the body than the task's `tight_clearance_m`, or
  the bumper was pressed;
- recovery: after a near_collision, until there was twice that room or 2 s had passed, as of t;
- blocked_aisle: at t, pallets lay on the plan within 1.2 m of the robot's middle.

Exposures are the situation at t, whatever the outcome:

- closing_traffic: someone within 2 m of the body came nearer, above .1 m/s, in the previous step;
- plan_blocked: pallets lay on the plan within 2.2 m of the robot's middle;
- slippery_floor: a wheel stood on a slippery patch.

Several may hold at once. A step's text lists all that hold, sorted and separated by commas, or is
"nominal" if none holds. `restock.ingest.task.schema.primary_of` chooses one of them.

`docs/twin.md` lists what `info` holds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints, stacked
from restock.ingest.task.schema import truth_text
from restock.ingest.task.surroundings import view_route
from restock.ingest.task.task import Body, Signals, Task, reached_goal
from restock.state import Stateful
from restock.train.twin.env.interface import Info
from restock.train.twin.floors.layout import AGENTS, Warehouse, pallet_half_m
from restock.train.twin.floors.planner import (
    CLOSURE_STEP_M,
    PLAN_POINTS,
    Closure,
    Planner,
    planners,
)
from restock.train.twin.missions import MISSIONS
from restock.train.twin.missions.mission import Situation
from restock.train.twin.physics.episode import Episode
from restock.train.twin.physics.sensing import Sensing, add_route
from restock.train.twin.physics.simulation import Simulation

if TYPE_CHECKING:
    from restock.train.twin.env.vector_env import WarehouseVectorEnv


@dataclass
class BlockFinder(Stateful):
    """A detector of wholly blocked aisles in the lidar scans of N robots over time.

    It looks at lidar returns up to `reach_m` ahead, in the aisle segment, that are neither rack nor
    wall. If they leave no gap of `passable_m` across the aisle for `persistence` successive steps
    at the same place, the aisle is blocked there. `floor` (N,) is each robot's index in `floors`.
    """

    STATE = ("seen", "place")

    floors: Sequence[Warehouse]
    num: int
    reach_m: float = 2.0
    passable_m: float = 0.6
    persistence: int = 3

    def __post_init__(self) -> None:
        self.seen = np.zeros(self.num, np.int64)  # successive steps with a block at one place
        self.place = np.full((self.num, 2), -1, np.int64)  # closure of the last sighting
        self.floor = np.zeros(self.num, np.int64)

    def reset(self, ids: Ints) -> None:
        self.seen[ids] = 0
        self.place[ids] = -1

    def update(
        self,
        ids: Ints,
        pose: F64,
        hits_m: F64,
        valid: Bools,
        heading: F64,
        turned: Bools,
    ) -> list[tuple[int, Closure]]:
        """Process one scan of each robot in `ids`; return (robot, closure) for each block found.

        `pose` (n, 3) is localised. `hits_m` (n, B, 2) are points in the map frame, of which `valid`
        (n, B) are returns. `heading` (n,) is the sign of the direction along x, or along y for
        robots whose plan mostly runs along y (`turned`, (n,)).
        """
        segment, edges = self._segments_ahead(ids, pose, heading, turned)
        x, y, here = hits_m[..., 0], hits_m[..., 1], pose[:, :1]
        if turned.any():
            swap = turned[:, None]
            x, y, here = (
                np.where(swap, y, x),
                np.where(swap, x, y),
                np.where(swap, pose[:, 1:2], here),
            )
        ahead = (x - here) * heading[:, None]
        west, south, east, north = (edges[:, side, None] for side in range(4))
        rack = 0.1  # returns this near to a rack are the rack
        obstacle = valid & (segment >= 0)[:, None] & (ahead > 0.1) & (ahead < self.reach_m)
        obstacle &= (y > south + rack) & (y < north - rack) & (x > west - 0.1) & (x < east + 0.1)
        face = np.minimum.reduce(np.where(obstacle, ahead, np.inf), axis=1)
        obstacle &= ahead < face[:, None] + 0.5
        across = np.concatenate([south, np.where(obstacle, y, north), north], axis=1)
        across.sort(axis=1)
        gap = np.maximum.reduce(across[:, 1:] - across[:, :-1], axis=1)
        shut = obstacle.any(axis=1) & (gap < self.passable_m)
        middle = here[:, 0] + heading * (np.where(shut, face, 0.0) + 0.3)
        step = ((middle - edges[:, 0]) / CLOSURE_STEP_M).astype(np.int64)
        step = step.clip(0, ((edges[:, 2] - edges[:, 0]) / CLOSURE_STEP_M).astype(np.int64) - 1)
        place, before, seen = stacked(segment, step), self.place[ids], self.seen[ids]
        same = (segment == before[:, 0]) & (np.abs(step - before[:, 1]) <= 1)
        self.seen[ids] = seen = np.where(shut, np.where(same, seen + 1, 1), 0)
        self.place[ids] = np.where(shut[:, None], place, -1)
        (blocked,) = (seen >= self.persistence).nonzero()
        self.seen[ids[blocked]] = 0
        return [(int(ids[k]), (int(place[k, 0]), int(place[k, 1]))) for k in blocked]

    def _segments_ahead(
        self,
        ids: Ints,
        pose: F64,
        heading: F64,
        turned: Bools,
    ) -> tuple[Ints, F64]:
        """Return the aisle segment (n,) each robot is in, or the one just ahead of it; -1 if none.

        Also returns the segments' edges (n, 4), x and y exchanged for robots that are `turned`.
        Only segments along the robot's direction count.
        """
        segment = np.full(len(ids), -1, np.int64)
        edges = np.zeros((len(ids), 4))
        x, y = np.array([pose[:, :2], pose[:, :2]]).transpose(2, 0, 1)  # (2, n): ahead, and here
        x[0] += 0.8 * heading * ~turned
        y[0] += 0.8 * heading * turned
        floors = self.floor[ids]
        for number in set(floors.tolist()):
            warehouse = self.floors[number]
            (on,) = (floors == number).nonzero()
            if not len(warehouse.segments):
                continue
            inside = warehouse.segment_of(x[:, on].ravel(), y[:, on].ravel()).reshape(2, -1)
            fits = (inside >= 0) & (warehouse.segment_along_y[inside] == turned[on])
            then, now = np.where(fits, inside, -1)
            segment[on] = np.where(now >= 0, now, then)
            edges[on] = warehouse.segment_edges[segment[on]]
        return segment, np.where(turned[:, None], edges[:, [1, 0, 3, 2]], edges)


STRAYED_M = 0.6
LOOK_M = 1.9  # the block finder reads a scan only if something is this near ahead

# Speeds and outline of the stand-in, and the room that it needs to turn on the spot. The path
# follower is tuned for it, and is scaled for other robots.
FASTEST_MPS, FASTEST_RADPS = 1.0, 1.2
STAND_IN, PIVOT_M = Body(length_m=0.70, width_m=0.50), 0.14
STANDING_SHARE = 0.2  # factor on stopping and slowing distances as the top speed nears 0


class Navigation(Stateful):
    """Plans and goals of N robots, each on one of `floors`.

    If `proposes` is true and the task has a route, `propose` adds the next command to signals.
    """

    STATE = ("plans_m", "plan_number", "closures", "finder")
    STATE_TYPES: ClassVar[Mapping[str, Any]] = {"closures": list[list[Closure]]}

    def __init__(
        self, floors: Sequence[Warehouse], num_envs: int, task: Task, *, proposes: bool = True
    ) -> None:
        self.task = task
        self._follower = PathFollower(task) if proposes and task.goal == "route" else None
        self.planners = planners(floors)
        self.finder = BlockFinder(floors, num_envs)
        self.floor = self.finder.floor  # (N,) index of each robot's floor
        self._any_along_y = any(floor.segment_along_y.any() for floor in floors)
        self.plans_m = np.zeros((num_envs, PLAN_POINTS, 2))
        self.goals_m = np.zeros((num_envs, 2))
        self.closures: list[list[Closure]] = [[] for _ in range(num_envs)]
        self.plan_number = np.zeros(num_envs, np.int64)  # rises with every new plan

    def planner_of(self, env: int) -> Planner:
        """Return the planner of the floor that a robot is on."""
        return self.planners[int(self.floor[env])]

    def reset(self, env: int, episode: Episode, floor: int = 0) -> None:
        """Begin an episode with its first plan."""
        self.floor[env] = floor
        self.plans_m[env], self.goals_m[env] = episode.plan_m, episode.goal
        self.closures[env] = []
        self.plan_number[env] += 1
        self.finder.reset(np.array([env]))

    def add_route(self, signals: Signals, ids: Ints | slice = slice(None)) -> F64:
        """Add the signals of plans and goals; return robots' distances (n,) from their plans."""
        return add_route(self.task, signals, self.plans_m[ids], self.goals_m[ids])

    def update(self, signals: Signals, offset_m: F64, sensing: Sensing) -> None:
        """Replan for robots that have strayed or found a block, and put new plans into the signals.

        Call this after computing the step's progress, so that a new plan does not change it.
        """
        replanned = set((offset_m > STRAYED_M).nonzero()[0].tolist())
        replanned |= self._find_blocks(signals, sensing)
        for env in replanned:
            self.plans_m[env] = self.planner_of(env).plan(
                float(signals["pose_x_m"][env]),
                float(signals["pose_y_m"][env]),
                (float(self.goals_m[env, 0]), float(self.goals_m[env, 1])),
                self.closures[env],
            )
            self.plan_number[env] += 1
        if replanned:
            ids = np.array(sorted(replanned), np.int64)
            rows: Signals = {name: column[ids] for name, column in signals.items()}
            self.add_route(rows, ids)
            for name, column in rows.items():
                signals[name][ids] = column

    def propose(self, signals: Signals) -> None:
        """Add navigation's next command to the signals; NaN if navigation proposes none."""
        command: F64 = np.full((len(signals["stamp_ns"]), 2), np.nan)
        if self._follower is not None:
            command = self._follower.table[self._follower.choose(signals)]
        signals["nav_speed_mps"], signals["nav_yaw_rate_radps"] = command.T.copy()

    def _find_blocks(self, signals: Signals, sensing: Sensing) -> set[int]:
        """Look for blocked aisles if something is near ahead; return robots with a new block."""
        yaw = signals["pose_yaw_rad"]
        toward_x = (
            np.cos(yaw) * signals["waypoint_near_x_m"] - np.sin(yaw) * signals["waypoint_near_y_m"]
        )
        near_ahead = signals["clearance_ahead_m"] < LOOK_M
        if self._any_along_y:
            toward_y = (
                np.sin(yaw) * signals["waypoint_near_x_m"]
                + np.cos(yaw) * signals["waypoint_near_y_m"]
            )
            along_y = np.abs(toward_y) > np.abs(toward_x)
            toward = np.where(along_y, toward_y, toward_x)
        else:
            along_y, toward = np.zeros(len(yaw), np.bool_), toward_x
        (ids,) = (near_ahead & (np.abs(toward) > 0.4)).nonzero()
        if not len(ids):
            return set()
        ranges = sensing.ranges_m[ids]
        pose = stacked(signals["pose_x_m"], signals["pose_y_m"], yaw)[ids]
        sim, turned = sensing.simulation, self.task.body.lidar_yaw_rad
        bearing = pose[:, 2, None] + (sim.bearings_rad + turned)
        valid = (ranges > self.task.range_min_m) & np.isfinite(ranges)
        reach = np.where(valid, ranges, 0.0)
        ahead = sim.lidar_x_m
        hits = stacked(
            (pose[:, 0] + ahead * np.cos(pose[:, 2]))[:, None] + reach * np.cos(bearing),
            (pose[:, 1] + ahead * np.sin(pose[:, 2]))[:, None] + reach * np.sin(bearing),
        )
        heading = np.sign(toward[ids])
        blocks = self.finder.update(ids, pose, hits, valid, heading, along_y[ids])
        changed = set()
        for env, closure in blocks:
            if closure not in self.closures[env]:
                self.closures[env].append(closure)
                changed.add(env)
        return changed


class PathFollower:
    """A driver that follows the plan, slows for turns and obstacles, and stops before them.

    It uses only what the robot senses: waypoints and lidar clearances. It never leaves its plan, so
    a pallet that blocks part of the aisle stops it for good. Without a lidar it detects nothing: it
    follows the plan and never stops for an obstacle.

    Args:
        stop_m: an obstacle this near ahead stops a robot that drives 1 m/s.
        slow_m: an obstacle this near ahead slows it down. Both distances are scaled down for a
            slower robot, which needs less room to stop.
    """

    def __init__(self, task: Task, *, stop_m: float = 0.30, slow_m: float = 0.80) -> None:
        self.table = np.asarray(task.actions, np.float64)  # (A, 2)
        fastest, turning = np.abs(self.table).max(axis=0)
        self._pace = np.minimum([fastest / FASTEST_MPS, turning / FASTEST_RADPS], 1.0)
        slower = STANDING_SHARE + (1.0 - STANDING_SHARE) * self._pace[0]
        self.stop_m, self.slow_m = stop_m * slower, slow_m * slower
        self.pivot_m = PIVOT_M * (_corner_m(task.body) / _corner_m(STAND_IN))
        self.lidar = task.lidar
        half = max(round(task.sectors * 30 / 360), 1)
        self._ahead = slice(task.sectors // 2 - half, task.sectors // 2 + half)
        self._behind = np.r_[0:half, task.sectors - half : task.sectors]
        # Rows: fast, slow; columns: straight on, to the left, to the right.
        bends = [((1.0, 0.0), (0.8, 0.7), (0.8, -0.7)), ((0.4, 0.0), (0.35, 0.6), (0.35, -0.6))]
        self._drive = np.array([[self._index(*velocity) for velocity in row] for row in bends])
        self._pivot = np.array([0, self._index(0.0, 1.2), self._index(0.0, -1.2)])
        # A robot that steers has no action that turns on the spot: it turns in several moves.
        self._steers = not (self.table[:, 1] != 0)[self.table[:, 0] == 0].any()
        self._back = np.array([0, self._index(-0.4, 0.6), self._index(-0.4, -0.6)])

    def choose(self, signals: Signals) -> Ints:
        """Return the actions (N,) whose velocities are nearest to those that the plan requires."""
        near = np.arctan2(signals["waypoint_near_y_m"], signals["waypoint_near_x_m"])
        far = np.arctan2(signals["waypoint_far_y_m"], signals["waypoint_far_x_m"])
        front, bend = self.front(signals), np.abs(near)
        slow = (
            (np.abs(far) > 0.5) | (front < self.slow_m) | (signals["goal_distance_m"] < self.slow_m)
        )
        side = np.where(near > 0, 1, 2)  # left, right
        careful = (slow | (bend > 0.45)) & (bend > 0.12)
        action = self._drive[(slow | careful).astype(np.intp), np.where(bend > 0.12, side, 0)]
        action[front < self.stop_m] = 0
        if self._steers:
            return self._turn_in_moves(signals, action, front, bend, side)
        pivot = (bend > 0.9) & ~(signals["clearance_m"] <= self.pivot_m)  # allowed if NaN (unknown)
        return np.where(pivot, self._pivot[side], action)

    def _turn_in_moves(
        self, signals: Signals, action: Ints, front: F64, bend: F64, side: Ints
    ) -> Ints:
        """Return the actions (N,) of steered robots that turn by driving forward and back.

        They turn if the plan leads away from their heading; other robots keep `action`.
        """
        backs = signals["wheel_speed_mps"] < -0.05  # continue a move that has begun
        behind = self._nearest(signals, self._behind)
        turns = (bend > 0.9) | ((bend > 0.3) & (backs | (front < self.stop_m)))
        room = np.where(backs, self.slow_m, self.stop_m)  # clearance needed ahead to drive on
        back = (front < room) & (behind > self.stop_m / 2)
        forward = np.where(front < self.stop_m / 2, 0, self._drive[1, side])
        return np.where(turns, np.where(back, self._back[side], forward), action)

    def front(self, signals: Signals) -> F64:
        """Return the clearance (N,) within 30 degrees of straight ahead; inf without a lidar."""
        return self._nearest(signals, self._ahead)

    def _nearest(self, signals: Signals, sectors: slice | NDArray[np.intp]) -> F64:
        if not self.lidar:
            return np.full(len(signals["clearance_m"]), np.inf)
        nearest: F64 = signals["sector_clearance_m"][:, sectors].min(axis=1)
        return nearest

    def near(self, signals: Signals) -> Bools:
        """Return the robots (N,) with an obstacle near."""
        return np.asarray(
            (signals["clearance_m"] < self.stop_m) | (self.front(signals) < 2 * self.stop_m)
        )

    def _index(self, speed_mps: float, yaw_rate_radps: float) -> int:
        """Return the action nearest to a velocity of the stand-in, scaled to this robot."""
        wanted = self._pace * (speed_mps, yaw_rate_radps)
        return int(np.abs(self.table - wanted).sum(axis=1).argmin())


def _corner_m(body: Body) -> float:
    """Return how much farther from the centre the corners are than the nearest sides."""
    return math.hypot(body.length_m, body.width_m) / 2 - min(body.length_m, body.width_m) / 2


AFTERMATH = "recovery"
SCORED = {kind.name: kind.is_true for kind in MISSIONS.values() if kind.is_true is not None}
NAMES = (*SCORED, AFTERMATH)
EXPOSURES = ("closing_traffic", "plan_blocked", "slippery_floor")


def _texts(names: tuple[str, ...]) -> NDArray[np.str_]:
    """Return the text of every subset of names: bit i of a subset's index is for names[i]."""
    sets = range(1 << len(names))
    return np.array([truth_text(n for bit, n in enumerate(names) if s >> bit & 1) for s in sets])


_TEXTS, _EXPOSED = _texts(NAMES), _texts(EXPOSURES)
AFTERMATH_S = 2.0
CLOSING_WITHIN_M, CLOSING_MPS = 2.0, 0.1
VIEW_M = tuple(0.2 * step for step in range(1, 12))  # distances ahead at which pallets are sought
BLOCK_AHEAD = 6  # the first six, to 1.2 m, decide blocked_aisle
REACH_M = VIEW_M[-1] + 1.5  # a pallet farther away than this is not in view
MARGIN = 0.4  # how far beside the plan a pallet is in the way, as a share of the body's width


class Truth(Stateful):
    """The true conditions and exposures of N environments, and the state that they depend on."""

    STATE = ("aftermath_s", "blocked", "traffic_gap_m", "exposed")

    def __init__(self, task: Task, num_envs: int) -> None:
        self._period_s = task.control_period_s
        self._near_m = task.rewards.tight_clearance_m
        self._margin_m = MARGIN * task.body.width_m
        self.aftermath_s = np.zeros(num_envs)  # time left of a recovery; 0 if there is none
        self.blocked = np.zeros(num_envs, np.bool_)  # at t, pallets were on the plan ahead
        self.traffic_gap_m = np.full((num_envs, AGENTS), np.inf)  # per agent, at t; inf: none
        self.exposed = np.zeros((num_envs, len(EXPOSURES)), np.bool_)  # exposures at t

    def reset(self, ids: Ints) -> None:
        self.aftermath_s[ids] = 0.0
        self.blocked[ids] = False
        self.traffic_gap_m[ids] = np.inf
        self.exposed[ids] = False

    def note_situation(self, simulation: Simulation, plans_m: F64) -> None:
        """Note every robot's exposures at the start of the step that was just driven."""
        pose, pallets, gaps_m = simulation.start, simulation.pallets, simulation.traffic_gap_m
        ahead = np.zeros((len(pose), len(VIEW_M)), np.bool_)
        apart = np.abs(pallets[:, :, :2] - pose[:, None, :2])
        near = np.maximum(apart[..., 0], apart[..., 1]) < REACH_M
        with_pallets = np.flatnonzero(near.any(axis=1))
        if len(with_pallets):
            ahead[with_pallets] = _blocked(
                pose[with_pallets], plans_m[with_pallets], pallets[with_pallets], self._margin_m
            )
        self.blocked[:] = ahead[:, :BLOCK_AHEAD].any(axis=1)
        with np.errstate(invalid="ignore"):  # the gap of an absent agent is infinite
            came_m = self.traffic_gap_m - gaps_m
        came = np.isfinite(came_m) & (came_m > CLOSING_MPS * self._period_s)
        self.exposed[:, 0] = (came & (gaps_m < CLOSING_WITHIN_M)).any(axis=1)
        self.exposed[:, 1] = ahead.any(axis=1)
        self.exposed[:, 2] = simulation.on_patch
        self.traffic_gap_m = gaps_m

    def exposure(self) -> NDArray[np.str_]:
        """Return all exposures (N,) of the current step, as one text each."""
        which = self.exposed @ (1 << np.arange(len(EXPOSURES)))
        texts: NDArray[np.str_] = _EXPOSED[which]
        return texts

    def condition(self, slipped: Bools, bumped: Bools, clearance_m: F64) -> NDArray[np.str_]:
        """Return all conditions (N,) of the step that ends now, as one text each."""
        near = bumped | (clearance_m < self._near_m)
        now = Situation(self.blocked, near, slipped, clearance_m, self.traffic_gap_m)
        missions = [is_true(now) for is_true in SCORED.values()]
        held = np.array([*missions, self.aftermath_s > 0])  # in the order of NAMES
        which = (1 << np.arange(len(NAMES))) @ held
        left = np.maximum(self.aftermath_s - self._period_s, 0.0)
        left[(clearance_m > 2 * self._near_m) & ~near] = 0.0
        self.aftermath_s = np.where(near, AFTERMATH_S, left)
        texts: NDArray[np.str_] = _TEXTS[which]
        return texts


def _blocked(pose: F64, plans_m: F64, pallets: F64, margin_m: float) -> Bools:
    """Return whether a pallet is within `margin_m` of the plan at each of VIEW_M, (n, VIEW_M)."""
    view = view_route(plans_m, pose[:, 0], pose[:, 1], np.zeros(len(pose)), VIEW_M)
    points = view.look_ahead_m + pose[:, None, :2]  # in the map frame, since heading is 0
    gap = np.abs(points[:, :, None] - pallets[:, None, :, :2])
    half = pallet_half_m(pallets[:, None, :, 2]) + margin_m
    return np.asarray((gap <= half).all(axis=-1).any(axis=-1), np.bool_)


def info_now(env: WarehouseVectorEnv, signals: Signals | None = None) -> Info:
    """Return the `info` of running episodes, with these signals (None: a copy of the current)."""
    return {
        "signals": signals or {name: column.copy() for name, column in env.signals.items()},
        "episode_condition": env.episode_condition.copy(),
        "block": env.block.copy(),
        "episode_seed": env.episode_seed.copy(),
        "perturbation": env.perturbation_name.copy(),
        "perturbation_values": env.perturbation_values.copy(),
        "layout": env.layout_names[env.layout],
        "floor": env.floor_objects[env.layout],
        "episode_number": env.episode_number.copy(),
        "mission_arm": env.mission_arm.copy(),
        "episode_steps": env.steps.copy(),
        "bumps": env.bumps.copy(),
        "true_pose": env.simulation.pose(),
    }


def info_after(
    env: WarehouseVectorEnv,
    after: Signals,
    progress_m: F64,
    condition: NDArray[np.str_],
    ended: Bools,
) -> Info:
    """Return the info of a step that led to the signals `after` under true `condition` (N,)."""
    sim, closest_m = env.simulation, env.simulation.traffic.closest_m
    return info_now(env, after) | {
        "progress_m": progress_m,
        "true_condition": condition,
        "true_exposure": env.truth.exposure(),
        "success": ended & reached_goal(env.task, after) & (env.bumps == 0),
        "invalid": sim.diverged.copy(),
        "travelled_m": sim.travelled_m,
        # inf replaces NaN: Gymnasium's checker compares infos, and NaN is unequal to itself.
        "closest_person_m": np.where(np.isnan(closest_m), np.inf, closest_m),
    }
