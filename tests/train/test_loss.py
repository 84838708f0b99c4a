"""Check the loss against hand calculations."""

import pytest
import torch
from torch import tensor

from restock.train.dqn.algorithm import conservative_penalty, dqn_loss, margin_penalty, td_target


def test_td_target_by_hand() -> None:
    # r = 1, gamma = 0.9, max_a Q_target(s') = 4 -> 1 + 0.9 * 4 = 4.6; terminal: the reward alone.
    target = td_target(
        reward=tensor([1.0, 1.0]),
        discount=tensor([0.9, 0.0]),
        next_target_q=tensor([[2.0, 4.0], [2.0, 4.0]]),
    )
    assert target.tolist() == pytest.approx([4.6, 1.0])


def test_double_dqn_evaluates_with_target_network() -> None:
    online = tensor([[9.0, 1.0]])  # prefers action 0
    slow = tensor([[2.0, 4.0]])  # values it 2, though its own best is worth 4
    reward, discount = tensor([1.0]), tensor([0.5])
    assert td_target(reward, discount, slow, online).tolist() == [2.0]  # 1 + 0.5 * 2
    assert td_target(reward, discount, slow, online, lower=True).tolist() == [2.0]
    assert td_target(reward, discount, slow, online / 9, lower=True).tolist() == [1.5]
    assert td_target(reward, discount, slow).tolist() == [3.0]  # 1 + 0.5 * 4


def test_preference_selects_but_adds_no_value() -> None:
    reward, discount = tensor([1.0]), tensor([0.5])
    slow, online = tensor([[4.0, 2.0, 8.0]]), tensor([[1.0, 3.0, 5.0]])
    implausible, proposed = tensor([[0, 0, -torch.inf]]), tensor([[9.0, 0, 0]])
    assert td_target(reward, discount, slow, online, implausible).tolist() == [1 + 0.5 * 2]
    assert td_target(reward, discount, slow, preference=implausible).tolist() == [1 + 0.5 * 4]
    assert td_target(reward, discount, slow, online, proposed).tolist() == [1 + 0.5 * 4]


def test_loss_by_hand() -> None:
    q = tensor([[1.0, 2.0], [3.0, 0.0]], requires_grad=True)
    loss = dqn_loss(q, tensor([1, 0]), tensor([1.5, 0.0]))
    # td = 2 - 1.5 = 0.5 and 3 - 0 = 3; huber 0.125 and 2.5; mean 1.3125
    assert loss.td.tolist() == [0.5, 3.0]
    assert loss.q.tolist() == [2.0, 3.0]
    assert loss.value.item() == pytest.approx(1.3125)
    loss.value.backward()
    assert q.grad is not None
    # Half of each error's clipped slope, and only at the actions taken.
    assert q.grad.tolist() == [[0.0, 0.25], [0.5, 0.0]]


def test_importance_weights_scale_each_row() -> None:
    q = tensor([[1.0, 2.0], [3.0, 0.0]])
    loss = dqn_loss(q, tensor([1, 0]), tensor([1.5, 0.0]), weight=tensor([2.0, 0.0]))
    assert float(loss.value) == pytest.approx(0.125)  # (2 * 0.125 + 0 * 2.5) / 2


def test_conservative_penalty_by_hand() -> None:
    q = tensor([[0.0, 0.0], [1.0, 3.0]])
    # log 2 - 0 = 0.6931; log(e + e^3) - 3 = 0.1269
    assert float(conservative_penalty(q, tensor([0, 1]))) == pytest.approx(0.4100, abs=1e-4)


def test_margin_by_hand() -> None:
    q = tensor([[1.0, 0.5], [1.0, 0.5], [2.0, 0.0]])
    # Expert 1 in rows 0 and 1: max(1 + 0.8, 0.5) - 0.5 = 1.3; in row 2 expert 0: max(2, 0.8) - 2.
    every = margin_penalty(q, tensor([1, 1, 0]), tensor([True, True, True]), 0.8)
    assert every.item() == pytest.approx(2.6 / 3)
    one = margin_penalty(q, tensor([1, 1, 0]), tensor([True, False, True]), 0.8)
    assert one.item() == pytest.approx(1.3 / 3)
