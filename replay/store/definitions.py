"""Create the views and macros that a query over a store needs.

DuckDB binds a macro with all its parts when it is created, so creating all macros takes longer than
most queries over a small store. A store's connection therefore gets only the views and macros that
a query names, and those that they name in turn. Its views are bound when a query uses them.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, partial
from importlib.resources import files
from typing import Protocol
from weakref import WeakKeyDictionary, ref

import duckdb
import pyarrow as pa

from restock.ingest.store.summary import with_included
from restock.ingest.task.schema import COLUMNS, FRAME_COLUMNS, RECORDING_COLUMNS
from restock.process import was_interrupted
from restock.replay.store.same_drives import install_same_drives

HELD_CONDITIONS = "held_conditions"  # view with the columns of `transitions`, and `condition`

# Ending of a column's name -> unit. Longer endings first.
UNITS = (
    ("_mps2", "m/s²"),
    ("_mps", "m/s"),
    ("_radps", "rad/s"),
    ("_radpm", "rad/m"),
    ("_rad", "rad"),
    ("_days", "days"),
    ("_ns", "ns"),
    ("_s", "s"),
    ("_m", "m"),
    ("_share", "1"),
    ("_fraction", "1"),
)


def view_docs() -> dict[str, str]:
    """Return the description of each view, by name, in the order of columns.toml."""
    return {name: table["doc"] for name, table in _read_docs().items() if name != "shared"}


def column_docs() -> dict[tuple[str, str], str]:
    """Return (view, column) -> meaning; for (view, column) without one, see ("shared", column)."""
    meanings = {
        (view, column): text
        for view, table in _read_docs().items()
        for column, text in table.items()
        if column != "doc"
    }
    meanings |= {
        ("transitions", column.name): column.meaning
        for column in COLUMNS
        if column.name != "condition"  # rows.sql renames this column
    }
    meanings |= {("recordings", column.name): column.meaning for column in RECORDING_COLUMNS}
    meanings |= {
        ("frames", column.name): column.meaning for column in FRAME_COLUMNS if column.name != "data"
    }
    return meanings


def unit(column: str) -> str:
    """Return a column's unit from the ending of its name, or ""."""
    return next((unit for ending, unit in UNITS if column.endswith(ending)), "")


def install_columns(connection: duckdb.DuckDBPyConnection) -> None:
    """Create the view `columns`, which lists the views that exist and their columns."""
    docs, own_units = column_docs(), {}
    for name, own_unit, meaning, topic, path in _custom_signals(connection):
        docs["transitions", name] = meaning or f"{path} of {topic}"
        own_units["transitions", name] = own_unit
    for view, column in [key for key in docs if key[0] == "transitions"]:
        docs.setdefault((HELD_CONDITIONS, column), docs[view, column])
        own_units[HELD_CONDITIONS, column] = own_units.get((view, column), "")
    columns = connection.sql(
        "SELECT table_name, column_name, data_type FROM duckdb_columns()"
        " WHERE NOT internal AND table_name NOT LIKE 'stored_%' ORDER BY table_name, column_index"
    ).fetchall()
    order = list(view_docs())
    columns = [(view, column, kind) for view, column, kind in columns if view in order]
    of_columns = [
        ("columns", name, "VARCHAR") for name in ("view", "column_name", "type", "unit", "meaning")
    ]
    rows = [
        {
            "view": view,
            "column_name": column,
            "type": kind,
            "unit": own_units.get((view, column)) or unit(column),
            "meaning": docs.get((view, column)) or docs.get(("shared", column)),
        }
        for view, column, kind in sorted(columns, key=lambda row: order.index(row[0])) + of_columns
    ]
    names = ("view", "column_name", "type", "unit", "meaning")
    schema = pa.schema([pa.field(name, pa.string()) for name in names])
    connection.register("columns", pa.Table.from_pylist(rows, schema=schema))


def _custom_signals(connection: duckdb.DuckDBPyConnection) -> list[tuple[str, ...]]:
    """Return the custom signals of the store's profiles: name, unit, meaning, topic and path."""
    has = connection.sql(
        "SELECT 1 FROM duckdb_columns() WHERE table_name = 'recordings' AND column_name = 'signals'"
    ).fetchall()
    if not has:
        return []
    return connection.sql(
        "SELECT DISTINCT ON (s.name) s.name, s.unit, s.meaning, s.topic, s.path"
        " FROM (SELECT ingested_at, unnest(signals) AS s FROM recordings) ORDER BY ingested_at DESC"
    ).fetchall()


def _read_docs() -> dict[str, dict[str, str]]:
    text = (files("restock.replay.store") / "columns.toml").read_text(encoding="utf-8")
    tables: dict[str, dict[str, str]] = tomllib.loads(text)
    return tables


# In this order: a view may use earlier ones.
VIEWS = ("rows.sql", "views.sql", "labels.sql", "events.sql", "fleet.sql", "exposure.sql")
FRAMES_SQL = "frames.sql"  # reads stored_frames, which exists only on a store's own connection
MACROS = (
    "macros.sql",
    "flawed_rows.sql",
    "recording_conditions.sql",
    "capacity.sql",
    "shared_rows.sql",
    "repeated_rows.sql",
    "corrections.sql",
    "measured_signals.sql",
    "episode_signals.sql",
    "drift.sql",
    "return_order.sql",
    "returns.sql",
)
SUMMARIES = "summaries.sql"  # replaces views of the same names if all manifests have summaries
# Files whose views `Store.connection` always has, for callers that do not use `install_named`.
COMMON = ("rows.sql", "views.sql", "labels.sql", "corrections.sql")
# Views that `rows_held` copies into memory. HELD_OF_MANY: few rows from a scan of many, copied in
# any store if several queries use them. HELD: views that others read, copied in stores of few rows,
# as DuckDB binds tables ten times faster and reads their columns once. HELD_SUMMARIES: copied
# because each recording's summary is a file of 166 columns until manifests are joined.
HELD_OF_MANY = ("driven_episodes",)
HELD_SUMMARIES = ("stored_summaries",)
HELD = (
    "recordings",
    "transitions",
    "episodes",
    "conditions",
    "actions",
    "untold_conditions",
)
FEW_ROWS = 100_000  # most rows of a store for HELD: about 1 kB per row
FEW_SUMMARISED_ROWS = 2_000_000  # most rows of a store for HELD_SUMMARIES: about 50 bytes per row
# Text in rows.sql. `_read_store_sql` makes it read stored_ingests, which saves a scan of rows.
_INGESTS = "ingest_id IN (SELECT ingest_id FROM stored_transitions)"
# A query with one of these words lists views, so that all of them must exist.
LISTS = {
    "columns",
    "information_schema",
    "duckdb_views",
    "duckdb_columns",
    "duckdb_functions",
    "duckdb_tables",
    "pg_catalog",
    "pg_views",
    "show",
    "show_tables",
    "sqlite_master",
}
_BEGINS = re.compile(r"^CREATE OR REPLACE (?:VIEW|MACRO) (\w+)", re.MULTILINE)
_VIEW = re.compile(r"^(CREATE OR REPLACE VIEW \w+) AS\b", re.MULTILINE)


class Definitions:
    """Views and macros of one connection to a store, created when a query names them.

    They read `stored_transitions`, `stored_recordings` and `stored_ingests` (the list of ingests,
    which saves a scan of all rows). They are created on demand as long as this object exists.

    Args:
        connection: the store's connection.
        observation_type: DuckDB type that observations are cast to.
        summaries: whether the common views read `stored_summaries` instead of rows.
        tables: name of a `stored_…` table -> function that creates it when a query needs it.
        replaced: names of views -> function that replaces them by tables when a query names one;
            this takes too long to do when a query only lists views.

    `computed` maps names of tables and macros to the Python functions that compute them. `made` has
    the names of the views and macros created so far.
    """

    def __init__(
        self,
        connection: duckdb.DuckDBPyConnection,
        observation_type: str,
        *,
        summaries: bool = False,
        tables: Mapping[str, Callable[[], None]] | None = None,
        replaced: Mapping[tuple[str, ...], Callable[[], None]] | None = None,
    ) -> None:
        self._tables = dict(tables or {})
        self._connection, self.summaries = connection, summaries
        self._statements = dict(
            _statements(_read_store_sql(observation_type, (*VIEWS, FRAMES_SQL, *MACROS)))
        )
        if summaries:
            self._statements |= _statements(definitions(names=[SUMMARIES]))
        self.computed: dict[tuple[str, ...], Callable[[], None]] = {}
        self._replaced: dict[tuple[str, ...], Callable[[], None]] = dict(replaced or {})
        self._replaced[("same_drives",)] = partial(install_same_drives, connection)
        self.made: set[str] = set()
        self._held: list[str] = []
        _DEFINITIONS[connection] = ref(self)
        make_on_demand(connection, self)

    def make(self, text: str) -> None:
        """Create the views that a query names, or all of them if it lists views."""
        words = set(re.findall(r"\w+", text.lower()))
        if words & LISTS:
            self.make_all()
            return
        self._make(words)
        for makers in (self.computed, self._replaced):
            for names in [names for names in makers if words & set(names)]:
                makers.pop(names)()

    def make_common(self) -> None:
        """Create the common views, COMMON."""
        self._make(_statements(definitions(names=COMMON)))

    def make_all(self) -> None:
        """Create all views and macros, and the view `columns`, which lists their columns."""
        self._make(self._statements)
        for names in list(self.computed):
            self.computed.pop(names)()
        if "columns" not in self.made:
            install_columns(self._connection)
            self.made.add("columns")

    def _make(self, names: Iterable[str]) -> None:
        order: dict[str, None] = {}
        seen: set[str] = set()
        for name in sorted(names):
            self._follow(name, order, seen)
        for table in sorted(seen & self._tables.keys()):
            self._tables.pop(table)()
        missing = [name for name in order if name not in self.made]
        if missing:
            self._connection.execute("\n".join(self._statements[name] for name in missing))
            self.made.update(missing)

    def _follow(self, name: str, order: dict[str, None], seen: set[str]) -> None:
        """Append a view or macro to `order`, after all that its definition names."""
        if name in seen:
            return
        seen.add(name)
        if name not in self._statements:
            return
        for other in sorted(_named_in(self._statements[name])):
            self._follow(other, order, seen)
        order[name] = None

    def hold(self, views: Sequence[str]) -> None:
        """Replace these views by tables of their rows; `release` restores the views."""
        self._make(views)
        for view in views:
            self._connection.execute(
                f"CREATE TABLE held_rows AS FROM {view};"
                f" ALTER VIEW {view} RENAME TO view_of_{view};"
                f" ALTER TABLE held_rows RENAME TO {view}"
            )
            self._held.append(view)

    def release(self) -> None:
        """Drop the tables of `hold`, and give the views their names back."""
        held, self._held = self._held, []
        for view in held:
            self._connection.execute(
                f"DROP TABLE {view}; ALTER VIEW view_of_{view} RENAME TO {view}"
            )


class Maker(Protocol):
    """Creator of a connection's tables and views when a query names them."""

    def make(self, text: str) -> None:
        """Create the tables and views that a query names."""

    def make_all(self) -> None:
        """Create all tables and views."""


# Values are weak, too: a Definitions refers to its connection, and would keep the key alive.
_DEFINITIONS: WeakKeyDictionary[duckdb.DuckDBPyConnection, ref[Definitions]] = WeakKeyDictionary()
_MAKERS: WeakKeyDictionary[duckdb.DuckDBPyConnection, ref[Maker]] = WeakKeyDictionary()


def make_on_demand(connection: duckdb.DuckDBPyConnection, maker: Maker) -> None:
    """Register a maker to see each query of a connection before it runs, while the maker exists."""
    _MAKERS[connection] = ref(maker)


def _maker(connection: duckdb.DuckDBPyConnection) -> Maker | None:
    reference = _MAKERS.get(connection)
    return None if reference is None else reference()


def _definitions_of(connection: duckdb.DuckDBPyConnection) -> Definitions | None:
    reference = _DEFINITIONS.get(connection)
    return None if reference is None else reference()


def install_named(connection: duckdb.DuckDBPyConnection, text: str) -> None:
    """Create the views that a query names, if the connection has a maker (stores, recordings)."""
    if (maker := _maker(connection)) is not None:
        maker.make(text)


@contextmanager
def rows_held(connection: duckdb.DuckDBPyConnection, texts: Sequence[str]) -> Iterator[None]:
    """Copy views that queries often read into tables in memory, which replace them in the block."""
    owner = _definitions_of(connection)
    if owner is None:
        yield
        return
    named = [view for view in HELD_OF_MANY if sum(view in text for text in texts) > 1]
    try:
        try:
            owner.hold([*_views_to_hold(connection, owner), *named])
        except duckdb.Error:  # unreadable rows are reported by the queries that need them
            owner.release()
            if was_interrupted():
                raise
        yield
    finally:
        owner.release()


def _views_to_hold(connection: duckdb.DuckDBPyConnection, owner: Definitions) -> list[str]:
    rows = stored_rows(connection)
    return [
        *(HELD_SUMMARIES if owner.summaries and rows <= FEW_SUMMARISED_ROWS else ()),
        *(HELD if 0 < rows <= FEW_ROWS else ()),
    ]


def stored_rows(connection: duckdb.DuckDBPyConnection) -> int:
    """Return the number of transitions in a store's files."""
    return connection.execute('SELECT sum("rows") FROM stored_ingests').fetchall()[0][0] or 0


def is_empty(connection: duckdb.DuckDBPyConnection) -> bool:
    """Return whether a connection is a store's, and the store has no transitions."""
    return connection in _DEFINITIONS and not stored_rows(connection)


def is_own(connection: duckdb.DuckDBPyConnection, view: str) -> bool:
    """Return whether a name is a store's view, and not one that a query created in its place."""
    owner = _definitions_of(connection)
    if owner is None:
        return False
    if view not in owner.made:  # it will be created when a query names it
        return True
    views = "SELECT 1 FROM duckdb_views() WHERE view_name = $1"
    return bool(connection.execute(views, [view]).fetchall())


def install_all(connection: duckdb.DuckDBPyConnection) -> bool:
    """Create all views; return False if the connection has no maker."""
    maker = _maker(connection)
    if maker is not None:
        maker.make_all()
    return maker is not None


def install_common(connection: duckdb.DuckDBPyConnection, observation_type: str) -> None:
    """Create the views of COMMON in the current schema, which must have a store's tables."""
    connection.execute("\n".join(_statements(_read_store_sql(observation_type, COMMON)).values()))


def definitions(observation_type: str = "FLOAT[]", names: Sequence[str] = (*VIEWS, *MACROS)) -> str:
    """Return the SQL of these files, which casts observations to this type."""
    folder = files("restock.replay.store")
    text = [(folder / name).read_text(encoding="utf-8") for name in names]
    whole = with_included("\n".join(text), folder)
    return whole.replace("::FLOAT[] AS", f"::{observation_type} AS")


def install_repeated_rows(connection: duckdb.DuckDBPyConnection) -> None:
    """Create the macro `repeated_rows` over any `transitions`; a store's macro scans no rows."""
    if connection in _DEFINITIONS:
        install_named(connection, "repeated_rows")
    else:
        connection.execute(definitions(names=["shared_rows.sql", "repeated_rows.sql"]))


def install_novelty(connection: duckdb.DuckDBPyConnection) -> None:
    """Create the table `novelty` for any `transitions`; a store may have a saved copy of it."""
    if connection in _DEFINITIONS:
        install_named(connection, "novelty")
    else:
        from restock.replay.store.novelty import read_novelty  # pyarrow.compute is slow to import

        connection.register("novelty", read_novelty(connection))


def _read_store_sql(observation_type: str, names: Sequence[str]) -> str:
    text = definitions(observation_type, names)
    return text.replace(_INGESTS, _INGESTS.replace("transitions", "ingests"))


def names_created_in(name: str) -> list[str]:
    """Return the names of the views and macros that an SQL file creates."""
    return list(_statements(definitions(names=[name])))


@cache
def _statements(text: str) -> Mapping[str, str]:
    """Return the statement that creates each view and macro of a script, by name."""
    begins = [*_BEGINS.finditer(text)]
    ends = [*(one.start() for one in begins[1:]), len(text)]
    parts = ((one[1], text[one.start() : end]) for one, end in zip(begins, ends, strict=True))
    return {name: _VIEW.sub(r"\1 WITH (DEFER_BINDING) AS", part, count=1) for name, part in parts}


@cache
def _named_in(statement: str) -> frozenset[str]:
    """Return the names that a statement reads, calls, or passes to macros in quotes."""
    sql = re.sub(r"--.*", "", statement)
    found = re.findall(r"\b(?:FROM|JOIN)\s+(\w+)|\b(\w+)\(|'(\w+)'", sql)
    return frozenset(name for names in found for name in names)
