"""The page of a folder: its runs in the order they began, what changed, and its stores by week."""

from __future__ import annotations

import itertools
import os
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import altair as alt
import pyarrow.compute as pc

from restock.errors import RestockError, RunError, counted
from restock.ingest.store.location import Location
from restock.replay.places import kind_beside
from restock.replay.store.definitions import install_named
from restock.replay.store.store import Store, is_store
from restock.report.fleet.coverage import coverage_weeks
from restock.report.look import blocks, charts
from restock.report.look.blocks import Figure, Rows, Section, Table, ask, count, named, words
from restock.stats import interval_text
from restock.train.judge.compare import diff_runs, last_evaluation
from restock.train.run.kept_evaluations import shown_evaluation, summary_rows
from restock.train.run.replay_audit import fed_shares
from restock.train.run.run import Run

DEPTH = 3  # folders below the one that was named in which runs and stores are looked for
MAX_SETTINGS = 6  # settings that are named in a line
_SOFTWARE = ("free", "software")  # kinds of settings that change no result by intent
_WEEKS = """
    SELECT week, condition, sum(hours)::DOUBLE AS hours, sum(rows_held)::BIGINT AS rows_held,
           sum(events)::BIGINT AS events, sum(successes)::BIGINT AS successes,
           sum(goal_episodes)::BIGINT AS goal_episodes
    FROM coverage_by_week GROUP BY week, condition ORDER BY week, condition
"""


def history_page(folder: Path) -> dict[str, Any]:
    """Return everything that the page's template needs.

    Runs that cannot be read are named on the page. Without a store in the folder, the stores that
    the runs' panels were mixed from are shown.

    Raises:
        RunError: there is neither a run nor a store in the folder.
    """
    runs, stores, missing = _found(folder)
    if not runs and not stores:
        raise RunError(
            "holds no run and no store" if folder.is_dir() else "no such folder",
            where=str(folder),
            remedy="give a run (`restock train --out`), or a folder of runs and stores",
        )
    fed_from = dict.fromkeys((run.document.get("panel") or {}).get("store") for run in runs)
    if not stores:
        stores = [Path(place) for place in fed_from if place and is_store(place)]
    driven = [_success(run) for run in runs]
    changes = [_change(a, b) for a, b in itertools.pairwise(runs)]
    return {
        "kicker": "runs and weeks",
        "title": folder.resolve().name,
        "headline": _headline(runs, changes, stores),
        "lead": "Runs are in the order in which they began, each beside the run before it.",
        "cards": [
            {"value": count(len(runs)), "label": "runs"},
            {"value": count(len(stores)), "label": "stores"},
        ],
        "sections": [
            _runs(runs, driven),
            _changes(runs, changes),
            _fed(runs),
            *(section for place in stores for section in _weeks(place)),
            Section("missing", "What could not be read", tables=[Table(missing)])
            if missing
            else None,
        ],
        "source": str(folder),
    }


def _found(folder: Path) -> tuple[list[Run], list[Path], Rows]:
    """Return the runs of a folder by when they began, its stores, and what cannot be read."""
    runs, stores, missing = [], [], []
    for name, below, files in os.walk(folder, followlinks=True):
        place = Path(name)
        kind = kind_beside(place)
        if kind == "run" and "progress.parquet" in files:
            try:
                runs.append(Run.open(place))
            except RestockError as error:
                missing.append({"run": str(place), "why": str(error)})
        elif is_store(Location.of(place)):
            stores.append(place)
        elif kind != "panel" and len(place.relative_to(folder).parts) < DEPTH:
            below[:] = sorted(one for one in below if not one.startswith("."))
            continue
        below.clear()
    return sorted(runs, key=_began), stores, missing


def _began(run: Run) -> int:
    return int(run.document.get("created_ns") or 0)


def _names(runs: list[Run]) -> list[str]:
    """Name runs by their folders, and by more of their paths where those are alike."""
    names = [run.path.name for run in runs]
    return [
        name if names.count(name) == 1 else "/".join(run.path.parts[-2:])
        for name, run in zip(names, runs, strict=True)
    ]


def _success(run: Run) -> tuple[str, Rows]:
    """Return who drove, and success by condition: `restock eval`, else training's last one."""
    evaluated, _ = shown_evaluation(run.path)
    rows = evaluated.filter(
        pc.and_(pc.equal(evaluated["policy"], "agent"), pc.equal(evaluated["perturbation"], "none"))
    ).to_pylist()
    if rows:
        return "restock eval", summary_rows(rows)
    try:
        rows = last_evaluation(run).to_pylist()
    except RunError:
        return "not yet", []
    own = {"policy": "agent", "perturbation": "none"}
    unknown = dict.fromkeys(("time_lost_s", "limited_s", "stopped_s"))
    return "training", summary_rows(row | own | unknown for row in rows)


def _change(before: Run, run: Run) -> dict[str, Any]:
    """Return what `restock coverage diff` finds between two runs, or why it cannot."""
    try:
        return diff_runs(before.path, run.path)
    except RestockError as error:
        return {"why": str(error), "settings": [], "evaluation": []}


def _headline(runs: list[Run], changes: Rows, stores: list[Path]) -> str:
    """Say what the last run does better or worse than the one before it."""
    if not changes:
        return f"{counted(len(runs), 'run')}, {counted(len(stores), 'store')}"
    before, last = _names(runs)[-2:]
    outcome = _outcome(changes[-1])
    return (
        f"{last}, the latest run, against {before}: {outcome or 'no difference of success shown'}"
    )


def _outcome(change: dict[str, Any]) -> str:
    """Name the conditions whose success differs, by the interval of the paired episodes."""
    if "why" in change:
        return f"not compared: {change['why']}"
    shown = [
        row | {"condition": f"{row['condition']}{_under(row['perturbation'])}"}
        for row in change["evaluation"]
        if row.get("difference_low") is not None
        and (row["difference_low"] > 0 or row["difference_high"] < 0)
    ]
    parts = (
        ("better", [row for row in shown if row["difference"] > 0]),
        ("worse", [row for row in shown if row["difference"] < 0]),
    )
    return "; ".join(f"{word} in {named(rows)}" for word, rows in parts if rows)


def _under(perturbation: str) -> str:
    return "" if perturbation in ("none", "nominal") else f" under {perturbation}"


def _runs(runs: list[Run], driven: list[tuple[str, Rows]]) -> Section | None:
    if not runs:
        return None
    names = _names(runs)
    table, dots = [], []
    for name, run, (by, cells) in zip(names, runs, driven, strict=True):
        panel, progress = run.document.get("panel") or {}, run.table("progress")
        steps = progress["env_steps"][-1].as_py() if progress.num_rows else 0
        table.append(
            {
                "run": name,
                "began": f"{datetime.fromtimestamp(_began(run) / 1e9, UTC):%Y-%m-%d %H:%M}",
                "logs": f"{Path(panel['store']).name}@{panel['store_version']}"
                if panel
                else "none",
                "logged rows": count(panel.get("rows")),
                "environment steps": count(steps),
                "driven by": by,
                "episodes": count(sum(row["episodes"] for row in cells)),
                **{
                    words(row["condition"]): interval_text(
                        row["success"], row["success_low"], row["success_high"]
                    )
                    for row in cells
                    if row["success"] is not None
                },
            }
        )
        dots += [row | {"run": name} for row in cells if row["success"] is not None]
    columns = dict.fromkeys(column for row in table for column in row)
    return Section(
        "runs",
        "Which runs, and how well do they drive?",
        intro="Success by condition with 95 % Wilson intervals, unperturbed: of `restock eval` if"
        " there is one, else of the last evaluation in training. Runs may have driven other"
        " missions: the table below counts only those that both of a pair drove.",
        figures=[Figure(_dots(dots), "Success by run and condition")] if dots else [],
        tables=[Table([dict.fromkeys(columns, "") | row for row in table])],
    )


def _dots(rows: Rows) -> blocks.Drawing:
    shown = charts.in_words(rows)
    return charts.estimates(
        shown,
        y="run",
        series="condition",
        names=charts.ordered(shown, "condition", blocks.WORDS_COLOURS),
        colours=blocks.WORDS_COLOURS,
        value="success",
        ends=("success_low", "success_high"),
        title="success",
        x_scale=alt.Scale(domain=[0, 1]),
    )


def _changes(runs: list[Run], changes: Rows) -> Section | None:
    if not changes:
        return None
    names = _names(runs)
    table = [
        {
            "run": name,
            "against": before,
            "settings": _settings(change["settings"]),
            "logs": "" if "why" in change else _logs(change["panels"]),
            "success": _outcome(change) or "no difference shown",
            "restock compare": "" if "why" in change else change["comparable"]["algorithm"],
        }
        for (before, name), change in zip(itertools.pairwise(names), changes, strict=True)
    ]
    return Section(
        "changed",
        "What changed from run to run?",
        intro="Each run beside the one before it: settings, rows of the panel, and conditions"
        " whose success differs by the 95 % interval over the missions that both drove. Another"
        " training seed may change as much. `restock coverage diff RUN RUN` prints the whole.",
        tables=[Table(table)],
    )


def _settings(differences: Rows) -> str:
    """Name the settings that differ, with both values; those of the panel are in another column."""
    shown = [
        f"{row['setting'].removeprefix('config.')} {row['first']} → {row['second']}"
        for row in differences
        if row["kind"] not in _SOFTWARE and not row["setting"].startswith("panel.")
    ]
    more = len(shown) - MAX_SETTINGS
    return "; ".join(shown[:MAX_SETTINGS] + [f"{more} more"] * (more > 0)) or "the same"


def _logs(panels: dict[str, Any] | None) -> str:
    if panels is None:
        return "the same panel"
    if "note" in panels:
        return str(panels["note"])
    rows = panels["rows"]
    return f"{rows['in']:,} rows in, {rows['out']:,} out, {rows['both']:,} in both"


def _fed(runs: list[Run]) -> Section | None:
    table = [
        {"run": name}
        | {
            words(row["stratum"]): f"{row['drawn_share']:.1%} (of {row['wanted_share']:.1%})"
            for row in fed_shares(run)
        }
        for name, run in zip(_names(runs), runs, strict=True)
    ]
    strata = dict.fromkeys(name for row in table for name in row)
    if len(strata) == 1:
        return None
    return Section(
        "fed",
        "What was each critic fed?",
        intro="Share of all rows fed, and the share that its mixture wanted.",
        tables=[Table([dict.fromkeys(strata, "") | row for row in table])],
    )


def _weeks(place: Path) -> list[Section]:
    """Return the sections of one store: its weeks, drawn and as a table."""
    with Store(place) as store:
        install_named(store.connection, _WEEKS)
        rows = ask(store.connection, _WEEKS)
        drawn = coverage_weeks(store)
    if not rows or drawn is None:
        return []
    weeks: dict[Any, dict[str, Any]] = {}
    for row in rows:
        week = "not known" if row["week"] is None else str(row["week"])
        line = weeks.setdefault(week, {"week": week, "hours": f"{row['hours'] or 0:.2f}"})
        name = words(row["condition"])
        line[name] = f"{row['events']:,} events" if row["events"] else f"{row['rows_held']:,} rows"
        if row["goal_episodes"]:
            line[name] += f", {row['successes']} of {row['goal_episodes']} arrived"
    columns = dict.fromkeys(column for line in weeks.values() for column in line)
    table = Table([dict.fromkeys(columns, "") | line for line in weeks.values()])
    title = f"{place.name}: week by week"
    return [replace(drawn, id=f"weeks-{place.name}", title=title, tables=[table])]
