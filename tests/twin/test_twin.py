"""Check the twin's environments: Gymnasium's rules, determinism, state and the task's functions."""

import json
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import restock  # noqa: F401 - registers the environment
from restock.errors import ConfigError, RunError
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import SIGNALS, nearest_action, observe, reward
from restock.ingest.task.task import terminated as is_terminated
from restock.train.run import checkpoint
from restock.train.twin.env.drivers import PlannerFollower
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.physics.episode import EpisodeSpec
from restock.train.twin.physics.perturbation import PERTURBATIONS, Perturbation, find_perturbation

BRIEF = msgspec.structs.replace(load_profile("warehouse_amr").task, time_limit_steps=30)


def roll(env: WarehouseVectorEnv, steps: int, seed: int) -> list[np.ndarray]:
    """Return all results of `steps` random steps, as arrays."""
    rng = np.random.default_rng(seed)
    seen = []
    for action in rng.integers(env.single_action_space.n, size=(steps, env.num_envs)):
        observation, earned, terminated, truncated, info = env.step(action)
        seen.append(
            np.column_stack([observation, earned, terminated, truncated, info["true_pose"]])
        )
    return seen


@pytest.fixture(scope="module")
def env() -> Iterator[WarehouseVectorEnv]:
    made = WarehouseVectorEnv(8, seed=1)
    yield made
    made.close()


def test_single_and_vector_environments_agree() -> None:
    single = gymnasium.make("restock/Warehouse-v0").unwrapped
    vector = WarehouseVectorEnv(1)
    one, _ = single.reset(seed=11)
    many, _ = vector.reset(seed=11)
    np.testing.assert_array_equal(one, many[0])
    for action in (2, 2, 3, 7, 9):
        one, earned, *_ = single.step(action)
        many, earned_too, *_ = vector.step(np.array([action]))
        np.testing.assert_array_equal(one, many[0])
        assert earned == earned_too[0]


def test_seed_gives_same_run_with_any_threads() -> None:
    runs = []
    for nthread, record in ((1, False), (2, False), (1, True)):
        made = WarehouseVectorEnv(6, nthread=nthread)
        made.reset(seed=5)
        if record:
            made.set_block_callback(lambda state: None, 0.02)
        runs.append(np.array(roll(made, 50, 0)))
    np.testing.assert_array_equal(runs[0], runs[1])
    np.testing.assert_array_equal(runs[0], runs[2])


def test_episode_does_not_depend_on_its_slot() -> None:
    spec = EpisodeSpec("near_collision", 42)
    alone, among = WarehouseVectorEnv(1), WarehouseVectorEnv(4, seed=9)
    alone.set_episodes([spec])
    among.set_episodes([EpisodeSpec("nominal", 1), EpisodeSpec("wheel_slip", 2), spec])
    alone.reset(seed=0)
    among.reset(seed=3)
    for action in (2, 2, 4, 3, 2, 2, 0, 9):
        one = alone.step(np.array([action]))[0]
        many = among.step(np.full(4, action))[0]
        np.testing.assert_array_equal(one[0], many[2])


@pytest.mark.long
def test_saved_state_resumes_bit_exactly(env, tmp_path):
    env.reset(seed=2)
    env.simulation.apply(0, Perturbation(payload_kg=10.0))  # replaced by the episode's own on reset
    env.reset(seed=2)
    roll(env, 260, 0)  # across episode ends
    checkpoint.save(tmp_path / "state", env.state_dict())
    state = checkpoint.load(tmp_path / "state")
    expected = np.array(roll(env, 40, 1))
    env.load_state_dict(state)
    np.testing.assert_array_equal(np.array(roll(env, 40, 1)), expected)
    fresh = WarehouseVectorEnv(8, seed=77)
    fresh.reset()
    fresh.load_state_dict(state)
    np.testing.assert_array_equal(np.array(roll(fresh, 40, 1)), expected)


def test_state_of_another_environment_is_rejected(env: WarehouseVectorEnv) -> None:
    env.reset(seed=2)
    with pytest.raises(RunError, match="8 environments"):
        WarehouseVectorEnv(2).load_state_dict(env.state_dict())
    with pytest.raises(RunError, match="has no task_hash"):
        env.load_state_dict({})


@pytest.mark.parametrize("pickler", ["pickle", "cloudpickle"])
def test_unpickled_environment_has_same_settings(pickler: str) -> None:
    dumps = pytest.importorskip(pickler).dumps
    made = WarehouseVectorEnv(3, conditions={"wheel_slip": 1.0}, perturbation="friction", seed=5)
    first, _ = made.reset()
    roll(made, 5, 0)
    again = pickle.loads(dumps(made))
    with pytest.raises(gymnasium.error.ResetNeeded):
        again.step(np.zeros(3, int))
    np.testing.assert_array_equal(again.reset()[0], first)
    assert again.perturbation.name == "friction"
    assert set(again.episode_condition) == {"wheel_slip"}
    roll(made, 1, 0)  # the original continues

    single = gymnasium.make("restock/Warehouse-v0", seed=7, action="continuous")
    other = pickle.loads(dumps(single))
    assert other.spec == single.spec
    assert other.action_space == single.action_space
    np.testing.assert_array_equal(other.reset()[0], single.reset()[0])


def test_autoreset_keeps_the_final_observation() -> None:
    env = WarehouseVectorEnv(8, task=BRIEF)
    env.reset(seed=4)
    ended = 0
    for _ in range(env.task.time_limit_steps):
        before = env.episode_seed.copy()
        observation, _, terminated, truncated, info = env.step(np.zeros(8, np.int64))
        done = terminated | truncated
        if done.any():
            np.testing.assert_array_equal(info["_final_obs"], done)
            np.testing.assert_array_equal(info["episode_seed"], before)  # of the ended episode
            assert (env.episode_seed[done] != before[done]).all()
            assert (env.steps[done] == 0).all()
            assert not np.array_equal(info["final_obs"][done], observation[done])
            ended += int(done.sum())
    assert ended == 8  # standing still, every episode is truncated at the limit
    assert not terminated.any()


def test_disabled_autoreset_resets_masked_environments() -> None:
    made = WarehouseVectorEnv(3, autoreset_mode=AutoresetMode.DISABLED)
    made.reset(seed=1)
    for _ in range(5):
        made.step(np.full(3, 2))
    made.reset(options={"reset_mask": np.array([False, True, False])})
    assert made.steps.tolist() == [5, 0, 5]


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_step_matches_task_functions_and_fills_signals(kind: str) -> None:
    """Observe and reward a continuous command as its nearest action."""
    env = WarehouseVectorEnv(8, action=kind)
    env.reset(seed=6)
    env.action_space.seed(0)
    names = {signal.name for signal in SIGNALS}
    previous = np.zeros(8, np.int64)
    for _ in range(30):
        now = {name: column.copy() for name, column in env.signals.items()}
        assert set(now) == names
        given = env.action_space.sample()
        observation, earned, terminated, truncated, info = env.step(given)
        after = info["signals"]
        assert all(np.isfinite(after[signal.name]).all() for signal in SIGNALS)
        if kind == "discrete":
            action, command = given, np.array(env.task.actions)[given]
        else:
            command = given
            action, residual = nearest_action(env.task, given[:, 0], given[:, 1])
            np.testing.assert_array_equal(info["action"], action)
            np.testing.assert_allclose(info["action_residual"], residual)
        expected = reward(env.task, now, after, info["progress_m"], action, previous)
        going = ~(terminated | truncated)
        np.testing.assert_array_equal(earned, expected)
        np.testing.assert_array_equal(terminated, is_terminated(env.task, after))
        seen = observe(env.task, after, now, action)
        np.testing.assert_allclose(observation[going], seen[going], atol=1e-6)
        np.testing.assert_allclose(after["command_speed_mps"], command[:, 0])
        np.testing.assert_allclose(after["command_yaw_rate_radps"], command[:, 1])
        previous = np.where(going, action, 0)


def test_replanning_does_not_jump_progress() -> None:
    specs = [EpisodeSpec("blocked_aisle", seed) for seed in range(16)]
    made = WarehouseVectorEnv(16)
    made.set_episodes(specs)
    made.reset(seed=0)
    driver = PlannerFollower(epsilon=0.0)
    replans, largest = 0, 0.0
    for _ in range(100):
        numbers, begun = made.navigation.plan_number.copy(), made.episodes_begun.copy()
        action, _ = driver.act(made, made.observation)
        *_, info = made.step(action)
        again = (made.navigation.plan_number != numbers) & (made.episodes_begun == begun)
        replans += int(again.sum())
        largest = max(largest, float(np.abs(info["progress_m"][again]).max(initial=0.0)))
    assert replans >= 3
    assert largest < 0.4  # no more than .2 s of driving


def test_fixed_episodes_are_numbered_and_then_run_out() -> None:
    made = WarehouseVectorEnv(2, task=BRIEF)
    made.set_episodes([EpisodeSpec("nominal", seed) for seed in range(3)])
    _, info = made.reset(seed=0)
    assert info["episode_number"].tolist() == [0, 1]
    for _ in range(made.task.time_limit_steps):
        *_, info = made.step(np.zeros(2, np.int64))
    assert sorted(made.episode_number.tolist()) == [-1, 2]


def test_divergence_truncates_episode_and_is_counted(env, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env.reset(seed=8)
    count = env.diverged
    env.simulation.qvel[3, 0] = np.nan
    before = env.observation.copy()
    observation, earned, terminated, truncated, info = env.step(np.full(8, 2))
    assert info["invalid"].tolist() == [index == 3 for index in range(8)]
    assert truncated[3]
    assert not terminated[3]
    assert env.diverged == count + 1
    assert np.isfinite(observation).all()
    assert np.isfinite(earned).all()
    np.testing.assert_array_equal(info["final_obs"][3], before[3])
    observation, *_, info = env.step(np.full(8, 2))
    assert not info["invalid"].any()
    assert not list(tmp_path.iterdir())  # no MUJOCO_LOG.TXT in the working directory


def test_block_callback_samples_true_motion() -> None:
    made = WarehouseVectorEnv(2, conditions={"nominal": 1.0})
    made.reset(seed=3)
    states: list[Any] = []
    made.set_block_callback(states.append, 0.02)
    start = made.simulation.pose()
    for _ in range(5):
        *_, info = made.step(np.array([1, 1]))
    assert len(states) == 5 * 10
    np.testing.assert_allclose(np.diff([state.time_s[0] for state in states]), 0.02)
    travelled = np.sum([state.speed_mps for state in states], axis=0) * 0.02
    moved = np.hypot(*(made.simulation.pose() - start)[:, :2].T)
    np.testing.assert_allclose(travelled, moved, rtol=0.1)
    np.testing.assert_array_equal(states[-1].x_m, info["true_pose"][:, 0])


@pytest.mark.parametrize("name", sorted(PERTURBATIONS))
def test_every_shipped_perturbation_drives(name: str) -> None:
    made = WarehouseVectorEnv(4, perturbation=PERTURBATIONS[name])
    made.reset(seed=1)
    for seen in roll(made, 15, 0):
        assert np.isfinite(seen).all()
    assert made.diverged == 0


def test_schedule_draws_perturbation_per_episode(tmp_path: Path) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text('name = "fleet"\n[ranges]\npayload_kg = [0, 50]\nlatency_s = [0.05, 0.2]\n')
    schedule = find_perturbation(str(path), where="test")
    made = WarehouseVectorEnv(8, perturbation=schedule)
    _, info = made.reset(seed=4)
    assert set(info["perturbation"]) == {"fleet"}
    drawn = [spec.perturbation for spec in made.specs]
    loads = [item.payload_kg for item in drawn if item is not None]
    values = [json.loads(text) for text in info["perturbation_values"]]
    assert values == [item.changed() for item in drawn if item is not None]
    assert len(set(loads)) == 8
    assert 0 <= min(loads) <= max(loads) <= 50
    again = WarehouseVectorEnv(8, perturbation=schedule)
    again.reset(seed=4)
    assert again.specs == made.specs
    state = made.state_dict()
    expected = np.array(roll(made, 10, 0))
    made.load_state_dict(state)
    np.testing.assert_array_equal(np.array(roll(made, 10, 0)), expected)
    np.testing.assert_array_equal(made.perturbation_name, again.perturbation_name)
    path.write_text("[ranges]\npayload_kg = [0, 500]\n")
    with pytest.raises(ConfigError, match=r"payload_kg must rise within \[0, 150\]"):
        find_perturbation(str(path), where="test")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"conditions": {"ice": 1.0}}, "ice"),
        ({"render_mode": "human"}, "unknown render_mode 'human'"),
        ({"perturbation": Perturbation(timestep_s=0.003)}, "does not divide"),
        ({"perturbation": {"friction": 0.5}}, "unknown key `friction`"),
        ({"layouts": ["default", "default"]}, "layout names must be unique"),
    ],
)
def test_invalid_arguments_are_rejected(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        WarehouseVectorEnv(**arguments)


def test_rendered_map_shows_robot() -> None:
    made = WarehouseVectorEnv(1, render_mode="rgb_array")
    made.reset(seed=1)
    (frame,) = made.render()
    assert frame.shape == (400, 480, 3)
    x, y, _ = made.simulation.pose()[0]
    row, column = 400 - 1 - int(y * 40), int(x * 40)
    assert frame[row, column].tolist() == [240, 130, 30]  # orange: the robot
