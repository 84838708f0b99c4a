"""Drive policies through the same seeded episodes in the twin, without exploration.

An episode is fully determined by its spec (condition, seed, perturbation), so every policy, run
and checkpoint drives the same episodes, and results can be compared episode by episode.

Evaluations during training also measure the critic on their steps, which are never in replay. On
replay itself, a critic that fits its feed has a low TD error whatever it is fed. If it is wrong on
evaluation steps and right on replay, replay lacks something. These steps also show how often each
condition occurs when driving, and what its observations look like. `restock diagnose` reads these
measurements.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from restock.arrays import F32, F64, Ints
from restock.ingest.task.conditions import Condition
from restock.ingest.task.robot import NONE, STOP
from restock.ingest.task.task import Signals, Task
from restock.replay.sampling.ring import FreshRing
from restock.train.dqn.learner import Learner, value_lag
from restock.train.feed.collector import Collector
from restock.train.feed.fresh_labels import values_entries
from restock.train.feed.logs import LogFidelity, Probe
from restock.train.twin.env.interface import Policy, Step, Twin
from restock.train.twin.physics.episode import EpisodeSpec

_TIMED_STEPS = 8

Stepper = Callable[[F32, Ints], Step]

STUCK_WINDOW_S, STUCK_RADIUS_M = 10.0, 0.5


@dataclass(frozen=True)
class EpisodeResult:
    """The outcome of one episode."""

    condition: str
    block: str  # none | partial | full
    episode_seed: int
    success: bool | None  # None: the task has no goal
    bumps: int  # contacts that began
    time_s: float
    undiscounted_return: float
    end_x_m: float
    end_y_m: float
    failure: str | None  # stuck | timeout | bump | cut
    perturbation: str = "nominal"
    perturbation_values: str = "{}"  # JSON: the parameters that are not nominal
    layout: str = "default"
    distance_m: float | None = None  # driven, over ground
    closest_person_m: float | None = None  # body edge to edge; None: there was no person
    discounted_return: float | None = None  # None: no discount was given
    limited_s: float | None = None  # time in which a limiter reduced commands; None: no limiter
    stopped_s: float | None = None  # part of `limited_s` in which it stopped the robot

    @property
    def row(self) -> dict[str, Any]:
        """Return the columns that all tables of episodes have."""
        return {
            "condition": self.condition,
            "block": self.block,
            "episode_seed": self.episode_seed,
            "perturbation": self.perturbation,
            "layout": self.layout,
            "perturbation_values": values_entries(self.perturbation_values),
            "success": self.success,
            "bumps": self.bumps,
            "time_s": self.time_s,
            "return": self.undiscounted_return,
            "discounted_return": self.discounted_return,
            "distance_m": self.distance_m,
            "closest_person_m": self.closest_person_m,
        }


def fixed_episodes(conditions: Sequence[str], episodes: int, first_seed: int) -> list[EpisodeSpec]:
    """Return `episodes` fixed episodes per condition, with seeds from `first_seed`."""
    return [
        EpisodeSpec(condition, first_seed + index)
        for index in range(episodes)
        for condition in conditions
    ]


def evaluation_time_s(env: Twin, specs: Sequence[EpisodeSpec], time_limit_steps: int) -> float:
    """Estimate how long driving these episodes takes, by timing a few steps.

    Assumes that episodes last a third of the time limit on average.
    """
    env.set_episodes(specs)
    env.reset(seed=0)
    action = np.zeros(env.num_envs, np.int64)
    env.step(action)
    began = time.perf_counter()
    for _ in range(_TIMED_STEPS):
        env.step(action)
    step_s = (time.perf_counter() - began) / _TIMED_STEPS
    return step_s * math.ceil(len(specs) / env.num_envs) * time_limit_steps / 3


def run_episodes(
    env: Twin,
    policy: Policy,
    specs: Sequence[EpisodeSpec],
    *,
    control_period_s: float,
    time_limit_steps: int,
    goal: bool = True,
    discount: float | None = None,
    step: Stepper | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[EpisodeResult]:
    """Drive every episode to its end, N at a time; return results in the order of `specs`.

    `step(observations, actions)`, if given, is called in place of `env.step(actions)`.
    Without a `goal`, success is None, and only episodes with a bump fail. `discount` is per step.
    """
    results: list[EpisodeResult | None] = [None] * len(specs)
    env.set_episodes(specs)
    # The seed fixes how environments keep driving once they have no episodes left.
    observation, _ = env.reset(seed=0)
    window = round(STUCK_WINDOW_S / control_period_s)
    steps = np.zeros(env.num_envs, np.int64)
    bumps = np.zeros(env.num_envs, np.int64)
    touching = np.zeros(env.num_envs, np.bool_)
    total, discounted = np.zeros(env.num_envs), np.zeros(env.num_envs)
    distance = np.zeros(env.num_envs)
    limited = np.zeros((2, env.num_envs), np.int64)  # counts of limited steps, and of those stopped
    track = np.zeros((env.num_envs, time_limit_steps + 1, 2))
    track[:, 0] = _position(env.signals)
    left = len(specs)
    while left:
        action, _ = policy.act(env, observation)
        made = env.step(action) if step is None else step(observation, action)
        observation, reward, terminated, truncated, info = made
        after = info["signals"]
        if discount is not None:
            discounted += reward * discount**steps
        steps += 1
        total += reward
        distance += info["travelled_m"]
        rule = info.get("limiter")
        if rule is not None:
            limited += rule != NONE, rule >= STOP
        bumped = np.asarray(after["bumped"], np.bool_)
        bumps += bumped & ~touching
        touching = bumped.copy()
        envs = np.arange(env.num_envs)
        track[envs, np.minimum(steps, time_limit_steps)] = _position(after)
        ended = np.flatnonzero(terminated | truncated)
        for place in ended:
            index = int(info["episode_number"][place])
            # -1: the environment has no episodes left and keeps driving unrecorded.
            if index >= 0:
                count = int(steps[place])
                closest = info["closest_person_m"][place]
                end = track[place, min(count, time_limit_steps)]
                before = track[place, max(count - window, 0)]
                success = bool(info["success"][place]) if goal else None
                values = info.get("perturbation_values")
                results[index] = EpisodeResult(
                    perturbation=str(info["perturbation"][place]),
                    layout=str(info["layout"][place]) if "layout" in info else "default",
                    perturbation_values="{}" if values is None else str(values[place]),
                    condition=specs[index].condition,
                    block=str(info["block"][place]),
                    episode_seed=specs[index].seed,
                    success=success,
                    bumps=int(bumps[place]),
                    time_s=count * control_period_s,
                    undiscounted_return=float(total[place]),
                    end_x_m=float(end[0]),
                    end_y_m=float(end[1]),
                    failure=None
                    if success or (success is None and not bumps[place])
                    else _failure(
                        bool(terminated[place]),
                        count < time_limit_steps,
                        float(np.hypot(*(end - before))) < STUCK_RADIUS_M,
                    ),
                    distance_m=float(distance[place]),
                    closest_person_m=float(closest) if np.isfinite(closest) else None,
                    discounted_return=None if discount is None else float(discounted[place]),
                    limited_s=None if rule is None else float(limited[0, place]) * control_period_s,
                    stopped_s=None if rule is None else float(limited[1, place]) * control_period_s,
                )
                left -= 1
                if progress is not None:
                    progress(1)
        steps[ended], bumps[ended], touching[ended] = 0, 0, False
        limited[:, ended] = 0
        total[ended], discounted[ended], distance[ended] = 0.0, 0.0, 0.0
        track[ended, 0] = _position(env.signals)[ended]
    return [result for result in results if result is not None]


def _position(signals: Signals) -> F64:
    return np.stack([signals["pose_x_m"], signals["pose_y_m"]], axis=-1)


def _failure(terminated: bool, early: bool, still: bool) -> str:
    if terminated:
        return "bump"
    if early:
        return "cut"
    return "stuck" if still else "timeout"


@dataclass(frozen=True)
class Score:
    """The result of a greedy evaluation."""

    success: dict[str, float]  # per condition; empty if the task has no goal
    success_mean: float  # over conditions with equal weight; 0 without a goal
    return_mean: float

    def beats(self, other: Score | None) -> bool:
        """Return whether mean success is higher than the other's, or equal with a higher return."""
        if other is None:
            return True
        best = (other.success_mean, other.return_mean)
        return (self.success_mean, self.return_mean) > best


def score(results: Sequence[EpisodeResult]) -> Score:
    """Average success and return over the episodes of each condition, then over conditions."""
    conditions = dict.fromkeys(result.condition for result in results)
    by = {name: [r for r in results if r.condition == name] for name in conditions}
    success = {
        name: float(np.mean([bool(r.success) for r in group]))
        for name, group in by.items()
        if all(r.success is not None for r in group)
    }
    returns = [float(np.mean([r.undiscounted_return for r in group])) for group in by.values()]
    average = float(np.mean(list(success.values()))) if success else 0.0
    return Score(success, average, float(np.mean(returns)))


_ROWS = 512  # rows per condition on which the critic is measured, chosen by hash
_CAPACITY = 16_384  # largest number of steps that are kept of an evaluation


class EvaluationBuffer:
    """The evaluation's twin, and the steps of the last episodes that were driven in it."""

    def __init__(
        self,
        env: Twin,
        task: Task,
        conditions: Sequence[Condition],
        ring: FreshRing,
        logs: LogFidelity | None,
    ) -> None:
        self.env = env
        self._task, self._conditions, self._logs = task, conditions, logs
        self._training_ring = ring
        self._collector = self._empty()

    def drive(
        self,
        policy: Policy,
        specs: Sequence[EpisodeSpec],
        discount: float | None = None,
        between: Callable[[], None] = lambda: None,
    ) -> list[EpisodeResult]:
        """Forget earlier steps, then drive every episode; return results in the order of `specs`.

        `between` is called before every step; if it raises, the drive ends.
        """
        self._collector = self._empty()

        def step(observation: F32, action: Ints) -> Step:
            between()
            return self._step(observation, action)

        return run_episodes(
            self.env,
            policy,
            specs,
            control_period_s=self._task.control_period_s,
            time_limit_steps=self._task.time_limit_steps,
            goal=self._task.goal != "none",
            discount=discount,
            step=step,
        )

    def _step(self, observation: F32, action: Ints) -> Step:
        collector = self._collector
        collector.observation = np.array(observation, copy=True)  # the twin overwrites its array
        step: Step = collector.start(action, np.ones(len(action), np.float32))
        ended = collector.finish(env_steps=0, gradient_steps=0, acting_step=0)
        number = step[4]["episode_number"]
        # Environments keep driving after their fixed episodes; those steps do not count.
        collector.forget([episode for episode in ended if number[episode.env] < 0])
        return step

    def measure(self, learner: Learner) -> list[dict[str, Any]]:
        """Measure the critic on the last episodes' steps; return a row per condition."""
        self._collector.label(all_of_them=True)
        ring = self._collector.ring
        probe = Probe.of_ring(ring, _ROWS)
        if probe is None:
            return []
        agreement: dict[str, float] = {}
        unexplained: dict[str, float] = {}
        if self._logs is not None:
            sources = (probe, Probe.of_ring(self._training_ring, _ROWS))
            agreement = self._logs.agreement(*(one for one in sources if one is not None))
            unexplained = self._logs.unexplained
        rows = probe.rows.to(learner.device)
        td, q, slow = learner.td_error(rows)
        online = learner.td_error(rows, online=True)[0]
        chosen = q.gather(1, rows[:, -3:-2].long())[:, 0]
        measured = []
        for index, name in enumerate(probe.conditions):
            part = slice(probe.bounds[index], probe.bounds[index + 1])
            measured.append(
                {
                    "condition": name,
                    "rows": part.stop - part.start,
                    "rows_met": int(ring.by_condition.counts[ring.conditions.index(name)]),
                    "td_abs_mean": float(td[part].abs().mean()),
                    "td_online_abs_mean": float(online[part].abs().mean()),
                    "explained": _explained_share(td[part], chosen[part] - td[part]),
                    "q_abs_mean": float(q[part].abs().mean()),
                    "q_lag": value_lag(q[part], slow[part]),
                    "logs_agreement": agreement.get(name),
                    "logs_unexplained": unexplained.get(name),
                }
            )
        return measured

    def _empty(self) -> Collector:
        like = self._training_ring
        ring = FreshRing(
            _CAPACITY,
            self.env.num_envs,
            self._task.observation_size,
            discount=like.discount,
            n_step=like.n_step,
            conditions=like.conditions,
        )
        return Collector(self.env, ring, self._conditions, self._task, None)


def _explained_share(td: Tensor, target: Tensor) -> float | None:
    """Return which share of the variance of targets (n,) Q explains; None if they do not vary."""
    spread = float(target.var(unbiased=False))
    return 1.0 - float(td.var(unbiased=False)) / spread if spread > 0 else None
