"""`restock sql`: any question to a store, a run or a panel."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from restock.errors import QueryError

EXPANDED_ROWS = 20  # at most so many rows too wide for the terminal are printed one below the other


@dataclass
class Sql:
    """Any question to a store, a run directory or a panel, in DuckDB's SQL.

    A store has the views transitions, recordings, episodes, coverage, coverage_by_condition,
    missing_cells, reward_mix, ages, label_overlap, versions, conditions, actions, drops, topics
    and label_scores; `restock sql STORE "FROM columns"` lists every column with its meaning. A run
    has its tables (progress, strata, ages, audit, …), a panel `rows`, `strata` and `held_out`.
    Queries are read-only, and Ctrl-C stops one.
    """

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """A store, a run directory or a panel."""
    query: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="QUERY")]
    """The query, or - to read it from stdin."""
    run_dir: Annotated[Path | None, tyro.conf.arg(name="run", metavar="RUN")] = None
    """A run whose tables are to be had beside, as run.audit, run.strata, …"""
    panel: Path | None = None
    """A panel whose tables are to be had beside, as panel.rows, panel.strata."""
    json: bool = False
    """Print a list of row objects."""
    csv: bool = False
    """Print CSV with a header."""
    memory_limit: str | None = None
    """What DuckDB may hold in memory, e.g. 4GB; beyond that it spills to a temporary folder."""

    def run(self) -> None:
        """Run the query and print its rows."""
        from restock.cli import output
        from restock.replay.places import open_place
        from restock.replay.query import fetch

        if self.json and self.csv:
            raise QueryError("--json and --csv are both given", remedy="choose one")
        text = sys.stdin.read() if self.query == "-" else self.query
        beside = {"run": self.run_dir, "panel": self.panel}
        given = {name: path for name, path in beside.items() if path is not None}
        with open_place(self.path, beside=given, memory_limit=self.memory_limit) as connection:
            columns, values = fetch(connection, text, where=str(self.path))
        rows = [dict(zip(columns, row, strict=True)) for row in values]
        if self.json:
            output.print_json(rows)
        elif self.csv:
            output.print_csv(rows, columns)
        elif _too_wide(rows, columns) and len(rows) <= EXPANDED_ROWS:
            for number, row in enumerate(rows, start=1):
                lines = [
                    {"column": name, "value": output.cell(row[name]).replace(r"\[", "[")}
                    for name in columns
                ]
                output.print_table(lines, title=f"row {number}")
        else:
            output.print_table(rows, columns)


def _too_wide(rows: list[dict[str, Any]], columns: list[str]) -> bool:
    """Whether a table of these rows would not fit side by side."""
    from restock.cli import output

    widths = (
        max([len(name), *(len(output.cell(row[name])) for row in rows)]) + 3 for name in columns
    )
    return sum(widths) > output.stdout().width
