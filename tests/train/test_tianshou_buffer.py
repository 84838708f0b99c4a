"""Tianshou's buffer alone: its targets, its sub-buffers, what it refuses."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.library_buffers import (
    DISCOUNT,
    TASK,
    TrainedBuffer,
    make_panel,
    make_store,
    tianshou_dqn,
    trained_tianshou,
)

from restock.errors import MixtureError
from restock.replay.panel.panel import Panel

pytestmark = pytest.mark.long  # half a minute to import, train and fill


# Imported by these tests alone: each process that collects the tests would wait for it.
def buffer_of(*args: Any, **options: Any) -> Any:
    from restock.train.libraries.tianshou_buffer import MixtureVectorReplayBuffer

    return MixtureVectorReplayBuffer(*args, **options)


def batch_of(**columns: Any) -> Any:
    from tianshou.data import Batch

    return Batch(**columns)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> TrainedBuffer:
    return trained_tianshou(tmp_path_factory.mktemp("tianshou"))


@pytest.fixture(scope="module")
def panel(trained: TrainedBuffer) -> Panel:
    return trained.panel


@pytest.mark.parametrize("n_step", [1, 3])
def test_targets_are_of_single_logged_and_of_n_fresh_steps(trained, panel, n_step):
    buffer, algorithm = trained.buffer, tianshou_dqn(n_step)
    batch, index = buffer.sample(64)
    with torch.no_grad():
        prepared = algorithm._preprocess_batch(batch, buffer, index)
        returns = prepared.returns.numpy().ravel()

        def value(observation: np.ndarray) -> float:
            seen = batch_of(obs=observation[None], info=[None])
            best = int(algorithm.policy(seen).act[0])
            return float(algorithm.policy(seen, model=algorithm.model_old).logits[0, best])

        logged = index >= buffer.fresh.capacity
        assert logged.sum() == 32
        column = panel.columns
        for at in np.flatnonzero(logged).tolist():
            row = panel.rows[index[at] - buffer.fresh.capacity]
            target = row[column["reward"]][0]
            if row[column["discount"]][0] > 0:
                target = target + DISCOUNT * value(row[column["next_observation"]])
            assert returns[at] == pytest.approx(float(target), abs=1e-3)
        at = int(np.flatnonzero(~logged)[0])
        here = [int(index[at])]
        while len(here) < n_step and not buffer.done[here[-1]]:
            here.append(int(buffer.next(np.array([here[-1]]))[0]))
        target = sum(DISCOUNT**k * buffer.rew[i] for k, i in enumerate(here))
        if not buffer.terminated[here[-1]]:
            target += DISCOUNT ** len(here) * value(buffer.obs_next[here[-1]])
        assert returns[at] == pytest.approx(float(target), abs=1e-3)


def test_a_reset_forgets_what_was_collected_and_keeps_the_logs(panel: Panel) -> None:
    buffer = buffer_of(100, 1, panel=panel, logs_share=0.5)
    _add(buffer, 5)
    assert len(buffer) == len(panel) + 5
    assert (buffer.sample_indices(8) < 100).sum() == 4
    buffer.reset()
    assert len(buffer) == len(panel)
    assert (buffer.sample_indices(8) >= 100).all()
    _add(buffer, 3)
    assert (buffer.sample_indices(8) < 3).sum() == 4


def test_a_blown_up_step_is_not_learnt_from() -> None:
    buffer = buffer_of(100, 1)
    _add(buffer, 4, invalid=3)
    assert buffer.feed.invalid_steps == 1
    assert set(buffer.sample_indices(200).tolist()) == {0, 1, 2}


def _add(buffer: Any, steps: int, invalid: int = -1, action: object = 1) -> None:
    for step in range(steps):
        seen = np.full((1, TASK.observation_size), step, np.float32)
        row = batch_of(
            obs=seen,
            act=np.array([action]),
            rew=np.array([0.5]),
            terminated=np.array([False]),
            truncated=np.array([step == invalid]),
            obs_next=seen + 1,
            info=np.array([{"invalid": step == invalid}]),
        )
        buffer.add(row, buffer_ids=[0])


def test_a_panel_of_several_steps_is_refused(tmp_path: Path) -> None:
    several = make_panel(make_store(tmp_path), tmp_path / "panel", n_step=3, post="full")
    with pytest.raises(MixtureError, match="its rows span 3 steps"):
        buffer_of(100, 1, panel=several)


def test_without_logs_and_without_steps_there_is_nothing_to_draw() -> None:
    with pytest.raises(MixtureError, match="no fresh row to draw"):
        buffer_of(100, 1).sample_indices(4)


def test_commands_of_logs_stand_beside_continuous_fresh_ones(panel: Panel) -> None:
    commands = np.linspace(-1, 1, 2 * len(panel)).reshape(-1, 2)
    buffer = buffer_of(50, 1, panel=panel, logs_share=0.5, commands=commands)
    _add(buffer, 1, action=[0.25, -0.5])
    batch, index = buffer.sample(8)
    np.testing.assert_allclose(batch.act[4:], [[0.25, -0.5]] * 4)
    np.testing.assert_allclose(batch.act[:4], commands[index[:4] - 50], rtol=1e-6)
