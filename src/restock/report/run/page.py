"""The page of a run: facts to headline, cards and sections. The template only lays them out."""

from __future__ import annotations

import base64
from typing import Any

from markupsafe import Markup

from restock.errors import RestockError, counted, policy_words
from restock.files import read_json
from restock.report.look import blocks, charts, floor_map
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
from restock.report.look.floor_map import FloorMap
from restock.report.run.facts import CELL_M, NO_GOAL, Facts
from restock.report.run.fed import actions_section, practice_section, sampled
from restock.report.run.headline import headline, judged_section, lead, losses, off_policy_table
from restock.report.run.twin_gap import run_section
from restock.train.run.kept_evaluations import cell_name, measured_row


def page(facts: Facts) -> dict[str, Any]:
    """Return everything that the page's template needs."""
    sections = [
        success(facts) if facts.twin else judged_section(facts),
        ways_section(facts),
        films_section(facts),
        sampled(facts),
        practice_section(facts),
        actions_section(facts),
        learning(facts),
        critic(facts),
        floor_section(facts),
        run_section(facts),
        provenance(facts),
    ]
    return {
        "kicker": "run report",
        "title": facts.run.name,
        "headline": headline(facts),
        "lead": lead(facts),
        "cards": _cards(facts),
        "sections": sections,
        "source": str(facts.run),
    }


def _cards(facts: Facts) -> list[dict[str, str]]:
    cards = []
    if facts.panel is not None:
        header = facts.panel.header
        cards.append({"value": f"{header.rows:,}", "label": f"logged rows in panel {header.id}"})
    if facts.twin:
        ring = facts.config.get("config", {}).get("replay", {}).get("ring_capacity", 0)
        cards += [
            {"value": f"{ring:,}", "label": "capacity of the fresh ring, rows"},
            {"value": _sampling(facts), "label": "of the rows fed from logs"},
            {"value": f"{facts.trained['env_steps']:,}", "label": "environment steps"},
        ]
    return [
        *cards,
        {"value": f"{facts.trained['gradient_steps']:,}", "label": "updates"},
        {"value": facts.target_rule, "label": "target rule"},
    ]


def _sampling(facts: Facts) -> str:
    if facts.panel is None and not facts.fed:
        return "0 %"
    rows = sum(row["drawn_rows"] for row in facts.sampled)
    logged = sum(row["drawn_rows"] for row in facts.sampled if row["source"] == "logs")
    return f"{logged / rows:.0%}" if rows else "?"


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
            **measured_row(row),
        }
        for row in sorted(shown, key=lambda row: (places[_place(row)], row["policy"] != OWN))
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
    shown, before = [], None
    for row in rows:
        kind = row["kind of episode"]
        shown.append(row | {"perturbation": "", "kind of episode": "" if kind == before else kind})
        before = kind
    clean = perturbation == "clean"
    return Table(
        shown,
        title="Success, return and safety side by side" + ("" if clean else f": {perturbation}"),
        caption="Intervals are 95 % over episodes. People include forklifts; the distance is "
        "the true one from the edge of the body. Time lost to the planner is over the missions in "
        "which both arrived."
        if clean
        else "",
        folded=not clean,
    )


def _cell_order(row: dict[str, Any]) -> tuple[str, int, str]:
    known = list(blocks.CONDITION_COLOURS)
    condition = row["cell"].split(" (")[0]
    place = known.index(condition) if condition in known else len(known)
    return (row["perturbation"] if row["perturbation"] != "none" else "", place, row["cell"])


def _place(row: dict[str, Any]) -> tuple[str, str]:
    return row["perturbation"], row["cell"]


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
        tables.append(Table(rows, title="Recordings"))
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


OWN = "agent"


def ways_section(facts: Facts) -> Section | None:
    """Show logged routes; None if none was driven, or nothing else was."""
    if not facts.ways:
        return None
    rows = sorted(
        facts.ways,
        key=lambda row: (
            *(row["perturbation"] != "none", row["cell"] != "nominal", row["cell"]),
            *(row["policy"] != OWN, row["policy"]),
        ),
    )
    names = policy_words(row["policy"] for row in rows)
    shown: list[dict[str, Any]] = [
        {
            "kind of episode": words(row["cell"])
            + ("" if row["perturbation"] == "none" else f", {row['perturbation']}"),
            "policy": names[row["policy"]],
            **measured_row(row),
        }
        for row in rows
    ]
    return Section(
        "ways",
        "And on routes that robots really drove?",
        intro="Start and goal of logged episodes, each route once, on the floor of the logs"
        f" (`restock eval --missions logged`). {facts.evaluation_on_ways}",
        tables=[
            Table(
                shown,
                title="Success on logged routes",
                caption="Intervals are 95 % Wilson intervals over routes; with few routes they "
                "are wide.",
            )
        ],
    )


def floor_section(facts: Facts) -> Section | None:
    """Show on the map where the logs have been, and where the agent failed."""
    layout = facts.floor
    if layout is None:
        return None
    racks = [(r.x_min, r.y_min, r.x_max, r.y_max) for r in layout.racks]
    plan = FloorMap(layout.width_m, layout.depth_m, racks)
    failures = [
        row
        for row in facts.failures
        if row["perturbation"] == "none" and row["layout"] == layout.name
    ]
    conditions = {row["condition"] for row in [*facts.rare, *failures]}
    names = charts.ordered(
        [{"condition": name} for name in conditions], "condition", blocks.CONDITION_COLOURS
    )
    colours = blocks.palette(names)
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


FILMS, FILMS_FILE = "eval/films", "films.json"


def films_section(facts: Facts) -> Section | None:
    """Return the section of films; None if none are of this policy (`--video` makes them)."""
    folder = facts.run / FILMS
    if not (folder / FILMS_FILE).is_file():
        return None
    try:
        films = read_json(folder / FILMS_FILE)["films"]
        figures = [_film(facts, film) for film in films]
    except (RestockError, KeyError, TypeError, ValueError, OSError) as error:
        facts.missing.append(f"Films are not shown, since they could not be read: {error}")
        return None
    if not figures:
        return None
    return Section(
        "films",
        "What does it look like?",
        intro="Episodes of the evaluation, driven again with the same spec, policy and outcome. "
        "For each condition: the failure with the lowest return, and an episode in which the "
        "agent succeeded and another policy did not; the film shows that one to its left. Seen "
        "from above: the robot is orange, its path a line, its plan dashed, the goal green; people "
        "are blue, forklifts yellow, pallets brown, slippery floor light blue.",
        figures=figures,
        two=True,
    )


def _film(facts: Facts, film: dict[str, Any]) -> Figure:
    data = base64.b64encode((facts.run / FILMS / str(film["file"])).read_bytes()).decode()
    other = film["rescued_from"]
    how = (
        f"arrived after {film['time_s']:.1f} s, where {policy_words([other])[other]} did not"
        f" ({film['other_failure']})"
        if film["success"]
        else f"{film['failure']} after {film['time_s']:.1f} s"
    )
    name = words(cell_name(film["condition"], film["block"]))
    return Figure(
        title=f"{name}: {film['kind']}",
        caption=f"Seed {film['episode_seed']}, policy {film['version']}: {how}; "
        f"{counted(film['bumps'], 'bump')}. The file is {FILMS}/{film['file']}.",
        moving=f"data:image/webp;base64,{data}",
    )
