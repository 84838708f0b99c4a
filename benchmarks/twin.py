"""The speed of the twin: the vector environment beside its physics and Gymnasium's own vectors.

    python benchmarks/twin.py [--quick] [--json] [--check] [--layouts NAME ...]

All contestants take turns in every round of one process, with the same model, timestep and kinds of
episodes under random actions. A figure is the median round's microseconds an environment step, of
CPU time (of all processes and threads) and of wall time. Everything but AsyncVectorEnv and the
contestants "2 threads" has one thread.

Then how the vector environment's cost grows with the share of episodes that have traffic, with the
beams of the lidar and with the floor, and what its parts cost. `--check` exits 1 where, at 32 or
128 environments, it costs more than 1.7 times its physics, or where at 8 it is not 1.7 times as
fast as a SyncVectorEnv of as many.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from twin_parts import parts

import restock  # noqa: F401 - registers the environment
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.physics.sensing import Sensing
from restock.train.twin.physics.simulation import LIDAR_BEAMS, Simulation

PEERS = 8  # environments of Gymnasium's own vectors
COUNTS = (8, 32, 128)
SCALED = 32  # environments while something else is scaled
UNDER_WAY = 20  # steps before anything is timed
TRAFFIC = (0.0, 0.15, 0.5, 1.0)  # share of episodes
BEAMS = (36, LIDAR_BEAMS, 180, 360)
TARGET = 1.7


class Contestant:
    """Something that makes environment steps, and what its rounds cost."""

    def __init__(self, run: Callable[[], object], count: int, pids: tuple[int, ...] = ()) -> None:
        self.run, self.count, self.pids = run, count, pids
        self._rounds: list[tuple[float, float]] = []

    def round(self, steps: int) -> None:
        """About `steps` environment steps."""
        repeats = max(steps // self.count, 4)
        cpu, wall = self._cpu_s(), time.perf_counter()
        for _ in range(repeats):
            self.run()
        scale = 1e6 / repeats / self.count
        taken = self._cpu_s() - cpu, time.perf_counter() - wall
        self._rounds.append((taken[0] * scale, taken[1] * scale))

    @property
    def cpu_us(self) -> float:
        return float(np.median([cpu for cpu, _ in self._rounds]))

    @property
    def wall_us(self) -> float:
        return float(np.median([wall for _, wall in self._rounds]))

    def _cpu_s(self) -> float:
        workers = 0.0
        for pid in self.pids:  # of each thread: nanoseconds on a processor
            for stat in Path(f"/proc/{pid}/task").glob("*/schedstat"):
                workers += int(stat.read_text().split()[0]) / 1e9
        return time.process_time() + workers


def under_way(env: WarehouseVectorEnv) -> Callable[[], object]:
    """A step under random actions, of environments that are some steps into their episodes."""
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    # As in a long run, some episode or other is always about to end.
    env.steps[:] = rng.integers(env.task.time_limit_steps, size=env.num_envs)

    def run() -> object:
        return env.step(rng.integers(env.single_action_space.n, size=env.num_envs))

    for _ in range(UNDER_WAY):
        run()
    return run


def vector(count: int, nthread: int = 1, **arguments: Any) -> Contestant:
    """The whole vector environment."""
    return Contestant(
        under_way(WarehouseVectorEnv(count, seed=1, nthread=nthread, **arguments)), count
    )


def with_beams(beams: int) -> Contestant:
    """The same with another lidar."""
    env = WarehouseVectorEnv(SCALED, seed=1)
    old = env.simulation
    env.simulation = Simulation(SCALED, env.task, env.warehouse, old.timestep_s, 1, beams=beams)
    env.sensing = Sensing(env.simulation, env.task)
    return Contestant(under_way(env), SCALED)


def physics(count: int) -> Contestant:
    """The substeps of a control period alone, of robots under way, always from the same state."""
    env = WarehouseVectorEnv(count, seed=1)
    under_way(env)
    sim = env.simulation
    substeps, state = sim.substeps * sim.blocks, sim.batch.state.copy()
    rng = np.random.default_rng(0)

    def run() -> None:
        sim.batch.state[:] = state
        wheels = rng.uniform(-8, 8, (count, 1, 2))
        sim.batch.rollout(substeps, np.repeat(wheels, substeps, axis=1))

    return Contestant(run, count)


def c_floor() -> Contestant:
    """One call of `mj_step` in C for a whole control period: no Python, no batch."""
    env = WarehouseVectorEnv(1, seed=1)
    env.reset(seed=1)
    sim = env.simulation
    data = sim.batch.get_data(0)
    data.ctrl[:] = 4.0, 2.0
    substeps = sim.substeps * sim.blocks
    return Contestant(lambda: mujoco.mj_step(sim.model, data, substeps), 1)


def gymnasiums(mode: str) -> tuple[Contestant, gymnasium.vector.VectorEnv]:
    """Gymnasium's own vector environments over single environments: "sync", or "async"."""
    env = gymnasium.make_vec(
        "restock:restock/Warehouse-v0", num_envs=PEERS, vectorization_mode=mode
    )
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    pids = tuple(process.pid for process in getattr(env, "processes", ()))
    return Contestant(lambda: env.step(rng.integers(10, size=PEERS)), PEERS, pids), env


def one() -> Contestant:
    """One environment in a Python loop."""
    env = gymnasium.make("restock/Warehouse-v0")
    env.reset(seed=1)
    rng = np.random.default_rng(0)

    def run() -> None:
        _, _, terminated, truncated, _ = env.step(rng.integers(10))
        if terminated or truncated:
            env.reset()

    return Contestant(run, 1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few rounds only")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--layouts", nargs="*", default=[], help="more floors, by name")
    options = parser.parse_args()

    asynchronous, opened = gymnasiums("async")  # first: its processes are forked from this one
    contestants = {"C floor, mj_step": c_floor()}
    contestants |= {f"Batch physics, {count}": physics(count) for count in COUNTS}
    contestants |= {f"vector environment, {count}": vector(count) for count in COUNTS}
    contestants["vector environment, 128, 2 threads"] = vector(128, nthread=2)
    contestants["one environment"] = one()
    contestants[f"SyncVectorEnv, {PEERS}"] = gymnasiums("sync")[0]
    contestants[f"AsyncVectorEnv, {PEERS}"] = asynchronous
    for share in TRAFFIC:
        kinds = {"nominal": 1 - share, "near_collision": share}
        contestants[f"traffic in {share:.0%} of episodes"] = vector(SCALED, conditions=kinds)
    for beams in BEAMS:
        contestants[f"{beams} beams"] = with_beams(beams)
    for name in options.layouts:
        contestants[f"floors: {name}"] = vector(SCALED, layouts=name)
    for _ in range(3 if options.quick else 12):
        for contestant in contestants.values():
            contestant.round(160 if options.quick else 640)
    opened.close()

    cost = {name: contestant.cpu_us for name, contestant in contestants.items()}
    ratios = {
        f"vector / physics, {count}": cost[f"vector environment, {count}"]
        / cost[f"Batch physics, {count}"]
        for count in COUNTS
    }
    for name in (f"SyncVectorEnv, {PEERS}", f"AsyncVectorEnv, {PEERS}"):
        ratios[f"{name} / vector"] = cost[name] / cost[f"vector environment, {PEERS}"]
    shares = {
        count: parts(count, steps=30 if options.quick else 150) for count in (COUNTS[0], COUNTS[-1])
    }
    missed = [
        f"{name}: {ratio:.2f}, target at most {TARGET}"
        for name, ratio in ratios.items()
        if name.startswith("vector / physics") and ratio > TARGET and not name.endswith(f" {PEERS}")
    ]
    sync = ratios[f"SyncVectorEnv, {PEERS} / vector"]
    if sync < TARGET:
        missed.append(f"SyncVectorEnv / vector: {sync:.2f}, target at least {TARGET}")
    if options.json:
        figures = {
            name: {"cpu_us": contestant.cpu_us, "wall_us": contestant.wall_us}
            for name, contestant in contestants.items()
        }
        found = {"us_per_env_step": figures, "ratios": ratios, "parts_us": shares, "missed": missed}
        print(json.dumps(found, indent=2))
    else:
        print(f"{'microseconds an environment step':40s} {'CPU':>8s} {'wall':>8s}")
        for name, contestant in contestants.items():
            print(f"{name:40s} {contestant.cpu_us:8.1f} {contestant.wall_us:8.1f}")
        for name, value in ratios.items():
            print(f"{name:40s} {value:8.2f}")
        for count, table in shares.items():
            whole = table["whole step"]
            print(f"\nparts of a step of {count} environments, us of CPU an environment step")
            for name, value in table.items():
                print(f"{name:40s} {value:8.1f} {value / whole:8.1%}")
    if missed:
        print("missed: " + "; ".join(missed), file=sys.stderr)
    return 1 if options.check and missed else 0


if __name__ == "__main__":
    sys.exit(main())
