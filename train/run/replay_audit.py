"""Read what a run's critic was fed: sums by stratum, and the audited transitions one by one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, overload

import duckdb
import msgspec
import pyarrow as pa

from restock.errors import RunError
from restock.replay.places import open_place
from restock.train.run.run import Run


class ReplayAuditRecord(msgspec.Struct, frozen=True):
    """One transition of an audited batch; a seeded sample of batches is audited.

    It was collected before the last target sync if `gradient_step - age_steps < target_sync_step`.
    """

    transition_id: int  # for a logged row, its id in the store; for a fresh row, negative
    age_steps: int  # updates since it was collected; for a logged row, since the run began
    age_days: float | None  # days from logging to the start of training; None: a fresh row
    condition: str | None  # None: a fresh row whose episode had not ended when the run did
    behavior_policy: str  # name of the policy that took the action
    action: str  # the action's name
    reward: float  # the n-step return
    target_sync_step: int | None  # update after which the target last moved; None: not known
    gradient_step: int  # number of the update whose batch contained the transition


class ReplayAudit(Sequence[ReplayAuditRecord]):
    """The audited rows of a run, ordered by batch and by position in the batch."""

    def __init__(self, table: pa.Table) -> None:
        self._table = table

    def __len__(self) -> int:
        return int(self._table.num_rows)

    @overload
    def __getitem__(self, place: int) -> ReplayAuditRecord: ...
    @overload
    def __getitem__(self, place: slice) -> ReplayAudit: ...
    def __getitem__(self, place: int | slice) -> ReplayAuditRecord | ReplayAudit:
        rows = range(len(self))[place]  # raises IndexError as a list does
        if isinstance(rows, range):
            return ReplayAudit(self._table.take(pa.array(rows, pa.int64())))
        return ReplayAuditRecord(**self._table.slice(rows, 1).to_pylist()[0])

    def __iter__(self) -> Iterator[ReplayAuditRecord]:
        for batch in self._table.to_batches(max_chunksize=4096):
            for row in batch.to_pylist():
                yield ReplayAuditRecord(**row)

    def to_arrow(self) -> pa.Table:
        """Return the records as a table, with a column per field."""
        return self._table


def replay_audit(run: Path | str) -> ReplayAudit:
    """Return the replay audit of a run: `restock sql RUN "FROM replay_audit"` in Python.

    Raises:
        RunError: there is no run, or it has no table `audit`.
    """
    path = Path(run)
    Run.open(path)
    if not (path / "audit.parquet").is_file():
        raise RunError("it has no audit.parquet", where=str(path), remedy="train the run first")
    fields = ", ".join(ReplayAuditRecord.__struct_fields__)
    with open_place(path) as connection:
        return ReplayAudit(connection.sql(f"SELECT {fields} FROM replay_audit").to_arrow_table())


SHORT = 0.02  # share of the rows fed; a smaller shortfall is not mentioned
LOW_PART = 0.5  # a warning is given if less than this part of a quota was fed


def fed_shares(run: Run) -> list[dict[str, Any]]:
    """Return a row per stratum, with its natural, wanted and drawn shares of all rows fed.

    `logs_share` and `fresh_share` add up to the drawn share. `short_share` is how much less than
    wanted was drawn, and `reason` is why. The list is empty for a run without a panel.
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


def fed_table(fed: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of `fed_shares` as texts for a table, in % of all rows fed."""
    shares = ("natural", "wanted", "drawn", "logs", "fresh", "short")
    return [
        {"stratum": row["stratum"]}
        | {name.replace("logs", "logged"): f"{100 * row[f'{name}_share']:.1f}" for name in shares}
        for row in fed
    ]
