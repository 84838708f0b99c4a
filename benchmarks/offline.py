"""Compare a policy from logs alone with the planner that drove in them, before it ever drives.

    python benchmarks/offline.py --out DIR [--hours 8] [--seeds 3] [--quick] [--json] [--check]

Records hours of the simulated fleet, ingests them and trains on them alone (`env.twin = false`):
once on clones of the operator's rows, once with other drivers' successes as well
(`teacher.successes`), and once more with each row mirrored. Each policy that can be made of what
was learnt (docs/train.md, "An offline start that is chosen") then drives `--episodes` missions of
each kind in the twin, which no choice was made on, beside the planner and the operator.

Intervals of a policy draw seeds and episodes again, those of planner and operator are Wilson's.
"Ahead" is paired by episode. What is done is not done again; `--check` exits 1 where the policy
that follows proposals unless they are implausible, with all rows and their mirror images, is below
the planner in any kind, or not ahead of it in partly blocked aisles.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from harness import finish, markdown, mean_interval, once, option_parser, run_restock
from numpy.typing import NDArray
from twin_runs import drive_missions, trained

from restock.ingest.profile.profile import load_profile
from restock.stats import interval_text, wilson
from restock.train.dqn.start_policy import StartPolicy, start_network
from restock.train.evaluation.policies import GreedyPolicy, load_agent
from restock.train.run.run import Run
from restock.train.twin.drivers.operator_policy import Operator
from restock.train.twin.drivers.policies import PlannerFollower
from restock.train.twin.env.interface import Policy
from restock.train.twin.missions.registry import KINDS

RECORDING_MINUTES = 48
FIRST_SEED, EVALUATION_SEED = 7000, 20_000
ARMS: Mapping[str, Sequence[str]] = {
    "operator's rows": ["teacher.successes=false"],
    "and successes": [],
    "and mirrored": ["teacher.mirror=true"],
}
STARTS = (
    StartPolicy(1.0),
    StartPolicy(0.3),
    StartPolicy(0.1, proposed=True),
    StartPolicy(0.3, proposed=True),
)
CHECKED = ("and mirrored", STARTS[2].name)
CELLS = {
    "nominal": ("nominal", "none"),
    "wheel slip": ("wheel_slip", "none"),
    "partly blocked": ("blocked_aisle", "partial"),
    "wholly blocked": ("blocked_aisle", "full"),
    "near collision": ("near_collision", "none"),
}
RESAMPLES = 2000


def main() -> int:
    parser = option_parser(__doc__, "12 minutes, 100 updates, 4 episodes: it shows that all runs")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--hours", type=float, default=8.0)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=300, help="of each kind")
    options = parser.parse_args()
    episodes = 4 if options.quick else options.episodes
    panel = _panel(options.out, 0.2 if options.quick else options.hours)
    quick = ["schedule.offline_updates=100"] if options.quick else []
    driven: dict[tuple[str, str], list[pa.Table]] = {}
    for name, make in (("planner", PlannerFollower), ("operator", Operator)):
        drive = partial(_drive, lambda make=make: make(epsilon=0.0), episodes)
        driven["", name] = [_kept(options.out / f"{name}.parquet", episodes, drive)]
    for arm, settings in ARMS.items():
        for seed in range(options.seeds):
            path = options.out / f"{arm.replace(' ', '-')}-{seed}"
            alone = ["env.twin=false", "teacher.source=logs", "record.tensorboard=false"]
            trained(path, [*alone, *settings, *quick, f"seed={seed}"], panel)
            for start in STARTS:
                file = path / f"drives-{start.name.replace(' ', '-').replace(',', '')}.parquet"
                drive = partial(_drive, partial(_policy, path, start), episodes)
                driven.setdefault((arm, start.name), []).append(_kept(file, episodes, drive))
    rows = [_row(*key, of, driven["", "planner"][0]) for key, of in driven.items()]
    return finish(options, rows, _missed(rows), [_as_markdown(rows)])


def _panel(out: Path, hours: float) -> Path:
    """Return the panel of so many hours of the fleet."""
    logs, store, panel = out / "logs", out / "store", out / "panel"
    logs.mkdir(parents=True, exist_ok=True)
    left = hours * 60
    while left > 0:
        number = round((hours * 60 - left) / RECORDING_MINUTES)
        minutes = min(left, RECORDING_MINUTES)
        words = [
            "twin",
            "record",
            "--out",
            str(logs / f"day_{number}.mcap"),
            "--minutes",
            f"{minutes:g}",
        ]
        words += ["--seed", str(FIRST_SEED + number)]
        once(logs / f"day_{number}.done", words, partial(run_restock, words))
        left -= minutes
    run_restock(["ingest", str(logs), "--store", str(store)])  # skips what it has
    if not panel.exists():
        run_restock(["mix", str(store), "--mixture", "coverage", "--out", str(panel)])
    return panel


def _policy(run: Path, start: StartPolicy) -> Policy:
    learnt = load_agent(Run.open(run)).network
    actions = load_profile("warehouse_amr").task.scaled_actions
    return GreedyPolicy(start_network(start, learnt, actions), start.name)


def _kept(file: Path, episodes: int, drive: Callable[[], pa.Table]) -> pa.Table:
    """Return the drives in a file, driven where it is not there or has other episodes."""
    if not file.exists() or pq.read_metadata(file).num_rows != episodes * len(KINDS):
        pq.write_table(drive(), file)
    return pq.read_table(file)


def _drive(make: Callable[[], Policy], episodes: int) -> pa.Table:
    results = drive_missions(make(), KINDS, episodes, EVALUATION_SEED)
    return pa.Table.from_pylist([result.row for result in results])


def _row(arm: str, policy: str, drives: Sequence[pa.Table], planner: pa.Table) -> dict[str, Any]:
    """Success of one policy in each cell and over the rare kinds, and what it is ahead by."""
    rng = np.random.default_rng(0)
    success = np.stack([_success(drive) for drive in drives])  # (seeds, episodes)
    ahead = success - _success(planner)
    cells = {cell: _episodes_of(planner, *which) for cell, which in CELLS.items()}
    row: dict[str, Any] = {"arm": arm, "policy": policy, "seeds": len(drives)}
    for cell, ids in cells.items():
        of_cell = success[:, ids]
        single = wilson(int(of_cell.sum()), of_cell.size)
        interval = single if len(drives) == 1 else mean_interval(of_cell, rng, RESAMPLES)
        row[cell] = {"episodes": len(ids), "success": float(of_cell.mean()), "interval": interval}
        row[cell]["ahead"] = float(ahead[:, ids].mean())
        row[cell]["ahead_interval"] = mean_interval(ahead[:, ids], rng, RESAMPLES)
    rare = [
        np.flatnonzero(np.asarray(planner["condition"]) == kind)
        for kind in KINDS
        if kind != "nominal"
    ]
    row["rare"] = float(np.mean([success[:, ids].mean() for ids in rare]))
    bumps = sum(float(np.sum(np.asarray(drive["bumps"])[np.concatenate(rare)])) for drive in drives)
    metres = sum(
        float(np.sum(np.asarray(drive["distance_m"])[np.concatenate(rare)])) for drive in drives
    )
    row["rare_bumps_per_km"] = 1e3 * bumps / metres
    return row


def _success(drive: pa.Table) -> NDArray[np.float64]:
    return np.asarray(drive["success"], np.float64)


def _episodes_of(drive: pa.Table, condition: str, block: str) -> NDArray[np.intp]:
    same = np.asarray(drive["condition"]) == condition
    return np.flatnonzero(same & (np.asarray(drive["block"]) == block))


def _missed(rows: Sequence[dict[str, Any]]) -> list[str]:
    (row,) = (row for row in rows if (row["arm"], row["policy"]) == CHECKED)
    missed = [
        f"{cell}: below the planner by {-row[cell]['ahead']:.3f}"
        for cell in CELLS
        if row[cell]["ahead_interval"][1] < 0
    ]
    if row["partly blocked"]["ahead_interval"][0] <= 0:
        missed.append("partly blocked: not ahead of the planner")
    return missed


def _as_markdown(rows: Sequence[dict[str, Any]]) -> str:
    header = ["cloned", "policy", *CELLS, "rare", "bumps per km"]
    lines = [
        [
            row["arm"],
            row["policy"],
            *(interval_text(row[cell]["success"], *row[cell]["interval"]) for cell in CELLS),
            f"{row['rare']:.2f}",
            f"{row['rare_bumps_per_km']:.1f}",
        ]
        for row in rows
    ]
    return markdown(header, lines)


if __name__ == "__main__":
    sys.exit(main())
