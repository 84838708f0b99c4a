"""What the behaviour network learns from: logged rows of named policies, and fresh labelled ones.

Logged rows are drawn by the shares of their strata, as the critic's are: a network that clones the
majority finds nothing plausible in the rare cases (arXiv:2310.04413). Fresh rows are drawn alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch

from restock.arrays import F64, Ints
from restock.errors import ConfigError
from restock.replay.ring.ring import FreshRing
from restock.state import Stateful
from restock.train.dqn.behaviour import Labelled
from restock.train.dqn.config import TeacherConfig
from restock.train.feed.logs import Logs


class Imitation(Stateful):
    """Draws batches of states with the action that a teacher took, or would have taken.

    Args:
        batch_size: M.
        device: where the batches are wanted.

    Raises:
        ConfigError: the teacher is `logs`, and they have no row of its policies.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_rng",)

    def __init__(
        self,
        config: TeacherConfig,
        logs: Logs | None,
        ring: FreshRing,
        *,
        batch_size: int,
        seed: int,
        device: torch.device,
    ) -> None:
        self.logs, self.ring, self.device = logs, ring, device
        self.batch_size = batch_size
        self._rng = np.random.default_rng([seed, 7])
        self.cloned: Ints = np.empty(0, np.int64)  # rows of the logs
        self._cumulative: F64 = np.empty(0)
        if logs is not None:
            self.cloned, self._cumulative = _cloned(logs, config.policies)
        if not len(self.cloned):
            names = None if logs is None else logs.behaviour_policy.names[:-1]  # the last: unknown
            refuse_nothing_to_learn(config, names)
        self.offline_updates = config.offline_updates if len(self.cloned) else 0
        self._logged = 0  # of an online batch
        if len(self.cloned):
            self._logged = round(batch_size * config.logs_share) if config.asks else batch_size

    def draw_offline(self) -> Labelled:
        """A batch (M,) of logged rows alone."""
        return self._gather(self.batch_size)

    def draw_online(self) -> Labelled:
        """A batch (M,): the logged share of it, then fresh rows."""
        return self._gather(self._logged if len(self.ring) else self.batch_size)

    def _gather(self, logged: int) -> Labelled:
        observation = np.empty((self.batch_size, self.ring.observation_size), np.float32)
        action = np.empty(self.batch_size, np.int64)
        columns = self.ring.columns["observation"]
        if logged and self.logs is not None:
            place = np.searchsorted(self._cumulative, self._rng.random(logged), side="right")
            rows = self.cloned[np.minimum(place, len(self.cloned) - 1)]
            packed = self.logs.rows[torch.from_numpy(rows)].numpy()
            observation[:logged], action[:logged] = packed[:, columns], packed[:, -3]
        if fresh := self.batch_size - logged:
            slots = self.ring.sample(fresh, self._rng)
            observation[logged:] = self.ring.rows[slots, columns]
            action[logged:] = self.ring.meta["teacher_action"][slots]
        return Labelled(
            torch.from_numpy(observation).to(self.device), torch.from_numpy(action).to(self.device)
        )


def refuse_nothing_to_learn(config: TeacherConfig, logged: Sequence[str] | None) -> None:
    """Raises ConfigError where the teacher is `logs`, and none of its policies is in them.

    Args:
        logged: names of the logs' behaviour policies; None: there are no logs.
    """
    if not config.filters or config.asks or set(config.policies) & set(logged or ()):
        return
    have = "this run has no logs" if logged is None else f"the logs have {', '.join(logged)}"
    raise ConfigError(
        f'teacher.source = "logs" clones the rows of {", ".join(config.policies) or "nobody"}, and'
        f" {have}",
        where="teacher.policies",
        remedy="give --panel one with rows of those policies, or name others",
    )


def _cloned(logs: Logs, policies: tuple[str, ...]) -> tuple[Ints, F64]:
    """Rows (n,) of these behaviour policies, and where the probability of each ends: by strata."""
    policy = logs.behaviour_policy
    codes = [policy.names.index(name) for name in policies if name in policy.names]
    rows = np.flatnonzero(np.isin(policy.codes, codes))
    weight = np.zeros(len(logs))
    for share, members in zip(logs.shares, logs.stratum_rows, strict=True):
        inside = members[np.isin(members, rows)]
        if len(inside):
            weight[inside] += share / len(inside)
    drawn = rows[weight[rows] > 0]
    cumulative = np.cumsum(weight[drawn])
    return drawn, cumulative / cumulative[-1] if len(drawn) else cumulative


__all__ = ["Imitation", "refuse_nothing_to_learn"]
