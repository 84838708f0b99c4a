"""The section that matters most: what the critic was fed."""

from __future__ import annotations

from typing import Any

from restock.report import charts
from restock.report.blocks import Section, clean_cells, count, mean, number, percent, section, table
from restock.report.charts import words
from restock.report.facts import Facts, Rows


def fed(facts: Facts) -> Section:
    natural = {stratum.name: stratum.natural_share for stratum in facts.strata}
    wanted = {stratum.name: stratum.share for stratum in facts.strata}
    logs = [row for row in facts.fed if row["source"] == "logs"]
    bars: Rows = []
    for row in logs:
        name = row["stratum"]
        for kind, value in (
            ("in the logs", natural.get(name, row["available_share"])),
            ("intended", wanted.get(name, row["quota_share"])),
            ("drawn", row["drawn_share"]),
        ):
            if value is not None:
                bars.append({"stratum": words(name), "kind": kind, "share": value})
    figures = []
    if bars:
        figures.append(
            {
                "title": "Logs: what was there, what was asked for, what was drawn",
                "svg": charts.shares(bars),
            }
        )
    if facts.ages:
        figures.append(
            {
                "title": "How old the sampled rows were",
                "svg": charts.ages(_age_rows(facts)),
                "caption": "Logs age by the calendar (days); fresh rows by environment steps since"
                " they were collected. The two are never pooled.",
            }
        )
    if facts.policies:
        figures.append(
            {
                "title": "Whose experience it was",
                "svg": charts.stacked(
                    [
                        {
                            "source": row["source"],
                            "who": row["behaviour_policy"],
                            "share": row["share"],
                        }
                        for row in facts.policies
                    ],
                    group="source",
                    part="who",
                    value="share",
                ),
            }
        )
    rows = [
        {
            "source": row["source"],
            "stratum": words(row["stratum"]),
            "timing": row["timing"] or "",
            "available": count(row["available_rows"]),
            "intended": percent(row["quota_share"]),
            "drawn": percent(row["drawn_share"]),
            "after weights": percent(row["effective_share"]),
            "rows drawn": count(row["drawn_rows"]),
            "replays per row": _replays(row),
            "mean reward": number(row["reward_mean"]),
            "terminal": percent(row["terminal_share"]),
        }
        for row in facts.fed
    ]
    return section(
        "fed",
        "What was the critic fed?",
        intro="The replay mix is the training distribution. Intended is what the mixture asks for,"
        " drawn what the batches held, after weights what the gradient saw.",
        callout=evaluation_bias(facts),
        figures=figures,
        two=True,
        tables=[
            table(
                rows,
                numbers={
                    "available",
                    "intended",
                    "drawn",
                    "after weights",
                    "rows drawn",
                    "replays per row",
                    "mean reward",
                    "terminal",
                },
                caption="Shares are of the source. Replays per row: rows drawn over rows available"
                " at the end, so for a ring that turned over it is an upper bound.",
            )
        ],
    )


def _replays(row: dict[str, Any]) -> str:
    if not row["available_rows"]:
        return ""
    return f"{row['drawn_rows'] / row['available_rows']:.1f}"


def _age_rows(facts: Facts) -> Rows:
    rows: Rows = []
    for row in facts.ages:
        unit = "d" if row["unit"] == "days" else "steps"
        low = 2 ** row["bucket"] if row["bucket"] >= 0 else 0
        text = f"< 1 {unit}" if row["bucket"] < 0 else f"{_short(low)} to {_short(2 * low)} {unit}"
        rows.append(
            {
                "source": row["source"],
                "bucket": text,
                "order": row["bucket"] + (0 if unit == "d" else 100),
                "share": row["share"],
            }
        )
    return rows


def _short(value: int) -> str:
    return f"{value / 1024:.0f}k" if value >= 1024 else str(value)


def evaluation_bias(facts: Facts) -> str:
    """The imbalance most likely to make the evaluation look better than deployment."""
    cells = clean_cells(facts)
    if not cells or not facts.logged:
        return ""
    by_condition: dict[str, list[dict[str, Any]]] = {}
    for row in cells:
        by_condition.setdefault(row["cell"].split(" (")[0], []).append(row)
    success = {name: mean(rows) for name, rows in by_condition.items()}
    episodes = sum(row["episodes"] for row in cells)
    evaluated = {
        name: sum(row["episodes"] for row in rows) / episodes for name, rows in by_condition.items()
    }
    logged = {row["condition"]: row["share"] for row in facts.logged if row["condition"] in success}
    total = sum(logged.values())
    if not total:
        return ""
    logged = {name: logged.get(name, 0.0) / total for name in success}
    as_evaluated = sum(evaluated[name] * success[name] for name in success)
    as_logged = sum(logged[name] * success[name] for name in success)
    worst = max(success, key=lambda n: (evaluated[n] - logged[n]) * (success[n] - as_logged))
    gain = (evaluated[worst] - logged[worst]) * (success[worst] - as_logged)
    more = evaluated[worst] > logged[worst]
    text = (
        f"Evaluation against deployment: weighted as the logs' episodes met them, success would be"
        f" {as_logged:.0%} instead of {as_evaluated:.0%}."
    )
    if gain <= 0.0005:
        return text + " No condition's share biases the evaluation upward."
    return text + (
        f" The share that biases it most is {words(worst)}: {evaluated[worst]:.0%} of the"
        f" evaluation's episodes, {logged[worst]:.0%} of the logs', and"
        f" {'easier' if more else 'harder'} than average ({success[worst]:.0%}); it is worth"
        f" {gain * 100:+.1f} points."
    )
