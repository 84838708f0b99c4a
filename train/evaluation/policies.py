"""Policies by name: the network of a run, or an ONNX file. Whatever drives may use them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from restock.arrays import F32, Ints
from restock.errors import ConfigError, RunError
from restock.ingest.task.task import Task
from restock.state import first_mismatch
from restock.train.dqn.behaviour import PolicyNetwork, make_policy
from restock.train.dqn.config import TrainConfig, parse_config
from restock.train.dqn.learner import Learner, greedy_actions
from restock.train.evaluation.evaluate import Score
from restock.train.run import checkpoint
from restock.train.run.kept_policy import PolicyOrigin, env_steps_of, latest_drives
from restock.train.run.run import Run, resuming
from restock.train.run.run_profile import profile_of_run
from restock.train.twin.env.interface import Policy


class GreedyPolicy:
    """A Q network that always takes its best action, or its best plausible one if filtered."""

    name = "agent"

    def __init__(
        self, network: PolicyNetwork, version: str = "", origin: PolicyOrigin | None = None
    ) -> None:
        """`origin` is the step of its run that it is from."""
        self.network, self.version, self.origin = network, version, origin

    def act(self, env: Any, observation: F32) -> tuple[Ints, F32]:
        action = greedy_actions(self.network, observation)
        return action, np.ones(len(action), np.float32)


def load_policy(name: str, task: Task) -> Policy | None:
    """Load the policy that `run:DIRECTORY` or `onnx:FILE` names; None for other names.

    Raises:
        ConfigError: no such file, or a policy of another task.
        RunError: no such run, one without a policy, or a damaged one.
    """
    kind, _, path = name.partition(":")
    if kind == "onnx" and path:
        from restock.train.evaluation.onnx_policy import OnnxPolicy

        return OnnxPolicy(Path(path), task)
    if kind != "run" or not path:
        return None
    run = Run.open(Path(path))
    agent = load_agent(run)
    trained = profile_of_run(run).task
    if trained.hash != task.hash:
        raise ConfigError(
            f"was trained on task {trained.hash}, this is {task.hash}",
            where=path,
            remedy="give a run of this task",
        )
    return agent


def load_agent(run: Run) -> GreedyPolicy:
    """Load the policy that drives, as `kept_policy` says: greedy, with its step as `origin`.

    Raises:
        RunError: it has made no update yet, its policy is missing or damaged, or it is of a task
            that the profile no longer is.
    """
    latest = latest_drives(run)
    if not (latest or run.best.exists()) and not (
        run.latest.is_file() and kept_one(checkpoint.load(run.latest))
    ):
        raise RunError(
            "has no policy yet: it stopped before its first update",
            where=str(run.path),
            remedy=f"continue it with {resuming(run.path)}",
        )
    config = parse_config(run.document["config"], where=str(run.path / "config.json"))
    task = profile_of_run(run).task
    file = run.latest if latest else run.best
    state = _latest_agent(run, config, task) if latest else load_kept(run)
    if state["task_hash"] != task.hash:
        raise RunError(
            f"its policy was trained on task {state['task_hash']}, profile"
            f" {config.profile!r} now defines {task.hash}",
            where=str(file),
            remedy="train again: the meaning of observations or actions has changed",
        )
    network = make_policy(config, state["observation_size"], state["actions"])
    try:
        network.load_state_dict(state["network"])
    except RuntimeError as error:  # torch's of other shapes or names
        raise RunError(
            f"its policy is not of the network that config.json describes: {first_mismatch(error)}",
            where=str(file),
            remedy="put the settings back that were changed in config.json: network, teacher",
        ) from error
    env_steps, updates = state["env_steps"], state["gradient_steps"]
    origin = PolicyOrigin("latest" if latest else "best", env_steps, updates, env_steps_of(run))
    return GreedyPolicy(network.eval(), f"{run.path.name}@{updates}", origin)


def _latest_agent(run: Run, config: TrainConfig, task: Task) -> dict[str, Any]:
    """Load the policy of the last checkpoint, as `save_agent` would have written it.

    Raises:
        RunError: the checkpoint is damaged, or not of the networks that config.json describes.
    """
    state = checkpoint.load(run.latest)
    plain = msgspec.structs.replace(config, device="cpu")
    learner = Learner(plain, task.observation_size, len(task.actions))
    try:
        learner.load_state_dict(state["learner"])
    except (KeyError, ValueError, RuntimeError, RunError) as error:
        raise RunError(
            f"contains no policy of the network that config.json describes: {error}",
            where=str(run.latest),
            remedy="put the settings back that were changed in config.json: network, teacher",
        ) from error
    return {
        "network": dict(learner.policy.state_dict()),
        "observation_size": task.observation_size,
        "actions": len(task.actions),
        "task_hash": run.document["task_hash"],
        "env_steps": state["progress"]["env_steps"],
        "gradient_steps": learner.gradient_steps,
    }


def kept_one(state: Mapping[str, Any]) -> bool:
    """Tell whether a run had kept a policy when this checkpoint of it was taken."""
    return bool(state["progress"]["evaluated_at"] >= 0)


def load_kept(run: Run) -> dict[str, Any]:
    """Load what `save_agent` wrote, of a run that has kept a policy.

    Raises:
        RunError: its file is missing or damaged.
    """
    if not run.best.exists():
        raise RunError(
            "does not exist, but the run has kept a policy there",
            where=str(run.best),
            remedy="restore it from a copy, or train again",
        )
    return checkpoint.load(run.best)


def save_agent(
    run: Run,
    network: PolicyNetwork,
    task: Task,
    score: Score,
    clocks: Mapping[str, int],
) -> None:
    """Keep a network as the best of a run so far; `clocks` are `env_steps` and `gradient_steps`."""
    state = {
        "network": dict(network.state_dict()),
        "observation_size": task.observation_size,
        "actions": len(task.actions),
        "task_hash": task.hash,
        **clocks,
        "score": asdict(score),
    }
    checkpoint.save(run.best, state)


__all__ = [
    "GreedyPolicy",
    "kept_one",
    "load_agent",
    "load_kept",
    "load_policy",
    "save_agent",
]
