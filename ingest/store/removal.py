"""Remove recordings, named by their ids or paths, from a store in one commit.

Their files and manifests are not deleted yet: as with replaced recordings, earlier versions need
them until the retention window is over.
"""

from __future__ import annotations

import os.path
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

from restock.errors import StoreError, quoted
from restock.ingest.store.writer import StoreWriter

OPERATION = "restock store remove"
PREFIX_DIGITS = 6  # least number of an id's first digits that can name a recording
_MAX_NAMED = 5


@dataclass(frozen=True)
class RemovedRecording:
    """A recording that was removed from a store, or would be."""

    recording_id: str
    source_file: str  # path that the recording was ingested from
    transitions: int
    episodes: int
    corrections: int  # number of label corrections by people; another ingest does not restore them
    tags: Mapping[str, str]


@dataclass(frozen=True)
class Removed:
    """Recordings that were removed from a store, or would be."""

    recordings: list[RemovedRecording] = field(default_factory=list)
    left: int = 0  # number of recordings that stay in the store
    version_before: int | None = None  # last version of the store with these recordings
    version: int | None = None  # version of the store without them; None if nothing was written


def remove_recordings(
    store: StoreWriter, names: Sequence[str], *, dry_run: bool = False
) -> Removed:
    """Remove recordings from a store, all or none of them.

    A name is a recording's id, at least PREFIX_DIGITS first digits of it, or the path that the
    recording was ingested from, or the last parts of that path.

    Raises:
        StoreError: a name fits no recording in the store, or several; a recording was ingested
            again meanwhile; the store cannot be written. Nothing is removed.
    """
    store.expect_store()
    live = sorted(store.live().to_pylist(maps_as_pydicts="strict"), key=_path_key)
    chosen = _choose(live, names, str(store.path))
    removed = [
        RemovedRecording(
            row["recording_id"],
            row["source_file"],
            row["transitions"],
            row["episodes"],
            len(row["corrections"] or ()),
            row["tags"] or {},
        )
        for row in chosen
    ]
    left = len(live) - len(chosen)
    if dry_run or not chosen:
        return Removed(removed, left)
    ingests = {row["recording_id"]: row["ingest_id"] for row in chosen}
    before, version = store.remove_recordings(ingests, OPERATION)
    return Removed(removed, left, before, version)


def _path_key(row: Mapping[str, Any]) -> tuple[str, str]:
    return row["source_file"], row["recording_id"]


def _choose(
    live: Sequence[dict[str, Any]], names: Iterable[str], where: str
) -> list[dict[str, Any]]:
    """Return the named manifest rows, or raise StoreError for ambiguous and unknown names."""
    chosen: dict[str, dict[str, Any]] = {}
    problems = []
    for name in dict.fromkeys(names):
        found = _find_named(live, name)
        if len(found) == 1:
            chosen[found[0]["recording_id"]] = found[0]
        else:
            problems.append(
                f"{name!r} is the name of {len(found)} recordings: {_listed(found)}"
                if found
                else f"no recording {name!r} is in the store"
            )
    if problems:
        raise StoreError(
            "\n    ".join(["nothing was removed:", *problems]),
            where=where,
            remedy="name each recording by its id (or at least its first"
            f" {PREFIX_DIGITS} digits) or its path; `restock sql {quoted(where)}"
            ' "SELECT recording_id, source_file FROM recordings"` lists them',
        )
    return sorted(chosen.values(), key=_path_key)


def _find_named(live: Sequence[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """Find the recordings that a name fits: by id or exact path, else by the path's end."""
    found = [
        row
        for row in live
        if (len(name) >= PREFIX_DIGITS and row["recording_id"].startswith(name.lower()))
        or _absolute(row["source_file"]) == _absolute(name)
    ]
    parts = PurePath(name).parts  # the name `b.mcap` fits `logs/b.mcap`
    ends = [(row, PurePath(row["source_file"]).parts[-len(parts) :]) for row in live if parts]
    return found or [row for row, end in ends if end == parts]


def _absolute(path: str) -> str:
    return os.path.normpath(Path(path).absolute())


def _listed(rows: Sequence[dict[str, Any]]) -> str:
    named = [f"{row['recording_id']} ({row['source_file']})" for row in rows[:_MAX_NAMED]]
    more = len(rows) - len(named)
    return ", ".join(named) + (f", and {more:,} more" if more else "")
