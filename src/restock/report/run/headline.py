"""The first sentences of a run's page: the difference from the baseline, and how certain it is.

Differences are given by condition, paired by episode and with intervals, not as one average.
A run without a twin is judged by logs that it did not learn from.
"""

from __future__ import annotations

from restock.errors import quoted
from restock.report.look.blocks import (
    Rows,
    Section,
    Table,
    better_and_worse,
    estimate,
    listed,
    points_text,
    span,
    words,
)
from restock.report.run.facts import Facts, mean_success
from restock.train.evaluation.paired import AGENT, agent_episodes, by_cell, paired
from restock.train.run.run import Run
from restock.train.twin.calibration.twin_gap import TRUSTED

BASELINES = {
    "planner": "the planner",
    "cloned": "the logs' drivers, cloned,",
    "random": "a random policy",
}
_WITHOUT = "evaluate it together with one: `restock eval --policies agent,planner`"


def headline(facts: Facts) -> str:
    """State the result in a sentence; name the policy that drove if it is not the best and last."""
    if not facts.twin:
        return _headline_of_logs(facts)
    if not facts.clean_cells():
        return f"Run {facts.run.name}: trained, not yet evaluated"
    return _result(facts) + _policy_step(facts)


def _result(facts: Facts) -> str:
    cells = facts.clean_cells()
    if facts.no_goal:
        returns = [row["return"] for row in cells]
        return (
            "No goal, so no success: mean return from"
            f" {min(returns):.2f} to {max(returns):.2f} in {len(cells)} kinds of episode"
        )
    average, random = mean_success(cells), facts.clean_cells("random")
    if random and average <= mean_success(random):
        current = facts.policy is None or facts.driven_step in (None, facts.policy.env_steps)
        return (
            ("Nothing was learned: no" if current else "No")
            + " better than a random policy on the same episodes"
            f" ({average:.0%} against {mean_success(random):.0%}, mean over conditions)"
        )
    return _against_baseline(facts) + _warn_of_gap(facts)


def _policy_step(facts: Facts) -> str:
    """State which policy drove; empty if it is the best one, and was trained to the last step."""
    step, policy = facts.driven_step, facts.policy
    if step is None or policy is None:
        return ""
    if step != policy.env_steps:
        return (
            f". Driven: policy of step {step:,} of {policy.run_env_steps:,}; the run now has that "
            f"of step {policy.env_steps:,}: evaluate it again"
        )
    ended = policy.chosen == "best" and step == policy.run_env_steps
    return "" if ended else f". Driven: {policy.text}"


def baseline(facts: Facts) -> str | None:
    """Return the baseline to compare with: the first of `BASELINES` that was evaluated."""
    return next((name for name in BASELINES if facts.clean_cells(name)), None)


def compare_with(facts: Facts, name: str | None) -> Rows:
    """Compare the agent with policy `name` by perturbation and condition, as rows of `paired`.

    Return [] if `name` is None, if one of the two was not evaluated, or if the task has no goal.
    """
    if name is None or facts.no_goal:
        return []
    driven = [agent_episodes(Run.open(facts.run), policy) for policy in (name, AGENT)]
    tables = [table for table in driven if table is not None]
    return paired(*map(by_cell, tables)) if len(tables) == len(driven) else []


def losses(facts: Facts) -> list[str]:
    """Describe where the agent is worse than the planner or the clone of the logs' drivers."""
    return [
        f"Worse than {BASELINES[name]} in {words(row['condition'])}"
        + ("" if row["perturbation"] == "none" else f" under {row['perturbation']}")
        + f": {row['success_b']:.0%} against {row['success_a']:.0%}"
        for name in ("planner", "cloned")
        if facts.clean_cells(name)
        for row in compare_with(facts, name)
        if row["verdict"] == "worse"
    ]


def _against_baseline(facts: Facts) -> str:
    name = baseline(facts)
    rows = [row for row in compare_with(facts, name) if row["perturbation"] == "none"]
    if not rows:
        each = listed(
            [
                f"{row['success']:.0%} [{row['success_low']:.0%}, {row['success_high']:.0%}] in"
                f" {words(row['condition'])}"
                for row in facts.clean_cells()
            ]
        )
        return f"No baseline drove the same episodes: success {each}"
    who = BASELINES[name or ""].removesuffix(",")
    parts, differ = better_and_worse(
        [row for row in rows if row["verdict"] in ("better", "worse")], f" than {who}"
    )
    if parts:
        rest = len(rows) - differ
        text = "; ".join(parts) + (f"; no difference shown in {rest} more" if rest else "")
        return text[0].upper() + text[1:]
    if same := [row for row in rows if row["verdict"] == "no difference shown"]:
        lowest = min(same, key=lambda row: row["difference"])
        where = words(lowest["condition"])
        return f"No difference from {who} is shown; the lowest is {points_text(lowest)} in {where}"
    return f"Too few of the same episodes to tell a difference from {who}"


def _warn_of_gap(facts: Facts) -> str:
    """Warn that success in the twin may mean little, unless nominal driving in it is trusted."""
    verdicts = () if facts.gap is None else facts.gap.verdicts
    nominal = next((each.verdict for each in verdicts if each.condition == "nominal"), TRUSTED)
    if nominal == TRUSTED:
        return ""
    return f": in a twin whose gap to these logs is {nominal} in nominal driving"


def lead(facts: Facts) -> str:
    """Say what the headline's numbers mean, and what training cost."""
    took = facts.clocks
    updates = f"{took['gradient_steps']:,} updates in {span(took['wall_s'])}"
    if not facts.twin:
        return f"A DQN trained on logs alone, without a twin: {updates}. Nothing has driven yet."
    text = f"Cost: {took['env_steps']:,} environment steps and {updates}."
    if not facts.clean_cells() or facts.no_goal:
        return text
    if baseline(facts) is None:
        return f"{text} Without a baseline, the success is hard to interpret: {_WITHOUT}."
    return (
        f"{text} Differences are in success, paired by episode, with 95 % intervals over episodes;"
        " they do not include the variation between training seeds."
    )


_ESTIMATORS = {
    "logged": "the logs' drivers",
    "fqe": "fitted Q evaluation (FQE)",
    "pdwis": "per-decision weighted importance sampling (PDWIS)",
}
NOTHING_DROVE = (
    "This run learned from the logs alone: it was not driven, in a twin or on a robot, so there "
    "is no success to show."
)


def _headline_of_logs(facts: Facts) -> str:
    """State the result of a run without a twin, from estimates on held-out logs."""
    rows = {(row["measure"], row["estimator"]): row for row in facts.off_policy}
    if not rows and not holds_out(facts):
        return "Trained on the logs alone, which are too short to evaluate it"
    if not rows:
        return "Trained on the logs alone, not yet evaluated"
    measure = "success" if any(name == "success" for name, _ in rows) else "return"
    logged = rows.get((measure, "logged"))
    judged = rows.get((measure, "pdwis"))  # the estimator that has an interval
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
    """Show the off-policy estimates, or say how to get them."""
    if facts.off_policy:
        how = (
            "These are estimates for episodes of the logs that it did not learn from, beside what"
            " the logs' drivers achieved there. Do not choose a policy by them alone."
        )
    elif holds_out(facts):
        how = (
            f"`restock eval --on-logs own {quoted(facts.run)}` evaluates it on episodes that it did"
            " not learn from."
        )
    else:
        how = (
            "The logs are too short to hold any of them out: it learned from all of them, so they"
            " cannot evaluate it. More recordings can."
        )
    tables = [off_policy_table(facts.off_policy)] if facts.off_policy else []
    return Section("judged", "How good is it?", intro=f"{NOTHING_DROVE} {how}", tables=tables)


def off_policy_table(rows: Rows) -> Table:
    """Show off-policy estimates, a row per measure and estimator."""
    shown = [
        {
            "measure": row["measure"],
            "estimator": _ESTIMATORS.get(row["estimator"], row["estimator"]),
            "value [95 %]": estimate(row),
            "episodes": row["episodes"],
        }
        for row in rows
    ]
    return Table(
        shown,
        title="Off-policy evaluation on held-out logs, before it drove",
        caption="Over all conditions. An estimate is refused if the weights leave too few "
        "episodes. Fitted Q evaluation rests only on a model of the values, and has no "
        "interval.",
    )
