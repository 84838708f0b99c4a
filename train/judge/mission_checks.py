"""Check missions as a whole: their goals, their floor, their drivers, and which ones are missing.

A single row cannot show that its goal is another mission's, that racks stand elsewhere than in the
twin, or that the missions that went well were left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.stats import ttest_1samp

from restock.arrays import F64, Bools, Ints
from restock.ingest.task.surroundings import outline_reach, sector_returns
from restock.ingest.task.task import Task
from restock.replay.store.parquet_views import passed_in
from restock.replay.store.store import Store
from restock.stats import clustered_quantiles
from restock.train.judge.answers import RESAMPLES
from restock.train.judge.fed_rows import (
    POSE,
    TAIL,
    Comparison,
    FedRows,
    judged,
    not_run,
    share_judged,
    shares_compared,
)
from restock.train.twin.floors.layout import (
    NEAR_RETURN_M,
    ON_WALL_M,
    Rect,
    Warehouse,
    from_walls_m,
    is_free,
)
from restock.train.twin.floors.occupancy_grid import into_frame

LOST = "rows lost"
NEARER = "goals come nearer"
AWAY = 0.05  # largest share of missions at fault
_DRIVEN_M = 2.0  # shorter drives do not show whether a mission goes to its goal
_SHORTER = 0.3  # a mission strays if its plan becomes shorter by less than this per metre driven
_JUMP = 0.06  # in units of 10 m; larger changes in one step mean that the plan was replaced
_STRAIGHT = 0.7  # with less distance from start to end per metre driven, a mission only wanders
FLOOR = "floor"
MOVED_M = 0.25
PLACED = 0.8  # least share of poses on free ground, if the logs are of this floor
_SEARCH_M, _STEP_M, _FINE_M = 2.5, 0.25, 0.05
_RETURNS = 3000
_MISSIONS = 6  # fewer missions with lidar returns are not compared with a floor
RANGES, SECTORS, ON_RACKS = "lidar ranges", "lidar sectors", "missions racks"
ON_FLOOR = 0.5  # least share of ranges that agree with the floor; with less, it is another floor
RANGE_M = 0.1
BLIND = 0.0  # largest share of sectors that may be blind
_LOOKS, _RAYS = 800, 3  # number of rows to compare, and of rays per sector
_NEARBY = 0.6  # walls within this share of the lidar's range should be seen
_MIN_GAIN = 0.05  # racks are moved only if the share of ranges that agree rises by at least this
_MIN_LOOKS = 40  # least ranges for a sector or a mission to be judged
DRIVEN = "driver"
OTHER_DRIVER = 0.1  # largest share of stretches in another's style, beyond the usual share
_MAX_CONFUSED = 0.1  # largest share of the others' stretches that may be taken for another driver's
_STRETCH = 10  # stretches with fewer steps are not counted
CHOSEN = "chosen on outcome: "
GAP = 0.3  # largest difference in success without and with a condition
_MIN_MISSIONS = 5  # least missions with and without a condition, and least stretches of a driver
_MIN_EXPOSED = 0.2  # exposures in at least this share of a condition's episodes are its situations

_SIGNALS = (
    f"SELECT t.transition_id, {', '.join(POSE)}, CAST(e.success AS DOUBLE) AS success,"
    " t.conditions, t.exposures, t.behaviour_policy, h.held, r.ticks - r.episode_ends"
    " - coalesce(list_sum([one.count FOR one IN r.drops]), 0) AS written"
    " FROM transitions t SEMI JOIN fed USING (transition_id)"
    " LEFT JOIN episodes e ON e.episode_id = t.episode_id JOIN recordings r"
    " ON r.recording_id = t.recording_id JOIN (SELECT recording_id, count(*) AS held FROM"
    " transitions GROUP BY recording_id) h ON h.recording_id = t.recording_id WHERE t.task_hash = ?"
)


def with_missions(store: Store, rows: FedRows) -> FedRows:
    """Fill in the fields of rows that only their store has: poses, success, labels, drivers."""
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
    driver = np.array([*table["behaviour_policy"].fill_null("").to_pylist(), ""])[at]
    counted = np.stack([np.append(table[name].to_numpy(), 0) for name in ("written", "held")], 1)
    return replace(
        rows, pose=values[:, :3], success=values[:, 3], held=held[at], driver=driver,
        counted=counted[at],
    )  # fmt: skip


def mission_checks(
    logs: FedRows, twin: FedRows | None, floors: Sequence[Warehouse], others: FedRows | None = None
) -> Iterator[Comparison]:
    """Check lost rows, goals, the floor, whether conditions follow from outcomes, and drivers.

    `others` are the rows of the other robots or recordings, if `logs` are only a part.
    """
    yield _check_lost_rows(logs)
    yield _check_goals(logs, twin)
    yield from _check_floor(logs, floors, twin)
    yield from _check_outcomes(logs)
    yield _check_driver(logs, others)


def _check_lost_rows(rows: FedRows) -> Comparison:
    what = "row that ingest wrote for a recording and that is gone"
    if rows.counted is None:
        return not_run(LOST, what, "no store")
    written, held = rows.counted[np.unique(rows.recording, return_index=True)[1]].T
    gone = np.maximum(written - held, 0).sum()
    return share_judged(LOST, what, int(gone), int(written.sum()), 0.0)


def _check_goals(logs: FedRows, twin: FedRows | None) -> Comparison:
    what = "mission drives without coming nearer to its goal"
    if logs.task.goal == "none" or logs.pose is None:
        reason = "no store with poses" if logs.pose is None else "the task has no goal"
        return not_run(NEARER, what, reason)
    expected = (0, 1000) if twin is None else _count_strayed(twin)
    return shares_compared(NEARER, what, _count_strayed(logs), expected, -1.0, AWAY)


def _count_strayed(rows: FedRows) -> tuple[int, int]:
    """Count the missions whose plan does not become shorter, and those that were judged.

    Short missions are not judged, nor those that end in a bump, which may have had no goal.
    """
    now, after = rows.now("goal_distance"), rows.after("goal_distance")
    seen = (now < 1.0) & (after < 1.0) & (np.abs(now - after) < _JUMP)
    driven = np.abs(rows.after("localised_speed")) * rows.task.control_period_s
    mission = np.unique(rows.episode, return_inverse=True)[1].reshape(-1)
    way = np.bincount(mission, driven * seen)
    shorter = np.bincount(mission, 10.0 * (now - after) * seen)
    bumped = np.bincount(mission, rows.last & (rows.reward < rows.task.rewards.bump / 2)) > 0
    long = (way > _DRIVEN_M) & ~bumped
    strayed = shorter < _SHORTER * way
    if rows.pose is not None:
        first = np.flatnonzero(np.append(True, np.diff(mission) > 0)[: len(mission)])
        ends = rows.pose[np.append(first[1:], len(mission)) - 1, :2]
        all_of_it = np.bincount(mission, driven)
        strayed &= np.hypot(*(ends - rows.pose[first, :2]).T) > _STRAIGHT * all_of_it
    return int(strayed[long].sum()), int(long.sum())


def _check_floor(
    rows: FedRows, floors: Sequence[Warehouse], twin: FedRows | None
) -> Iterator[Comparison]:
    """Find the move of the twin's racks that fits the lidar best, and test it on other missions.

    Then compare the lidar's ranges with the racks and walls of the floor that fits best.
    """
    what = "distance of the floor's racks from where the lidar sees them"
    if rows.pose is None or not rows.task.lidar or not floors:
        missing = "the robot has no lidar" if not rows.task.lidar else "no store with poses"
        yield not_run(FLOOR, what, missing)
        return
    clearance = rows.sectors() ** 2 * rows.task.range_max_m
    x, y = sector_returns(rows.task, clearance)
    placed = np.isfinite(np.asarray(rows.pose, np.float64)).all(axis=1, keepdims=True)
    seen = (clearance < min(rows.task.range_max_m * (1 - 1e-6), NEAR_RETURN_M)) & placed
    cos, sin = np.cos(rows.pose[:, 2:]), np.sin(rows.pose[:, 2:])
    places = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) + rows.pose[:, None, :2]
    mission = np.broadcast_to(rows.episode[:, None], seen.shape)[seen]
    places = places[seen]
    kept = slice(None, None, len(places) // (2 * _RETURNS) + 1)
    places, mission = places[kept], np.unique(mission[kept], return_inverse=True)[1].reshape(-1)
    if not len(mission) or mission.max() + 1 < _MISSIONS:
        yield not_run(FLOOR, what, "too few missions with lidar returns")
        return
    first = mission % 2 == 0
    by_floor = []
    for floor in floors:
        own = into_frame(places, floor.map_origin)
        move = _best_move(floor, own[first])
        near = from_walls_m(floor, *(own + move).T) < ON_WALL_M
        by_floor.append((float(near.mean()), floor, move, own, near))
    share, floor, move, own, near = max(by_floor, key=lambda one: one[0])
    driven = into_frame(rows.pose[np.isfinite(rows.pose).all(axis=1), :2], floor.map_origin)
    distance = float(np.hypot(*move))
    ranges = list(_check_ranges(rows, floor, move, twin))
    if is_free(floor, *(driven + move).T).mean() < PLACED or not ranges:
        reason = (
            f"these logs are of another floor ({share:.0%} of the lidar's returns lie on racks of"
            f" {floor.name!r}): `restock twin layout --from` makes that floor, and `restock"
            " diagnose PLACE FLOOR.toml` compares with it"
        )
        yield not_run(FLOOR, what, reason)
        return
    still = from_walls_m(floor, *own.T) < ON_WALL_M
    gains = _mean_by_mission(near.astype(float) - still, mission, ~first)
    better = ttest_1samp(gains, 0.0, alternative="greater")
    p = float(better.pvalue) if distance > MOVED_M and np.ptp(gains) > 0 else 1.0
    sides = ((-move[0], "east", "west"), (-move[1], "north", "south"))
    way = " and ".join(
        f"{abs(by):.1f} m {plus if by > 0 else minus}" for by, plus, minus in sides if abs(by) > 0.1
    )
    yield Comparison(
        FLOOR, what, "m", "off" if p < TAIL else "ok" if distance <= MOVED_M else "undecided",
        logs=float(still.mean()), twin=share, effect=distance, most=MOVED_M,
        logs_rows=len(rows), p=p,
        note=f"{way} of where {floor.name!r} has them ({still.mean():.0%} of the lidar's returns"
        f" lie on its racks and walls, {share:.0%} if these are moved)",
    )  # fmt: skip
    yield from ranges


def _check_ranges(
    rows: FedRows, floor: Warehouse, move: F64, twin: FedRows | None
) -> Iterator[Comparison]:
    """Compare each sector's ranges with the distances to the floor's racks and walls.

    Yields nothing if fewer than `ON_FLOOR` of the ranges agree: the logs are of another floor.
    `move` (2,) is applied to the poses if that fits clearly better.
    """
    assert rows.pose is not None
    kept = np.flatnonzero(np.isfinite(rows.pose).all(axis=1))
    kept = kept[:: len(kept) // _LOOKS + 1]
    clearance, best = rows.sectors()[kept] ** 2 * rows.task.range_max_m, ON_FLOOR
    for by in (np.zeros(2), move):
        least, most = _expected_clearance(rows.task, floor, rows.pose[kept], by)
        shown = (least > 0.1) & (least < _NEARBY * rows.task.range_max_m) & (most - least < 0.6)
        if twin is not None:
            shown &= (twin.sectors() < 1.0).any(axis=0)  # sectors that the twin's lidar covers
        off = clearance - least
        near = np.abs(off - (np.median(off[shown]) if shown.any() else 0.0)) < ON_WALL_M
        if (share := near[shown].sum() / max(shown.sum(), 1)) >= best:
            plain, away, alike, best = shown, off, near, share + _MIN_GAIN
    if best == ON_FLOOR:
        return
    cluster = np.broadcast_to(rows.cluster[kept][:, None], away.shape)[plain]
    (middle,) = clustered_quantiles(
        away[plain], cluster, (0.5,), rng=np.random.default_rng(0), resamples=RESAMPLES
    )
    what = "range of the lidar less the distance to the floor's racks and walls"
    yield judged(RANGES, what, "difference", middle, logs=middle.value, twin=0.0, least=-RANGE_M,
                 most=RANGE_M, logs_rows=len(kept))  # fmt: skip
    looked, seen = plain.sum(axis=0), (alike & plain).sum(axis=0)
    blind, judged_ones = seen < looked / 2, looked >= _MIN_LOOKS
    bearings = (np.flatnonzero(blind & judged_ones) + 0.5) * 360 / rows.task.sectors - 180
    what = "sector that mostly does not see the floor's racks and walls"
    yield share_judged(SECTORS, what, len(bearings), int(judged_ones.sum()), BLIND,
                       note=", ".join(f"{one:+.0f}" for one in bearings))  # fmt: skip
    plain &= ~blind
    mission = np.unique(rows.episode[kept], return_inverse=True)[1].reshape(-1)
    looked, seen = (np.bincount(mission, one.sum(axis=1)) for one in (plain, alike & plain))
    blind, judged_ones = seen < looked / 2, looked >= _MIN_LOOKS
    what = "mission in which the lidar mostly does not see the floor's racks where they are"
    yield share_judged(ON_RACKS, what, int((blind & judged_ones).sum()), int(judged_ones.sum()),
                       AWAY)  # fmt: skip


def _expected_clearance(task: Task, floor: Warehouse, pose: F64, move: F64) -> tuple[F64, F64]:
    """Return the clearance (N, S) expected in each sector from poses (N, 3), from racks and walls.

    Returns the minimum and the maximum over `_RAYS` rays of the sector.
    """
    width = 2 * np.pi / task.sectors
    inside = (np.arange(_RAYS) + 0.5) / _RAYS * width
    bearing = (np.arange(task.sectors)[:, None] * width - np.pi + inside).reshape(-1)
    yaw = pose[:, 2:] - floor.map_origin[2]
    ahead = task.body.lidar_x_m * np.concatenate([np.cos(yaw), np.sin(yaw)], axis=1)
    x, y = (into_frame(pose[:, :2], floor.map_origin) + move + ahead).T[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = 1 / np.stack([np.cos(yaw + bearing), np.sin(yaw + bearing)])
        nearest = np.full(along.shape[1:], 1e6)
        for rack in (Rect(0.0, 0.0, floor.width_m, floor.depth_m), *floor.racks):
            ends = [np.stack([rack.edges[at] - x, rack.edges[at + 1] - y]) * along for at in (0, 2)]
            near, far = np.minimum(*ends).max(axis=0), np.maximum(*ends).min(axis=0)
            hit = far if nearest.min() == 1e6 else near  # first: the floor's outline, from inside
            nearest = np.where((hit > 0) & (near <= far), np.minimum(nearest, hit), nearest)
    clear = (nearest - outline_reach(bearing, task.body)).reshape(len(pose), task.sectors, _RAYS)
    return clear.min(axis=2), clear.max(axis=2)


def _check_driver(rows: FedRows, others: FedRows | None) -> Comparison:
    """Compare the stored driver with the driver in the other rows whose style is most similar."""
    what = "stretch that is driven in the style of another driver"
    if others is None or rows.driver is None or others.driver is None:
        return not_run(DRIVEN, what, "no other rows of a store to compare with")
    names = [name for name in np.unique(others.driver).tolist() if name]
    stretch = [_split_by_driver(one) for one in (rows, others)]
    names = [one for one in names if (stretch[1][1] == one).sum() >= _MIN_MISSIONS]
    if len(names) < 2:
        return not_run(DRIVEN, what, "fewer than two known drivers in the other rows")
    style, known = _driving_features(others), np.isin(others.driver, names)
    middle, spread = style[known].mean(axis=0), style[known].std(axis=0) + 1e-9
    (style, own) = ((each - middle) / spread for each in (style, _driving_features(rows)))
    right = np.stack([others.driver == name for name in names], axis=1)[known]
    weight = (right / right.sum(axis=0)).sum(axis=1, keepdims=True)  # equal total per driver
    square = (style[known] * weight).T @ style[known] + 1e-3 * np.eye(style.shape[1])
    fit = np.linalg.solve(square, (style[known] * weight).T @ right)
    level = (style[known] * weight).sum(axis=0) / len(names) @ fit

    def count_wrong(one: FedRows, style: F64, of: tuple[Ints, NDArray[np.str_]]) -> tuple[int, int]:
        each = (np.bincount(of[0]) >= _STRETCH) & np.isin(of[1], names)
        like = np.stack([np.bincount(of[0], score) for score in (style @ fit - level).T], axis=1)
        predicted = np.array(names)[like.argmax(axis=1)]
        return int((predicted != of[1])[each].sum()), int(each.sum())

    usual = count_wrong(others, style, stretch[1])
    if usual[0] > _MAX_CONFUSED * usual[1]:
        return not_run(DRIVEN, what, "the drivers drive alike")
    return shares_compared(
        DRIVEN, what, count_wrong(rows, own, stretch[0]), usual, -1.0, OTHER_DRIVER
    )


def _split_by_driver(rows: FedRows) -> tuple[Ints, NDArray[np.str_]]:
    """Split rows by driver and episode into stretches; return each row's, (N,), and the drivers."""
    assert rows.driver is not None
    begins = np.append(True, (np.diff(rows.episode) != 0) | (rows.driver[1:] != rows.driver[:-1]))
    return np.cumsum(begins) - 1, rows.driver[begins]


def _driving_features(rows: FedRows) -> F64:
    """Return features (N, F) of how a row's driver responds to the plan and to obstacles."""
    speed, turn = (rows.command() / np.abs(rows.task.actions).max(axis=0).clip(1e-9)).T
    near = np.arctan2(rows.now("near_sin"), rows.now("near_cos"))
    shown = [speed, np.abs(turn), turn * near, np.abs(turn - near), speed * np.abs(near)]
    shown += [rows.action != rows.previous_action(), speed * rows.now("goal_distance")]
    shown.append(np.abs(rows.now("nav_speed") - speed))
    shown.append(np.abs(rows.now("nav_yaw_rate") - turn) * rows.now("nav_known"))
    if rows.task.lidar:
        middle = rows.task.sectors // 2
        shown.append(speed * rows.sectors()[:, middle - 2 : middle + 2].min(axis=1))
    return np.stack([*shown, *np.eye(len(rows.task.actions))[rows.action].T], axis=1, dtype=float)


def _best_move(floor: Warehouse, places: F64) -> F64:
    """Return the move (2,) that best fits lidar returns to walls; length has a small penalty."""
    places = places[:: len(places) // _RETURNS + 1]
    best = np.zeros(2)
    for step, reach in ((_STEP_M, _SEARCH_M), (_FINE_M, _STEP_M)):
        at = np.arange(-reach, reach + step / 2, step)
        moves = best + np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
        fits = [
            float((from_walls_m(floor, *(places + move).T) < ON_WALL_M / 2).mean())
            - 0.002 * float(np.hypot(*move))
            for move in moves
        ]
        best = moves[int(np.argmax(fits))]
    return np.asarray(best)


def _mean_by_mission(values: F64, mission: np.ndarray, chosen: Bools) -> F64:
    """Return the mean of the values (M,) that are `chosen`, per mission."""
    number = np.unique(mission[chosen], return_inverse=True)[1].reshape(-1)
    return np.asarray(np.bincount(number, values[chosen]) / np.bincount(number))


def _check_outcomes(rows: FedRows) -> Iterator[Comparison]:
    """Compare the success of each condition's episodes with others in the same situations."""
    what = "success without the condition less success with it, in the same situations"
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
        situations = [
            exposure
            for exposure in set().union(*exposures)
            if sum(exposure in exposures[i] for i in np.flatnonzero(with_it))
            >= _MIN_EXPOSED * with_it.sum()
        ]
        left = np.array([any(one in e for one in situations) for e in exposures]) & known & ~with_it
        if min(with_it.sum(), left.sum()) >= _MIN_MISSIONS:
            made = shares_compared(
                CHOSEN + name, what, (int(success[left].sum()), int(left.sum())),
                (int(success[with_it].sum()), int(with_it.sum())), -1.0, GAP,
            )  # fmt: skip
            # A condition is often an outcome, so some gap is expected and raises no suspicion.
            yield replace(made, status="ok") if made.status == "undecided" else made
