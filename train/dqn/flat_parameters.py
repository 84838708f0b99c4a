"""A network's parameters as views of one tensor, so that one call moves all of them.

Adam's step, the target's pull and the average of weights are each one operation over one block of
memory, whatever the number of layers. The network stays what it is: its own parameters, by their
names, are the views.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

_ALIGNMENT = 16  # elements: every parameter begins on a cache line, as its own tensor would


class FlatParameters:
    """The parameters of `network`, moved into `values`; their gradients are views of `gradient`.

    `load_state_dict` and in-place writes go through the views. Whatever replaces a parameter's
    `.data` (`Module.to`) must come before.

    Args:
        network: whose parameters are moved.
        learns: whether they have gradients; else `gradient` is empty.
    """

    def __init__(self, network: nn.Module, *, learns: bool) -> None:
        parameters = list(network.parameters())
        self._shapes = [parameter.shape for parameter in parameters]
        self._offsets, size = [], 0
        for parameter in parameters:
            self._offsets.append(size)
            size += -(-parameter.numel() // _ALIGNMENT) * _ALIGNMENT
        self.values = parameters[0].detach().new_zeros(size)
        self.gradient = self.values.new_zeros(size if learns else 0)
        for parameter, view in zip(parameters, self.views(self.values), strict=True):
            view.copy_(parameter.detach())
            parameter.data = view
        if learns:
            self.values.grad = self.gradient
            for parameter, view in zip(parameters, self.views(self.gradient), strict=True):
                parameter.grad = view

    def views(self, flat: Tensor) -> list[Tensor]:
        """A tensor as long as `values`, parameter by parameter, in the network's order."""
        return [
            flat[offset : offset + shape.numel()].view(shape)
            for offset, shape in zip(self._offsets, self._shapes, strict=True)
        ]

    def flat_of(self, pieces: list[Tensor]) -> Tensor:
        """The inverse of `views`: a new tensor; what lies between parameters is 0."""
        flat = torch.zeros_like(self.values)
        for view, piece in zip(self.views(flat), pieces, strict=True):
            view.copy_(piece)
        return flat
