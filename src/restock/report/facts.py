"""What a report knows: the rows behind every figure, read from a run, its panel and its store."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import duckdb
import pyarrow.parquet as pq

from restock.errors import RestockError, RunError
from restock.replay.panel.panel import Panel, Stratum
from restock.replay.store.store import Store, read_parquet
from restock.stats import wilson
from restock.train.run.run import Run
from restock.train.run.run_tables import EVAL_EPISODES
from restock.train.twin.floors.floors import open_floors
from restock.train.twin.floors.layout import DEFAULT, Warehouse

Rows = list[dict[str, Any]]
CELL_M = 0.25
MOST_DOTS = 1500
LISTS = (
    "fed",
    "conditions",
    "ages",
    "policies",
    "learning",
    "td",
    "lag",
    "loss",
    "cells",
    "failures",
)


@dataclass
class Facts:
    """Everything that the page is made of. Lists are empty where a run has not got there."""

    run: Path
    config: dict[str, Any]
    fed: Rows
    conditions: Rows  # in the batches, whatever the strata are
    ages: Rows
    policies: Rows
    learning: Rows
    kept: dict[str, Any] | None
    td: Rows
    lag: Rows
    loss: Rows
    cells: Rows  # of `restock eval`, with Wilson intervals as low and high
    failures: Rows
    panel: Panel | None = None
    floor: Warehouse | None = None  # that the run drives on, where it is one
    visited: Rows = field(default_factory=list)
    rare: Rows = field(default_factory=list)
    recordings: Rows = field(default_factory=list)
    logged: Rows = field(default_factory=list)  # share of logged rows per condition
    off_policy: Rows = field(default_factory=list)  # off-policy estimates, over all conditions
    missing: list[str] = field(default_factory=list)  # what could not be read, and why

    @property
    def strata(self) -> list[Stratum]:
        return [] if self.panel is None else list(self.panel.strata)


def gather(path: Path) -> Facts:
    """Read a run.

    Raises:
        RunError: no run at `path`, or one without a single logged update.
    """
    run = Run.open(path)
    with duckdb.connect() as connection:
        for file in sorted(path.glob("*.parquet")):
            read_parquet(connection, file.stem, [file])
        if not (path / "conditions.parquet").exists():  # a run from before it was kept
            connection.register("conditions", run.table("conditions"))
        file = path / "eval" / "episodes.parquet"
        evaluated = EVAL_EPISODES.empty_table()
        if file.exists():
            evaluated = pq.read_table(file, schema=EVAL_EPISODES)
        connection.register("evaluated", evaluated)
        queries = _queries()
        found = {name: _rows(connection, sql) for name, sql in queries.items()}
    if not found["loss"]:
        raise RunError(
            "has no update to report on yet",
            where=str(path),
            remedy="let it train past its first logging interval",
        )
    for row in found["cells"]:
        row["success"] = row["successes"] / row["episodes"]
        row["low"], row["high"] = wilson(int(row["successes"]), int(row["episodes"]))
    facts = Facts(
        run=path,
        config=run.document,
        kept=found["kept"][0] if found["kept"] else None,
        **{name: found[name] for name in LISTS},  # type: ignore[arg-type]
    )
    facts.off_policy = [
        row for row in run.table("off_policy").to_pylist() if row["condition"] == "all"
    ]
    if not facts.cells:
        facts.missing.append("`restock eval` has not been run: success is of training only.")
    _add_panel(facts)
    if facts.visited:
        _add_floor(facts)
    return facts


def _add_panel(facts: Facts) -> None:
    said = facts.config.get("panel")
    where = said.get("path") if isinstance(said, dict) else said
    if not where:
        facts.missing.append("The run had no panel: it learnt from fresh experience alone.")
        return
    try:
        facts.panel = Panel.open(where)
        with Store(facts.panel.header.store) as store:
            facts.visited = _store_rows(store, "visited", cell_m=CELL_M)
            facts.rare = _store_rows(store, "rare", most=MOST_DOTS)
            facts.recordings = _store_rows(store, "recordings")
            facts.logged = _store_rows(store, "logged")
    except RestockError as error:
        facts.missing.append(f"Not shown, since it could not be read: {error}")


def _add_floor(facts: Facts) -> None:
    layouts = facts.config["config"].get("env", {}).get("layouts", DEFAULT)
    try:
        floors = open_floors(layouts)
    except RestockError as error:
        facts.missing.append(f"The floor is not drawn, since it could not be read: {error}")
        return
    if len(floors) == 1:
        facts.floor = floors[0]
    else:
        facts.missing.append(
            f"No floor is drawn: the run drives on {len(floors)} floors ({layouts})."
        )


def _store_rows(store: Store, name: str, **parameters: Any) -> Rows:
    sql = _queries("store.sql")[name]
    return _as_dicts(store.connection.execute(sql, parameters or None))


def _queries(name: str = "run.sql") -> dict[str, str]:
    """The statements of a file, by the `-- name:` line before each."""
    text = (files("restock.report") / name).read_text(encoding="utf-8")
    parts = text.split("-- name: ")[1:]
    return {part.split("\n", 1)[0].strip(): part.split("\n", 1)[1] for part in parts}


def _rows(connection: duckdb.DuckDBPyConnection, sql: str) -> Rows:
    return _as_dicts(connection.execute(sql))


def _as_dicts(cursor: duckdb.DuckDBPyConnection) -> Rows:
    names = [column[0] for column in cursor.description or ()]
    return [dict(zip(names, row, strict=True)) for row in cursor.fetchall()]


def span(seconds: float) -> str:
    """A duration for people."""
    if not math.isfinite(seconds):
        return "?"
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def pretty(document: Any) -> str:
    return json.dumps(document, indent=2, default=str)
