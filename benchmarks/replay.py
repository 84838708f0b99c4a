"""What sampling costs: uniform, quotas and Stable-Baselines3's buffer, in one interleaved run.

    python benchmarks/replay.py [--quick] [--json] [--check]

Every contender fills a batch that is ready to train on (observation, next observation, action,
reward, discount), from rows that lie in memory, on one thread. Then quotas over ten million row
numbers, the building of a panel, and the fresh ring. `--check` exits 1 where a target of the design
is missed. Stable-Baselines3 is left out where it is not installed.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from restock.replay.layout import row_width
from restock.replay.ring import FreshRing
from restock.replay.sampler import QuotaSampler, uniform_sampler

OBSERVATION, ACTIONS, BATCH = 93, 9, 256
SHARES = np.array([0.4, 0.2, 0.15, 0.1, 0.08, 0.04, 0.027, 0.003])  # of a batch
NATURAL = np.array([0.88, 0.05, 0.03, 0.02, 0.01, 0.005, 0.004, 0.001])  # of the rows
UNIFORM_TARGET, QUOTA_TARGET = 4.0, 1.2


class Packed:
    """Packed rows and a sampler: one draw and one gather into a batch that is there already."""

    def __init__(self, rows: torch.Tensor, sampler: QuotaSampler) -> None:
        self.rows, self.sampler = rows, sampler
        self.batch = torch.empty(BATCH, rows.shape[1])

    def __call__(self) -> None:
        drawn, _ = self.sampler.draw()
        torch.index_select(self.rows, 0, torch.from_numpy(drawn), out=self.batch)


class MultinomialDraw(Packed):
    """The usual way to draw by weights: a probability for every row."""

    def __init__(self, rows: torch.Tensor, stratum_rows: list[np.ndarray]) -> None:
        super().__init__(rows, uniform_sampler(len(rows), BATCH, np.random.default_rng(0)))
        self.weight = torch.empty(len(rows))
        for members, share in zip(stratum_rows, SHARES, strict=True):
            self.weight[members] = float(share / len(members))

    def __call__(self) -> None:
        drawn = torch.multinomial(self.weight, BATCH, replacement=True)
        torch.index_select(self.rows, 0, drawn, out=self.batch)


def strata(count: int) -> list[np.ndarray]:
    """Row numbers of eight strata of natural sizes, scattered."""
    code = np.random.default_rng(1).choice(len(NATURAL), count, p=NATURAL)
    return [np.flatnonzero(code == index) for index in range(len(NATURAL))]


def stable_baselines3(rows: torch.Tensor) -> Callable[[], None] | None:
    """Its ReplayBuffer over the same rows, or None where it is not installed."""
    try:
        from gymnasium import spaces
        from stable_baselines3.common.buffers import ReplayBuffer
    except ImportError:
        return None
    size = OBSERVATION
    buffer = ReplayBuffer(
        len(rows), spaces.Box(-1, 1, (size,)), spaces.Discrete(ACTIONS), device="cpu"
    )
    packed = rows.numpy()
    buffer.observations[:, 0] = packed[:, :size]
    buffer.next_observations[:, 0] = packed[:, size : 2 * size]
    buffer.actions[:, 0] = packed[:, 2 * size : 2 * size + 1]
    buffer.rewards[:, 0] = packed[:, 2 * size + 1]
    buffer.full = True

    def sample() -> None:
        buffer.sample(BATCH)

    return sample


def measure(contenders: dict[str, Callable[[], None]], rounds: int, draws: int) -> dict[str, float]:
    """Median over rounds of the microseconds of one batch; contenders take turns."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, draw in contenders.items():
            few = max(draws // 50, 2) if name == "multinomial" else draws
            draw()
            began = time.perf_counter()
            for _ in range(few):
                draw()
            times[name].append((time.perf_counter() - began) / few * 1e6)
    return {name: float(np.median(values)) for name, values in times.items()}


def ten_million(count: int) -> dict[str, float]:
    """Index and quotas over many rows."""
    stratum_rows = strata(count)
    began = time.perf_counter()
    sampler = QuotaSampler(stratum_rows, SHARES, BATCH, np.random.default_rng(0))
    index_s = time.perf_counter() - began
    us = measure({"draw": lambda: sampler.draw() and None}, 5, 500)["draw"]
    return {"rows": count, "index_s": index_s, "draw_us": us}


def panel_build(count: int) -> dict[str, float] | None:
    """A panel of `count` rows from an Arrow table, checksummed."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    import pyarrow as pa
    from conftest import CONDITIONS, recording_transitions

    from restock.ingest.scan import Body
    from restock.ingest.task import Task
    from restock.replay.build import build_panel
    from restock.replay.mixture import load_mixture

    actions = tuple((float(i), 0.0) for i in range(ACTIONS))
    task = Task(body=Body(length_m=0.7, width_m=0.5), actions=actions)
    recordings = max(count // 20_000, 1)
    table = pa.concat_tables(
        [recording_transitions(i, episodes=600, task=task) for i in range(1, recordings + 1)]
    )
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        panel = build_panel(
            table, load_mixture("coverage"), Path(folder) / "p", conditions=CONDITIONS
        )
        elapsed = time.perf_counter() - began
        return {"rows": len(table), "packed": len(panel), "rows_per_s": len(table) / elapsed}


def fresh_ring(steps: int) -> dict[str, float]:
    """Appending steps of 16 environments, three-step returns, labels at the end of episodes."""
    envs, length = 16, 100
    ring = FreshRing(
        50_000, envs, OBSERVATION, discount=0.97, n_step=3, conditions=("rare", "nominal")
    )
    rng = np.random.default_rng(0)
    observation = rng.normal(size=(envs, OBSERVATION)).astype(np.float32)
    action, reward = np.zeros(envs, np.int64), np.zeros(envs, np.float32)
    never, labels = np.zeros(envs, np.bool_), np.ones(length + 1, np.int64)
    began = time.perf_counter()
    for step in range(steps):
        ended = (np.arange(envs) * 6 + step) % length == 0
        keys = ring.append(
            observation=observation,
            action=action,
            reward=reward,
            terminated=ended,
            truncated=never,
            next_observation=observation,
            env_step=step * envs,
            gradient_step=step,
        )
        for key in keys[ended]:
            ring.set_labels(int(key), labels)
    us = (time.perf_counter() - began) / steps * 1e6
    return {"append_us": us, "append_us_per_env_step": us / envs}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--check", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    count = 200_000 if args.quick else 1_000_000
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(count, row_width(OBSERVATION), generator=generator)
    stratum_rows = strata(count)

    def quotas(*, replacement: bool) -> Packed:
        rng = np.random.default_rng(0)
        return Packed(rows, QuotaSampler(stratum_rows, SHARES, BATCH, rng, replacement=replacement))

    contenders: dict[str, Callable[[], None]] = {
        "uniform": Packed(rows, uniform_sampler(count, BATCH, np.random.default_rng(0))),
        "quotas": quotas(replacement=True),
        "quotas_without_replacement": quotas(replacement=False),
        "multinomial": MultinomialDraw(rows, stratum_rows),
    }
    peer = stable_baselines3(rows)
    if peer is not None:
        contenders["stable_baselines3"] = peer
    us = measure(contenders, *((5, 200) if args.quick else (15, 1000)))
    del contenders, peer
    result: dict[str, Any] = {
        "rows": count,
        "batch": BATCH,
        "us_per_batch": us,
        "rows_per_s": {name: BATCH / value * 1e6 for name, value in us.items()},
        "quotas_over_uniform": us["quotas"] / us["uniform"],
        "many_rows": ten_million(1_000_000 if args.quick else 10_000_000),
        "panel_build": panel_build(20_000 if args.quick else 200_000),
        "fresh_ring": fresh_ring(500 if args.quick else 5000),
    }
    missed = []
    if us["quotas"] > QUOTA_TARGET * us["uniform"]:
        missed.append(f"quotas: {result['quotas_over_uniform']:.2f}x uniform, at most 1.2x")
    if "stable_baselines3" in us:
        result["stable_baselines3_over_uniform"] = us["stable_baselines3"] / us["uniform"]
        if us["stable_baselines3"] < UNIFORM_TARGET * us["uniform"]:
            missed.append(
                f"uniform: Stable-Baselines3 {result['stable_baselines3_over_uniform']:.2f}x,"
                " at least 4x"
            )
    result["missed"] = missed
    if args.json:
        print(json.dumps(result, indent=1))
    else:
        for name, value in us.items():
            print(f"{name:28} {value:10.1f} us a batch of {BATCH}  {value / us['uniform']:8.2f}x")
        for name in ("many_rows", "panel_build", "fresh_ring"):
            print(f"{name:28} {result[name]}")
        print("\n".join(f"missed: {line}" for line in missed) or "all targets met")
    return 1 if args.check and missed else 0


if __name__ == "__main__":
    sys.exit(main())
