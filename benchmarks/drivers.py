"""The scripted drivers of the twin: success per condition, over fixed seeded episodes.

    python benchmarks/drivers.py [--quick] [--json] [--check] [--perturbation NAME]
    python benchmarks/drivers.py --drive skid_steer --episodes 24   # under every perturbation

Success is to reach the goal within the time limit without any bump. `--check` exits 1 where a
driver misses what the task needs of it: a planner that is good in nominal aisles and helpless in
partly blocked ones, an operator who manages everywhere, a random driver who does not.

With `--drive` a robot of that drive takes the place of the twin's own: planner and operator drive
it in nominal aisles and over slippery patches, nominally and with less friction, a third of its
mass as payload, and more latency.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
from harness import finish, markdown, option_parser

from restock.ingest.profile.profile import load_profile
from restock.ingest.task.robot import Robot
from restock.ingest.task.task import Body, Task
from restock.stats import interval_text, wilson
from restock.train.evaluation.evaluate import EpisodeResult, run_episodes
from restock.train.twin.env.drivers import (
    BehaviourPolicy,
    Handover,
    Operator,
    PlannerFollower,
    RandomPolicy,
)
from restock.train.twin.env.interface import Policy
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.missions import KINDS
from restock.train.twin.physics.episode import EpisodeSpec
from restock.train.twin.physics.perturbation import PERTURBATIONS, Perturbation

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
    ("operator", "blocked_aisle partial"): (0.95, 1.0),
    ("operator", "blocked_aisle full"): (0.95, 1.0),
    ("operator", "near_collision"): (0.8, 1.0),
    ("random", "nominal"): (0.0, 0.1),
}


@dataclass(frozen=True)
class Driven:
    """A robot of one drive, and the actions that it has."""

    robot: Robot
    body: Body
    actions: tuple[tuple[float, float], ...]

    @property
    def task(self) -> Task:
        usual = load_profile("warehouse_amr").task
        return msgspec.structs.replace(usual, body=self.body, actions=self.actions)


_TURNING = ((0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (0.8, 0.6), (0.8, -0.6), (0.0, 1.2), (0.0, -1.2))
DRIVES = {
    "differential": Driven(
        Robot(wheel_radius_m=0.1, track_m=0.4, mass_kg=40.0),
        Body(0.6, 0.5),
        (*_TURNING, (-0.4, 0.0)),
    ),
    "skid_steer": Driven(
        Robot(drive="skid_steer", wheel_radius_m=0.1, track_m=0.4, wheelbase_m=0.4, mass_kg=40.0),
        Body(0.6, 0.5),
        (*_TURNING, (-0.4, 0.0)),
    ),
    "ackermann": Driven(
        Robot(
            drive="ackermann",
            wheel_radius_m=0.1,
            track_m=0.4,
            wheelbase_m=0.5,
            mass_kg=40.0,
            max_steering_rad=0.6,
        ),
        Body(0.8, 0.5),
        (
            *((0.0, 0.0), (0.4, 0.0), (1.0, 0.0), (0.8, 0.6), (0.8, -0.6), (0.4, 0.5), (0.4, -0.5)),
            *((-0.4, 0.0), (-0.4, 0.5), (-0.4, -0.5)),
        ),
    ),
}
UNDER = {
    "nominal": Perturbation(),
    "friction": PERTURBATIONS["friction"],
    "payload": Perturbation(name="payload", payload_kg=13.0),
    "latency": PERTURBATIONS["latency"],
}


def drive(
    policy: Policy,
    specs: Sequence[EpisodeSpec],
    perturbation: Perturbation | None = None,
    driven: Driven | None = None,
) -> list[EpisodeResult]:
    """Drive each of these episodes with the twin's own robot or the given one."""
    count = min(len(specs), 64)
    own = {} if driven is None else {"task": driven.task, "robot": driven.robot}
    env = WarehouseVectorEnv(count, nthread=0, perturbation=perturbation, **own)
    return run_episodes(
        env,
        policy,
        specs,
        control_period_s=env.task.control_period_s,
        time_limit_steps=env.task.time_limit_steps,
    )


def cells(results: Sequence[EpisodeResult]) -> dict[str, list[EpisodeResult]]:
    """Group results by condition and kind of block."""
    by_cell: dict[str, list[EpisodeResult]] = {}
    for one in results:
        name = one.condition if one.block == "none" else f"{one.condition} {one.block}"
        by_cell.setdefault(name, []).append(one)
    return dict(sorted(by_cell.items()))


def main() -> int:
    parser = option_parser(__doc__, quick="20 episodes a cell, not 100")
    parser.add_argument("--perturbation", choices=sorted(PERTURBATIONS), default="nominal")
    parser.add_argument("--drive", choices=sorted(DRIVES), help="of a robot in its place")
    parser.add_argument("--episodes", type=int, default=24, metavar="N", help="a cell, of --drive")
    options = parser.parse_args()
    if options.drive is not None:
        return by_drive(options)
    # Blocked aisles are drawn twice as often: half are blocked partly, half wholly.
    episodes = 20 if options.quick else 100
    rows = []
    for name, make in DRIVERS.items():
        for kind in KINDS:
            count = 2 * episodes if kind == "blocked_aisle" else episodes
            specs = [EpisodeSpec(kind, FIRST_SEED + index) for index in range(count)]
            for cell, results in cells(
                drive(make(), specs, PERTURBATIONS[options.perturbation])
            ).items():
                rows.append(_row(name, cell, results))
                print(_line(rows[-1]), file=sys.stderr if options.json else sys.stdout, flush=True)
    return finish(options, rows, [_line(row) for row in rows if not _good(row)], [])


def by_drive(options: argparse.Namespace) -> int:
    """Planner and operator under each perturbation, with the robot of one drive."""
    rows = []
    for driver in ("planner", "operator"):
        for name, perturbation in UNDER.items():
            for kind in ("nominal", "wheel_slip"):
                specs = [EpisodeSpec(kind, FIRST_SEED + one) for one in range(options.episodes)]
                results = drive(DRIVERS[driver](), specs, perturbation, DRIVES[options.drive])
                rows.append(_row(driver, kind, results) | {"under": name})
                print(f"{name:9s}", _line(rows[-1]), file=sys.stderr, flush=True)
    table = [
        [driver, kind]
        + [
            interval_text(row["success"], row["low"], row["high"])
            for row in rows
            if (row["driver"], row["condition"]) == (driver, kind)
        ]
        for driver in ("planner", "operator")
        for kind in ("nominal", "wheel_slip")
    ]
    return finish(options, rows, [], [markdown(["driver", options.drive, *UNDER], table)])


def _row(driver: str, cell: str, results: Sequence[EpisodeResult]) -> dict[str, Any]:
    success = sum(one.success for one in results)
    low, high = wilson(success, len(results))
    return {
        "driver": driver,
        "condition": cell,
        "episodes": len(results),
        "success": success / len(results),
        "low": low,
        "high": high,
        "bumped": sum(one.bumps > 0 for one in results) / len(results),
        "seconds": sum(one.time_s for one in results) / len(results),
    }


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
