"""Which logged rows the behaviour network clones: those of named drivers, and others' successes.

An operator is called where the planner fails, so the logs hold few rows of how it drives where
nothing is wrong, or beside people whom the planner gets past. A clone of those rows alone is poor
there. The rest is in the logs as well: episodes that other drivers brought to their goal without
help (filtered behaviour cloning, %BC in arXiv:2106.01345).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from restock.arrays import F32, Bools
from restock.replay.mixture.packed_row import SCALARS, row_columns
from restock.replay.panel.panel import Panel
from restock.train.dqn.config import TeacherConfig
from restock.train.feed.logs import Coded


def of_policies(policy: Coded, policies: Sequence[str]) -> Bools:
    """The rows (n,) of these behaviour policies."""
    codes = [policy.names.index(name) for name in policies if name in policy.names[:-1]]
    return np.isin(policy.codes, codes)


def of_successes(
    policy: Coded, episode: Coded, reward: F32, discount: F32, policies: Sequence[str]
) -> Bools:
    """The rows (n,) of episodes that reached their goal, and in which none of `policies` drove.

    An episode reached it where it was terminated (discount 0) with a reward above 0.
    """
    well = (discount == 0.0) & (reward > 0.0)
    count = len(episode.names)
    ended = np.bincount(episode.codes[well], minlength=count) > 0
    helped = np.bincount(episode.codes[of_policies(policy, policies)], minlength=count) > 0
    ended[-1] = False  # no episode is known
    return np.asarray((ended & ~helped)[episode.codes], np.bool_)


def packed_successes(policy: Coded, episode: Coded, packed: F32, policies: Sequence[str]) -> Bools:
    """`of_successes` of packed rows (n, W)."""
    columns = row_columns((packed.shape[1] - len(SCALARS)) // 2)
    reward, discount = (
        np.asarray(packed[:, columns[name]]).ravel() for name in ("reward", "discount")
    )
    return of_successes(policy, episode, reward, discount, policies)


def cloned(panel: Panel, teacher: TeacherConfig) -> Bools:
    """The rows (n,) of a panel that are cloned before the first environment step."""
    policy = Coded.of(panel.meta["behaviour_policy"])
    rows = of_policies(policy, teacher.policies)
    if teacher.successes:
        episode = Coded.of(panel.meta["episode_id"])
        rows |= packed_successes(policy, episode, panel.rows, teacher.policies)
    return rows
