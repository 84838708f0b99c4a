"""One update: a batch of packed rows to a loss, a step of Adam, a tick of the target's clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from restock.errors import ConfigError
from restock.state import Stateful
from restock.train.dqn.behaviour import Behaviour, FilteredNetwork, Labelled, PolicyNetwork
from restock.train.dqn.config import LossConfig, NetworkConfig, TrainConfig
from restock.train.dqn.flat_adam import FlatAdam, FlatParameters, averaging_rate
from restock.train.dqn.loss import (
    Loss,
    conservative_gradient,
    conservative_penalty,
    dqn_gradient,
    dqn_loss,
    margin_gradient,
    margin_penalty,
    td_target,
)
from restock.train.dqn.manual_backprop import (
    ManualBackprop,
    UpdatePath,
    make_backprop,
    update_path,
)
from restock.train.dqn.native_backprop import NativeBackprop, native_td_loss
from restock.train.dqn.network import QNetwork, clone, make_network
from restock.train.dqn.target import Polyak, TargetUpdate

_ByHand = ManualBackprop | NativeBackprop


@dataclass(frozen=True)
class Terms:
    """What an update is given beside the rows (B, W)."""

    weight: Tensor | None  # (B,) importance weights; None: ones
    logged: int  # how many of the first rows the terms below apply to
    conservative: float | Tensor  # weight of the CQL term, or that of each such row (logged,)
    return_to_go: Tensor | None  # (logged,)
    expert: Tensor | None  # (logged,) bool

    @property
    def has_conservative(self) -> bool:
        return isinstance(self.conservative, Tensor) or self.conservative > 0


class Learner(Stateful):
    """The online network, its target, its optimizer and how many updates they have seen.

    Batches are packed rows (B, 2D + 3) float32 as `restock.replay.mixture.packed_row` says:
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
    ) -> None:
        """`path` None takes the fastest that the config allows; both agree but for rounding."""
        self.device = open_device(config.device)
        self.loss: LossConfig = config.loss
        self.network: QNetwork = make_network(
            config.network,
            observation_size,
            actions,
            generator=torch.Generator().manual_seed(config.seed),
        ).to(self.device)
        self.target_network = clone(self.network)
        self.policy_network = clone(self.network)
        self.path = path or update_path(config.network, config.device, config.threads)
        self.optimizer = FlatAdam(
            self.network,
            config.optimizer.learning_rate,
            config.optimizer.max_grad_norm,
            compiled=self.path == "native",
        )
        self._policy = FlatParameters(self.policy_network, learns=False).values
        self._slow = FlatParameters(self.target_network, learns=False).values
        self.target = TargetUpdate(config.target, [self.optimizer.values], [self._slow])
        self.averaging = config.evaluation.averaging
        learns = self.optimizer
        self._backprop = make_backprop(self.path, self.network, learns.values, learns.gradient)
        self._target_backprop = make_backprop(self.path, self.target_network, self._slow)
        self.gradient_steps = 0
        self.behaviour: Behaviour | None = None
        self._acting: PolicyNetwork = self.network
        self.policy: PolicyNetwork = self.policy_network  # what is evaluated and kept
        if config.teacher.filters:
            self.behaviour = Behaviour(
                config.teacher,
                observation_size,
                actions,
                seed=config.seed,
                averaging=self.averaging,
                device=self.device,
                # Its network is plain, whatever Q's is.
                path=path or update_path(NetworkConfig(), config.device, config.threads),
            )
            ratio = self.behaviour.ratio
            self._acting = FilteredNetwork(self.network, self.behaviour.network, ratio)
            self.policy = FilteredNetwork(self.policy_network, self.behaviour.average, ratio)
        self._filters_target = config.teacher.target == "filtered"

    def update(
        self,
        rows: Tensor,
        *,
        weight: Tensor | None = None,
        logged: int = 0,
        conservative: float = 0.0,
        return_to_go: Tensor | None = None,
        expert: Tensor | None = None,
        labelled: Labelled | None = None,
    ) -> Loss:
        """One gradient step on `rows`; the target's clock is ticked by `self.target` afterwards.

        Args:
            rows: (B, 2D + 3) float32, on the learner's device.
            weight: (B,) importance weights, or None for ones.
            logged: how many of the first rows are from logs; the conservative term sees only those.
            conservative: the weight of that term.
            return_to_go: (logged,) what the logs got from each of them on, for Cal-QL.
            expert: (logged,) bool, whether the margin term applies, or None: to none.
            labelled: what the behaviour network learns from, where there is one.
        """
        terms = Terms(weight, logged, conservative if logged else 0.0, return_to_go, expert)
        loss = self._fill_gradient(rows, terms)
        self.gradient_steps += 1
        # `policy_network`, the one that is evaluated and kept, follows as an average of weights.
        self.optimizer.step(self._policy, self.averaging_rate(self.gradient_steps))
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
        """An update by operations on the device alone, which a CUDA graph can repeat.

        With the target's, where that follows at every update. Rates () are of the averages. The
        counts are the caller's to keep, by `count`.
        """
        loss = self._fill_gradient(rows, terms)
        self.optimizer.move(self._policy, rate)
        if self.behaviour is not None and labelled is not None:
            self.behaviour.move(labelled, behaviour_rate)
        if isinstance(self.target.rule, Polyak):
            self.target.pull()
        return loss

    def count(self, updates: int, *, labelled: bool) -> None:
        """That so many updates were made by `move`."""
        self.gradient_steps += updates
        self.optimizer.count(updates)
        if self.behaviour is not None and labelled:
            self.behaviour.count(updates)
        if isinstance(self.target.rule, Polyak):
            self.target.last_sync = self.gradient_steps

    def averaging_rate(self, update: int) -> float:
        """Of the average of weights, at update number `update` (from 1)."""
        return averaging_rate(self.averaging, update)

    @property
    def moved(self) -> list[Tensor]:
        """All that `move` moves."""
        slow = [] if self.behaviour is None else self.behaviour.moved
        return [*self.optimizer.moved, self._policy, self._slow, *slow]

    def _fill_gradient(self, rows: Tensor, terms: Terms) -> Loss:
        if self._backprop is not None and self._target_backprop is not None:
            return self._by_hand(self._backprop, self._target_backprop, rows, terms)
        return self._by_autograd(rows, terms)

    def _by_autograd(self, rows: Tensor, terms: Terms) -> Loss:
        """Fill the gradient from a graph: any network."""
        observation, next_observation, action, reward, discount = unpack(
            rows, self.network.observation_size
        )
        target = self._target(self.target_network, next_observation, reward, discount)
        logged, share = terms.logged, terms.logged / len(rows)
        q = self.network(observation)
        loss = dqn_loss(q, action, target, weight=terms.weight, huber_delta=self.loss.huber_delta)
        value = loss.value
        if terms.has_conservative:
            term = conservative_penalty(
                q[:logged], action[:logged], terms.return_to_go, terms.conservative
            )
            value = value + term * share
        if terms.expert is not None:
            term = margin_penalty(q[:logged], action[:logged], terms.expert, self.loss.margin_size)
            value = value + self.loss.margin * term * share
        self.optimizer.gradient.zero_()
        value.backward()  # type: ignore[no-untyped-call]
        return loss

    @torch.no_grad()
    def _by_hand(self, online: _ByHand, slow: _ByHand, rows: Tensor, terms: Terms) -> Loss:
        """Fill the gradient by hand: the plain network, with every term of the loss."""
        size, settings, logged = self.network.observation_size, self.loss, terms.logged
        observation, next_observation, action, reward, discount = unpack(rows, size)
        # Of Double DQN s and s' go through the online network together.
        inputs = (observation, next_observation) if settings.double else (observation,)
        q, *following = online.forward(*inputs)
        next_q = following[0] if following else None
        (slow_q,) = slow.forward(next_observation)
        plausible = self._plausible(next_observation)
        weight, delta = terms.weight, settings.huber_delta
        if self.path == "native":
            loss, gradient = native_td_loss(
                *(q, slow_q, next_q, plausible, rows[:, 2 * size :]),
                weight=weight,
                huber_delta=delta,
            )
        else:
            target = td_target(reward, discount, slow_q, next_q, plausible)
            loss = dqn_loss(q, action, target, weight=weight, huber_delta=delta)
            gradient = dqn_gradient(loss.td, action, q.shape[1], weight=weight, huber_delta=delta)
        share = logged / len(rows)
        if terms.has_conservative:
            term = conservative_gradient(q[:logged], action[:logged], terms.return_to_go)
            if isinstance(terms.conservative, Tensor):
                gradient[:logged].addcmul_(term, terms.conservative.unsqueeze(1), value=share)
            else:
                gradient[:logged].add_(term, alpha=terms.conservative * share)
        if terms.expert is not None:
            term = margin_gradient(q[:logged], action[:logged], terms.expert, settings.margin_size)
            gradient[:logged].add_(term, alpha=settings.margin * share)
        online.backward(gradient)
        return loss

    @torch.no_grad()
    def _target(
        self, slow: QNetwork, next_observation: Tensor, reward: Tensor, discount: Tensor
    ) -> Tensor:
        """What Q(s, a) should be, (B,), where `slow` evaluates the next action."""
        next_q = self.network(next_observation) if self.loss.double else None
        plausible = self._plausible(next_observation)
        return td_target(reward, discount, slow(next_observation), next_q, plausible)

    def _plausible(self, next_observation: Tensor) -> Tensor | None:
        """The actions (B, A) that the target's maximum may look at; None: all."""
        if self.behaviour is None or not self._filters_target:
            return None
        return self.behaviour.plausible(next_observation)

    @property
    def is_finite(self) -> bool:
        """Whether every parameter is: a gradient that is not finite leaves its mark on them."""
        of_values = [self.optimizer.values]
        if self.behaviour is not None:
            of_values.append(self.behaviour.optimizer.values)
        return all(bool(torch.isfinite(values).all()) for values in of_values)

    @torch.no_grad()
    def td_error(self, rows: Tensor, *, online: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Of rows, without learning: Q(s, a) - y (B,), Q(s) (B, A), Q_target(s) (B, A).

        `online` lets the online network bootstrap y, as if the target's clock did not lag.
        """
        observation, next_observation, action, reward, discount = unpack(
            rows, self.network.observation_size
        )
        slow = self.network if online else self.target_network
        target = self._target(slow, next_observation, reward, discount)
        q: Tensor = self.network(observation)
        return dqn_loss(q, action, target).td, q, self.target_network(observation)

    def greedy(self, observation: NDArray[np.float32]) -> NDArray[np.int64]:
        """The best action (N,) of each observation (N, D), among the plausible ones."""
        return greedy_actions(self._acting, observation)

    def take_over(self, weights: Mapping[str, Tensor]) -> None:
        """Put a kept policy's weights (of `policy`) into all networks; moments are forgotten."""
        ratio = None if self.behaviour is None else self.behaviour.in_force
        self.policy.load_state_dict(weights)
        kept = self.policy_network.state_dict()
        for network in (self.network, self.target_network):
            network.load_state_dict(kept)
        self.optimizer.forget()
        if self.behaviour is not None and ratio is not None:
            self.behaviour.in_force = ratio  # the run's, not that of when the policy was kept
            self.behaviour.network.load_state_dict(self.behaviour.average.state_dict())
            self.behaviour.optimizer.forget()


def unpack(rows: Tensor, observation_size: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Packed rows to observation, next observation, action (int64), reward and discount."""
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
    """The best action (N,) of each observation (N, D), on the network's device."""
    device = next(network.parameters()).device
    values = network(torch.from_numpy(np.ascontiguousarray(observation)).to(device))
    best: NDArray[np.int64] = values.argmax(dim=1).cpu().numpy()
    return best


def open_device(name: str) -> torch.device:
    """The device, checked.

    Raises:
        ConfigError: `cuda` where this PyTorch sees none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            f"this PyTorch ({torch.__version__}) sees no CUDA device",
            where="--device cuda",
            remedy="use --device cpu, or install a CUDA build of torch on a machine with a GPU",
        )
    return torch.device(name)
