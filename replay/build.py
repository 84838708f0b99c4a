"""Build a panel: a plan's rows packed into one memory-mapped file, all or nothing."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import duckdb
import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from restock import __version__
from restock.errors import PanelError, StoreError
from restock.ingest.conditions import NOMINAL, Condition, labels_version, shipped
from restock.ingest.task import Task
from restock.replay.layout import PACKING_VERSION, Ints, n_step_return, row_columns, row_width
from restock.replay.mixture import Mixture
from restock.replay.panel import (
    HEADER,
    HELD_OUT,
    META,
    ROWS,
    FileRecord,
    Header,
    Panel,
    Stratum,
    checksum,
)
from restock.replay.plan import Plan, plan_panel
from restock.replay.store import Store

BATCH_ROWS = 16_384  # observations held in memory at a time, while packing


@dataclass(frozen=True)
class Source:
    """Where transitions come from: a connection with a view `transitions`, and what it is."""

    connection: duckdb.DuckDBPyConnection
    name: str
    version: int
    task_json: Callable[[str], str]  # task hash -> the task as JSON; "" where nothing is known
    conditions: tuple[Condition, ...]


@contextmanager
def open_source(
    transitions: pa.Table | Store,
    *,
    task: Task | None = None,
    conditions: Sequence[Condition] | None = None,
) -> Iterator[Source]:
    """A store, or a table with the columns of `ingest.schema`, as a source of a panel.

    Without `conditions` a table's are the shipped ones that its labels name.
    """
    if isinstance(transitions, Store):
        found = transitions.conditions() if conditions is None else tuple(conditions)
        yield Source(
            transitions.connection,
            str(transitions.path),
            transitions.version,
            transitions.task_json,
            found,
        )
        return
    with duckdb.connect() as connection:
        connection.register("given", transitions)
        connection.execute("CREATE VIEW transitions AS SELECT *, stamp_ns AS logged_ns FROM given")
        if conditions is None:
            named = connection.sql("SELECT DISTINCT unnest(conditions) FROM transitions").fetchall()
            known = shipped()
            conditions = [
                known.get(name) or Condition(name, "post", "false") for (name,) in sorted(named)
            ]

        def task_json(task_hash: str) -> str:
            if task is None:
                return ""
            if task.hash != task_hash:
                raise StoreError(f"its rows are of task {task_hash}, the task given is {task.hash}")
            return msgspec.json.encode(task).decode()

        yield Source(connection, "table in memory", -1, task_json, tuple(conditions))


def build_panel(
    transitions: pa.Table | Store,
    mixture: Mixture,
    out: str | Path,
    *,
    task: Task | None = None,
    conditions: Sequence[Condition] | None = None,
    force: bool = False,
    advance: Callable[[int], None] = lambda rows: None,
) -> Panel:
    """Plan, pack and open a panel.

    Args:
        transitions: a store, or a table with the columns of `ingest.schema.transition_schema`.
        mixture: what to take, in which shares.
        out: the panel's directory, which must not exist yet.
        task: for a table, the task its rows were made by.
        conditions: for a table, the conditions that labelled it.
        force: replace a panel that is already at `out`.
        advance: called with the number of source rows read, as packing goes on.

    Raises:
        ConfigError, MixtureError, StoreError: see `plan_panel`.
        PanelError: `out` is there already.
    """
    with open_source(transitions, task=task, conditions=conditions) as source:
        plan = plan_panel(source.connection, mixture, source.conditions)
        return write_panel(source, plan, out, force=force, advance=advance)


def write_panel(
    source: Source,
    plan: Plan,
    out: str | Path,
    *,
    force: bool = False,
    advance: Callable[[int], None] = lambda rows: None,
) -> Panel:
    """Pack a plan's rows into `out`; an interruption leaves nothing there.

    Raises PanelError when something is at `out` that may not be replaced.
    """
    out = Path(out)
    if out.exists() and not (force and (out / HEADER).is_file()):
        raise PanelError(
            "already there",
            where=str(out),
            remedy="choose another --out"
            + ("; --force replaces a panel" if (out / HEADER).is_file() else ""),
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(f".{out.name}.{os.getpid()}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    try:
        observation_size = _pack(source.connection, plan, partial / ROWS, advance)
        pq.write_table(_meta(plan), partial / META, compression="zstd")
        held = plan.rows.filter(pa.array(plan.held_out))
        pq.write_table(
            held.select(["transition_id", "recording_id", "episode_id", "step_index", "condition"]),
            partial / HELD_OUT,
            compression="zstd",
        )
        header = _header(source, plan, observation_size, partial)
        (partial / HEADER).write_bytes(msgspec.json.format(msgspec.json.encode(header), indent=1))
        if out.exists():
            shutil.rmtree(out)
        partial.rename(out)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return Panel.open(out)


def _pack(
    connection: duckdb.DuckDBPyConnection, plan: Plan, path: Path, advance: Callable[[int], None]
) -> int:
    """Write the packed rows; returns the observation size. Memory: one batch of observations."""
    chosen = plan.panel_rows
    ids = plan.rows["transition_id"].to_numpy()
    wanted = ids[chosen]
    # The row whose next observation is the one n steps after: last step of each row's return.
    last = chosen + plan.horizon[chosen] - 1
    last_ids = ids[last]
    by_id, by_last = np.argsort(wanted), np.argsort(last_ids, kind="stable")
    sorted_ids, sorted_last = wanted[by_id], last_ids[by_last]
    needed = np.union1d(wanted, last_ids)
    of_task = f"FROM transitions WHERE task_hash = '{plan.task_hash}'"
    first = connection.sql(f"SELECT len(observation) {of_task} LIMIT 1").fetchall()
    size = int(first[0][0])
    query = f"SELECT transition_id, observation, next_observation {of_task}"
    rows = np.memmap(path, np.dtype("<f4"), "w+", shape=(len(chosen), row_width(size)))
    part = row_columns(size)
    for batch in connection.sql(query).to_arrow_reader(BATCH_ROWS):
        batch_ids = batch.column("transition_id").to_numpy()
        for name, ordered, places in (
            ("observation", sorted_ids, by_id),
            ("next_observation", sorted_last, by_last),
        ):
            values = _matrix(batch.column(name), size)
            source_row, target = _matches(batch_ids, ordered, places)
            rows[target, part[name]] = values[source_row]
        advance(len(batch_ids))
    if not np.isin(needed, ids).all():
        raise PanelError("the source changed while it was read", where=str(path))
    reward = plan.rows["reward"].to_numpy()
    discount = plan.mixture.discount
    rows[:, part["action"]] = plan.rows["action"].to_numpy()[chosen][:, None]
    rows[:, part["reward"]] = n_step_return(reward, plan.horizon, discount)[chosen][:, None]
    going_on = ~plan.rows["terminated"].to_numpy()[last]
    rows[:, part["discount"]] = (discount ** plan.horizon[chosen] * going_on)[:, None]
    rows.flush()
    return size


def _matches(ids: Ints, ordered: Ints, places: Ints) -> tuple[Ints, Ints]:
    """Of a batch's ids: (row of the batch, place in the panel) for every panel row that asks.

    `ordered` are the ids the panel's rows ask for, sorted (they may repeat); `places` their rows.
    """
    order = np.argsort(ids)
    sorted_ids = ids[order]
    low = int(np.searchsorted(ordered, sorted_ids[0], "left"))
    high = int(np.searchsorted(ordered, sorted_ids[-1], "right"))
    asked = ordered[low:high]
    at = np.searchsorted(sorted_ids, asked)
    found = sorted_ids[np.minimum(at, len(sorted_ids) - 1)] == asked
    return order[at[found]], places[low:high][found]


def _matrix(column: pa.Array, size: int) -> NDArray[np.float32]:
    """A list column (n lists of `size` floats) as (n, size)."""
    flat = column.flatten().to_numpy(zero_copy_only=False)
    if flat.size != len(column) * size:
        raise PanelError(f"observations are not all of {size} entries; `restock audit` names them")
    matrix: NDArray[np.float32] = flat.reshape(len(column), size)
    return matrix


def _meta(plan: Plan) -> pa.Table:
    chosen = plan.panel_rows
    code = plan.stratum[chosen]
    names = pa.array([line.stratum for line in plan.strata], pa.string())
    meta = plan.rows.take(pa.array(chosen))
    meta = meta.append_column(
        "stratum", pa.DictionaryArray.from_arrays(pa.array(code.astype(np.int32)), names)
    )
    meta = meta.append_column("stratum_code", pa.array(code))
    meta = meta.append_column("horizon", pa.array(plan.horizon[chosen].astype(np.int16)))
    return meta.append_column("weight", pa.array(plan.weight))


def panel_id(source_version: int, plan: Plan) -> str:
    """What names a panel: store version, mixture, task, rows, strata, weights, packing code."""
    chosen = plan.panel_rows
    digest = hashlib.blake2b(digest_size=8)
    digest.update(
        msgspec.json.encode([PACKING_VERSION, source_version, plan.mixture, plan.task_hash])
    )
    for array in (
        plan.rows["transition_id"].to_numpy()[chosen],
        plan.stratum[chosen],
        plan.horizon[chosen],
        plan.weight,
    ):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _header(source: Source, plan: Plan, observation_size: int, partial: Path) -> Header:
    by_priority = sorted(source.conditions, key=lambda c: (c.priority, c.name))
    return Header(
        id=panel_id(source.version, plan),
        store=source.name,
        store_version=source.version,
        task_hash=plan.task_hash,
        task_json=source.task_json(plan.task_hash),
        labels_version=labels_version(source.conditions),
        observation_size=observation_size,
        rows=len(plan.panel_rows),
        discount=plan.mixture.discount,
        n_step=plan.mixture.n_step,
        packing_version=PACKING_VERSION,
        restock_version=__version__,
        newest_ns=plan.newest_ns,
        logs_share=plan.logs_share,
        conditions=[*(c.name for c in by_priority), NOMINAL],
        left_out=plan.left_out,
        effective_rows=plan.effective_rows,
        strata=[
            Stratum(name=line.stratum, **{k: v for k, v in asdict(line).items() if k != "stratum"})
            for line in plan.strata
        ],
        mixture=plan.mixture,
        files={
            name: FileRecord((partial / name).stat().st_size, checksum(partial / name))
            for name in (ROWS, META, HELD_OUT)
        },
    )
