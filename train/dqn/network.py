"""The Q network: observation to one value per action.

A LayerNorm MLP. LayerNorm bounds how far values can extrapolate away from the data, which is what
keeps off-policy learning on logs and fresh experience together stable (RLPD, arXiv:2302.02948).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import Tensor, nn

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
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.observation_size, self.actions = observation_size, actions
        layers: list[nn.Module] = []
        width = observation_size
        for size in hidden:
            layers.append(nn.Linear(width, size))
            if layer_norm:
                layers.append(nn.LayerNorm(size))
            layers.append(nn.ReLU())
            width = size
        self.body = nn.Sequential(*layers)
        self.advantage = nn.Linear(width, actions)
        self._initialise(generator)

    def _initialise(self, generator: torch.Generator | None) -> None:
        """PyTorch's initialisation of a Linear layer, but from a generator of ours."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                bound = module.in_features**-0.5
                with torch.no_grad():
                    module.weight.uniform_(-bound, bound, generator=generator)
                    module.bias.uniform_(-bound, bound, generator=generator)

    def forward(self, observation: Tensor) -> Tensor:
        """Return action values (B, A)."""
        features = self.body(observation)
        values: Tensor = self.advantage(features)
        return values


def clone(network: N) -> N:
    """Return a copy that takes no gradients: the target network."""
    import copy

    copied = copy.deepcopy(network)
    for parameter in copied.parameters():
        parameter.requires_grad_(False)
    return copied


@contextmanager
def torch_threads(number: int) -> Iterator[None]:
    """Set the number of torch's CPU threads while the block runs.

    Networks of this size are slower on several, many times so where other processes want the cores.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)
