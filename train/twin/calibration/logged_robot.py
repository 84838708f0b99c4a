"""The robot whose logs a store holds: the `[robot]` of the profile that they were ingested with."""

from __future__ import annotations

from restock.errors import ConfigError
from restock.ingest.profile.profile_text import read_profile_toml
from restock.ingest.task.robot import Robot
from restock.replay.store.store import Store, profiles_of


def robot_of_store(store: Store, task_hash: str) -> Robot | None:
    """The robot of the newest profile that read the rows of a task; None where it has none, or
    where an older Restock kept no profile."""
    for stored in profiles_of(store.connection, task_hash):
        if not stored.toml:
            continue
        try:
            profile = read_profile_toml(stored.toml, where=str(store.path))
        except ConfigError:  # of another version: as if it were not there
            continue
        return profile.robot
    return None
