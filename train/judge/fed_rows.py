"""Rows that a critic is fed, from a panel, a store or the twin, in one form.

Rows are sorted by episode and step, so that a row's predecessor stands before it. Most checks use
only observations, actions, rewards and ends of episodes, by the task's names. So a panel can be
judged even if its store no longer exists.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import chain
from statistics import NormalDist
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.errors import PanelError, RestockError, StoreError
from restock.ingest.task.conditions import Condition, label, primary
from restock.ingest.task.robot import Robot
from restock.ingest.task.task import STORED_SIGNALS, Task, nearness_of
from restock.replay.panel.panel import Panel
from restock.replay.store.parquet_views import passed_in
from restock.replay.store.store import Store
from restock.stats import ConfidenceInterval, holm, wilson
from restock.train.twin.env.drivers import Handover, Operator, PlannerFollower
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import DEFAULT
from restock.train.twin.missions import KINDS
from restock.train.twin.physics.perturbation import Perturbation

Status = Literal["ok", "off", "undecided", "not run"]
TAIL = 0.025  # one tail of a 95 % interval


@dataclass
class Comparison:
    """The result of a check: a figure, its 95 % interval and the range that is allowed.

    `status` is "ok" if `effect` is in the allowed range, "off" if the whole interval is outside,
    "undecided" if the interval reaches into the range.
    """

    check: str  # name of the check in `causes.toml` and the docs
    what: str  # what was compared, for people
    measure: str  # what `effect` is: "ratio", "difference", "share", …
    status: Status
    logs: float | None = None
    twin: float | None = None
    effect: float | None = None
    low: float | None = None
    high: float | None = None
    least: float | None = None  # lower end of the allowed range
    most: float | None = None  # upper end of the allowed range
    logs_rows: int = 0
    twin_rows: int = 0
    note: str = ""
    p: float = 1.0  # one-sided p-value of a value this far outside the allowed range

    @property
    def off(self) -> bool:
        return self.status == "off"

    @property
    def suspicious(self) -> bool:
        """Return whether the check is undecided but its interval excludes "no effect"."""
        neutral = 1.0 if self.measure == "ratio" else 0.0
        if self.status != "undecided" or self.low is None or self.high is None:
            return False
        return self.low > neutral or self.high < neutral


def judged(
    check: str, what: str, measure: str, interval: ConfidenceInterval, *,
    logs: float | None, twin: float | None, least: float = -math.inf, most: float = math.inf,
    logs_rows: int, twin_rows: int = 0, note: str = "",
) -> Comparison:  # fmt: skip
    """Judge a figure by its interval; the check was not run if the figure is not finite."""
    if not math.isfinite(interval.value):
        return not_run(check, what, note or "too few rows")
    within = least <= interval.value <= most
    beyond = interval.low > most or interval.high < least
    status: Status = "ok" if within else "off" if beyond else "undecided"
    return Comparison(
        check, what, measure, status, logs, twin,
        interval.value, interval.low, interval.high,
        None if math.isinf(least) else least, None if math.isinf(most) else most,
        logs_rows, twin_rows, note, _p_value(interval, least, most),
    )  # fmt: skip


def _p_value(interval: ConfidenceInterval, least: float, most: float) -> float:
    """Return the one-sided p-value of the nearest allowed value, from the interval's width."""
    value = interval.value
    if value > most:
        by, half = value - most, value - interval.low
    elif value < least:
        by, half = least - value, interval.high - value
    else:
        return 1.0
    z = by / half * NormalDist().inv_cdf(0.975) if half > 0 else math.inf
    return 1.0 if math.isnan(z) else NormalDist().cdf(-z)


def correct_over_parts(parts: Sequence[Sequence[Comparison]]) -> None:
    """Correct each check for the number of parts (robots, recordings) in which it was made.

    Holm's method: in sound logs, a check is off in any of the parts as rarely as a single test.
    """
    by_check: dict[str, list[Comparison]] = {}
    for row in chain.from_iterable(parts):
        by_check.setdefault(row.check, []).append(row)
    for rows in by_check.values():
        for row, adjusted in zip(rows, holm([row.p for row in rows]), strict=True):
            if row.off and adjusted > TAIL:
                row.status = "undecided"


def not_run(check: str, what: str, reason: str) -> Comparison:
    """Return the result of a check that could not run, with the reason."""
    return Comparison(check, what, "", "not run", note=reason)


def share_judged(
    check: str, what: str, found: int, of: int, most: float, *, least: float = 0.0, note: str = ""
) -> Comparison:
    """Judge a share of the logs' rows, `found` of `of`, against fixed limits."""
    if not of:
        return not_run(check, what, note or "no such rows")
    interval = ConfidenceInterval(found / of, *wilson(found, of))
    return judged(
        check, what, "share", interval, logs=found / of, twin=None, least=least, most=most,
        logs_rows=of,
        note=note,
    )  # fmt: skip


def shares_compared(
    check: str, what: str, logs: tuple[int, int], twin: tuple[int, int], least: float, most: float,
    note: str = "",
) -> Comparison:  # fmt: skip
    """Judge the difference of two shares, each (found, of), by Newcombe's interval."""
    if not logs[1] or not twin[1]:
        return not_run(check, what, "no such rows in the " + ("logs" if twin[1] else "twin"))
    (p, q), ((a, b), (c, d)) = (
        (logs[0] / logs[1], twin[0] / twin[1]),
        (wilson(*logs), wilson(*twin)),
    )
    interval = ConfidenceInterval(
        p - q, p - q - math.hypot(p - a, d - q), p - q + math.hypot(b - p, q - c)
    )
    return judged(
        check, what, "difference", interval, logs=p, twin=q, least=least, most=most,
        logs_rows=logs[1], twin_rows=twin[1], note=note,
    )  # fmt: skip


def unflagged(check: str, what: str, reason: str) -> Flags:
    """Return a check of single rows that could not run on any row, with the reason."""
    return Flags(check, what, np.zeros(0, np.int64), np.zeros(0, np.bool_), 0.0, reason)


@dataclass(frozen=True)
class Flags:
    """A check of single rows: the M rows that it checked, and which of these are off."""

    check: str
    what: str
    transition_id: Ints  # (M,)
    off: Bools  # (M,)
    most: float  # largest share of rows that may be off
    note: str = ""

    def of(self, rows: FedRows) -> Comparison:
        """Judge which share of these rows is off, among those that were checked."""
        inside = np.isin(self.transition_id, rows.transition_id)
        found = int(self.off[inside].sum())
        return share_judged(
            self.check, self.what, found, int(inside.sum()), self.most, note=self.note
        )


_COLUMNS = (
    *("transition_id", "episode_id", "step_index", "recording_id", "robot", "logged_ns"),
    *("condition", "action", "reward", "terminated", "truncated", "observation"),
    "next_observation",
)
FEW_EPISODES = 20  # with fewer, a bootstrap draws stretches of `BLOCK_STEPS` in place of episodes
BLOCK_STEPS = 50  # steps this far apart are no longer correlated
MAX_ROWS = 40_000  # at most about so many rows are read, in whole episodes from a fixed shuffle


@dataclass(frozen=True)
class FedRows:
    """N rows of one task, sorted by episode and step."""

    task: Task
    observation: F32  # (N, D)
    next_observation: F32  # (N, D) at t + 1, also if a panel has n-step returns
    action: Ints  # (N,)
    reward: F64  # (N,) of one step
    terminated: Bools  # (N,)
    truncated: Bools  # (N,)
    episode: Ints  # (N,) codes, ascending
    step: Ints  # (N,) number of the step in its episode
    recording: NDArray[np.str_]  # (N,)
    robot: NDArray[np.str_]  # (N,) the recording's tag; "" if it has none
    logged_ns: Ints  # (N,)
    condition: NDArray[np.str_]  # (N,)
    transition_id: Ints  # (N,)
    # These are None if the rows' store is missing:
    pose: F64 | None = None  # (N, 3) on the map: x and y in m, heading in rad
    success: F64 | None = None  # (N,) of the row's episode; NaN if unknown
    held: NDArray[np.object_] | None = None  # (N,) pairs of sets: conditions, exposures
    driver: NDArray[np.str_] | None = None  # (N,) behaviour policy; "" if unknown
    counted: Ints | None = None  # (N, 2) rows of its recording: written by ingest, still stored
    left_out: dict[str, int] = field(default_factory=dict)  # reason -> rows that were left out

    def __len__(self) -> int:
        return len(self.action)

    def take(self, chosen: Bools, **left_out: int) -> FedRows:
        """Return the chosen rows; `left_out` counts the others by reason."""
        arrays: dict[str, Any] = {
            item.name: value[chosen]
            for item in fields(self)
            if isinstance(value := getattr(self, item.name), np.ndarray)
        }
        return replace(self, left_out=self.left_out | left_out, **arrays)

    @cached_property
    def joined(self) -> Bools:
        """Return whether each row is the step after the row before it, (N,)."""
        joined = np.zeros(len(self), np.bool_)
        joined[1:] = (np.diff(self.episode) == 0) & (np.diff(self.step) == 1)
        return joined

    @cached_property
    def cluster(self) -> Ints:
        """Return each row's bootstrap unit, (N,): its episode, or a stretch if episodes are few."""
        if len(np.unique(self.episode)) >= FEW_EPISODES:
            return self.episode
        stretch = self.step // BLOCK_STEPS
        return self.episode * (int(stretch.max(initial=0)) + 1) + stretch

    @cached_property
    def last(self) -> Bools:
        """Return whether each row is the last of its episode, (N,)."""
        return np.asarray(
            np.append(np.diff(self.episode) != 0, np.ones(min(len(self), 1))), np.bool_
        )

    @cached_property
    def _stretch(self) -> Ints:
        return np.asarray(np.cumsum(~self.joined), np.int64)

    def before(self, lag: int) -> tuple[Ints, Bools]:
        """Return the row index (N,) `lag` steps earlier (later if < 0), and whether it exists."""
        place = np.arange(len(self)) - lag
        inside = np.clip(place, 0, max(len(self) - 1, 0))
        known = (place == inside) & (self._stretch[inside] == self._stretch)
        return inside, np.asarray(known, np.bool_)

    def now(self, name: str) -> F64:
        """Return an entry of the observations at t, (N,)."""
        return self._column(self.observation, name)

    def after(self, name: str) -> F64:
        """Return an entry of the observations at t + 1, (N,)."""
        return self._column(self.next_observation, name)

    def sectors(self, *, after: bool = False) -> F64:
        """Return the clearance entries (N, sectors), in [0, 1], by ascending bearing."""
        return nearness_of(self.task, self.next_observation if after else self.observation)

    def previous_action(self, *, after: bool = False) -> Ints:
        """Return the previous action that the observations at t, or t + 1, contain, (N,)."""
        first = self.task.observation_names.index("previous_action_0")
        rows = self.next_observation if after else self.observation
        held = rows[:, first : first + len(self.task.actions)]
        return np.asarray(held.argmax(axis=1), np.int64)

    def command(self) -> F64:
        """Return the speed (m/s) and yaw rate (rad/s) of each row's action, (N, 2)."""
        return np.asarray(self.task.actions, np.float64)[self.action]

    def _column(self, rows: F32, name: str) -> F64:
        return rows[:, self.task.observation_names.index(name)].astype(np.float64)


def of_panel(panel: Panel, most: int = MAX_ROWS) -> FedRows:
    """Return the rows of a panel, at most about `most`.

    A row with an n-step return gets its next observation from the following row. It is left out,
    and counted, if the panel does not have that row.

    Raises:
        PanelError: a row's action is not among the task's.
    """
    meta = panel.meta
    order = _order_by_step(meta)
    counts = np.unique(_text(meta, "episode_id"), return_counts=True)[1]
    kept = np.repeat(np.isin(np.arange(len(counts)), _choose_episodes(counts, most)), counts)
    order = order[kept]
    packed = np.asarray(panel.rows[order])
    rows = FedRows(
        task=panel.task,
        observation=packed[:, panel.columns["observation"]],
        next_observation=packed[:, panel.columns["next_observation"]],
        left_out=_count_left_out(int((~kept).sum())),
        **_columns(meta, order),
    )
    _check_actions(rows, PanelError, str(panel.path))
    far = _numbers(meta, "horizon")[order] > 1
    return _with_one_step(rows, np.asarray(far, np.bool_)) if far.any() else rows


def of_store(store: Store, task_hash: str, most: int = MAX_ROWS) -> FedRows:
    """Return a store's rows of one task, at most about `most`.

    Raises:
        StoreError: there are none, or a row's action is not among the task's.
    """
    counted = store.connection.sql(
        "SELECT episode_id, count(*) AS rows FROM transitions WHERE task_hash = ?"
        " GROUP BY ALL ORDER BY ALL",
        params=[task_hash],
    ).to_arrow_table()
    if not len(counted):
        raise StoreError(f"no transitions of task {task_hash}", where=str(store.path))
    counts = counted["rows"].to_numpy()
    kept = _choose_episodes(counts, most)
    wanted = counted.select(["episode_id"]).take(pa.array(kept))
    named = ("primary_condition AS condition" if n == "condition" else n for n in _COLUMNS)
    with passed_in(store.connection, wanted=wanted):
        table = store.connection.sql(
            f"SELECT {', '.join(named)} FROM transitions SEMI JOIN wanted USING (episode_id)"
            " WHERE task_hash = $task",
            params={"task": task_hash},
        ).to_arrow_table()
    order = _order_by_step(table)
    task = store.task(task_hash)
    rows = FedRows(
        task=task,
        observation=_vectors(table["observation"], task.observation_size)[order],
        next_observation=_vectors(table["next_observation"], task.observation_size)[order],
        left_out=_count_left_out(int(counts.sum()) - len(order)),
        **_columns(table, order),
    )
    _check_actions(rows, StoreError, str(store.path))
    return rows


def _check_actions(rows: FedRows, error: type[RestockError], where: str) -> None:
    """Raise an error if a row's action is not in the task's table."""
    actions = len(rows.task.actions)
    unknown = np.flatnonzero((rows.action < 0) | (rows.action >= actions))
    if len(unknown):
        first = unknown[0]
        raise error(
            f"transition {rows.transition_id[first]} (step {rows.step[first]} of an episode of "
            f"recording {rows.recording[first]}) has action {rows.action[first]}, and the task has"
            f" actions 0 to {actions - 1}; rows with such an action: {len(unknown):,}",
            where=where,
            remedy="something changed actions after ingest: ingest the logs again",
        )


def _choose_episodes(counts: Ints, most: int) -> Ints:
    """Choose which episodes (E,) to read: all, or enough for about `most` rows."""
    shuffled = np.random.default_rng(0).permutation(len(counts))
    return np.sort(shuffled[np.cumsum(counts[shuffled]) <= max(most, counts[shuffled[:1]].sum())])


def _order_by_step(table: pa.Table) -> Ints:
    episode = np.unique(_text(table, "episode_id"), return_inverse=True)[1].reshape(-1)
    return np.lexsort((_numbers(table, "step_index"), episode))


def _count_left_out(rows: int) -> dict[str, int]:
    return {"in episodes beyond the limit of rows to check": rows} if rows else {}


def _columns(table: pa.Table, order: Ints) -> dict[str, Any]:
    """Return the fields of `FedRows` that a store's rows and a panel's `meta` both have."""
    episode = np.unique(_text(table, "episode_id")[order], return_inverse=True)[1].reshape(-1)
    kinds: dict[str, Any] = {"action": np.int64, "reward": np.float64, "transition_id": np.int64}
    kinds |= {"terminated": np.bool_, "truncated": np.bool_, "logged_ns": np.int64}
    found = {name: _numbers(table, name)[order].astype(kind) for name, kind in kinds.items()}
    return found | {
        "episode": episode.astype(np.int64),
        "step": _numbers(table, "step_index")[order].astype(np.int64),
        "recording": _text(table, "recording_id")[order],
        "robot": _text(table, "robot")[order]
        if "robot" in table.column_names  # panels made by an older Restock lack it
        else np.full(len(order), ""),
        "condition": _text(table, "condition")[order],
    }


def _with_one_step(rows: FedRows, far: Bools) -> FedRows:
    """Replace next observations that are several steps ahead (`far`) by those of the next step."""
    following, known = rows.before(-1)
    after = rows.next_observation.copy()
    after[far & known] = rows.observation[following[far & known]]
    lost = far & ~known
    left = {"the next step is not in the panel": int(lost.sum())}
    return replace(rows, next_observation=after).take(~lost, **left)


def _numbers(table: pa.Table, name: str) -> NDArray[Any]:
    values: NDArray[Any] = table[name].to_numpy()
    return values


def _text(table: pa.Table, name: str) -> NDArray[np.str_]:
    values = table[name].cast(pa.string()).fill_null("").to_numpy()
    return np.asarray(values).astype(np.str_)


def _vectors(column: pa.ChunkedArray, size: int) -> F32:
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return np.ascontiguousarray(flat, np.float32).reshape(-1, size)


ROBOTS, STEPS = 24, 400  # robots in the twin, and steps of each
EXPLORATION = 0.1  # exploration rate of their drivers
POSE = ("pose_x_m", "pose_y_m", "pose_yaw_rad")
_SIGNALS = tuple(signal.name for signal in STORED_SIGNALS)


def drive_twin(
    task: Task,
    conditions: Sequence[Condition],
    *,
    robot: Robot | None = None,
    perturbation: Perturbation | None = None,
    layouts: str = DEFAULT,
    seed: int = 0,
    robots: int = ROBOTS,
    steps: int = STEPS,
) -> FedRows:
    """Drive the twin, and return the rows of episodes that ended within `steps` steps per robot.

    `conditions` must be computable from the twin's signals.

    Raises:
        ConfigError: the twin cannot keep the task's control period, or has no such body.
    """
    env = WarehouseVectorEnv(
        robots, conditions=dict.fromkeys(KINDS, 1.0), perturbation=perturbation, seed=seed,
        nthread=0, task=task, robot=robot, layouts=layouts,
    )  # fmt: skip
    table = np.asarray(task.actions, np.float64)
    driver = Handover(
        PlannerFollower(epsilon=EXPLORATION, seed=seed), Operator(epsilon=EXPLORATION, seed=seed)
    )
    taken: list[dict[str, NDArray[Any]]] = []
    observation, _ = env.reset(seed=seed)
    for _ in range(steps):
        action, _ = driver.act(env, observation)
        now = {name: column.copy() for name, column in env.signals.items()}
        after, reward, terminated, truncated, info = env.step(action)
        ended = terminated | truncated
        now["command_speed_mps"], now["command_yaw_rate_radps"] = table[action].T
        step = {"now " + name: now[name] for name in _SIGNALS}
        step |= {"after " + name: info["signals"][name] for name in _SIGNALS}
        following = after.copy()
        for place in np.flatnonzero(ended):
            following[place] = info["final_obs"][place]
        taken.append(
            step
            | {"observation": observation, "next_observation": following, "action": action}
            | {"reward": reward, "terminated": terminated, "truncated": truncated}
            | {"ended": ended, "invalid": info["invalid"]}
        )
        observation = after
    env.close()
    return _rows_of_ended_episodes(task, conditions, taken)


def _rows_of_ended_episodes(
    task: Task, conditions: Sequence[Condition], taken: Sequence[dict[str, NDArray[Any]]]
) -> FedRows:
    """Return the rows of valid episodes that ended, robot by robot, from T steps of N robots."""
    steps = {name: np.stack([step[name] for step in taken], axis=1) for name in taken[0]}
    flat = {name: values.reshape(-1, *values.shape[2:]) for name, values in steps.items()}
    ended = steps["ended"]
    later = np.cumsum(ended[:, ::-1], axis=1)[:, ::-1].reshape(-1)  # number of ends from here on
    robot = np.repeat(np.arange(len(ended)), ended.shape[1])
    episode = np.unique(robot * (ended.shape[1] + 1) - later, return_inverse=True)[1].reshape(-1)
    broken = np.isin(episode, episode[flat["invalid"]])
    kept = (later > 0) & ~broken
    chosen = {name: values[kept] for name, values in flat.items()}
    episode = np.unique(episode[kept], return_inverse=True)[1].reshape(-1).astype(np.int64)
    first = np.flatnonzero(np.append(True, np.diff(episode) != 0)[: len(episode)])
    step = np.arange(len(episode)) - np.repeat(first, np.diff(np.append(first, len(episode))))
    return FedRows(
        task=task,
        observation=chosen["observation"],
        next_observation=chosen["next_observation"],
        action=chosen["action"].astype(np.int64),
        reward=chosen["reward"].astype(np.float64),
        terminated=chosen["terminated"],
        truncated=chosen["truncated"],
        episode=episode,
        step=step.astype(np.int64),
        recording=np.full(len(episode), "twin"),
        robot=np.full(len(episode), ""),
        logged_ns=np.zeros(len(episode), np.int64),
        condition=_labels(conditions, chosen, episode, step),
        transition_id=np.arange(len(episode), dtype=np.int64),
        pose=np.stack([chosen["now " + name] for name in POSE], axis=1),
    )


def _labels(
    conditions: Sequence[Condition], rows: dict[str, NDArray[Any]], episode: Ints, step: Ints
) -> NDArray[np.str_]:
    """Return the primary condition of each row, computed as for logs."""
    ends = np.flatnonzero(rows["ended"])
    order = np.argsort(np.concatenate([np.arange(len(episode)), ends + 0.5]), kind="stable")
    columns: dict[str, Any] = {
        "episode_index": np.concatenate([episode, episode[ends]])[order],
        "step_index": np.concatenate([step, step[ends] + 1])[order],
    }
    for name in _SIGNALS:
        both = np.concatenate([rows["now " + name], rows["after " + name][ends]])
        columns[name] = both[order]
    labels = label(pa.table(columns), list(conditions))
    names = np.array(primary(labels, list(conditions)) or ["nominal"] * len(order))
    return np.asarray(names[order < len(episode)], np.str_)
