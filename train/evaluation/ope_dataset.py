"""The data set of an off-policy evaluation: logged episodes that the policy never learned from.

A policy is evaluated on whole episodes without any row in the panel that trained it. The models are
fitted only on the panel's rows: action values, and the behaviour if the logs lack probabilities.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any, Literal

import duckdb
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.errors import PanelError, RunError, StoreError
from restock.files import read_table
from restock.ingest.store.location import Location
from restock.ingest.task.task import Task
from restock.replay.panel.panel import EVALUATION_SPLIT, HEADER, Panel
from restock.replay.store.parquet_views import passed_in
from restock.replay.store.store import Store
from restock.train.dqn.fitted_q import Transitions

Measure = Literal["return", "success"]
MODEL_ROWS = 200_000  # a model is fitted on at most so many random rows, to save memory and time


@dataclass(frozen=True)
class OpeSteps:
    """N rows, sorted by episode and step; episodes may lack their last steps."""

    rows: Transitions
    episode: Ints  # (N,) ascending, index in `condition`
    condition: NDArray[np.str_]  # (E,) of each episode
    probability: F64  # (N,) logged probability of the action; NaN if not logged
    bumps: Bools  # (N,) whether there was a contact in [t, t + 1)
    bumped_before: Bools  # (N,) whether there was a contact in the episode up to t

    def measured(self, measure: Measure) -> OpeSteps:
        """Return the rows with the measure as their reward.

        `return` is the task's own reward. `success` is 1 on reaching the goal and else 0. A contact
        then ends the episode, and rows after it are left out. With a discount of 1, the return of
        `success` is the probability of arriving without contact.
        """
        if measure == "return":
            return self
        keep = ~self.bumped_before
        rows = self.rows
        arrives = (rows.terminated & ~self.bumps)[keep]
        counted = Transitions(
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
            probability=self.probability[keep],
            bumps=self.bumps[keep],
            bumped_before=self.bumped_before[keep],
        )

    @property
    def unlogged(self) -> Bools:
        """Return whether the logs lack the action's probability, (N,)."""
        return ~(self.probability > 0)


@dataclass(frozen=True)
class OpeDataset:
    """The steps that a policy is evaluated on, and those that models are fitted on."""

    training: OpeSteps  # steps that the policy learned from; models are fitted on them
    evaluation: OpeSteps  # steps that the policy did not learn from
    notes: tuple[str, ...]  # for the user
    hindsight: bool = False  # goals were set in hindsight, so arriving is not a success


def load_ope_dataset(
    trained: Panel | None, task: Task, logs: str | None = None, *, seed: int = 0
) -> OpeDataset:
    """Load episodes that a run did not learn from, and the rows that it did learn from.

    Args:
        trained: the panel that the run learned from; the models are fitted on its rows.
        task: the task that the run was trained on.
        logs: a store, or a panel whose held-out rows are used; None: the run's own panel.
        seed: for choosing the models' rows at random if there are more than `MODEL_ROWS`.

    Raises:
        RunError: the run had no panel, no episode is left, or the logs are of another task.
        StoreError, PanelError: a store or panel is missing or has changed.
    """
    if trained is None:
        raise RunError(
            "did not learn from a panel, whose rows the models are fitted on",
            remedy="evaluate it in the twin: `restock eval RUN`",
        )
    notes: list[str] = []
    with ExitStack() as opened:
        store, ids = _open(logs, trained, task)
        opened.enter_context(store)
        training_ids = np.asarray(trained.meta_column("transition_id"), np.int64)
        if logs is None and trained.header.split_by == "within_episode":
            notes.append(f"held out: {trained.header.split_note}, not whole episodes")
        else:
            ids, left_out = _exclude_trained(store, trained, ids)
            if left_out:
                notes.append(f"{left_out:,} episodes left out: some of their rows were trained on")
        training_store = store if logs is None else opened.enter_context(panel_store(trained))
        if not len(ids) or not len(training_ids):
            raise RunError(
                "contains no episode that the run did not learn from"
                + (f" (held out: {trained.header.split_note})" if _unsplit(trained) else ""),
                where=logs or str(trained.path),
                remedy="mix with [evaluation_split] share above 0, or name other logs with"
                " --on-logs",
            )
        if (count := len(training_ids)) > MODEL_ROWS:
            notes.append(
                f"the models are fitted on {MODEL_ROWS:,} of {count:,} rows, chosen at random"
            )
            rng = np.random.default_rng([seed, 11])
            training_ids = rng.choice(training_ids, MODEL_ROWS, replace=False)
        evaluation = read_steps(store.connection, ids)
        if hindsight := _has_hindsight(store.connection, ids):
            notes.append("goals in hindsight are always reached: success is not estimated")
        training = read_steps(training_store.connection, training_ids)
    for name, steps, requested in (
        ("held-out", evaluation, ids),
        ("panel's", training, training_ids),
    ):
        if missing := len(requested) - len(steps.rows):
            notes.append(f"{missing:,} {name} rows are in other stores, and not used")
        if not len(steps.rows):
            raise StoreError(f"has none of the {name} rows", where=str(training_store.path))
    return OpeDataset(training, evaluation, tuple(notes), hindsight)


def _unsplit(trained: Panel) -> bool:
    """Return whether a panel's logs had no rows to hold out."""
    return not trained.splits and bool(trained.header.split_note)


def _has_hindsight(connection: duckdb.DuckDBPyConnection, ids: Ints) -> bool:
    """Return whether some of these rows have a goal that was set in hindsight."""
    with passed_in(connection, wanted=pa.table({"transition_id": ids})):
        ((found,),) = connection.sql(
            "SELECT coalesce(bool_or(goal_source = 'hindsight'), false) FROM transitions"
            " SEMI JOIN wanted USING (transition_id)"
        ).fetchall()
    return bool(found)


def _open(logs: str | None, trained: Panel, task: Task) -> tuple[Store, Ints]:
    """Open the logs' store; return it with the IDs of its rows, or of a panel's held-out rows."""
    panel: Panel | None = trained
    if logs is not None:
        location = Location.of(logs)
        folder = location.folder
        panel = Panel.open(folder) if folder is not None and (folder / HEADER).is_file() else None
    if panel is not None:
        ids = held_out_of(panel)
        store, tasks = panel_store(panel), {panel.task_hash}
    else:
        store = Store(location)
        columns = store.connection.sql(
            "SELECT transition_id, task_hash FROM transitions"
        ).fetchnumpy()
        ids, tasks = columns["transition_id"], set(columns["task_hash"])
    if tasks != {task.hash}:
        store.close()
        raise RunError(
            f"its rows are of task {', '.join(sorted(map(str, tasks))) or 'none'}, but the run is"
            f" of task {task.hash}",
            where=logs or str(store.path),
            remedy="ingest the logs again with the run's profile",
        )
    return store, np.asarray(ids, np.int64)


def held_out_of(panel: Panel) -> Ints:
    """Return the IDs (n,) of a panel's held-out rows; raise PanelError if the file is damaged."""
    split = panel.path / EVALUATION_SPLIT
    panel.header.files[EVALUATION_SPLIT].check(split, verify=True)
    table = read_table(split, columns=["transition_id"], error=PanelError)
    return np.asarray(table["transition_id"], np.int64)


def held_out_rows(panel: Panel, driver: str | None = None) -> Transitions:
    """Return the held-out rows of a panel's first store; only those of `driver` if it is given.

    Raises:
        StoreError, PanelError: the store or the list of rows is missing.
    """
    ids = held_out_of(panel)
    with panel_store(panel) as store:
        if driver is not None:
            with passed_in(store.connection, wanted=pa.table({"transition_id": ids})):
                own = store.connection.execute(
                    "SELECT transition_id FROM transitions SEMI JOIN wanted USING (transition_id)"
                    " WHERE behaviour_policy = ?",
                    [driver],
                ).fetchnumpy()
            ids = np.asarray(own["transition_id"], np.int64)
        return read_steps(store.connection, ids).rows


def read_steps(connection: duckdb.DuckDBPyConnection, ids: Ints) -> OpeSteps:
    """Read the rows with these IDs, sorted by recording, episode and step."""
    query = files(__package__).joinpath("ope_episodes.sql").read_text(encoding="utf-8")
    with passed_in(connection, wanted=pa.table({"transition_id": ids})):
        table = connection.sql(query).to_arrow_table()
    names = np.asarray(table["episode_id"].to_pylist(), str)
    new = np.ones(len(names), np.bool_)
    new[1:] = names[1:] != names[:-1]
    labels = np.asarray(table["of_condition"].to_pylist(), str)

    def column(name: str, kind: Any) -> NDArray[Any]:
        return np.array(table[name].to_numpy(), kind)

    return OpeSteps(
        Transitions(
            _matrix(table["observation"]),
            column("action", np.int64),
            column("reward", np.float32),
            _matrix(table["next_observation"]),
            column("terminated", np.bool_),
        ),
        np.cumsum(new) - 1,
        labels[new],
        column("action_probability", np.float64),
        column("bumps", np.bool_),
        column("bumped_before", np.bool_),
    )


def _matrix(column: pa.ChunkedArray) -> F32:
    """Return a list column of N rows as (N, D)."""
    lists = column.combine_chunks()
    flat = np.array(lists.flatten().to_numpy(zero_copy_only=False), np.float32)
    return flat.reshape(len(lists), -1) if len(lists) else np.zeros((0, 0), np.float32)


def panel_store(panel: Panel) -> Store:
    """Open a panel's store at its version; raise StoreError if it was mixed from a table."""
    if panel.store_version < 0:
        raise StoreError(
            "was mixed from a table in memory: its held-out rows were not stored",
            where=str(panel.path),
            remedy="give the logs with --on-logs STORE",
        )
    return Store(panel.header.store, version=panel.store_version)


def _exclude_trained(store: Store, trained: Panel, ids: Ints) -> tuple[Ints, int]:
    """Leave out episodes with rows in the panel; return the other row IDs and the number left out.

    An episode is also left out if it has a copy of one of the panel's rows under another ID.
    """
    meta = trained.meta
    learnt = pa.table({"transition_id": meta["transition_id"]})
    with passed_in(store.connection, learnt=learnt):
        copies = store.sql(
            "SELECT DISTINCT episode_id FROM transitions WHERE transition_id IN (SELECT"
            " transition_id FROM same_steps() WHERE step IN (SELECT step FROM same_steps()"
            " SEMI JOIN learnt USING (transition_id)))"
        ).fetchnumpy()["episode_id"]
    episodes = np.union1d(meta["episode_id"].unique().to_numpy(zero_copy_only=False), copies)
    with passed_in(
        store.connection,
        wanted=pa.table({"transition_id": ids}),
        trained=pa.table({"episode_id": pa.array(episodes.tolist(), pa.string())}),
    ):
        ((left_out,),) = store.connection.sql(
            "SELECT count(DISTINCT episode_id) FROM transitions"
            " SEMI JOIN wanted USING (transition_id) SEMI JOIN trained USING (episode_id)"
        ).fetchall()
        rest = store.connection.sql(
            "SELECT transition_id FROM transitions"
            " SEMI JOIN wanted USING (transition_id) ANTI JOIN trained USING (episode_id)"
        ).fetchnumpy()["transition_id"]
    return np.asarray(rest, np.int64), int(left_out)
