"""Logged episodes for judging a policy that never learnt from them, and rows for the models.

Held out are whole episodes of which no row is in the panel that trained. The models (the values,
and where the logs do not say it the behaviour) are fitted on the panel's rows alone.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from restock.errors import RunError, StoreError
from restock.ingest.store.location import Location
from restock.ingest.task.task import Task
from restock.replay.panel.panel import HEADER, HELD_OUT, Panel
from restock.replay.store.store import Store, passed_in
from restock.train.dqn.fitted_q import Rows

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Measure = Literal["return", "success"]
MODEL_ROWS = 200_000  # at most, chosen by chance: bounds memory and time


@dataclass(frozen=True)
class Steps:
    """Rows by episode and step; only the first steps of an episode may be there."""

    rows: Rows
    episode: Ints  # (N,) ascending, the place in `condition`
    condition: NDArray[np.str_]  # (E,) of each episode
    truncated: Bools  # (N,)
    probability: NDArray[np.float64]  # (N,) of the action, as logged; NaN where it is not
    bumps: Bools  # (N,) a contact in [t, t + 1)
    bumped_before: Bools  # (N,) a contact in the episode up to t

    def measured(self, measure: Measure) -> Steps:
        """The same rows with what is measured as their reward.

        `return` is the task's own reward. `success` is 1 on reaching the goal and 0 else, and a
        contact ends the episode: discounted by 1 it is the chance to arrive without any.
        """
        if measure == "return":
            return self
        keep = ~self.bumped_before
        rows = self.rows
        arrives = (rows.terminated & ~self.bumps)[keep]
        counted = Rows(
            rows.observation[keep],
            rows.action[keep],
            arrives.astype(np.float32),
            rows.next_observation[keep],
            (rows.terminated | self.bumps)[keep],
        )
        return replace(
            self,
            rows=counted,
            episode=self.episode[keep],
            truncated=self.truncated[keep],
            probability=self.probability[keep],
            bumps=self.bumps[keep],
            bumped_before=self.bumped_before[keep],
        )


@dataclass(frozen=True)
class Evidence:
    """What a policy is judged by."""

    model: Steps  # to fit models on
    held: Steps  # to judge by: no episode of these is among those
    notes: tuple[str, ...]  # what is worth saying


def find_evidence(
    trained: Panel | None, task: Task, logs: str | None = None, *, seed: int = 0
) -> Evidence:
    """Episodes that a run did not learn from, and the rows that it did.

    Args:
        trained: the panel that the run learnt from. For a run without one the models are fitted
            on half of the episodes of `logs`, chosen by hash.
        task: that the run was trained on.
        logs: a store, or a panel, whose held-out rows then count; default the run's own panel.
        seed: of the choice of rows for the models, where there are many.

    Raises:
        RunError: no episode is left, or the logs are of another task.
        StoreError, PanelError: no store or panel there, or it is no longer what it was.
    """
    if logs is None and trained is None:
        raise RunError("learnt from no panel", remedy="name logs with --on-logs STORE")
    notes: list[str] = []
    with ExitStack() as opened:
        store, asked = _open(logs, trained, task)
        opened.enter_context(store)
        if trained is None:
            asked, fed = _halves(store, asked)
            source = store
            notes.append("the run had no panel: the models are of one half of the episodes")
        else:
            asked, seen = _unseen(store, trained, asked)
            if seen:
                notes.append(f"{seen:,} episodes left aside: rows of them were trained on")
            fed = np.asarray(trained.meta_column("transition_id"), np.int64)
            source = store if logs is None else opened.enter_context(_store_of(trained))
        if not len(asked) or not len(fed):
            raise RunError(
                "holds no episode that the run did not learn from",
                where=logs or (str(trained.path) if trained is not None else None),
                remedy="mix with [held_out] share above 0, or name other logs with --on-logs",
            )
        if len(fed) > MODEL_ROWS:
            notes.append(f"models are of {MODEL_ROWS:,} of {len(fed):,} rows, chosen by chance")
            fed = np.random.default_rng([seed, 11]).choice(fed, MODEL_ROWS, replace=False)
        held, model = read_steps(store.connection, asked), read_steps(source.connection, fed)
    for name, there, wanted in (("held-out", held, asked), ("panel's", model, fed)):
        if missing := len(wanted) - len(there.rows):
            notes.append(f"{missing:,} {name} rows are of other stores, and not looked at")
        if not len(there.rows):
            raise StoreError(f"has none of the {name} rows", where=str(source.path))
    return Evidence(model, held, tuple(notes))


def _open(logs: str | None, trained: Panel | None, task: Task) -> tuple[Store, Ints]:
    """The store of the logs, and the ids of the rows in question."""
    panel = trained
    if logs is not None:
        place = Location.of(logs)
        folder = place.folder
        panel = Panel.open(folder) if folder is not None and (folder / HEADER).is_file() else None
    if panel is not None:
        ids = pq.read_table(panel.path / HELD_OUT, columns=["transition_id"])["transition_id"]
        store, asked, found = _store_of(panel), np.asarray(ids, np.int64), {panel.task_hash}
    else:
        store = Store(place)
        rows = store.connection.sql("SELECT transition_id, task_hash FROM transitions")
        columns = rows.fetchnumpy()
        asked, found = np.asarray(columns["transition_id"], np.int64), set(columns["task_hash"])
    if found != {task.hash}:
        store.close()
        raise RunError(
            f"its rows are of task {', '.join(sorted(map(str, found))) or 'none'}, the run's is"
            f" {task.hash}",
            where=logs or str(store.path),
            remedy="ingest the logs again with the run's profile",
        )
    return store, asked


def read_steps(connection: duckdb.DuckDBPyConnection, ids: Ints) -> Steps:
    """The rows of these ids, by recording, episode and step."""
    query = (
        files("restock.train.evaluation").joinpath("held_episodes.sql").read_text(encoding="utf-8")
    )
    with passed_in(connection, asked=pa.table({"transition_id": ids})):
        table = connection.sql(query).to_arrow_table()
    names = np.asarray(table["episode_id"].to_pylist(), str)
    new = np.ones(len(names), np.bool_)
    new[1:] = names[1:] != names[:-1]
    labels = np.asarray(table["of_condition"].to_pylist(), str)

    def column(name: str, kind: Any) -> NDArray[Any]:
        return np.array(table[name].to_numpy(), kind)

    return Steps(
        Rows(
            _matrix(table["observation"]),
            column("action", np.int64),
            column("reward", np.float32),
            _matrix(table["next_observation"]),
            column("terminated", np.bool_),
        ),
        np.cumsum(new) - 1,
        labels[new],
        column("truncated", np.bool_),
        column("action_probability", np.float64),
        column("bumps", np.bool_),
        column("bumped_before", np.bool_),
    )


def _matrix(column: pa.ChunkedArray) -> NDArray[np.float32]:
    """A list column of N rows as (N, D)."""
    lists = column.combine_chunks()
    flat = np.array(lists.flatten().to_numpy(zero_copy_only=False), np.float32)
    return flat.reshape(len(lists), -1) if len(lists) else np.zeros((0, 0), np.float32)


def _store_of(panel: Panel) -> Store:
    if panel.store_version < 0:
        raise StoreError(
            "was mixed from a table in memory: its held-out rows are kept nowhere",
            where=str(panel.path),
            remedy="name the logs with --on-logs STORE",
        )
    return Store(panel.header.store, version=panel.store_version)


def _unseen(store: Store, trained: Panel, asked: Ints) -> tuple[Ints, int]:
    """Those of the rows whose episode has no row in the panel; and how many episodes had."""
    fed = pa.table({"episode_id": trained.meta["episode_id"].cast(pa.string())})
    ids = pa.table({"transition_id": asked})
    with passed_in(store.connection, asked=ids, fed=fed.group_by("episode_id").aggregate([])):
        seen = store.connection.sql(
            "SELECT count(DISTINCT episode_id) FROM transitions"
            " SEMI JOIN asked USING (transition_id) SEMI JOIN fed USING (episode_id)"
        ).fetchall()
        rest = store.connection.sql(
            "SELECT transition_id FROM transitions"
            " SEMI JOIN asked USING (transition_id) ANTI JOIN fed USING (episode_id)"
        ).fetchnumpy()["transition_id"]
    return np.asarray(rest, np.int64), int(seen[0][0])


def _halves(store: Store, asked: Ints) -> tuple[Ints, Ints]:
    """Rows to judge by, and rows for the models: episodes by hash."""
    with passed_in(store.connection, asked=pa.table({"transition_id": asked})):
        found = store.connection.sql(
            "SELECT transition_id, hash(episode_id) % 2 = 0 AS judged"
            " FROM transitions SEMI JOIN asked USING (transition_id)"
        ).fetchnumpy()
    ids, judged = np.asarray(found["transition_id"], np.int64), np.asarray(found["judged"])
    return ids[judged], ids[~judged]


def run_panel(document: dict[str, Any]) -> Panel | None:
    """The panel that a run learnt from, by its `config.json`; None where it had none."""
    fed = document.get("panel")
    return None if fed is None else Panel.open(Path(fed["path"]))


__all__ = ["Evidence", "Measure", "Steps", "find_evidence", "run_panel"]
