"""Robot logs to coverage-labelled transitions, replay mixtures, and a DQN in a twin.

The packages `restock.ingest`, `restock.replay`, `restock.train` and `restock.twin` contain the
public names; docs/reference.md lists them. `restock.report` writes the pages about a run. Importing
a package is cheap: `torch`, `mujoco` and `duckdb` are imported when they are first needed.
The Gymnasium environment `restock/Warehouse-v0` is registered by name when Gymnasium is imported,
before or after this module.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from restock.errors import RestockError
from restock.process import when_imported

if TYPE_CHECKING:
    from pathlib import Path
    from types import ModuleType

    from restock import ingest as ingest
    from restock import replay as replay
    from restock import report as report
    from restock import train as train
    from restock import twin as twin
    from restock.replay.places import Place
    from restock.replay.store.store import Store

    __version__: str

__all__ = ["RestockError", "__version__", "open"]


def _register() -> None:
    import gymnasium

    gymnasium.register(
        id="restock/Warehouse-v0",
        entry_point="restock.train.twin.env.vector_env:WarehouseEnv",
        vector_entry_point="restock.train.twin.env.vector_env:WarehouseVectorEnv",
    )


when_imported("gymnasium", _register)


def open(path: str | Path, *, version: int | str | None = None) -> Store | Place:
    """Open a store, a run, a panel or recordings: `restock.open("store").sql("FROM coverage")`.

    The result has `.sql(query)`, `.coverage()` and `.show()`. Recordings are a file, a folder or a
    glob. `version` selects a version of a store, by its number or an ISO 8601 time. The path
    `"store@12"` selects version 12, too.
    """
    from glob import has_magic

    from restock.ingest.store.location import Location
    from restock.ingest.store.version import parse_version
    from restock.replay.places import Place, add_computed_tables
    from restock.replay.store.store import Store, is_store

    place = Location.of(path)
    other = place.folder is not None and (place.folder.exists() or has_magic(str(path)))
    if version is None and place.version is None and other and not is_store(place):
        return Place(path)
    moment = parse_version(version) if isinstance(version, str) else version
    opened = Store(path, version=moment)
    add_computed_tables(opened)
    return opened


if not TYPE_CHECKING:

    def __getattr__(name: str) -> ModuleType | str:
        if name == "__version__":  # read on demand, because package metadata are slow to read
            globals()[name] = _version()
            return globals()[name]
        # `import restock` is enough to write `restock.twin.EpisodeSpec`.
        if name in ("ingest", "replay", "report", "train", "twin"):
            return importlib.import_module(f"restock.{name}")
        raise AttributeError(f"module 'restock' has no attribute {name!r}")


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("restock")
    except PackageNotFoundError:  # running from a source tree that was never installed
        return "0.0.0+unknown"
