"""Check which policy of a run is kept: the best evaluated, or the latest if interrupted."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from support.toy_run import config, session

from restock.cli import main
from restock.errors import RunError
from restock.report.run.facts import gather
from restock.report.run.headline import headline
from restock.train.evaluation.policies import load_agent
from restock.train.loop import TrainingInterrupted, train
from restock.train.prepare import prepare_new, prepare_resumed
from restock.train.run.run import PolicyOrigin, Run, kept_policy
from restock.train.session import Session


def train_until(live: Session, stop: Callable[[], bool]) -> Session:
    with pytest.raises(TrainingInterrupted):
        train(live, stop=stop)
    live.close()
    return live


def test_run_interrupted_before_evaluation_keeps_latest(tmp_path):
    """Regression: the policy of step 0, from the logs alone, was reported as the result."""
    live = session(tmp_path / "a", config())
    train_until(live, lambda: live.progress.env_steps >= 700)
    run = Run.open(live.run.path)
    assert run.best.is_file()
    assert kept_policy(run) == PolicyOrigin("latest", 700, live.learner.gradient_steps, 700)
    resumed = session(live.run.path, config(), resume=True)
    train(resumed)
    resumed.close()
    now = kept_policy(Run.open(live.run.path))
    assert now is not None
    assert (now.chosen, now.run_env_steps) == ("best", 1600)
    assert now.env_steps in (800, 1600)


@pytest.mark.parametrize(
    ("phase", "chosen", "step"), [("offline", "latest", 0), ("warmup", "best", 0)]
)
def test_interruption_before_online_learning(phase, chosen, step, tmp_path):
    """Keep the latest policy after offline updates, and the evaluated one in the warm-up."""
    live = session(tmp_path / "a", config())

    def stop() -> bool:
        if phase == "offline":
            return live.learner.gradient_steps >= 20
        return live.progress.env_steps >= 100

    train_until(live, stop)
    now = kept_policy(Run.open(live.run.path))
    assert now is not None
    assert (now.chosen, now.env_steps) == (chosen, step)
    assert now.gradient_steps == live.learner.gradient_steps


def test_evaluation_after_last_checkpoint_counts(tmp_path: Path) -> None:
    live = session(tmp_path / "a", config())
    train_until(live, lambda: live.progress.env_steps >= 700)
    before = live.run.latest.read_bytes()
    resumed = session(live.run.path, config(), resume=True)
    train(resumed)
    resumed.close()
    live.run.latest.write_bytes(before)
    now = kept_policy(Run.open(live.run.path))
    assert now is not None
    assert now.chosen == "best"
    assert now.env_steps >= 800


def test_reports_name_the_driven_policy(tmp_path, shell):
    path = tmp_path / "run"
    settings = [
        *("network.hidden=[16]", "env.num_envs=4", "replay.batch_size=16", "schedule.env_steps=80"),
        *("schedule.warmup_env_steps=20", "schedule.updates_per_env_step=1"),
        *("evaluation.every_env_steps=80", "evaluation.episodes=1", "record.every_updates=10"),
        "record.trackers=[]",
    ]
    live = prepare_new(path, None, None, settings).open()
    train_until(live, lambda: live.progress.env_steps >= 60)
    loaded = load_agent(Run.open(path))
    for name, weights in live.learner.policy.state_dict().items():
        assert torch.equal(loaded.network.state_dict()[name], weights), name

    text = "policy of step 60, the latest; not evaluated in training"
    line = ["eval", str(path), "--episodes", "nominal=1", "--perturbations", "none"]
    document = shell.json(*line, "--policies", "agent")
    updates = live.learner.gradient_steps
    assert document["trained"]["agent"] == {
        "chosen": "latest",
        "env_steps": 60,
        "gradient_steps": updates,
        "run_env_steps": 60,
        "text": text,
    }
    assert f"agent: {text}" in shell.err(*line, "--policies", "agent", code=0)
    assert f"policy run@{updates} of step 60," in " ".join(
        shell.err(*line[:2], "--episodes", "0", code=0).split()
    )
    assert headline(gather(path)).endswith(f". Driven: {text}")
    assert shell.json("report", path, "--card")["policy"]["text"] == text
    onnx = tmp_path / "policy.onnx"
    assert shell.json("export", path, "--to", "onnx", "--out", onnx)["trained"] == text

    resumed = prepare_resumed(path, ["schedule.env_steps=160"]).open()
    train(resumed)
    resumed.close()
    step = load_agent(Run.open(path)).origin
    assert step is not None
    assert step.chosen == "best"
    facts = gather(path)
    assert f"Driven: policy of step 60 of 160; the run now has that of step {step.env_steps}" in (
        headline(facts)
    )
    assert main([*line, "--policies", "agent"]) == 0
    message = headline(gather(path))
    assert message.endswith(step.text) == (step.env_steps < 160)
    assert "step 60" not in message


def test_run_stopped_before_first_update_has_no_policy(tmp_path: Path) -> None:
    changes: dict[str, Any] = {"schedule": {"warmup_env_steps": 400}}
    live = session(tmp_path / "a", config(**changes), logs=None)
    train_until(live, lambda: live.progress.env_steps >= 100)
    run = Run.open(live.run.path)
    assert kept_policy(run) is None
    with pytest.raises(RunError, match="stopped before its first update"):
        load_agent(run)
