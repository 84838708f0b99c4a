"""The page of a run: turns facts into a headline and sections, which the template lays out."""

from __future__ import annotations

import base64
from collections import Counter
from typing import Any

import msgspec
from markupsafe import Markup

from restock.errors import RestockError, counted, policy_words
from restock.files import read_json
from restock.replay.plan.exclusions import DAY_NS
from restock.replay.sampling.rules import RULES
from restock.report.look import charts, floor_map
from restock.report.look.blocks import Figure, Rows, Section, Table, cell, pretty, shown, words
from restock.report.run.facts import NO_GOAL, Facts, evaluation_bias
from restock.report.run.headline import headline, judged_section, lead, losses, off_policy_table
from restock.report.run.twin_gap import run_section
from restock.train.run.kept_evaluations import cell_name, measured_row

# Column -> title, for the tables on the page and on the replay card.
FED = {
    "stratum": "stratum",
    **{f"{name}_share": name for name in ("natural", "wanted", "drawn")},
    **{"logs_share": "from logs", "fresh_share": "fresh", "short_share": "short"},
    "reason": "why short",
}
AGES = {name: name for name in ("source", "unit", "rows", "p50", "p90", "p99")}
POLICIES = {"source": "source", "behaviour_policy": "policy", "rows": "rows", "share": "share"}
PRACTICE = {
    **{"arm": "missions", "natural_share": "natural", "first_share": "wanted at first"},
    **{"last_share": "wanted at last", "given_share": "given", "episodes": "ended"},
}
SHARE_COLOURS = {"natural": "#cbd5e1", "wanted": "#94a3b8", "drawn": "#0f766e"}


def page(facts: Facts) -> dict[str, Any]:
    """Return the content of the page, for `write_page`."""
    return {
        "kicker": "run report",
        "title": facts.run.name,
        "headline": headline(facts),
        "lead": lead(facts),
        "sections": [
            success(facts) if facts.twin else judged_section(facts),
            films_section(facts),
            sampled(facts),
            practice_section(facts),
            learning(facts),
            floor_section(facts),
            run_section(facts),
            provenance(facts),
        ],
        "source": str(facts.run),
    }


def success(facts: Facts) -> Section | None:
    """Show each policy's success by kind of episode; None if nothing was evaluated."""
    if not facts.cells:
        return None
    cells = _evaluated(facts.cells)
    tables = [
        _measures(
            [row for row in cells if row["perturbation"] == name and row["policy"] != "random"],
            "Success, return and safety side by side" + ("" if name == "clean" else f": {name}"),
            "Intervals are 95 % over episodes. People include forklifts; the distance to them is "
            "the true one between the edges of the bodies. Time lost to the planner is over the "
            "missions that both completed."
            if name == "clean"
            else "",
            folded=name != "clean",
        )
        for name in dict.fromkeys(row["perturbation"] for row in cells)
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
        figures=[] if facts.no_goal else [Figure(charts.success(cells))],
        tables=tables,
    )


def _evaluated(cells: Rows) -> Rows:
    """Return the cells of an evaluation in the page's order, with names as words."""
    names = policy_words(row["policy"] for row in cells)
    ordered = sorted(
        cells,
        key=lambda row: (
            *(row["perturbation"] != "none", row["perturbation"]),
            *(row["condition"] != "nominal", row["condition"]),
            *(row["policy"] != "agent", row["policy"]),
        ),
    )
    return [
        row
        | {"policy": names[row["policy"]], "condition": words(row["condition"])}
        | {"perturbation": "clean" if row["perturbation"] == "none" else row["perturbation"]}
        for row in ordered
    ]


def _measures(rows: Rows, title: str, caption: str, *, folded: bool = False) -> Table:
    measured = [
        {"kind of episode": row["condition"], "policy": row["policy"], **measured_row(row)}
        for row in rows
    ]
    return Table(measured, title, caption, folded)


def sampled(facts: Facts) -> Section:
    """Show what the critic was fed: the section that matters most."""
    rows: Rows = [
        {"stratum": words(row["stratum"]), "kind": kind, "share": row[f"{kind}_share"]}
        for row in facts.fed
        for kind in SHARE_COLOURS
    ]
    figures = [Figure(charts.shares(rows, "stratum", SHARE_COLOURS))] if rows else []
    return Section(
        "fed",
        "What was the critic fed?",
        intro="The replay mix is the training distribution. A quota is a stratum's share of the "
        "batch, whether its rows are logged or fresh. Natural: the share under uniform draws from "
        "the same sources. Wanted: the quota. Drawn: the share of all rows fed in the whole run.",
        callout=evaluation_bias(facts),
        figures=figures,
        tables=[
            Table(shown(facts.fed, FED)),
            Table(
                [
                    {"of the run": key, "": in_words(rule)}
                    for key, rule in feed_rules(facts).items()
                ],
                title="By which rules",
            ),
            Table(
                shown(facts.ages, AGES),
                title="How old the sampled rows were",
                caption="Upper ends of log2 buckets: days before training began for logs"
                f"{_newest(facts)}, environment steps since they were collected for fresh rows.",
            ),
            Table(shown(facts.policies, POLICIES), title="Who drove the sampled rows"),
        ],
    )


def feed_rules(facts: Facts) -> dict[str, Any]:
    """Return capacity, sampling rule and target rule; None for a value that the run lacks."""
    settings, panel = facts.config.get("config", {}), facts.panel
    replay = settings.get("replay", {})
    mixture = msgspec.to_builtins(panel.header.mixture) if panel is not None else None
    return {
        "capacity": {
            "ring_rows": replay.get("ring_capacity"),
            "panel_rows": len(panel) if panel is not None else None,
            "panel": (facts.config.get("panel") or {}).get("id"),
            "store_version": panel.header.store_version if panel is not None else None,
        },
        "sampling": {
            "batch_size": replay.get("batch_size"),
            "logs_share": _drawn_share(facts, "logs"),
            "logs": _rule(mixture),
            "fresh": _fresh_rule(facts, mixture),
            "n_step": {
                "logs": panel.n_step if panel is not None else None,
                "fresh": settings.get("loss", {}).get("n_step"),
            },
        },
        "target": facts.config.get("target") or settings.get("target"),
    }


def _rule(mixture: dict[str, Any] | None) -> str | None:
    """Describe how the logged part of a batch is drawn; None without a panel."""
    if mixture is None:
        return None
    name = str(mixture.get("within", "uniform"))
    within = RULES[name].doc if name in RULES else name
    cap = mixture.get("max_replays_per_row")
    most = f", a row at most {cap:g} times" if cap else ""
    return f"quotas by stratum, within a stratum {within}{most}"


def _fresh_rule(facts: Facts, mixture: dict[str, Any] | None) -> str | None:
    """Describe how the fresh part of a batch was drawn; None if no fresh row was drawn."""
    if not _drawn_share(facts, "fresh"):
        return None
    rules = [] if mixture is None else [*mixture["strata"], mixture["each_condition"] or {}]
    by_quota = any(rule.get("share", "natural") != "natural" for rule in rules)
    return "quotas by stratum, within a stratum uniform" if by_quota else "uniform over the ring"


def _drawn_share(facts: Facts, source: str) -> float | None:
    rows = sum(row["drawn_rows"] for row in facts.sampled)
    of_source = sum(row["drawn_rows"] for row in facts.sampled if row["source"] == source)
    return of_source / rows if rows else None


def in_words(value: Any, name: str = "", *, inside: bool = False) -> str:
    """Format a JSON document as one line of text."""
    if isinstance(value, dict):
        between, after = (", ", " ") if inside else ("; ", ": ")
        parts = [f"{words(key)}{after}{in_words(v, key, inside=True)}" for key, v in value.items()]
        return between.join(parts) or "none"
    if isinstance(value, list | tuple):
        return " and ".join(map(in_words, value)) or "none"
    if value is None or isinstance(value, bool):
        return "yes" if value else "no" if value is False else "none"
    return cell(name, value)


def _newest(facts: Facts) -> str:
    """Describe the age of the panel's newest row when training began; empty if unknown."""
    began_ns = facts.config.get("created_ns")
    if facts.panel is None or began_ns is None:
        return ""
    days = (began_ns - facts.panel.header.newest_ns) / DAY_NS
    return f" (the panel's newest row was {days:,.1f} days old then)"


def practice_section(facts: Facts) -> Section | None:
    """Return the section on practice; None if the run has no record of it."""
    if not facts.practice:
        return None
    return Section(
        "practice",
        "What did it practise?",
        intro=f"Missions in the twin, by the rule “{facts.practice[0]['rule']}”. Shares are of "
        "missions that ended while the agent explored; its success is lower there than in "
        "evaluations.",
        tables=[Table(shown(facts.practice, PRACTICE | {"success": "success, exploring"}))],
    )


def learning(facts: Facts) -> Section:
    """Show success and loss over training, and how the critic's errors and target behaved."""
    figures, policy = [], facts.policy
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
    if facts.lag:
        figures.append(
            Figure(
                charts.lines(
                    facts.lag,
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
    tables = [off_policy_table(facts.off_policy)] if facts.off_policy and facts.twin else []
    return Section("learning", "How did it learn?", figures=figures, two=True, tables=tables)


def provenance(facts: Facts) -> Section:
    """Show what the panel was made of, what could not be read, and the configuration."""
    pins = {}
    if facts.panel is not None:
        header = facts.panel.header
        left_out = [f"{count:,} {reason}" for reason, count in header.left_out.items() if count]
        pins = {
            "panel": f"{header.id}, {counted(header.rows, 'row')}",
            "store": f"{header.store}, version {header.store_version}",
            "task": header.task_hash,
            "labels": header.labels_version,
            "left out of the panel": ", ".join(left_out) or "nothing",
            "held out to evaluate on": header.split_note
            or words(header.split_by or header.mixture.evaluation_split.by),
        }
    unlabelled = [
        {"condition": words(name), "not labelled in the twin, which has no": ", ".join(signals)}
        for name, signals in facts.config.get("not_evaluated", {}).items()
    ]
    return Section(
        "provenance",
        "Where does the data come from?",
        intro=" ".join(facts.missing),
        tables=[
            Table([{"pinned": name, "value": value} for name, value in pins.items()]),
            Table(unlabelled, title="Conditions of the logs that the twin cannot show"),
        ],
        details=pretty(facts.config),
        details_title="The full configuration of the run, and the versions of its software",
    )


def floor_section(facts: Facts) -> Section | None:
    """Show where the agent failed without a perturbation, on the floor with the most failures.

    None if it did not fail on a known floor.
    """
    clean = [row for row in facts.failures if row["perturbation"] == "none"]
    names = {floor.name for floor in facts.floors}
    failed = Counter(row["layout"] for row in clean if row["layout"] in names)
    if not failed:
        return None
    ((name, episodes),) = failed.most_common(1)
    layout = next(floor for floor in facts.floors if floor.name == name)
    drawing, legend = floor_map.draw(
        (layout.width_m, layout.depth_m),
        [(r.x_min, r.y_min, r.x_max, r.y_max) for r in layout.racks],
        failures=[row for row in clean if row["layout"] == name],
    )
    notes = [
        f"Crosses are the ends of the agent's {counted(episodes, 'failed clean episode')}; the bar"
        f" is {floor_map.BAR_M} m. Drawn on the floor {name}."
    ]
    if layout.starts_m:
        notes.append(
            f"Its missions start at {len(layout.starts_m)} places where the robot was in the logs, "
            f"and go to {len(layout.goals)}."
        )
    caption = legend + Markup("<br>") + " ".join(notes)
    return Section("map", "Where did it fail?", figures=[Figure(drawing, caption=caption)])


FILMS, FILMS_FILE = "eval/films", "films.json"


def films_section(facts: Facts) -> Section | None:
    """Return the section of films; None if there are none (`restock eval --video` makes them)."""
    folder = facts.run / FILMS
    if not (folder / FILMS_FILE).is_file():
        return None
    try:
        figures = [_film(facts, film) for film in read_json(folder / FILMS_FILE)["films"]]
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
        "agent succeeded and another policy did not; that film shows the other policy on the left. "
        "Seen from above: the robot is orange, its path a line, its plan dashed, the goal green; "
        "people are blue, forklifts yellow, pallets brown, slippery floor light blue.",
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
