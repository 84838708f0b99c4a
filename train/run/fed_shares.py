"""What the critic of a run was fed, over all its batches: the run's table `fed`, summed."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import duckdb

from restock.train.run.run import Run

SHORT = 0.02  # of the rows fed: less is not worth a word
LOW_PART = 0.5  # of a quota: a run that fed less warns


def fed_shares(run: Run) -> list[dict[str, Any]]:
    """Return a row per stratum: its natural, wanted, drawn and short share of all rows fed.

    `logs_share` and `fresh_share` say where the drawn rows came from, `reason` why it was short.
    Empty for a run without a panel.
    """
    sql = (files("restock.train.run") / "fed_shares.sql").read_text(encoding="utf-8")
    with duckdb.connect() as connection:
        connection.register("fed", run.table("fed"))
        found = connection.sql(sql)
        return [dict(zip(found.columns, row, strict=True)) for row in found.fetchall()]


def shortfalls(fed: list[dict[str, Any]]) -> list[str]:
    """Return a line for each stratum that was fed less than half of its quota."""
    return [
        f"{row['stratum']} was {row['drawn_share']:.1%} of the rows fed, less than half of its"
        f" quota of {row['wanted_share']:.1%}" + (f": {row['reason']}" if row["reason"] else "")
        for row in fed
        if row["drawn_share"] < LOW_PART * row["wanted_share"]
    ]


__all__ = ["SHORT", "fed_shares", "shortfalls"]
