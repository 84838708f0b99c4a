"""Two runs: settings, what their critics were fed, and their evaluations side by side.

`restock compare` refuses to compare methods that were fed differently; this shows what is
different, names that verdict, and refuses nothing but two tasks.
"""

from __future__ import annotations

from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa

from restock.errors import RestockError, RunError
from restock.replay.fleet.panel_difference import diff_panels
from restock.replay.panel.panel import Panel
from restock.stats import mean_over_strata
from restock.train.comparison.arms import differences
from restock.train.comparison.compare import MIN_EPISODES, compare, last_evaluation
from restock.train.evaluation.regression import agent_episodes
from restock.train.run.measures import cell_name
from restock.train.run.run import Run

Rows = list[dict[str, Any]]
_Key = tuple[int, str]  # seed, and the values of the perturbation in force


def diff_runs(first: Path | str, second: Path | str, *, seed: int = 0) -> dict[str, Any]:
    """What is different in `second`, as plain values: what `restock coverage diff --json` prints.

    Raises:
        RunError: one of them is missing or damaged, or they are of different tasks.
    """
    a, b = Run.open(first), Run.open(second)
    tasks = [str(run.document.get("task_hash")) for run in (a, b)]
    if tasks[0] != tasks[1]:
        raise RunError(
            f"was trained on task {tasks[1]}, {first} on {tasks[0]}: their returns and episodes "
            "have different meanings",
            where=str(second),
            remedy="compare runs of one profile (`profile` in their configs)",
        )
    settings = [asdict(difference) for difference in differences(a, b)]
    source, evaluation, note = _evaluations(a, b, np.random.default_rng(seed))
    verdict = _verdict(a.path, b.path)
    return {
        "kind": "run",
        "different": bool(settings) or any(row["difference"] for row in evaluation),
        "a": _side(a),
        "b": _side(b),
        "settings": settings,
        "panels": _panels(a, b),
        "fed": _fed(a, b),
        "ages": _ages(a, b),
        "evaluated_by": source,
        "evaluation": evaluation,
        "evaluation_note": note,
        "comparable": verdict,
    }


def _side(run: Run) -> dict[str, Any]:
    progress = run.table("progress")
    last = progress.slice(max(progress.num_rows - 1, 0)).to_pylist()
    fed = run.document.get("panel") or {}
    return {
        "path": str(run.path),
        "env_steps": last[0]["env_steps"] if last else 0,
        "gradient_steps": last[0]["gradient_steps"] if last else 0,
        "panel": fed.get("id"),
        "task": run.document.get("task_hash"),
    }


def _panels(a: Run, b: Run) -> dict[str, Any] | None:
    """What is different between their panels, where both are still where they were."""
    fed = [run.document.get("panel") or {} for run in (a, b)]
    if not all(fed) or fed[0].get("id") == fed[1].get("id"):
        return None
    try:
        panels = [Panel.open(one["path"]) for one in fed]
        for panel, one in zip(panels, fed, strict=True):
            if panel.id != one["id"]:
                return {"note": f"{one['path']} is now another panel, {panel.id}"}
        return diff_panels(*panels)
    except RestockError as error:
        return {"note": str(error)}


def _fed(a: Run, b: Run) -> Rows:
    """One line a source and condition: its share of all rows drawn, plain and after weights."""
    query = files("restock.train.comparison").joinpath("fed_shares.sql")
    with duckdb.connect() as connection:
        for side, run in (("a", a), ("b", b)):
            connection.register(f"fed_{side}", run.table("sampled_episodes"))
        return _rows(connection, query.read_text(encoding="utf-8"))


def _ages(a: Run, b: Run) -> Rows:
    """One line a source and unit: median and 90th percentile of the rows drawn, last interval."""
    lines: dict[tuple[str, str], dict[str, Any]] = {}
    for side, run in (("a", a), ("b", b)):
        table = run.table("ages")
        for row in table.to_pylist():
            key = row["source"], row["unit"]
            line = lines.setdefault(key, {"source": key[0], "unit": key[1]})
            line |= {f"{name}_{side}": row[name] for name in ("p50", "p90")}
    empty = dict.fromkeys(("p50_a", "p50_b", "p90_a", "p90_b"))
    return [{**empty, **line} for line in lines.values()]


def _rows(connection: duckdb.DuckDBPyConnection, query: str) -> Rows:
    relation = connection.sql(query)
    return [dict(zip(relation.columns, row, strict=True)) for row in relation.fetchall()]


def _evaluations(a: Run, b: Run, rng: np.random.Generator) -> tuple[str | None, Rows, str | None]:
    """Where the episodes are from, a line a perturbation and condition, or why there is none."""
    driven = [agent_episodes(run) for run in (a, b)]
    source = "restock eval"
    if any(table is None for table in driven):
        source = "training"
        try:
            driven = [last_evaluation(run) for run in (a, b)]
        except RunError as error:
            return None, [], str(error)
    cells = [_cells(table) for table in driven if table is not None]
    rows = []
    for cell, of_a in cells[0].items():
        of_b = cells[1].get(cell, {})
        if shared := sorted(of_a.keys() & of_b.keys()):
            pairs = np.array([[of_a[key], of_b[key]] for key in shared])  # (n, 2, 2)
            rows.append(_evaluation(cell, pairs, rng))
    return (
        source,
        rows,
        None if rows else ("they have no episode in common: evaluate both with the same --seed"),
    )


def _evaluation(
    cell: tuple[str, str], pairs: np.ndarray[Any, Any], rng: np.random.Generator
) -> dict[str, Any]:
    """Success and return of both, and the paired differences over episodes."""
    line: dict[str, Any] = {
        "perturbation": cell[0],
        "condition": cell[1],
        "episodes": len(pairs),
    }
    for place, name in enumerate(("success", "return")):
        of_both = pairs[:, :, place]
        known = not np.isnan(of_both).any()
        prefix = "" if name == "success" else "return_"
        keys = (f"{prefix}difference", f"{prefix}difference_low", f"{prefix}difference_high")
        line |= {f"{name}_a": None, f"{name}_b": None, **dict.fromkeys(keys)}
        if not known:  # the task has no goal
            continue
        line |= {f"{name}_a": float(of_both[:, 0].mean()), f"{name}_b": float(of_both[:, 1].mean())}
        found = mean_over_strata([of_both[:, 1] - of_both[:, 0]], rng=rng)
        line[keys[0]] = found.value
        if len(pairs) >= MIN_EPISODES and found.low < found.high:
            line |= {keys[1]: found.low, keys[2]: found.high}
    return line


def _cells(table: pa.Table) -> dict[tuple[str, str], dict[_Key, tuple[float, float]]]:
    cells: dict[tuple[str, str], dict[_Key, tuple[float, float]]] = {}
    for row in table.to_pylist():
        cell = str(row.get("perturbation", "none")), cell_name(row["condition"], row["block"])
        success = float("nan") if row["success"] is None else float(row["success"])
        key = int(row["episode_seed"]), str(sorted(row.get("perturbation_values") or ()))
        cells.setdefault(cell, {})[key] = success, float(row["return"])
    return cells


def _verdict(first: Path, second: Path) -> dict[str, Any]:
    """What `restock compare` says of them, by what may differ: named here, and not obeyed."""
    verdict: dict[str, Any] = {}
    for treatment in ("algorithm", "mixture"):
        try:
            verdict[treatment] = compare([first], [second], treatment=treatment).verdict
        except RunError as error:
            verdict[treatment] = f"not compared: {error}"
    return verdict
