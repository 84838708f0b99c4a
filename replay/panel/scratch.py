"""Per-row facts that packing needs: how each row of a plan continues in the next, and its returns.

The results are on disk beside the panel while it is built, a few bytes per row, and are deleted
when it is complete. All functions take the rows of a store in order (recording, episode, step), or
a stretch of them.

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

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.replay.plan.candidates import STRETCH, Places, codes, stretches

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


class SourceSteps:
    """Every row of a plan in order: ids, rewards and what each is to the next, (N,).

    Args:
        folder: where the files go.
        rows: META_COLUMNS of the plan's rows.
        random_probability: of an action chosen blindly; below it a policy explores. 0: unknown.
    """

    def __init__(
        self,
        folder: Path,
        rows: pa.Table,
        *,
        random_probability: float,
    ) -> None:
        self.rows = len(rows)
        self.ids: Ints = rows["transition_id"].to_numpy()
        self.reward: F32 = rows["reward"].to_numpy()
        self.flags: NDArray[np.uint8] = _on_disk(folder / "flags", np.uint8, self.rows)
        self._folder = folder
        for begin, end in stretches(self.rows - 1):
            # With the row behind: what that one is to the last.
            self.flags[begin:end] = _flags(rows.slice(begin, end + 1 - begin), random_probability)
        if rows["terminated"][-1].as_py():
            self.flags[-1] = TERMINATED

    def _continues(self, begin: int, end: int) -> Bools:
        return (self.flags[begin:end] & ON_POLICY) > 0

    def horizon(self, begin: int, end: int, n_step: int) -> Ints:
        """Return the number of steps in the return of each row of [begin, end)."""
        return n_step_horizon(self._continues(begin, end + n_step - 1), n_step)[: end - begin]

    def returns(self, begin: int, end: int, horizon: Ints, discount: float) -> F64:
        """Compute n-step returns of the rows [begin, end) with these horizons."""
        ahead = int(horizon.max(initial=1)) - 1
        reward = self.reward[begin : end + ahead]
        padded = np.concatenate([horizon, np.ones(len(reward) - len(horizon), np.int64)])
        return n_step_return(reward, padded, discount)[: end - begin]

    def returns_to_go(self, discount: float) -> tuple[F32, Bools]:
        """Compute each row's discounted return (N,), on disk, and whether it is complete (N,).

        A return is complete if it runs to the termination of its episode.
        """
        total: F32 = _on_disk(self._folder / "return_to_go", np.float32, self.rows)
        whole: Bools = _on_disk(self._folder / "whole", np.bool_, self.rows)
        after, ends_whole = 0.0, False
        for begin in reversed(range(0, self.rows, STRETCH)):
            end = min(begin + STRETCH, self.rows)
            continues = self._continues(begin, end)
            sums = return_to_go(self.reward[begin:end], continues, discount, after)
            total[begin:end] = sums
            # Of each row, the last of the stretch that it reaches.
            stops = np.append(np.flatnonzero(~continues[:-1]), len(continues) - 1)
            last = stops[np.searchsorted(stops, np.arange(len(continues)))]
            terminated = (self.flags[begin:end] & TERMINATED) > 0
            reached = terminated.copy()
            if continues[-1]:
                reached[-1] = ends_whole
            whole[begin:end] = reached[last]
            after, ends_whole = float(sums[0]), bool(whole[begin])
        return total, whole

    def places(self) -> Places:
        """Return where a transition is, by its id."""
        return Places(self.ids)


def _flags(rows: pa.Table, random_probability: float) -> NDArray[np.uint8]:
    # A row without a version is of the version "" of its policy.
    version = pc.coalesce(rows["behaviour_version"].cast(pa.string()), "")
    version = version.combine_chunks().dictionary_encode()
    policy = codes(rows, "behaviour_policy")
    pair = policy * len(version.dictionary) + version.indices.to_numpy()
    return step_flags(
        episode=codes(rows, "episode_id").astype(np.int64),
        step_index=rows["step_index"].to_numpy(),
        policy=np.where(policy < 0, -1, pair),
        terminated=rows["terminated"].to_numpy(),
        truncated=rows["truncated"].to_numpy(),
        explored=rows["action_probability"].to_numpy() < random_probability,
    )


def _on_disk(path: Path, dtype: Any, rows: int) -> NDArray[Any]:
    return np.memmap(path, dtype, "w+", shape=(rows,))
