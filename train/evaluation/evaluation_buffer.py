"""The critic on experience that is in no replay: the steps of the periodic evaluations.

Replay measures itself: a critic that fits what it is fed has a low TD error there, whatever it is
fed. The evaluation's episodes are fresh, of every condition, and never learnt from; what the critic
gets wrong on them and not in replay is what replay lacks. They also say how often each condition is
met when driving, and what its observations look like. `restock diagnose` reads it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from restock.ingest.task.conditions import Condition
from restock.ingest.task.task import Task
from restock.replay.ring.ring import FreshRing
from restock.train.dqn.learner import Learner
from restock.train.dqn.target import value_lag
from restock.train.feed.collector import Collector
from restock.train.feed.log_fidelity import LogFidelity
from restock.train.feed.probe import Probe
from restock.train.twin.env.interface import Twin
from restock.train.twin.physics.episode import EpisodeSpec

Step = tuple[Any, Any, Any, Any, dict[str, Any]]
_ROWS = 512  # per condition, chosen by hash
_CAPACITY = 16_384  # steps kept of one evaluation


class _Tapped:
    """A twin that remembers what its last step returned."""

    def __init__(self, env: Twin) -> None:
        self._env = env
        self.num_envs = env.num_envs
        self.last: Step = (None, None, None, None, {})

    @property
    def signals(self) -> dict[str, NDArray[Any]]:
        return self._env.signals

    def set_episodes(self, specs: Iterable[EpisodeSpec], /) -> None:
        self._env.set_episodes(specs)

    def reset(self, *, seed: int | None = None) -> tuple[NDArray[Any], dict[str, Any]]:
        return self._env.reset(seed=seed)

    def step(self, actions: NDArray[Any], /) -> Step:
        self.last = self._env.step(actions)
        return self.last

    def get_state(self) -> dict[str, Any]:
        return self._env.get_state()

    def set_state(self, state: dict[str, Any], /) -> None:
        self._env.set_state(state)


class HeldOut(_Tapped):
    """The evaluation's twin, which keeps what is driven in it apart."""

    def __init__(
        self,
        env: Twin,
        task: Task,
        conditions: Sequence[Condition],
        like: FreshRing,
        logs: LogFidelity | None,
    ) -> None:
        self._inner = _Tapped(env)
        super().__init__(self._inner)
        self._task, self._conditions, self._like, self._logs = task, conditions, like, logs
        self._collector = self._begin()

    def reset(self, *, seed: int | None = None) -> tuple[NDArray[Any], dict[str, Any]]:
        """Begin anew: what was kept is forgotten."""
        self._collector = self._begin()
        observation, info = super().reset(seed=seed)
        self._collector.observation = np.array(observation, copy=True)
        return observation, info

    def step(self, actions: NDArray[Any], /) -> Step:
        self._collector.start(actions, np.ones(len(actions), np.float32))
        self._collector.finish(env_steps=0, gradient_steps=0, acting_step=0)
        return self._inner.last

    def measure(self, learner: Learner) -> list[dict[str, Any]]:
        """Rows for the run's `held_out`, one a condition, of the episodes since the last reset."""
        self._collector.label(all_of_them=True)
        ring = self._collector.ring
        probe = Probe.of_ring(ring, _ROWS)
        if probe is None:
            return []
        agreement = self._logs.agreement(probe) if self._logs is not None else {}
        unexplained = self._logs.unexplained if self._logs is not None else {}
        rows = probe.rows.to(learner.device)
        td, q, slow = learner.td_error(rows)
        own = learner.td_error(rows, online=True)[0]
        chosen = q.gather(1, rows[:, -3:-2].long())[:, 0]
        found = []
        for index, name in enumerate(probe.conditions):
            part = slice(probe.bounds[index], probe.bounds[index + 1])
            found.append(
                {
                    "condition": name,
                    "rows": part.stop - part.start,
                    "rows_met": int(ring.strata.counts[ring.conditions.index(name)]),
                    "td_abs_mean": float(td[part].abs().mean()),
                    "td_online_abs_mean": float(own[part].abs().mean()),
                    "explained": _explained(td[part], chosen[part] - td[part]),
                    "q_abs_mean": float(q[part].abs().mean()),
                    "q_lag": value_lag(q[part], slow[part]),
                    "logs_agreement": agreement.get(name),
                    "logs_unexplained": unexplained.get(name),
                }
            )
        return found

    def _begin(self) -> Collector:
        like = self._like
        ring = FreshRing(
            _CAPACITY,
            self.num_envs,
            self._task.observation_size,
            discount=like.discount,
            n_step=like.n_step,
            conditions=like.conditions,
        )
        return Collector(self._inner, ring, self._conditions, self._task, None)


def _explained(td: Tensor, target: Tensor) -> float | None:
    """The share of the targets' variance (n,) that the critic explains; None where they are one."""
    spread = float(target.var(unbiased=False))
    return 1.0 - float(td.var(unbiased=False)) / spread if spread > 0 else None


__all__ = ["HeldOut"]
