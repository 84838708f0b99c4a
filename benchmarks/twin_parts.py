"""Where a step of the vector environment goes: CPU time by part, each without the parts within it.

The parts are functions of the twin, timed from outside; a step without timers is what
`benchmarks/twin.py` measures. "labels" is no part of a step: it is what the conditions cost that
training labels every finished episode with.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa

from restock.ingest.profile.profile import load_profile
from restock.ingest.task.conditions import label
from restock.ingest.task.signals import STORED_SIGNALS
from restock.train.twin.env import vector_env
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.physics import sensing


class Stopwatch:
    """CPU seconds by part; while one part runs, the part that called it stands still."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = {}
        self._open: list[str] = []
        self._since = 0.0

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*given: Any, **named: Any) -> Any:
            self._turn()
            self._open.append(name)
            try:
                return function(*given, **named)
            finally:
                self._turn()
                self._open.pop()

        return run

    def _turn(self) -> None:
        now = time.process_time()
        if self._open:
            part = self._open[-1]
            self.spent[part] = self.spent.get(part, 0.0) + now - self._since
        self._since = now


def parts(count: int, steps: int) -> dict[str, float]:
    """Part -> microseconds of CPU an environment step, `count` environments, random actions."""
    env = WarehouseVectorEnv(count, seed=1)
    env.reset(seed=1)
    watch = Stopwatch()
    sim = env.simulation
    for name, owner, method in (
        ("physics", sim.batch, "rollout"),
        ("lidar", sim.batch, "ray"),
        ("lidar", sim, "cast"),
        ("sensors and their noise", env.sensing, "sense"),
        ("navigation: plans, blocked aisles", env.navigation, "update"),
        ("traffic", sim.traffic, "advance"),
        ("traffic", sim.scenery, "walk"),
        ("controller and friction", sim, "drive"),
        ("truth", env.truth, "look"),
        ("truth", env.truth, "conclude"),
        ("info", env, "_info_after"),
        ("autoreset: episodes laid out", env, "_begin"),
        ("the rest of step", env, "step"),
    ):
        setattr(owner, method, watch.timed(name, getattr(owner, method)))
    swapped = {
        "observe": "observation",
        "reward": "reward and termination",
        "terminated": "reward and termination",
        "add_motion": "sensors and their noise",
        "add_route": "route",
    }
    before = {name: getattr(vector_env, name) for name in swapped}
    rng = np.random.default_rng(0)
    # As in a long run, some episode or other is always about to end.
    env.steps[:] = rng.integers(env.task.time_limit_steps, size=count)
    rows = []
    try:
        for name, part in swapped.items():
            setattr(vector_env, name, watch.timed(part, before[name]))
        for step in range(20 + steps):
            if step == 20:
                watch.spent.clear()
            *_, info = env.step(rng.integers(env.single_action_space.n, size=count))
            rows.append(info["signals"])
    finally:
        for name, function in before.items():
            setattr(vector_env, name, function)
    scale = 1e6 / steps / count
    found = {name: spent * scale for name, spent in watch.spent.items()}
    found = dict(sorted(found.items(), key=lambda item: -item[1]))
    found["whole step"] = sum(found.values())
    found["labels (in training, not in step)"] = _labels(rows, count)
    return found


def _labels(rows: list[sensing.Signals], count: int) -> float:
    """Microseconds an environment step to label the conditions of these steps."""
    conditions = load_profile("warehouse_amr").conditions
    columns: dict[str, Any] = {
        "episode_index": np.repeat(np.arange(count), len(rows)),
        "step_index": np.tile(np.arange(len(rows)), count),
    }
    for signal in STORED_SIGNALS:
        stacked = np.stack([row[signal.name] for row in rows], axis=1)  # (N, T, …)
        flat = stacked.reshape(count * len(rows), *stacked.shape[2:])
        columns[signal.name] = flat.tolist() if flat.ndim > 1 else flat
    table = pa.table(columns)
    label(table, conditions)
    began = time.process_time()
    label(table, conditions)
    return (time.process_time() - began) * 1e6 / table.num_rows
