"""The way the logs were driven, as a policy: behaviour cloning, a reference in the twin.

A network whose softmax is the probability of each action in the logs acts by these probabilities,
as its drivers did, not by the likeliest. Its number of updates is that with the best likelihood on
held-out episodes; `RUN/eval/clones.parquet` says how good the clone is on the rows that the panel
holds out. Observations contain the last action, so repeating it agrees often: the file also has the
agreement of repeating alone.
"""

from __future__ import annotations

import re
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from restock.arrays import F32, Bools, Ints
from restock.errors import ConfigError, PanelError, StoreError
from restock.replay.panel.panel import Panel
from restock.train.dqn.fitted_q import FittedQConfig, cloned_behaviour, cloned_probabilities
from restock.train.dqn.network import QNetwork
from restock.train.evaluation.off_policy.dataset import MODEL_ROWS, held_out_rows
from restock.train.run import checkpoint
from restock.train.run.kept_evaluations import CloneQuality, keep_clone
from restock.train.run.run import Run
from restock.train.run.run_profile import run_panel

CLONED = "cloned"
UPDATES = (50, 100, 200, 400, 800, 1600)  # that are tried
SET_ASIDE = 5  # every fifth episode chooses among them


class ClonedPolicy:
    """Takes each action with the probability that it has in the logs, by its own seeded draws."""

    def __init__(self, network: QNetwork, quality: CloneQuality, version: str, seed: int) -> None:
        self.name, self.version = quality.policy, version
        self.network, self.quality = network, quality
        self._rng = np.random.default_rng([seed, 14])

    def act(self, env: Any, observation: F32) -> tuple[Ints, F32]:
        """Actions (N,) for observations (N, D), and the probabilities (N,) they had."""
        of_each = cloned_probabilities(self.network, observation)  # (N, A)
        draw = self._rng.random((len(of_each), 1))
        action = (draw > of_each.cumsum(axis=1)).sum(axis=1)
        action = np.minimum(action, of_each.shape[1] - 1)
        return action, of_each[np.arange(len(action)), action].astype(np.float32)


def is_cloned(name: str) -> bool:
    """Tell whether a policy's name is `cloned`, or `cloned:DRIVER`."""
    kind, sign, driver = name.partition(":")
    return kind == CLONED and bool(driver) == bool(sign)


def cloned_panel(run: Run, name: str) -> Panel:
    """Open the panel of the rows that a clone is made of.

    Raises:
        ConfigError: the run learnt from no logs, or nobody of that name drove in them.
        PanelError: the panel is no longer what it was.
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
            f"{', '.join(known) or 'nobody: use cloned, which is of all rows'}",
        )
    return panel


def load_cloned(run: Run, name: str, *, seed: int = 0) -> ClonedPolicy:
    """Load the clone of the logs' drivers, trained on first use and kept in `RUN/eval`.

    Args:
        name: `cloned`, of all rows of the run's panel, or `cloned:DRIVER`, of one driver's.
        seed: of what it draws as it drives.

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
    network = _empty_network(panel.observation_size, len(panel.task.actions))
    network.load_state_dict(state["network"])
    version = f"{panel.id}@{quality.updates}"
    return ClonedPolicy(network.eval(), quality, version, seed)


def clone_of(panel: Panel, name: str) -> tuple[QNetwork, CloneQuality]:
    """Clone a panel's drivers; those of one name where `name` is `cloned:DRIVER`."""
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
        **_judged(
            network,
            held_out,
            held_action,
            _frequencies(action, actions),
            panel.task.observation_names.index("previous_action_0"),
        ),
    )
    return network, quality


def best_updates(observation: F32, action: Ints, episode: Ints, actions: int) -> int:
    """Return the number of updates that gives held-out episodes the largest likelihood.

    Of a single episode its last fifth is set aside. More updates than that learn rows by heart.
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
    """Observations and actions that the panel holds out; why there are none, where that says."""
    try:
        rows = held_out_rows(panel, driver or None)
    except (PanelError, StoreError) as error:
        none = np.zeros((0, panel.observation_size), np.float32), np.zeros(0, np.int64)
        return *none, f"held-out rows cannot be read: {error}"
    return rows.observation, rows.action, None


def _judged(
    network: QNetwork, observation: F32, action: Ints, frequencies: F32, first: int
) -> dict[str, Any]:
    """Compute the held-out part of a `CloneQuality`.

    `first` is where an observation has the last action.
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
    """Count how often each action was taken (A,), plus one each, so that none has probability 0."""
    counts = np.bincount(action, minlength=actions) + 1
    return np.asarray(counts / counts.sum(), np.float32)


def _log_likelihood(network: QNetwork, observation: F32, action: Ints) -> float:
    """Return the mean of log G(a|s) over rows, in nats."""
    probability = cloned_probabilities(network, observation)[np.arange(len(action)), action]
    return float(np.log(np.maximum(probability, 1e-12)).mean())


def _clone(observation: F32, action: Ints, actions: int, updates: int) -> QNetwork:
    config = replace(FittedQConfig(), cloning_updates=updates)
    return cloned_behaviour(observation, action, actions, config=config, seed=0)


def _empty_network(observation_size: int, actions: int) -> QNetwork:
    none = np.zeros((1, observation_size), np.float32), np.zeros(1, np.int64)
    return _clone(*none, actions, 0)


__all__ = [
    "CLONED",
    "ClonedPolicy",
    "clone_of",
    "cloned_panel",
    "is_cloned",
    "load_cloned",
]
