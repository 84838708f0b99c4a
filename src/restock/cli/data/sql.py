"""`restock sql`: queries a store, a run, a panel or recordings."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from restock.cli import output
from restock.cli.words import Option, Positional
from restock.errors import ExitCode, QueryError, StoreError
from restock.process import went_on_after_interrupt

if TYPE_CHECKING:
    import duckdb

SHOWN_ROWS = 40  # rows shown on a terminal; files and pipes get all rows
CUT_TO = 4  # a record on a terminal shows this many values of a list of more than twice as many
RECORDS = r"\G"  # ends a query instead of a semicolon, as in MySQL
HELP = r"""End a query with ";", or with "\G" to see each row as a record.
  .tables          the tables and views
  FROM columns;    their columns, with meanings
  Ctrl-C stops a query; Ctrl-D or .quit ends."""
_TABLES = 'SELECT "view", count(*) AS columns FROM columns GROUP BY ALL ORDER BY ALL'


@dataclass
class SqlCommand:
    """Query a store, a run directory, a panel or recordings, in DuckDB's SQL.

    A store has the views transitions, recordings, episodes, coverage, coverage_by_condition,
    missing_cells, reward_mix, ages, label_overlap, versions, conditions, actions, drops, topics,
    label_scores, drift and signal_weeks; `restock sql STORE "FROM columns"` lists every column
    with its meaning. A run has its tables (progress, strata, ages, audit, …) and the view
    replay_audit; a panel has `rows`, `strata` and `evaluation_split`. A recording, or a folder of
    them, has a table for each topic, and `topics` lists them; only what a query names is decoded.
    A terminal shows the first 40 rows, and the columns that fit; a query that ends with \\G shows
    each row as a record. A file or a pipe gets everything. Queries are read-only, and Ctrl-C stops
    a query. Without a query, a prompt opens. The exit code is 3 if recordings have lost messages.
    """

    path: Annotated[str, Positional("PATH")]
    """A store, a run directory, a panel, a recording, or a folder of recordings."""
    second: Annotated[str | None, Positional("PANEL")] = None
    """Beside a store: a panel or a run whose tables the query can also use, as panel.rows,
    run.audit, …"""
    third: Annotated[str | None, Positional("RUN")] = None
    """Beside a store: the other of panel and run; either may come first."""
    query: Annotated[str | None, Positional("QUERY")] = None
    """The query, or - to read it from stdin. Default: open a prompt."""
    json: bool = False
    """Print a list of row objects."""
    csv: bool = False
    """Print CSV with a header."""
    export: Annotated[Path | None, Option("FILE")] = None
    """Write the rows of the query to a .parquet, .csv or .json file. Without a query, write a
    store's views for use in any DuckDB: an init file (.sql) or a database (.duckdb)."""

    def run(self) -> int:
        """Run the query and print or write its rows."""
        from restock.replay.places import beside_of, open_place

        place, others, query = self._places()
        if self.json + self.csv + (self.export is not None) > 1:
            raise QueryError("--json, --csv and --export cannot be combined", remedy="choose one")
        if self.export is not None and (query is None or self.export.suffix in (".sql", ".duckdb")):
            if query is not None or others:
                raise QueryError(
                    "--export writes a store's views, and runs no query",
                    remedy="leave out one, or name a .parquet, .csv or .json file for its rows",
                )
            self._export(place, self.export)
            return ExitCode.OK
        losses: list[str] = []
        with open_place(
            place,
            beside=beside_of(others),
            opened=output.say_unverified,
            lost=losses.append,
        ) as connection:
            if query is None and sys.stdin.isatty():
                self._prompt(connection)
            else:
                text = sys.stdin.read() if query in (None, "-") else query
                self._run_query(connection, text or "", alone=True)
        for loss in losses:
            sys.stderr.write(f"lost: {loss}\n")
        return ExitCode.LOSSY if losses else ExitCode.OK

    def _run_query(
        self, connection: duckdb.DuckDBPyConnection, text: str, *, alone: bool = False
    ) -> None:
        from restock.replay.store.query import fetch

        text = text.rstrip()
        records, text = text.endswith(RECORDS), text.removesuffix(RECORDS)
        if self.export is not None:
            self._write(connection, text, self.export)
            return
        terminal = sys.stdout.isatty() and not (self.json or self.csv)
        columns, values, count = fetch(
            connection,
            text,
            where=self.path,
            at_most=SHOWN_ROWS if terminal else None,
            alone=alone,
        )
        rows = [dict(zip(columns, row, strict=True)) for row in values]
        hidden = 0
        if self.json:
            output.print_json(rows)
        elif self.csv:
            output.print_csv(rows, columns)
        elif records:
            output.print_records(
                [_shorten_lists(row) for row in rows] if terminal else rows, columns
            )
        elif terminal:
            hidden = output.print_elided(rows, columns)
        else:
            output.print_plain(rows, columns, values=True)
        if count > len(rows):
            output.say(f"{count:,} rows, {len(rows)} shown; a file or a pipe gets all of them")
        if hidden:
            output.say(
                f"{len(columns)} columns, {len(columns) - hidden} shown: end the query with"
                f" {RECORDS} to see all, or name those you want"
            )

    def _write(self, connection: duckdb.DuckDBPyConnection, text: str, out: Path) -> None:
        """Write the rows of a query to a file, in the format that its ending names."""
        from restock.files import expect_file_place, temporary_name
        from restock.replay.store.query import fetch, write_parquet

        expect_file_place(out, "--export")
        if out.suffix not in (".parquet", ".csv", ".json"):
            raise QueryError(
                f"rows are not written to {out.suffix or 'a file without an ending'}",
                where=str(out),
                remedy="name it .parquet, .csv or .json",
            )
        if out.exists():
            raise QueryError("already there", where=str(out), remedy="choose another name")
        temporary = temporary_name(out)
        try:
            if out.suffix == ".parquet":
                write_parquet(connection, text, temporary, where=self.path)
            else:
                columns, values, _ = fetch(connection, text, where=self.path, alone=True)
                rows = [dict(zip(columns, row, strict=True)) for row in values]
                with temporary.open("w", encoding="utf-8", newline="") as file:
                    if out.suffix == ".csv":
                        output.print_csv(rows, columns, file)
                    else:
                        output.print_json(rows, file)
            temporary.replace(out)
        finally:
            temporary.unlink(missing_ok=True)

    def _prompt(self, connection: duckdb.DuckDBPyConnection) -> None:
        """Answer queries one after the other: a semicolon ends each, Ctrl-D ends the prompt."""
        with contextlib.suppress(ImportError):
            import readline  # noqa: F401  (gives the prompt arrow keys and a history)
        output.say('End a query with ";". help lists what else there is. Ctrl-D to quit.')
        text = ""
        while True:
            try:
                text += input("restock> " if not text else "      -> ") + "\n"
                word = text.strip().rstrip(";").lower()
                if word in (".help", "help", ".quit", "quit", ".exit", "exit", ".tables"):
                    text = ""
                    if word in (".help", "help"):
                        output.say(HELP)
                    elif word == ".tables":
                        self._run_query(connection, _TABLES)
                    else:
                        return
                if text.strip().endswith((";", RECORDS)):
                    ended_query, text = text, ""
                    self._run_query(connection, ended_query)
            except EOFError:
                return
            except KeyboardInterrupt:  # ends this query, not the prompt
                went_on_after_interrupt()
                text = ""
                output.say("stopped")
            except (QueryError, StoreError) as error:
                sys.stderr.write(f"{error}\n")

    def _places(self) -> tuple[str, tuple[str, ...], str | None]:
        """Return the first place, the panel and run to query with it, and the query.

        The last word is the query if it is not the path of a panel or a run.
        """
        from restock.replay.places import kind_beside

        others = [word for word in (self.second, self.third, self.query) if word is not None]
        query = others.pop() if others and kind_beside(others[-1]) is None else None
        return self.path, tuple(others), query

    def _export(self, place: str, out: Path) -> None:
        from restock.files import expect_file_place
        from restock.replay.store.store import Store, export_views

        expect_file_place(out, "--export")
        with Store(place) as store:
            export_views(store, out)
            output.say(f"views of {store.path}, version {store.version} -> {out}")


def _shorten_lists(row: dict[str, Any]) -> dict[str, Any]:
    """Cut the long lists of a row that is printed as a record on a terminal."""
    return {
        name: [*value[:CUT_TO], f"… {len(value):,} in all"]
        if isinstance(value, list | tuple) and len(value) > 2 * CUT_TO
        else value
        for name, value in row.items()
    }
