"""Select the rows to export: those of a query to a store, or those of a panel."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import duckdb
import msgspec
import numpy as np
import pyarrow as pa

from restock import __version__
from restock.arrays import F64
from restock.errors import PanelError, QueryError, StoreError
from restock.ingest.task.task import Task
from restock.replay.export.images import chosen_cameras
from restock.replay.export.trajectory import (
    CARRIED,
    COMMAND,
    REQUIRED,
    STATE,
    missing_columns,
)
from restock.replay.panel.panel import HEADER, Panel
from restock.replay.places import open_place
from restock.replay.store.parquet_views import literal
from restock.replay.store.query import fetch, interruptible
from restock.replay.store.query import query as run_query
from restock.replay.store.store import Store

BATCH_ROWS = 16_384
EVERYTHING = "FROM transitions"
OF_PANEL = "FROM transitions SEMI JOIN panel.rows USING (transition_id)"


@dataclass(frozen=True)
class Selection:
    """Rows to export, sorted by episode and step."""

    where: str
    batches: Iterator[pa.RecordBatch]
    task: Task
    continuous: bool
    command_range: tuple[F64, F64]  # lowest and highest speed and yaw rate of the actions, (2,)
    provenance: dict[str, Any]  # where the rows are from, as JSON values
    store: Store  # the store of the rows
    cameras: tuple[str, ...] = ()  # exported cameras; every row has a frame of each
    left_out: Mapping[str, int] = field(default_factory=dict)  # reason -> number of rows
    by_name: bool = False  # the query defines STATE, which replaces the task's observation

    @property
    def observation_size(self) -> int:
        return self.task.observation_size


@contextmanager
def open_selection(
    path: str | Path,
    *,
    query: str | None = None,
    panel: str | Path | None = None,
    continuous: bool = False,
    cameras: Sequence[str] | None = (),
) -> Iterator[Selection]:
    """Open the rows of a query to a store, or the rows of a panel in its store.

    Args:
        path: a store (`store@12` for a version), or a panel.
        query: SQL over the store's views that returns whole transitions; default: all.
        panel: a panel whose tables the query may use: `panel.rows`, `panel.strata`.
        continuous: export the logged command as action, not the index of the nearest action.
        cameras: leave out rows without a frame of each of these cameras; None: all cameras.

    Raises:
        StoreError, PanelError: no store or panel, rows of several tasks, no rows, unknown camera.
        QueryError: the query does not run or lacks columns.
    """
    if (Path(path) / HEADER).is_file():
        header = Panel.open(path).header
        if query is not None or panel is not None or header.others or header.store_version < 0:
            raise PanelError(
                "without a store, only a panel of one store can be exported, and without a query",
                where=str(path),
                remedy=f'give a store first: restock export STORE PANEL --query "{OF_PANEL}"',
            )
        panel, query = path, OF_PANEL
        path = f"{header.store}@{header.store_version}"
    text = (query or EVERYTHING).strip().rstrip(";")
    beside: Mapping[str, str | Path] = {"panel": panel} if panel is not None else {}
    with (
        Store(path) as store,
        open_place(path, beside=beside, only_store=True) as connection,
    ):
        store.verify()
        chosen = chosen_cameras(store, cameras)
        yield _select(store, connection, text, panel, continuous, chosen)


_SIZES = ("tinyint", "smallint", "integer", "bigint", "hugeint")
_INTEGERS = frozenset(sign + size for sign in ("", "u") for size in _SIZES)
_NUMBERS = _INTEGERS | {"float", "double", "decimal"}
_LISTS = ("observation", "next_observation")
# Column -> allowed DuckDB types of its values or list items, and their name in error messages.
_TYPES: dict[str, tuple[Collection[str], str]] = {
    **dict.fromkeys(("action", "step_index"), (_INTEGERS, "an integer")),
    **dict.fromkeys(("reward", *COMMAND), (_NUMBERS, "a number")),
    **dict.fromkeys(("terminated", "truncated"), ({"boolean"}, "true or false")),
    **dict.fromkeys(_LISTS, (_NUMBERS, "a list of numbers")),
}


def _select(
    store: Store,
    connection: duckdb.DuckDBPyConnection,
    text: str,
    panel: str | Path | None,
    continuous: bool,
    cameras: Sequence[str],
) -> Selection:
    where = str(store.path)
    result = run_query(connection, text, where=where)
    columns = result.columns
    if missing := missing_columns(columns, continuous=continuous):
        raise QueryError(
            f"the query gives no {', '.join(missing)}",
            where=where,
            remedy="select whole transitions, as `FROM transitions WHERE …` does; an export needs "
            + ", ".join((*REQUIRED, *COMMAND) if continuous else REQUIRED),
        )
    for name, kind in zip(columns, result.types, strict=True):
        if name in _TYPES:
            types, words = _TYPES[name]
            listed = kind.id in ("list", "array")
            items: Any = kind.children[0][1] if listed else kind
            if items.id not in types or listed != (name in _LISTS):
                raise QueryError(f"its {name} is a {kind}, not {words}", where=where)
    requested, left_out = text, dict[str, int]()
    state = _state_sql(columns, result.types, where)
    if state:
        known = " AND ".join(f"coalesce(isfinite({value}), false)" for value in state.values())
        having = f"FROM ({text}) WHERE {known}"
        left_out[f"{STATE} is not known"] = _count_lost(connection, text, having, where)
        text = having
    for camera in cameras:
        text, left_out[f"no frame of camera {camera}"] = _with_frames(
            connection, text, columns, camera, where
        )
    acted = COMMAND if continuous else ("action",)
    extremes = ", ".join(f"min({name}), max({name})" for name in acted)
    hashes, recordings = (
        f"list(DISTINCT {name})" if name in columns else "NULL"
        for name in ("task_hash", "recording_id")
    )
    _, rows, _ = fetch(
        connection,
        f"SELECT count(*), {hashes}, {recordings}, {extremes} FROM ({text})",
        where=where,
    )
    facts = rows[0]
    if not facts[0]:
        raise StoreError("the query gives no rows", where=where, remedy="nothing was written")
    if facts[1] is not None and len(facts[1]) > 1:
        raise StoreError(
            f"the query gives rows of the tasks {', '.join(sorted(facts[1]))}",
            where=where,
            remedy="add WHERE task_hash = '…'",
        )
    task = store.task(facts[1][0] if facts[1] else None)
    if not continuous and any(
        at is not None and not 0 <= at < len(task.actions) for at in facts[3:5]
    ):
        raise StoreError(
            f"its actions go from {facts[3]} to {facts[4]}; its task has actions 0 to"
            f" {len(task.actions) - 1}",
            where=where,
            remedy="export the actions as they are stored",
        )
    # Episodes in the order they were driven if the query has these columns, else by id.
    driven = ["recording_id", "episode_index"]
    order = [*(driven if set(driven) <= set(columns) else []), "episode_id", "step_index"]
    carried = {name: name for name in CARRIED if name in columns}
    if "primary_condition" in columns:
        carried["condition"] = "primary_condition AS condition"
    if state:
        carried[STATE] = f'[{", ".join(state.values())}] AS "{STATE}"'
    wanted = (*REQUIRED, *(COMMAND if continuous else ()), *carried.values())
    relation = run_query(
        connection,
        f"SELECT {', '.join(wanted)} FROM ({text}) ORDER BY {', '.join(order)}",
        where=where,
    )
    table = np.asarray(task.actions)
    low, high = table.min(axis=0), table.max(axis=0)
    if continuous:  # logged commands may exceed the range of the task's actions
        low, high = np.minimum(low, facts[3::2]), np.maximum(high, facts[4::2])
    return Selection(
        where=where,
        batches=_batches(connection, relation, where),
        task=task,
        continuous=continuous,
        command_range=(low, high),
        provenance={
            "store": where,
            "store_version": store.version,
            "query": requested,
            "panel": Panel.open(panel).id if panel is not None else None,
            "tags": _tags(store, facts[2] or []),
            **({"cameras": list(cameras)} if cameras else {}),
            **_describe_task(task, continuous),
            **({"observation_names": list(state)} if state else {}),
        },
        by_name=bool(state),
        store=store,
        cameras=tuple(cameras),
        left_out={why: count for why, count in left_out.items() if count},
    )


def _with_frames(
    connection: duckdb.DuckDBPyConnection,
    text: str,
    columns: Sequence[str],
    camera: str,
    where: str,
) -> tuple[str, int]:
    """Return the query restricted to rows with a frame of this camera, and the rows left out."""
    if "transition_id" not in columns:
        raise QueryError(
            "the query gives no transition_id, by which frames are found",
            where=where,
            remedy="select it too, or give --cameras none",
        )
    having = (
        f"FROM ({text}) WHERE transition_id IN"
        f" (SELECT transition_id FROM transition_frames WHERE camera = {literal(camera)})"
    )
    fewer = _count_lost(connection, text, having, where, f"a frame of camera {camera!r}")
    return having, fewer


def _count_lost(
    connection: duckdb.DuckDBPyConnection, text: str, having: str, where: str, what: str = STATE
) -> int:
    """Count the rows of query `text` that query `having` lacks; raise StoreError if that is all."""
    counts = [
        fetch(connection, f"SELECT count(*) FROM ({one})", where=where)[1][0][0]
        for one in (text, having)
    ]
    if counts[0] and not counts[1]:
        raise StoreError(
            f"none of the {counts[0]:,} rows has {what}",
            where=where,
            remedy="name the other cameras with --cameras, or none"
            if what != STATE
            else "choose signals that the store has: their values are all null",
        )
    return int(counts[0] - counts[1])


def _state_sql(columns: Sequence[str], types: Sequence[Any], where: str) -> dict[str, str]:
    """Return name -> SQL for each number in the query's column `observation.state`, or {}.

    Raises:
        QueryError: the column is not a struct of numbers.
    """
    if STATE not in columns:
        return {}
    kind = types[list(columns).index(STATE)]
    inner = dict(kind.children) if kind.id == "struct" else {}
    if not inner or not all(one.id in _NUMBERS for one in inner.values()):
        raise QueryError(
            f"its {STATE} is a {kind}, not numbers by name",
            where=where,
            remedy=f"""SELECT *, {{'x.vel': wheel_speed_mps}} AS "{STATE}" FROM transitions""",
        )
    names = {name: name.replace('"', '""') for name in inner}
    return {name: f'CAST("{STATE}"."{quoted}" AS DOUBLE)' for name, quoted in names.items()}


def _tags(store: Store, recordings: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return recording id -> tags; recordings without tags are left out."""
    rows = store.connection.execute(
        "SELECT recording_id, tags FROM recordings WHERE recording_id IN (SELECT unnest(?))"
        " AND cardinality(tags) > 0 ORDER BY recording_id",
        [list(recordings)],
    ).fetchall()
    return dict(rows)


def _batches(
    connection: duckdb.DuckDBPyConnection, relation: duckdb.DuckDBPyRelation, where: str
) -> Iterator[pa.RecordBatch]:
    """Yield a query's rows in batches; Ctrl-C stops it.

    Raises QueryError if the query fails while it runs.
    """
    try:
        reader = interruptible(connection, lambda: relation.to_arrow_reader(BATCH_ROWS))
        while (batch := interruptible(connection, lambda: next(reader, None))) is not None:
            yield batch
    except (duckdb.Error, pa.ArrowException, OSError) as error:
        raise QueryError(str(error).splitlines()[0], where=where) from error


def _describe_task(task: Task, continuous: bool) -> dict[str, Any]:
    return {
        "task_hash": task.hash,
        "task": msgspec.to_builtins(task),
        "observation_names": task.observation_names,
        "action": "command (m/s, rad/s)" if continuous else "index into task.actions",
        "action_names": list(COMMAND) if continuous else task.action_names,
        "restock_version": __version__,
    }
