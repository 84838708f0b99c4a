"""Places to query: a store, a run, a panel or recordings, as views of one connection."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from glob import has_magic
from importlib import resources
from pathlib import Path
from typing import Self

import duckdb
import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from restock.errors import RecordingError, RunError, StoreError
from restock.files import read_json, read_table
from restock.ingest.store.location import Location
from restock.replay.store.definitions import definitions, install_named
from restock.replay.store.parquet_views import REMAKE, literal, read_parquet
from restock.replay.store.query import query
from restock.replay.store.store import Store, is_store, set_memory_limit

RUN_CONFIG = "config.json"


@contextmanager
def open_place(
    path: str | Path,
    *,
    beside: Mapping[str, str | Path] | None = None,
    only_store: bool = False,
    opened: Callable[[Store], None] = lambda store: None,
    lost: Callable[[str], None] = lambda loss: None,
    confined: bool = False,
) -> Iterator[duckdb.DuckDBPyConnection]:
    """Yield a connection with the views of a store, a run or a panel, or the topics of recordings.

    Views are created when they are needed: use `query`, or call `install_named` with the SQL first.

    Args:
        path: the place: a folder, or `s3://bucket/prefix` for a store; `store@12` for a version; a
            recording, a folder of recordings, or a glob.
        beside: schema -> path of a run or a panel to add to a store: `{"run": "runs/a"}` gives
            `run.audit`, `{"panel": "panel"}` gives `panel.rows`.
        only_store: accept only a store.
        opened: called with the store before it is queried: `Store.verify` verifies its files.
        lost: called with each loss of recordings: damage, or messages of a topic that was read.
        confined: restrict queries to the files of the place.

    Raises:
        RecordingError: a file is not a recording, or a folder has none that can be opened.
        StoreError: the place cannot be queried, or has no such version; or a place in `beside` is
            not a run or panel, or all its logged rows are of recordings that the store lacks.
    """
    place = Location.of(path)
    if only_store or place.folder is None or is_store(place):
        with Store(place) as store:
            opened(store)
            add_computed_tables(store)
            _add_all(store.bare, beside)
            for schema, path in (beside or {}).items():
                _refuse_of_another_store(store, schema, path)
            if confined:
                _confine(store.bare, place.folder)
            yield store.bare
        return
    place.expect_both_tables()
    path = place.folder
    found = path.exists() or has_magic(str(path))
    if not found:
        raise StoreError("it does not exist", where=str(path), remedy=place.remedy_if_absent())
    if place.version is not None:
        raise StoreError("only a store has versions", where=str(path), remedy="leave out the @")
    with (
        tempfile.TemporaryDirectory(prefix="restock-") as spill,
        duckdb.connect(config={"temp_directory": spill}) as connection,
    ):
        set_memory_limit(connection, where=path)
        topics = None
        if path.is_dir() and _add(connection, path, "main") is not None:
            _list_columns(connection)
        else:
            topics = _topics(connection, path, lost, remedy=place.remedy_if_absent())
        _add_all(connection, beside)
        if confined:
            _confine(connection, None if topics else path)
        yield connection
        del topics  # the object had to exist until here: it creates tables on demand


def _topics(
    connection: duckdb.DuckDBPyConnection, path: Path, lost: Callable[[str], None], *, remedy: str
) -> object:
    """Install the topics of recordings as tables; return the object that creates them."""
    from restock.ingest.containers.open_recording import recordings_in
    from restock.replay.topics import Topics  # imported here as it imports rosbags

    try:
        recordings_in(path)
    except RecordingError as error:
        if not path.is_dir():
            raise
        raise StoreError(
            "it is not a store, a run or a panel, and holds no recording",
            where=str(path),
            remedy=remedy,
        ) from error
    return Topics(connection, path, lost)


# Table of a panel or run -> query that counts its rows by condition.
_COVERAGE = {
    "rows": "SELECT condition, count(*) AS rows FROM rows GROUP BY ALL ORDER BY ALL",
    "replay_audit": "SELECT condition, count(*) AS sampled FROM replay_audit GROUP BY ALL ORDER BY"
    " ALL",
}
_OVERVIEW = {"topics": "FROM topics", "strata": "FROM strata"}  # table -> query for `Place.show`


class Place:
    """A run, a panel or recordings, open for reading. Close it, or use it as a context manager.

    Args:
        path: a run's or a panel's folder; a recording, a folder of recordings, or a glob.

    `lost` lists losses of recordings: damage, and lost messages of topics that were read.

    Raises:
        StoreError: the place cannot be queried.
        RecordingError: see `open_place`.
    """

    def __init__(self, path: str | Path) -> None:
        self.path, self.lost = Path(path), list[str]()
        self._opened = ExitStack()
        place = open_place(path, lost=self.lost.append)
        self._connection = self._opened.enter_context(place)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Place {self.path}>"

    def close(self) -> None:
        """Close the connection and its files."""
        self._opened.close()

    def sql(self, text: str) -> duckdb.DuckDBPyRelation:
        """Return the result of a query: `.to_arrow_table()`, `.df()`, `.pl()`, `.fetchall()`.

        Raises:
            QueryError: the query fails, with DuckDB's message, or it would write.
        """
        return query(self._connection, text, where=str(self.path))

    def coverage(self) -> duckdb.DuckDBPyRelation:
        """Count a panel's packed rows, or a run's audited sampled rows, by condition.

        Raises:
            StoreError: the place has no labels, as with recordings.
        """
        text = self._first(_COVERAGE)
        if text is None:
            raise StoreError(
                "it has no labels of conditions",
                where=str(self.path),
                remedy="`restock ingest RECORDINGS --store STORE` labels them, in a store",
            )
        return self.sql(text)

    def show(self) -> None:
        """Print an overview: the topics of recordings, or the strata of a panel or a run."""
        text = self._first(_OVERVIEW) or "FROM columns"
        self.sql(text).show()

    def _first(self, questions: Mapping[str, str]) -> str | None:
        """Return the first query whose table exists; None if there is none."""
        install_named(self._connection, " ".join(questions))
        found = self._connection.sql("SHOW TABLES").fetchall()
        names = {name for (name,) in found}
        return next((text for table, text in questions.items() if table in names), None)


def _confine(connection: duckdb.DuckDBPyConnection, folder: Path | None) -> None:
    """Allow a connection only the files of a folder (None: no files), and no Python objects."""
    folders = [] if folder is None else [str(folder), str(folder.absolute())]
    listed = ", ".join(map(literal, folders))
    connection.execute(
        f"SET allowed_directories = [{listed}]; SET enable_external_access = false;"
        " SET python_enable_replacements = false; SET enable_progress_bar = false"
    )


def add_computed_tables(store: Store) -> None:
    """Register the tables `mixture(…)`, `mixture_rows(…)` and `gaps(…)`, created when queried."""
    store.add_tables(("mixture", "mixture_rows"), _install_mixtures)
    store.add_tables(("gaps",), _install_gaps)


def _install_mixtures(store: Store) -> None:
    from restock.replay.panel.mixture_tables import install_mixtures  # rarely needed

    install_mixtures(store)


def _install_gaps(store: Store) -> None:
    from restock.replay.fleet.shopping_list import install_gaps

    install_gaps(store)


def beside_of(places: Iterable[str | Path]) -> dict[str, Path]:
    """Return kind ("panel" or "run") -> path of places that are queried together with a store.

    Raises:
        StoreError: a place is neither a panel nor a run, or there are two of a kind.
    """
    found: dict[str, Path] = {}
    for place in map(Path, places):
        kind = kind_beside(place)
        if kind is None or kind in found:
            what = f"is a second {kind}" if kind else "is not a panel or a run"
            raise StoreError(
                what if place.exists() else "does not exist",
                where=str(place),
                remedy="beside a store, give a panel (`restock mix`) and a run (`restock train`)",
            )
        found[kind] = place
    return found


def kind_beside(place: str | Path) -> str | None:
    """Return "panel" or "run" by the files in a folder; None if it is neither."""
    with suppress(OSError, ValueError):  # if `place` is a query, it is no valid path
        for kind, file in (("panel", "panel.json"), ("run", RUN_CONFIG)):
            if (Path(place) / file).is_file():
                return kind
    return None


def _add_all(
    connection: duckdb.DuckDBPyConnection, beside: Mapping[str, str | Path] | None
) -> None:
    for schema, path in (beside or {}).items():
        connection.execute(f'CREATE SCHEMA "{schema}"')
        if _add(connection, Path(path), schema) != schema:
            raise StoreError(f"is not a {schema} with tables", where=str(path))


def _refuse_of_another_store(store: Store, schema: str, path: str | Path) -> None:
    """Raise StoreError if all logged rows of a run or panel are of recordings that the store lacks.

    Ids of recordings depend only on their content, so a store that was moved or copied passes.
    """
    fed = f"""
        FROM information_schema.tables
        SELECT table_name
        WHERE table_schema = '{schema}' AND table_name IN ('rows', 'sampled_episodes')
    """
    for (table,) in store.bare.sql(fed).fetchall():
        recordings = {
            "rows": "recording_id FROM {schema}.rows",
            "sampled_episodes": "split_part(episode, '/', 1) FROM {schema}.sampled_episodes"
            " WHERE source = 'logs'",
        }[table].format(schema=f'"{schema}"')
        ids = {one for (one,) in store.bare.sql(f"SELECT DISTINCT {recordings}").fetchall() if one}
        held = store.bare.sql("SELECT recording_id FROM stored_recordings").fetchall()
        if ids and ids.isdisjoint(one for (one,) in held):
            raise StoreError(
                f"none of its logged rows are of a recording in {store.path}"
                f" version {store.version}: this {schema} was made from another store",
                where=str(path),
                remedy=f"name the store that it was made from, or a {schema} of this store",
            )


def _add(connection: duckdb.DuckDBPyConnection, path: Path, schema: str) -> str | None:
    """Create the views of a run or a panel; return its kind, or None if it is neither."""
    from restock.replay.panel.panel import EVALUATION_SPLIT, HEADER, META, Panel

    if (path / HEADER).is_file():
        panel = Panel.open(path)
        for view, name in (("rows", META), ("evaluation_split", EVALUATION_SPLIT)):
            panel.header.files[name].check(path / name, verify=True)
            read_parquet(connection, view, [path / name], schema=schema)
        strata = pa.Table.from_pylist([msgspec.structs.asdict(s) for s in panel.strata])
        _create_table(connection, schema, "strata", strata)
        return "panel"
    tables = sorted(path.glob("*.parquet"))
    if not tables or not (path / RUN_CONFIG).is_file():
        return None
    files = {file.stem: file for file in tables}
    files |= {f"eval_{file.stem}": file for file in sorted(path.glob("eval/*.parquet"))}
    for view, file in files.items():
        # Verifies page checksums, which DuckDB does not.
        read_table(file, error=StoreError, remedy=REMAKE)
        read_parquet(connection, view, [file], schema=schema)
        for field in pq.read_schema(file):
            if meaning := (field.metadata or {}).get(b"meaning", b"").decode():
                column = f'"{schema}"."{view}"."{field.name}"'
                connection.execute(f"COMMENT ON COLUMN {column} IS {literal(meaning)}")
    if "audit" in files:
        _add_replay_audit(connection, path, schema)
    if "eval_episodes" in files:
        _add_returns(connection, files["eval_episodes"], schema)
    return "run"


def _add_replay_audit(connection: duckdb.DuckDBPyConnection, run: Path, schema: str) -> None:
    """Create the view `replay_audit` of a run, and the table of its actions' names."""
    names = read_json(run / RUN_CONFIG, error=RunError).get("actions", [])
    table = {
        "action": pa.array(range(len(names)), pa.int16()),
        "name": pa.array(names, pa.string()),
    }
    _create_table(connection, schema, "action_names", pa.table(table))
    text = resources.files("restock.replay").joinpath("replay_audit.sql").read_text("utf-8")
    connection.execute(text.replace("{schema}", schema))


def _add_returns(connection: duckdb.DuckDBPyConnection, file: Path, schema: str) -> None:
    """Create the views `driven_episodes` and `returns` if evaluations have discounted returns."""
    if "discounted_return" not in pq.read_schema(file).names:
        return
    connection.execute(definitions(names=("return_order.sql",)))
    text = resources.files("restock.replay.store").joinpath("run_returns.sql").read_text("utf-8")
    connection.execute(text.replace("{schema}", schema))


def _create_table(
    connection: duckdb.DuckDBPyConnection, schema: str, name: str, table: pa.Table
) -> None:
    connection.register("passed_in", table)
    connection.execute(f'CREATE TABLE "{schema}"."{name}" AS FROM passed_in')
    connection.unregister("passed_in")


def _list_columns(connection: duckdb.DuckDBPyConnection) -> None:
    """Create the view `columns` of a run or panel: names, types, and meanings if a run has them."""
    connection.execute(
        'CREATE VIEW columns AS SELECT table_name AS "view", column_name,'
        ' data_type AS "type", comment AS meaning FROM duckdb_columns() WHERE NOT internal'
    )
