"""The Q network: observation to one value per action, and how it is differentiated.

A LayerNorm MLP. LayerNorm bounds how far values can extrapolate away from the data, which is what
keeps off-policy learning on logs and fresh experience together stable (RLPD, arXiv:2302.02948).

Compiled code may make a plain network's forward and backward pass for PyTorch's autograd. That
kernel knows no loss: it gives action values, and takes their gradient. `restock.native` says
whether there is one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Literal, Protocol, TypeVar

import torch
from torch import Tensor, nn

from restock import native

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


UpdatePath = Literal["native", "autograd"]


class Differentiable(Protocol):
    """A network that learns, or the kernel that computes the same."""

    def __call__(self, observation: Tensor) -> Tensor:
        """Return action values (B, A) of observations (B, D)."""
        ...

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forget the gradient; False keeps its memory."""
        ...


def update_path(device: str, threads: int = 1) -> UpdatePath:
    """Return how a run's networks are differentiated; `config.json` keeps it as `update_path`.

    The kernel computes on one thread of the CPU. A run with more threads or on another device uses
    PyTorch's operations, as does a network that is not a plain `QNetwork`.
    """
    on_cpu = torch.device(device).type == "cpu"
    return "native" if on_cpu and threads == 1 and native.is_used() else "autograd"


def differentiable(
    path: UpdatePath, network: QNetwork, values: Tensor, gradient: Tensor | None = None
) -> Differentiable:
    """Return what a loss is computed with: a kernel, or the network itself.

    Args:
        path: which of both is wanted; only a plain `QNetwork` has a kernel.
        network: its parameters are in `values`, by `FlatParameters`.
        values: all parameters.
        gradient: their gradients; None if the network does not learn.
    """
    if path == "native" and type(network) is QNetwork:
        return Kernel(network, values, gradient)
    return network


class Kernel:
    """A plain `QNetwork` on flat parameters: observations (B, D) to action values (B, A).

    Gradients are added up until `zero_grad`, as autograd does. One thread at a time may use it;
    while it computes, other threads run.

    Args:
        network: float32, on the CPU, its parameters in `values` by `FlatParameters`.
        values: all parameters.
        gradient: where their gradients go; None if it does not learn.
        wide: whether AVX-512 may be used: the result is the same.
    """

    def __init__(
        self,
        network: QNetwork,
        values: Tensor,
        gradient: Tensor | None = None,
        *,
        wide: bool = True,
    ) -> None:
        modules = list(network.body)
        widths = [module.out_features for module in modules if isinstance(module, nn.Linear)]
        norms = [module.eps for module in modules if isinstance(module, nn.LayerNorm)]
        self._actions = network.actions
        self._gradient = gradient
        self._adds = False  # whether the next backward pass adds to the gradient or overwrites it
        self._passes = 0  # forward passes so far: only the last can be differentiated
        self._network = native.compiled.Network(
            (network.observation_size, *widths, network.actions),
            norms[0] if norms else -1.0,
            values.numpy(),
            None if gradient is None else gradient.numpy(),
            wide,
        )

    def __call__(self, observation: Tensor) -> Tensor:
        """Return action values (B, A); those of a network that learns are a leaf of the graph.

        Their gradient goes through the kernel as soon as autograd has all of it.
        """
        values = self._forward(observation)
        if self._gradient is not None and torch.is_grad_enabled():
            made_by = self._passes
            values.requires_grad_().register_post_accumulate_grad_hook(  # type: ignore[no-untyped-call]
                lambda leaf: self._backward(observation, made_by, leaf.grad)
            )
        return values

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Let the next backward pass overwrite the gradient instead of adding to it."""
        self._adds = False

    def _forward(self, observation: Tensor) -> Tensor:
        out = observation.new_empty(len(observation), self._actions)
        self._network.forward((observation.numpy(),), out.numpy())
        self._passes += 1
        return out

    def _backward(self, observation: Tensor, made_by: int, gradient: Tensor | None) -> None:
        assert self._gradient is not None
        assert gradient is not None
        if made_by != self._passes:  # another pass has overwritten what this one left
            self._forward(observation)
        earlier = self._gradient.clone() if self._adds else None
        self._network.backward(gradient.contiguous().numpy())
        if earlier is not None:
            self._gradient.add_(earlier)
        self._adds = True
