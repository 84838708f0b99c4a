"""The page about a folder: its runs in order of start, what changed, and its stores by week."""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from restock.errors import RestockError, RunError, counted
from restock.ingest.store.location import Location
from restock.replay.places import kind_beside
from restock.replay.store.store import Store, is_store
from restock.report.fleet.coverage import coverage_weeks
from restock.report.look.blocks import Rows, Section, Table, better_and_worse, count, words
from restock.stats import interval_text
from restock.train.evaluation.paired import agent_episodes
from restock.train.judge.compare import diff_runs, last_evaluation
from restock.train.run.kept_evaluations import summary_rows
from restock.train.run.replay_audit import fed_shares
from restock.train.run.run import Run

DEPTH = 3  # levels of subfolders that are searched for runs and stores
MAX_SETTINGS = 6  # settings named in one line
CLEAN = ("none", "nominal")  # both mean "without a perturbation"
_SOFTWARE = ("free", "software")  # kinds of settings that should not change results
T = TypeVar("T")


class _RunSummary(NamedTuple):
    """What the page shows about a run."""

    run: Run
    env_steps: int
    by: str  # where `success` comes from: `restock eval`, training, or nowhere yet
    success: Rows  # one row per condition
    fed: Rows  # one row per stratum


def history_page(folder: Path) -> dict[str, Any]:
    """Return the content of the page, for `write_page`.

    Runs and stores that cannot be read are named on the page. If the folder has no store, the page
    shows the stores that the runs' panels were mixed from.

    Raises:
        RunError: there is neither a run nor a store in the folder.
    """
    found, stores = _find_places(folder)
    if not found and not stores:
        raise RunError(
            "holds no run and no store" if folder.is_dir() else "no such folder",
            where=str(folder),
            remedy="give a run (`restock train --out`), or a folder of runs and stores",
        )
    missing: Rows = []
    runs = sorted(_read(_read_run, found, missing), key=lambda one: _start_ns(one.run))
    fed_from = ((one.run.document.get("panel") or {}).get("store") for one in runs)
    weeks = list(
        _read(_weeks_section, stores or map(Path, filter(None, dict.fromkeys(fed_from))), missing)
    )
    changes = [_change(a.run, b.run) for a, b in itertools.pairwise(runs)]
    headline = f"{counted(len(runs), 'run')}, {counted(len(weeks), 'store')}"
    if changes:
        before, last = _names(runs)[-2:]
        headline = f"{last}, the latest run, against {before}: {_outcome(changes[-1])}"
    return {
        "kicker": "runs and weeks",
        "title": folder.resolve().name,
        "headline": headline,
        "lead": "Runs are in order of their start; each is compared with the run before it.",
        "sections": [
            _runs_section(runs),
            _changes_section(runs, changes),
            *weeks,
            Section("missing", "What could not be read", tables=[Table(missing)])
            if missing
            else None,
        ],
        "source": str(folder),
    }


def _find_places(folder: Path) -> tuple[list[Path], list[Path]]:
    """Find the runs and the stores of a folder."""
    runs, stores = [], []
    for name, below, files in os.walk(folder, followlinks=True):
        place = Path(name)
        kind = kind_beside(place)
        if kind == "run" and "progress.parquet" in files:
            runs.append(place)
        elif is_store(Location.of(place)):
            stores.append(place)
        elif kind != "panel" and len(place.relative_to(folder).parts) < DEPTH:
            below[:] = sorted(one for one in below if not one.startswith("."))
            continue
        below.clear()
    return runs, stores


def _read(read: Callable[[Path], T | None], places: Iterable[Path], missing: Rows) -> Iterator[T]:
    """Yield the result of `read` for each place; add places that cannot be read to `missing`."""
    for place in places:
        try:
            if (found := read(place)) is not None:
                yield found
        except RestockError as error:
            missing.append({"place": str(place), "why": str(error)})


def _start_ns(run: Run) -> int:
    return int(run.document.get("created_ns") or 0)


def _names(runs: Sequence[_RunSummary]) -> list[str]:
    """Name each run by its folder, and by the parent folder too if runs share the name."""
    paths = [one.run.path for one in runs]
    names = Counter(path.name for path in paths)
    return [path.name if names[path.name] == 1 else "/".join(path.parts[-2:]) for path in paths]


def _read_run(path: Path) -> _RunSummary:
    """Read a run. Success is from `restock eval`, or else from training's last evaluation."""
    run = Run.open(path)
    progress, by = run.table("progress"), "restock eval"
    steps = progress["env_steps"][-1].as_py() if progress.num_rows else 0
    if (driven := agent_episodes(run)) is None:
        evaluated = run.table("evaluations").num_rows
        by, driven = ("training", last_evaluation(run)) if evaluated else ("not yet", None)
    unknown = dict.fromkeys(("time_lost_s", "limited_s", "stopped_s"))
    clean = {"policy": "agent", "perturbation": "none"}
    rows = [
        unknown | row | clean
        for row in ([] if driven is None else driven.to_pylist())
        if row["perturbation"] in CLEAN
    ]
    return _RunSummary(run, steps, by, summary_rows(rows), fed_shares(run))


def _change(before: Run, run: Run) -> dict[str, Any]:
    """Return what differs between two runs, or why they cannot be compared."""
    try:
        return diff_runs(before, run)
    except RestockError as error:
        return {"why": str(error), "settings": [], "evaluation": []}


def _outcome(change: dict[str, Any]) -> str:
    """Name the conditions in which success differs: their paired interval excludes zero."""
    if "why" in change:
        return f"not compared: {change['why']}"
    shown = [
        row | {"condition": row["condition"] + (under not in CLEAN) * f" under {under}"}
        for row in change["evaluation"]
        for under in [row["perturbation"]]
        if row.get("difference_low") is not None
    ]
    return "; ".join(better_and_worse(shown)[0]) or "no difference shown"


def _runs_section(runs: Sequence[_RunSummary]) -> Section | None:
    if not runs:
        return None
    table = []
    for name, summary in zip(_names(runs), runs, strict=True):
        panel, began = summary.run.document.get("panel") or {}, _start_ns(summary.run) / 1e9
        logs = f"{Path(panel['store']).name}@{panel['store_version']}" if panel else "none"
        fed = [f"{words(row['stratum'])} {row['drawn_share']:.1%}" for row in summary.fed]
        table.append(
            {
                "run": name,
                "began": f"{datetime.fromtimestamp(began, UTC):%Y-%m-%d %H:%M}",
                "logs": logs,
                "logged rows": count(panel.get("rows")),
                "fed": ", ".join(fed),
                "environment steps": count(summary.env_steps),
                "driven by": summary.by,
                "episodes": count(sum(row["episodes"] for row in summary.success)),
                **{
                    words(row["condition"]): interval_text(
                        row["success"], row["success_low"], row["success_high"]
                    )
                    for row in summary.success
                    if row["success"] is not None
                },
            }
        )
    return Section(
        "runs",
        "Which runs, and how well do they drive?",
        intro="Fed: shares of all rows that the critic was fed. Success by condition without a"
        " perturbation, with 95 % Wilson intervals, from `restock eval` or else from the last"
        " evaluation in training. Runs may have driven different missions; the table below counts"
        " only missions that both runs of a pair drove.",
        tables=[_fill_columns(table)],
    )


def _fill_columns(rows: Rows) -> Table:
    """Return a table from rows with different columns; cells that a row lacks are empty."""
    columns = dict.fromkeys(column for row in rows for column in row)
    return Table([dict.fromkeys(columns, "") | row for row in rows])


def _changes_section(runs: Sequence[_RunSummary], changes: Rows) -> Section | None:
    if not changes:
        return None
    names = _names(runs)
    table = [
        {
            "run": name,
            "against": before,
            "settings": _settings(change["settings"]),
            "logs": "" if "why" in change else _logs(change["panels"]),
            "success": _outcome(change),
        }
        for (before, name), change in zip(itertools.pairwise(names), changes, strict=True)
    ]
    return Section(
        "changed",
        "What changed from run to run?",
        intro="Each run is compared with the run before it: settings, rows of the panel, and"
        " conditions in which success differs by the 95 % interval over the missions that both"
        " drove. Another training seed may change success as much.",
        tables=[Table(table)],
    )


def _settings(differences: Rows) -> str:
    """Name the settings that differ, with both values; another column describes the panels."""
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


def _weeks_section(place: Path) -> Section | None:
    """Return a section with a chart and a table of a store's weeks; None if there are no rows."""
    if not is_store(place):
        return None
    with Store(place) as store:
        rows, section = coverage_weeks(store)
    if section is None:
        return None
    weeks: dict[str, dict[str, Any]] = {}
    for row in rows:
        week = "not known" if row["week"] is None else str(row["week"])
        line = weeks.setdefault(week, {"week": week, "hours": f"{row['hours'] or 0:.2f}"})
        name = words(row["condition"])
        line[name] = f"{row['events']:,} events" if row["events"] else f"{row['rows_held']:,} rows"
        if row["goal_episodes"]:
            line[name] += f", {row['successes']} of {row['goal_episodes']} arrived"
    title, table = f"{place.name}: week by week", _fill_columns([*weeks.values()])
    return replace(section, id=f"weeks-{place.name}", title=title, tables=[table])
