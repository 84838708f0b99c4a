"""Reward against success: what drivers earn, and how often they succeed.

A reward that pays for haste gives an agent that touches something in a quarter of its missions more
than a driver that touches nothing; an agent trained on it learns to touch. That shows before any
training, in the returns of the drivers that are there: of a store, or of a run's evaluations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import duckdb

from restock.errors import ConfigError, RunError, quoted
from restock.files import read_json
from restock.ingest.store.location import Location
from restock.process import interrupts_raised
from restock.replay.places import RUN_CONFIG, open_place
from restock.replay.store.audit import Audit, Finding, Thresholds, check_thresholds, run_audits
from restock.replay.store.definitions import install_named
from restock.replay.store.query import found
from restock.replay.store.store import Store

DISCOUNT = 0.99  # of a store's rows, unless another is asked for
NAMES = ("reward_order", "reward_undetermined")
OF_RUN = "evaluated_"


@dataclass(frozen=True)
class RewardAudit:
    """What was found of a store or a run."""

    discount: float
    returns: list[dict[str, Any]]  # a row a condition, driver and outcome
    # A row a condition and pair of drivers; ends of `more_return` are NaN below three episodes.
    order: list[dict[str, Any]]
    findings: list[Finding]


@interrupts_raised
def audit_reward(
    place: str | Path,
    audits: Sequence[Audit],
    thresholds: Thresholds,
    *,
    discount: float | None = None,
) -> RewardAudit:
    """Return whether more success earns more, in a store's logs or a run's evaluations.

    Args:
        place: a store, or a run.
        audits, thresholds: all that are known; those of the reward are run.
        discount: of one step; for a run its own, for a store DISCOUNT.

    Raises:
        ConfigError: another discount than a run's evaluations were made with; thresholds that none
            of the audits uses.
        RunError: a run that was not evaluated, or by an earlier Restock.
        StoreError: there is neither a store nor a run.
    """
    folder = Location.of(place).folder
    of_run = folder is not None and (folder / RUN_CONFIG).is_file()
    names = [OF_RUN + name if of_run else name for name in NAMES]
    check_thresholds(audits, thresholds)
    chosen = [audit for audit in audits if audit.name in names]
    limits = {name: table for name, table in thresholds.items() if name in names}
    if of_run:
        assert folder is not None
        discount = _discount_of(folder, discount)
    discount = DISCOUNT if discount is None else discount
    beside = {"run": place} if of_run else {}
    with open_place(
        place,
        beside=beside,
        only_store=not of_run,
        opened=Store.verify,
    ) as connection:
        if of_run:
            _check_evaluated(connection, Path(place))
        else:
            install_named(connection, "driven_episodes returns_of return_order")
            connection.execute(
                "CREATE OR REPLACE VIEW driven_episodes AS"
                f" FROM discounted_episodes({float(discount)!r})"
            )
        findings = run_audits(connection, chosen, limits, beside=beside)
        source = "run.driven_episodes" if of_run else "driven_episodes"
        least = max(float(table["min_episodes"]) for table in limits.values())
        same = float(limits[names[1]]["same_success"])
        order = _rows(connection, f"FROM return_order('{source}', {least!r}, {same!r})")
        for row in order:
            row["more_return"] = [math.nan if end is None else end for end in row["more_return"]]
        returns = _rows(connection, f"FROM returns_of('{source}')")
        return RewardAudit(discount, returns, order, findings)


def _discount_of(run: Path, requested: float | None) -> float:
    config = read_json(run / RUN_CONFIG, error=RunError)["config"]
    discount = float(config["loss"]["discount"])
    if requested is not None and abs(requested - discount) > 1e-9:
        raise ConfigError(
            f"the evaluations of {run} are discounted by {discount:g}, not {requested:g}",
            where="--discount",
            remedy="leave it out: an evaluation does not keep its rewards by step",
        )
    return discount


def _check_evaluated(connection: duckdb.DuckDBPyConnection, run: Path) -> None:
    query = "SELECT table_name FROM information_schema.tables WHERE table_schema = 'run'"
    if ("driven_episodes",) not in connection.execute(query).fetchall():
        raise RunError(
            "has no evaluation with discounted returns",
            where=str(run),
            remedy=f"restock eval {quoted(run)} --policies agent,planner,operator --episodes 200"
            " --perturbations none",
        )


def _rows(connection: duckdb.DuckDBPyConnection, query: str) -> list[dict[str, Any]]:
    columns, rows = found(connection, query)
    return [dict(zip(columns, row, strict=True)) for row in rows]
