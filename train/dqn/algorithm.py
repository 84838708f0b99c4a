"""The interface of value-based algorithms, and DQN written once in PyTorch.

    y_i     = r_i + d_i * Q_target(s'_i, a_i')                       Double DQN, arXiv:1509.06461
    a_i'    = argmax_a Q(s'_i, a)
    delta_i = Q(s_i, a_i) - y_i
    L       = mean_i w_i * huber(delta_i)

`d_i` is the discount of row i: gamma**n for an n-step row that bootstraps, 0 for one that
terminated. A truncated episode bootstraps: its d is not 0.

Without a behaviour network to filter a_i', min(Q, Q_target) takes the place of Q_target (clipped
double Q-learning, arXiv:1802.09477): the action with the largest value in s' is often one that
nobody has tried, and nothing corrects its value.

`loss.algorithm` of a run's config names an entry of `ALGORITHMS`, or your own as `module:name`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from restock.arrays import F32
from restock.errors import ConfigError
from restock.train.dqn.network import QNetwork

if TYPE_CHECKING:
    from restock.train.dqn.config import LossConfig, NetworkConfig, TrainConfig


MARGIN = 0.8  # by how much Q of an expert's action must exceed the others' (arXiv:1704.03732)


@dataclass(frozen=True)
class TrainingBatch:
    """The batch of one update. Rows from logs come first."""

    observation: Tensor  # (B, D) float32
    next_observation: Tensor  # (B, D) float32
    action: Tensor  # (B,) int64
    reward: Tensor  # (B,) float32, the sum of the row's n discounted rewards
    discount: Tensor  # (B,) float32, gamma**n if the row bootstraps, else 0
    weight: Tensor | None = None  # (B,) importance weights; None: ones
    # (B, A) float32, added to Q(s', a) to choose the next action; None: nothing.
    preference: Tensor | None = None
    lower: bool = False  # bootstrap from min(Q, Q_target) instead of Q_target
    logged: int = 0  # L, how many of the first rows the terms below apply to
    conservative: float | Tensor = 0.0  # weight of the CQL term, or one weight per such row (L,)
    expert: Tensor | None = None  # (L,) bool, which rows get the margin term; None: no row


@dataclass(frozen=True)
class Loss:
    """The loss of a batch, and the parts that the run records."""

    value: Tensor  # () float32, with gradient
    td: Tensor  # (B,) float32, Q(s, a) minus the TD target, without gradient
    q: Tensor  # (B,) float32, Q(s, a), without gradient
    penalty: Tensor | None = None  # () float32, added to `value` for the gradient, not recorded


class Algorithm(Protocol):
    """A way to learn action values, constructed from a run's `LossConfig`.

    The greedy action is the one whose value, plus the teacher's preference if there is a teacher,
    is largest. The twin, evaluation and ONNX all use this rule.
    """

    def make_network(
        self,
        config: NetworkConfig,
        observation_size: int,
        actions: int,
        generator: torch.Generator | None = None,
    ) -> QNetwork:
        """Return a network whose `forward` gives action values (B, A) of observations (B, D)."""
        ...

    def loss(self, network: Any, target: Any, batch: TrainingBatch) -> Loss:
        """Return the loss of `network` on a batch; `target` is its slow copy.

        Both networks come from `make_network`. Instead of a plain `QNetwork`, they may be compiled
        functions with the same values and gradients.
        """
        ...


class DQN:
    """Double DQN with Huber's loss, and the CQL and margin terms on logged rows."""

    def __init__(self, settings: LossConfig) -> None:
        self.settings = settings

    def make_network(
        self,
        config: NetworkConfig,
        observation_size: int,
        actions: int,
        generator: torch.Generator | None = None,
    ) -> QNetwork:
        """Return a multilayer perceptron with one output per action."""
        return QNetwork(
            observation_size,
            actions,
            hidden=config.hidden,
            layer_norm=config.layer_norm,
            generator=generator,
        )

    def loss(
        self,
        network: Callable[[Tensor], Tensor],
        target: Callable[[Tensor], Tensor],
        batch: TrainingBatch,
    ) -> Loss:
        """Return the loss on a batch; `value` is the TD part, `penalty` the other terms."""
        with torch.no_grad():
            next_online_q = network(batch.next_observation) if self.settings.double else None
            wanted = td_target(
                batch.reward,
                batch.discount,
                target(batch.next_observation),
                next_online_q,
                batch.preference,
                lower=batch.lower,
            )
        q = network(batch.observation)
        delta = self.settings.huber_delta
        loss = dqn_loss(q, batch.action, wanted, weight=batch.weight, huber_delta=delta)
        return Loss(loss.value, loss.td, loss.q, self._penalty(q, batch))

    def gradient(
        self, q: F32, scalars: F32, next_value: F32, weight: F32 | None
    ) -> tuple[Loss, F32]:
        """Return the loss without penalty and its gradient by `q` (B, A), bit for bit as autograd.

        `scalars` (B, 3) has the columns action, reward and discount. `next_value` (B,) is the value
        of the next action, `weight` (B,) has importance weights; None: ones.
        """
        chosen = np.arange(len(q)), scalars[:, 0].astype(np.int64)
        td = q[chosen] - (scalars[:, 1] + scalars[:, 2] * next_value)
        size, half, scale = np.abs(td), np.float32(0.5), np.full(len(q), 1 / len(q), np.float32)
        delta = np.float32(self.settings.huber_delta)
        losses = np.where(size < delta, half * size * size, delta * (size - half * delta))
        if weight is not None:
            losses, scale = losses * weight, scale * weight
        gradient = np.zeros_like(q)
        gradient[chosen] = np.clip(td, -delta, delta) * scale
        loss, *of_rows = map(torch.from_numpy, (losses, td, q[chosen]))
        return Loss(loss.mean(), *of_rows), gradient

    def _penalty(self, q: Tensor, batch: TrainingBatch) -> Tensor | None:
        """Return the CQL and margin terms, times the share L / B of rows; None if both are off."""
        logged, share = batch.logged, batch.logged / len(q)
        action = batch.action[:logged]
        terms = []
        if isinstance(batch.conservative, Tensor) or (batch.conservative > 0 and logged):
            term = conservative_penalty(q[:logged], action, batch.conservative)
            terms.append(term * share)
        if batch.expert is not None:
            term = margin_penalty(q[:logged], action, batch.expert, MARGIN)
            terms.append(self.settings.margin * term * share)
        return sum(terms[1:], terms[0]) if terms else None


ALGORITHMS: dict[str, Callable[[LossConfig], Algorithm]] = {"dqn": DQN}


def make_algorithm(config: LossConfig) -> Algorithm:
    """Return the algorithm that `config.algorithm` names.

    Raises:
        ConfigError: there is no such name, module or attribute.
    """
    algorithm_class = ALGORITHMS.get(config.algorithm)
    if algorithm_class is None:
        algorithm_class = _import_named(config.algorithm)
    return algorithm_class(config)


def _import_named(source: str) -> Callable[[LossConfig], Algorithm]:
    """Import `module:name`; modules in the working directory are found, too."""
    module, _, name = source.partition(":")
    folder = str(Path.cwd())
    sys.path.insert(0, folder)
    try:
        found: Callable[[LossConfig], Algorithm] = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"{source!r} cannot be imported: {error}",
            where="loss.algorithm",
            remedy=f"give one of {', '.join(ALGORITHMS)}, or your own as module:name",
        ) from error
    finally:
        sys.path.remove(folder)
    return found


def make_network(
    config: TrainConfig,
    observation_size: int,
    actions: int,
    generator: torch.Generator | None = None,
) -> QNetwork:
    """Return the network of a run's algorithm."""
    made = make_algorithm(config.loss)
    return made.make_network(config.network, observation_size, actions, generator)


def td_target(
    reward: Tensor,
    discount: Tensor,
    next_target_q: Tensor,
    next_online_q: Tensor | None = None,
    preference: Tensor | None = None,
    *,
    lower: bool = False,
) -> Tensor:
    """Return the TD target of Q(s, a), (B,).

    Args:
        reward: (B,), the sum of the row's n discounted rewards.
        discount: (B,), gamma**n if the row bootstraps, else 0.
        next_target_q: (B, A), the target network at s'.
        next_online_q: (B, A), the online network at s': it selects the action that the target
            network evaluates (Double DQN). None: the target network does both (DQN).
        preference: (B, A), added to the values that select the next action, not to the TD target;
            -inf forbids an action (discrete BCQ, arXiv:1910.01708). None: nothing is added.
        lower: bootstrap from min(Q, Q_target) of the next action instead of Q_target.
    """
    chooses = next_target_q if next_online_q is None else next_online_q
    if preference is not None:
        chooses = chooses + preference
    best = chooses.argmax(dim=1, keepdim=True)
    value = next_target_q.gather(1, best)
    if lower and next_online_q is not None:
        value = torch.minimum(value, next_online_q.gather(1, best))
    return reward + discount * value.squeeze(1)


def dqn_loss(
    q: Tensor,
    action: Tensor,
    target: Tensor,
    *,
    weight: Tensor | None = None,
    huber_delta: float = 1.0,
) -> Loss:
    """Return the loss of action values `q` (B, A) at `action` (B,) int64 against `target` (B,).

    `weight` (B,) are importance weights that correct the sampling; None: ones.
    """
    chosen = q.gather(1, action.unsqueeze(1))  # (B, 1): squeezing it slows the backward pass
    wanted = target.unsqueeze(1)
    if weight is None:
        value = functional.huber_loss(chosen, wanted, delta=huber_delta)
    else:
        losses = functional.huber_loss(chosen, wanted, reduction="none", delta=huber_delta)
        value = (losses.squeeze(1) * weight).mean()
    detached = chosen.detach().squeeze(1)
    return Loss(value, detached - target, detached)


def conservative_penalty(q: Tensor, action: Tensor, weight: float | Tensor = 1.0) -> Tensor:
    """Return discrete CQL's regulariser, the mean of weight * (logsumexp_a Q(s, a) - Q(s, a_log)).

    It pushes down the values of actions that the logs never took (arXiv:2006.04779, CQL(H)).
    `weight` is one number for all rows, or one per row, (B,).
    """
    chosen = q.gather(1, action.unsqueeze(1)).squeeze(1)
    return ((q.logsumexp(dim=1) - chosen) * weight).mean()


def margin_penalty(q: Tensor, action: Tensor, expert: Tensor, margin: float) -> Tensor:
    """Return DQfD's large-margin term, the mean of max_a [Q(s, a) + l(a)] - Q(s, a_E).

    l(a) is 0 for the expert's action a_E and `margin` for all others, so Q of a_E must be larger by
    `margin` (arXiv:1704.03732, equation 1). `expert` (B,) bool marks the expert's rows. The mean is
    over all B rows, so the term is small in a batch with few expert rows.
    """
    others = torch.full_like(q, margin).scatter_(1, action.unsqueeze(1), 0.0)
    chosen = q.gather(1, action.unsqueeze(1)).squeeze(1)
    return (((q + others).amax(dim=1) - chosen) * expert).mean()
