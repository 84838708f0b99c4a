"""The critic on experience that is in no replay: the steps of the periodic evaluations.

Replay measures itself: a critic that fits what it is fed has a low TD error there, whatever it is
fed. The evaluation's episodes are fresh, of every condition, and never learnt from; what the critic
gets wrong on them and not in replay is what replay lacks. They also say how often each condition is
met when driving, and what its observations look like. `restock diagnose` reads it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from restock.arrays import F32, Ints
from restock.ingest.task.conditions import Condition
from restock.ingest.task.task import Task
from restock.replay.ring.ring import FreshRing
from restock.train.dqn.learner import Learner
from restock.train.dqn.target import value_lag
from restock.train.evaluation.evaluate import EpisodeResult, run_episodes
from restock.train.feed.collector import Collector
from restock.train.feed.probe import LogFidelity, Probe
from restock.train.twin.env.interface import Policy, Step, Twin
from restock.train.twin.physics.episode import EpisodeSpec

_ROWS = 512  # per condition, chosen by hash
_CAPACITY = 16_384  # steps kept of one evaluation


class EvaluationBuffer:
    """The evaluation's twin, and the steps of the episodes that were last driven in it."""

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
        """Drive every episode, in the order of `specs`; what was kept before is forgotten.

        `between` is called before every step; what it raises ends the drive.
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
        collector.observation = np.array(observation, copy=True)  # the twin writes over its own
        step: Step = collector.start(action, np.ones(len(action), np.float32))
        ended = collector.finish(env_steps=0, gradient_steps=0, acting_step=0)
        number = step[4]["episode_number"]
        # Environments drive on after their fixed episodes: those steps do not count.
        collector.forget([episode for episode in ended if number[episode.env] < 0])
        return step

    def measure(self, learner: Learner) -> list[dict[str, Any]]:
        """Rows of the run's table, one a condition, of the episodes that were last driven."""
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
    """Return the explained share of the targets' variance (n,); None without variance."""
    spread = float(target.var(unbiased=False))
    return 1.0 - float(td.var(unbiased=False)) / spread if spread > 0 else None


__all__ = ["EvaluationBuffer"]
