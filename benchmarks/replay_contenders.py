"""The contenders of `benchmarks/replay.py`: Restock's samplers and other libraries' buffers.

The others are filled once, and then give a batch as their own learners take it: Stable-Baselines3
and TorchRL as tensors, Tianshou and cpprb as arrays (their learners convert them later, which is
not counted here). A library that is not installed is left out.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from restock.replay.sampling.sampler import QuotaSampler, uniform_sampler
from restock.train.feed.batches import gather_rows

Draw = Callable[[], None]
ALPHA, BETA = 0.6, 0.4
OBSERVATION, ACTIONS, BATCH = 93, 9, 256
SHARES = np.array([0.4, 0.2, 0.15, 0.1, 0.08, 0.04, 0.027, 0.003])  # of a batch
NATURAL = np.array([0.88, 0.05, 0.03, 0.02, 0.01, 0.005, 0.004, 0.001])  # of the rows


class Packed:
    """Packed rows and a sampler: one draw and one gather."""

    def __init__(self, rows: torch.Tensor, sampler: QuotaSampler) -> None:
        self.rows, self.sampler = rows, sampler
        self.batch = torch.empty(0)

    def __call__(self) -> None:
        self.gather(torch.from_numpy(self.sampler.draw()[0]))

    def gather(self, index: torch.Tensor) -> None:
        self.batch = gather_rows(self.rows, index)


class RowsAlone(Packed):
    """The gather of rows that were drawn beforehand: what no sampler can be faster than."""

    def __init__(self, rows: torch.Tensor) -> None:
        super().__init__(rows, uniform_sampler(len(rows), BATCH, np.random.default_rng(0)))
        drawn = [torch.from_numpy(self.sampler.draw()[0]) for _ in range(4096)]
        self.drawn = itertools.cycle(drawn)

    def __call__(self) -> None:
        self.gather(next(self.drawn))


class IndexSelected(Packed):
    """The same, gathered as PyTorch's public interface has it, into a batch that exists already."""

    def gather(self, index: torch.Tensor) -> None:
        if not len(self.batch):
            self.batch = torch.empty(len(index), self.rows.shape[1])
        torch.index_select(self.rows, 0, index, out=self.batch)


class Prioritised(Packed):
    """The same with weights, and the update of the priorities of what was drawn."""

    def __init__(self, rows: torch.Tensor, sampler: QuotaSampler, errors: np.ndarray) -> None:
        super().__init__(rows, sampler)
        sampler.update(np.arange(len(rows)), errors)
        self.errors = errors[:BATCH]

    def __call__(self) -> None:
        index, _ = self.sampler.draw()
        self.gather(torch.from_numpy(index))
        if (weights := self.sampler.drawn_weights) is not None:
            torch.from_numpy(weights)
        self.sampler.update(index, self.errors)


class MultinomialDraw(Packed):
    """The usual way to draw by weights: a probability for every row."""

    def __init__(self, rows: torch.Tensor, stratum_rows: list[np.ndarray]) -> None:
        super().__init__(rows, uniform_sampler(len(rows), BATCH, np.random.default_rng(0)))
        self.weight = torch.empty(len(rows))
        for members, share in zip(stratum_rows, SHARES, strict=True):
            self.weight[members] = float(share / len(members))

    def __call__(self) -> None:
        self.gather(torch.multinomial(self.weight, BATCH, replacement=True))


def in_memory(count: int, width: int) -> torch.Tensor:
    """Random rows, in memory as numpy allocates it: with huge pages where the system has them."""
    rows = np.empty((count, width), np.float32)
    rng = np.random.default_rng(0)
    for begin in range(0, count, 65_536):
        rng.standard_normal(dtype=np.float32, out=rows[begin : begin + 65_536])
    return torch.from_numpy(rows)


def strata(count: int) -> list[np.ndarray]:
    """Return the row numbers of eight strata of natural sizes, scattered."""
    code = np.random.default_rng(1).choice(len(NATURAL), count, p=NATURAL)
    return [np.flatnonzero(code == index) for index in range(len(NATURAL))]


def quota_sampler(stratum_rows: list[np.ndarray], *, replacement: bool = True) -> QuotaSampler:
    rng = np.random.default_rng(0)
    within = "uniform" if replacement else "without_replacement"
    return QuotaSampler(stratum_rows, SHARES, BATCH, rng, within=within)


class Columns:
    """Packed rows (n, 2 D + 3) float32 as the columns that other buffers hold."""

    def __init__(self, rows: np.ndarray, observation_size: int, actions: int) -> None:
        size = observation_size
        self.size, self.actions, self.count = size, actions, len(rows)
        self.observation, self.next_observation = rows[:, :size], rows[:, size : 2 * size]
        self.action = (np.arange(len(rows)) % actions).astype(np.int64)
        self.reward = np.ascontiguousarray(rows[:, 2 * size + 1])
        self.done = np.zeros(len(rows), np.bool_)


def stable_baselines3(columns: Columns, batch: int) -> Draw:
    from gymnasium import spaces
    from stable_baselines3.common.buffers import ReplayBuffer

    box, actions = spaces.Box(-1, 1, (columns.size,)), spaces.Discrete(columns.actions)
    buffer = ReplayBuffer(columns.count, box, actions, device="cpu")
    buffer.observations[:, 0] = columns.observation
    buffer.next_observations[:, 0] = columns.next_observation
    buffer.actions[:, 0, 0] = columns.action
    buffer.rewards[:, 0] = columns.reward
    buffer.full = True
    return lambda: buffer.sample(batch) and None


def _fill_tianshou(buffer: Any, columns: Columns) -> Any:
    from tianshou.data import Batch

    buffer.set_batch(
        Batch(
            obs=columns.observation,
            obs_next=columns.next_observation,
            act=columns.action,
            rew=columns.reward,
            terminated=columns.done,
            truncated=columns.done,
            done=columns.done,
        )
    )
    buffer._size = columns.count
    return buffer


def tianshou(columns: Columns, batch: int) -> Draw:
    from tianshou.data import ReplayBuffer

    buffer = _fill_tianshou(ReplayBuffer(columns.count), columns)
    return lambda: buffer.sample(batch) and None


def tianshou_per(columns: Columns, batch: int, errors: np.ndarray) -> Draw:
    from tianshou.data import PrioritizedReplayBuffer

    buffer = _fill_tianshou(PrioritizedReplayBuffer(columns.count, ALPHA, BETA), columns)
    buffer.init_weight(np.arange(columns.count))
    buffer.update_weight(np.arange(columns.count), errors)

    def sample() -> None:
        _, index = buffer.sample(batch)
        buffer.update_weight(index, errors[:batch])

    return sample


def _torchrl(columns: Columns, batch: int, sampler: Any) -> Any:
    from tensordict import TensorDict
    from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

    logging.getLogger("torchrl").setLevel(logging.ERROR)
    count = columns.count
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(count), sampler=sampler, batch_size=batch, priority_key="td"
    )
    # In parts: the storage makes room for all, the rows of a part are copied once more.
    for begin in range(0, count, 50_000):
        part = slice(begin, begin + 50_000)
        rows = {
            "observation": torch.from_numpy(columns.observation[part]),
            "action": torch.from_numpy(columns.action[part]),
            ("next", "observation"): torch.from_numpy(columns.next_observation[part]),
            ("next", "reward"): torch.from_numpy(columns.reward[part]),
            ("next", "done"): torch.from_numpy(columns.done[part]),
        }
        buffer.extend(TensorDict(rows, [min(50_000, count - begin)]))
    return buffer


def torchrl(columns: Columns, batch: int) -> Draw:
    from torchrl.data import RandomSampler

    buffer = _torchrl(columns, batch, RandomSampler())
    return lambda: buffer.sample() is None and None


def torchrl_per(columns: Columns, batch: int, errors: np.ndarray) -> Draw:
    from torchrl.data import PrioritizedSampler

    buffer = _torchrl(columns, batch, PrioritizedSampler(columns.count, alpha=ALPHA, beta=BETA))
    buffer.update_priority(torch.arange(columns.count), torch.from_numpy(errors))
    few = torch.from_numpy(errors[:batch].copy())

    def sample() -> None:
        drawn = buffer.sample()
        buffer.update_priority(drawn["index"], few)

    return sample


def _fill_cpprb(buffer: Any, columns: Columns) -> Any:
    buffer.add(
        obs=columns.observation,
        act=columns.action,
        rew=columns.reward,
        next_obs=columns.next_observation,
        done=columns.done,
    )
    return buffer


def _cpprb_shapes(columns: Columns) -> dict[str, Any]:
    vector = {"shape": columns.size}
    return {"obs": vector, "act": {"dtype": np.int64}, "rew": {}, "next_obs": vector, "done": {}}


def cpprb(columns: Columns, batch: int) -> Draw:
    from cpprb import ReplayBuffer

    buffer = _fill_cpprb(ReplayBuffer(columns.count, _cpprb_shapes(columns)), columns)
    return lambda: buffer.sample(batch) is None and None


def cpprb_per(columns: Columns, batch: int, errors: np.ndarray) -> Draw:
    from cpprb import PrioritizedReplayBuffer

    made = PrioritizedReplayBuffer(columns.count, _cpprb_shapes(columns), alpha=ALPHA)
    buffer = _fill_cpprb(made, columns)
    buffer.update_priorities(np.arange(columns.count), errors)

    def sample() -> None:
        drawn = buffer.sample(batch, BETA)
        buffer.update_priorities(drawn["indexes"], errors[:batch])

    return sample


UNIFORM = {
    "stable_baselines3": stable_baselines3,
    "tianshou": tianshou,
    "torchrl": torchrl,
    "cpprb": cpprb,
}
PRIORITISED = {"tianshou_per": tianshou_per, "torchrl_per": torchrl_per, "cpprb_per": cpprb_per}


def uniform(columns: Columns, batch: int) -> dict[str, Draw | str]:
    """Uniform sampling, of each library; where it is unavailable, why."""
    return _installed(UNIFORM, columns, batch)


def prioritised(columns: Columns, batch: int, errors: np.ndarray) -> dict[str, Draw | str]:
    """PER: a batch with its weights, and the update of its priorities."""
    return _installed(PRIORITISED, columns, batch, errors)


def _installed(makers: dict[str, Any], *arguments: Any) -> dict[str, Draw | str]:
    made: dict[str, Draw | str] = {}
    for name, maker in makers.items():
        try:
            made[name] = maker(*arguments)
        except ImportError as error:
            made[name] = f"not installed: {error.name}"
        except RuntimeError as error:  # TorchRL without its compiled part
            made[name] = str(error)
    return made
