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
    reward: Tensor, discount: Tensor, next_target_q: Tensor, next_online_q: Tensor | None = None
) -> Tensor:
    """What Q(s, a) should be, (B,).

    Args:
        reward: (B,), the sum of the row's n discounted rewards.
        discount: (B,), gamma**n where the row bootstraps, else 0.
        next_target_q: (B, A), the target network at s'.
        next_online_q: (B, A), the online network at s': it selects the action that the target
            network evaluates (Double DQN). None lets the target network do both (DQN).
    """
    if next_online_q is None:
        next_value = next_target_q.amax(dim=1)
    else:
        best = next_online_q.argmax(dim=1, keepdim=True)
        next_value = next_target_q.gather(1, best).squeeze(1)
    return reward + discount * next_value


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


def conservative_penalty(q: Tensor, action: Tensor) -> Tensor:
    """Discrete CQL's regulariser, () : mean of logsumexp_a Q(s, a) - Q(s, a_logged).

    Pushes down the values of actions that the logs never took (arXiv:2006.04779, CQL(H)).
    """
    chosen = q.gather(1, action.unsqueeze(1)).squeeze(1)
    return (q.logsumexp(dim=1) - chosen).mean()
