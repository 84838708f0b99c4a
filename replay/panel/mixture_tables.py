"""`mixture(name)` and `mixture_rows(name)`: plans as table macros in a store's SQL.

Plans are computed in Python, so the macros call Python functions. These open the same version of
the store again, because a running query cannot use its own connection.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import duckdb
import pyarrow as pa
from duckdb.func import PythonUDFType

from restock.replay.store.store import Store

if TYPE_CHECKING:
    from restock.replay.plan.plan import PanelPlan

# Columns of `FROM mixture(name)` -> types: fields of `Stratum`, two of them named as in runs.
STRATA = {
    "stratum": "VARCHAR",
    "source": "VARCHAR",
    "rows": "BIGINT",
    "episodes": "BIGINT",
    "natural_share": "DOUBLE",
    "wanted_share": "DOUBLE",
    "drawn_share": "DOUBLE",
    "effective_share": "DOUBLE",
    "replays_per_row": "DOUBLE",
    "missing_rows": "BIGINT",
    "correction": "VARCHAR",
    "timing": "VARCHAR",
    "note": "VARCHAR",
}
ROWS = {
    "transition_id": "BIGINT",
    "recording_id": "VARCHAR",
    "episode_id": "VARCHAR",
    "step_index": "INTEGER",
    "source": "VARCHAR",
    "stratum": "VARCHAR",
    "weight": "FLOAT",
}
_ARROW = {
    "VARCHAR": pa.string(),
    "BIGINT": pa.int64(),
    "INTEGER": pa.int32(),
    "DOUBLE": pa.float64(),
    "FLOAT": pa.float32(),
}
T = TypeVar("T")
_RENAMED = {"stratum": "name", "drawn_share": "share"}  # column -> field of `Stratum`


def install_mixtures(store: Store) -> None:
    """Create the macros `mixture(name)` and `mixture_rows(name)` in a store's connection."""
    tables = {"planned_strata": (STRATA, strata_table), "planned_rows": (ROWS, rows_table)}
    script = files("restock.replay.panel") / "mixture_tables.sql"
    install_planned(store, tables, script, _plan)


def _plan(own: Store, name: str) -> PanelPlan:
    from restock.replay.mixture.mixture import load_mixture
    from restock.replay.panel.build import open_source

    mixture = load_mixture(name)
    with open_source(own, mixture, folder=Path(name).parent) as source:
        return source.plan(mixture)


def install_planned(
    store: Store,
    tables: Mapping[str, tuple[dict[str, str], Callable[[T], pa.Table]]],
    script: Traversable,
    plan: Callable[[Store, str], T],
) -> None:
    """Create table macros in a store's connection that return rows of a plan, made in Python.

    Args:
        tables: name of a SQL function -> its columns, and a function from a plan to its table.
        script: the SQL that creates the macros, which call the functions of `tables`.
        plan: plans a mixture; its arguments are another `Store` of the same version, and the name.
    """
    limit = store.bare.sql("SELECT current_setting('memory_limit')").fetchall()[0][0]
    path, version = store.path, store.version

    @functools.lru_cache(maxsize=1)
    def planned(name: str, _changed_ns: int) -> T:
        with Store(path, version=version, memory_limit=limit) as own:
            return plan(own, name)

    for function, (columns, table_of) in tables.items():
        _install_function(store.bare, function, columns, table_of, planned)
    store.bare.execute(script.read_text(encoding="utf-8"))


def _install_function(
    connection: duckdb.DuckDBPyConnection,
    function: str,
    columns: dict[str, str],
    table_of: Callable[[T], pa.Table],
    planned: Callable[[str, int], T],
) -> None:
    """Install a SQL function that maps mixture names to lists of structs, one struct per row.

    `planned` gets a name and the modification time of its file in ns (0 for a shipped mixture).
    """
    schema = pa.schema([(name, _ARROW[kind]) for name, kind in columns.items()])

    def lists(names: pa.Array) -> pa.Array:
        tables = [
            table_of(planned(name, _changed_ns(name))).select(columns).cast(schema)
            for name in names.to_pylist()
        ]
        ends = [0]
        for table in tables:
            ends.append(ends[-1] + len(table))
        rows = pa.concat_tables([schema.empty_table(), *tables]).combine_chunks()
        structs = pa.StructArray.from_arrays(
            [column.combine_chunks() for column in rows.columns], fields=list(schema)
        )
        return pa.ListArray.from_arrays(pa.array(ends, pa.int32()), structs)

    fields = ", ".join(f'"{name}" {kind}' for name, kind in columns.items())
    # Declare side effects: otherwise DuckDB's optimiser may replace the call by a constant.
    connection.create_function(
        function,
        lists,
        ["VARCHAR"],
        f"STRUCT({fields})[]",
        type=PythonUDFType.ARROW,
        side_effects=True,
    )


def _changed_ns(name: str) -> int:
    """Return when a mixture's file was modified (ns): a changed file must be planned again."""
    path = Path(name)
    return path.stat().st_mtime_ns if path.is_file() else 0


def strata_table(plan: PanelPlan) -> pa.Table:
    """Return the strata of a plan, with columns STRATA."""
    return pa.table(
        {name: [getattr(line, _RENAMED.get(name, name)) for line in plan.strata] for name in STRATA}
    )


def rows_table(plan: PanelPlan) -> pa.Table:
    """Return the rows that a plan packs, in order, with columns ROWS."""
    rows = plan.rows.take(pa.array(plan.panel_rows))
    code = pa.array(plan.stratum[plan.panel_rows])
    return pa.table(
        {
            **{name: rows[name] for name in ROWS if name in rows.column_names},
            "source": pa.array([line.source for line in plan.strata]).take(code),
            "stratum": pa.array([line.name for line in plan.strata]).take(code),
            "weight": pa.array(plan.weight),
        }
    )
