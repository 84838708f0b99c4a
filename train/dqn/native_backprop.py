"""The compiled update behind tensors (`restock.native` says whether there is one).

`NativeBackprop` is `ManualBackprop` with a call each way, `native_td_loss` the loss and its
gradient in one. They are equal up to the rounding of sums: `tests/train/test_native.py`.
"""

from __future__ import annotations

from torch import Tensor, nn

from restock.native import compiled
from restock.train.dqn.loss import Loss
from restock.train.dqn.network import QNetwork


class NativeBackprop:
    """A plain `QNetwork` on flat parameters, evaluated and, where it learns, differentiated.

    For one thread at a time; while it computes, other threads run.

    Args:
        network: float32, on the CPU, its parameters in `values` by `FlatParameters`.
        values: all parameters.
        gradient: where their gradients go; None where it does not learn.
        wide: whether AVX-512 may be used where there is one: the result is the same.

    Raises:
        TypeError: a network that it does not do.
    """

    def __init__(
        self,
        network: QNetwork,
        values: Tensor,
        gradient: Tensor | None = None,
        *,
        wide: bool = True,
    ) -> None:
        if network.value is not None:
            raise TypeError("the compiled update supports only a plain QNetwork")
        modules = list(network.body)
        widths = [module.out_features for module in modules if isinstance(module, nn.Linear)]
        norms = [module.eps for module in modules if isinstance(module, nn.LayerNorm)]
        self._actions = network.actions
        self._new = values.new_empty
        self._network = compiled.Network(
            (network.observation_size, *widths, network.actions),
            norms[0] if norms else -1.0,
            values.numpy(),
            None if gradient is None else gradient.numpy(),
            wide,
        )

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Action values (B, A) of each of the inputs (B, D), all of one length, in one pass."""
        out = self._new(len(inputs) * len(inputs[0]), self._actions)
        self._network.forward(tuple(each.numpy() for each in inputs), out.numpy())
        return out.chunk(len(inputs))

    def backward(self, gradient: Tensor) -> None:
        """Fill every parameter's `grad` from that of the first input's action values, (B, A)."""
        self._network.backward(gradient.numpy())


def native_td_loss(
    q: Tensor,
    next_target_q: Tensor,
    next_online_q: Tensor | None,
    plausible: Tensor | None,
    tail: Tensor,
    *,
    weight: Tensor | None,
    huber_delta: float,
) -> tuple[Loss, Tensor]:
    """`td_target` and `dqn_loss`, and `dqn_gradient` (B, A).

    `tail` (B, 3) is the end of packed rows: action, reward and discount. All but the loss, which is
    a mean, are those functions' to the last bit.
    """
    count = len(q)
    gradient, out = q.new_empty(q.shape), q.new_empty(2 * count + 1)
    target = next_target_q.numpy()
    compiled.td_loss(
        q.numpy(),
        target,
        target if next_online_q is None else next_online_q.numpy(),
        None if plausible is None else plausible.numpy(),
        tail.numpy(),
        None if weight is None else weight.numpy(),
        huber_delta,
        gradient.numpy(),
        out.numpy(),
    )
    return Loss(out[-1], out[:count], out[count:-1]), gradient


__all__ = ["NativeBackprop", "native_td_loss"]
