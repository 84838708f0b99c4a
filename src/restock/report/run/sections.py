"""The sections: success, what was sampled, learning, the critic's health, the map, provenance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from markupsafe import Markup

from restock.replay.plan.exclusions import DAY_NS
from restock.report.look import charts, floor_map
from restock.report.look.blocks import (
    Figure,
    Rows,
    Section,
    Table,
    count,
    pretty,
    span,
    words,
)
from restock.report.run import shares
from restock.report.run.facts import CELL_M, NO_GOAL, Facts, evaluation_bias
from restock.report.run.headline import losses
from restock.report.run.logs_alone import table as off_policy_table
from restock.words import counted, policy_words

_YEARS_FROM_DAYS = 512  # ages are in years from there on


def success(facts: Facts) -> Section | None:
    if not facts.cells:
        return None
    cells = sorted(facts.cells, key=_cell_order)
    names = policy_words(row["policy"] for row in cells)
    shown = [
        {
            **row,
            "policy": names[row["policy"]],
            "cell": words(row["cell"]),
            "perturbation": "clean" if row["perturbation"] == "none" else row["perturbation"],
        }
        for row in cells
    ]
    places = {place: number for number, place in enumerate(dict.fromkeys(map(_place, shown)))}
    rows = [
        {
            "perturbation": row["perturbation"],
            "kind of episode": row["cell"],
            "policy": row["policy"],
            "success": "no goal"
            if row["success"] is None
            else f"{row['success']:.0%} [{row['low']:.0%}, {row['high']:.0%}]",
            "episodes": row["episodes"],
            "discounted return": _told(row, "discounted_return", ".2f"),
            "bumps per km": _told(row, "bumps_per_km", ".1f"),
            "least distance to people": _told(row, "closest_person_least_m", ".2f", " m"),
            "time to goal": _told(row, "time_s", ".1f", " s"),
            "time lost to the planner": ""
            if row["policy"] == "planner"
            else _told(row, "time_lost_s", "+.1f", " s"),
        }
        for row in sorted(shown, key=lambda row: (places[_place(row)], row["policy"] != "agent"))
        if row["policy"] != "random"
    ]
    tables = [
        _success_table(name, [row for row in rows if row["perturbation"] == name])
        for name in dict.fromkeys(row["perturbation"] for row in rows)
    ]
    return Section(
        "success",
        "Does it reach the goal?",
        intro=NO_GOAL
        if facts.no_goal
        else "Success per kind of episode, on the same seeded episodes for every policy, without "
        "a perturbation (clean) and under each one. Lines are 95 % Wilson intervals. "
        f"{facts.evaluation}" + "".join(f" {one.text}." for one in facts.clones),
        callout="" if facts.no_goal else ". ".join(losses(facts)),
        figures=[] if facts.no_goal else [Figure(charts.success(shown))],
        tables=tables,
    )


def _success_table(perturbation: str, rows: Rows) -> Table:
    """Show the success under one perturbation, folded unless that is the clean one."""
    reported = {name for row in rows for name, value in row.items() if value != ""} - {
        "perturbation"
    }
    shown, before = [], None
    for row in rows:
        kind = row["kind of episode"]
        line = {name: value for name, value in row.items() if name in reported}
        shown.append(line | {"kind of episode": "" if kind == before else kind})
        before = kind
    clean = perturbation == "clean"
    return replace(
        _table(
            shown,
            {"policy", "kind of episode"},
            title="Success, return and safety side by side"
            + ("" if clean else f": {perturbation}"),
            caption="Intervals are 95 % over episodes. People include forklifts; the distance is "
            "the true one from the edge of the body. Time lost is over the missions in which "
            "both arrived."
            if clean
            else "",
        ),
        folded=not clean,
    )


def _table(rows: Rows, texts: set[str], *, title: str = "", caption: str = "") -> Table:
    """Make a table whose columns are numbers, except `texts`."""
    numbers = set(rows[0]) - texts if rows else set()
    return Table(rows, numbers, title=title, caption=caption)


def _cell_order(row: dict[str, Any]) -> tuple[str, int, str]:
    known = list(charts.CONDITION_COLOURS)
    condition = row["cell"].split(" (")[0]
    place = known.index(condition) if condition in known else len(known)
    return (row["perturbation"] if row["perturbation"] != "none" else "", place, row["cell"])


def _place(row: dict[str, Any]) -> tuple[str, str]:
    return row["perturbation"], row["cell"]


def _told(row: dict[str, Any], name: str, form: str, unit: str = "") -> str:
    """Format a value with its unit and interval; nothing if it is unknown."""
    if row[name] is None:
        return ""
    low, high = row.get(f"{name}_low"), row.get(f"{name}_high")
    ends = "" if low is None else f" [{low:{form}}, {high:{form}}]"
    return f"{row[name]:{form}}{unit}{ends}"


def sampled(facts: Facts) -> Section:
    """Show what the critic was fed: the section that matters most."""
    of_shares = shares.figure(facts)
    figures = [] if of_shares is None else [of_shares]
    if facts.ages:
        figures.append(
            Figure(
                charts.ages(_age_rows(facts)),
                "How old the sampled rows were",
                f"The age of logs is in days (before training began{_newest(facts)}), that of "
                "fresh rows in environment steps since they were collected. The two are never "
                "pooled.",
            )
        )
    if facts.policies:
        policies = [{**row, "who": row["behaviour_policy"]} for row in facts.policies]
        stacked = charts.stacked(
            policies, group="source", part="who", value="share", colours=charts.POLICY_COLOURS
        )
        figures.append(Figure(stacked, "Behaviour policies of the sampled rows"))
    return Section(
        "fed",
        "What was the critic fed?",
        intro="The replay mix is the training distribution. A quota is a stratum's share of the "
        "batch, whether its rows are logged or fresh. Wanted: the quota. Drawn: the share of all "
        "rows fed. After weights: the share in the gradient.",
        callout=evaluation_bias(facts),
        figures=figures,
        two=True,
        tables=[*([shares.fed_table(facts)] if facts.fed else []), shares.table(facts)],
    )


def _newest(facts: Facts) -> str:
    """Return the age of the panel's newest row: what is only as old is not stale."""
    began_ns = facts.config.get("created_ns")
    if facts.panel is None or began_ns is None:
        return ""
    days = (began_ns - facts.panel.header.newest_ns) / DAY_NS
    age = f"{days:,.1f} days" if days < _YEARS_FROM_DAYS else f"{days / 365.25:.1f} years"
    return f"; the panel's newest row was {age} old then"


def _age_rows(facts: Facts) -> Rows:
    rows: Rows = []
    for row in facts.ages:
        unit = "d" if row["unit"] == "days" else "steps"
        text = f"< 1 {unit}" if row["bucket"] < 0 else _span(2 ** row["bucket"], unit)
        rows.append(
            {
                "source": row["source"],
                "bucket": text,
                "order": row["bucket"] + (0 if unit == "d" else 100),
                "share": row["share"],
            }
        )
    return rows


def _span(low: int, unit: str) -> str:
    """Label ages from `low` to twice that, in years if they are that old."""
    if unit == "d" and low >= _YEARS_FROM_DAYS:
        return f"{low / 365.25:.1f} to {2 * low / 365.25:.1f} y"
    return f"{_short(low)} to {_short(2 * low)} {unit}"


def _short(value: int) -> str:
    return f"{value / 1024:.0f}k" if value >= 1024 else str(value)


def learning(facts: Facts) -> Section:
    figures = []
    policy = facts.policy
    latest = policy if policy is not None and policy.chosen == "latest" else None
    if any(row["success"] is not None for row in facts.learning):
        figures.append(
            Figure(
                charts.lines(
                    charts.in_words(facts.learning),
                    x="env_steps",
                    y="success",
                    series="condition",
                    y_title="success",
                    percent=True,
                    domain=(0, 1),
                    points=True,
                    marker=None if policy is None or latest else float(policy.env_steps),
                ),
                "Greedy success on fixed episodes",
                "The kept checkpoint is the best of these evaluations, not the last."
                if latest is None
                else f"None of these is of the {latest.text}.",
            )
        )
    figures.append(
        Figure(
            charts.lines(
                facts.loss,
                x="gradient_steps",
                y="loss",
                series="phase",
                y_title="Huber loss",
                colours={"offline": "#334155", "warmup": "#94a3b8", "online": "#14b8a6"},
            ),
            "Loss",
            "A low loss alone says little: with a frozen target it is lowest.",
        )
    )
    tables = [off_policy_table(facts.off_policy)] if facts.off_policy and facts.twin else []
    return Section("learning", "How did it learn?", figures=figures, two=True, tables=tables)


def critic(facts: Facts) -> Section | None:
    figures = []
    if facts.td:
        figures.append(
            Figure(
                charts.lines(
                    charts.in_words(facts.td),
                    x="gradient_steps",
                    y="td_abs_mean",
                    series="condition",
                    y_title="mean |TD error| on a fixed probe",
                ),
                "TD error by condition",
                "On the same rows at every point. If a condition stays high while the others "
                "fall, the buffer does not teach it.",
            )
        )
    lag = [
        {**row, "what": "relative value lag"}
        for row in facts.lag
        if row["target_q_lag"] is not None
    ]
    if lag:
        figures.append(
            Figure(
                charts.lines(
                    lag,
                    x="gradient_steps",
                    y="target_q_lag",
                    series="what",
                    y_title="mean |Q − Q target| / mean |Q|",
                    colours={"relative value lag": "#0f766e"},
                ),
                "Lag of the target network",
                f"Target rule: {facts.target_rule}. Near zero, the target keeps up; above about a "
                "quarter, it slows down learning.",
            )
        )
    return (
        Section("critic", "Is the critic healthy?", figures=figures, two=True) if figures else None
    )


def floor_section(facts: Facts) -> Section | None:
    """Show on the map where the logs have been, and where the agent failed."""
    layout = facts.floor
    if layout is None:
        return None
    racks = [(r.x_min, r.y_min, r.x_max, r.y_max) for r in layout.racks]
    plan = floor_map.FloorMap(layout.width_m, layout.depth_m, racks)
    failures = [
        row
        for row in facts.failures
        if row["perturbation"] == "none" and row["layout"] == layout.name
    ]
    conditions = {row["condition"] for row in [*facts.rare, *failures]}
    names = charts.ordered(
        [{"condition": name} for name in conditions], "condition", charts.CONDITION_COLOURS
    )
    colours = charts.palette(names)
    steps = sum(row["rows"] for row in facts.visited)
    return Section(
        "map",
        "Where did it happen?",
        figures=[
            Figure(
                floor_map.visited(plan, facts.visited, CELL_M),
                "Where the logs have been",
                f"{steps:,} logged steps in cells of {CELL_M} m, darker where there are more"
                f" (logarithmic); the bar is {floor_map.BAR_M} m. Drawn on the run's floor, "
                f"{layout.name}"
                + (f", the first of {facts.floors} with logs." if facts.floors > 1 else ".")
                + (
                    f" Not drawn: what was logged in other frames, "
                    f"{counted(facts.elsewhere, 'recording')}."
                    if facts.elsewhere
                    else ""
                )
                + (
                    f" Its missions start at {len(layout.starts_m)} places where the robot was in "
                    f"the logs, and go to {len(layout.goals)}."
                    if layout.starts_m
                    else ""
                ),
            ),
            Figure(
                floor_map.events(plan, facts.rare, failures, colours),
                "Rare conditions in the logs (dots), the agent's failures (crosses)",
                Markup(floor_map.legend(names, colours))
                + Markup("<br>")
                + f"{len(failures)} failed clean episodes there.",
            ),
        ],
        two=True,
    )


def provenance(facts: Facts) -> Section:
    tables = []
    unlabelled = [
        {"condition": words(name), "not labelled in the twin, which has no": ", ".join(signals)}
        for name, signals in facts.config.get("not_evaluated", {}).items()
    ]
    if facts.panel is not None:
        header = facts.panel.header
        left_out = [f"{count:,} {reason}" for reason, count in header.left_out.items() if count]
        pins = {
            "panel": header.id,
            "store": f"{header.store}, version {header.store_version}",
            "task": header.task_hash,
            "labels": header.labels_version,
            "left out of the panel": ", ".join(left_out) or "nothing",
            "held out to evaluate on": header.split_note
            or words(header.split_by or header.mixture.evaluation_split.by),
        }
        tables.append(Table([{"pinned": name, "value": value} for name, value in pins.items()]))
    if facts.recordings:
        rows = [
            {
                "recording": row["source_file"],
                "format": row["format"],
                "length": span(row["duration_s"]),
                "episodes": row["episodes"],
                "transitions": count(row["transitions"]),
                "profile": f"{row['profile']} {row['profile_hash']}",
                "id": row["recording_id"],
            }
            for row in facts.recordings
        ]
        tables.append(Table(rows, {"length", "episodes", "transitions"}, title="Recordings"))
    tables.append(Table(unlabelled, title="Conditions of the logs that the twin cannot show"))
    versions = facts.config.get("versions", {})
    software = [{"software": name, "version": str(value)} for name, value in versions.items()]
    tables.append(Table(software, title="Software"))
    return Section(
        "provenance",
        "Where does the data come from?",
        intro=" ".join(facts.missing),
        tables=tables,
        details=pretty(facts.config),
        details_title="The full configuration of the run",
    )
