"""Stable-Baselines3 learns from logs and fresh rows, and the record says from which."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import pytest
from support.stores import recording_transitions, write_store

import restock  # noqa: F401 - registers the environment
from restock.errors import MixtureError, PanelError
from restock.ingest.profile.profile import load_profile
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.build import build_panel
from restock.replay.panel.panel import Panel
from restock.replay.store.store import Store

sb3 = pytest.importorskip("stable_baselines3")

from restock.train.libraries.sb3_buffer import (  # noqa: E402
    MixtureReplayBuffer,
    dqn_critic,
    logged_commands,
)

TASK = load_profile("warehouse_amr").task
MIXTURE = """
discount = 0.97
n_step = {n_step}
correction = {{pre = "none", post = "{post}"}}
[[strata]]
name = "wheel_slip"
share = 0.25
[each_condition]
share = "natural"
"""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recordings = [recording_transitions(index, task=TASK) for index in (1, 2)]
    return write_store(tmp_path_factory.mktemp("sb3") / "store", recordings, task=TASK)


@pytest.fixture(scope="module")
def panel_of(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Panel]:
    def made(n_step: int = 3, post: str = "none") -> Panel:
        out = tmp_path_factory.mktemp("panel") / "panel"
        with Store(store) as opened:
            return build_panel(opened, parse_mixture(MIXTURE.format(n_step=n_step, post=post)), out)

    return made


@pytest.fixture(scope="module")
def panel(panel_of: Callable[..., Panel]) -> Panel:
    return panel_of()


def envs(count: int, **arguments: Any) -> Any:
    from stable_baselines3.common.vec_env import DummyVecEnv

    made = [lambda: gymnasium.make("restock/Warehouse-v0", **arguments)] * count
    return DummyVecEnv(made)


def tables(run: Path) -> dict[str, list[dict[str, Any]]]:
    return {path.stem: pq.read_table(path).to_pylist() for path in run.glob("*.parquet")}


@pytest.fixture(scope="module")
def trained(panel: Panel, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    """A DQN after 40 updates on logs and some hundred environment steps."""
    run = tmp_path_factory.mktemp("runs") / "sb3"
    model = sb3.DQN(
        "MlpPolicy",
        envs(2),
        replay_buffer_class=MixtureReplayBuffer,
        replay_buffer_kwargs={
            "panel": panel.path,
            "run": run,
            "logs_share": 0.5,
            "n_step": 3,
            "audit_share": 0.2,
            "log_every": 60,
        },
        buffer_size=1000,
        learning_starts=40,
        train_freq=4,
        batch_size=64,
        policy_kwargs={"net_arch": [32]},
        seed=0,
        device="cpu",
    )
    model.replay_buffer.critic = dqn_critic(model)
    model.learn(0)  # sets up the logger; then the logs alone
    model.train(40, batch_size=64)
    model.learn(520, reset_num_timesteps=False)
    model.replay_buffer.close()
    return model, run


def test_dqn_trains_first_on_logs_then_on_both(trained: tuple[Any, Path], panel: Panel) -> None:
    model, run = trained
    feed = model.replay_buffer.feed
    assert feed.env_steps == model.num_timesteps == 520
    assert feed.batches == model._n_updates > 80
    found = tables(run)
    offline = [row for row in found["strata"] if row["phase"] == "offline"]
    logs = [row for row in found["strata"] if row["source"] == "logs"]
    fresh = [row for row in found["strata"] if row["source"] == "fresh"]
    assert sum(row["drawn_rows"] for row in logs) + sum(
        row["drawn_rows"] for row in fresh
    ) == 64 * (feed.batches)
    assert sum(row["drawn_rows"] for row in logs) == 40 * 64 + (feed.batches - 40) * 32
    assert {row["source"] for row in offline} == {"logs"}
    assert sum(row["drawn_rows"] for row in offline) == 40 * 64
    assert sum(row["updates"] for row in found["progress"]) == feed.batches


def test_the_quotas_are_met_exactly(trained: tuple[Any, Path], panel: Panel) -> None:
    _, run = trained
    logs = [row for row in tables(run)["strata"] if row["source"] == "logs"]
    drawn: dict[str, int] = {}
    for row in logs:
        drawn[row["stratum"]] = drawn.get(row["stratum"], 0) + row["drawn_rows"]
    total = sum(drawn.values())
    for stratum in panel.strata:
        assert abs(drawn[stratum.name] - stratum.share * total) < 2  # the rounding, twice
    assert drawn["wheel_slip"] == pytest.approx(0.25 * total, abs=2)


def test_audit_rows_lead_back_to_their_transitions(
    trained: tuple[Any, Path], panel: Panel, store: Path
) -> None:
    _, run = trained
    audit = tables(run)["audit"]
    logged = [row for row in audit if row["source"] == "logs"]
    fresh = [row for row in audit if row["source"] == "fresh"]
    assert logged
    assert fresh
    place = {int(t): i for i, t in enumerate(panel.meta["transition_id"].to_pylist())}
    with Store(store) as opened:
        conditions = dict(opened.sql("SELECT transition_id, condition FROM transitions").fetchall())
    for row in logged:
        packed = np.array(panel.rows[place[row["transition_id"]]])
        assert row["row_hash"] == hashlib.blake2b(packed.tobytes(), digest_size=8).hexdigest()
        assert row["condition"] == conditions[row["transition_id"]]
        assert row["age_days"] >= 0
    for row in fresh:
        assert 0 <= row["age_env_steps"] < 520
        assert row["behaviour_policy"] == "stable-baselines3"
    assert all(np.isfinite(row["td"]) and np.isfinite(row["q"]) for row in audit)


def test_td_errors_by_condition_are_recorded(trained: tuple[Any, Path]) -> None:
    _, run = trained
    rows = [row for row in tables(run)["strata"] if row["drawn_rows"]]
    assert all(row["td_abs_mean"] > 0 for row in rows)


def test_ended_episodes_are_labelled(trained: tuple[Any, Path]) -> None:
    model, run = trained
    ended = tables(run)["episodes"]
    assert len(ended) >= 2  # two environments, 260 steps each, 240 at most an episode
    buffer = model.replay_buffer
    for row in ended:
        slots = np.flatnonzero(buffer.ring.meta["episode"][: len(buffer.ring)] == row["episode"])
        assert len(slots) == row["steps"]
        codes = buffer.ring.condition(slots)
        assert (codes >= 0).all()
        held = {buffer.ring.conditions[code] for code in codes} - {"nominal"}
        assert held <= set(row["conditions"])
    assert buffer.feed.labels.unlabelled_episodes == 0


def test_the_run_can_be_queried(
    trained: tuple[Any, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    from restock import cli

    _, run = trained
    query = "SELECT source, sum(drawn_rows)::INT AS rows FROM strata GROUP BY ALL ORDER BY ALL"
    assert cli.main(["sql", str(run), query]) == 0
    assert "logs" in capsys.readouterr().out


def test_fresh_rows_are_what_the_environment_gave(tmp_path: Path) -> None:
    """Against Stable-Baselines3's own n-step buffer, fed the same steps."""
    from stable_baselines3.common.buffers import NStepReplayBuffer

    env = envs(2)
    arguments = (400, env.observation_space, env.action_space, "cpu", 2)
    mine = MixtureReplayBuffer(*arguments, n_step=3, discount=0.9)
    theirs = NStepReplayBuffer(*arguments, n_steps=3, gamma=0.9)
    observation = env.reset()
    rng = np.random.default_rng(0)
    for _ in range(190):
        action = rng.integers(env.action_space.n, size=2)
        after, reward, done, infos = env.step(action)
        following = after.copy()
        for i in np.flatnonzero(done):
            following[i] = infos[i]["terminal_observation"]
        for buffer in (mine, theirs):
            buffer.add(observation, following, action, reward, done, infos)
        observation = after
    ring = mine.ring
    slots = np.flatnonzero(ring.meta["horizon"][: len(ring)] == 3)
    packed = mine._samples(ring.rows[slots], mine._fresh_actions[slots], None)
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
        assert packed.discounts[row, 0] == pytest.approx(0.9**3)
        assert ring.meta["episode_step"][slot] <= 240


@pytest.mark.parametrize("given", ["table", "store"])
def test_sac_trains_on_the_continuous_face_with_logs(
    panel: Panel, store: Path, tmp_path: Path, given: str
) -> None:
    commands = logged_commands(panel, store) if given == "store" else None
    model = sb3.SAC(
        "MlpPolicy",
        envs(1, action="continuous"),
        replay_buffer_class=MixtureReplayBuffer,
        replay_buffer_kwargs={
            "panel": panel.path,
            "run": tmp_path / "run",
            "commands": commands,
            "n_step": 3,
            "audit_share": 1.0,
        },
        buffer_size=500,
        learning_starts=20,
        batch_size=32,
        policy_kwargs={"net_arch": [16]},
        seed=0,
        device="cpu",
    )
    model.learn(60)
    model.replay_buffer.close()
    batch = model.replay_buffer.sample(32)
    assert batch.actions.shape == (32, 2)
    assert (batch.actions.abs() <= 1).all()
    rows = model.replay_buffer._log_actions
    space = model.action_space
    if given == "table":  # scaled back they are the task's actions
        physical = space.low + (rows + 1) / 2 * (space.high - space.low)
        index = panel.rows[:, panel.columns["action"]][:, 0].astype(int)
        np.testing.assert_allclose(physical, np.array(TASK.actions)[index], atol=1e-6)
    else:
        inside = np.clip(commands, space.low, space.high)
        physical = space.low + (rows + 1) / 2 * (space.high - space.low)
        np.testing.assert_allclose(physical, inside, atol=1e-6)
    audit = tables(tmp_path / "run")["audit"]
    assert {row["source"] for row in audit} == {"logs", "fresh"}
    assert all(row["td"] is None for row in audit)  # SAC keeps it to itself


def test_weights_that_the_library_cannot_use_are_refused(
    panel_of: Callable[..., Panel],
) -> None:
    weighted = panel_of(post="full")
    env = envs(1)
    arguments = (100, env.observation_space, env.action_space)
    with pytest.raises(MixtureError, match="losses take none"):
        MixtureReplayBuffer(*arguments, panel=weighted)
    assert MixtureReplayBuffer(*arguments, panel=weighted, ignore_weights=True).size() == 0


def test_a_panel_of_another_task_is_refused(store_path: Path, tmp_path: Path) -> None:
    with Store(store_path) as opened:
        other = build_panel(
            opened, parse_mixture(MIXTURE.format(n_step=1, post="none")), tmp_path / "other"
        )
    env = envs(1)
    with pytest.raises(PanelError, match="its rows are of task"):
        MixtureReplayBuffer(100, env.observation_space, env.action_space, panel=other)


def test_a_blown_up_step_is_not_learnt_from() -> None:
    env = envs(1)
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
