"""The probe: a few rows per condition, fixed for the whole run, on which the critic is measured.

Batches change with the policy and the mixture; the probe does not. So TD error by condition and
the distance between the two networks' values can be compared over a run and between runs, as long
as their probe hashes agree.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from restock.arrays import splitmix64
from restock.replay.mixture.packed_row import GOLDEN
from restock.replay.ring.ring import FreshRing
from restock.train.dqn.learner import Learner
from restock.train.dqn.target import value_lag
from restock.train.feed.logs import Logs


@dataclass(frozen=True)
class Probe:
    """Rows (n, W) float32, sorted by condition; `bounds[c]:bounds[c + 1]` are condition c's."""

    rows: Tensor
    conditions: list[str]
    bounds: list[int]
    source: str  # logs | fresh
    hash: str  # 16 hex digits of the rows

    @classmethod
    def of_logs(cls, logs: Logs, per_condition: int) -> Probe | None:
        """The rows of each condition whose hashed transition ids come first."""
        codes, names = logs.condition.codes, logs.condition.names
        return cls._choose(codes, names, logs.transition_id, per_condition, logs.rows, "logs")

    @classmethod
    def of_ring(cls, ring: FreshRing, per_condition: int) -> Probe | None:
        """Without logs: labelled rows of the ring, copied, so that they stay when it moves on."""
        count = len(ring)
        codes = ring.by_condition.stratum[:count].astype(np.int32)
        key = (ring.meta["episode"][:count] << 20) | ring.meta["episode_step"][:count]
        rows = torch.from_numpy(ring.rows[:count])
        return cls._choose(codes, list(ring.conditions), key, per_condition, rows, "fresh")

    @classmethod
    def _choose(
        cls,
        codes: NDArray[Any],
        names: list[str],
        key: NDArray[np.int64],
        per_condition: int,
        rows: Tensor,
        source: str,
    ) -> Probe | None:
        chosen: list[NDArray[np.int64]] = []
        kept, bounds = [], [0]
        for code, name in enumerate(names):
            members = np.flatnonzero(codes == code)
            if not len(members) or not per_condition:
                continue
            order = np.argsort(_scramble(key[members]), kind="stable")[:per_condition]
            chosen.append(members[order])
            kept.append(name)
            bounds.append(bounds[-1] + len(order))
        if not chosen:
            return None
        picked = rows[torch.from_numpy(np.concatenate(chosen))].clone()
        digest = hashlib.blake2b(picked.numpy().tobytes(), digest_size=8).hexdigest()
        return cls(picked, kept, bounds, source, digest)

    def measure(self, learner: Learner) -> tuple[list[dict[str, Any]], float]:
        """Rows for the run's `probe`, per condition, and the lag over all of it."""
        td, q, slow = learner.td_error(self.rows.to(learner.device))
        action = self.rows[:, -3].long().to(learner.device)
        chosen = q.gather(1, action.unsqueeze(1)).squeeze(1)
        rows = []
        for index, name in enumerate(self.conditions):
            part = slice(self.bounds[index], self.bounds[index + 1])
            rows.append(
                {
                    "source": self.source,
                    "condition": name,
                    "rows": part.stop - part.start,
                    "td_abs_mean": float(td[part].abs().mean()),
                    "q_mean": float(chosen[part].mean()),
                    "q_lag": value_lag(q[part], slow[part]),
                    "probe_hash": self.hash,
                }
            )
        return rows, value_lag(q, slow)


def _scramble(key: NDArray[np.int64]) -> NDArray[np.uint64]:
    """A fixed mixing of ids (splitmix64), so that the choice depends on ids, not on order."""
    return splitmix64(key.astype(np.uint64) + np.uint64(GOLDEN))
