"""Load policies by name: a run's network, an ONNX file, or a clone of the logs' drivers.

A clone is made by behaviour cloning, and serves as a reference in the twin. The softmax of its
network is the probability of each action in the logs, and the clone draws actions with these
probabilities, as the drivers did. The number of updates is chosen by the likelihood of episodes
that are set aside. `RUN/eval/clones.parquet` has the clone's quality on the panel's held-out rows.
Observations contain the last action, and repeating it is often right, so the file also has the
agreement of always repeating it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from restock.arrays import F32, Bools, Ints
from restock.errors import ConfigError, PanelError, RunError, StoreError
from restock.ingest.task.task import Task, proposal_reader
from restock.replay.panel.panel import Panel
from restock.state import first_mismatch
from restock.train.dqn.behaviour import PolicyNetwork, ProposalNetwork, make_policy
from restock.train.dqn.config import PLANNER, TrainConfig, parse_config
from restock.train.dqn.fitted_q import FittedQConfig, cloned_behaviour, cloned_probabilities
from restock.train.dqn.learner import Learner, greedy_actions
from restock.train.dqn.network import Ensemble, QNetwork, UpdatePath, clone, members_of
from restock.train.evaluation.evaluate import Score
from restock.train.evaluation.ope_dataset import MODEL_ROWS, held_out_rows
from restock.train.run import checkpoint
from restock.train.run.kept_evaluations import CloneQuality, keep_clone
from restock.train.run.run import (
    MEAN_OF,
    PolicyOrigin,
    Run,
    chosen_policy,
    env_steps_of,
    now_ns,
    resume_command,
)
from restock.train.run.run_profile import profile_of_run, run_panel
from restock.train.twin.env.interface import Policy


def make_learner(config: TrainConfig, task: Task, *, path: UpdatePath | None = None) -> Learner:
    """Make the learner of a task; `path` as in `Learner`."""
    proposal = proposal_reader(task) if config.teacher.source == PLANNER else None
    return Learner(config, task.observation_size, len(task.actions), path=path, proposal=proposal)


class GreedyPolicy:
    """A policy network that always takes its best action."""

    name = "agent"

    def __init__(
        self, network: PolicyNetwork, version: str = "", origin: PolicyOrigin | None = None
    ) -> None:
        """`origin` is the step of its run at which the network was saved."""
        self.network, self.version, self.origin = network, version, origin

    def act(self, env: Any, observation: F32) -> tuple[Ints, F32]:
        action = greedy_actions(self.network, observation)
        return action, np.ones(len(action), np.float32)


def load_policy(name: str, task: Task) -> Policy | None:
    """Load the policy that `run:DIRECTORY` or `onnx:FILE` names; None for other names.

    Raises:
        ConfigError: there is no such file, or the policy is of another task.
        RunError: there is no such run, or its policy is missing or damaged.
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
            f"was trained on task {trained.hash}, but this is task {task.hash}",
            where=path,
            remedy="give a run of this task",
        )
    return agent


def load_agent(run: Run) -> GreedyPolicy:
    """Load the policy that a run drives with (`kept_policy`) as a greedy policy.

    Raises:
        RunError: the run has made no update yet, its policy is missing or damaged, or the profile's
            task has changed since it was trained.
    """
    chosen = chosen_policy(run)
    latest = chosen == "latest"
    if not (latest or run.best.exists()) and not (
        run.latest.is_file() and kept_one(checkpoint.load(run.latest))
    ):
        raise RunError(
            "has no policy yet: it stopped before its first update",
            where=str(run.path),
            remedy=f"continue it with {resume_command(run.path)}",
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
    runs = len(run.document.get(MEAN_OF, "1"))
    network = make_policy(config, state["observation_size"], state["actions"], runs=runs)
    try:
        network.load_state_dict(state["network"])
    except RuntimeError as error:  # raised by PyTorch if shapes or names differ
        raise RunError(
            f"its policy does not fit the network in config.json: {first_mismatch(error)}",
            where=str(file),
            remedy="undo the changes of network and teacher in config.json",
        ) from error
    env_steps, updates = state["env_steps"], state["gradient_steps"]
    origin = PolicyOrigin(chosen, env_steps, updates, env_steps_of(run))
    return GreedyPolicy(network.eval(), f"{run.path.name}@{updates}", origin)


def _latest_agent(run: Run, config: TrainConfig, task: Task) -> dict[str, Any]:
    """Load the policy of the last checkpoint, in the form that `save_agent` writes.

    Raises:
        RunError: the checkpoint is damaged, or does not fit the networks in config.json.
    """
    state = checkpoint.load(run.latest)
    plain = msgspec.structs.replace(config, device="cpu")
    learner = make_learner(plain, task)
    try:
        learner.load_state_dict(state["learner"])
    except (KeyError, ValueError, RuntimeError, RunError) as error:
        raise RunError(
            f"contains no policy that fits the network in config.json: {error}",
            where=str(run.latest),
            remedy="undo the changes of network and teacher in config.json",
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
    """Return whether the run had a best policy when this checkpoint was written."""
    return bool(state["progress"]["evaluated_at"] >= 0)


def load_kept(run: Run) -> dict[str, Any]:
    """Load the best policy, as `save_agent` wrote it.

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
    """Save a network as the run's best so far; `clocks` are `env_steps` and `gradient_steps`."""
    state = {
        "network": dict(network.state_dict()),
        "observation_size": task.observation_size,
        "actions": len(task.actions),
        "task_hash": task.hash,
        **clocks,
        "score": asdict(score),
    }
    checkpoint.save(run.best, state)


def write_mean(places: Sequence[Path], out: Path) -> GreedyPolicy:
    """Write a run that acts by the mean of several runs' action values, and load its policy.

    Independent runs have different errors, so their mean has smaller ones (arXiv:1611.01929). If
    the runs filter actions, the new run filters by the mean of their behaviour networks' logits. If
    the planner taught them, the margin by which actions must beat the planner's proposal shrinks by
    the root of the number of runs, like the errors. The new run was fed nothing: it has no tables.

    Raises:
        RunError: the runs differ in more than their seeds, or one has no policy.
    """
    runs = [Run.open(path) for path in places]
    agents = [load_agent(run) for run in runs]
    configs = [parse_config(run.document["config"], where=str(run.path)) for run in runs]
    kinds = [
        (run.document["task_hash"], config.network, config.loss.algorithm, config.teacher.source)
        for run, config in zip(runs, configs, strict=True)
    ]
    for run, kind in zip(runs, kinds, strict=True):
        if kind != kinds[0]:
            raise RunError(
                f"is not of the same task, network, algorithm and teacher as {runs[0].path}",
                where=str(run.path),
                remedy="give runs that differ in their seeds alone",
            )
    networks: list[Any] = [agent.network for agent in agents]
    mean, root = clone(networks[0]), len(runs) ** 0.5
    parts = [name for name in ("values", "behaviour") if hasattr(mean, name)]
    for name in parts:
        setattr(mean, name, _mean([getattr(network, name) for network in networks]))
    if not parts:
        mean = _mean(networks)
    if isinstance(mean, ProposalNetwork):
        mean.lead = mean.lead / root
    document = {key: value for key, value in runs[0].document.items() if key != "format"}
    whole = msgspec.to_builtins(configs[0])
    whole["teacher"]["margin"] /= root
    of = [run.document.get(MEAN_OF, [made.version]) for run, made in zip(runs, agents, strict=True)]
    document |= {"created_ns": now_ns(), "config": whole, MEAN_OF: [*chain.from_iterable(of)]}
    made = Run.create(out, document)
    clocks = {
        name: sum(getattr(agent.origin, name) for agent in agents)
        for name in ("env_steps", "gradient_steps")
    }
    save_agent(made, mean, profile_of_run(made).task, Score({}, 0.0, 0.0), clocks)
    return load_agent(made)


def _mean(networks: Sequence[Any]) -> Ensemble:
    return Ensemble([member for network in networks for member in members_of(network)])


CLONED = "cloned"
UPDATES = (50, 100, 200, 400, 800, 1600)  # numbers of updates that are tried to fit a clone
SET_ASIDE = 5  # every fifth episode is set aside to choose among `UPDATES`


class ClonedPolicy:
    """A policy that draws each action with its probability in the logs, from a seeded generator."""

    def __init__(self, network: QNetwork, quality: CloneQuality, version: str, seed: int) -> None:
        self.name, self.version = quality.policy, version
        self.network, self.quality = network, quality
        self._rng = np.random.default_rng([seed, 14])

    def act(self, env: Any, observation: F32) -> tuple[Ints, F32]:
        """Draw actions (N,) for observations (N, D); return them and their probabilities (N,)."""
        of_each = cloned_probabilities(self.network, observation)  # (N, A)
        draw = self._rng.random((len(of_each), 1))
        action = (draw > of_each.cumsum(axis=1)).sum(axis=1)
        action = np.minimum(action, of_each.shape[1] - 1)
        return action, of_each[np.arange(len(action)), action].astype(np.float32)


def is_cloned(name: str) -> bool:
    """Return whether a policy's name is `cloned` or `cloned:DRIVER`."""
    kind, sign, driver = name.partition(":")
    return kind == CLONED and bool(driver) == bool(sign)


def cloned_panel(run: Run, name: str) -> Panel:
    """Open the panel whose rows a clone is fitted to.

    Raises:
        ConfigError: the run did not learn from logs, or these have no driver of that name.
        PanelError: the panel has changed.
    """
    panel = run_panel(run.document)
    if panel is None:
        raise ConfigError(
            "did not learn from logs: there is no driver to clone",
            where=f"{run.path}, {name}",
            remedy="leave out `cloned` in --policies, or train with --panel",
        )
    driver = name.partition(":")[2]
    known = _drivers(panel)
    if driver and driver not in known:
        raise ConfigError(
            f"its logs have no driver named {driver!r}",
            where=f"{run.path}, {name}",
            remedy=f"its drivers are "
            f"{', '.join(known) or 'not named: use cloned, which clones all rows'}",
        )
    return panel


def load_cloned(run: Run, name: str, *, seed: int = 0) -> ClonedPolicy:
    """Load the clone of the logs' drivers, which is trained on first use and kept in `RUN/eval`.

    Args:
        name: `cloned` for all rows of the run's panel, or `cloned:DRIVER` for one driver's.
        seed: for drawing the actions.

    Raises:
        ConfigError, PanelError: as `cloned_panel`.
    """
    panel = cloned_panel(run, name)
    file = run.path / "eval" / f"{re.sub(r'[^A-Za-z0-9_-]', '_', name)}.safetensors"
    settings = {"policy": name, "panel": panel.id, "updates": list(UPDATES)}
    state = checkpoint.load(file) if file.is_file() else {}
    if state.get("settings") != settings:
        network, quality = clone_of(panel, name)
        state = {
            "settings": settings,
            "network": dict(network.state_dict()),
            "quality": asdict(quality),
        }
        checkpoint.save(file, state)
        keep_clone(run.path, quality)
    quality = CloneQuality(**state["quality"])
    nothing = np.zeros((1, panel.observation_size), np.float32), np.zeros(1, np.int64)
    network = _clone(*nothing, len(panel.task.actions), updates=0)
    network.load_state_dict(state["network"])
    version = f"{panel.id}@{quality.updates}"
    return ClonedPolicy(network.eval(), quality, version, seed)


def clone_of(panel: Panel, name: str) -> tuple[QNetwork, CloneQuality]:
    """Clone a panel's drivers together, or a single one if `name` is `cloned:DRIVER`."""
    actions, driver = len(panel.task.actions), name.partition(":")[2]
    chosen = np.arange(len(panel))
    if driver:
        who = np.asarray(panel.meta["behaviour_policy"].to_pylist(), object)
        chosen = np.flatnonzero(who == driver)
    if len(chosen) > MODEL_ROWS:
        chosen = np.sort(np.random.default_rng([0, 15]).choice(chosen, MODEL_ROWS, replace=False))
    observation = np.array(panel.rows[chosen, : panel.observation_size])
    action = np.asarray(panel.meta_column("action"), np.int64)[chosen]
    names = np.asarray(panel.meta["episode_id"].to_pylist(), str)[chosen]
    _, episode = np.unique(names, return_inverse=True)
    updates = best_updates(observation, action, episode, actions)
    network = _clone(observation, action, actions, updates)
    held_out, held_action, note = _held_out(panel, driver)
    quality = CloneQuality(
        policy=name,
        drivers=[driver] if driver else _drivers(panel),
        rows=len(action),
        episodes=int(episode.max(initial=-1)) + 1,
        updates=updates,
        training_log_likelihood=_log_likelihood(network, observation, action),
        note=note,
        **_held_out_quality(
            network,
            held_out,
            held_action,
            _frequencies(action, actions),
            panel.task.observation_names.index("previous_action_0"),
        ),
    )
    return network, quality


def best_updates(observation: F32, action: Ints, episode: Ints, actions: int) -> int:
    """Return the number of updates with the largest likelihood on episodes that are set aside.

    More updates would memorise rows. If there is only one episode, its last fifth is set aside.
    """
    aside: Bools = episode % SET_ASIDE == SET_ASIDE - 1
    if not aside.any() or aside.all():
        aside = episode == episode.max(initial=0)
    if aside.all():
        aside = np.arange(len(action)) >= len(action) * (SET_ASIDE - 1) // SET_ASIDE
    if aside.all() or not aside.any():  # a single row
        return UPDATES[0]
    seen, taken = observation[~aside], action[~aside]
    likelihood = [
        _log_likelihood(_clone(seen, taken, actions, count), observation[aside], action[aside])
        for count in UPDATES
    ]
    return UPDATES[int(np.argmax(likelihood))]


def _drivers(panel: Panel) -> list[str]:
    return sorted(set(panel.meta["behaviour_policy"].to_pylist()) - {None})


def _held_out(panel: Panel, driver: str) -> tuple[F32, Ints, str | None]:
    """Return the panel's held-out observations and actions; if unreadable, none and the reason."""
    try:
        rows = held_out_rows(panel, driver or None)
    except (PanelError, StoreError) as error:
        none = np.zeros((0, panel.observation_size), np.float32), np.zeros(0, np.int64)
        return *none, f"held-out rows cannot be read: {error}"
    return rows.observation, rows.action, None


def _held_out_quality(
    network: QNetwork, observation: F32, action: Ints, frequencies: F32, first: int
) -> dict[str, Any]:
    """Compute the fields of a `CloneQuality` that describe held-out rows.

    `first` is the index in an observation at which the previous action's one-hot code begins.
    """
    if not len(action):
        unknown = ("log_likelihood", "frequencies_log_likelihood", "agreement", "repeating")
        return {"held_out_rows": 0, **dict.fromkeys((*unknown, "changed_agreement"))}
    agrees = cloned_probabilities(network, observation).argmax(axis=1) == action
    last = observation[:, first : first + len(frequencies)].argmax(axis=1)
    changed = last != action
    return {
        "held_out_rows": len(action),
        "log_likelihood": _log_likelihood(network, observation, action),
        "frequencies_log_likelihood": float(np.log(frequencies[action]).mean()),
        "agreement": float(agrees.mean()),
        "repeating": float((~changed).mean()),
        "changed_agreement": float(agrees[changed].mean()) if changed.any() else None,
    }


def _frequencies(action: Ints, actions: int) -> F32:
    """Return the share of each action (A,), after adding one to each count so that none is 0."""
    counts = np.bincount(action, minlength=actions) + 1
    return np.asarray(counts / counts.sum(), np.float32)


def _log_likelihood(network: QNetwork, observation: F32, action: Ints) -> float:
    """Return the mean log-probability of the actions under a cloned network, in nats."""
    probability = cloned_probabilities(network, observation)[np.arange(len(action)), action]
    return float(np.log(np.maximum(probability, 1e-12)).mean())


def _clone(observation: F32, action: Ints, actions: int, updates: int) -> QNetwork:
    config = replace(FittedQConfig(), cloning_updates=updates)
    return cloned_behaviour(observation, action, actions, config=config, seed=0)
