"""The scripted drivers of the twin: success per condition, over fixed seeded episodes.

    python benchmarks/drivers.py [--quick] [--json] [--check] [--perturbation NAME]

Success is to reach the goal within the time limit without any bump. `--check` exits 1 where a
driver misses what the task needs of it: a planner that is good in nominal aisles and helpless in
partly blocked ones, an operator who manages everywhere, a random driver who does not.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
from harness import finish, option_parser

from restock.stats import wilson
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
    policy: BehaviourPolicy, kind: str, episodes: int, perturbation: str
) -> dict[str, list[Any]]:
    """(success, bumped, seconds) of each episode, by condition and kind of block."""
    env = WarehouseVectorEnv(min(episodes, 32), perturbation=PERTURBATIONS[perturbation])
    env.set_episodes([EpisodeSpec(kind, FIRST_SEED + index) for index in range(episodes)])
    observation, _ = env.reset(seed=0)
    done: dict[int, tuple[str, bool, bool, float]] = {}
    while len(done) < episodes:
        action, _ = policy.act(env, observation)
        observation, _, terminated, truncated, info = env.step(action)
        for index in np.flatnonzero(terminated | truncated):
            number = int(info["episode_number"][index])
            if number >= 0:
                block = str(info["block"][index])
                done[number] = (
                    kind if block == "none" else f"{kind} {block}",
                    bool(info["success"][index]),
                    bool(info["bumps"][index] > 0),
                    float(info["episode_steps"][index]) * env.task.control_period_s,
                )
    cells = defaultdict(list)
    for name, *result in done.values():
        cells[name].append(result)
    return cells


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
            for cell, results in sorted(drive(make(), kind, count, options.perturbation).items()):
                success = [result[0] for result in results]
                low, high = wilson(sum(success), len(success))
                rows.append(
                    {
                        "driver": name,
                        "condition": cell,
                        "episodes": len(success),
                        "success": float(np.mean(success)),
                        "low": low,
                        "high": high,
                        "bumped": float(np.mean([result[1] for result in results])),
                        "seconds": float(np.mean([result[2] for result in results])),
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
