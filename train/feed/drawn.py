"""Batches as they were drawn, kept whole until their interval is summed.

The update loop only appends a `BatchRecord`; joining many into columns, and keeping an open
interval in a checkpoint, happen outside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class BatchRecord:
    """A batch as it was drawn: L rows of logs and F fresh ones, B = L + F."""

    step: int
    env_steps: int
    log_row: NDArray[np.int64]  # (L,)
    log_stratum: NDArray[np.int64]  # (L,)
    quota: NDArray[np.float64]  # (S,) shares of the logs in force; none where no row is logged
    code: NDArray[np.int16]  # (F,) condition of each fresh row, -1 while unlabelled
    episode: NDArray[np.int64]  # (F,)
    episode_step: NDArray[np.int32]  # (F,)
    policy: NDArray[np.int16]  # (F,)
    env_step: NDArray[np.int64]  # (F,) when it was collected
    gradient_step: NDArray[np.int64]  # (F,)
    td: NDArray[np.float32]  # (B,)
    q: NDArray[np.float32]  # (B,)
    weight: NDArray[np.float32] | None  # (B,)
    tail: NDArray[np.float32]  # (B, 2) reward, discount


# The arrays of a batch that a checkpoint keeps, and which of its rows they are about.
_ARRAYS = {
    **dict.fromkeys(("log_row", "log_stratum"), "log"),
    **dict.fromkeys(
        ("code", "episode", "episode_step", "policy", "env_step", "gradient_step"), "fresh"
    ),
    **dict.fromkeys(("td", "q", "tail"), "both"),
}


def _logged(values: NDArray[Any], batch: BatchRecord) -> NDArray[Any]:
    return values[: len(batch.log_row)]


def _fresh(values: NDArray[Any], batch: BatchRecord) -> NDArray[Any]:
    return values[len(batch.log_row) :]


def as_columns(kept: Sequence[BatchRecord], unlabelled: int) -> dict[str, NDArray[Any]]:
    """Batches as columns over all their rows, logs and fresh apart.

    `unlabelled` is the stratum of fresh rows whose episode has not ended.
    """

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(batch, name) for batch in kept])

    fresh = [len(batch.code) for batch in kept]
    code = joined("code")
    quotas = [batch.quota for batch in kept if len(batch.log_row)]
    columns = {
        "log_quota": np.mean(quotas, axis=0) if quotas else np.empty(0),
        "log_row": joined("log_row"),
        "log_stratum": joined("log_stratum"),
        "fresh_stratum": np.where(code < 0, unlabelled, code),
        "fresh_key": (joined("episode") << 20) | joined("episode_step"),
        "fresh_policy": joined("policy"),
        "age_env_steps": np.repeat([b.env_steps for b in kept], fresh) - joined("env_step"),
        "age_gradient_steps": np.repeat([b.step for b in kept], fresh) - joined("gradient_step"),
    }
    for side, part in (("log", _logged), ("fresh", _fresh)):
        for name in ("td", "q"):
            columns[f"{side}_{name}"] = np.concatenate(
                [part(getattr(batch, name), batch) for batch in kept]
            )
        columns[f"{side}_weight"] = np.concatenate(
            [
                np.ones(len(part(batch.td, batch)), np.float32)
                if batch.weight is None
                else part(batch.weight, batch)
                for batch in kept
            ]
        )
        tail = np.concatenate([part(batch.tail, batch) for batch in kept])
        columns[f"{side}_reward"], columns[f"{side}_discount"] = tail[:, 0], tail[:, 1]
    return columns


def to_state(kept: Sequence[BatchRecord]) -> dict[str, Any]:
    """Joined arrays and JSON values, for a checkpoint."""
    if not kept:
        return {"clocks": []}
    weights = [b.weight if b.weight is not None else np.ones_like(b.td) for b in kept]
    return {
        "clocks": [[b.step, b.env_steps, len(b.log_row), len(b.code)] for b in kept],
        "weight": np.concatenate(weights),
        "quota_sizes": [len(b.quota) for b in kept],
        "quota": np.concatenate([b.quota for b in kept]),
        **{name: np.concatenate([getattr(b, name) for b in kept]) for name in _ARRAYS},
    }


def from_state(state: Mapping[str, Any]) -> list[BatchRecord]:
    """The batches that `to_state` was given."""
    kept = []
    logged = fresh = quotas = 0
    sizes = state.get("quota_sizes", ())
    for (step, env_steps, log_rows, slots), size in zip(state["clocks"], sizes, strict=True):
        places = {
            "log": slice(logged, logged + log_rows),
            "fresh": slice(fresh, fresh + slots),
            "both": slice(logged + fresh, logged + fresh + log_rows + slots),
        }
        arrays = {name: state[name][places[side]] for name, side in _ARRAYS.items()}
        weight = state["weight"][places["both"]]
        quota = state["quota"][quotas : quotas + size]
        kept.append(
            BatchRecord(step=step, env_steps=env_steps, weight=weight, quota=quota, **arrays)
        )
        logged, fresh, quotas = logged + log_rows, fresh + slots, quotas + size
    return kept
