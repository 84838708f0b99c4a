"""Policies that add a teacher's preference to Q, and take the action with the largest sum.

`ProposalNetwork` prefers navigation's proposal by a margin: it takes another action only if Q of
that action is larger by more than the margin. So the policy begins as the stack that drives today,
and deviates where its values have learnt that deviating pays (safe policy improvement with a
baseline, arXiv:1712.06924). Its target chooses by the same rule, so Q is the value of this policy.

`FilteredNetwork` takes the best action by Q of those that a behaviour network finds plausible.

The behaviour network gives G(a|s). It learns by cross-entropy from the teacher's answers in visited
states, and from the teacher's logged actions. An action is plausible if G(a|s) is at least `ratio`
times the largest. Target values use only plausible actions, too (discrete BCQ, arXiv:1910.01708).
The teacher is queried where the agent goes, not where it drove itself (DAgger, arXiv:1011.0686).

G has a network of its own, because imitation and values pull a shared network apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from restock.arrays import F32, F64, Bools
from restock.state import Stateful
from restock.train.dqn.algorithm import make_network
from restock.train.dqn.config import PLANNER, TeacherConfig, TrainConfig
from restock.train.dqn.network import (
    Ensemble,
    FlatAdam,
    FlatParameters,
    Kernel,
    QNetwork,
    UpdatePath,
    averaging_rate,
    clone,
    differentiable,
)

Values = QNetwork | Ensemble
UNKNOWN = -1  # code of the action if the teacher was not queried or had no opinion
HIDDEN = (256, 256)  # widths of the behaviour network's layers
_LEARNING_RATE = 1e-3
_SEED = 1 << 32  # added to the run's seed: the sum is larger than any seed of a Q network


@dataclass(frozen=True)
class Labelled:
    """States, and the teacher's actions in them."""

    observation: Tensor  # (M, D) float32
    action: Tensor  # (M,) int64, or UNKNOWN


def plausible_actions(logits: Tensor, ratio: Tensor) -> Tensor:
    """Return which actions (B, A) bool have G(a|s) >= ratio * max G(.|s); at least one per row.

    Args:
        logits: (B, A), of which G is the softmax.
        ratio: () from 0 (every action is plausible) to 1 (only the likeliest one is).
    """
    return logits >= logits.amax(dim=1, keepdim=True) + ratio.log().to(logits.dtype)


def imitation_loss(logits: Tensor, action: Tensor) -> Tensor:
    """Return the mean of -log G(a|s) over the rows (M,) with a known action; 0 if none has one."""
    known = action != UNKNOWN
    losses = functional.cross_entropy(logits, action, ignore_index=UNKNOWN, reduction="none")
    return losses.sum() / known.sum().clamp_min(1)


class FilteredNetwork(nn.Module):
    """A network that gives Q for plausible actions and -inf for others."""

    ratio: Tensor

    def __init__(self, values: Values, behaviour: Values, ratio: Tensor | None = None) -> None:
        super().__init__()
        self.values, self.behaviour = values, behaviour
        self.observation_size, self.actions = values.observation_size, values.actions
        self.register_buffer("ratio", torch.zeros(()) if ratio is None else ratio)

    def forward(self, observation: Tensor) -> Tensor:
        """Return action values (B, A) of observations (B, D)."""
        plausible = plausible_actions(self.behaviour(observation), self.ratio)
        q: Tensor = self.values(observation)
        return q.masked_fill(~plausible, -torch.inf)


# Arrays W (A, D), b (A,) and k (D,) that read navigation's proposal from an observation o (D,):
# W @ o + b is largest for the proposed action; k @ o is 1 if there is a proposal, else 0.
Proposal = tuple[F64, F64, F64]


class ProposalNetwork(nn.Module):
    """A network that gives Q, plus `margin` for the action that navigation proposes, if any."""

    nearest: Tensor  # (A, D), W of `Proposal`
    offset: Tensor  # (A,), b of `Proposal`
    lead: Tensor  # (D,), margin * k of `Proposal`

    def __init__(self, values: Values, proposal: Proposal | None, margin: float) -> None:
        """Build the network; without a `proposal`, its buffers are 0 until weights are loaded."""
        super().__init__()
        self.values = values
        self.observation_size, self.actions = values.observation_size, values.actions
        shape = self.actions, self.observation_size
        nearest, offset, known = proposal or (
            np.zeros(shape),
            np.zeros(shape[0]),
            np.zeros(shape[1]),
        )
        for name, buffer in (("nearest", nearest), ("offset", offset), ("lead", margin * known)):
            self.register_buffer(name, torch.from_numpy(np.asarray(buffer, np.float32)))

    def preference(self, observation: Tensor) -> Tensor:
        """Return the amount added to each action value (B, A) of observations (B, D)."""
        near = functional.linear(observation, self.nearest, self.offset)
        proposed = near >= near.amax(dim=1, keepdim=True)
        return proposed * (observation @ self.lead)[:, None]

    def forward(self, observation: Tensor) -> Tensor:
        """Return action values (B, A) of observations (B, D)."""
        q: Tensor = self.values(observation)
        return q + self.preference(observation)


PolicyNetwork = Values | FilteredNetwork | ProposalNetwork


def make_behaviour(
    observation_size: int,
    actions: int,
    generator: torch.Generator | None = None,
) -> QNetwork:
    """Return a new behaviour network, whose softmax is G."""
    return QNetwork(observation_size, actions, hidden=HIDDEN, generator=generator)


def make_policy(
    config: TrainConfig, observation_size: int, actions: int, *, runs: int = 1
) -> PolicyNetwork:
    """Return a network to load the weights of a policy into, or of a mean of several `runs`."""
    values = _combine_runs([make_network(config, observation_size, actions) for _ in range(runs)])
    if config.teacher.source == PLANNER:
        return ProposalNetwork(values, None, config.teacher.margin)
    if not config.teacher.has_filter:
        return values
    behaviours = [make_behaviour(observation_size, actions) for _ in range(runs)]
    return FilteredNetwork(values, _combine_runs(behaviours))


def _combine_runs(networks: Sequence[QNetwork]) -> Values:
    return networks[0] if len(networks) == 1 else Ensemble(networks)


class Behaviour(Stateful):
    """The behaviour network, its optimizer, and the ratio that decides which actions are plausible.

    `average` is a copy of the network with the average of its weights: it is evaluated and kept.
    """

    STATE: ClassVar[tuple[str, ...]] = ("network", "average", "optimizer", "updates")

    def __init__(
        self,
        config: TeacherConfig,
        observation_size: int,
        actions: int,
        *,
        seed: int,
        device: torch.device,
        path: UpdatePath,
    ) -> None:
        generator = torch.Generator().manual_seed(_SEED + seed)
        self.network = make_behaviour(observation_size, actions, generator).to(device)
        self.average = clone(self.network)
        self.optimizer = FlatAdam(self.network, _LEARNING_RATE, compiled=path == "native")
        self._slow = FlatParameters(self.average, learns=False).values
        learns = self.optimizer
        self._logits = differentiable(path, self.network, learns.values, learns.gradient)
        self.updates = 0
        self.ratio = torch.tensor(config.ratio, device=device)
        self._floor = np.float32(self.ratio.log().cpu())  # plausible: logit >= largest logit + this

    def learn(self, labelled: Labelled) -> None:
        """Make one gradient step."""
        device = self.ratio.device
        self._fill_gradient(Labelled(labelled.observation.to(device), labelled.action.to(device)))
        self.updates += 1
        self.optimizer.step(self._slow, averaging_rate(self.updates))

    def move(self, labelled: Labelled, rate: Tensor) -> None:
        """Make one gradient step by operations on the device alone, without counting it."""
        self._fill_gradient(labelled)
        self.optimizer.move(self._slow, rate)

    def count(self, updates: int) -> None:
        """Count updates that were made by `move`."""
        self.updates += updates
        self.optimizer.count(updates)

    @property
    def moved(self) -> list[Tensor]:
        """Return all tensors that `move` changes."""
        return [*self.optimizer.moved, self._slow]

    def plausible(self, observation: F32) -> Bools:
        """Return which actions (B, A) are plausible in observations (B, D), by compiled code."""
        assert isinstance(self._logits, Kernel)
        logits = self._logits.values(observation)
        return np.asarray(logits >= logits.max(axis=1, keepdims=True) + self._floor)

    def _fill_gradient(self, labelled: Labelled) -> None:
        if isinstance(self._logits, Kernel):  # the same bits as autograd's, see below
            logits = torch.from_numpy(self._logits.values(labelled.observation.numpy()))
            likely, action = torch.log_softmax(logits, dim=1), labelled.action.numpy()
            known = np.flatnonzero(action != UNKNOWN)
            chosen = torch.zeros_like(likely)
            chosen.numpy()[known, action[known]] = np.float32(-1) / np.float32(max(len(known), 1))
            gradient = torch._log_softmax_backward_data(chosen, likely, 1, likely.dtype).numpy()
            self._logits.descend(gradient)
            return
        self._logits.zero_grad(set_to_none=False)
        loss = imitation_loss(self._logits(labelled.observation), labelled.action)
        loss.backward()  # type: ignore[no-untyped-call]

    @torch.no_grad()
    def preference(self, observation: Tensor) -> Tensor:
        """Return 0 for plausible actions (B, A) in observations (B, D), -inf for others."""
        plausible = plausible_actions(self._logits(observation), self.ratio)
        return torch.where(plausible, 0.0, -torch.inf)
