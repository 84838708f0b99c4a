"""How large a buffer must be: by what it still covers when only the newest rows are kept."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import duckdb

from restock.errors import StoreError
from restock.replay.store.query import interruptible, values

CELLS_SHARE = 0.95


@dataclass(frozen=True)
class Capacity:
    """How coverage grows with capacity, and the least capacity that is enough."""

    rows: int  # of the store
    cells: int  # condition x zone x action cells that were ever seen
    recommended: int  # rows: the least that keep `cells_share` of those cells
    cells_share: float
    half_share: float  # of the cells, what the newest half of the rows keeps
    curve: list[dict[str, Any]]  # capacity, cells, cells_share, conditions, episodes, …

    @property
    def saturated(self) -> bool:
        """Whether the second half of the rows showed hardly anything new."""
        return self.half_share >= self.cells_share


def recommend_capacity(
    connection: duckdb.DuckDBPyConnection, cells_share: float = CELLS_SHARE
) -> Capacity:
    """The least number of newest rows that keep `cells_share` of the cells ever seen.

    A capacity by task diversity: below it, a first-in-first-out buffer forgets whole cells of
    condition x zone x action, and no sampling brings them back.

    Raises StoreError where there are no transitions.
    """

    def ask() -> tuple[list[dict[str, Any]], list[tuple[Any, ...]]]:
        relation = connection.sql("FROM capacity_curve()")
        curve = [dict(zip(relation.columns, row, strict=True)) for row in values(relation)]
        firsts = connection.sql(
            "SELECT min(place) FROM (SELECT condition, zone, action,"
            " row_number() OVER (ORDER BY logged_ns DESC, transition_id DESC) AS place"
            " FROM transitions) GROUP BY condition, zone, action ORDER BY ALL"
        ).fetchall()
        return curve, firsts

    curve, firsts = interruptible(connection, ask)
    if not curve:
        raise StoreError("it holds no transitions", remedy="`restock ingest` recordings first")
    needed = max(math.ceil(cells_share * len(firsts)), 1)
    return Capacity(
        rows=curve[-1]["capacity"],
        cells=len(firsts),
        recommended=firsts[needed - 1][0],
        cells_share=cells_share,
        half_share=curve[-2]["cells_share"] if len(curve) > 1 else 1.0,
        curve=curve,
    )
