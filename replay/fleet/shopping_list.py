"""The shopping list: which missions, and how many of each, fill the gaps of a store.

For each gap and kind of mission there is a forecast. An integer linear programme finds the smallest
number of missions that fills all gaps. For each gap by itself, the planned amount suffices with the
probability CONFIDENCE.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from restock.arrays import F64
from restock.errors import figure, plural
from restock.replay.fleet.forecast import (
    Forecast,
    forecast,
    missions_to_see_one,
    probability_to_close,
)
from restock.replay.fleet.gaps import Gap, Unit, Yields, find_gaps
from restock.replay.mixture.mixture import load_mixture
from restock.replay.panel.mixture_tables import install_planned
from restock.replay.store.audit import load_thresholds
from restock.replay.store.store import Store

# Names and types of the columns of `FROM gaps(name)`.
COLUMNS = {
    **dict.fromkeys(("asked_by", "stratum", "condition", "zone"), "VARCHAR"),
    "action": "BIGINT",
    **dict.fromkeys(("action_name", "robot", "counted"), "VARCHAR"),
    **dict.fromkeys(("needed", "there", "missing"), "BIGINT"),
    **dict.fromkeys(("unit", "best"), "VARCHAR"),
    **dict.fromkeys(("rate", "rate_low", "rate_high"), "DOUBLE"),
    **dict.fromkeys(("amount", "amount_low", "amount_high"), "DOUBLE"),
}
CONFIDENCE = 0.8  # probability with which the plan should close each gap
HOUR_STEPS = 60  # planned hours are rounded up to multiples of 1 / HOUR_STEPS
_PART = 0.1  # an order is listed for a gap if it fills at least this fraction of the gap


@dataclass(frozen=True)
class Supply:
    """Something that can be ordered: missions of a kind, or hours of logging."""

    kind: str | None  # None: the fleet's usual operation
    zone: str | None = None  # zone on the route; None: any
    robot: str | None = None  # robot that drives; None: any

    @property
    def name(self) -> str:
        words = [self.kind or "logging"]
        words += [f"in {self.zone}"] if self.zone else []
        words += [f"by {self.robot}"] if self.robot else []
        return " ".join(words)


@dataclass(frozen=True)
class FilledGap:
    """A gap with the supply that fills it best."""

    gap: Gap
    best: Supply | None  # None: no logged episode contributed to the gap
    forecast: Forecast | None  # forecast of the best supply
    see_one: tuple[Supply, int] | None  # without `best`: what to try, and missions to see one row
    closes_with: float | None = None  # probability that the plan closes the gap


@dataclass(frozen=True)
class Order:
    """One line of the shopping list."""

    supply: Supply
    amount: float  # number of missions, or hours
    hours: float
    fills: tuple[str, ...]  # descriptions of the gaps to which it contributes


@dataclass(frozen=True)
class ShoppingList:
    """A plan of what to log next."""

    unit: Unit
    gaps: list[FilledGap]
    orders: list[Order]
    total_low: float  # missions or hours in all, at the 2.5 % quantile of each gap's replicates
    total_high: float  # missions or hours in all, at the 97.5 % quantile

    @property
    def total(self) -> float:
        return sum(order.amount for order in self.orders)


def shopping_list(
    yields: Yields,
    gaps: Sequence[Gap],
    *,
    unit: Unit | None = None,
) -> ShoppingList:
    """Plan orders that fill the gaps, if new missions yield as much as the store's episodes.

    Args:
        unit: missions of a kind, or hours of logging; None: missions if recordings have true
            conditions (a simulator drives any kind ordered), else hours.
    """
    if unit is None:
        unit = "missions" if yields.simulated else "hours"
    rng = np.random.default_rng(0)
    kinds: list[str | None] = [None] if unit == "hours" else [*sorted(set(yields.kind))]
    supplies = list(dict.fromkeys(s for gap in gaps for s in _supplies(gap, kinds)))
    table: dict[tuple[int, Supply], Forecast] = {}
    for supply in supplies:
        at = yields.members(supply.kind, supply.zone)
        amount = yields.amount(unit, supply.zone)[at]
        for index, gap in enumerate(gaps):
            if _may_fill(supply, gap):
                # Use the same random draws for every gap, so that equal gaps get equal forecasts.
                draws = np.random.default_rng(0)
                table[index, supply] = forecast(gap.found[at], amount, gap.missing, rng=draws)
    filled = [
        _fill_gap(gap, {s: table[index, s] for s in _supplies(gap, kinds)})
        for index, gap in enumerate(gaps)
    ]
    reachable = [index for index, one in enumerate(filled) if one.best is not None]
    amounts = _minimise_amounts(gaps, reachable, table, CONFIDENCE, unit)
    total_low, total_high = (
        sum(_minimise_amounts(gaps, reachable, table, share, unit).values())
        for share in (0.025, 0.975)
    )
    orders = [
        _order(supply, amount, gaps, table, yields, unit) for supply, amount in amounts.items()
    ]
    orders.sort(key=lambda order: -order.amount)
    if unit == "missions":
        filled = [_with_probability(one, amounts, yields, rng) for one in filled]
    return ShoppingList(unit, filled, orders, total_low, total_high)


def _may_fill(supply: Supply, gap: Gap) -> bool:
    """Return whether the supply has the zone and the robot that the gap requires, if any."""
    requested = ((gap.cell.get("zone"), supply.zone), (gap.cell.get("robot"), supply.robot))
    return all(wanted is None or wanted in ("", given) for wanted, given in requested)


def _supplies(gap: Gap, kinds: Sequence[str | None]) -> list[Supply]:
    """Return the supplies for a gap, one per kind, with the gap's zone and robot."""
    zone, robot = gap.cell.get("zone"), gap.cell.get("robot")
    return [
        Supply(kind, None if zone is None else str(zone), str(robot) if robot else None)
        for kind in kinds
    ]


def _fill_gap(gap: Gap, forecasts: dict[Supply, Forecast]) -> FilledGap:
    known = {supply: one for supply, one in forecasts.items() if one.known}
    if known:
        best = min(known, key=lambda supply: known[supply].quantile(CONFIDENCE))
        return FilledGap(gap, best, known[best], None)
    # Choose the kind named like the gap, else the kind with the fewest episodes so far.
    named = [
        supply
        for supply in forecasts
        if supply.kind in (gap.cell.get("condition"), gap.cell.get("stratum"))
    ]
    likely = min(named or forecasts, key=lambda supply: (forecasts[supply].episodes, supply.name))
    return FilledGap(gap, None, None, (likely, missions_to_see_one(forecasts[likely].episodes)))


def _minimise_amounts(
    gaps: Sequence[Gap],
    reachable: Sequence[int],
    table: dict[tuple[int, Supply], Forecast],
    share: float,
    unit: Unit,
) -> dict[Supply, float]:
    """Compute the smallest amounts (missions or hours) that fill all reachable gaps.

    An amount suffices for a gap if it fills the gap in a fraction `share` of the replicates. If n
    missions alone would suffice, one mission counts as filling 1/n of the gap.
    """
    from scipy.optimize import LinearConstraint, milp

    supplies = list(dict.fromkeys(supply for (index, supply) in table if index in reachable))
    if not supplies:
        return {}
    rates = np.zeros((len(reachable), len(supplies)))
    for row, index in enumerate(reachable):
        for column, supply in enumerate(supplies):
            enough = [one.quantile(share) for one in _forecasts(table, index, supply)]
            if enough:
                rates[row, column] = gaps[index].missing / max(*enough, 1e-9)
    whole = unit == "missions"
    missing = np.array([gaps[index].missing for index in reachable])
    scale = np.maximum(missing, 1e-9)  # the solver needs constraints of similar size
    # On a tie, prefer missions without a required zone or robot, which are easier to arrange.
    cost = [1.001 if supply.zone or supply.robot else 1.0 for supply in supplies]
    found = milp(
        np.array(cost),
        constraints=LinearConstraint(rates / scale[:, None], missing / scale, np.inf),
        integrality=np.full(len(supplies), int(whole)),
        options={"time_limit": 10.0, "mip_rel_gap": 0.01},
    )
    if found.x is None:  # should not happen: some supply fills each reachable gap
        return {}
    amounts = np.round(found.x) if whole else np.ceil(found.x * HOUR_STEPS - 1e-6) / HOUR_STEPS
    return {s: float(a) for s, a in zip(supplies, amounts.tolist(), strict=True) if a > 0}


def _forecasts(
    table: dict[tuple[int, Supply], Forecast], index: int, supply: Supply
) -> list[Forecast]:
    """Return forecasts for a gap: with the supply's zone and robot, without zone, and without both.

    The caller uses the worst one: for a gap without a zone, missions through one zone count no more
    than missions anywhere. Otherwise, the zone with the luckiest sample would look best.
    """
    ways = (supply, Supply(supply.kind, None, supply.robot), Supply(supply.kind))
    return [one for way in dict.fromkeys(ways) if (one := table.get((index, way))) is not None]


def _order(
    supply: Supply,
    amount: float,
    gaps: Sequence[Gap],
    table: dict[tuple[int, Supply], Forecast],
    yields: Yields,
    unit: Unit,
) -> Order:
    at = yields.members(supply.kind, supply.zone)
    hours = amount if unit == "hours" else amount * float(yields.hours[at].mean())
    fills = tuple(
        describe_cell(gap)
        for index, gap in enumerate(gaps)
        if (one := table.get((index, supply))) is not None
        and one.rate * amount >= _PART * gap.missing
    )
    return Order(supply, amount, hours, fills)


def _with_probability(
    one: FilledGap, amounts: dict[Supply, float], yields: Yields, rng: np.random.Generator
) -> FilledGap:
    parts: list[tuple[F64, int]] = []
    for supply, amount in amounts.items():
        if _may_fill(supply, one.gap):
            at = yields.members(supply.kind, supply.zone)
            parts.append((one.gap.found[at], round(amount)))
    closes = probability_to_close(parts, one.gap.missing, rng=rng) if one.best else None
    return FilledGap(one.gap, one.best, one.forecast, one.see_one, closes)


def describe_cell(gap: Gap) -> str:
    """Describe a cell in words: `wheel_slip`, or `wheel_slip, turn left 1.2, aisle_2`."""
    cell = dict(gap.cell)
    words = [str(cell.pop(name)) for name in ("stratum", "condition") if name in cell]
    if (action := cell.pop("action", None)) is not None:
        words.append(gap.action_name or f"action {action}")
    return ", ".join([*words, *(str(value) for value in cell.values() if value != "")])


def document(found: ShoppingList) -> dict[str, Any]:
    """Return a shopping list as the plain values that `restock coverage gaps --json` prints."""
    return {
        "unit": found.unit,
        "confidence": CONFIDENCE,
        "closed": not found.gaps,
        "gaps": [_gap(one) for one in found.gaps],
        "plan": {
            "orders": [
                {
                    "kind": order.supply.kind,
                    "zone": order.supply.zone,
                    "robot": order.supply.robot,
                    "missions": round(order.amount) if found.unit == "missions" else None,
                    "hours": order.hours,
                    "fills": list(order.fills),
                }
                for order in found.orders
            ],
            "total": found.total,
            "total_low": found.total_low,
            "total_high": found.total_high,
            "hours": sum(order.hours for order in found.orders),
        },
    }


def _gap(one: FilledGap) -> dict[str, Any]:
    gap, seen = one.gap, one.forecast
    line: dict[str, Any] = {
        "asked_by": gap.asked_by,
        "cell": describe_cell(gap),
        **{
            name: gap.cell.get(name) for name in ("stratum", "condition", "zone", "action", "robot")
        },
        "action_name": gap.action_name,
        "counted": gap.counted,
        "needed": math.ceil(gap.needed),
        "there": round(gap.there),
        "missing": math.ceil(gap.missing),
        "thinnest_zones": list(gap.thinnest),
        "best": one.best.name if one.best else None,
        "rate": seen.rate if seen else None,
        "rate_low": seen.rate_low if seen else None,
        "rate_high": seen.rate_high if seen else None,
        "rate_of_episodes": seen.episodes if seen else None,
        "amount": seen.quantile(0.5) if seen else None,
        "amount_low": seen.quantile(0.025) if seen else None,
        "amount_high": seen.quantile(0.975) if seen else None,
        "closes_with": one.closes_with,
    }
    if one.see_one is not None:
        supply, missions = one.see_one
        line |= {"never_seen_in": supply.name, "at_least": missions}
    return line


Lines = list[dict[str, Any]]


def readable(answer: dict[str, Any]) -> tuple[Lines, Lines, Lines]:
    """Return a `document` as rows of three tables: gaps with a rate, gaps without, and the plan."""
    unit = answer["unit"]
    known = [
        {
            "gap": gap["cell"],
            "asked by": gap["asked_by"],
            "of": gap["counted"],
            **{name: gap[name] for name in ("needed", "there", "missing", "best")},
            f"per {'mission' if unit == 'missions' else 'hour'}": _with_ends(gap, "rate"),
            unit: _with_ends(gap, "amount"),
            "thinnest in": ", ".join(gap["thinnest_zones"][:2]),
            "the plan closes it": "" if gap["closes_with"] is None else f"{gap['closes_with']:.0%}",
        }
        for gap in answer["gaps"]
        if gap["best"]
    ]
    # All actions that were never taken in a condition share one row.
    groups: dict[tuple[Any, ...], Lines] = {}
    for gap in answer["gaps"]:
        if not gap["best"]:
            key = (gap["stratum"] or gap["condition"], gap["zone"], gap["robot"], gap["asked_by"])
            groups.setdefault(key, []).append(gap)
    unknown = []
    for (*cell, asked_by), members in groups.items():
        actions = [
            gap["action_name"] or f"action {gap['action']}"
            for gap in members
            if gap["action"] is not None
        ]
        least = min(members, key=lambda gap: gap["at_least"])
        episodes = f"{least['at_least']:,} more {plural(least['at_least'], 'episode')}"
        unknown.append(
            {
                "gap": ", ".join(str(part) for part in cell if part),
                "actions": ", ".join(actions),
                "asked by": asked_by,
                "of": least["counted"],
                "needed": least["needed"],
                "to see one, with 95 %": f"at least {episodes} of {least['never_seen_in']}",
            }
        )
    orders = [
        {
            "kind": order["kind"] or "logging",
            **{name: order[name] or "" for name in ("zone", "robot", "missions")},
            "hours": round(order["hours"], 2),
            "fills": "; ".join(dict.fromkeys(order["fills"])),
        }
        for order in answer["plan"]["orders"]
    ]
    return _without_empty(known), _without_empty(unknown), _without_empty(orders)


def _with_ends(gap: dict[str, Any], name: str) -> str:
    value, low, high = (figure(gap[key]) for key in (name, f"{name}_low", f"{name}_high"))
    return f"{value} ({low} to {high})"


def _without_empty(lines: Lines) -> Lines:
    """Leave out columns that are empty in all rows."""
    kept = {name for line in lines for name, value in line.items() if value != ""}
    return [{name: value for name, value in line.items() if name in kept} for line in lines]


def install_gaps(store: Store) -> None:
    """Create the macro `gaps(name)` in a store's connection: gaps by a mixture and the audits.

    Kinds of missions are the store's conditions. (`restock coverage gaps` uses those that the twin
    can drive.)
    """
    script = files("restock.replay.fleet") / "gaps.sql"
    install_planned(store, {"planned_gaps": (COLUMNS, _gaps_table)}, script, _plan_list)


def _plan_list(own: Store, name: str) -> ShoppingList:
    yields, gaps = find_gaps(
        own,
        load_mixture(name),
        name=name,
        folder=Path(name).parent,
        kinds=[condition.name for condition in own.conditions()],
        thresholds=load_thresholds(),
    )
    return shopping_list(yields, gaps)


def _gaps_table(found: ShoppingList) -> pa.Table:
    """Return one row per gap, with columns COLUMNS."""
    lines = [{**line, "unit": found.unit} for line in document(found)["gaps"]]
    return pa.table({name: [line[name] for line in lines] for name in COLUMNS})
