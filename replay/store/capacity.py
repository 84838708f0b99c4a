"""How large a buffer must be: by what it still covers when only the newest rows are kept."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import duckdb
import pyarrow as pa

from restock.errors import ConfigError, StoreError, expect
from restock.replay.store.definitions import install_named
from restock.replay.store.query import found, interruptible

CELLS_SHARE = 0.95
EFFECTIVE_EPISODES = 50.0
_COLUMNS = ("transition_id", "episode_id", "logged_ns", "condition", "zone", "action")


@dataclass(frozen=True)
class Capacity:
    """How coverage grows with capacity, and the least capacity that is enough."""

    rows: int  # of the store
    cells: int  # condition x zone x action cells that were ever seen
    recommended: int  # rows: the least that keep those cells and episodes
    cells_share: float
    effective_episodes: float  # that the rows must be worth
    rows_for_cells: int  # the least that keep `cells_share` of the cells
    rows_for_episodes: int | None  # … that are worth so many episodes; None: all rows are not
    half_share: float  # of the cells, what the newest half of the rows keeps
    curve: list[dict[str, Any]]  # capacity, cells, cells_share, conditions, episodes, …

    @property
    def saturated(self) -> bool:
        """Return whether the second half of the rows showed hardly anything new."""
        return self.half_share >= self.cells_share

    @property
    def reason(self) -> str:
        """Why so many, in a sentence."""
        cells = (
            f"{self.rows_for_cells:,} of {self.rows:,} rows keep {self.cells_share:.0%} of the"
            f" {self.cells} condition x zone x action cells ever seen"
        )
        if self.rows_for_episodes is None:
            return (
                f"{cells}, and all of them are worth less than"
                f" {self.effective_episodes:g} effective episodes"
            )
        return (
            f"{cells}, and {self.rows_for_episodes:,} are worth"
            f" {self.effective_episodes:g} effective episodes"
        )


def recommend_capacity(
    connection: duckdb.DuckDBPyConnection,
    cells_share: float = CELLS_SHARE,
    effective_episodes: float = EFFECTIVE_EPISODES,
) -> Capacity:
    """Return the least number of newest rows that keep the diversity of a store's tasks.

    They keep `cells_share` of the condition x zone x action cells ever seen, and are worth
    `effective_episodes`. Below the first, a first-in-first-out buffer forgets whole cells, and no
    sampling brings them back; below the second, what it holds is a few drives.

    Raises StoreError where there are no transitions, ConfigError for a share that is none, or for
    a path in place of a connection.
    """
    expect("connection", connection, duckdb.DuckDBPyConnection, 'give Store("store").connection')
    if not 0 <= cells_share <= 1 or not effective_episodes >= 0:
        raise ConfigError(
            f"cells_share must be in [0, 1], and effective_episodes at least 0, got {cells_share} "
            f"and {effective_episodes}"
        )
    install_named(connection, "capacity_curve capacity_needed")

    def ask() -> tuple[list[dict[str, Any]], tuple[Any, ...]]:
        columns, rows = found(connection, "FROM capacity_curve()")
        curve = [dict(zip(columns, row, strict=True)) for row in rows]
        needed = connection.execute(
            "FROM capacity_needed($cells, $episodes)",
            {"cells": cells_share, "episodes": effective_episodes},
        )
        return curve, needed.fetchall()[0]

    curve, (cells, for_cells, for_episodes) = interruptible(connection, ask)
    if not curve:
        raise StoreError("it holds no transitions", remedy="`restock ingest` recordings first")
    rows = curve[-1]["capacity"]
    return Capacity(
        rows=rows,
        cells=cells,
        recommended=max(for_cells, rows if for_episodes is None else for_episodes),
        cells_share=cells_share,
        effective_episodes=effective_episodes,
        rows_for_cells=for_cells,
        rows_for_episodes=for_episodes,
        half_share=curve[-2]["cells_share"] if len(curve) > 1 else 1.0,
        curve=curve,
    )


def capacity_of_rows(transitions: pa.Table) -> Capacity:
    """Return the same of rows in memory: of a panel (`panel.meta`), which is what a run is fed."""
    macros = files("restock.replay.store").joinpath("capacity.sql").read_text(encoding="utf-8")
    with duckdb.connect() as connection:
        rows = transitions.select(list(_COLUMNS)).rename_columns({"condition": "primary_condition"})
        connection.register("transitions", rows)
        connection.execute(macros)
        return recommend_capacity(connection)


__all__ = ["Capacity", "capacity_of_rows", "recommend_capacity"]
