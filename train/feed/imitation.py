"""What the behaviour network learns from: logged rows that are cloned, and fresh labelled ones.

Logged rows are drawn by the shares of their strata, as the critic's are: a network that clones the
majority finds nothing plausible in the rare cases (arXiv:2310.04413). Fresh rows are drawn alike.
If a teacher keeps to no side, a row's mirror image is as valid as the row: half of the rows are
drawn mirrored.

The rows of named drivers are cloned, and other drivers' successes. An operator is called when the
planner fails, so the logs hold few rows of how it drives when nothing is wrong, or beside people
whom the planner gets past, and a clone of those rows alone is poor there. Episodes that other
drivers brought to their goal without help fill that gap (filtered behaviour cloning, %BC in
arXiv:2106.01345).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from restock.arrays import F32, F64, Bools, Ints
from restock.errors import ConfigError
from restock.ingest.task.task import Mirror
from restock.replay.panel.panel import Panel
from restock.replay.sampling.packed_rows import SCALARS, row_columns
from restock.replay.sampling.ring import FreshRing
from restock.state import Stateful
from restock.train.dqn.behaviour import UNKNOWN, Labelled, imitation_loss, plausible_actions
from restock.train.dqn.config import TeacherConfig
from restock.train.dqn.learner import Learner
from restock.train.feed.logs import Coded, Logs

_MEASURED = 128  # rows a condition


def rows_of_policies(policy: Coded, policies: Sequence[str]) -> Bools:
    """Select the rows (n,) of these behaviour policies."""
    codes = [policy.names.index(name) for name in policies if name in policy.names[:-1]]
    return np.isin(policy.codes, codes)


def rows_of_successes(
    policy: Coded, episode: Coded, reward: F32, discount: F32, policies: Sequence[str]
) -> Bools:
    """Select the rows (n,) of episodes that reached their goal without any of `policies`.

    An episode reached it where it was terminated (discount 0) with a reward above 0.
    """
    well = (discount == 0.0) & (reward > 0.0)
    count = len(episode.names)
    ended = np.bincount(episode.codes[well], minlength=count) > 0
    helped = np.bincount(episode.codes[rows_of_policies(policy, policies)], minlength=count) > 0
    ended[-1] = False  # no episode is known
    return np.asarray((ended & ~helped)[episode.codes], np.bool_)


def packed_successes(policy: Coded, episode: Coded, packed: F32, policies: Sequence[str]) -> Bools:
    """`of_successes` of packed rows (n, W)."""
    columns = row_columns((packed.shape[1] - len(SCALARS)) // 2)
    reward, discount = (
        np.asarray(packed[:, columns[name]]).ravel() for name in ("reward", "discount")
    )
    return rows_of_successes(policy, episode, reward, discount, policies)


def cloned(panel: Panel, teacher: TeacherConfig) -> Bools:
    """Select the rows (n,) of a panel that are cloned before the first environment step."""
    policy = Coded.of(panel.meta["behaviour_policy"])
    rows = rows_of_policies(policy, teacher.policies)
    if teacher.successes:
        episode = Coded.of(panel.meta["episode_id"])
        rows |= packed_successes(policy, episode, panel.rows, teacher.policies)
    return rows


class Imitation(Stateful):
    """Draws batches of states with the action that a teacher took, or would have taken.

    Args:
        batch_size: M.
        mirror: of the task, if rows are mirrored.

    Raises:
        ConfigError: the logs have no row of the policies that are to be cloned.
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
        mirror: Mirror | None = None,
    ) -> None:
        self.logs, self.ring, self._mirror = logs, ring, mirror
        self.batch_size, self._seed = batch_size, seed
        self._rng = np.random.default_rng([seed, 7])
        self._offline = self._online = _Drawn(np.empty(0, np.int64), np.empty(0))
        if logs is not None:
            by_teacher = rows_of_policies(logs.behaviour_policy, config.policies)
            every = by_teacher
            if config.successes:
                every = by_teacher | packed_successes(
                    *(logs.behaviour_policy, logs.episode, logs.rows.numpy(), config.policies)
                )
            self._offline = _Drawn.of(logs, every)
            # Answers in the agent's own states are worth more than what other drivers did.
            self._online = _Drawn.of(logs, by_teacher) if config.asks else self._offline
        if not len(self._offline.rows):
            names = None if logs is None else logs.behaviour_policy.names[:-1]  # the last: unknown
            refuse_nothing_to_learn(config, names)
        self.offline_updates = (config.offline_updates or 0) if len(self._offline.rows) else 0
        self._logged = 0  # of an online batch
        if len(self._online.rows):
            self._logged = round(batch_size * config.logs_share) if config.asks else batch_size

    @property
    def cloned(self) -> Ints:
        """The rows (n,) of the logs that online batches are drawn from."""
        return self._online.rows

    def draw_offline(self) -> Labelled:
        """Draw a batch (M,) of logged rows alone."""
        return self._gather(self._offline, self.batch_size)

    def draw_online(self) -> Labelled:
        """Draw a batch (M,): its logged share, then fresh rows."""
        return self._gather(self._online, self._logged if len(self.ring) else self.batch_size)

    def _gather(self, drawn: _Drawn, logged: int) -> Labelled:
        rows = drawn.sample(logged, self._rng)
        fresh = self.batch_size - logged
        slots = self.ring.sample(fresh, self._rng) if fresh else np.empty(0, np.int64)
        parts = [self._logged_states(rows), self._fresh_states(slots)]
        observation, action = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        if self._mirror is not None:
            turned = self._rng.random(len(observation)) < 0.5
            observation[turned] = self._mirror.observation(observation[turned])
            action[turned] = self._mirror.action(action[turned])
        return Labelled(torch.from_numpy(observation), torch.from_numpy(action))

    def _logged_states(self, rows: Ints) -> tuple[F32, Ints]:
        """Observations (n, D) of rows of the logs, and the actions (n,) that were taken."""
        if self.logs is None or not len(rows):
            return self._fresh_states(np.empty(0, np.int64))
        packed = self.logs.rows[torch.from_numpy(rows)].numpy()
        return packed[:, self.ring.columns["observation"]], packed[:, -3].astype(np.int64)

    def _fresh_states(self, slots: Ints) -> tuple[F32, Ints]:
        """Observations (n, D) of slots of the ring, and the teacher's answers (n,)."""
        observation = self.ring.rows[slots, self.ring.columns["observation"]]
        return observation, self.ring.meta["teacher_action"][slots].astype(np.int64)

    def measure(self, learner: Learner) -> list[dict[str, Any]]:
        """Rows of the run's `teacher`: what the filter does now, by source and condition.

        Of up to 128 rows a condition that learning draws from, chosen at random.
        """
        rng = np.random.default_rng([self._seed, 8, learner.gradient_steps])
        groups: dict[tuple[str, str], tuple[F32, Ints]] = {}
        if self.logs is not None and len(self.cloned):
            codes = self.logs.condition.codes[self.cloned]
            for code in np.unique(codes).tolist():
                rows = _some(self.cloned[codes == code], rng)
                groups["logs", self.logs.condition.names[code]] = self._logged_states(rows)
        for code, name in enumerate(self.ring.conditions):
            slots = _some(np.sort(self.ring.by_condition.members(code)), rng)
            if len(slots):
                groups["fresh", name] = self._fresh_states(slots)
        return [
            {"source": source, "condition": name, **_measured(learner, *states)}
            for (source, name), states in groups.items()
        ]


def _some(rows: Ints, rng: np.random.Generator) -> Ints:
    return rows if len(rows) <= _MEASURED else rng.choice(rows, _MEASURED, replace=False)


@torch.no_grad()
def _measured(learner: Learner, observation: F32, action: Ints) -> Mapping[str, Any]:
    """Measure what the filter does in states (n, D) with the teacher's actions (n,)."""
    if learner.behaviour is None:
        raise RuntimeError("there is no behaviour network to measure")
    states = torch.from_numpy(observation).to(learner.device)
    logits = learner.behaviour.network(states)
    plausible = plausible_actions(logits, learner.behaviour.ratio)
    q = learner.network(states)
    chosen = q.masked_fill(~plausible, -torch.inf).argmax(dim=1)
    answer = torch.from_numpy(action).to(learner.device)
    requested = answer != UNKNOWN
    teachers = answer.clamp_min(0)

    def share(of: torch.Tensor) -> float | None:
        return float(of[requested].float().mean()) if bool(requested.any()) else None

    return {
        "ratio": learner.behaviour.in_force,
        "rows": len(action),
        "asked_rows": int(requested.sum()),
        "loss": float(imitation_loss(logits, answer)) if bool(requested.any()) else None,
        "agreement": share(logits.argmax(dim=1) == teachers),
        "plausible_actions": float(plausible.sum(dim=1).float().mean()),
        "teacher_plausible": share(plausible.gather(1, teachers.unsqueeze(1)).squeeze(1)),
        "changed": float((chosen != q.argmax(dim=1)).float().mean()),
        "chosen_agreement": share(chosen == teachers),
    }


def refuse_nothing_to_learn(config: TeacherConfig, logged: Sequence[str] | None) -> None:
    """Raise ConfigError if the logs must have rows of the teacher's policies, but have none.

    One must where the teacher is `logs`; or where they were chosen: only the default ones, of a
    teacher that is asked, may be absent.

    Args:
        logged: names of the logs' behaviour policies; None: there are no logs.
    """
    if not config.filters or set(config.policies) & set(logged or ()):
        return
    chosen = config.policies and config.policies != TeacherConfig().policies
    if config.asks and (logged is None or not chosen):
        return
    have = "this run has no logs" if logged is None else f"the logs have {', '.join(logged)}"
    raise ConfigError(
        f'teacher.source = "{config.source}" clones the rows of '
        f"{', '.join(config.policies) or 'nobody'}, but {have}",
        where="teacher.policies",
        remedy="give a --panel with rows of those policies, or choose other policies",
    )


@dataclass(frozen=True)
class _Drawn:
    """Logged rows (n,), and where the probability of each ends: by the shares of their strata."""

    rows: Ints
    cumulative: F64

    @classmethod
    def of(cls, logs: Logs, chosen: Bools) -> _Drawn:
        weight = np.zeros(len(logs))
        for share, members in zip(logs.shares, logs.stratum_rows, strict=True):
            inside = members[chosen[members]]
            if len(inside):
                weight[inside] += share / len(inside)
        rows = np.flatnonzero(weight > 0)
        cumulative = np.cumsum(weight[rows])
        return cls(rows, cumulative / cumulative[-1] if len(rows) else cumulative)

    def sample(self, count: int, rng: np.random.Generator) -> Ints:
        place = np.searchsorted(self.cumulative, rng.random(count), side="right")
        return self.rows[np.minimum(place, len(self.rows) - 1)]


__all__ = ["Imitation", "refuse_nothing_to_learn"]
