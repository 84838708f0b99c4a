"""Fitted Q evaluation: estimate the values of a policy from rows that other policies drove.

Le, Voloshin and Yue 2019 (arXiv:1903.08738); the strongest of the direct methods in Voloshin et al.
2019 (arXiv:1911.06854). Iteration k fits Q_k to r + gamma E_{a ~ policy} Q_{k-1}(s', a), with
Q_0 = 0, so Q_K is the value of the next K steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from restock.arrays import F32
from restock.train.dqn.behaviour import PolicyNetwork
from restock.train.dqn.network import QNetwork, clone

_PART = 8192  # rows evaluated at a time


@dataclass(frozen=True)
class Transitions:
    """Transitions, in no particular order."""

    observation: F32  # (N, D)
    action: NDArray[np.int64]  # (N,)
    reward: F32  # (N,)
    next_observation: F32  # (N, D)
    terminated: NDArray[np.bool_]  # (N,)

    def __len__(self) -> int:
        return len(self.action)


@dataclass(frozen=True)
class FittedQConfig:
    """The settings of a fit."""

    iterations: int = 240  # also the horizon in steps; default: the warehouse task's time limit
    updates: int = 25  # gradient steps per iteration
    batch_size: int = 256
    hidden: Sequence[int] = (128, 128)
    layer_norm: bool = True
    learning_rate: float = 1e-3  # falls to a tenth over the iterations
    cloning_updates: int = 1500  # gradient steps of `cloned_behaviour`


def soft_greedy(network: PolicyNetwork, observation: F32, epsilon: float) -> F32:
    """Return the action probabilities (N, A) of the epsilon-greedy policy.

    With `epsilon` 0, an episode in which the logs took one action that is not greedy would have
    importance weight 0.
    """
    q = values(network, observation)
    probability = np.full(q.shape, epsilon / q.shape[1], np.float32)
    probability[np.arange(len(q)), q.argmax(axis=1)] += 1 - epsilon
    return probability


def fitted_q(
    rows: Transitions,
    next_probability: F32,
    *,
    discount: float,
    bounds: tuple[float, float] | None = None,
    config: FittedQConfig = FittedQConfig(),
    seed: int = 0,
    between: Callable[[], None] = lambda: None,
) -> QNetwork:
    """Fit the action values of a policy.

    Args:
        rows: the logged transitions.
        next_probability: (N, A) the policy's probability of each action in `next_observation`.
        discount: discount factor per step.
        bounds: lower and upper limit that TD targets are clipped to; None: no limits.
        seed: seed of the initial weights and of the batches.
        between: called before every update; an exception that it raises ends the fit.
    """
    actions = next_probability.shape[1]
    generator = torch.Generator().manual_seed(seed)
    network = QNetwork(
        rows.observation.shape[1],
        actions,
        hidden=config.hidden,
        layer_norm=config.layer_norm,
        generator=generator,
    )
    observation, next_observation = map(torch.from_numpy, (rows.observation, rows.next_observation))
    action, reward = torch.from_numpy(rows.action), torch.from_numpy(rows.reward)
    not_terminated = torch.from_numpy(discount * ~rows.terminated).float()
    policy = torch.from_numpy(next_probability)
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate, fused=True)
    decay = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.1, config.iterations)
    before: QNetwork | None = None
    for _ in range(config.iterations):
        for _ in range(config.updates):
            between()
            batch = torch.randint(len(rows), (config.batch_size,), generator=generator)
            target = reward[batch]
            if before is not None:
                with torch.no_grad():
                    value = (policy[batch] * before(next_observation[batch])).sum(dim=1)
                target = target + not_terminated[batch] * value
            if bounds is not None:
                target = target.clamp(*bounds)
            q = network(observation[batch]).gather(1, action[batch, None])[:, 0]
            # Not Huber's loss: the value is a mean, and rare large rewards must count in full.
            _descend(optimizer, nn.functional.mse_loss(q, target))
        decay.step()
        before = clone(network)
    return network


def cloned_behaviour(
    observation: F32,
    action: NDArray[np.int64],
    actions: int,
    *,
    config: FittedQConfig = FittedQConfig(),
    seed: int = 0,
    between: Callable[[], None] = lambda: None,
) -> QNetwork:
    """Fit a network whose softmax is the probability with which the logs chose each action.

    Use it for logs without action probabilities; importance weights from it are estimates.
    `between` is called before every update; an exception that it raises ends the fit.
    """
    generator = torch.Generator().manual_seed(seed)
    network = QNetwork(
        observation.shape[1], actions, hidden=config.hidden, layer_norm=config.layer_norm,
        generator=generator,
    )  # fmt: skip
    seen, taken = torch.from_numpy(observation), torch.from_numpy(action)
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate, fused=True)
    for _ in range(config.cloning_updates):
        between()
        batch = torch.randint(len(taken), (config.batch_size,), generator=generator)
        _descend(optimizer, nn.functional.cross_entropy(network(seen[batch]), taken[batch]))
    return network


def cloned_probabilities(clone: QNetwork, observation: F32) -> NDArray[np.float64]:
    """Return the probability of each action (N, A) under a cloned behaviour."""
    logits = values(clone, observation)
    probability = np.exp(logits - logits.max(axis=1, keepdims=True))
    return np.asarray(probability / probability.sum(axis=1, keepdims=True), np.float64)


@torch.no_grad()
def values(network: nn.Module, observation: F32) -> NDArray[np.float64]:
    """Return action values (N, A), computed in parts to bound memory."""
    starts = range(0, max(len(observation), 1), _PART)
    parts = [network(torch.from_numpy(observation[at : at + _PART])) for at in starts]
    return np.asarray(torch.cat(parts).double().numpy())


def _descend(optimizer: Any, loss: Tensor) -> None:
    optimizer.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    optimizer.step()
