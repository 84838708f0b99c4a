"""The section on what to log next: the plan of `restock coverage gaps`, and each gap."""

from __future__ import annotations

from typing import Any

from restock.report.look.blocks import Rows, Section, Table, count, words
from restock.words import counted, plural

MAX_GAPS = 20  # in the table


def to_log(gaps: dict[str, Any]) -> dict[str, str]:
    """Make the card of what to log next."""
    plan, unit = gaps["plan"], gaps["unit"]
    unknown = [gap for gap in gaps["gaps"] if gap["best"] is None]
    if gaps["closed"]:
        return {"value": "0", "label": f"{unit} to log next"}
    if unknown and not plan["orders"]:
        least = _to_see_one(unknown)
        most = sum(least.values())
        return {
            "value": f"at least {most:,}",
            "label": f"more {plural(most, 'episode')} of {' and '.join(least)}, to see what was"
            " never logged (95 %)",
        }
    label = (
        f"{unit} to log next (95 %: {amount(plan['total_low'])} to {amount(plan['total_high'])})"
    )
    if unknown:
        verb = "has no rate and is" if len(unknown) == 1 else "have no rate and are"
        label += f"; {counted(len(unknown), 'gap')} {verb} not in it"
    return {"value": amount(plan["total"]), "label": label}


def _to_see_one(gaps: Rows) -> dict[str, int]:
    """Return, for gaps without a rate, how many episodes of each kind show one with 95 %."""
    least: dict[str, int] = {}
    for gap in gaps:
        kind = words(gap["never_seen_in"])
        least[kind] = min(gap["at_least"], least.get(kind, gap["at_least"]))
    return least


def shopping_section(gaps: dict[str, Any]) -> Section:
    unit, plan = gaps["unit"], gaps["plan"]
    if gaps["closed"]:
        return Section("shopping", "What to log next", intro="Nothing: there are no gaps.")
    orders = [
        {
            "kind": words(order["kind"] or "logging"),
            "zone": words(order["zone"] or ""),
            "robot": order["robot"] or "",
            **({"missions": count(order["missions"])} if unit == "missions" else {}),
            "hours": f"{order['hours']:.2f}",
            "fills": "; ".join(words(name) for name in dict.fromkeys(order["fills"])),
        }
        for order in plan["orders"]
    ]
    ordered = sorted(gaps["gaps"], key=lambda gap: gap["there"] / max(gap["needed"], 1))
    table = [
        {
            "gap": words(gap["cell"]),
            "there": count(gap["there"]),
            "needed": count(gap["needed"]),
            "of": gap["counted"],
            unit: ""
            if gap["amount"] is None
            else f"{amount(gap['amount'])} [{amount(gap['amount_low'])},"
            f" {amount(gap['amount_high'])}]",
            "best": words(gap["best"]) if gap["best"] else _no_rate(gap),
            "asked by": gap["asked_by"],
        }
        for gap in ordered[:MAX_GAPS]
    ]
    left = len(gaps["gaps"]) - len(table)
    unknown = _to_see_one([gap for gap in gaps["gaps"] if gap["best"] is None])
    never = " and ".join(_more_of(kind, least) for kind, least in unknown.items())
    intro = []
    if orders:
        which = "every gap that has a rate" if unknown else "every gap"
        intro.append(
            f"The least number of {unit} that fills {which} with {gaps['confidence']:.0%},"
            " at the rates of the store's own episodes; intervals are 95 %."
        )
    if orders and unit == "missions":  # the twin drives no hours
        intro.append("`restock coverage gaps --missions-out FILE` writes it as missions to drive.")
    if unknown:
        intro.append(
            "What was never logged has no rate, so no amount to fill it is known: to see one"
            f" with 95 %, log at least {never}."
        )
    return Section(
        "shopping",
        "What to log next",
        intro=" ".join(intro),
        tables=[
            Table(_without_empty(orders), {"missions", "hours"}, title="What to drive"),
            Table(
                _without_empty(table),
                {"there", "needed", unit},
                title="What is missing",
                caption=f"{left:,} more gaps: `restock coverage gaps --json` has all."
                if left
                else "",
            ),
        ],
    )


def _no_rate(gap: dict[str, Any]) -> str:
    ((kind, least),) = _to_see_one([gap]).items()
    return f"no rate is known: at least {_more_of(kind, least)}"


def _more_of(kind: str, episodes: int) -> str:
    """`9 more episodes of blocked aisle`."""
    return f"{episodes:,} more {plural(episodes, 'episode')} of {kind}"


def _without_empty(rows: Rows) -> Rows:
    """Without the columns that say nothing in any row."""
    reported = {name for row in rows for name, value in row.items() if value != ""}
    return [{name: value for name, value in row.items() if name in reported} for row in rows]


def amount(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


__all__ = ["amount", "shopping_section", "to_log"]
