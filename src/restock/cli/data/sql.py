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

    path: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """A store, a run directory or a panel."""
    second: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[PANEL]")] = None
    """Beside a store: a panel or a run whose tables the query can also use, as panel.rows,
    run.audit, …"""
    third: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[RUN]")] = None
    """And the other of the two, in either order."""
    query: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[QUERY]")] = None
    """The query, or - to read it from stdin. Default: open a prompt."""
    json: bool = False
    """Print a list of row objects."""
    csv: bool = False
    """Print CSV with a header."""
    export: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write a store's views for use in any DuckDB: an init file (.sql) or a database (.duckdb)."""

    def run(self) -> None:
        """Run the query and print its rows."""
        from restock.cli import output
        from restock.replay.places import beside_of, open_place

        place, others, query = self._places()
        if self.json and self.csv:
            raise QueryError("--json and --csv cannot be combined", remedy="choose one")
        if self.export is not None:
            if query is not None or others:
                raise QueryError(
                    "--export writes a store's views, and runs no query", remedy="leave out one"
                )
            self._export(place, self.export)
            return
        with open_place(
            place,
            beside=beside_of(others),
            opened=output.say_unverified,
        ) as connection:
            if query is None and sys.stdin.isatty():
                self._prompt(connection)
            else:
                text = sys.stdin.read() if query in (None, "-") else query
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
            where=self.path,
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

    def _places(self) -> tuple[str, tuple[str, ...], str | None]:
        """Return the place to query, those beside it, and the query: a last word that is none."""
        from restock.replay.places import kind_beside

        others = [word for word in (self.second, self.third, self.query) if word is not None]
        query = others.pop() if others and kind_beside(others[-1]) is None else None
        return self.path, tuple(others), query

    def _export(self, place: str, out: Path) -> None:
        from restock.cli import output
        from restock.files import expect_file_place
        from restock.replay.store.store import Store, export_views

        expect_file_place(out, "--export")
        with Store(place) as store:
            export_views(store, out)
            output.say(f"views of {store.path}, version {store.version} -> {out}")


def _cut(row: dict[str, Any]) -> dict[str, Any]:
    """Cut long lists of a row for a terminal."""
    return {
        name: [*value[:CUT_TO], f"… {len(value):,} in all"]
        if isinstance(value, list | tuple) and len(value) > 2 * CUT_TO
        else value
        for name, value in row.items()
    }
