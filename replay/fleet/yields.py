"""What each episode of a store yielded, as a sample of what the next ones would.

An episode is the unit: one mission, or for a fleet whose missions cannot be chosen, so many hours
of logging. Its rows are alike, so nothing is said of a rate but over episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from typing import Literal

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from restock.arrays import F64, Bools, Ints
from restock.replay.plan.source_plan import episode_hours

MIN_STEPS = 3  # a label of a step or two may be a mistake
CELL = ("condition", "zone", "action", "robot")
Unit = Literal["missions", "hours"]


@dataclass(frozen=True)
class Yields:
    """E episodes, and their rows by cell of condition x zone x action x robot."""

    episode_id: list[str]  # (E,)
    hours: F64  # (E,)
    kind: list[str]  # (E,) what it met, of the kinds of missions there are
    simulated: bool  # the recordings knew the truth: missions of a kind can be driven
    # Number (of the episode), condition (all that hold, by commas), zone, action, robot, rows.
    cells: pa.Table

    def __len__(self) -> int:
        return len(self.episode_id)

    def members(self, kind: str | None = None, zone: str | None = None) -> Ints:
        """Return the episodes of a kind, and those that came through a zone."""
        chosen = np.ones(len(self), np.bool_)
        if kind is not None:
            chosen &= np.array([one == kind for one in self.kind], np.bool_)
        if zone is not None:
            chosen &= self._hours_in(zone) > 0
        return np.flatnonzero(chosen)

    def amount(self, unit: Unit, zone: str | None = None) -> F64:
        """(E,) what each episode was of: one mission, or so many hours (in the zone)."""
        if unit == "missions":
            return np.ones(len(self))
        return self.hours if zone is None else self._hours_in(zone)

    def rows_of(self, cell: dict[str, str | int]) -> F64:
        """(E,) rows of each episode in a cell; what it does not name may be any."""
        kept = np.ones(len(self.cells), np.bool_)
        for name, value in cell.items():
            kept &= self._is(name, value)
        return self._sum(kept)

    def values(self, name: str) -> list[str | int]:
        """Return what there is of condition, zone, action or robot."""
        values: list[str | int] = self.cells[name].unique().to_pylist()
        if name == "condition":
            values = [one for held in values for one in str(held).split(",")]
        return sorted(set(values))

    @cached_property
    def total(self) -> F64:
        """(E,) rows of each episode."""
        return self._sum(np.ones(len(self.cells), np.bool_))

    def _hours_in(self, zone: str) -> F64:
        share = self.rows_of({"zone": zone}) / np.maximum(self.total, 1)
        return np.asarray(self.hours * share, np.float64)

    def _is(self, name: str, value: str | int) -> Bools:
        if name == "condition":
            held = [one for one in self.cells[name].unique().to_pylist() if value in one.split(",")]
            return np.asarray(pc.is_in(self.cells[name], pa.array(held, pa.string())), np.bool_)
        return np.asarray(pc.equal(self.cells[name], value).to_numpy(), np.bool_)

    def _sum(self, kept: Bools) -> F64:
        number, rows = (self.cells[name].to_numpy()[kept] for name in ("number", "rows"))
        return np.bincount(number, rows, len(self)).astype(np.float64)


def read_yields(connection: duckdb.DuckDBPyConnection, kinds: Sequence[str]) -> Yields:
    """Read the yield of each episode in `transitions`; `kinds` are the missions one could drive."""
    script = files("restock.replay.fleet").joinpath("episode_yields.sql")
    for statement in duckdb.extract_statements(script.read_text(encoding="utf-8")):
        given = {"kinds": list(kinds), "min_steps": MIN_STEPS}
        named = {name: given[name] for name in statement.named_parameters}
        connection.execute(statement, named or None)
    table = connection.sql("FROM yield_episodes ORDER BY number").to_arrow_table()
    return Yields(
        table["episode_id"].to_pylist(),
        episode_hours(*(table[name].to_numpy() for name in ("first_ns", "last_ns", "rows"))),
        table["kind"].to_pylist(),
        bool(pc.any(table["simulated"]).as_py()),
        connection.sql("FROM yield_cells ORDER BY ALL").to_arrow_table(),
    )


def in_order(yields: Yields, names: pa.Array, found: F64) -> F64:
    """Return what was found in the episodes of these ids, as `yields` has them (E,), or NaN."""
    place = {name: index for index, name in enumerate(names.to_pylist())}
    padded = np.append(found, np.nan)
    return padded[[place.get(name, -1) for name in yields.episode_id]]


__all__ = ["CELL", "Unit", "Yields", "in_order", "read_yields"]
