"""The page of a run without a twin, judged by logs that it did not learn from."""

from __future__ import annotations

from restock.report.look.blocks import Rows, Section, Table, estimate
from restock.report.run.facts import Facts
from restock.words import quoted

_NAMES = {
    "logged": "the logs' drivers",
    "fqe": "fitted Q evaluation (FQE)",
    "pdwis": "per-decision weighted importance sampling (PDWIS)",
}
NOTHING_DROVE = (
    "This run learned from the logs alone: it was not driven, in a twin or on a robot, so there "
    "is no success to show."
)


def headline(facts: Facts) -> str:
    """Say the most that can honestly be said."""
    rows = {(row["measure"], row["estimator"]): row for row in facts.off_policy}
    if not rows and not holds_out(facts):
        return "Trained on the logs alone, which are too short to evaluate it"
    if not rows:
        return "Trained on the logs alone, not yet evaluated"
    measure = "success" if any(name == "success" for name, _ in rows) else "return"
    logged = rows.get((measure, "logged"))
    judged = rows.get((measure, "pdwis"))  # the estimator with an interval
    if logged is None or judged is None or judged["value"] is None:
        return "Trained on the logs alone: there are too few to evaluate it"
    return (
        f"By held-out logs alone: {measure} {estimate(judged)}, the logs' drivers "
        f"{estimate(logged)}"
    )


def holds_out(facts: Facts) -> bool:
    """Return whether the panel left some rows for evaluation."""
    left_out = {} if facts.panel is None else facts.panel.header.left_out
    return any("evaluation split" in why for why, rows in left_out.items() if rows)


def judged_section(facts: Facts) -> Section:
    """Show the estimates, or how to get them."""
    if not facts.off_policy and not holds_out(facts):
        return Section(
            "judged",
            "How good is it?",
            intro=f"{NOTHING_DROVE} The logs are too short to hold any of them out: it learned "
            "from all of them, so they cannot evaluate it. More recordings can.",
        )
    if not facts.off_policy:
        return Section(
            "judged",
            "How good is it?",
            intro=f"{NOTHING_DROVE} `restock eval --on-logs own {quoted(facts.run)}` evaluates it"
            " on episodes that it did not learn from.",
        )
    return Section(
        "judged",
        "How good is it?",
        intro=f"{NOTHING_DROVE} These are estimates for episodes of the logs that it did not "
        "learn from, beside what the logs' drivers achieved there. Do not choose a policy by "
        "them alone.",
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
        caption="Over all conditions. An estimate is refused if the weights leave too few "
        "episodes. Fitted Q evaluation rests only on a model of the values, and has no "
        "interval.",
    )


__all__ = ["NOTHING_DROVE", "headline", "judged_section", "table"]
