"""A plain network's forward and backward pass in compiled code, for PyTorch's autograd.

The kernel knows no loss: it gives action values, and takes their gradient. `restock.native` says
whether there is one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor, nn

from restock import native
from restock.train.dqn.network import QNetwork

UpdatePath = Literal["native", "autograd"]


def update_path(device: str, threads: int = 1) -> UpdatePath:
    """Return how a run's networks are differentiated; `config.json` keeps it as `update_path`.

    The kernel computes on one thread of the CPU. A run with more threads or on another device uses
    PyTorch's operations, as does a network that is not a plain `QNetwork`.
    """
    on_cpu = torch.device(device).type == "cpu"
    return "native" if on_cpu and threads == 1 and native.is_used() else "autograd"


def differentiable(
    path: UpdatePath, network: QNetwork, values: Tensor, gradient: Tensor | None = None
) -> Callable[[Tensor], Tensor]:
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

    Gradients are added to those that are there, as autograd does. One thread at a time may use it;
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
        # What one backward pass writes, before it is added to the gradient.
        self._one_pass = None if gradient is None else torch.zeros_like(gradient)
        self._anchor = torch.zeros((), requires_grad=True)  # lets autograd record the function
        self._passes = 0  # forward passes so far: only the last can be differentiated
        self._network = native.compiled.Network(
            (network.observation_size, *widths, network.actions),
            norms[0] if norms else -1.0,
            values.numpy(),
            None if self._one_pass is None else self._one_pass.numpy(),
            wide,
        )

    def __call__(self, observation: Tensor) -> Tensor:
        """Return action values (B, A)."""
        if self._gradient is None or not torch.is_grad_enabled():
            return self._forward(observation)
        values: Tensor = _Differentiated.apply(  # type: ignore[no-untyped-call]
            self._anchor, observation, self
        )
        return values

    def _forward(self, observation: Tensor) -> Tensor:
        out = observation.new_empty(len(observation), self._actions)
        self._network.forward((observation.numpy(),), out.numpy())
        self._passes += 1
        return out

    def _backward(self, observation: Tensor, made_by: int, gradient: Tensor) -> None:
        if self._gradient is None or self._one_pass is None:
            raise RuntimeError("this network does not learn: its parameters have no gradients")
        if made_by != self._passes:  # another pass has overwritten what this one left
            self._forward(observation)
        self._network.backward(gradient.contiguous().numpy())
        self._gradient.add_(self._one_pass)


class _Differentiated(torch.autograd.Function):
    """The kernel as one operation of a graph."""

    @staticmethod
    def forward(ctx: Any, anchor: Tensor, observation: Tensor, kernel: Kernel) -> Tensor:
        values = kernel._forward(observation)
        ctx.kernel, ctx.observation, ctx.made_by = kernel, observation, kernel._passes
        return values

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, None, None]:
        ctx.kernel._backward(ctx.observation, ctx.made_by, gradients[0])
        return None, None, None


__all__ = ["Kernel", "UpdatePath", "differentiable", "update_path"]
