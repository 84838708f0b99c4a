"""Check target updates, by hand and on the two-clocks example."""

import pytest
import torch
from torch import nn

from restock.train.dqn.config import Hard, Polyak, describe
from restock.train.dqn.learner import TargetUpdate, value_lag


class ScalarEstimate(nn.Module):
    """Module with one parameter."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.value = nn.Parameter(torch.tensor([value], dtype=torch.float64))


def test_hard_target_of_two_clocks_example() -> None:
    """Update one state with a self-loop (reward 1, discount .5)."""
    online, target = ScalarEstimate(0.0), ScalarEstimate(0.0)
    clock = TargetUpdate(Hard(every=3), online.parameters(), target.parameters())
    history = []
    for step in range(1, 5):
        with torch.no_grad():
            goal = 1.0 + 0.5 * target.value
            online.value += 0.5 * (goal - online.value)
        moved = clock.after(step)
        history.append((float(online.value), float(target.value), moved, clock.last_sync))
    assert history == [
        (0.5, 0.0, False, 0),
        (0.75, 0.0, False, 0),
        (0.875, 0.875, True, 3),
        (1.15625, 0.875, False, 3),  # 0.875 + 0.5 * (1 + 0.5 * 0.875 - 0.875)
    ]


def test_polyak_by_hand() -> None:
    online, target = ScalarEstimate(1.0), ScalarEstimate(0.0)
    clock = TargetUpdate(Polyak(tau=0.1), online.parameters(), target.parameters())
    values = []
    for step in range(1, 4):
        assert clock.after(step)
        values.append(float(target.value))
    assert values == pytest.approx([0.1, 0.19, 0.271])  # 1 - 0.9**n
    assert clock.last_sync == 3


def test_distance_is_relative_to_the_online_parameters() -> None:
    online, target = ScalarEstimate(4.0), ScalarEstimate(3.0)
    clock = TargetUpdate(Hard(every=2), online.parameters(), target.parameters())
    assert clock.distance() == pytest.approx(0.25)
    clock.after(2)
    assert clock.distance() == 0.0


def test_value_lag_by_hand() -> None:
    q, slow = torch.tensor([[1.0, -3.0]]), torch.tensor([[0.0, -2.0]])
    assert value_lag(q, slow) == pytest.approx(1.0 / 2.0)


def test_rule_describes_its_effective_lag() -> None:
    assert describe(Polyak(tau=0.005)) == {
        "rule": "polyak",
        "tau": 0.005,
        "effective_lag_updates": 200.0,
    }
    assert describe(Hard(every=1000))["effective_lag_updates"] == 500
