"""Novelty: how far an observation is from those of other episodes. It finds what no rule describes.

The novelty of a row is the mean distance of its observation (scaled by the task) to the NEAREST
observations among REFERENCE rows of the task, without rows of its own episode. The reference rows
are drawn by hashes of their ids, so files and threads do not change them. As their number is fixed,
the cost is linear in the rows of the store, and what is rare in the store stays novel, however many
rows of it there are.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, TypeVar

import duckdb
import numpy as np
import pyarrow as pa

from restock.arrays import F32, Ints
from restock.errors import StoreError
from restock.replay.store.definitions import stored_rows
from restock.replay.store.parquet_views import passed_in

if TYPE_CHECKING:
    from restock.replay.store.store import Store

REFERENCE = 2_000  # reference rows per task
NEAREST = 10  # number of nearest reference rows; the mean distance to them is the novelty
NOVEL_SHARE = 0.01  # share of a task's rows that are `novel`: those with the largest novelty
QUICK_ROWS = 100_000  # up to so many rows, measuring takes seconds
KEPT = "novelty.parquet"  # in a store: table `novelty`, and a hash of the measured files' paths
T = TypeVar("T", pa.Table, pa.RecordBatch)
_BATCH_ROWS = 65_536
_AT_A_TIME = 512  # rows compared at a time
_ENTRIES = 3  # observation entries that are reported as unusual
_COLUMNS = "task_hash, episode_id, transition_id, observation"
# md5, because DuckDB's `hash` may change with its version.
_REFERENCE = f"""
    SELECT {_COLUMNS}
    FROM transitions
    WHERE transition_id IN (
        SELECT unnest(
            arg_min(transition_id, md5_number_lower(transition_id::VARCHAR), {REFERENCE})
        )
        FROM transitions
        GROUP BY task_hash
    )
    ORDER BY transition_id
"""
_MEASURED = pa.schema({"task": pa.int16(), "transition_id": pa.int64(), "novelty": pa.float32()})
_NOVELTY = f"""
    SELECT transition_id, novelty, novelty > threshold AS novel
    FROM measured
    JOIN (
        SELECT task, quantile_cont(novelty, {1 - NOVEL_SHARE}) AS threshold
        FROM measured
        GROUP BY task
    ) USING (task)
    ORDER BY transition_id
"""
_NOVEL_ROWS = """
    SELECT
        'novel' AS condition,
        'pre' AS timing,
        count(*) AS rows_held,
        count(*) / nullif((SELECT count(*) FROM novelty), 0) AS held_share,
        count(DISTINCT episode_id) AS episodes_held,
        (count(DISTINCT episode_id) FILTER (WHERE success))
            / nullif(count(DISTINCT episode_id) FILTER (WHERE success IS NOT NULL), 0)
            AS success_share,
        count(DISTINCT recording_id) AS recordings,
        count(DISTINCT zone) AS zones,
        list_sort(list(DISTINCT behaviour_policy)) AS behaviour_policies,
        count(*) FILTER (WHERE len(conditions) = 0) AS nominal_rows,
        0 AS uncertain_recordings
    FROM transitions
    JOIN (SELECT transition_id FROM novelty WHERE novel) USING (transition_id)
    JOIN (SELECT episode_id, success FROM episodes) USING (episode_id)
"""


@dataclass(frozen=True)
class Reference:
    """R reference rows of one task."""

    observation: F32  # (R, D)
    episodes: pa.Array  # ids
    episode: Ints  # (R,) index into `episodes`

    @classmethod
    def of(cls, rows: pa.Table) -> Reference:
        coded = rows["episode_id"].combine_chunks().dictionary_encode()
        return cls(_observations(rows), coded.dictionary, coded.indices.to_numpy())

    def compare(self, observation: F32, episode_id: pa.Array) -> tuple[Ints, F32]:
        """Return the nearest reference rows of other episodes, (N, NEAREST), and the novelty, (N,).

        The novelty is NaN if other episodes have fewer than NEAREST reference rows.
        """
        near = np.zeros((len(observation), NEAREST), np.int64)
        novelty = np.full(len(observation), np.nan, np.float32)
        if len(self.observation) < NEAREST:
            return near, novelty
        import pyarrow.compute as pc  # slow to import

        own = pc.index_in(episode_id, value_set=self.episodes).fill_null(-1).to_numpy()
        square = np.square(self.observation).sum(axis=1)
        for begin in range(0, len(observation), _AT_A_TIME):
            part = slice(begin, begin + _AT_A_TIME)
            # (n, R) squared distances, less a constant per observation: their order is the same.
            distance = square - 2 * (observation[part] @ self.observation.T)
            distance[own[part, None] == self.episode] = np.inf
            found = np.argpartition(distance, NEAREST - 1, axis=1)[:, :NEAREST]
            found.sort(axis=1)  # a fixed order, so that the sum is always the same
            gap = observation[part, None] - self.observation[found]
            near[part] = found
            novelty[part] = np.linalg.norm(gap, axis=2).mean(axis=1)
            lacking = np.isinf(np.take_along_axis(distance, found, axis=1)).any(axis=1)
            novelty[part][lacking] = np.nan
        return near, novelty


def read_novelty(connection: duckdb.DuckDBPyConnection) -> pa.Table:
    """Measure the novelty of a connection's `transitions`: transition_id, novelty and novel."""
    references = _read_references(connection)
    measured = [_MEASURED.empty_table()]
    rows = connection.sql(f"SELECT {_COLUMNS} FROM transitions").to_arrow_reader(_BATCH_ROWS)
    for batch in rows:
        for number, (task, reference) in enumerate(references.items()):
            part = _of_task(batch, task)
            _, novelty = reference.compare(_observations(part), part["episode_id"])
            # A copy: a column of DuckDB's batch would keep the whole batch in memory.
            ids = part["transition_id"].to_numpy().copy()
            known = pa.array(novelty, from_pandas=True)  # NaN is null
            arrays = [pa.repeat(pa.scalar(number, pa.int16()), len(ids)), pa.array(ids), known]
            measured.append(pa.table(arrays, schema=_MEASURED))
    with passed_in(connection, measured=pa.concat_tables(measured)):
        return connection.sql(_NOVELTY).to_arrow_table()


def kept_novelty(store: Store) -> pa.Table:
    """Return the table of `read_novelty`, from the store if it was measured for the same files.

    Otherwise measure it and save it in the store, if the store can be written.
    """
    if _is_kept(store):
        return store.path.read(KEPT)
    table = read_novelty(store.connection).replace_schema_metadata(_fingerprint(store))
    with suppress(OSError, StoreError):
        store.path.write(table, KEPT)
    return table


def is_quick(store: Store) -> bool:
    """Return whether the novelty of a store's rows is saved, or can be measured within seconds."""
    return stored_rows(store.bare) <= QUICK_ROWS or _is_kept(store)


def _is_kept(store: Store) -> bool:
    with suppress(OSError, StoreError, pa.ArrowException):
        return bool(store.path.read_schema(KEPT).metadata == _fingerprint(store))
    return False


def _fingerprint(store: Store) -> dict[bytes, bytes]:
    of = repr((REFERENCE, NEAREST, NOVEL_SHARE, sorted(store.files["stored_transitions"])))
    return {b"of": blake2b(of.encode(), digest_size=16).hexdigest().encode()}


def strangest(store: Store, limit: int = 20) -> list[dict[str, Any]]:
    """Return the rows with the largest novelty, at most one per episode, in descending order.

    `strange` lists the observation entries that differ most from the nearest reference rows, each
    with its value and the mean of these rows.
    """
    rows = store.sql(
        "SELECT transition_id::VARCHAR AS row, round(novelty::DOUBLE, 2) AS novelty, '' AS strange,"
        " primary_condition AS condition, zone, robot, logged_time, source_file, step_index,"
        " task_hash, episode_id, observation"
        " FROM transitions JOIN novelty USING (transition_id) WHERE novelty.novelty IS NOT NULL"
        " QUALIFY row_number() OVER"
        " (PARTITION BY episode_id ORDER BY novelty.novelty DESC, transition_id) = 1"
        f" ORDER BY novelty.novelty DESC, transition_id LIMIT {limit}"
    ).to_arrow_table()
    references = _read_references(store.connection)
    found: list[dict[str, Any]] = rows.drop_columns(["observation"]).to_pylist()
    for number, row in enumerate(found):
        task, one = row.pop("task_hash"), rows.slice(number, 1)
        (observed,) = observation = _observations(one)
        near, _ = references[task].compare(observation, one["episode_id"])
        usual = references[task].observation[near[0]].mean(axis=0)
        names = store.task(task).observation_names
        furthest = np.argsort(-np.abs(observed - usual), kind="stable")[:_ENTRIES]
        row["strange"] = ", ".join(
            f"{names[entry]} {observed[entry]:.2f} (near: {usual[entry]:.2f})" for entry in furthest
        )
    return found


def novel_rows(store: Store) -> dict[str, Any]:
    """Summarise the novel rows in one row, like a condition's row in `coverage_by_condition`.

    `nominal_rows` counts the novel rows in which no condition holds.
    """
    (line,) = store.sql(_NOVEL_ROWS).to_arrow_table().to_pylist()
    return dict(line)


def explain_novel_rows(found: Mapping[str, Any]) -> str:
    """Return a sentence that explains the result of `novel_rows`."""
    if not found["rows_held"]:
        return "No row has a novelty: that needs some rows of other episodes to compare it with."
    return (
        f"Novel rows are the {NOVEL_SHARE:.0%} whose observations are furthest from those of other"
        f" episodes: in {found['nominal_rows']:,} of {found['rows_held']:,}, no condition holds."
    )


def _read_references(connection: duckdb.DuckDBPyConnection) -> dict[str, Reference]:
    rows = connection.sql(_REFERENCE).to_arrow_table()
    tasks = rows["task_hash"].unique().to_pylist()
    return {task: Reference.of(_of_task(rows, task)) for task in tasks}


def _of_task(rows: T, task: str) -> T:
    import pyarrow.compute as pc  # slow to import

    return rows.filter(pc.equal(rows["task_hash"], task))


def _observations(rows: pa.Table | pa.RecordBatch) -> F32:
    """Return the observations of one task's rows, (N, D)."""
    column = rows["observation"]
    lists = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    flat = lists.flatten().to_numpy(zero_copy_only=False)
    observation: F32 = flat.reshape(len(rows), -1) if len(rows) else np.empty((0, 1), np.float32)
    return observation
