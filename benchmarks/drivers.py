"""The scripted drivers of the twin: success per condition, over fixed seeded episodes.

    python benchmarks/drivers.py [--quick] [--json] [--check] [--perturbation NAME]

Success is to reach the goal within the time limit without any bump. `--check` exits 1 where a
driver misses what the task needs of it: a planner that is good in nominal aisles and helpless in
partly blocked ones, an operator who manages everywhere, a random driver who does not.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from harness import finish, option_parser

from restock.stats import wilson
from restock.train.evaluation.evaluate import EpisodeResult, run_episodes
from restock.train.twin.env.interface import Policy
from restock.train.twin.env.operator_policy import Operator
from restock.train.twin.env.policies import BehaviourPolicy, Handover, PlannerFollower, RandomPolicy
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.physics.episode import KINDS, EpisodeSpec
from restock.train.twin.physics.perturbation import PERTURBATIONS

DRIVERS: dict[str, Callable[[], BehaviourPolicy]] = {
    "planner": PlannerFollower,
    "operator": Operator,
    "planner+operator": lambda: Handover(PlannerFollower(), Operator()),
    "random": RandomPolicy,
}
FIRST_SEED = 10_000
TARGETS = {  # (driver, condition): lowest and highest success that will do
    ("planner", "nominal"): (0.95, 1.0),
    ("planner", "blocked_aisle partial"): (0.0, 0.3),
    ("operator", "nominal"): (0.8, 1.0),
    ("operator", "wheel_slip"): (0.8, 1.0),
    ("operator", "blocked_aisle partial"): (0.8, 1.0),
    ("operator", "blocked_aisle full"): (0.8, 1.0),
    ("operator", "near_collision"): (0.8, 1.0),
    ("random", "nominal"): (0.0, 0.1),
}


def drive(
    policy: Policy, specs: Sequence[EpisodeSpec], perturbation: str = "nominal"
) -> list[EpisodeResult]:
    """How each of these episodes went."""
    count = min(len(specs), 64)
    env = WarehouseVectorEnv(count, nthread=0, perturbation=PERTURBATIONS[perturbation])
    return run_episodes(
        env,
        policy,
        specs,
        control_period_s=env.task.control_period_s,
        time_limit_steps=env.task.time_limit_steps,
    )


def cells(results: Sequence[EpisodeResult]) -> dict[str, list[EpisodeResult]]:
    """By condition and kind of block."""
    by_cell: dict[str, list[EpisodeResult]] = {}
    for one in results:
        name = one.condition if one.block == "none" else f"{one.condition} {one.block}"
        by_cell.setdefault(name, []).append(one)
    return dict(sorted(by_cell.items()))


def main() -> int:
    parser = option_parser(__doc__, quick="20 episodes a cell, not 100")
    parser.add_argument("--perturbation", choices=sorted(PERTURBATIONS), default="nominal")
    options = parser.parse_args()
    # Blocked aisles are drawn twice as often: half are blocked partly, half wholly.
    episodes = 20 if options.quick else 100
    rows = []
    for name, make in DRIVERS.items():
        for kind in KINDS:
            count = 2 * episodes if kind == "blocked_aisle" else episodes
            specs = [EpisodeSpec(kind, FIRST_SEED + index) for index in range(count)]
            for cell, results in cells(drive(make(), specs, options.perturbation)).items():
                success = sum(one.success for one in results)
                low, high = wilson(success, len(results))
                rows.append(
                    {
                        "driver": name,
                        "condition": cell,
                        "episodes": len(results),
                        "success": success / len(results),
                        "low": low,
                        "high": high,
                        "bumped": sum(one.bumps > 0 for one in results) / len(results),
                        "seconds": sum(one.time_s for one in results) / len(results),
                    }
                )
                print(_line(rows[-1]), file=sys.stderr if options.json else sys.stdout, flush=True)
    return finish(options, rows, [_line(row) for row in rows if not _good(row)], [])


def _good(row: dict[str, Any]) -> bool:
    low, high = TARGETS.get((row["driver"], row["condition"]), (0.0, 1.0))
    return bool(low <= row["success"] <= high)


def _line(row: dict[str, Any]) -> str:
    return (
        f"{row['driver']:17s} {row['condition']:22s} success {row['success']:.2f}"
        f" [{row['low']:.2f}, {row['high']:.2f}] bumped {row['bumped']:.2f}"
        f" {row['seconds']:5.1f} s  n={row['episodes']}"
    )


if __name__ == "__main__":
    sys.exit(main())
