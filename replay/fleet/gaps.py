"""Gaps of a store: rows that a mixture, an audit or a minimum requires, and that the store lacks.

A gap is a number of missing rows (or episodes) in a cell of condition x zone x action x robot. It
has the rows that each episode of the store contributed: the sample for a forecast.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cached_property
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any, Literal

import duckdb
import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from restock.arrays import F64, Bools, Ints
from restock.errors import ConfigError
from restock.ingest.task.conditions import NOMINAL, Condition, shipped
from restock.process import interrupts_raised
from restock.replay.mixture.mixture import CorrectionRule, EvaluationSplit, Mixture
from restock.replay.panel.build import open_source
from restock.replay.plan.plan import LOGS, PanelPlan, plan_panel
from restock.replay.store.audit import Thresholds, check_thresholds, shipped_audits
from restock.replay.store.definitions import install_named
from restock.replay.store.store import Store

MIN_STEPS = 3  # steps in which an episode must have a condition; fewer may be a mistake
CELL = ("condition", "zone", "action", "robot")
Unit = Literal["missions", "hours"]


@dataclass(frozen=True)
class Yields:
    """E episodes, and the number of rows of each by condition, zone, action and robot."""

    episode_id: list[str]  # (E,)
    hours: F64  # (E,)
    kind: list[str]  # (E,) kind of mission: the condition that the episode met, or nominal
    simulated: bool  # some recordings are simulated, so missions of any kind can be ordered
    # Columns: number (0..E - 1, the episode), condition (all that hold, separated by commas), zone,
    # action, robot, rows.
    cells: pa.Table

    def __len__(self) -> int:
        return len(self.episode_id)

    def members(self, kind: str | None = None, zone: str | None = None) -> Ints:
        """Return the indices of episodes of a kind that drove through a zone; None: any."""
        chosen = np.ones(len(self), np.bool_)
        if kind is not None:
            chosen &= np.array([one == kind for one in self.kind], np.bool_)
        if zone is not None:
            chosen &= self._hours_in(zone) > 0
        return np.flatnonzero(chosen)

    def amount(self, unit: Unit, zone: str | None = None) -> F64:
        """Return each episode's amount in this unit, (E,): 1 mission, or its hours in the zone."""
        if unit == "missions":
            return np.ones(len(self))
        return self.hours if zone is None else self._hours_in(zone)

    def rows_of(self, cell: dict[str, str | int]) -> F64:
        """Count each episode's rows in a cell, (E,); columns that it does not name are free."""
        kept = np.ones(len(self.cells), np.bool_)
        for name, value in cell.items():
            kept &= self._matches(name, value)
        return self._sum(kept)

    def values(self, name: str) -> list[str | int]:
        """Return the sorted values of a column: condition, zone, action or robot."""
        values: list[str | int] = self.cells[name].unique().to_pylist()
        if name == "condition":
            values = [one for held in values for one in str(held).split(",")]
        return sorted(set(values))

    @cached_property
    def total(self) -> F64:
        """Return the rows of each episode, (E,)."""
        return self._sum(np.ones(len(self.cells), np.bool_))

    def _hours_in(self, zone: str) -> F64:
        share = self.rows_of({"zone": zone}) / np.maximum(self.total, 1)
        return np.asarray(self.hours * share, np.float64)

    def _matches(self, name: str, value: str | int) -> Bools:
        if name == "condition":
            held = [one for one in self.cells[name].unique().to_pylist() if value in one.split(",")]
            return np.asarray(pc.is_in(self.cells[name], pa.array(held, pa.string())), np.bool_)
        return np.asarray(pc.equal(self.cells[name], value).to_numpy(), np.bool_)

    def _sum(self, kept: Bools) -> F64:
        number, rows = (self.cells[name].to_numpy()[kept] for name in ("number", "rows"))
        return np.bincount(number, rows, len(self)).astype(np.float64)


def episode_hours(first_ns: Ints, last_ns: Ints, rows: Ints) -> F64:
    """Return episode durations (E,) in hours; the last step has the mean length of the others."""
    steps = np.maximum(rows - 1, 1)
    return np.asarray((last_ns - first_ns) / 3.6e12 * rows / steps, np.float64)


def read_yields(connection: duckdb.DuckDBPyConnection, kinds: Sequence[str]) -> Yields:
    """Read the yields of all episodes in `transitions`; `kinds` are the kinds of missions."""
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


def reorder(yields: Yields, names: pa.Array, found: F64) -> F64:
    """Reorder `found`, values of the episodes `names`, like `yields`, (E,); NaN for others."""
    place = {name: index for index, name in enumerate(names.to_pylist())}
    padded = np.append(found, np.nan)
    return padded[[place.get(name, -1) for name in yields.episode_id]]


Counted = Literal["rows", "episodes"]
# Audits whose thresholds are numbers of rows or episodes, which gaps are measured against.
AUDITS = ("rare_condition", "few_effective_episodes", "missing_cells")


@dataclass(frozen=True)
class Gap:
    """A cell or stratum with too few rows or episodes."""

    asked_by: str  # what requires it: "mixture coverage", "audit rare_condition", "--min-rows"
    cell: dict[str, str | int]  # value of any of condition (or stratum), zone, action, robot
    counted: Counted
    needed: float
    there: float
    # (E,) rows or episodes that each episode adds; NaN if the mixture admits none of its rows.
    found: F64
    action_name: str | None = None  # name of the cell's action; None: no action, or tasks differ
    thinnest: tuple[str, ...] = ()  # up to three zones that lack most of their part of `needed`

    @property
    def missing(self) -> float:
        return max(self.needed - self.there, 0.0)


@interrupts_raised
def find_gaps(
    store: Store,
    mixture: Mixture,
    *,
    name: str,
    folder: Path | str | None = None,
    kinds: Sequence[str] = (),
    thresholds: Thresholds | None = None,
    min_rows: int = 0,
) -> tuple[Yields, list[Gap]]:
    """Return the store's episodes and its gaps: gaps in episodes first, then in rows, by size.

    Args:
        name: the mixture's name, for reports.
        folder: the folder for relative paths of the mixture's other stores.
        kinds: kinds of missions that can be driven: conditions of the store, or shipped ones.
        thresholds: audit -> its thresholds; AUDITS are used. None: the mixture alone.
        min_rows: minimum of rows in each cell of CELL; 0: none.

    Raises:
        ConfigError, MixtureError, StoreError: see `plan_panel`; also unknown kinds, audits or
            thresholds, or a threshold of a wrong type.
    """
    _refuse_unknown(kinds, [NOMINAL, *(one.name for one in store.conditions()), *shipped()])
    if thresholds is not None:
        check_thresholds(shipped_audits(), thresholds, others=True)
    requested = _without_split(store, uncorrected(mixture))
    with open_source(store, requested, folder=None if folder is None else Path(folder)) as source:
        plan = plan_panel(source.connection, requested, source.conditions, source.others)
    yields = read_yields(store.connection, kinds)
    gaps = _find_strata_gaps(plan, yields, f"mixture {name}")
    if thresholds is not None:
        gaps += _find_audit_gaps(store.connection, yields, thresholds)
    if min_rows:
        gaps += _find_cell_gaps(yields, store.conditions(), min_rows)
    gaps.sort(key=lambda gap: (gap.counted, -gap.missing, str(gap.cell)))
    named = dict(
        store.sql(
            "SELECT action, any_value(name) FROM actions"
            " GROUP BY ALL HAVING count(DISTINCT name) = 1"
        ).fetchall()
    )
    gaps = [replace(gap, action_name=named.get(gap.cell.get("action"))) for gap in gaps]
    return yields, [gap for gap in gaps if gap.missing > 0]


def _refuse_unknown(kinds: Sequence[str], known: Sequence[str]) -> None:
    for kind in kinds:
        if kind not in known:
            near = get_close_matches(kind, known, n=1)
            names = f"the conditions are {', '.join(dict.fromkeys(known))}"
            raise ConfigError(
                f"no condition is called {kind!r}",
                where="kinds",
                remedy=f"did you mean {near[0]!r}? {names}" if near else names,
            )


def uncorrected(mixture: Mixture) -> Mixture:
    """Return the mixture without weights, which are slow to estimate and do not affect gaps.

    The result accepts shortfalls, because gaps are found from them.
    """
    strata = tuple(msgspec.structs.replace(rule, correction=None) for rule in mixture.strata)
    each = mixture.each_condition
    return msgspec.structs.replace(
        mixture,
        strata=strata,
        each_condition=each and msgspec.structs.replace(each, correction=None),
        correction=CorrectionRule(pre="none", post="none", below_natural="allow"),
        shortfall="shrink",
    )


def _without_split(store: Store, mixture: Mixture) -> Mixture:
    """Remove a split by recording from the mixture if the store has only one recording."""
    if mixture.evaluation_split.by != "recording":
        return mixture
    several = store.sql("SELECT count(DISTINCT recording_id) > 1 FROM transitions").fetchall()[0][0]
    none = EvaluationSplit(by="none")
    return mixture if several else msgspec.structs.replace(mixture, evaluation_split=none)


def _find_strata_gaps(plan: PanelPlan, yields: Yields, asked_by: str) -> list[Gap]:
    """Return a gap for each stratum with too few rows for its wanted share."""
    gaps = []
    names = plan.rows["episode_id"].combine_chunks().dictionary
    for code, line in enumerate(plan.strata):
        if not line.missing_rows or line.source != LOGS:
            continue
        found = reorder(yields, names, plan.found[line.name])
        needed = line.rows + line.missing_rows
        cell: dict[str, str | int] = {"stratum": line.name}
        thin = _rank_zones(plan, code, needed)
        gaps.append(Gap(asked_by, cell, "rows", needed, line.rows, found, thinnest=thin))
    return gaps


def _rank_zones(plan: PanelPlan, code: int, needed: int) -> tuple[str, ...]:
    """Return up to three zones that lack most rows of `needed` times their share of all rows."""
    column = plan.rows["zone"].combine_chunks()
    names, zone = column.dictionary.to_pylist(), column.indices.fill_null(len(column.dictionary))
    size = len(names) + 1
    everywhere = np.bincount(zone.to_numpy(), minlength=size)[: len(names)]
    there = np.bincount(zone.to_numpy()[plan.stratum == code], minlength=size)[: len(names)]
    short = needed * everywhere / max(everywhere.sum(), 1) - there
    return tuple(names[place] for place in np.argsort(-short)[:3].tolist() if short[place] > 0)


def _find_audit_gaps(
    connection: duckdb.DuckDBPyConnection, yields: Yields, thresholds: Thresholds
) -> list[Gap]:
    """Return gaps between the store and the thresholds of AUDITS, also those that are closed."""
    gaps = []
    limits = {name: {k: float(v) for k, v in thresholds.get(name, {}).items()} for name in AUDITS}
    lines = connection.sql(
        "SELECT condition, rows_held, episodes_held, effective_episodes FROM coverage_by_condition"
    ).fetchall()
    for condition, rows, episodes, effective in lines:
        if rows is None:  # no recording can show this condition, so more drives would not help
            continue
        found = yields.rows_of({"condition": condition})
        observed = np.asarray(found > 0, np.float64)
        requested = limits["rare_condition"]
        cell: dict[str, str | int] = {"condition": condition}
        by = "audit rare_condition"
        gaps.append(Gap(by, cell, "rows", requested.get("min_rows", 0), rows, found))
        gaps.append(Gap(by, cell, "episodes", requested.get("min_episodes", 0), episodes, observed))
        least = limits["few_effective_episodes"].get("min_effective_episodes", 0)
        if effective and effective < least:  # 0 if no row has the condition
            # Assume that rows are spread over new episodes as unevenly as over those in the store.
            needed = math.ceil(least * episodes / effective)
            by = "audit few_effective_episodes"
            gaps.append(Gap(by, cell, "episodes", needed, episodes, observed))
    least = limits["missing_cells"].get("min_rows", 0)
    install_named(connection, "cells_below")
    cells = connection.execute("FROM cells_below(?)", [least]).fetchall() if least else []
    for condition, action, *_, rows in cells:
        cell = {"condition": condition, "action": action}
        gaps.append(Gap("audit missing_cells", cell, "rows", least, rows, yields.rows_of(cell)))
    return gaps


def _find_cell_gaps(yields: Yields, conditions: Sequence[Condition], min_rows: int) -> list[Gap]:
    """Return a gap for each cell with fewer than `min_rows` rows, including empty ones.

    A cell with a robot counts only that robot's rows, but its forecast uses rows of all robots.
    """
    gaps = []
    values: dict[str, list[str | int]] = {name: yields.values(name) for name in CELL}
    known = {NOMINAL, *(condition.name for condition in conditions), *values["condition"]}
    values["condition"] = sorted(known, key=str)
    if values["robot"] == [""]:  # no recording has the tag
        del values["robot"]
    for chosen in product(*values.values()):
        cell: dict[str, Any] = dict(zip(values, chosen, strict=True))
        there = float(yields.rows_of(cell).sum())
        if there < min_rows:
            anyone = {name: value for name, value in cell.items() if name != "robot"}
            found = yields.rows_of(anyone)
            gaps.append(Gap("--min-rows", cell, "rows", min_rows, there, found))
    return gaps
