"""`restock sql`: any question to a store, a run or a panel."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from restock.errors import QueryError, StoreError
from restock.process import went_on_after_interrupt

if TYPE_CHECKING:
    import duckdb

SHOWN_ROWS = 40  # on a terminal; a file or a pipe gets all
EXPANDED_ROWS = 20  # at most so many rows too wide for the terminal are printed one below the other

CUT_TO = 4  # values of a list that are shown, where it has more than twice as many


@dataclass
class SqlCommand:
    """Query a store, a run directory or a panel, in DuckDB's SQL.

    A store has the views transitions, recordings, episodes, coverage, coverage_by_condition,
    missing_cells, reward_mix, ages, label_overlap, versions, conditions, actions, drops, topics,
    label_scores, drift and signal_weeks; `restock sql STORE "FROM columns"` lists every column
    with its meaning. A run has its tables (progress, strata, ages, audit, …) and the view
    replay_audit; a panel has `rows`, `strata` and `evaluation_split`.
    A terminal shows the first 40 rows and shortens long lists; a file or a pipe gets everything.
    Queries are read-only, and Ctrl-C stops a query. Without a query, a prompt opens.
    """

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """A store, a run directory or a panel."""
    query: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[QUERY]")] = None
    """The query, or - to read it from stdin. Default: open a prompt."""
    run_dir: Annotated[Path | None, tyro.conf.arg(name="run", metavar="RUN")] = None
    """A run whose tables the query can also use, as run.audit, run.strata, …"""
    panel: Annotated[Path | None, tyro.conf.arg(metavar="PANEL")] = None
    """A panel whose tables the query can also use, as panel.rows, panel.strata."""
    json: bool = False
    """Print a list of row objects."""
    csv: bool = False
    """Print CSV with a header."""
    memory_limit: Annotated[str | None, tyro.conf.arg(metavar="SIZE")] = None
    """Memory limit of DuckDB, e.g. 4GB; beyond it, DuckDB spills to a temporary folder."""
    export: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write a store's views for use in any DuckDB: an init file (.sql) or a database (.duckdb)."""

    def run(self) -> None:
        """Run the query and print its rows."""
        from restock.cli import output
        from restock.replay.places import open_place

        if self.json and self.csv:
            raise QueryError("--json and --csv cannot be combined", remedy="choose one")
        if self.export is not None:
            if self.query is not None:
                raise QueryError(
                    "--export writes the views, and runs no query", remedy="leave out one"
                )
            self._export(self.export)
            return
        beside = {"run": self.run_dir, "panel": self.panel}
        given = {name: path for name, path in beside.items() if path is not None}
        with open_place(
            self.path,
            beside=given,
            memory_limit=self.memory_limit,
            opened=output.say_unverified,
        ) as connection:
            if self.query is None and sys.stdin.isatty():
                self._prompt(connection)
            else:
                text = sys.stdin.read() if self.query in (None, "-") else self.query
                self._answer(connection, text or "", alone=True)

    def _answer(
        self, connection: duckdb.DuckDBPyConnection, text: str, *, alone: bool = False
    ) -> None:
        from restock.cli import output
        from restock.replay.store.query import fetch

        terminal = sys.stdout.isatty() and not (self.json or self.csv)
        columns, values, count = fetch(
            connection,
            text,
            where=str(self.path),
            at_most=SHOWN_ROWS if terminal else None,
            alone=alone,
        )
        rows = [dict(zip(columns, row, strict=True)) for row in values]
        if self.json:
            output.print_json(rows)
        elif self.csv:
            output.print_csv(rows, columns)
        elif not terminal and len(rows) > EXPANDED_ROWS:
            output.print_plain(rows, columns)
        else:
            self._show([_cut(row) for row in rows] if terminal else rows, columns)
        if count > len(rows):
            output.say(f"{count:,} rows, {len(rows)} shown; a file or a pipe gets all of them")

    def _show(self, rows: list[dict[str, Any]], columns: list[str]) -> None:
        """Print a table, or the rows one below the other if a table would not fit."""
        from restock.cli import output

        if len(rows) <= EXPANDED_ROWS and output.too_wide(rows, columns):
            for number, row in enumerate(rows, start=1):
                lines = [
                    {"column": name, "value": output.cell(row[name]).replace(r"\[", "[")}
                    for name in columns
                ]
                output.print_table(lines, title=f"row {number}")
        else:
            output.print_table(rows, columns)

    def _prompt(self, connection: duckdb.DuckDBPyConnection) -> None:
        """Answer queries one after the other: a semicolon ends each, Ctrl-D ends the prompt."""
        from restock.cli import output

        with contextlib.suppress(ImportError):
            import readline  # noqa: F401  (gives the prompt a history)
        output.say('End a query with ";". FROM columns; lists all columns. Ctrl-D to quit.')
        text = ""
        while True:
            try:
                text += input("restock> " if not text else "      -> ") + "\n"
                if text.strip().endswith(";"):
                    question, text = text, ""
                    self._answer(connection, question)
            except EOFError:
                return
            except KeyboardInterrupt:  # of this query, not of the prompt
                went_on_after_interrupt()
                text = ""
                output.say("stopped")
            except (QueryError, StoreError) as error:
                sys.stderr.write(f"{error}\n")

    def _export(self, out: Path) -> None:
        from restock.cli import output
        from restock.files import expect_file_place
        from restock.replay.store.export_views import export_views
        from restock.replay.store.store import Store

        expect_file_place(out, "--export")
        with Store(self.path) as store:
            export_views(store, out)
            output.say(f"views of {self.path}, version {store.version} -> {out}")


def _cut(row: dict[str, Any]) -> dict[str, Any]:
    """Cut long lists of a row for a terminal."""
    return {
        name: [*value[:CUT_TO], f"… {len(value):,} in all"]
        if isinstance(value, list | tuple) and len(value) > 2 * CUT_TO
        else value
        for name, value in row.items()
    }
