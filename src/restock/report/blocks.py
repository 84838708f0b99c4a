"""The building blocks of the page: sections, tables, and numbers as people read them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from restock.report.facts import Facts, Rows

Section = dict[str, Any]


def section(
    name: str,
    title: str,
    *,
    intro: str = "",
    callout: str = "",
    figures: Sequence[dict[str, Any]] = (),
    two: bool = False,
    tables: Sequence[dict[str, Any]] = (),
    details: str = "",
    details_title: str = "",
) -> Section:
    drawn = [{"title": "", "caption": "", **figure} for figure in figures]
    return {
        "id": name,
        "title": title,
        "intro": intro,
        "callout": callout,
        "figures": drawn,
        "two": two,
        "tables": list(tables),
        "details": details,
        "details_title": details_title,
    }


def table(
    rows: Rows, *, numbers: set[str] | None = None, title: str = "", caption: str = ""
) -> dict[str, Any]:
    return {
        "title": title,
        "caption": caption,
        "columns": list(rows[0]) if rows else [],
        "rows": rows,
        "numbers": numbers or set(),
    }


def estimate(row: dict[str, Any]) -> str:
    """A value with its interval, or why there is none."""
    if row["value"] is None:
        return f"refused: {row['refused']}"
    if row["low"] is None:
        return f"{row['value']:.2f}"
    return f"{row['value']:.2f} [{row['low']:.2f}, {row['high']:.2f}]"


def percent(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.1%}" if value < 0.1 else f"{value:.0%}"


def count(value: int | None) -> str:
    return "" if value is None else f"{int(value):,}"


def number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def mean(cells: Rows) -> float:
    return float(sum(row["success"] for row in cells) / len(cells))


def clean_cells(facts: Facts, perturbation: str = "none", policy: str = "agent") -> Rows:
    return [
        row
        for row in facts.cells
        if row["policy"] == policy and row["perturbation"] == perturbation
    ]


def target_rule(facts: Facts) -> str:
    rule = facts.config.get("config", {}).get("target", {})
    if rule.get("rule") == "polyak":
        return f"Polyak τ {rule['tau']:g}"
    return f"hard, every {rule['every']:,}" if rule.get("rule") == "hard" else "?"
