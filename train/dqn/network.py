"""The Q network: observation to one value per action.

A LayerNorm MLP. LayerNorm bounds how far values can extrapolate away from the data, which is what
keeps off-policy learning on logs and fresh experience together stable (RLPD, arXiv:2302.02948).
`dueling` splits the head into a value and advantages (arXiv:1511.06581), `quantiles` makes each
value the mean of a distribution (QR-DQN, arXiv:1710.10044), and an `Ensemble` holds several.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar, cast

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from restock.train.dqn.config import NetworkConfig

N = TypeVar("N", bound=nn.Module)


class QNetwork(nn.Module):
    """Observations (B, D) float32 to action values (B, A) float32."""

    def __init__(
        self,
        observation_size: int,
        actions: int,
        *,
        hidden: Sequence[int] = (256, 256),
        layer_norm: bool = True,
        dueling: bool = False,
        quantiles: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.observation_size, self.actions = observation_size, actions
        self.quantiles = quantiles
        layers: list[nn.Module] = []
        width = observation_size
        for size in hidden:
            layers.append(nn.Linear(width, size))
            if layer_norm:
                layers.append(nn.LayerNorm(size))
            layers.append(nn.ReLU())
            width = size
        self.body = nn.Sequential(*layers)
        self.advantage = nn.Linear(width, actions * max(quantiles, 1))
        self.value = nn.Linear(width, max(quantiles, 1)) if dueling else None
        self._initialise(generator)

    @property
    def members(self) -> list[QNetwork]:
        """The networks that this one is made of: itself."""
        return [self]

    def _initialise(self, generator: torch.Generator | None) -> None:
        """PyTorch's initialisation of a Linear layer, but from a generator of ours."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                bound = module.in_features**-0.5
                with torch.no_grad():
                    module.weight.uniform_(-bound, bound, generator=generator)
                    module.bias.uniform_(-bound, bound, generator=generator)

    def forward(self, observation: Tensor) -> Tensor:
        """Action values (B, A)."""
        if self.quantiles:
            return self.distribution(observation).mean(dim=2)
        features = self.body(observation)
        advantage: Tensor = self.advantage(features)
        if self.value is None:
            return advantage
        value: Tensor = self.value(features)
        return value + advantage - advantage.mean(dim=1, keepdim=True)

    def distribution(self, observation: Tensor) -> Tensor:
        """The quantiles of each action's return, (B, A, N), at (i + 1/2) / N."""
        features = self.body(observation)
        spread: Tensor = self.advantage(features).unflatten(1, (self.actions, self.quantiles))
        if self.value is None:
            return spread
        value: Tensor = self.value(features)
        return value.unsqueeze(1) + spread - spread.mean(dim=1, keepdim=True)


class Ensemble(nn.Module):
    """K networks that differ in their beginning: the mean acts, the least is believed.

    A target from the least of several is not the overestimate that one network's maximum is
    (arXiv:2101.05982).
    """

    def __init__(self, networks: Sequence[QNetwork]) -> None:
        super().__init__()
        self._members = nn.ModuleList(networks)
        self.observation_size, self.actions = networks[0].observation_size, networks[0].actions
        self.quantiles = networks[0].quantiles

    @property
    def members(self) -> list[QNetwork]:
        """The networks that this one is made of."""
        return cast("list[QNetwork]", list(self._members))

    def forward(self, observation: Tensor) -> Tensor:
        """Action values (B, A), the mean over the members'."""
        return torch.stack([member(observation) for member in self.members]).mean(dim=0)


Network = QNetwork | Ensemble


def make_network(
    config: NetworkConfig,
    observation_size: int,
    actions: int,
    generator: torch.Generator | None = None,
) -> Network:
    """The network that a run's config asks for."""
    networks = [
        QNetwork(
            observation_size,
            actions,
            hidden=config.hidden,
            layer_norm=config.layer_norm,
            dueling=config.dueling,
            quantiles=config.quantiles,
            generator=generator,
        )
        for _ in range(config.ensemble)
    ]
    return networks[0] if config.ensemble == 1 else Ensemble(networks)


def clone(network: N) -> N:
    """A copy that takes no gradients: the target network."""
    import copy

    copied = copy.deepcopy(network)
    for parameter in copied.parameters():
        parameter.requires_grad_(False)
    return copied
