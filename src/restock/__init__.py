"""Restock: robot logs to coverage-labelled transitions, replay mixtures, and a DQN in a twin.

Importing `restock` is cheap; `torch`, `mujoco` and `duckdb` load with the room that needs them.
The Gymnasium environment `restock/Warehouse-v0` is registered here, by name only.
"""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import gymnasium

try:
    __version__ = version("restock")
except PackageNotFoundError:  # running from a source tree that was never installed
    __version__ = "0.0.0+unknown"

if TYPE_CHECKING:
    from restock.replay.store.store import Store

__all__ = ["__version__", "open"]

gymnasium.register(
    id="restock/Warehouse-v0",
    entry_point="restock.train.twin.env.single_env:WarehouseEnv",
    vector_entry_point="restock.train.twin.env.vector_env:WarehouseVectorEnv",
)


def open(store: str) -> Store:
    """Open a store of transitions for reading: `restock.open("store").sql("FROM coverage")`."""
    from restock.replay.store.store import Store

    return Store(store)


def __getattr__(name: str) -> Any:
    raise AttributeError(f"module 'restock' has no attribute {name!r}")
