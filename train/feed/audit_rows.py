"""Rows of audited batches, as columns of the run's table `audit`."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.replay.ring.ring import FreshRing
from restock.train.feed.batches import Batch
from restock.train.feed.fresh_log import FreshPerturbations
from restock.train.feed.logs import Coded, Logs

Columns = dict[str, Any]


def row_hashes(packed: NDArray[np.float32]) -> list[str]:
    """blake2b of each packed row (B, W), 16 hex digits: `restock trace` holds rows against it."""
    return [hashlib.blake2b(row.tobytes(), digest_size=8).hexdigest() for row in packed]


def logged_rows(
    columns: Mapping[str, NDArray[Any]], logs: Logs, age_days: NDArray[np.float64]
) -> Columns:
    """What is to be said of the logged rows of one batch (`columns`, by `drawn.as_columns`)."""
    row = columns["log_row"]
    return {
        "source": "logs",
        "transition_id": logs.transition_id[row],
        "panel_row": row,
        "ring_slot": None,
        "episode": _names(logs.episode, row),
        "episode_step": None,
        "age_days": age_days[row],
        "age_env_steps": None,
        "age_gradient_steps": None,
        "stratum": [logs.strata[code] for code in columns["log_stratum"].tolist()],
        "condition": _names(logs.condition, row),
        "behaviour_policy": _names(logs.behaviour_policy, row),
        "behaviour_version": _names(logs.behaviour_version, row),
        "perturbation": (
            [logs.perturbation.known(place) for place in row.tolist()]
            if logs.perturbation
            else None
        ),
        "perturbation_values": None,
        **_learnt(columns, "log"),
    }


def fresh_rows(
    columns: Mapping[str, NDArray[Any]],
    batch: Batch,
    ring: FreshRing,
    strata: Sequence[str],
    perturbations: FreshPerturbations | None = None,
) -> Columns:
    """The same of its fresh rows. The last of `strata` has no condition yet."""
    slots, meta = batch.slots, ring.meta
    codes = columns["fresh_stratum"].tolist()
    keys = meta["episode"][slots]
    return {
        "source": "fresh",
        "transition_id": None,
        "panel_row": None,
        "ring_slot": slots,
        "episode": [str(key) for key in meta["episode"][slots].tolist()],
        "episode_step": meta["episode_step"][slots],
        "age_days": None,
        "age_env_steps": columns["age_env_steps"],
        "age_gradient_steps": columns["age_gradient_steps"],
        "stratum": [strata[code] for code in codes],
        "condition": [None if code == len(strata) - 1 else strata[code] for code in codes],
        "behaviour_policy": [
            ring.behaviour_policies[code] for code in columns["fresh_policy"].tolist()
        ],
        "behaviour_version": [str(version) for version in meta["policy_version"][slots].tolist()],
        "perturbation": perturbations.names(keys) if perturbations else None,
        "perturbation_values": perturbations.values(keys) if perturbations else None,
        **_learnt(columns, "fresh"),
    }


def _learnt(columns: Mapping[str, NDArray[Any]], side: str) -> Columns:
    names = ("reward", "discount", "weight", "q", "td")
    return {name: columns[f"{side}_{name}"] for name in names}


def _names(coded: Coded, rows: NDArray[np.int64]) -> list[str]:
    return [str(coded.names[code]) for code in coded.codes[rows].tolist()]
