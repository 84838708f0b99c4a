"""What packing must know of every row of a plan: what each is to the next, and where it is.

What is worked out of it lies on disk beside the panel while it is built, a few bytes a row, and is
gone when the panel is there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.replay.mixture.n_step import (
    CONTINUES,
    ON_POLICY,
    TERMINATED,
    n_step_horizon,
    n_step_return,
    return_to_go,
    step_flags,
)
from restock.replay.plan.candidates import codes
from restock.replay.plan.transition_ids import STRETCH, Places, stretches


class SourceSteps:
    """Every row of a plan in order: ids, rewards and what each is to the next, (N,).

    Args:
        folder: where the files go.
        rows: META_COLUMNS of the plan's rows.
        random_probability: of an action chosen blindly; below it a policy explores. 0: unknown.
        cut_at_off_policy: end returns before off-policy actions; see `n_step`.
    """

    def __init__(
        self,
        folder: Path,
        rows: pa.Table,
        *,
        random_probability: float,
        cut_at_off_policy: bool,
    ) -> None:
        self.rows = len(rows)
        self._bit = ON_POLICY if cut_at_off_policy else CONTINUES
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
        return (self.flags[begin:end] & self._bit) > 0

    def horizon(self, begin: int, end: int, n_step: int) -> Ints:
        """Return the number of steps in the return of each row of [begin, end)."""
        return n_step_horizon(self._continues(begin, end + n_step - 1), n_step)[: end - begin]

    def returns(self, begin: int, end: int, horizon: Ints, discount: float) -> F64:
        """n-step returns of the rows [begin, end), of those horizons."""
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
