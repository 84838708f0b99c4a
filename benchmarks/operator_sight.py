"""Count the bumps of a driver who decides as the operator does, but sees less.

    python benchmarks/operator_sight.py [--episodes 300] [--quick] [--json]

The operator reads the simulation: it sees ice before the robot is on it, how people move, and who
is behind a rack. A policy on the robot does not. Each row takes one of these from the operator and
lets it drive the missions of `benchmarks/targets.py`, without random mistakes: it shows what a
policy that imitates the operator can hope for.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from harness import finish, markdown, option_parser
from twin_runs import drive_missions

from restock.arrays import F64, Bools, Ints
from restock.stats import interval_text, wilson
from restock.train.twin.env.drivers import Operator
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import PARKED_M

EVALUATION_SEED = 20_000  # that of targets.py
RAY_POINTS = 41


class FeelsIce(Operator):
    """Knows of ice once the robot's middle has been on it for so many steps (None: never)."""

    def __init__(self, after_steps: int | None) -> None:
        super().__init__(epsilon=0.0)
        self._after_steps = after_steps
        self._on_ice = np.zeros(0, np.int64)
        self._of_episode = np.zeros(0, np.int64)
        self._felt = np.zeros(0, np.bool_)

    def _icy(self, env: WarehouseVectorEnv, pose: F64) -> Bools:
        if len(self._of_episode) != len(pose):
            self._on_ice = np.zeros(len(pose), np.int64)
            self._of_episode = np.full(len(pose), -1)
            self._felt = np.zeros(len(pose), np.bool_)
        begun = self._of_episode != env.episodes_begun
        self._of_episode = env.episodes_begun.copy()
        patches = env.simulation.patches
        inside = (np.abs(pose[:, None, :2] - patches[:, :, :2]) <= patches[:, :, 2:4]).all(axis=2)
        self._on_ice = np.where(inside.any(axis=1), np.where(begun, 0, self._on_ice) + 1, 0)
        self._felt &= ~begun
        if self._after_steps is not None:
            self._felt |= self._on_ice >= self._after_steps
        return self._felt & super()._icy(env, pose)


class SeesStill(Operator):
    """Sees where people are, and takes them to stand."""

    def choose(self, env: WarehouseVectorEnv) -> Ints:
        traffic = env.simulation.traffic
        true = traffic.speed_mps
        traffic.speed_mps = np.zeros_like(true)
        try:
            return super().choose(env)
        finally:
            traffic.speed_mps = true


class SeesInSight(Operator):
    """Does not see people behind racks."""

    def choose(self, env: WarehouseVectorEnv) -> Ints:
        traffic = env.simulation.traffic
        true = traffic.position_m
        hidden = _behind_racks(env)
        traffic.position_m = np.where(hidden[..., None], PARKED_M[0], true)
        try:
            return super().choose(env)
        finally:
            traffic.position_m = true


def _behind_racks(env: WarehouseVectorEnv) -> Bools:
    """Return which agents (N, G) a rack hides from the robot's middle."""
    traffic, pose = env.simulation.traffic, env.simulation.pose()
    hidden = np.zeros(traffic.state.shape, np.bool_)
    along = np.linspace(0.0, 1.0, RAY_POINTS)[:, None, None]
    for index in np.flatnonzero(traffic.active):
        racks = env.floors[env.layout[index]].racks
        boxes = np.array([[rack.x_min, rack.x_max, rack.y_min, rack.y_max] for rack in racks])
        start = pose[index, :2]
        x, y = np.moveaxis(start + along * (traffic.position_m[index] - start), -1, 0)[..., None]
        inside = (boxes[:, 0] < x) & (x < boxes[:, 1]) & (boxes[:, 2] < y) & (y < boxes[:, 3])
        hidden[index] = inside.any(axis=(0, 2))
    return hidden


SIGHT: dict[str, dict[str, Callable[[], Operator]]] = {
    "wheel_slip": {
        "everything": partial(Operator, epsilon=0.0),
        "ice once it is on it, after .2 s": partial(FeelsIce, 1),
        "… after .4 s": partial(FeelsIce, 2),
        "… after .6 s": partial(FeelsIce, 3),
        "no ice": partial(FeelsIce, None),
    },
    "near_collision": {
        "everything": partial(Operator, epsilon=0.0),
        "nobody behind racks": partial(SeesInSight, epsilon=0.0),
        "where people are, not how they move": partial(SeesStill, epsilon=0.0),
    },
}


def main() -> int:
    parser = option_parser(__doc__, "4 episodes: it shows that all runs")
    parser.add_argument("--episodes", type=int, default=300, help="of each kind")
    options = parser.parse_args()
    episodes = 4 if options.quick else options.episodes
    rows = [
        _driven(kind, sees, make(), episodes)
        for kind, drivers in SIGHT.items()
        for sees, make in drivers.items()
    ]
    return finish(options, rows, [], [_as_markdown(rows)])


def _driven(kind: str, sees: str, driver: Operator, episodes: int) -> dict[str, Any]:
    """Return what one driver's missions of a kind come to."""
    results = drive_missions(driver, (kind,), episodes, EVALUATION_SEED)
    taken_s = [result.time_s for result in results if result.success]
    low, high = wilson(len(taken_s), len(results))
    return {
        "kind": kind,
        "sees": sees,
        "success": len(taken_s) / len(results),
        "low": low,
        "high": high,
        "bumps": sum(result.bumps for result in results),
        "km": sum(result.distance_m for result in results) / 1e3,
        "time_s": float(np.mean(taken_s)) if taken_s else None,
    }


def _as_markdown(rows: list[dict[str, Any]]) -> str:
    return markdown(
        ["missions", "the operator sees", "success", "bumps per km", "s"],
        (
            (
                row["kind"].replace("_", " "),
                row["sees"],
                interval_text(row["success"], row["low"], row["high"]),
                f"{row['bumps'] / row['km']:.1f}",
                "" if row["time_s"] is None else f"{row['time_s']:.1f}",
            )
            for row in rows
        ),
    )


if __name__ == "__main__":
    sys.exit(main())
