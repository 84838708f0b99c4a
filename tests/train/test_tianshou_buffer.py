"""Tianshou learns from logs and fresh rows, and the record says from which."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from support.stores import recording_transitions, write_store

import restock  # noqa: F401 - registers the environment
from restock.errors import MixtureError
from restock.ingest.profile.profile import load_profile
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.build import build_panel
from restock.replay.panel.panel import Panel
from restock.replay.store.store import Store

pytest.importorskip("tianshou")

from tianshou.algorithm import DQN
from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Batch, Collector, CollectStats
from tianshou.env import DummyVectorEnv
from tianshou.trainer import OffPolicyTrainerParams
from tianshou.utils.net.common import Net

from restock.train.libraries.tianshou_buffer import MixtureVectorReplayBuffer

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
GAMMA = 0.97


@pytest.fixture(scope="module")
def panel_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Panel]:
    recordings = [recording_transitions(index, task=TASK) for index in (1, 2)]
    store = write_store(tmp_path_factory.mktemp("tianshou") / "store", recordings, task=TASK)

    def made(n_step: int = 1, post: str = "full") -> Panel:
        out = tmp_path_factory.mktemp("panel") / "panel"
        with Store(store) as opened:
            return build_panel(opened, parse_mixture(MIXTURE.format(n_step=n_step, post=post)), out)

    return made


@pytest.fixture(scope="module")
def panel(panel_of: Callable[..., Panel]) -> Panel:
    return panel_of()


def tables(run: Path) -> dict[str, list[dict[str, Any]]]:
    return {path.stem: pq.read_table(path).to_pylist() for path in run.glob("*.parquet")}


def dqn(n_step: int = 1) -> Any:
    torch.manual_seed(0)
    actions = gymnasium.spaces.Discrete(len(TASK.actions))
    net = Net(
        state_shape=(TASK.observation_size,), action_shape=len(TASK.actions), hidden_sizes=[32]
    )
    return DQN(
        policy=DiscreteQLearningPolicy(model=net, action_space=actions, eps_training=0.5),
        optim=AdamOptimizerFactory(lr=1e-3),
        gamma=GAMMA,
        n_step_return_horizon=n_step,
        target_update_freq=20,
    )


@pytest.fixture(scope="module")
def trained(panel: Panel, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path, Any]:
    """A buffer after 30 updates on logs, and some on logs and 500 fresh steps."""
    run = tmp_path_factory.mktemp("runs") / "tianshou"
    envs = DummyVectorEnv([lambda: gymnasium.make("restock/Warehouse-v0")] * 2)
    envs.seed(0)
    buffer = MixtureVectorReplayBuffer(
        1000, 2, panel=panel, run=run, logs_share=0.5, audit_share=0.3, log_every=25
    )
    algorithm = dqn()
    from tianshou.algorithm.algorithm_base import policy_within_training_step

    with policy_within_training_step(algorithm.policy):
        for _ in range(30):
            algorithm.update(buffer, 64)
    collector = Collector[CollectStats](algorithm, envs, buffer, exploration_noise=True)
    collector.reset()
    stats = algorithm.run_training(
        OffPolicyTrainerParams(
            training_collector=collector,
            max_epochs=1,
            epoch_num_steps=504,
            collection_step_num_env_steps=24,
            update_step_num_gradient_steps_per_sample=0.1,
            batch_size=64,
            show_progress=False,
            verbose=False,
        )
    )
    buffer.close()
    return buffer, run, stats


def test_dqn_trains_first_on_logs_then_on_both(trained: tuple[Any, Path, Any]) -> None:
    buffer, run, stats = trained
    feed, found = buffer.feed, tables(run)
    assert feed.env_steps == stats.train_step == 504
    assert feed.batches == 2 * stats.update_step + 30  # two gradient steps a collection
    offline = [row for row in found["strata"] if row["phase"] == "offline"]
    assert {row["source"] for row in offline} == {"logs"}
    assert sum(row["drawn_rows"] for row in offline) == 30 * 64
    by_source = {
        source: sum(r["drawn_rows"] for r in found["strata"] if r["source"] == source)
        for source in ("logs", "fresh")
    }
    assert by_source["fresh"] == (feed.batches - 30) * 32
    assert by_source["logs"] == 30 * 64 + by_source["fresh"]


def test_the_quotas_are_met_exactly(trained: tuple[Any, Path, Any], panel: Panel) -> None:
    _, run, _ = trained
    drawn: dict[str, int] = {}
    for row in tables(run)["strata"]:
        if row["source"] == "logs":
            drawn[row["stratum"]] = drawn.get(row["stratum"], 0) + row["drawn_rows"]
    for stratum in panel.strata:
        assert abs(drawn[stratum.name] - stratum.share * sum(drawn.values())) < 2


def test_audit_rows_lead_back_to_their_transitions(
    trained: tuple[Any, Path, Any], panel: Panel
) -> None:
    _, run, _ = trained
    audit = tables(run)["audit"]
    place = {int(t): i for i, t in enumerate(panel.meta["transition_id"].to_pylist())}
    sources = set()
    for row in audit:
        sources.add(row["source"])
        assert np.isfinite(row["td"])  # Tianshou hands its TD errors back
        if row["source"] == "logs":
            at = place[row["transition_id"]]
            packed = np.array(panel.rows[at])
            assert row["row_hash"] == hashlib.blake2b(packed.tobytes(), digest_size=8).hexdigest()
            assert row["weight"] == pytest.approx(float(panel.weights[at]), rel=1e-5)
            assert row["condition"] == panel.meta["condition"][at].as_py()
        else:
            assert 0 <= row["age_env_steps"] < 504
            assert row["weight"] == 1
    assert sources == {"logs", "fresh"}


def test_ended_episodes_are_labelled(trained: tuple[Any, Path, Any]) -> None:
    buffer, run, _ = trained
    ended = tables(run)["episodes"]
    assert len(ended) >= 2  # two environments, 252 steps each, 240 at most an episode
    fresh = buffer.fresh
    for row in ended:
        slots = np.flatnonzero(fresh.filled & (fresh.meta["episode"] == row["episode"]))
        assert len(slots) == row["steps"]
        codes = fresh.condition(slots)
        assert (codes >= 0).all()
        held = {fresh.conditions[code] for code in codes} - {"nominal"}
        assert held <= set(row["conditions"])
    assert buffer.feed.labels.unlabelled_episodes == 0


@pytest.mark.parametrize("n_step", [1, 3])
def test_targets_of_logs_are_of_single_steps_and_of_fresh_rows_tianshous_own(
    trained: tuple[Any, Path, Any], panel: Panel, n_step: int
) -> None:
    buffer, _, _ = trained
    algorithm = dqn(n_step)
    batch, index = buffer.sample(64)
    with torch.no_grad():
        prepared = algorithm._preprocess_batch(batch, buffer, index)
        returns = prepared.returns.numpy().ravel()

        def value(observation: np.ndarray) -> float:
            seen = Batch(obs=observation[None], info=[None])
            best = int(algorithm.policy(seen).act[0])
            return float(algorithm.policy(seen, model=algorithm.model_old).logits[0, best])

        logged = index >= buffer.fresh.capacity
        assert logged.sum() == 32
        column = panel.columns
        for at in np.flatnonzero(logged).tolist():
            row = panel.rows[index[at] - buffer.fresh.capacity]
            target = row[column["reward"]][0]
            if row[column["discount"]][0] > 0:
                target = target + GAMMA * value(row[column["next_observation"]])
            assert returns[at] == pytest.approx(float(target), abs=1e-3)
        at = int(np.flatnonzero(~logged)[0])
        here = [int(index[at])]
        while len(here) < n_step and not buffer.done[here[-1]]:
            here.append(int(buffer.next(np.array([here[-1]]))[0]))
        target = sum(GAMMA**k * buffer.rew[i] for k, i in enumerate(here))
        if not buffer.terminated[here[-1]]:
            target += GAMMA ** len(here) * value(buffer.obs_next[here[-1]])
        assert returns[at] == pytest.approx(float(target), abs=1e-3)


def test_a_reset_forgets_what_was_collected_and_keeps_the_logs(panel: Panel) -> None:
    buffer = MixtureVectorReplayBuffer(100, 1, panel=panel, logs_share=0.5)
    _add(buffer, 5)
    assert len(buffer) == len(panel) + 5
    assert (buffer.sample_indices(8) < 100).sum() == 4
    buffer.reset()
    assert len(buffer) == len(panel)
    assert (buffer.sample_indices(8) >= 100).all()
    _add(buffer, 3)
    assert (buffer.sample_indices(8) < 3).sum() == 4


def test_a_blown_up_step_is_not_learnt_from() -> None:
    buffer = MixtureVectorReplayBuffer(100, 1)
    _add(buffer, 4, invalid=3)
    assert buffer.feed.invalid_steps == 1
    assert set(buffer.sample_indices(200).tolist()) == {0, 1, 2}


def _add(buffer: Any, steps: int, invalid: int = -1) -> None:
    size = TASK.observation_size
    for step in range(steps):
        seen = np.full((1, size), step, np.float32)
        info = np.array([{"invalid": step == invalid}])
        row = Batch(
            obs=seen,
            act=np.array([1]),
            rew=np.array([0.5]),
            terminated=np.array([False]),
            truncated=np.array([step == invalid]),
            obs_next=seen + 1,
            info=info,
        )
        buffer.add(row, buffer_ids=[0])


def test_a_panel_of_several_steps_is_refused(panel_of: Callable[..., Panel]) -> None:
    with pytest.raises(MixtureError, match="its rows span 3 steps"):
        MixtureVectorReplayBuffer(100, 1, panel=panel_of(n_step=3))


def test_without_logs_and_without_steps_there_is_nothing_to_draw() -> None:
    with pytest.raises(MixtureError, match="no fresh row to draw"):
        MixtureVectorReplayBuffer(100, 1).sample_indices(4)


def test_commands_of_logs_stand_beside_continuous_fresh_ones(panel: Panel) -> None:
    commands = np.linspace(-1, 1, 2 * len(panel)).reshape(-1, 2)
    buffer = MixtureVectorReplayBuffer(50, 1, panel=panel, logs_share=0.5, commands=commands)
    seen = np.zeros((1, TASK.observation_size), np.float32)
    row = Batch(
        obs=seen,
        act=np.array([[0.25, -0.5]]),
        rew=np.array([0.0]),
        terminated=np.array([False]),
        truncated=np.array([False]),
        obs_next=seen,
        info=np.array([{}]),
    )
    buffer.add(row, buffer_ids=[0])
    batch, index = buffer.sample(8)
    np.testing.assert_allclose(batch.act[4:], [[0.25, -0.5]] * 4)
    np.testing.assert_allclose(batch.act[:4], commands[index[:4] - 50], rtol=1e-6)
