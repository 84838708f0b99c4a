"""The Q network forward and backward, written out: what autograd would do, with less around it.

One pass over several inputs at once keeps what the backward pass needs, which writes every
parameter's gradient where the optimizer looks for it.
Per layer, with x the layer's input (B, I), z = x W^T + b and g the gradient that comes in:

    h = relu(layer_norm(z))                     forward
    g = g * [h > 0]                             backward: ReLU,
    g, dgamma, dbeta = layer_norm'(g, z)        LayerNorm (arXiv:1607.06450),
    dW = g^T x,  db = sum_i g_i,  g = g W       and the product

`tests/train/test_manual_backprop.py` compares it with autograd in double precision. It does the
plain network alone: a dueling head keeps to autograd. Where the compiled update is
(`native_backprop.py`), that does the same in its place.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from restock import native
from restock.train.dqn.config import NetworkConfig
from restock.train.dqn.native_backprop import NativeBackprop
from restock.train.dqn.network import QNetwork
from restock.train.dqn.products import affine, product, product_into

UpdatePath = Literal["native", "manual", "autograd"]


def update_path(network: NetworkConfig, device: str, threads: int = 1) -> UpdatePath:
    """Which way a run's gradients are made; `config.json` says it as `update_path`.

    The compiled way computes on one thread of the CPU: a run that asks for more, or for another
    device, has PyTorch's operations.
    """
    if network.dueling:
        return "autograd"
    on_cpu = torch.device(device).type == "cpu"
    return "native" if on_cpu and threads == 1 and native.is_used() else "manual"


class _Affine:
    """The tensors of a Linear or a LayerNorm: weight, bias, and where their gradients go."""

    def __init__(self, module: nn.Linear | nn.LayerNorm) -> None:
        self.weight, self.bias = module.weight.detach(), module.bias.detach()
        self.weight_gradient, self.bias_gradient = module.weight.grad, module.bias.grad


class _Layer:
    """A hidden layer, and what its last forward pass left for the backward one."""

    def __init__(self, linear: nn.Linear) -> None:
        self.linear = _Affine(linear)
        self.norm: _Affine | None = None
        self.shape, self.eps = (linear.out_features,), 0.0  # of the norm
        empty = self.linear.weight.new_empty(0)
        self.before = self.after = empty  # (n, H) z and h
        self.mean = self.inverse_deviation = empty  # (n, 1) of z


class ManualBackprop:
    """A plain `QNetwork`, evaluated and, where its parameters have gradients, differentiated.

    Made after `FlatParameters`: it keeps hold of the parameters and gradients that it finds.

    Raises:
        TypeError: a network that it does not do.
    """

    def __init__(self, network: QNetwork) -> None:
        if network.value is not None:
            raise TypeError("manual backpropagation supports only a plain QNetwork")
        self._head = _Affine(network.advantage)
        self._layers: list[_Layer] = []
        for module in network.body:
            if isinstance(module, nn.Linear):
                self._layers.append(_Layer(module))
            elif isinstance(module, nn.LayerNorm):
                self._layers[-1].norm, self._layers[-1].eps = _Affine(module), module.eps
        self._input = self._head.weight.new_empty(0, network.observation_size)  # (B, D), the first

    @torch.no_grad()
    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Action values (B, A) of each of the inputs (B, D), all of one length, in one pass."""
        # Inputs are columns of wider rows: products of such take oneDNN a hundred times as long.
        hidden = inputs[0].contiguous() if len(inputs) == 1 else torch.cat(inputs)
        self._input = hidden[: len(inputs[0])]
        for layer in self._layers:
            linear, norm = layer.linear, layer.norm
            hidden = affine(hidden, linear.weight, linear.bias, relu=norm is None)
            if norm is not None:
                layer.before = hidden
                hidden, layer.mean, layer.inverse_deviation = torch.native_layer_norm(
                    hidden, layer.shape, norm.weight, norm.bias, layer.eps
                )
                hidden.relu_()
            layer.after = hidden
        return affine(hidden, self._head.weight, self._head.bias).chunk(len(inputs))

    @torch.no_grad()
    def backward(self, gradient: Tensor) -> None:
        """Fill every parameter's `grad` from that of the first input's action values, (B, A)."""
        count = len(self._input)
        _fill(self._head, gradient, self._layers[-1].after[:count])
        down = product(gradient, self._head.weight)
        for index in range(len(self._layers) - 1, -1, -1):
            layer = self._layers[index]
            torch.ops.aten.threshold_backward.grad_input(
                down, layer.after[:count], 0, grad_input=down
            )
            if (norm := layer.norm) is not None:
                down, weight, bias = torch.ops.aten.native_layer_norm_backward(
                    down,
                    layer.before[:count],
                    layer.shape,
                    layer.mean[:count],
                    layer.inverse_deviation[:count],
                    norm.weight,
                    norm.bias,
                    [True, True, True],
                )
                _required(norm.weight_gradient).copy_(weight)
                _required(norm.bias_gradient).copy_(bias)
            below = self._layers[index - 1].after[:count] if index else self._input
            _fill(layer.linear, down, below)
            if index:
                down = product(down, layer.linear.weight)


def make_backprop(
    path: UpdatePath, network: QNetwork, values: Tensor, gradient: Tensor | None = None
) -> ManualBackprop | NativeBackprop | None:
    """What differentiates `network`, whose parameters are in `values`; None: autograd does."""
    if path == "native":
        return NativeBackprop(network, values, gradient)
    return ManualBackprop(network) if path == "manual" else None


def _fill(linear: _Affine, gradient: Tensor, given: Tensor) -> None:
    """The gradients of a Linear from that of its output (B, O) and its input (B, I)."""
    product_into(_required(linear.weight_gradient), gradient.t(), given)
    torch.sum(gradient, 0, out=_required(linear.bias_gradient))


def _required(gradient: Tensor | None) -> Tensor:
    if gradient is None:
        raise RuntimeError("this network does not learn: its parameters have no gradients")
    return gradient
