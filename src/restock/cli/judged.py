"""What `restock eval --on-logs` prints: a row a measure and condition, its estimators beside."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from restock.train.evaluation.ope import Judging
    from restock.train.evaluation.ope_run import Judged


def show_judged(path: Path, judged: Judged, how: Judging, *, as_json: bool) -> None:
    """Print the estimates, and why those that weigh are refused where they are."""
    from restock.cli.output import print_json, print_table, say

    if as_json:
        print_json(
            {
                "run": str(path),
                "policy": judged.version,
                "notes": list(judged.notes),
                "results": judged.rows,
            }
        )
        return
    cells: dict[tuple[str, str], dict[str, Any]] = {}
    for row in judged.rows:
        key = row["measure"], row["condition"]
        shown = cells.setdefault(
            key, {"measure": key[0], "condition": key[1], "episodes": row["episodes"]}
        )
        shown[row["estimator"]] = _value(row)
        shown["weights worth"] = f"{row['ess']:.1f} episodes"
    print_table(
        list(cells.values()),
        title=f"{judged.version}, greedy but for {how.epsilon:.0%} chance, judged on logs"
        " it did not learn from [95 % over episodes]",
    )
    for row in judged.rows:
        if row["condition"] == "all" and row["estimator"] == "pdwis" and row["refused"]:
            longest = f"; --horizon {row['ess_steps']} would do" if row["ess_steps"] else ""
            say(f"{row['measure']}: pdwis and wdr are refused: {row['refused']}{longest}")
    estimated = judged.rows[0]["estimated_share"] if judged.rows else 0.0
    if estimated:
        say(
            f"the behaviour's probabilities are estimated (cloned) for {estimated:.0%} of the rows:"
            " the logs do not say them"
        )
    for note in judged.notes:
        say(note)


def _value(row: dict[str, Any]) -> str:
    if row["value"] is None:
        return "refused"
    if row["low"] is None:
        return f"{row['value']:.2f}"
    return f"{row['value']:.2f} [{row['low']:.2f}, {row['high']:.2f}]"


__all__ = ["show_judged"]
