"""One update: the loss of a batch of packed rows, a step of Adam, a step of the target.

Two clocks run in DQN: the online network moves at every update, the target network by its own
rule. The rule decides how old the values are that the critic learns from, so it is a typed value
that is in the config, metrics and checkpoints of a run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import ClassVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from restock.errors import ConfigError
from restock.state import Stateful
from restock.train.dqn.algorithm import DQN, Loss, TrainingBatch, make_algorithm, make_network
from restock.train.dqn.behaviour import (
    Behaviour,
    FilteredNetwork,
    Labelled,
    PolicyNetwork,
    Proposal,
    ProposalNetwork,
)
from restock.train.dqn.config import PLANNER, Polyak, TargetRule, TrainConfig
from restock.train.dqn.network import (
    FlatAdam,
    FlatParameters,
    Kernel,
    UpdatePath,
    averaging_rate,
    clone,
    differentiable,
    update_path,
)


@dataclass(frozen=True)
class Terms:
    """Arguments of an update besides the rows (B, W)."""

    weight: Tensor | None  # (B,) importance weights; None: ones
    logged: int  # how many of the first rows the two terms below apply to
    conservative: float | Tensor  # weight of the CQL term, or one weight per such row (logged,)
    expert: Tensor | None  # (logged,) bool, rows that get the margin term; None: no row


class Learner(Stateful):
    """The online network, its target, its optimizer and the number of updates made.

    Batches are packed rows (B, 2D + 3) float32 as `restock.replay.sampling.packed_rows` says:
    `[observation | next_observation | action | reward | discount]`.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "network",
        "target_network",
        "policy_network",
        "optimizer",
        "gradient_steps",
        "target",
        "behaviour",
    )

    def __init__(
        self,
        config: TrainConfig,
        observation_size: int,
        actions: int,
        *,
        path: UpdatePath | None = None,
        proposal: Proposal | None = None,
    ) -> None:
        """Build the networks.

        Args:
            path: how gradients are computed, which changes only rounding; None: the fastest way.
            proposal: reads navigation's proposal from observations, if the proposal is the teacher.
        """
        self.device = open_device(config.device)
        self.algorithm = make_algorithm(config.loss)
        generator = torch.Generator().manual_seed(config.seed)
        self.network = make_network(config, observation_size, actions, generator).to(self.device)
        self.target_network = clone(self.network)
        self.policy_network = clone(self.network)
        self.path = path or update_path(config.device, config.threads)
        self.optimizer = FlatAdam(
            self.network,
            config.optimizer.learning_rate,
            compiled=self.path == "native",
        )
        self._policy = FlatParameters(self.policy_network, learns=False).values
        self._slow = FlatParameters(self.target_network, learns=False).values
        self.target = TargetUpdate(config.target, [self.optimizer.values], [self._slow])
        learns = self.optimizer
        # What the loss calls: the networks, or compiled kernels in their place.
        self._online = differentiable(self.path, self.network, learns.values, learns.gradient)
        self._target = differentiable(self.path, self.target_network, self._slow)
        self._has_kernels = type(self.algorithm) is DQN and type(self._online) is Kernel
        self.gradient_steps = 0
        self.behaviour: Behaviour | None = None
        self._preference: Callable[[Tensor], Tensor] | None = None
        self._acting: PolicyNetwork = self.network
        self.policy: PolicyNetwork = self.policy_network  # what is evaluated and kept
        if config.teacher.has_filter:
            self.behaviour = Behaviour(
                config.teacher,
                observation_size,
                actions,
                seed=config.seed,
                device=self.device,
                path=self.path,
            )
            ratio = self.behaviour.ratio
            self._preference = self.behaviour.preference
            self._acting = FilteredNetwork(self.network, self.behaviour.network, ratio)
            self.policy = FilteredNetwork(self.policy_network, self.behaviour.average, ratio)
        elif config.teacher.source == PLANNER:
            margin = config.teacher.margin
            acting = ProposalNetwork(self.network, proposal, margin).to(self.device)
            self._preference, self._acting = acting.preference, acting
            self.policy = ProposalNetwork(self.policy_network, proposal, margin).to(self.device)

    def update(
        self,
        rows: Tensor,
        *,
        weight: Tensor | None = None,
        logged: int = 0,
        conservative: float = 0.0,
        expert: Tensor | None = None,
        labelled: Labelled | None = None,
    ) -> Loss:
        """Make one gradient step on `rows`; the caller advances `self.target` afterwards.

        Args:
            rows: (B, 2D + 3) float32, on the learner's device.
            weight: (B,) importance weights, or None for ones.
            logged: how many of the first rows are from logs; the CQL term applies only to those.
            conservative: the weight of the CQL term.
            expert: (logged,) bool, which rows the margin term applies to; None: no row.
            labelled: a batch for the behaviour network, if there is one.
        """
        terms = Terms(weight, logged, conservative if logged else 0.0, expert)
        is_plain = terms.conservative == 0 and terms.expert is None
        fill = self._fill_by_kernels if is_plain and self._has_kernels else self._fill_gradient
        loss = fill(rows, terms)
        self.gradient_steps += 1
        # This also moves the average of weights, `policy_network`, which is evaluated and kept.
        self.optimizer.step(self._policy, averaging_rate(self.gradient_steps))
        if self.behaviour is not None and labelled is not None:
            self.behaviour.learn(labelled)
        return loss

    def move(
        self,
        rows: Tensor,
        terms: Terms,
        labelled: Labelled | None,
        rate: Tensor,
        behaviour_rate: Tensor,
    ) -> Loss:
        """Make an update by operations on the device alone, which a CUDA graph can repeat.

        A Polyak target is moved, too. `rate` and `behaviour_rate`, (), are the averaging rates of
        the weights of Q and of the behaviour network. The caller counts the update by `count`.
        """
        loss = self._fill_gradient(rows, terms)
        self.optimizer.move(self._policy, rate)
        if self.behaviour is not None and labelled is not None:
            self.behaviour.move(labelled, behaviour_rate)
        if isinstance(self.target.rule, Polyak):
            self.target.pull()
        return loss

    def count(self, updates: int, *, labelled: bool) -> None:
        """Count updates that were made by `move`."""
        self.gradient_steps += updates
        self.optimizer.count(updates)
        if self.behaviour is not None and labelled:
            self.behaviour.count(updates)
        if isinstance(self.target.rule, Polyak):
            self.target.last_sync = self.gradient_steps

    @property
    def moved(self) -> list[Tensor]:
        """Return all tensors that `move` changes."""
        slow = [] if self.behaviour is None else self.behaviour.moved
        return [*self.optimizer.moved, self._policy, self._slow, *slow]

    def _fill_gradient(self, rows: Tensor, terms: Terms) -> Loss:
        self._online.zero_grad(set_to_none=False)
        loss = self.algorithm.loss(self._online, self._target, self._batch(rows, terms))
        descended = loss.value if loss.penalty is None else loss.value + loss.penalty
        descended.backward()  # type: ignore[no-untyped-call]
        return Loss(loss.value.detach(), loss.td, loss.q)

    def _fill_by_kernels(self, rows: Tensor, terms: Terms) -> Loss:
        """Do what `_fill_gradient` does, bit for bit, by kernels: for DQN without CQL or margin."""
        parts = self._online, self._target, self.algorithm
        online, target, algorithm = cast("tuple[Kernel, Kernel, DQN]", parts)
        packed, count, size = rows.numpy(), len(rows), self.network.observation_size
        now, after = packed[:, :size], packed[:, size : 2 * size]
        slow = fast = target.values(after)
        q = online.values(now, after) if algorithm.settings.double else online.values(now)
        if algorithm.settings.double:
            q, fast = q[:count], q[count:]
        chooses = fast
        if self.behaviour is not None:
            chooses = np.where(self.behaviour.plausible(after), fast, -np.inf)
        elif self._preference is not None:
            chooses = fast + self._preference(torch.from_numpy(after)).numpy()
        weight = None if terms.weight is None else terms.weight.numpy()
        best = np.arange(count), chooses.argmax(axis=1)
        next_value = slow[best]
        if self.behaviour is None:
            next_value = np.minimum(next_value, fast[best])
        loss, gradient = algorithm.gradient(q, packed[:, 2 * size :], next_value, weight)
        online.descend(gradient)
        return loss

    def _batch(self, rows: Tensor, terms: Terms) -> TrainingBatch:
        parts = unpack(rows, self.network.observation_size)
        return TrainingBatch(
            *parts,
            weight=terms.weight,
            preference=None if self._preference is None else self._preference(parts[1]),
            lower=self.behaviour is None,
            logged=terms.logged,
            conservative=terms.conservative,
            expert=terms.expert,
        )

    @property
    def is_finite(self) -> bool:
        """Return whether all parameters are finite; a NaN or infinite gradient makes them NaN."""
        of_values = [self.optimizer.values]
        if self.behaviour is not None:
            of_values.append(self.behaviour.optimizer.values)
        return all(bool(torch.isfinite(values).all()) for values in of_values)

    @torch.no_grad()
    def td_error(self, rows: Tensor, *, online: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Return Q(s, a) - y (B,), Q(s) (B, A) and Q_target(s) (B, A) of rows, without learning.

        With `online`, the target y is computed with the online network, as if there were no lag.
        """
        batch = self._batch(rows, Terms(None, 0, 0.0, None))
        slow = self.network if online else self.target_network
        td = self.algorithm.loss(self.network, slow, batch).td
        return td, self.network(batch.observation), self.target_network(batch.observation)

    def greedy(self, observation: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return the best action (N,) of each observation (N, D), with the teacher's preference."""
        return greedy_actions(self._acting, observation)


class TargetUpdate(Stateful):
    """A target rule, applied to the parameters of two networks given in the same order."""

    STATE: ClassVar[tuple[str, ...]] = ("last_sync",)

    def __init__(
        self, rule: TargetRule, online: Iterable[torch.Tensor], target: Iterable[torch.Tensor]
    ) -> None:
        self.rule = rule
        self.last_sync = 0  # number of the last update after which the target moved
        self._online = list(online)
        self._target = list(target)

    def is_due(self, gradient_step: int) -> bool:
        """Return whether the target moves after update number `gradient_step` (from 1)."""
        return isinstance(self.rule, Polyak) or gradient_step % self.rule.every == 0

    @torch.no_grad()
    def after(self, gradient_step: int) -> bool:
        """Move the target if due after update `gradient_step` (from 1); return whether it moved.

        Do nothing if the target has already moved for this update, as in `Learner.move`.
        """
        if gradient_step == self.last_sync or not self.is_due(gradient_step):
            return False
        self.pull()
        self.last_sync = gradient_step
        return True

    @torch.no_grad()
    def pull(self) -> None:
        """Move the target by its rule, whether it is due or not."""
        for slow, fast in zip(self._target, self._online, strict=True):
            if isinstance(self.rule, Polyak):
                slow.lerp_(fast, self.rule.tau)
            else:
                slow.copy_(fast)

    @torch.no_grad()
    def distance(self) -> float:
        """Return |online - target| / |online| over all parameters (Euclidean norm)."""
        apart = torch._foreach_norm(torch._foreach_sub(self._online, self._target))
        size = torch._foreach_norm(self._online)
        total = torch.stack(list(size)).norm()
        return float(torch.stack(list(apart)).norm() / total.clamp_min(1e-12))


@torch.no_grad()
def value_lag(online_q: torch.Tensor, target_q: torch.Tensor) -> float:
    """Return mean |Q - Q_target| / mean |Q| over values (B, A)."""
    return float((online_q - target_q).abs().mean() / online_q.abs().mean().clamp_min(1e-12))


def unpack(rows: Tensor, observation_size: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Unpack rows into observation, next observation, action (int64), reward and discount."""
    size = observation_size
    return (
        rows[:, :size],
        rows[:, size : 2 * size],
        rows[:, 2 * size].long(),
        rows[:, 2 * size + 1],
        rows[:, 2 * size + 2],
    )


@torch.inference_mode()
def greedy_actions(network: PolicyNetwork, observation: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the best action (N,) of each observation (N, D), on the network's device."""
    device = next(network.parameters()).device
    values = network(torch.from_numpy(np.ascontiguousarray(observation)).to(device))
    best: NDArray[np.int64] = values.argmax(dim=1).cpu().numpy()
    return best


def open_device(name: str) -> torch.device:
    """Return the device.

    Raises:
        ConfigError: `cuda` is given, but PyTorch finds no CUDA device.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            f"this PyTorch ({torch.__version__}) sees no CUDA device",
            where="--device cuda",
            remedy="use --device cpu, or install a CUDA build of torch on a machine with a GPU",
        )
    return torch.device(name)
