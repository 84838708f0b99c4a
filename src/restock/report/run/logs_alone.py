"""What a page says of a run without a twin: nothing drove, so logs that it did not learn from
judge it."""

from __future__ import annotations

from restock.report.look.blocks import Rows, Section, Table, estimate
from restock.report.run.facts import Facts

_NAMES = {
    "logged": "what was logged",
    "fqe": "fitted Q evaluation (FQE)",
    "pdwis": "per-decision weighted importance sampling (PDWIS)",
    "wdr": "weighted doubly robust (WDR)",
}
BEST_FIRST = ("wdr", "pdwis")  # estimators with an interval
NOTHING_DROVE = (
    "This run learnt from the logs alone: nothing drove, in a twin or on a robot, so there is no"
    " success to show."
)


def headline(facts: Facts) -> str:
    """The most that can honestly be said."""
    rows = {(row["measure"], row["estimator"]): row for row in facts.off_policy}
    if not rows and not holds_out(facts):
        return "Trained on the logs alone, which are too short to judge it by"
    if not rows:
        return "Trained on the logs alone, not yet judged"
    measure = "success" if any(name == "success" for name, _ in rows) else "return"
    logged = rows.get((measure, "logged"))
    judged = next((rows[measure, e] for e in BEST_FIRST if known(rows.get((measure, e)))), None)
    if logged is None or judged is None:
        return "Trained on the logs alone: they are too few to say what it is worth"
    return (
        f"By held-out logs alone: {measure} {estimate(judged)}, as they were driven"
        f" {estimate(logged)}"
    )


def holds_out(facts: Facts) -> bool:
    """Whether the panel left some rows for evaluation."""
    left_out = {} if facts.panel is None else facts.panel.header.left_out
    return any("evaluation split" in why for why, rows in left_out.items() if rows)


def known(row: dict[str, object] | None) -> bool:
    """Whether an estimate was not refused."""
    return row is not None and row["value"] is not None


def judged_section(facts: Facts) -> Section:
    """The estimates, or how to get them."""
    if not facts.off_policy and not holds_out(facts):
        return Section(
            "judged",
            "What is it worth?",
            intro=f"{NOTHING_DROVE} And the logs are too short to hold any of them out: it learnt"
            " from all, so they cannot judge it. More recordings can.",
        )
    if not facts.off_policy:
        return Section(
            "judged",
            "What is it worth?",
            intro=f"{NOTHING_DROVE} `restock eval --on-logs own {facts.run}` says what it is worth"
            " on episodes that it did not learn from.",
        )
    return Section(
        "judged",
        "What is it worth?",
        intro=f"{NOTHING_DROVE} These are estimates for episodes of the logs that it did not learn"
        " from, beside what their own drivers achieved there. Choose nothing by them alone.",
        tables=[table(facts.off_policy)],
    )


def table(rows: Rows) -> Table:
    """Off-policy estimates, a row a measure and estimator."""
    shown = [
        {
            "measure": row["measure"],
            "estimator": _NAMES.get(row["estimator"], row["estimator"]),
            "value [95 %]": estimate(row),
            "episodes": row["episodes"],
        }
        for row in rows
    ]
    return Table(
        shown,
        {"episodes"},
        title="Off-policy evaluation on held-out logs, before it drove",
        caption="Over all conditions; an estimate is refused where the weights leave too few"
        " episodes to say. What was logged is what the logs' drivers achieved. Fitted Q"
        " evaluation rests on a model of the values alone, and has no interval.",
    )


__all__ = ["NOTHING_DROVE", "headline", "judged_section", "table"]
