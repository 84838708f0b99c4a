"""The speed of the twin: the vector environment beside its physics and a SyncVectorEnv.

    python benchmarks/twin.py [--quick] [--json] [--check]

All contestants take turns in every round of one process, on one thread, with the same model,
timestep and actions; the figure is the best round's microseconds of CPU time per environment
step. `--check` exits 1 where the vector environment costs more than 1.7 times its physics at 128
environments, or is not 1.7 times as fast as a SyncVectorEnv of the single environment.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable

import gymnasium
import mujoco
import numpy as np

import restock  # noqa: F401 - registers the environment
from restock.train.simulation import Simulation
from restock.train.vector_env import WarehouseVectorEnv

SYNC_ENVS = 8


def vector(count: int) -> tuple[Callable[[], None], int]:
    """Steps of the whole vector environment under random actions."""
    env = WarehouseVectorEnv(count, seed=1)
    env.reset(seed=1)
    rng = np.random.default_rng(0)

    def run() -> None:
        env.step(rng.integers(env.single_action_space.n, size=count))

    return run, count


def physics(count: int) -> tuple[Callable[[], None], int]:
    """The substeps alone, in one `Batch`, of robots under way in the same layouts."""
    env = WarehouseVectorEnv(count, seed=1)
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(20):
        env.step(rng.integers(env.single_action_space.n, size=count))
    sim: Simulation = env.simulation
    substeps = sim.substeps * sim.blocks

    def run() -> None:
        wheels = rng.uniform(-8, 8, (count, 1, 2))
        sim.batch.rollout(substeps, np.repeat(wheels, substeps, axis=1))

    return run, count


def c_floor() -> tuple[Callable[[], None], int]:
    """One long call of `mj_step` in C: no Python, no batch."""
    env = WarehouseVectorEnv(1, seed=1)
    env.reset(seed=1)
    sim = env.simulation
    data = sim.batch.get_data(0)
    data.ctrl[:] = 4.0, 2.0
    substeps = sim.substeps * sim.blocks

    def run() -> None:
        mujoco.mj_step(sim.model, data, substeps)

    return run, 1


def sync() -> tuple[Callable[[], None], int]:
    """Gymnasium's own vector environment over single environments."""
    env = gymnasium.make_vec("restock/Warehouse-v0", num_envs=SYNC_ENVS, vectorization_mode="sync")
    env.reset(seed=1)
    rng = np.random.default_rng(0)

    def run() -> None:
        env.step(rng.integers(10, size=SYNC_ENVS))

    return run, SYNC_ENVS


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few rounds only")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    contestants = {"C floor, mj_step": c_floor(), f"SyncVectorEnv of {SYNC_ENVS}": sync()}
    for count in (8, 16, 32, 128):
        contestants[f"Batch physics, {count}"] = physics(count)
        contestants[f"vector environment, {count}"] = vector(count)
    best = dict.fromkeys(contestants, np.inf)
    for _ in range(3 if options.quick else 12):
        for name, (run, count) in contestants.items():
            repeats = max(1280 // count // 8, 4)
            begin = time.process_time()
            for _ in range(repeats):
                run()
            best[name] = min(best[name], (time.process_time() - begin) / repeats / count * 1e6)
    ratios = {
        "vector / physics at 128": best["vector environment, 128"] / best["Batch physics, 128"],
        "vector / physics at 16": best["vector environment, 16"] / best["Batch physics, 16"],
        "SyncVectorEnv / vector at 128": best[f"SyncVectorEnv of {SYNC_ENVS}"]
        / best["vector environment, 128"],
    }
    if options.json:
        print(json.dumps({"us_per_env_step": best, "ratios": ratios}, indent=2))
    else:
        for name, value in best.items():
            print(f"{name:28s} {value:8.1f} us an environment step")
        for name, value in ratios.items():
            print(f"{name:32s} {value:.2f}")
    good = ratios["vector / physics at 128"] <= 1.7 <= ratios["SyncVectorEnv / vector at 128"]
    if not good:
        print(
            "missed: at most 1.7 times the physics, at least 1.7 times SyncVectorEnv's speed",
            file=sys.stderr,
        )
    return 1 if options.check and not good else 0


if __name__ == "__main__":
    sys.exit(main())
