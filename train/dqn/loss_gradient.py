"""The gradients of the loss with respect to the action values, by hand: (B, A), small and cheap.

Each function is the derivative of one in `restock.train.dqn.loss`, which stays the definition;
`tests/train/test_kernel.py` compares them with autograd. `manual_backprop` takes them from
here through the network.
"""

from __future__ import annotations

import torch
from torch import Tensor


def dqn_gradient(
    td: Tensor, action: Tensor, actions: int, *, weight: Tensor | None, huber_delta: float
) -> Tensor:
    """Of `dqn_loss`, (B, A): at the action taken, huber'(td) * weight / B; 0 elsewhere.

    Args:
        td: (B,) Q(s, a) - y.
        action: (B,) int64.
        actions: A.
        weight: (B,), or None for ones.
        huber_delta: where the error's slope stops growing.
    """
    slope = td.clamp(-huber_delta, huber_delta)
    if weight is not None:
        slope *= weight
    slope /= len(td)
    gradient = td.new_zeros(len(td), actions)
    return gradient.scatter_(1, action.unsqueeze(1), slope.unsqueeze(1))


def conservative_gradient(q: Tensor, action: Tensor, return_to_go: Tensor | None) -> Tensor:
    """Of `conservative_penalty`, (B, A): (softmax - one-hot of the logged action) / B.

    With `return_to_go` (B,), values below it have no gradient from the softmax.
    """
    if return_to_go is None:
        gradient = q.softmax(dim=1)
    else:
        floor = return_to_go.unsqueeze(1)
        gradient = torch.maximum(q, floor).softmax(dim=1) * (q > floor)
    chosen = action.unsqueeze(1)
    gradient.scatter_add_(1, chosen, gradient.new_full(chosen.shape, -1.0))
    gradient /= len(q)
    return gradient


def margin_gradient(q: Tensor, action: Tensor, expert: Tensor, margin: float) -> Tensor:
    """Of `margin_penalty`, (B, A): (one-hot of the best rival - one-hot of the expert's) / B.

    On rows that are an expert's; where the expert's action leads by the margin, the two are one.
    """
    chosen = action.unsqueeze(1)
    others = torch.full_like(q, margin).scatter_(1, chosen, 0.0)
    rival = (q + others).argmax(dim=1, keepdim=True)
    share = (expert.to(q.dtype) / len(q)).unsqueeze(1)
    return torch.zeros_like(q).scatter_add_(1, rival, share).scatter_add_(1, chosen, -share)
