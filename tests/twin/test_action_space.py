"""Check both action spaces: an index into the table, or a continuous command."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import restock  # noqa: F401 - registers the environment
from restock.errors import ConfigError
from restock.train.twin.env.vector_env import WarehouseVectorEnv


@pytest.mark.parametrize("action", ["discrete", "continuous"])
def test_action_spaces_pass_gymnasium_checker(action: str) -> None:
    made = gymnasium.make("restock/Warehouse-v0", render_mode="rgb_array", action=action)
    check_env(made.unwrapped)


@pytest.mark.parametrize("action", ["discrete", "continuous"])
def test_make_vec_returns_native_environment(action: str) -> None:
    made = gymnasium.make_vec(
        "restock/Warehouse-v0",
        num_envs=3,
        vectorization_mode="vector_entry_point",
        nthread=2,
        action=action,
    )
    assert isinstance(made.unwrapped, WarehouseVectorEnv)
    assert made.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert made.spec is not None
    made.action_space.seed(0)
    observation, _ = made.reset(seed=3)
    for _ in range(3):
        assert made.observation_space.contains(observation)
        observation, earned, terminated, truncated, info = made.step(made.action_space.sample())
    assert earned.shape == terminated.shape == truncated.shape == (3,)
    assert ("action" in info) == (action == "continuous")


def test_continuous_space_spans_task_actions() -> None:
    made = WarehouseVectorEnv(1, action="continuous")
    table = np.array(made.task.actions, np.float32)
    np.testing.assert_array_equal(made.single_action_space.low, table.min(axis=0))
    np.testing.assert_array_equal(made.single_action_space.high, table.max(axis=0))


def test_table_command_equals_its_index() -> None:
    discrete, continuous = WarehouseVectorEnv(4), WarehouseVectorEnv(4, action="continuous")
    np.testing.assert_array_equal(discrete.reset(seed=3)[0], continuous.reset(seed=3)[0])
    table = np.array(discrete.task.actions)
    rng = np.random.default_rng(0)
    for action in rng.integers(len(table), size=(30, 4)):
        by_index = discrete.step(action)
        by_command = continuous.step(table[action])
        np.testing.assert_array_equal(by_command[4]["action"], action)
        np.testing.assert_allclose(by_command[4]["action_residual"], 0, atol=1e-6)
        for left, right in zip(by_index[:4], by_command[:4], strict=True):
            np.testing.assert_allclose(left, right, atol=2e-4)  # float32 commands


def test_nan_command_is_rejected() -> None:
    made = WarehouseVectorEnv(2, action="continuous")
    made.reset(seed=0)
    with pytest.raises(ConfigError, match="environment 1 of the twin: an action must be two"):
        made.step(np.array([[0.0, 0.0], [np.nan, 0.0]]))


@pytest.mark.parametrize("index", [-1, 10, 0.7, np.nan])
def test_action_index_out_of_range_is_rejected(index: float) -> None:
    """Regression: -1 selected the last action, and .7 the first."""
    made = WarehouseVectorEnv(2)
    made.reset(seed=0)
    with pytest.raises(ConfigError, match="environment 1 of the twin: an action must be an index"):
        made.step(np.array([0, index]))
    made.step(np.array([0.0, 9.0]))
