"""Check missions as a whole: do goals come nearer, on whose floor, and which missions are kept.

A row cannot show that its goal is another mission's, that racks stand elsewhere than in the twin,
or that the missions that went well were left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa
from scipy.stats import ttest_1samp

from restock.arrays import F64, Bools
from restock.ingest.task.surroundings import sector_returns
from restock.replay.store.parquet_views import passed_in
from restock.replay.store.store import Store
from restock.train.judge.fed_rows import TAIL, Comparison, FedRows, not_run, shares_compared
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.occupancy_grid import into_frame
from restock.train.twin.floors.placed import (
    NEAR_M,
    PLACED,
    SEEN,
    WITHIN_M,
    from_walls_m,
    on_free_ground,
)

NEARER = "goals come nearer"
AWAY = 0.05  # of the missions
_DRIVEN_M = 2.0  # from which on a mission shows whether it goes to its goal
_SHORTER = 0.3  # m of plan less, at least, for each metre driven
_STRAIGHT = 0.7  # of the way driven, from its begin to its end: who wanders has no goal
FLOOR = "floor"
MOVED_M = 0.25
_SEARCH_M, _STEP_M, _FINE_M = 2.5, 0.25, 0.05
_RETURNS = 3000
_MISSIONS = 6  # in which a floor is looked at
CHOSEN = "chosen on outcome: "
GAP = 0.3  # of the share that succeeds
_MIN_MISSIONS = 5  # with and without
_MET = 0.2  # of a condition's episodes, for an exposure to be their situation

_SIGNALS = (
    "SELECT t.transition_id, pose_x_m, pose_y_m, pose_yaw_rad,"
    " CAST(e.success AS DOUBLE) AS success, t.conditions, t.exposures"
    " FROM transitions t SEMI JOIN fed USING (transition_id)"
    " LEFT JOIN episodes e ON e.episode_id = t.episode_id WHERE t.task_hash = ?"
)


def with_missions(store: Store, rows: FedRows) -> FedRows:
    """Return the rows with their poses, their episodes' success, and their situations."""
    fed = pa.table({"transition_id": rows.transition_id})
    with passed_in(store.connection, fed=fed):
        table = store.connection.sql(_SIGNALS, params=[rows.task.hash]).to_arrow_table()
    found = {number: place for place, number in enumerate(table["transition_id"].to_pylist())}
    at = np.array([found.get(number, -1) for number in rows.transition_id.tolist()], np.int64)
    columns = [table[name].to_numpy().astype(np.float64) for name in table.column_names[1:5]]
    values = np.append(np.stack(columns, axis=1), np.full((1, 4), np.nan), axis=0)[at]
    held = np.empty(len(table) + 1, object)
    names = zip(table["conditions"].to_pylist(), table["exposures"].to_pylist(), strict=True)
    held[:] = [(set(a or ()), set(b or ())) for a, b in names] + [(set(), set())]
    return replace(rows, pose=values[:, :3], success=values[:, 3], held=held[at])


def mission_checks(
    logs: FedRows, twin: FedRows | None, floors: Sequence[Warehouse]
) -> Iterator[Comparison]:
    """Check goals, then the floor, then whether conditions are of missions that failed."""
    yield _nearer(logs, twin)
    yield _on_floor(logs, floors)
    yield from _chosen(logs)


def _nearer(logs: FedRows, twin: FedRows | None) -> Comparison:
    what = "mission drives metres that do not bring its goal nearer"
    if logs.task.goal == "none" or logs.pose is None:
        reason = "no store with poses" if logs.pose is None else "the task has no goal"
        return not_run(NEARER, what, reason)
    expected = (0, 1000) if twin is None else _strayed(twin)
    return shares_compared(NEARER, what, _strayed(logs), expected, -1.0, AWAY)


def _strayed(rows: FedRows) -> tuple[int, int]:
    """Count the missions whose plan does not become shorter, of those that show it."""
    now, after = rows.now("goal_distance"), rows.after("goal_distance")
    seen = (now < 1.0) & (after < 1.0)
    driven = np.abs(rows.after("localised_speed")) * rows.task.control_period_s
    mission = np.unique(rows.episode, return_inverse=True)[1].reshape(-1)
    way = np.bincount(mission, driven * seen)
    shorter = np.bincount(mission, 10.0 * (now - after) * seen)
    long = way > _DRIVEN_M
    strayed = shorter < _SHORTER * way
    if rows.pose is not None:
        first = np.flatnonzero(np.append(True, np.diff(mission) > 0)[: len(mission)])
        ends = rows.pose[np.append(first[1:], len(mission)) - 1, :2]
        all_of_it = np.bincount(mission, driven)
        strayed &= np.hypot(*(ends - rows.pose[first, :2]).T) > _STRAIGHT * all_of_it
    return int(strayed[long].sum()), int(long.sum())


def _on_floor(rows: FedRows, floors: Sequence[Warehouse]) -> Comparison:
    """Find the move of the twin's racks that fits the lidar best, and test it on other missions."""
    what = "racks against where the lidar sees them, on the twin's floor"
    if rows.pose is None or not rows.task.lidar or not floors:
        missing = "the robot has no lidar" if not rows.task.lidar else "no store with poses"
        return not_run(FLOOR, what, missing)
    clearance = rows.sectors() ** 2 * rows.task.range_max_m
    x, y = sector_returns(rows.task, clearance)
    placed = np.isfinite(np.asarray(rows.pose, np.float64)).all(axis=1, keepdims=True)
    seen = (clearance < min(rows.task.range_max_m * (1 - 1e-6), WITHIN_M)) & placed
    cos, sin = np.cos(rows.pose[:, 2:]), np.sin(rows.pose[:, 2:])
    places = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) + rows.pose[:, None, :2]
    mission = np.broadcast_to(rows.episode[:, None], seen.shape)[seen]
    places = places[seen]
    kept = slice(None, None, len(places) // (2 * _RETURNS) + 1)
    places, mission = places[kept], np.unique(mission[kept], return_inverse=True)[1].reshape(-1)
    if not len(mission) or mission.max() + 1 < _MISSIONS:
        return not_run(FLOOR, what, "too few missions with lidar returns")
    first = mission % 2 == 0
    by_floor = []
    for floor in floors:
        own = into_frame(places, floor.map_origin)
        move = _best_move(floor, own[first])
        near = from_walls_m(floor, own + move) < NEAR_M
        by_floor.append((float(near.mean()), floor, move, own, near))
    share, floor, move, own, near = max(by_floor, key=lambda one: one[0])
    driven = into_frame(rows.pose[np.isfinite(rows.pose).all(axis=1), :2], floor.map_origin)
    if share < SEEN or on_free_ground(floor, driven + move).mean() < PLACED:
        reason = (
            f"these logs are of another floor ({share:.0%} of the lidar's returns lie on racks of"
            f" {floor.name!r}): `restock twin layout --from` makes theirs, and `restock diagnose"
            " PLACE FLOOR.toml` compares with it"
        )
        return not_run(FLOOR, what, reason)
    still = from_walls_m(floor, own) < NEAR_M
    gains = _by_mission(near.astype(float) - still, mission, ~first)
    distance = float(np.hypot(*move))
    better = ttest_1samp(gains, 0.0, alternative="greater")
    p = float(better.pvalue) if distance > MOVED_M and np.ptp(gains) > 0 else 1.0
    sides = ((-move[0], "east", "west"), (-move[1], "north", "south"))
    way = " and ".join(
        f"{abs(by):.1f} m {plus if by > 0 else minus}" for by, plus, minus in sides if abs(by) > 0.1
    )
    return Comparison(
        FLOOR, what, "m", "off" if p < TAIL else "ok" if distance <= MOVED_M else "undecided",
        logs=float(still.mean()), twin=share, effect=distance, most=MOVED_M,
        logs_rows=len(rows), p=p,
        note=f"{way} of where {floor.name!r} has them ({still.mean():.0%} of the lidar's returns"
        f" lie on its racks and walls, {share:.0%} if these are moved)",
    )  # fmt: skip


def _best_move(floor: Warehouse, places: F64) -> F64:
    """Return by how much (2,) places fit a floor's walls best, to `_FINE_M`; a short move wins."""
    places = places[:: len(places) // _RETURNS + 1]
    best = np.zeros(2)
    for step, reach in ((_STEP_M, _SEARCH_M), (_FINE_M, _STEP_M)):
        at = np.arange(-reach, reach + step / 2, step)
        moves = best + np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
        fits = [
            float((from_walls_m(floor, places + move) < NEAR_M / 2).mean())
            - 0.002 * float(np.hypot(*move))
            for move in moves
        ]
        best = moves[int(np.argmax(fits))]
    return np.asarray(best)


def _by_mission(values: F64, mission: np.ndarray, chosen: Bools) -> F64:
    """Return the mean of values (M,) in each of the chosen missions."""
    number = np.unique(mission[chosen], return_inverse=True)[1].reshape(-1)
    return np.asarray(np.bincount(number, values[chosen]) / np.bincount(number))


def _chosen(rows: FedRows) -> Iterator[Comparison]:
    """Compare each condition's episodes with others in the situations that they met."""
    what = "of the episodes in the same situations, those without the condition that succeed more"
    if rows.held is None or rows.success is None:
        yield not_run(CHOSEN.strip(": "), what, "no store with outcomes")
        return
    first, mission = np.unique(rows.episode, return_index=True, return_inverse=True)[1:]
    success = rows.success[first]
    conditions: list[set[str]] = [set() for _ in first]
    exposures: list[set[str]] = [set() for _ in first]
    for place, (named, exposed) in zip(mission.reshape(-1).tolist(), rows.held, strict=True):
        conditions[place] |= named
        exposures[place] |= exposed
    known = np.isfinite(success)
    for name in sorted(set().union(*conditions)):
        with_it = np.array([name in one for one in conditions]) & known
        met = [
            exposure
            for exposure in set().union(*exposures)
            if sum(exposure in exposures[i] for i in np.flatnonzero(with_it))
            >= _MET * with_it.sum()
        ]
        left = np.array([any(one in each for one in met) for each in exposures]) & known & ~with_it
        if min(with_it.sum(), left.sum()) >= _MIN_MISSIONS:
            made = shares_compared(
                CHOSEN + name, what, (int(success[left].sum()), int(left.sum())),
                (int(success[with_it].sum()), int(with_it.sum())), -1.0, GAP,
            )  # fmt: skip
            # A condition is often an outcome, so some gap is expected and raises no suspicion.
            yield replace(made, status="ok") if made.status == "undecided" else made
