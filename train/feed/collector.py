"""Collect the twin's steps into the fresh ring, and label the episodes that ended.

Finished episodes are labelled by the same conditions as logs, over the same signals, several
episodes per query.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import Bools, Ints
from restock.ingest.task.conditions import (
    NOMINAL,
    Condition,
    label,
    of_kind,
    primary,
    runnable,
    signals_named,
)
from restock.ingest.task.schema import signal_arrays, steps_schema
from restock.ingest.task.task import STORED_SIGNALS, Signals, Task
from restock.replay.mixture.mixture import Mixture
from restock.replay.panel.panel import Panel
from restock.replay.plan.strata import NOMINAL_PRIORITY, ResolvedStratum, assign, rules_of
from restock.replay.sampling.ring import FreshRing
from restock.state import Stateful
from restock.train.dqn.behaviour import UNKNOWN
from restock.train.feed.fresh_labels import EpisodeLabels, FreshPerturbations, values_entries
from restock.train.feed.teacher import CheckedTeacher, Label
from restock.train.twin.env.interface import Twin
from restock.train.twin.floors.layout import DEFAULT

_EPISODES_PER_QUERY = 32  # at once: planning a query takes as long as labelling 1,000 steps
_NO_VALUES = ("{}",)  # perturbation values of a twin that reports only the name


@dataclass(frozen=True)
class EndedEpisode:
    """A training episode that ended; a row of the run's `episodes`."""

    env_steps: int
    gradient_steps: int
    key: int  # the ring's key of the episode
    env: int
    episode_seed: int
    perturbation: str
    true_condition: str
    block: str
    undiscounted_return: float
    success: bool | None  # None: the task has no goal
    bumps: int
    steps: int
    signals: Signals  # arrays (steps + 1,) by signal
    perturbation_values: str = "{}"  # JSON of the values that are not nominal
    layout: str = DEFAULT
    arm: int = -1  # index into the twin's `mission_arms`; -1: none was chosen


class Collector(Stateful):
    """A collector that steps the twin and keeps the signals that labels need.

    `start` begins a step, in a thread if there is an executor, and `finish` adds its result to the
    ring. In between, the learner may learn from the rows that the ring already has.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "observation",
        "_steps",
        "_return",
        "_bumps",
        "_touching",
        "invalid_steps",
        "_history",
        "perturbations",
        "labels",
        "_unlabelled",
        "teacher",
    )

    def __init__(
        self,
        env: Twin,
        ring: FreshRing,
        conditions: Sequence[Condition],
        task: Task,
        executor: Executor | None,
        teacher: CheckedTeacher | None = None,
        strata: FreshStrata | None = None,
    ) -> None:
        self.env, self.ring, self.task = env, ring, task
        self.strata = strata  # assigns the ring's rows to strata; None: conditions are the strata
        self.goal = task.goal != "none"  # whether success is defined
        self.conditions = list(conditions)
        self._codes = {name: code for code, name in enumerate(ring.conditions)}
        self._executor = executor
        self.teacher = teacher  # queried before each step, on the twin's thread
        self._actions = np.asarray(task.actions, np.float64)
        count, length = env.num_envs, task.time_limit_steps + 1
        self._history: dict[str, NDArray[Any]] = {
            signal.name: np.zeros((count, length), signal.dtype) for signal in STORED_SIGNALS
        }
        self._steps = np.zeros(count, np.int64)
        self._return = np.zeros(count)
        self._bumps = np.zeros(count, np.int64)
        self._touching = np.zeros(count, np.bool_)
        self._unlabelled: list[EndedEpisode] = []
        self.invalid_steps = 0  # steps whose physics diverged
        self.observation: NDArray[np.float32] = np.zeros(0, np.float32)
        self._sent: tuple[NDArray[np.int64], NDArray[np.float32]] | None = None
        self._future: Future[Any] | None = None
        self._result: Any = None
        self._label: Label | int = UNKNOWN  # the teacher's actions in the current step
        self.perturbations = FreshPerturbations()
        self.labels = EpisodeLabels()  # labels of ended episodes, until the record used them

    def check_conditions(self) -> None:
        """Raise ConfigError now, not after minutes of driving, if a condition's SQL cannot run."""
        columns: dict[str, Any] = {
            name: np.zeros(0, np.int64) for name in ("episode_index", "step_index")
        }
        columns |= {name: history[:0, 0] for name, history in self._history.items()}
        label(pa.table(columns), self.conditions)

    def reset(self, seed: int) -> None:
        """Reset the twin, and keep its first observations (N, D)."""
        self.observation, _ = self.env.reset(seed=seed)

    @property
    def steps(self) -> NDArray[np.int64]:
        """Return the steps so far of each environment's current episode, (N,)."""
        return self._steps

    def start(
        self,
        action: NDArray[np.int64],
        probability: NDArray[np.float32],
    ) -> Any:
        """Begin a step with one action per environment, (N,), each drawn with `probability` (N,).

        Returns the step's result, or None if a thread makes it; `finish` adds it to the ring.
        """
        envs = np.arange(self.env.num_envs)
        now = self.env.signals
        for name, history in self._history.items():
            history[envs, self._steps] = now[name]
        # As in a log, a row's command is the one in force during the step that begins there.
        self._history["command_speed_mps"][envs, self._steps] = self._actions[action, 0]
        self._history["command_yaw_rate_radps"][envs, self._steps] = self._actions[action, 1]
        if self._executor is not None:
            self._future = self._executor.submit(self._step, action)
        else:
            self._result = self._step(action)
        self._sent = (action, probability)
        return self._result

    def _step(self, action: NDArray[np.int64]) -> Any:
        if self.teacher is not None:
            self._label = self.teacher.query(self.env, self.observation)
        return self.env.step(action)

    def finish(
        self, *, env_steps: int, gradient_steps: int, acting_step: int
    ) -> list[EndedEpisode]:
        """Add the result of the step to the ring.

        Args:
            env_steps: the run's environment steps before this step.
            gradient_steps: the run's gradient steps so far.
            acting_step: the gradient step of the network that chose the actions.

        Returns the episodes that ended.
        """
        if self._sent is None:
            raise RuntimeError("finish() without start()")
        # Clear both first: reading the result raises if the teacher failed, and no step was made.
        (action, probability), self._sent = self._sent, None
        future, self._future = self._future, None
        result, self._result = future.result() if future is not None else self._result, None
        observation, reward, terminated, truncated, info = result
        ended = np.asarray(terminated | truncated, np.bool_)
        next_observation = np.array(observation, copy=True)
        for place in np.flatnonzero(ended):  # autoreset: `observation` is the next episode's
            next_observation[place] = info["final_obs"][place]
        keys = self.ring.append(
            observation=self.observation,
            action=action,
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            next_observation=next_observation,
            env_step=env_steps,
            gradient_step=acting_step,
            policy_version=acting_step,
            action_probability=probability,
            teacher_action=self._label,
        )
        if info["invalid"].any():
            self._drop(keys, info["invalid"])
        self.observation = np.array(observation, copy=True)
        after = info["signals"]
        bumped = np.asarray(after["bumped"], np.bool_)
        self._steps += 1
        self._return += reward
        self._bumps += bumped & ~self._touching
        self._touching = bumped.copy()  # a copy, because other code reads the step's array
        values = info.get("perturbation_values", _NO_VALUES * self.env.num_envs)
        self.perturbations.note(keys, info["perturbation"], values)
        finished = []
        for place in np.flatnonzero(ended):
            count = int(self._steps[place])
            for name, history in self._history.items():
                history[place, count] = after[name][place]
            finished.append(
                EndedEpisode(
                    env_steps=env_steps + self.env.num_envs,
                    gradient_steps=gradient_steps,
                    key=int(keys[place]),
                    env=int(place),
                    episode_seed=int(info["episode_seed"][place]),
                    perturbation=str(info["perturbation"][place]),
                    perturbation_values=str(values[place]),
                    layout=str(info["layout"][place]) if "layout" in info else DEFAULT,
                    arm=int(info["mission_arm"][place]) if "mission_arm" in info else -1,
                    true_condition=str(info["episode_condition"][place]),
                    block=str(info["block"][place]),
                    undiscounted_return=float(self._return[place]),
                    success=bool(info["success"][place]) if self.goal else None,
                    bumps=int(self._bumps[place]),
                    steps=count,
                    signals={
                        name: history[place, : count + 1].copy()
                        for name, history in self._history.items()
                    },
                )
            )
        self._steps[ended], self._return[ended], self._bumps[ended] = 0, 0.0, 0
        self._touching[ended] = False
        self._unlabelled.extend(finished)
        return finished

    def _drop(self, keys: NDArray[np.int64], invalid: NDArray[np.bool_]) -> None:
        """Overwrite the row of a step whose physics diverged with a copy of the row before it."""
        ring = self.ring
        for key in keys[invalid]:
            slots = np.flatnonzero(ring.meta["episode"][: len(ring)] == key)
            order = slots[np.argsort(ring.meta["episode_step"][slots])]
            if len(order) > 1:
                ring.rows[order[-1]] = ring.rows[order[-2]]
                label = ring.meta["teacher_action"]
                label[order[-1]] = label[order[-2]]
            self.invalid_steps += 1

    def forget(self, episodes: Sequence[EndedEpisode]) -> None:
        """Mark ended episodes as never labelled: their rows get no condition."""
        keys = {episode.key for episode in episodes}
        for key in sorted(keys):
            self.labels.give_up(key)
        self._unlabelled = [episode for episode in self._unlabelled if episode.key not in keys]

    def label(self, *, all_of_them: bool = False) -> list[dict[str, Any]]:
        """Label ended episodes if enough wait; return rows of the run's table `episodes`."""
        waiting = self._unlabelled
        if not waiting or (len(waiting) < _EPISODES_PER_QUERY and not all_of_them):
            return []
        self._unlabelled = []
        self.perturbations.forget(self.ring.meta["episode"][: len(self.ring)])
        exposures = [] if self.strata is None else self.strata.exposures
        held = label(steps_table(waiting), [*self.conditions, *exposures])
        labels = {condition.name: held[condition.name] for condition in self.conditions}
        names = primary(labels, self.conditions)
        codes = np.array([self._codes[name] for name in names] or [], np.int64)
        rows, begin = [], 0
        for episode in waiting:
            inside = slice(begin, begin + episode.steps)  # the last step begins no transition
            begin += episode.steps + 1
            of_steps = codes[inside] if len(codes) else np.zeros(episode.steps, np.int64)
            strata = None
            if self.strata is not None:
                of_episode = {name: holds[inside] for name, holds in held.items()}
                strata = self.strata.codes(of_episode, episode.steps, self.ring.stratum_rows)
            self.ring.set_labels(episode.key, of_steps, strata)
            self.labels.note(episode.key, of_steps, strata)
            rows.append(
                {
                    "env_steps": episode.env_steps,
                    "gradient_steps": episode.gradient_steps,
                    "episode": episode.key,
                    "env": episode.env,
                    "episode_seed": episode.episode_seed,
                    "perturbation": episode.perturbation,
                    "perturbation_values": values_entries(episode.perturbation_values),
                    "layout": episode.layout,
                    "true_condition": episode.true_condition,
                    "block": episode.block,
                    "conditions": [name for name, held in labels.items() if held[inside].any()],
                    "return": episode.undiscounted_return,
                    "success": episode.success,
                    "bumps": episode.bumps,
                    "steps": episode.steps,
                    "time_s": episode.steps * self.task.control_period_s,
                }
            )
        return rows

    def state_dict(self) -> dict[str, Any]:
        """Return arrays and JSON values. Call between `finish` and `start`, never during a step."""
        if self._sent is not None:
            raise RuntimeError("a step is under way")
        return super().state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the collector; the twin has its own state."""
        super().load_state_dict(state)
        self._unlabelled = [EndedEpisode(**episode) for episode in state["unlabelled"]]


def conditions_in_twin(
    conditions: Sequence[Condition], signals: Collection[str], *, lidar: bool = True
) -> tuple[list[Condition], dict[str, list[str]]]:
    """Return the conditions that the twin can evaluate, and what `signals` each other one lacks.

    The twin fills Restock's own signals, but none of a profile's `[signals.*]`. Conditions over a
    profile's signals label only logs: on fresh episodes they would be guesses. For a robot without
    a lidar, conditions over scans are left out, too, because scans are null in its logs.

    Raises:
        ConfigError: a condition's SQL fails for another reason than a missing signal.
    """
    steps = steps_schema().empty_table()
    needed: dict[str, list[str]] = {} if lidar else signals_named(conditions)
    conditions = [condition for condition in conditions if condition.name not in needed]
    evaluated = runnable(steps, conditions)
    for condition in conditions:
        if condition not in evaluated:
            words = {word.lower() for word in re.findall(r"\w+", condition.sql)}
            needed[condition.name] = sorted(words & set(signals))
            if not needed[condition.name]:
                label(steps, [condition])  # raises the reason
    return evaluated, needed


def ring_conditions(conditions: Sequence[Condition]) -> list[str]:
    """Return the names of the ring's condition codes, in order: by priority, nominal last."""
    ordered = sorted(conditions, key=lambda condition: (condition.priority, condition.name))
    return [condition.name for condition in ordered] + [NOMINAL]


def steps_table(episodes: Sequence[EndedEpisode]) -> pa.Table:
    """Return the steps of episodes as `restock.ingest.task.conditions.label` takes them."""
    lengths = [episode.steps + 1 for episode in episodes]
    columns: dict[str, Any] = {
        "episode_index": np.repeat(np.arange(len(episodes)), lengths),
        "step_index": np.concatenate([np.arange(length) for length in lengths]),
    }
    signals = {
        name: np.concatenate([episode.signals[name] for episode in episodes])
        for name in episodes[0].signals
    }
    return pa.table(columns | signal_arrays(signals))


class FreshStrata:
    """The strata of a mixture, assigned to the steps of the twin's episodes.

    Args:
        names: the strata's names (S,), without a store's name.
        conditions: outcomes and exposures that can be evaluated on fresh rows.

    `known` (S,) is whether fresh rows can be in a stratum. They cannot if it is defined by columns
    of the store (`where`), or by a condition that cannot be evaluated in the twin.
    """

    def __init__(
        self, mixture: Mixture, names: Sequence[str], conditions: Sequence[Condition]
    ) -> None:
        self.names = tuple(names)
        reported = {condition.name: condition for condition in conditions}
        rules = rules_of(mixture, names)
        self.known: Bools = np.array(
            [
                rule.where is None and (rule.name == NOMINAL or rule.name in reported)
                for rule in rules
            ]
        )
        self.exposures = [c for c in of_kind(conditions, "exposure") if c.name in self.names]
        self._outcomes = [condition.name for condition in of_kind(conditions, "outcome")]
        self._strata = []
        for rule in rules:
            own = reported[rule.name].priority if rule.name in reported else NOMINAL_PRIORITY
            priority = own if rule.priority is None else rule.priority
            self._strata.append(ResolvedStratum(rule, "", None, priority, "pre", "none"))

    @classmethod
    def of(cls, panel: Panel, conditions: Sequence[Condition]) -> FreshStrata:
        """Build the strata from a panel's mixture."""
        header = panel.header
        first = header.strata[: len(header.strata) // (1 + len(header.others))]
        return cls(header.mixture, [stratum.name for stratum in first], conditions)

    def codes(self, labels: Mapping[str, Bools], steps: int, rows: Ints) -> NDArray[np.int16]:
        """Return the stratum of each step (T,) of an episode; -1 for a step in none.

        Args:
            labels: condition -> whether it holds in each step (T,).
            steps: T, the number of the episode's steps.
            rows: (S,) how many fresh rows each stratum has so far.
        """
        held = [labels[name] for name in self._outcomes if name in labels]
        nominal = ~np.any(held, axis=0) if held else np.ones(steps, np.bool_)
        member = np.zeros((steps, len(self.names)), np.bool_)
        for index, stratum in enumerate(self._strata):
            if not self.known[index]:
                continue
            holds = nominal if stratum.name == NOMINAL else labels[stratum.name]
            if stratum.left_over:
                holds = np.ones(steps, np.bool_)
            elif stratum.steps_of_episode:
                holds = np.full(steps, holds.sum() >= stratum.rule.min_steps)
            member[:, index] = holds
        code = assign(member, self._strata)
        observed = [i for i, s in enumerate(self._strata) if s.dealt and steps and member[0, i]]
        if observed:
            fewest = min(observed, key=lambda i: (rows[i], self._strata[i].priority))
            code[np.isin(code, observed)] = fewest
        return code
