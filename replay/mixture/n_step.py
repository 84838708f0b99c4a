"""Returns over several steps of a recording: how far they reach, what they sum to.

All functions take the rows of a store in order (recording, episode, step), or a stretch of them.

An n-step return of step t uses the rewards of [t, t + n) and bootstraps from the state at t + n. It
is cut where the episode ends, where a step is missing, and, if asked, before an off-policy action:
step j's action is no part of the return of an earlier step where

- another behaviour policy (or version) chose it than the step before: a handover;
- its policy thought it less likely than chance (below 1 / number of actions): it explored.

Such a cut looks at the action of j, which is chosen at the state that the return then bootstraps
from: given that state it is independent of the rewards before it, so the cut adds no bias (it is
the cut of Watkins's Q(lambda), 1989). It never looks at a reward or a state after j.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints

CONTINUES, ON_POLICY, TERMINATED = 1, 2, 4  # bits of a step's flags


def step_flags(
    *,
    episode: NDArray[np.int64],
    step_index: NDArray[np.integer],
    policy: NDArray[np.int64],
    terminated: Bools,
    truncated: Bools,
    explored: Bools,
) -> NDArray[np.uint8]:
    """Return what the step after each row is to it, (N - 1,) bits for N rows in order.

    `episode` and `policy` (N,) are codes, equal where the values are; `explored` (N,) says that a
    row's own policy thought its action less likely than chance.

    CONTINUES: the next row is the next step of the same episode. ON_POLICY: and the same policy
    chose its action, without exploring. TERMINATED: the row itself ends its episode for good.
    """
    same = (episode[1:] == episode[:-1]) & (step_index[1:] == step_index[:-1] + 1)
    continues = same & ~terminated[:-1] & ~truncated[:-1]
    on_policy = continues & (policy[1:] == policy[:-1]) & ~explored[1:]
    flags = continues * CONTINUES + on_policy * ON_POLICY + terminated[:-1] * TERMINATED
    return np.asarray(flags, np.uint8)


def n_step_horizon(continues: Bools, n_step: int) -> Ints:
    """Return how many steps each row's return spans, (N,) in 1..n_step.

    `continues[i]` (N,) says that row i + 1 is part of what row i may sum over (so it is False where
    the episode ends, where a step is missing, and on the last row).
    """
    horizon = np.ones(len(continues), np.int64)
    unbroken = np.ones(len(continues), np.bool_)
    for ahead in range(1, min(n_step, len(continues) + 1)):
        # Row i reaches i + ahead if it reached i + ahead - 1 and that one continues.
        step = np.zeros(len(continues), np.bool_)
        step[: len(continues) - ahead + 1] = continues[ahead - 1 :]
        unbroken &= step
        horizon += unbroken
    return horizon


def n_step_return(reward: F32, horizon: Ints, discount: float) -> F64:
    """sum(gamma^k r[i + k]) for k below horizon[i], (N,)."""
    total = np.asarray(reward, np.float64).copy()
    for ahead in range(1, int(horizon.max(initial=1))):
        reach = np.flatnonzero(horizon > ahead)
        total[reach] += discount**ahead * reward[reach + ahead]
    return total


def return_to_go(reward: F32, continues: Bools, discount: float, after: float = 0.0) -> F64:
    """sum(gamma^k r[i + k]) to the end of what continues, (N,).

    `after` is the return-to-go of the row behind the last, for a stretch whose last row continues.

    By doubling: with sums over 2^j steps at hand, one pass makes those over 2^(j+1), so a stretch
    takes the logarithm of its longest episode in passes.
    """
    total = np.asarray(reward, np.float64).copy()
    if not len(total):
        return total
    # How many steps of the stretch lie before the end of each row's episode, itself included.
    ends = np.flatnonzero(~continues)
    ends = ends if len(ends) and ends[-1] == len(total) - 1 else np.append(ends, len(total) - 1)
    row = np.arange(len(total))
    left = ends[np.searchsorted(ends, row)] - row
    ahead = 1
    while ahead <= int(left.max()):
        reach = np.flatnonzero(left >= ahead)
        total[reach] += discount**ahead * total[reach + ahead]
        ahead *= 2
    if continues[-1]:
        open_end = np.flatnonzero(row + left == len(total) - 1)
        total[open_end] += discount ** (left[open_end] + 1) * after
    return total
