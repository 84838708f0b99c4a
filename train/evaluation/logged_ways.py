"""Make missions of the twin from real drives: start and goal of logged episodes.

A store keeps no goal. Each row has the goal's distance and, once the goal is within reach of the
far look-ahead point, its position. If the robot never came that near, the goal is computed from
distances along its way, unless it hardly moved aside. Episodes whose goal stays unknown, and those
that the floor has no way for, are counted.

Recordings may each have a frame of their own. A recording's ways are missions of the floor that has
the same frame.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files

import duckdb
import numpy as np
import pyarrow as pa

from restock.arrays import F64, Ints
from restock.errors import ConfigError
from restock.ingest.task.task import Task
from restock.replay.panel.panel import Panel
from restock.replay.store.parquet_views import passed_in
from restock.train.evaluation.ope_dataset import held_out_of, panel_store
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.occupancy_grid import into_frame
from restock.train.twin.floors.placed import logged_drives, placed_on
from restock.train.twin.floors.planner import Planner
from restock.train.twin.physics.episode import EpisodeSpec, Way, draw_episode

HELD_OUT, EVERY = "logged", "logged:all"
AGREE_M = 0.3  # a goal by the waypoint must be as far as the row says
RESIDUAL_M = 0.1  # of a goal by distances
ASIDE_M = 0.3  # that the way must leave a straight line by, for distances to tell a goal
NO_GOAL = "the rows do not contain the goal's position"
NO_WAY = "the goal cannot be reached on the floor: it is inside a wall, outside, or enclosed"
AT_GOAL = "it starts at its goal"
OTHER_FRAME = "its recording is in another frame than the floor"


@dataclass(frozen=True)
class LoggedWays:
    """Start pose and goal of episodes, in the frame of their logs."""

    ways: Sequence[Way]
    recordings: Sequence[str]  # of each way, its recording's id
    logged: int  # episodes that were looked at


@dataclass(frozen=True)
class LoggedMissions:
    """One episode per kind and logged route with room for it, and why others were left out."""

    specs: Mapping[str, Sequence[EpisodeSpec]]  # by kind
    ways: int  # that can be driven
    logged: int  # episodes that were looked at
    source: str  # which these were
    left_out: Mapping[str, int] = field(default_factory=dict)  # episodes, by reason
    no_room: Mapping[str, int] = field(default_factory=dict)  # ways without room, by kind

    @property
    def text(self) -> str:
        """Return the counts as a sentence."""
        said = f"missions of the logs: {self.ways} of {self.logged} can be driven"
        parts = [f"{said} ({self.source})"]
        parts += [f"{count} not: {why}" for why, count in self.left_out.items()]
        parts += [f"no room for {kind}: {count}" for kind, count in self.no_room.items() if count]
        return "; ".join(parts)


def logged_missions(
    panel: Panel, floors: Sequence[Warehouse], kinds: Sequence[str], *, every: bool = False
) -> LoggedMissions:
    """Turn the held-out episodes of a panel into missions on floors of their frames.

    Args:
        every: those that were trained on too; also where nothing is held out.

    Raises:
        ConfigError: none of them can be driven on these floors.
        StoreError, PanelError: the logs are no longer there.
    """
    with panel_store(panel) as store:
        ids = np.asarray(held_out_of(panel), np.int64)
        held_out = len(ids) > 0 and not every
        if not held_out:
            ids = np.union1d(ids, np.asarray(panel.meta_column("transition_id"), np.int64))
        found = logged_ways(store.connection, ids, panel.task)
        drives = logged_drives(store.connection, panel.task, sorted(set(found.recordings)))
    source = (
        "episodes that the panel holds out"
        if held_out
        else "logged episodes, most of which were trained on"
    )
    placed = {
        recording: next((floor for floor in floors if placed_on(floor, drive)), None)
        for recording, drive in drives.items()
    }
    planner = {floor.name: Planner(floor) for floor in floors}
    left_out = Counter({NO_GOAL: found.logged - len(found.ways)})
    drivable: list[tuple[Warehouse, Way]] = []
    for logged, recording in zip(found.ways, found.recordings, strict=True):
        floor = placed[recording]
        if floor is None:
            left_out[OTHER_FRAME] += 1
            continue
        way = _in_frame(logged, floor)
        why = _undrivable(way, floor, planner[floor.name], panel.task.goal_radius_m)
        if why is None:
            drivable.append((floor, way))
        else:
            left_out[why] += 1
    several = len(floors) > 1
    specs: dict[str, list[EpisodeSpec]] = {
        kind: [
            spec
            for floor, way in drivable
            for spec in (
                EpisodeSpec(kind, _seed(way), layout=floor.name if several else None, way=way),
            )
            if _has_room(spec, floor, planner[floor.name])
        ]
        for kind in kinds
    }
    made = LoggedMissions(
        {kind: some for kind, some in specs.items() if some},
        len(drivable),
        found.logged,
        source,
        {why: number for why, number in left_out.items() if number},
        {
            kind: len(drivable) - len(some)
            for kind, some in specs.items()
            if len(some) < len(drivable)
        },
    )
    if not made.specs:
        raise ConfigError(
            made.text,
            where=f"--missions, {', '.join(floor.name for floor in floors)}",
            remedy=f"give --missions {EVERY}, a floor in the frame of the logs (`restock twin "
            "layout --from STORE`), or leave out --missions",
        )
    return made


def logged_ways(connection: duckdb.DuckDBPyConnection, ids: Ints, task: Task) -> LoggedWays:
    """Return the routes of the episodes that contain any of these rows, if the rows show them."""
    query = (files("restock.train.evaluation") / "logged_ways.sql").read_text(encoding="utf-8")
    with passed_in(connection, wanted=pa.table({"transition_id": ids})):
        columns = connection.sql(query).fetchnumpy()
    recordings = np.asarray(columns.pop("recording_id"), str)
    names = np.asarray(columns.pop("episode_id"), str)
    first = np.flatnonzero(names[1:] != names[:-1]) + 1
    rows = np.stack([np.asarray(column, np.float64) for column in columns.values()], axis=-1)
    ways, of = [], []
    for begin, episode in zip([0, *first], np.split(rows, first), strict=True):
        goal = goal_of(episode, task.far_m) if len(episode) else None
        if goal is not None and np.isfinite(episode[0, :3]).all():
            x, y, yaw = episode[0, :3].tolist()
            ways.append((x, y, yaw, float(goal[0]), float(goal[1])))
            of.append(str(recordings[begin]))
    return LoggedWays(ways, of, len(first) + 1 if len(rows) else 0)


def goal_of(rows: F64, far_m: float) -> F64 | None:
    """Find the goal of an episode, (2,), from its rows (N, 7); None if they do not show it.

    Columns: pose x, y, yaw; far waypoint forward, left; route left; distance to the goal.
    """
    place, yaw, far = rows[:, :2], rows[:, 2], rows[:, 3:5]
    left, distance = rows[:, 5], rows[:, 6]
    in_reach = np.flatnonzero(left <= far_m)
    if len(in_reach):
        at = int(in_reach[-1])
        turn = np.array([[np.cos(yaw[at]), -np.sin(yaw[at])], [np.sin(yaw[at]), np.cos(yaw[at])]])
        goal: F64 = place[at] + turn @ far[at]
        if abs(float(np.hypot(*(goal - place[at]))) - distance[at]) <= AGREE_M:
            return goal
    known = np.isfinite(rows[:, [0, 1, 6]]).all(axis=1)
    place, distance = place[known], distance[known]
    if len(place) < 3:
        return None
    # |p - g|^2 = d^2 less its mean over rows is linear in g: 2 (p - mean) . g = ...
    centred = place - place.mean(axis=0)
    _, spread, _ = np.linalg.svd(centred, full_matrices=False)
    if spread[-1] / np.sqrt(len(place)) < ASIDE_M / 2:
        return None
    square = (place**2).sum(axis=1) - distance**2
    goal, *_ = np.linalg.lstsq(2 * centred, square - square.mean(), rcond=None)
    residual = np.abs(np.hypot(*(place - goal).T) - distance)
    return np.asarray(goal) if float(residual.max()) <= RESIDUAL_M else None


def _in_frame(way: Way, floor: Warehouse) -> Way:
    """Transform a way of the logs into a floor's own frame."""
    of = np.asarray(way, np.float64)
    ends = into_frame(np.stack([of[:2], of[3:5]]), floor.map_origin)
    x, y, goal_x, goal_y = ends.ravel().round(3).tolist()
    return x, y, round(float(of[2] - floor.map_origin[2]), 3), goal_x, goal_y


def _undrivable(way: Way, floor: Warehouse, planner: Planner, radius_m: float) -> str | None:
    """Return why a way cannot be driven on a floor; None if it can."""
    x, y, _, goal_x, goal_y = way
    inside = all(
        0 <= px <= floor.width_m and 0 <= py <= floor.depth_m
        for px, py in ((x, y), (goal_x, goal_y))
    )
    if not inside or not np.isfinite(planner.distance_m(x, y, (goal_x, goal_y))):
        return NO_WAY
    return AT_GOAL if np.hypot(goal_x - x, goal_y - y) <= radius_m else None


def _has_room(spec: EpisodeSpec, floor: Warehouse, planner: Planner) -> bool:
    try:
        draw_episode(spec, floor, planner)
    except ConfigError:
        return False
    return True


def _seed(way: Way) -> int:
    """Return the seed of a way's mission: the same in every run, and different for another way."""
    return zlib.crc32(np.asarray(way, np.float64).tobytes()) >> 1
