"""A store's steps for comparing them with the twin: each row, and the step that came after it.

A row holds its signals at t; those at t + 1 are the next row's, or, at an episode's end, those of
the step that only ends it, which the store keeps in its files' metadata.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from restock.errors import StoreError
from restock.ingest.store.episode_rows import episode_ends
from restock.ingest.store.writer import TRANSITIONS
from restock.ingest.task.schema import SIGNAL_COLUMNS
from restock.ingest.task.signals import Columns
from restock.ingest.task.task import Task
from restock.replay.store.store import Store, passed_in

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

NOMINAL = "nominal"
SIGNALS = tuple(column.name for column in SIGNAL_COLUMNS)
_FIRST_SECTOR = "clearance_"


@dataclass(frozen=True)
class LoggedSteps:
    """N rows of one task, by recording, episode and step."""

    task: Task
    now: dict[str, NDArray[Any]]  # the stored signals at t, (N,) each
    after: dict[str, NDArray[Any]]  # those at t + 1; of no meaning where not `followed`
    followed: Bools  # (N,) the step at t + 1 is known
    transition_id: Ints  # (N,)
    episode_id: NDArray[np.str_]  # (N,)
    begins: Bools  # (N,) the row before belongs to another episode, or is not there
    action: Ints  # (N,)
    reward: F64  # (N,)
    progress_m: F64  # (N,)
    conditions: dict[str, Bools]  # name -> (N,) it holds; `nominal` where none does

    def __len__(self) -> int:
        return len(self.transition_id)

    def find(self, transition_id: Ints) -> Ints:
        """The rows of these ids, which must be here."""
        order = np.argsort(self.transition_id, kind="stable")
        found: Ints = order[np.searchsorted(self.transition_id, transition_id, sorter=order)]
        return found


def logged_steps(store: Store, task_hash: str | None = None) -> LoggedSteps:
    """All rows of a store's task.

    Raises:
        StoreError: the store has none, or rows of several tasks and no `task_hash`.
    """
    task = store.task(task_hash)
    sql = (files("restock.train.twin.calibration") / "logged_steps.sql").read_text(encoding="utf-8")
    table = store.connection.sql(sql, params={"task": task_hash or task.hash}).to_arrow_table()
    if not len(table):
        raise StoreError("it holds no transitions", where=str(store.path))
    now = {name: _numbers(table[name]) for name in SIGNALS}
    episode = table["episode_id"].to_numpy().astype(str)
    step = _numbers(table["step_index"])
    same = (episode[1:] == episode[:-1]) & (step[1:] == step[:-1] + 1)
    after = {name: np.append(column[1:], column[:1]) for name, column in now.items()}
    followed = np.append(same, False)
    row_of = {
        (name, number): row
        for row, (name, number) in enumerate(zip(episode.tolist(), step.tolist(), strict=True))
        if not followed[row]
    }
    for recording, ends in _ends(store):
        columns = {name: _numbers(ends[name]) for name in ("episode_index", "step_index", *SIGNALS)}
        for end in range(len(ends)):
            name = f"{recording}/{columns['episode_index'][end]}"
            row = row_of.get((name, int(columns["step_index"][end]) - 1))
            if row is not None:
                followed[row] = True
                for signal in SIGNALS:
                    after[signal][row] = columns[signal][end]
    return LoggedSteps(
        task=task,
        now=now,
        after=after,
        followed=followed,
        transition_id=_numbers(table["transition_id"]),
        episode_id=episode,
        begins=~np.append(False, same),
        action=_numbers(table["action"]).astype(np.int64),
        reward=_numbers(table["reward"]),
        progress_m=_numbers(table["progress_m"]),
        conditions=_conditions(table["conditions"].to_pylist()),
    )


def observations(store: Store, transition_id: Ints, size: int) -> tuple[F32, F32]:
    """Observation and next observation of these rows, (n, D) each, in this order."""
    wanted = pa.table({"transition_id": transition_id, "place": np.arange(len(transition_id))})
    with passed_in(store.connection, wanted=wanted):
        table = store.connection.sql(
            "SELECT observation, next_observation FROM wanted"
            " JOIN transitions USING (transition_id) ORDER BY place"
        ).to_arrow_table()
    now, after = (_vectors(table[name], size) for name in ("observation", "next_observation"))
    return now, after


def sector_clearance(task: Task, observation: F32) -> F64:
    """The sector clearances (n, sectors) in metres that an observation (n, D) was made of.

    Those beyond the task's range read as its range: an observation does not tell them apart.
    """
    first = next(
        place for place, name in enumerate(task.observation_names) if name.startswith(_FIRST_SECTOR)
    )
    seen = observation[:, first : first + task.sectors].astype(np.float64)
    return np.asarray(seen**2 * task.range_max_m, np.float64)


def previous_action(task: Task, observation: F32) -> Ints:
    """The action before t (n,), from the observation at t."""
    first = task.observation_names.index("previous_action_0")
    one_hot = observation[:, first : first + len(task.actions)]
    chosen: Ints = np.argmax(one_hot, axis=1).astype(np.int64)
    return chosen


def rows_of(columns: Columns, rows: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Some rows of every column."""
    return {name: column[rows] for name, column in columns.items()}


def _conditions(held: Sequence[Sequence[str] | None]) -> dict[str, Bools]:
    lists = [names or () for names in held]
    known = sorted({name for names in lists for name in names})
    found = {name: np.array([name in names for names in lists], np.bool_) for name in known}
    return {NOMINAL: np.array([not names for names in lists], np.bool_), **found}


def _ends(store: Store) -> list[tuple[str, pa.Table]]:
    """(recording, the steps that only end its episodes) of every file that carries them."""
    found = []
    root = store.path.table(TRANSITIONS)
    for file in store.files["stored_transitions"]:
        schema = pq.read_schema(
            f"{TRANSITIONS}/{file.removeprefix(f'{root}/')}", filesystem=store.path.files
        )
        ends = episode_ends(schema.empty_table())
        if ends is not None:
            found.append((file.removeprefix(f"{root}/").split("/")[0], ends))
    return found


def _numbers(column: pa.ChunkedArray) -> NDArray[Any]:
    """float32 as float64: what is computed from it is computed as ingest does."""
    values: NDArray[Any] = column.combine_chunks().to_numpy(zero_copy_only=False)
    return values.astype(np.float64) if values.dtype == np.float32 else values.copy()


def _vectors(column: pa.ChunkedArray, size: int) -> F32:
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return np.ascontiguousarray(flat, np.float32).reshape(-1, size)
