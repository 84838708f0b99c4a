"""Check the Stable-Baselines3 buffer: n-step rows, continuous actions and rejected input."""

from pathlib import Path

import numpy as np
import pytest
from support.library_buffers import TASK, make_panel, make_store, run_tables, sb3_envs, sb3_model

from restock.errors import MixtureError, PanelError
from restock.replay.panel.panel import Panel

pytest.importorskip("stable_baselines3")

from restock.train.libraries.sb3_buffer import MixtureReplayBuffer, logged_commands


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_store(tmp_path_factory.mktemp("sb3"))


@pytest.fixture(scope="module")
def panel(store: Path) -> Panel:
    return make_panel(store, store.parent / "panel", n_step=3)


@pytest.mark.long
def test_fresh_rows_match_sb3_nstep_buffer(tmp_path: Path) -> None:
    from stable_baselines3.common.buffers import NStepReplayBuffer

    env = sb3_envs(2)
    arguments = (400, env.observation_space, env.action_space, "cpu", 2)
    buffer = MixtureReplayBuffer(*arguments, n_step=3, discount=0.9)
    theirs = NStepReplayBuffer(*arguments, n_steps=3, gamma=0.9)
    observation = env.reset()
    rng = np.random.default_rng(0)
    for _ in range(190):
        action = rng.integers(env.action_space.n, size=2)
        after, reward, done, infos = env.step(action)
        following = after.copy()
        for i in np.flatnonzero(done):
            following[i] = infos[i]["terminal_observation"]
        for one in (buffer, theirs):
            one.add(observation, following, action, reward, done, infos)
        observation = after
    ring = buffer.ring
    slots = np.flatnonzero(ring.meta["horizon"][: len(ring)] == 3)
    packed = buffer._samples(ring.rows[slots], buffer._fresh_actions[slots], None)
    place = {}
    for i in range(theirs.pos):
        for e in range(2):
            place[theirs.observations[i, e].tobytes()] = (i, e)
    for row, slot in enumerate(slots[:150]):
        i, e = place[packed.observations[row].numpy().tobytes()]
        np.testing.assert_array_equal(packed.actions[row], theirs.actions[i, e])
        rewards = theirs.rewards[i : i + 3, e]
        np.testing.assert_allclose(packed.rewards[row, 0], rewards @ 0.9 ** np.arange(3), rtol=1e-5)
        np.testing.assert_array_equal(
            packed.next_observations[row], theirs.next_observations[i + 2, e]
        )
        terminated = theirs.dones[i + 2, e] and not theirs.timeouts[i + 2, e]
        assert packed.discounts[row, 0] == pytest.approx(0 if terminated else 0.9**3)
        assert ring.meta["episode_step"][slot] <= 240


@pytest.mark.parametrize("given", ["table", "store"])
def test_sac_trains_on_continuous_actions_with_logs(panel, store, tmp_path, given):
    commands = logged_commands(panel.path, store) if given == "store" else None
    fed = {"panel": panel.path, "run": tmp_path / "run", "commands": commands, "n_step": 3}
    model = sb3_model(
        "SAC",
        sb3_envs(1, action="continuous"),
        {**fed, "audit_share": 1.0},
        buffer_size=500,
        learning_starts=20,
        batch_size=32,
        policy_kwargs={"net_arch": [16]},
    )
    model.learn(60)
    model.replay_buffer.close()
    batch = model.replay_buffer.sample(32)
    assert batch.actions.shape == (32, 2)
    assert (batch.actions.abs() <= 1).all()
    rows = model.replay_buffer._log_actions
    space = model.action_space
    physical = space.low + (rows + 1) / 2 * (space.high - space.low)
    index = panel.rows[:, panel.columns["action"]][:, 0].astype(int)
    driven = np.array(TASK.actions)[index] if commands is None else commands
    np.testing.assert_allclose(physical, np.clip(driven, space.low, space.high), atol=1e-6)
    audit = run_tables(tmp_path / "run")["audit"]
    assert {row["source"] for row in audit} == {"logs", "fresh"}
    assert all(row["td"] is None for row in audit)  # SAC does not report it


def test_unusable_weights_are_rejected(store: Path, tmp_path: Path) -> None:
    weighted = make_panel(store, tmp_path / "panel", n_step=3, post="full")
    env = sb3_envs(1)
    arguments = (100, env.observation_space, env.action_space)
    with pytest.raises(MixtureError, match="do not use any"):
        MixtureReplayBuffer(*arguments, panel=weighted).sample(1)
    unweighted = MixtureReplayBuffer(*arguments, panel=weighted, ignore_weights=True)
    assert len(unweighted.sample(3).rewards) == 3


def test_panel_of_another_task_is_rejected(store_path: Path, tmp_path: Path) -> None:
    other = make_panel(store_path, tmp_path / "other")
    env = sb3_envs(1)
    with pytest.raises(PanelError, match="its rows are of task"):
        MixtureReplayBuffer(100, env.observation_space, env.action_space, panel=other).sample(1)


def test_invalid_step_is_not_stored() -> None:
    env = sb3_envs(1)
    buffer = MixtureReplayBuffer(100, env.observation_space, env.action_space, "cpu", 1)
    size = env.observation_space.shape[0]
    for step, invalid in enumerate([False, False, True]):
        seen = np.full((1, size), step, np.float32)
        info = {"invalid": invalid, "TimeLimit.truncated": invalid}
        action, done = np.array([step]), np.array([invalid])
        buffer.add(seen, seen + 1, action, np.array([float(step)]), done, [info])
    np.testing.assert_array_equal(buffer.ring.rows[2], buffer.ring.rows[1])
    assert buffer._fresh_actions[2, 0] == 1
    assert buffer.feed.invalid_steps == 1
