"""The other sections: success, learning, the critic's health, the map, provenance."""

from __future__ import annotations

from typing import Any

from markupsafe import Markup

from restock.report import charts, floor
from restock.report.blocks import Section, count, estimate, section, table, target_rule
from restock.report.charts import words
from restock.report.facts import CELL_M, Facts, Rows, pretty, span


def success(facts: Facts) -> Section | None:
    if not facts.cells:
        return None
    cells = sorted(facts.cells, key=_cell_order)
    worst = "; ".join(_regressions(facts))
    rows = [
        {
            "policy": row["policy"],
            "perturbation": "clean" if row["perturbation"] == "none" else row["perturbation"],
            "kind of episode": words(row["cell"]),
            "success": f"{row['success']:.0%}",
            "95 % interval": f"{row['low']:.0%} to {row['high']:.0%}",
            "episodes": row["episodes"],
            "collisions per episode": f"{row['bumps']:.2f}",
            "time to goal": "" if row["time_s"] is None else f"{row['time_s']:.1f} s",
            "return": f"{row['mean_return']:.2f}",
        }
        for row in cells
    ]
    shown = [
        {
            **{key: row[key] for key in ("policy", "success", "low", "high")},
            "cell": words(row["cell"]),
            "perturbation": "clean" if row["perturbation"] == "none" else row["perturbation"],
        }
        for row in cells
    ]
    return section(
        "success",
        "Does it reach the goal?",
        intro="Success per kind of episode, on the same seeded episodes for every policy, clean and"
        " under each perturbation. Lines are 95 % Wilson intervals.",
        callout=worst,
        figures=[{"svg": charts.success(shown)}],
        tables=[
            table(
                [row for row in rows if row["policy"] == "agent"],
                numbers={
                    "success",
                    "95 % interval",
                    "episodes",
                    "collisions per episode",
                    "time to goal",
                    "return",
                },
                title="The agent, cell by cell",
            )
        ],
    )


def _cell_order(row: dict[str, Any]) -> tuple[str, int, str]:
    known = list(charts.CONDITION_COLOURS)
    condition = row["cell"].split(" (")[0]
    place = known.index(condition) if condition in known else len(known)
    return (row["perturbation"] if row["perturbation"] != "none" else "", place, row["cell"])


def _regressions(facts: Facts) -> list[str]:
    """Where the agent is clearly worse than the planner: the intervals do not overlap."""
    planner = {
        (row["perturbation"], row["cell"]): row for row in facts.cells if row["policy"] == "planner"
    }
    said = []
    for row in facts.cells:
        other = planner.get((row["perturbation"], row["cell"]))
        if row["policy"] == "agent" and other is not None and row["high"] < other["low"]:
            where = "" if row["perturbation"] == "none" else f" under {row['perturbation']}"
            said.append(
                f"Worse than the planner in {words(row['cell'])}{where}: {row['success']:.0%}"
                f" against {other['success']:.0%}"
            )
    return said


def learning(facts: Facts) -> Section:
    figures = []
    marker = float(facts.kept["env_steps"]) if facts.kept else None
    if facts.learning:
        figures.append(
            {
                "title": "Greedy success on fixed episodes",
                "svg": charts.lines(
                    [{**row, "condition": words(row["condition"])} for row in facts.learning],
                    x="env_steps",
                    y="success",
                    series="condition",
                    x_title="environment steps",
                    y_title="success",
                    colours={words(k): v for k, v in charts.CONDITION_COLOURS.items()},
                    percent=True,
                    points=True,
                    marker=marker,
                ),
                "caption": "The checkpoint that is kept is the best of these evaluations,"
                " never simply the last.",
            }
        )
    figures.append(
        {
            "title": "Loss",
            "svg": charts.lines(
                facts.loss,
                x="gradient_steps",
                y="loss",
                series="phase",
                x_title="updates",
                y_title="Huber loss",
                colours={"offline": "#334155", "warmup": "#94a3b8", "online": "#14b8a6"},
            ),
            "caption": "A low loss alone says little: a frozen target has the lowest loss of all.",
        }
    )
    return section(
        "learning",
        "How did it learn?",
        figures=figures,
        two=True,
        tables=_off_policy(facts.off_policy),
    )


def _off_policy(rows: Rows) -> list[dict[str, Any]]:
    """Off-policy estimates, where a run has them."""
    if not rows:
        return []
    shown = [
        {
            "measure": row["measure"],
            "estimator": row["estimator"],
            "value [95 %]": estimate(row),
            "episodes": row["episodes"],
        }
        for row in rows
    ]
    return [
        table(
            shown,
            numbers={"episodes"},
            title="Off-policy evaluation on held-out logs, before it drove",
            caption="Over all conditions; an estimate is refused where the weights leave too few"
            " episodes to say.",
        )
    ]


def critic(facts: Facts) -> Section | None:
    figures = []
    if facts.td:
        figures.append(
            {
                "title": "TD error by condition",
                "svg": charts.lines(
                    facts.td,
                    x="gradient_steps",
                    y="td_abs_mean",
                    series="condition",
                    x_title="updates",
                    y_title="mean |TD error| on a fixed probe",
                ),
                "caption": "On the same rows at every point. A condition that stays high while"
                " the others fall is one that the buffer does not teach.",
            }
        )
    lag = [row for row in facts.lag if row["target_q_lag"] is not None]
    if lag:
        figures.append(
            {
                "title": "How far the target is behind",
                "svg": charts.lines(
                    [{**row, "what": "relative value lag"} for row in lag],
                    x="gradient_steps",
                    y="target_q_lag",
                    series="what",
                    x_title="updates",
                    y_title="mean |Q − Q target| / mean |Q|",
                    colours={"relative value lag": "#0f766e"},
                ),
                "caption": f"Target rule: {target_rule(facts)}. Near zero the target keeps up;"
                " above about a quarter it holds learning back.",
            }
        )
    return (
        section("critic", "Is the critic healthy?", figures=figures, two=True) if figures else None
    )


def floor_map(facts: Facts) -> Section | None:
    layout = facts.floor
    if layout is None:
        return None
    racks = [(r.x_min, r.y_min, r.x_max, r.y_max) for r in layout.racks]
    plan = floor.Floor(layout.width_m, layout.depth_m, racks)
    failures = [
        row
        for row in facts.failures
        if row["perturbation"] == "none" and row["layout"] == layout.name
    ]
    conditions = {row["condition"] for row in facts.rare} | {row["condition"] for row in failures}
    known = [name for name in charts.CONDITION_COLOURS if name in conditions]
    return section(
        "map",
        "Where did it happen?",
        figures=[
            {
                "title": "Where the logs have been",
                "svg": floor.visited(plan, facts.visited, CELL_M),
                "caption": f"{sum(row['rows'] for row in facts.visited):,} logged steps in cells of"
                f" {CELL_M} m, darker where there are more (logarithmic). Drawn on the floor that"
                f" the run drives on, {layout.name}.",
            },
            {
                "title": "Rare conditions in the logs (dots), the agent's failures (crosses)",
                "svg": floor.events(plan, facts.rare, failures),
                "caption": Markup(floor.legend(known + sorted(conditions - set(known))))
                + Markup("<br>")
                + f"{len(failures)} failed clean episodes there.",
            },
        ],
        two=True,
    )


def provenance(facts: Facts) -> Section:
    config = facts.config
    tables = []
    if facts.panel is not None:
        header = facts.panel.header
        pins = [
            ("panel", header.id),
            ("store", f"{header.store}, version {header.store_version}"),
            ("task", header.task_hash),
            ("labels", header.labels_version),
            ("left out of the panel", _left_out(header.left_out)),
        ]
        tables.append(table([{"pinned": name, "value": value} for name, value in pins]))
    if facts.recordings:
        tables.append(
            table(
                [
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
                ],
                numbers={"length", "episodes", "transitions"},
                title="Recordings",
            )
        )
    versions = config.get("versions", {})
    tables.append(
        table(
            [{"software": name, "version": str(value)} for name, value in versions.items()],
            title="Software",
        )
    )
    return section(
        "provenance",
        "Where does all of this come from?",
        intro=" ".join(facts.missing),
        tables=tables,
        details=pretty(config),
        details_title="The whole configuration of the run",
    )


def _left_out(counts: dict[str, int]) -> str:
    said = [f"{count:,} {reason}" for reason, count in counts.items() if count]
    return ", ".join(said) or "nothing"
