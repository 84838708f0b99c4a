"""The evidence: does coverage-aware replay of rare logs pay off? One command, start to end.

    python benchmarks/evidence.py --out /tmp/evidence [--hours 24] [--workers 2]

Records hours of the stand-in fleet at natural rates (88 % of missions nominal, 4 % each of wheel
slip, blocked aisles and near collisions), ingests them, and runs the study of benchmarks/evidence/:
every arm with every seed at equal environment steps and updates. What is there is not done again.
The comparisons are in OUT/study/study.md; the tables of docs/evidence.md are printed at the end.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import duckdb
import numpy as np
from harness import markdown, mean_interval, run_restock

from restock.cli import main as restock
from restock.stats import percentiles
from restock.train.study.study import StudyPlan, load_study

HERE = Path(__file__).parent / "evidence"
NATURAL = "nominal=.88,wheel_slip=.04,blocked_aisle=.04,near_collision=.04"
RATES = "odom=10,imu=10,scan=5,joint_states=5,amcl_pose=5,tf=5,bumper=5"
CELLS = ("nominal", "wheel_slip", "partly blocked", "wholly blocked", "near_collision")
# Of one condition: each counts by half.
RARE = {"wheel_slip": 2, "partly blocked": 1, "wholly blocked": 1, "near_collision": 2}
CELL = """CASE WHEN condition <> 'blocked_aisle' THEN condition
    WHEN block = 'partial' THEN 'partly blocked' ELSE 'wholly blocked' END"""
RESAMPLES = 4000


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--hours", type=int, default=24, help="one recording each")
    parser.add_argument("--workers", type=int, default=1, help="recordings, then runs, at a time")
    options = parser.parse_args()
    logs = options.out / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    hours = [(logs / f"hour{hour}.mcap", 100 + hour) for hour in range(1, options.hours + 1)]
    with ThreadPoolExecutor(options.workers) as pool:
        list(pool.map(_record, *zip(*hours, strict=True)))
    if not (options.out / "store").exists():
        run_restock(["ingest", str(logs), "--store", str(options.out / "store")])
    for file in HERE.glob("*.toml"):
        shutil.copy(file, options.out / file.name)
    study, out = options.out / "study.toml", options.out / "study"
    code = restock(["study", str(study), "--out", str(out), "--workers", str(options.workers)])
    plan = StudyPlan(load_study(study), study.parent, out)
    print(f"\n{ends(plan)}\n\n{curves(plan)}\n\n{leads(plan)}")
    return code


def _record(recording: Path, seed: int) -> None:
    if not recording.exists():
        flags = ["--minutes", "60", "--seed", str(seed), "--rates", RATES, "--conditions", NATURAL]
        command = [sys.executable, "-m", "restock", "record", "--out", str(recording), *flags]
        subprocess.run(command, check=True)


def ends(plan: StudyPlan) -> str:
    """Success of each arm in each cell on the study's episodes, with 95 % intervals."""
    weights: list[dict[str, int]] = [{cell: 1} for cell in CELLS] + [RARE]
    rows = []
    for arm in plan.study.arms:
        runs = [_successes(path / "eval" / "episodes.parquet") for path in plan.runs(arm)]
        if all(runs):
            rows.append([f"`{arm.name}`", *(_interval(runs, cells) for cells in weights)])
    return markdown(["", *CELLS, "rare conditions"], rows)


def curves(plan: StudyPlan) -> str:
    """Success in the rare conditions at each periodic evaluation, the mean over seeds."""
    by_arm: dict[str, dict[int, float]] = {}
    for arm in plan.study.arms:
        by_step: dict[int, list[float]] = {}
        for path in plan.runs(arm):
            if not (path / "evaluations.parquet").exists():
                continue
            rows = duckdb.sql(
                f"SELECT env_steps, {CELL} AS cell, avg(success::INT) AS success"
                " FROM read_parquet(?) GROUP BY ALL",
                params=[str(path / "evaluations.parquet")],
            ).fetchall()
            for step in {row[0] for row in rows}:
                cells = {cell: success for at, cell, success in rows if at == step}
                by_step.setdefault(step, []).append(_weighted(cells))
        by_arm[arm.name] = {step: float(np.mean(values)) for step, values in by_step.items()}
    steps = sorted({step for curve in by_arm.values() for step in curve if step % 1000 == 0})
    return _by_steps(steps, {name: _formatted(curve) for name, curve in by_arm.items()})


def leads(plan: StudyPlan) -> str:
    """How far each arm is ahead of the baseline in the rare conditions, paired, by steps."""
    base = [_rare_episodes(path) for path in plan.runs(plan.study.base)]
    if not all(base):
        return ""
    steps = sorted(set.intersection(*map(set, base)))
    by_arm: dict[str, dict[int, str]] = {}
    for arm in plan.study.arms:
        runs = [_rare_episodes(path) for path in plan.runs(arm)]
        evaluated = [step for step in steps if all(step in run for run in runs)]
        if arm == plan.study.base or len(evaluated) < 2:
            continue
        pairs = list(zip(runs, base, strict=True))
        by_arm[arm.name] = {
            step: _lead(np.array([run[step] - other[step] for run, other in pairs]))
            for step in evaluated
        }
    return _by_steps(steps, by_arm)


def _formatted(curve: dict[int, float]) -> dict[int, str]:
    return {step: f"{success:.2f}" for step, success in curve.items()}


def _by_steps(steps: list[int], by_arm: dict[str, dict[int, str]]) -> str:
    rows = [[f"`{name}`", *(at.get(step, "") for step in steps)] for name, at in by_arm.items()]
    return markdown(["steps", *(f"{step:,}" for step in steps)], rows)


def _rare_episodes(path: Path) -> dict[int, np.ndarray]:
    """0 or 1 of each rare episode of a run's periodic evaluations, by environment steps."""
    rows = duckdb.sql(
        "SELECT env_steps, list(success::INT ORDER BY condition, episode_seed)"
        " FROM read_parquet(?) WHERE condition <> 'nominal' GROUP BY ALL",
        params=[str(path / "evaluations.parquet")],
    ).fetchall()
    return {step: np.array(values, np.float64) for step, values in rows}


def _lead(ahead: np.ndarray) -> str:
    """The mean of (runs, episodes), and 95 % of it with both drawn again."""
    low, high = mean_interval(ahead, np.random.default_rng(0), RESAMPLES)
    return f"{ahead.mean():+.2f} [{low:+.2f}, {high:+.2f}]"


def _successes(path: Path) -> dict[str, np.ndarray]:
    """0 or 1 of each episode of a run, by cell, in the order of the episodes' seeds."""
    if not path.exists():
        return {}
    rows = duckdb.sql(
        f"SELECT {CELL} AS cell, list(success::INT ORDER BY episode_seed)"
        " FROM read_parquet(?) GROUP BY ALL",
        params=[str(path)],
    ).fetchall()
    return {cell: np.array(values, np.float64) for cell, values in rows}


def _weighted(success: dict[str, float], weights: dict[str, int] = RARE) -> float:
    known = {cell: weight for cell, weight in weights.items() if cell in success}
    return sum(success[cell] * weight for cell, weight in known.items()) / sum(known.values())


def _interval(runs: Sequence[dict[str, np.ndarray]], weights: dict[str, int]) -> str:
    """The mean over runs, and 95 % of its values with runs and episodes drawn again: all
    runs drove the same ones."""
    rng = np.random.default_rng(0)
    cells = {cell: np.stack([run[cell] for run in runs]) for cell in weights}  # (runs, episodes)
    means = []
    for _ in range(RESAMPLES):
        chosen = rng.integers(len(runs), size=len(runs))
        drawn = {
            cell: float(
                values[chosen][:, rng.integers(values.shape[1], size=values.shape[1])].mean()
            )
            for cell, values in cells.items()
        }
        means.append(_weighted(drawn, weights))
    centre = _weighted({cell: float(values.mean()) for cell, values in cells.items()}, weights)
    low, high = percentiles(np.array(means))
    return f"{centre:.2f} [{low:.2f}, {high:.2f}]"


if __name__ == "__main__":
    raise SystemExit(main())
