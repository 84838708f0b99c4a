"""Compare updates in blocks with single updates, on the CPU and as a CUDA graph."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pytest
import torch
from support.panels import panel_of
from support.stores import CONDITIONS, recording_transitions
from support.toy_run import assert_same_run, config, logs, run_to_end, session, tables
from support.toy_twin import TASK

from restock.cli.failures import as_restock_error
from restock.replay.sampling.ring import FreshRing
from restock.train.feed.logs import Logs
from restock.train.feed.update_blocks import LONGEST, DeviceTable, UpdateBlocks
from restock.train.loop import train
from restock.train.session import Session

OFFLINE = {"env_steps": 0, "offline_updates": 3 * LONGEST + 5}
# Tables with the policy's action in audited rows, computed at the end of a block.
POLICY_TABLES = {"actions", "audit"}


@pytest.fixture(params=["cpu", "cuda"])
def device(request: pytest.FixtureRequest) -> str:
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    return str(request.param)


def in_blocks(
    path: Path, device: str, *, resume: bool = False, logs: Logs | None = None, **changes: Any
) -> Session:
    """Open a session that updates in blocks."""
    parts = {} if logs is None else {"logs": logs}
    live = session(path, config(device=device, **changes), resume=resume, **parts)
    if live.blocks is None:
        live.blocks = UpdateBlocks(
            live.config, live.learner, live.batches, live.imitation, live.log_terms
        )
    return live


def train_and_close(live: Session) -> Session:
    train(live)
    live.close()
    return live


VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "every term": {
        "loss": {"conservative": 0.5, "margin": 0.5},
        "optimizer": {"learning_rate": 3e-3},
        "target": {"rule": "hard", "every": 13},
    },
    "teacher": {"teacher": {"source": "logs", "offline_updates": 20}},
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_blocks_match_single_updates(variant: str, device: str, tmp_path: Path) -> None:
    """Compare sampled rows bit for bit, and weights up to rounding."""
    changes = {**VARIANTS[variant], "schedule": OFFLINE}
    single = run_to_end(tmp_path / "one", config(**changes))
    blocks = train_and_close(in_blocks(tmp_path / "blocks", device, **changes))
    assert (
        blocks.learner.gradient_steps == single.learner.gradient_steps == OFFLINE["offline_updates"]
    )
    assert blocks.learner.target.last_sync == single.learner.target.last_sync
    for name in ("network", "target_network", "policy"):
        expected = getattr(single.learner, name).state_dict()
        for key, value in getattr(blocks.learner, name).state_dict().items():
            np.testing.assert_allclose(
                value.cpu(), expected[key], rtol=2e-3, atol=2e-4, err_msg=f"{name} {key}"
            )
    fed, expected_fed = tables(blocks.run.path), tables(single.run.path)
    rows = ["gradient_step", "batch_row", "row_hash", "transition_id", "weight", "reward"]
    assert fed["audit"].select(rows).equals(expected_fed["audit"].select(rows))
    assert len(fed["audit"]) > 0
    assert fed["sampled_episodes"].equals(expected_fed["sampled_episodes"])


def test_online_run_in_blocks_matches_single_updates(tmp_path: Path) -> None:
    """Compare the ring, the weights and all tables of an online run."""
    short = {"schedule": {"env_steps": 800}}
    single = run_to_end(tmp_path / "one", config(**short))
    blocks = train_and_close(in_blocks(tmp_path / "blocks", "cpu", **short))
    for name, value in single.learner.policy.state_dict().items():
        assert torch.equal(value, blocks.learner.policy.state_dict()[name]), name
    np.testing.assert_array_equal(single.ring.rows, blocks.ring.rows)
    fed, expected = tables(blocks.run.path), tables(single.run.path)
    for name in expected.keys() - POLICY_TABLES:
        assert fed[name].equals(expected[name]), name
    audit = [name for name in expected["audit"].column_names if name != "greedy_action"]
    assert fed["audit"].select(audit).equals(expected["audit"].select(audit))


@pytest.mark.long
def test_run_in_blocks_is_repeatable_and_resumable(device: str, tmp_path: Path) -> None:
    whole = train_and_close(in_blocks(tmp_path / "whole", device))
    assert_same_run(whole, train_and_close(in_blocks(tmp_path / "again", device)))
    stopped = in_blocks(tmp_path / "stopped", device)
    requested = iter(range(150))
    with pytest.raises(Exception, match="restock train --resume"):
        train(stopped, stop=lambda: next(requested, None) is None)
    stopped.close()
    resumed = train_and_close(in_blocks(tmp_path / "stopped", device, resume=True))
    assert_same_run(whole, resumed)


def test_priorities_feed_blocks_like_single_updates(device, tmp_path):
    """Draw by priority, which depends on the TD errors of earlier updates."""
    text = "discount = 0.9\nwithin = 'per'\n[each_condition]\nshare = 'equal'\n"
    table = recording_transitions(1, task=TASK)
    built = panel_of(table, text, tmp_path / "panel", task=TASK, conditions=CONDITIONS)
    changes = {"schedule": {"env_steps": 200, "warmup_env_steps": 40, "offline_updates": 40}}
    single = run_to_end(tmp_path / "one", config(**changes), logs=Logs.of_panel(built))
    live = in_blocks(tmp_path / "blocks", device, logs=Logs.of_panel(built), **changes)
    assert live.batches.needs_td
    blocks = train_and_close(live)
    fed, expected = tables(blocks.run.path)["audit"], tables(single.run.path)["audit"]
    of_logs = [table.filter(pc.equal(table["source"], "logs")) for table in (fed, expected)]
    rows = ["gradient_step", "batch_row", "row_hash", "transition_id", "reward"]
    assert len(of_logs[0]) == len(of_logs[1]) > 0
    if device == "cpu":  # a GPU's priorities differ by rounding
        assert of_logs[0].select(rows).equals(of_logs[1].select(rows))


def test_device_table_follows_the_ring(device: str) -> None:
    ring = FreshRing(64, 4, TASK.observation_size, discount=0.9, n_step=2)
    shelf = logs()
    table = DeviceTable(shelf.rows, ring, torch.device(device))
    rng = np.random.default_rng(0)
    for step in range(40):  # more than one lap of the ring
        observation = rng.random((4, TASK.observation_size)).astype(np.float32)
        ended = rng.random(4) < 0.1
        ring.append(
            observation=observation,
            action=rng.integers(3, size=4),
            reward=rng.random(4),
            terminated=ended,
            truncated=np.zeros(4, np.bool_),
            next_observation=observation,
            env_step=step,
            gradient_step=0,
        )
        if step % 3 == 0:
            table.follow()
            np.testing.assert_array_equal(table.rows[: table.logs].cpu(), shelf.rows)
            np.testing.assert_array_equal(table.rows[table.logs :].cpu(), ring.rows)


def test_nonfinite_learner_names_its_update(device: str, tmp_path: Path) -> None:
    shelf = logs()
    shelf.rows[7, 2] = torch.nan
    live = session(tmp_path / "run", config(device=device, schedule=OFFLINE), logs=shelf)
    live.blocks = UpdateBlocks(live.config, live.learner, live.batches, None, live.log_terms)
    with pytest.raises(Exception, match=r"update \d+.*panel row 7 ") as raised:
        train(live)
    at = int(str(raised.value).split("at update ")[1].split(";")[0])
    assert at == live.learner.gradient_steps
    live.close()


def test_gpu_with_too_little_memory_is_reported() -> None:
    full = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 90.00 GiB.")
    error = as_restock_error(full, ["train", "--device", "cuda"])
    assert "out of GPU memory: CUDA out of memory" in error.what
    assert "--device cpu" in str(error.remedy)
