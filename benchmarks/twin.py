"""The speed of the twin: the vector environment beside its physics and Gymnasium's own vectors.

    python benchmarks/twin.py [--quick] [--json] [--check] [--layouts NAME ...]

All contestants take turns in every round of one process, with the same model, timestep and kinds of
episodes under random actions. A figure is the median round's microseconds an environment step, of
CPU time (of all processes and threads) and of wall time. Everything but AsyncVectorEnv and the
contestants "2 threads" has one thread.

Then how the vector environment's cost grows with the share of episodes that have traffic, with the
beams of the lidar and with the floor, what its parts cost, and what lidar ranges cost by compiled
code and by MuJoCo's rays. `--check` exits 1 where, at 32 or 128 environments, it costs more than
1.7 times its physics, where at 8 it is not 1.7 times as fast as a SyncVectorEnv of as many, or
where compiled ranges cost more than MuJoCo's.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pyarrow as pa
from harness import finish, in_turns, option_parser

import restock  # noqa: F401 - registers the environment
from restock import native
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.conditions import label
from restock.ingest.task.task import STORED_SIGNALS
from restock.train.twin.env import vector_env
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import Rect, Warehouse
from restock.train.twin.physics import sensing
from restock.train.twin.physics.robot_model import LIDAR_BEAMS, stand_in
from restock.train.twin.physics.sensing import Sensing
from restock.train.twin.physics.simulation import Simulation

PEERS = 8  # environments of Gymnasium's own vectors
COUNTS = (8, 32, 128)
SCALED = 32  # environments while something else is scaled
UNDER_WAY = 20  # steps before anything is timed
TRAFFIC = (0.0, 0.15, 0.5, 1.0)  # share of episodes
BEAMS = (36, LIDAR_BEAMS, 180, 360)
PIECES = 280  # boxes of a floor that is made from scans
TARGET = 1.7


class Contestant:
    """Something that makes environment steps, and what its rounds cost."""

    def __init__(self, run: Callable[[], object], count: int, pids: tuple[int, ...] = ()) -> None:
        self.run, self.count, self.pids = run, count, pids

    def round(self, steps: int) -> tuple[float, float]:
        """Microseconds an environment step, of CPU and wall time, over about `steps` of them."""
        repeats = max(steps // self.count, 4)
        cpu, wall = self._cpu_s(), time.perf_counter()
        for _ in range(repeats):
            self.run()
        scale = 1e6 / repeats / self.count
        taken = self._cpu_s() - cpu, time.perf_counter() - wall
        return taken[0] * scale, taken[1] * scale

    def _cpu_s(self) -> float:
        workers = 0.0
        for pid in self.pids:  # of each thread: nanoseconds on a processor
            for stat in Path(f"/proc/{pid}/task").glob("*/schedstat"):
                workers += int(stat.read_text().split()[0]) / 1e9
        return time.process_time() + workers


def under_way(env: WarehouseVectorEnv) -> Callable[[], object]:
    """Return steps under random actions of environments that are already in their episodes."""
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
    """Return the whole vector environment."""
    return Contestant(
        under_way(WarehouseVectorEnv(count, seed=1, nthread=nthread, **arguments)), count
    )


def with_beams(beams: int) -> Contestant:
    """Return the same with another lidar."""
    env = WarehouseVectorEnv(SCALED, seed=1)
    old = env.simulation
    robot = stand_in(env.task.body, beams)
    env.simulation = Simulation(SCALED, env.task, env.floors[0], old.timestep_s, 1, robot=robot)
    env.sensing = Sensing(env.simulation, env.task)
    return Contestant(under_way(env), SCALED)


def in_pieces(floor: Warehouse, count: int) -> Warehouse:
    """Return the same floor with its racks cut, along x, into so many boxes: what a map gives."""
    each = -(-count // len(floor.racks))
    racks = []
    for rack in floor.racks:
        edges = np.linspace(rack.x_min, rack.x_max, each + 1).tolist()
        racks += [Rect(x0, rack.y_min, x1, rack.y_max) for x0, x1 in pairwise(edges)]
    return replace(floor, racks=tuple(racks))


def ranging(used: bool, beams: int, boxes: int | None) -> Contestant:
    """Lidar ranges alone, of robots under way."""
    env = WarehouseVectorEnv(SCALED, seed=1)
    under_way(env)
    floor = env.floors[0] if boxes is None else in_pieces(env.floors[0], boxes)
    robot = stand_in(env.task.body, beams)
    sim = Simulation(SCALED, env.task, floor, env.simulation.timestep_s, 1, robot=robot)
    sim.qpos[:] = env.simulation.qpos
    ids = np.arange(SCALED)

    def run() -> None:
        native.IS_USED = used
        sim.cast(ids)
        native.IS_USED = True

    return Contestant(run, SCALED)


def physics(count: int) -> Contestant:
    """Return the substeps of a control period alone, always from the same state."""
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
    """Return a contestant: one C call of `mj_step` per control period."""
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
    """Return a contestant: one environment in a Python loop."""
    env = gymnasium.make("restock/Warehouse-v0")
    env.reset(seed=1)
    rng = np.random.default_rng(0)

    def run() -> None:
        _, _, terminated, truncated, _ = env.step(rng.integers(10))
        if terminated or truncated:
            env.reset()

    return Contestant(run, 1)


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
    """Part -> microseconds of CPU an environment step without the parts within it.

    The parts are functions of the twin, timed from outside, under random actions. "labels" is no
    part of a step: it is what the conditions cost that training labels every finished episode with.
    """
    env = WarehouseVectorEnv(count, seed=1)
    env.reset(seed=1)
    watch = Stopwatch()
    sim = env.simulation
    for name, owner, method in (
        ("physics", sim.batch, "rollout"),
        ("lidar", sim.batch, "ray"),
        ("lidar", sim, "cast"),
        ("sensors and their noise", env.sensing, "sense"),
        ("sensors and their noise", env.sensing, "add_motion"),
        ("route", env.navigation, "add_route"),
        ("navigation: plans, blocked aisles", env.navigation, "update"),
        ("traffic", sim.traffic, "advance"),
        ("traffic", sim.scenery, "walk"),
        ("controller and friction", sim, "drive"),
        ("truth", env.truth, "note_situation"),
        ("truth", env.truth, "condition"),
        ("autoreset: episodes laid out", env, "_begin"),
        ("the rest of step", env, "step"),
    ):
        setattr(owner, method, watch.timed(name, getattr(owner, method)))
    swapped = {
        "observe": "observation",
        "reward": "reward and termination",
        "is_terminated": "reward and termination",
        "info_after": "info",
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
    us = {name: spent * scale for name, spent in watch.spent.items()}
    us = dict(sorted(us.items(), key=lambda item: -item[1]))
    us["whole step"] = sum(us.values())
    us["labels (in training, not in step)"] = _labels(rows, count)
    return us


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


def lines(
    cpu: dict[str, float],
    wall: dict[str, float],
    ratios: dict[str, float],
    shares: dict[int, dict[str, float]],
) -> Iterator[str]:
    """Yield the figures as tables."""
    yield f"{'microseconds an environment step':40s} {'CPU':>8s} {'wall':>8s}"
    yield from (f"{name:40s} {cpu[name]:8.1f} {wall[name]:8.1f}" for name in cpu)
    yield from (f"{name:40s} {value:8.2f}" for name, value in ratios.items())
    for count, table in shares.items():
        whole = table["whole step"]
        yield f"\nparts of a step of {count} environments, us of CPU an environment step"
        yield from (f"{name:40s} {us:8.1f} {us / whole:8.1%}" for name, us in table.items())


def main() -> int:
    parser = option_parser(__doc__, quick="a few rounds only")
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
    ranged = [(LIDAR_BEAMS, None), (360, None), (LIDAR_BEAMS, PIECES), (360, PIECES)]
    for beams, boxes in ranged if native.IS_USED else []:
        name = f"{beams} beams, {'default floor' if boxes is None else f'in {boxes} boxes'}"
        contestants[f"ranges, {name}"] = ranging(True, beams, boxes)
        contestants[f"MuJoCo's rays, {name}"] = ranging(False, beams, boxes)
    steps = 160 if options.quick else 640
    rounds = {name: partial(contestant.round, steps) for name, contestant in contestants.items()}
    measured = in_turns(rounds, 3 if options.quick else 12)
    opened.close()

    cpu, wall = (
        {name: float(np.median([one[kind] for one in both])) for name, both in measured.items()}
        for kind in (0, 1)
    )
    ratios = {
        f"vector / physics, {count}": cpu[f"vector environment, {count}"]
        / cpu[f"Batch physics, {count}"]
        for count in COUNTS
    }
    for name in (f"SyncVectorEnv, {PEERS}", f"AsyncVectorEnv, {PEERS}"):
        ratios[f"{name} / vector"] = cpu[name] / cpu[f"vector environment, {PEERS}"]
    ratios |= {
        f"{name} / compiled": cpu[name] / cpu[name.replace("MuJoCo's rays", "ranges")]
        for name in cpu
        if name.startswith("MuJoCo's rays")
    }
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
    missed += [
        f"{name}: {ratio:.2f}, target at least 1"
        for name, ratio in ratios.items()
        if name.endswith("/ compiled") and ratio < 1
    ]
    figures = {name: {"cpu_us": cpu[name], "wall_us": wall[name]} for name in cpu}
    answer = {"us_per_env_step": figures, "ratios": ratios, "parts_us": shares}
    return finish(options, answer, missed, lines(cpu, wall, ratios, shares))


if __name__ == "__main__":
    sys.exit(main())
