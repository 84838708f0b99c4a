"""`restock-mcp`: read-only tools of the Model Context Protocol about one place, on stdio.

A tool's answer is what a verb prints as JSON, with limits on its rows and its time.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Annotated, Any

from restock.cli.output import plain
from restock.cli.words import Positional
from restock.errors import ConfigError, QueryError, RestockError, RunError
from restock.process import expect_installed

if TYPE_CHECKING:
    import duckdb

_ROW = re.compile(r"[0-9]+(/[0-9]+)?")


@dataclass
class McpCommand:
    """Answer an assistant's questions about one place, over the Model Context Protocol on stdio.

    PLACE is a store, a run, a panel, a recording or a folder of recordings. The tools are sql,
    coverage, events, trace, diagnose and gate. They change nothing, and SQL reads no file outside
    PLACE. See docs/sql.md.

    An assistant starts it itself: name `restock-mcp PLACE` in its settings.
    """

    place: Annotated[str, Positional("PLACE")]
    """The store, run, panel, recording or folder of recordings."""
    rows: int = 200
    """The largest number of rows of a query, or of entries of a list, in an answer."""
    seconds: float = 60.0
    """The longest time for an answer, in seconds."""

    def run(self) -> None:
        """Serve until the client closes stdin."""
        expect_installed("restock-mcp", "mcp")
        from mcp.server.mcpserver import MCPServer
        from mcp.server.mcpserver.exceptions import ToolError
        from mcp.types import ToolAnnotations

        if self.rows < 1 or self.seconds <= 0:
            raise ConfigError("must be above 0", where="--rows, --seconds", remedy="leave it out")
        questions = _Questions(self.place, self.rows, self.seconds)
        tools = (
            *(questions.sql, questions.coverage, questions.events),
            *(questions.trace, questions.diagnose, questions.gate),
        )
        served = MCPServer(
            "restock",
            instructions=f"Robot logs at {self.place}: `FROM columns` lists what SQL can query.",
            log_level="WARNING",
        )
        hints = ToolAnnotations(read_only_hint=True)
        for tool in tools:
            served.add_tool(_show_errors(tool, ToolError), annotations=hints)
        served.run("stdio")


def _show_errors(
    tool: Callable[..., dict[str, Any]], error_type: type[Exception]
) -> Callable[..., dict[str, Any]]:
    """Raise a tool's RestockErrors as `error_type`: MCP hides the text of any other type."""

    @wraps(tool)
    def run(*args: Any, **named: Any) -> dict[str, Any]:
        try:
            return tool(*args, **named)
        except RestockError as error:
            raise error_type(str(error)) from error

    return run


@dataclass(frozen=True)
class _Questions:
    """The tools. The client sees the docstring of a method as the tool's description."""

    place: str
    rows: int
    seconds: float

    def sql(self, query: str) -> dict[str, Any]:
        """Run one SELECT in DuckDB's SQL, and return its columns and first rows.

        `FROM columns` lists every table and column with its meaning. Topics of recordings are
        tables under their names, in double quotes: `SELECT log_time_ns FROM "/odom"`.
        """
        from restock.replay.places import open_place
        from restock.replay.store.query import fetch

        lost: list[str] = []
        with (
            open_place(self.place, lost=lost.append, confined=True) as connection,
            self._limit_time(connection),
        ):
            columns, values, count = fetch(
                connection, query, where=self.place, at_most=self.rows, only_select=True
            )
        rows = [dict(zip(columns, row, strict=True)) for row in values]
        found: dict[str, Any] = plain({"columns": columns, "rows": rows, "all_rows": count})
        return found | ({"lost": lost} if lost else {})

    def coverage(self) -> dict[str, Any]:
        """Return how many rows, episodes and recordings of a store hold each condition."""
        return {"conditions": self._run_verb("coverage", self.place)}

    def events(self, condition: str = "") -> dict[str, Any]:
        """List a store's events, all or of one condition: where, when, how long, and the outcome.

        An event is a run of steps in which a condition holds.
        """
        named = condition.replace("'", "''")
        where = f"WHERE condition = '{named}'" if condition else ""
        return self.sql(f"FROM events {where} ORDER BY logged_onset_time, event_id")

    def trace(self, row: str = "") -> dict[str, Any]:
        """Trace a row to its recording, the time in it, and its topics.

        `row` is a transition id of a store, a row number of a panel, or STEP/ROW of a run. Without
        it, list rows that are worth a look: the strangest, or those with the largest TD errors.
        """
        if row and not _ROW.fullmatch(row):
            raise QueryError(f"{row!r} is not a row", where="row", remedy="give digits, or 1200/17")
        found = self._run_verb("trace", self.place, *([row] if row else []))
        return found if isinstance(found, dict) else {"rows": found}

    def diagnose(self, twin: bool = False) -> dict[str, Any]:
        """Tell whether a run's critic fails because of its buffer or because of its target.

        For a store or a panel, tell whether its rows are at fault. With `twin`, also compare them
        with rows of the twin, which takes longer.
        """
        found = self._run_verb("diagnose", self.place, *([] if twin else ["--no-twin"]))
        return dict(found)

    def gate(self) -> dict[str, Any]:
        """Return what `restock gate` found out about a run: whether its policy may drive."""
        from restock.files import read_json

        remedy = "`restock gate RUN --baseline planner` drives it, which takes minutes"
        file = Path(self.place) / "gate" / "gate.json"
        return dict(self._cut(read_json(file, error=RunError, remedy=remedy)))

    def _run_verb(self, *words: str) -> Any:
        """Run a verb in a process for at most `seconds`, and return the JSON document it prints."""
        command = [sys.executable, "-m", "restock", *words, "--json"]
        try:
            done = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=self.seconds,
            )
        except subprocess.TimeoutExpired:
            raise self._too_long() from None
        if done.returncode not in (0, 1):
            raise RestockError(done.stderr.removeprefix("restock: ").strip())
        return self._cut(json.loads(done.stdout))

    def _cut(self, value: Any) -> Any:
        """Cut long lists; the last entry then gives the full length."""
        if isinstance(value, Mapping):
            return {name: self._cut(one) for name, one in value.items()}
        if not isinstance(value, list):
            return value
        more = [f"… {len(value):,} in all"] if len(value) > self.rows else []
        return [*map(self._cut, value[: self.rows]), *more]

    @contextmanager
    def _limit_time(self, connection: duckdb.DuckDBPyConnection) -> Iterator[None]:
        """Interrupt the connection's queries after `seconds`."""
        ended, late = Event(), Event()

        def stop() -> None:
            wait = self.seconds
            while not ended.wait(wait):  # an interrupt between two queries is lost: repeat it
                late.set()
                connection.interrupt()
                wait = 0.1

        thread = Thread(target=stop, daemon=True)
        thread.start()
        try:
            yield
        except QueryError as error:
            raise (self._too_long() if late.is_set() else error) from error
        finally:
            ended.set()
            thread.join()

    def _too_long(self) -> QueryError:
        return QueryError(
            f"stopped after {self.seconds:g} s",
            where=self.place,
            remedy="ask for less, or start restock-mcp with more --seconds",
        )
