"""The loss of DQN, as pure functions that a test checks against hand arithmetic.

    y_i     = r_i + d_i * Q_target(s'_i, argmax_a Q(s'_i, a))        Double DQN, arXiv:1509.06461
    delta_i = Q(s_i, a_i) - y_i
    L       = mean_i w_i * huber(delta_i)

`d_i` is the discount of row i: gamma**n for an n-step row that bootstraps, 0 for one that
terminated. A truncated episode bootstraps: its d is not 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class Loss:
    """What one batch cost, and the parts that the record of the run keeps."""

    value: Tensor  # () float32, with gradient
    td: Tensor  # (B,) float32, Q(s, a) - y, without gradient
    q: Tensor  # (B,) float32, Q(s, a), without gradient


def td_target(
    reward: Tensor,
    discount: Tensor,
    next_target_q: Tensor,
    next_online_q: Tensor | None = None,
    plausible: Tensor | None = None,
) -> Tensor:
    """What Q(s, a) should be, (B,).

    Args:
        reward: (B,), the sum of the row's n discounted rewards.
        discount: (B,), gamma**n where the row bootstraps, else 0.
        next_target_q: (B, A), the target network at s'.
        next_online_q: (B, A), the online network at s': it selects the action that the target
            network evaluates (Double DQN). None lets the target network do both (DQN).
        plausible: (B, A) bool, at least one of each row: the actions at s' that may be selected
            (discrete BCQ, arXiv:1910.01708). None: all of them.
    """
    chooses = next_target_q if next_online_q is None else next_online_q
    if plausible is not None:
        chooses = chooses.masked_fill(~plausible, -torch.inf)
    best = chooses.argmax(dim=1, keepdim=True)
    return reward + discount * next_target_q.gather(1, best).squeeze(1)


def huber(error: Tensor, delta: float = 1.0) -> Tensor:
    """error**2 / 2 up to |error| = delta, then linear with slope delta; elementwise."""
    return functional.huber_loss(error, torch.zeros_like(error), reduction="none", delta=delta)


def dqn_loss(
    q: Tensor,
    action: Tensor,
    target: Tensor,
    *,
    weight: Tensor | None = None,
    huber_delta: float = 1.0,
) -> Loss:
    """The loss of action values `q` (B, A) at `action` (B,) int64 against `target` (B,).

    `weight` (B,) are importance weights, where sampling is corrected for; None is all ones.
    """
    chosen = q.gather(1, action.unsqueeze(1)).squeeze(1)
    td = chosen - target
    each = huber(td, huber_delta)
    value = each.mean() if weight is None else (each * weight).mean()
    return Loss(value, td.detach(), chosen.detach())


def conservative_penalty(
    q: Tensor, action: Tensor, return_to_go: Tensor | None = None, weight: float | Tensor = 1.0
) -> Tensor:
    """Discrete CQL's regulariser, () : mean of weight * (logsumexp_a Q(s, a) - Q(s, a_logged)).

    Pushes down the values of actions that the logs never took (arXiv:2006.04779, CQL(H)). With
    `return_to_go` (B,), not below what the logs are known to have got from there: Cal-QL's
    calibration (arXiv:2303.05479), so that online learning does not begin by unlearning. `weight`
    is of all rows or of each, (B,).
    """
    chosen = q.gather(1, action.unsqueeze(1)).squeeze(1)
    if return_to_go is not None:
        q = torch.maximum(q, return_to_go.unsqueeze(1))
    return ((q.logsumexp(dim=1) - chosen) * weight).mean()


def margin_penalty(q: Tensor, action: Tensor, expert: Tensor, margin: float) -> Tensor:
    """DQfD's large-margin term, () : mean of max_a [Q(s, a) + l(a)] - Q(s, a_E) over expert rows.

    l(a) is `margin` for every action but the expert's, so that the expert's must be better by that
    much (arXiv:1704.03732, equation 1). `expert` (B,) bool says which rows are an expert's; the
    mean is over all B rows, so a batch with few of them has little of it.
    """
    others = torch.full_like(q, margin).scatter_(1, action.unsqueeze(1), 0.0)
    chosen = q.gather(1, action.unsqueeze(1)).squeeze(1)
    return (((q + others).amax(dim=1) - chosen) * expert).mean()


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
