"""Check the learner on a corridor of four states whose optimal values are known."""

import numpy as np
import pytest
import torch

from restock.train.dqn.config import TrainConfig, parse_config
from restock.train.dqn.learner import Learner

STATES, GAMMA = 4, 0.9


def corridor() -> tuple[torch.Tensor, np.ndarray]:
    """Return packed rows (8, 11) of every state and action, and the optimal values (4, 2)."""
    rows, q = [], np.zeros((STATES, 2))
    following, reward, discount = (np.zeros((STATES, 2)) for _ in range(3))
    for state in range(STATES):
        for action, move in enumerate((-1, 1)):
            out = state + move == STATES
            following[state, action] = np.clip(state + move, 0, STATES - 1)
            reward[state, action], discount[state, action] = (1.0, 0.0) if out else (-0.05, GAMMA)
            now, after = np.eye(STATES)[[state, int(following[state, action])]]
            rows.append([*now, *after, action, reward[state, action], discount[state, action]])
    for _ in range(200):  # value iteration
        q = reward + discount * q.max(axis=1)[following.astype(int)]
    return torch.tensor(np.array(rows), dtype=torch.float32), q


def config(**settings: object) -> TrainConfig:
    document: dict[str, dict[str, object]] = {
        "network": {"hidden": [32, 32]},
        "loss": {"discount": GAMMA},
        "target": {"rule": "polyak", "tau": 0.1},
        "optimizer": {"learning_rate": 5e-3},
    }
    for path, value in settings.items():
        section, key = path.split("__")
        document[section][key] = value
    return parse_config(document, where="test")


def learn_values(settings: TrainConfig, updates: int = 500, **given: object) -> np.ndarray:
    """Return the values (4, 2) after learning from every row of the corridor."""
    rows, _ = corridor()
    learner = Learner(settings, STATES, 2)
    for step in range(1, updates + 1):
        learner.update(rows, **given)  # type: ignore[arg-type]
        learner.target.after(step)
    with torch.no_grad():
        return learner.network(torch.eye(STATES)).numpy()


@pytest.mark.parametrize("settings", [{}, {"loss__double": False}], ids=str)
def test_values_agree_with_value_iteration(settings: dict[str, object]) -> None:
    np.testing.assert_allclose(learn_values(config(**settings)), corridor()[1], atol=0.06)


def test_margin_makes_expert_action_greedy() -> None:
    rows, _ = corridor()
    backs = rows[:, 2 * STATES] == 0  # the expert always goes back
    values = learn_values(config(loss__margin=5.0), logged=len(rows), expert=backs)
    assert (values.argmax(axis=1) == 0).all()
    none = learn_values(
        config(loss__margin=5.0), logged=len(rows), expert=torch.zeros(8, dtype=torch.bool)
    )
    np.testing.assert_allclose(none, corridor()[1], atol=0.06)
