"""`replay.ring_capacity = "auto"`: as many fresh rows as keep the diversity that the logs showed.

The panel's rows, the newest first, say how many a first-in-first-out buffer must hold to keep 95 %
of their condition x zone x action cells and 50 effective episodes
(`restock.replay.store.capacity`). The run's `config.json` keeps the number, why, and the curve.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import msgspec
import numpy as np

from restock.errors import ConfigError
from restock.replay.mixture.packed_row import row_width
from restock.replay.panel.panel import Panel
from restock.replay.ring.ring import META
from restock.replay.store.capacity import capacity_of_rows
from restock.train.dqn.config import TrainConfig

MAX_BYTES = 2 << 30  # of a ring that "auto" chooses
_SLOT_BYTES = 18  # of a row's stratum, its place there, and its age


def resolve_ring_capacity(
    config: TrainConfig, panel: Panel | None
) -> tuple[TrainConfig, dict[str, Any] | None]:
    """The config with a number of rows, and what `config.json` says of how it was chosen.

    Raises:
        ConfigError: it is to be chosen, and there is no panel to choose it by.
    """
    if config.replay.ring_capacity != "auto":
        return config, None
    if panel is None:
        raise ConfigError(
            'replay.ring_capacity = "auto" is chosen from the rows of a panel, but there is none',
            remedy="give --panel, or a number of rows",
        )
    capacity = capacity_of_rows(panel.meta)
    rows, reason = capacity.recommended, capacity.reason
    least = max(config.replay.batch_size, config.env.num_envs * config.loss.n_step)
    most = MAX_BYTES // row_bytes(panel.observation_size)
    if rows < least:
        rows, reason = least, f"{reason}; a batch and the environments' steps need {least:,}"
    if rows > most:
        rows, reason = most, f"{reason}; {MAX_BYTES >> 30} GiB hold {most:,}"
    replay = msgspec.structs.replace(config.replay, ring_capacity=rows)
    chosen = {"asked": "auto", "ring_rows": rows, "reason": reason, **asdict(capacity)}
    return msgspec.structs.replace(config, replay=replay), chosen


def row_bytes(observation_size: int) -> int:
    """What one row of a ring takes."""
    meta = sum(np.dtype(kind).itemsize for kind in META.values())
    return row_width(observation_size) * 4 + meta + _SLOT_BYTES


__all__ = ["resolve_ring_capacity"]
