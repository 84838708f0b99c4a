"""What `restock eval --baseline` prints: per perturbation and condition, what became of it."""

from __future__ import annotations

from typing import Any


def show_regression(rows: list[dict[str, Any]], baseline: str, margin: float) -> None:
    """The table, and one line that says what it comes to."""
    from restock.cli.output import print_table, say

    print_table(
        [_shown(row) for row in rows],
        title=f"success against the baseline {baseline}, paired by episode [95 %]",
    )
    for row in rows:
        if row["reason"]:
            say(f"{row['perturbation']}, {row['condition']}: {row['reason']}")
    if any(row["verdict"] == "refused" for row in rows):
        say("drive both with the same --episodes, --perturbations and --seed")
    worse = [f"{r['condition']} ({r['perturbation']})" for r in rows if r["verdict"] == "worse"]
    if worse:
        say(f"WORSE by more than {margin:g}, with the interval below 0: {', '.join(worse)}")


def _shown(row: dict[str, Any]) -> dict[str, Any]:
    known = row["baseline"] is not None
    return {
        "perturbation": row["perturbation"],
        "condition": row["condition"],
        "episodes": row["episodes"],
        "baseline": f"{row['baseline']:.2f}" if known else "",
        "candidate": f"{row['candidate']:.2f}" if known else "",
        "difference": f"{row['difference']:+.2f} [{row['difference_low']:+.2f},"
        f" {row['difference_high']:+.2f}]"
        if known
        else "",
        "P(improvement)": f"{row['improvement']:.2f}" if known else "",
        "": row["verdict"],
    }


__all__ = ["show_regression"]
