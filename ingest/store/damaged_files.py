"""Find damaged files of a store, replace or remove them, and report the recordings that are lost.

Every page of a store's Parquet files has a checksum, which DuckDB does not verify. So each file is
read whole once before its rows are used, and the store keeps a list of the files that passed. A
damaged file is removed from its table. If it was a joined file (see `restock store compact`), the
recordings' own files that it replaced are used again while they are kept. The other recordings
whose rows or manifests were in it are reported: no view shows them until they are ingested again. A
readable file is never removed. Other writers may continue meanwhile.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.fs

from restock.errors import StoreError, counted, quoted
from restock.ingest.store.commits import READ_ROWS, AddedFile
from restock.ingest.store.lineage import (
    OWN_PATH,
    StoredFile,
    StoreReader,
    active_files,
    damage_named,
    damage_remedy,
    frame_files,
    is_system_error,
    own_path,
    stored_files,
)
from restock.ingest.store.location import FRAMES, RECORDINGS, TRANSITIONS, Location, open_parquet
from restock.ingest.store.writer import StoreWriter

OPERATION = "restock store compact --drop-damaged"
READ_AT_ONCE = 4  # files that are read in parallel; each has one row group in memory
VERIFIED = "verified.json"  # in a store: path of an undamaged file -> [bytes, write time in ns]
Files = Mapping[str, list[StoredFile]]  # table name -> its readable files
_LOST_COLUMNS = (
    *("recording_id", "ingest_id", "ingested_at"),
    *("source_file", "transitions", "corrections"),
)


@dataclass(frozen=True)
class LostRecording:
    """A recording that views no longer show because its rows or its manifest were lost."""

    recording_id: str
    source_file: str
    transitions: int
    corrections: int | None  # number of label corrections by people; None if the manifest is lost


@dataclass(frozen=True)
class DamagedFile:
    """A file of a store that is damaged or missing, and what to do about it."""

    file: str
    remedy: str


@dataclass(frozen=True)
class Verified:
    """Result of reading all files of a store: their number, and the damaged ones."""

    files: int
    damaged: list[DamagedFile]


@dataclass
class Dropped:
    """What was done with damaged files, or would be. Paths of files are relative to the store."""

    dropped: list[str] = field(default_factory=list)
    restored: list[str] = field(default_factory=list)  # recordings' own files that are used again
    lost: list[LostRecording] = field(default_factory=list)
    unnamed_transitions: int = 0  # lost rows of recordings whose manifests are lost as well


def drop_damaged(store: StoreWriter, *, dry_run: bool = False) -> Dropped:
    """Replace or remove the damaged files of a store's tables. Every file is read whole.

    Raises:
        StoreError: there is no store, it cannot be reached or written, or a file cannot be read
            for a reason other than damage.
    """
    store.expect_store()
    damaged: dict[str, dict[str, int]] = {}  # table -> path -> rows, as counted in Delta's log
    readable: dict[str, list[StoredFile]] = {}
    for name in (TRANSITIONS, RECORDINGS):
        table = store.path.open_table(name)
        rows = {path: count or 0 for path, count, *_ in active_files(table)}
        broken = _find_damaged(store.path, [f"{name}/{path}" for path in rows])
        damaged[name] = {path: rows[path] for path in rows if f"{name}/{path}" in broken}
        readable[name] = stored_files(store.path, name, table, without=damaged[name])
    done = Dropped()
    lost = _find_lost(store.path, readable, damaged)
    for name, paths in damaged.items():
        missing = [own_path(*ids) for ids in lost[name]]
        made = [file for path in missing if (file := _own_file(store.path, name, path))]
        if not paths or (
            not dry_run and store.replace_files(name, paths.keys(), made, OPERATION) is None
        ):
            continue  # no file is damaged, or another process has replaced or removed one
        if not dry_run and name == RECORDINGS:  # readers would still find these by their paths
            store.path.delete(f"{name}/{path}" for path in paths if OWN_PATH.fullmatch(path))
        done.dropped += [f"{name}/{path}" for path in paths]
        done.restored += [f"{name}/{file.path}" for file in made]
        restored = {file.path for file in made}
        done.lost += [one for ids, one in lost[name].items() if own_path(*ids) not in restored]
    if any(path.startswith(f"{RECORDINGS}/") for path in done.dropped):
        named = sum(one.transitions for one in lost[TRANSITIONS].values())
        done.unnamed_transitions = max(0, sum(damaged[TRANSITIONS].values()) - named)
    done.lost.sort(key=lambda one: (one.source_file, one.recording_id))
    return done


def verify_store(path: str | Path | Location) -> Verified:
    """Read every file of a store whole: rows, manifests, and the frames that manifests name.

    Raises:
        StoreError: there is no store, it cannot be reached, or a file cannot be read for a reason
            other than damage.
    """
    store = StoreReader(path)
    store.path.expect_newest()
    store.path.expect_both_tables()
    paths = [
        f"{name}/{file}"
        for name in (TRANSITIONS, RECORDINGS)
        for file, *_ in active_files(store.path.open_table(name))
    ]
    damaged = verify_files(store.path, paths, again=True)
    if not any(path.startswith(f"{RECORDINGS}/") for path in damaged):
        frames = [f"{FRAMES}/{path}" for path in frame_files(store.live())]
        damaged += verify_files(store.path, frames, again=True)
        paths += frames
    reported = [DamagedFile(path, damage_remedy(store.path, path)) for path in damaged]
    return Verified(len(paths), reported)


def verify_files(place: Location, paths: Iterable[str], *, again: bool = False) -> list[str]:
    """Read files of a store whole and return the damaged ones; paths are relative to the store.

    Files that passed earlier and still have the same size and write time are skipped, unless
    `again`.

    Raises:
        StoreError: a file cannot be read for a reason other than damage.
    """
    stamps = _stamps(place)
    known = _read_verified(place, stamps)
    unread = [path for path in paths if again or path not in known]
    damaged = _find_damaged(place, unread)
    if unread:
        for path in unread:
            known.pop(path, None)
        known |= {path: stamps[path] for path in unread if path in stamps and path not in damaged}
        with suppress(OSError, StoreError), place.writing(VERIFIED) as out:  # fails if read-only
            out.write(json.dumps(known).encode())
    return damaged


def unverified_files(place: Location, paths: Iterable[str]) -> int:
    """Count the files among these that `verify_files` would read."""
    known = _read_verified(place, _stamps(place))
    return sum(path not in known for path in paths)


def damaged_error(place: Location, damaged: Sequence[str]) -> StoreError:
    """Return the error for files that `verify_files` found damaged, with what to do."""
    more = ""
    if len(damaged) > 1:
        count = counted(len(damaged) - 1, "more file")
        more = f"; `restock store verify {quoted(place)}` lists {count}"
    why = "cannot be read: it is truncated, or a page does not match its checksum"
    if damaged[0] not in _stamps(place):
        why = "is missing"
    return StoreError(
        f"its file {damaged[0]} {why}",
        where=str(place),
        remedy=damage_remedy(place, damaged[0]) + more,
    )


def _stamps(place: Location) -> dict[str, list[int]]:
    """Return the size (bytes) and write time (ns) of each Parquet file in a store, by path."""
    with place.translate_errors():
        infos = place.files.get_file_info(pa.fs.FileSelector("", recursive=True))
    return {
        one.path: [one.size, one.mtime_ns or 0] for one in infos if one.path.endswith(".parquet")
    }


def _read_verified(place: Location, stamps: Mapping[str, list[int]]) -> dict[str, list[int]]:
    """Return the stamps of files that passed an earlier check and have not changed since."""
    try:
        with place.reading(VERIFIED) as source:
            reported = json.loads(source.read())
    except (OSError, ValueError, StoreError):
        return {}
    reported = reported if isinstance(reported, dict) else {}
    return {path: stamp for path, stamp in stamps.items() if reported.get(path) == stamp}


def _find_damaged(place: Location, paths: Sequence[str]) -> list[str]:
    with ThreadPoolExecutor(READ_AT_ONCE) as pool:
        broken = pool.map(lambda path: is_damaged(place, path), paths)
        return [path for path, one in zip(paths, broken, strict=True) if one]


def is_damaged(place: Location, path: str) -> bool:
    """Return whether a file is missing, is not a complete Parquet file, or fails its checksums.

    Raises:
        StoreError: it cannot be read for another reason: permissions, the disk, the network.
    """
    with damage_named(place, path):
        try:
            with place.reading(path) as source:
                file = open_parquet(source)
                # A damaged page header may claim 0 values: reading ends early without an error.
                read = sum(batch.num_rows for batch in file.iter_batches(READ_ROWS))
                return bool(read != file.metadata.num_rows)
        except (FileNotFoundError, pa.ArrowInvalid):
            return True
        except OSError as error:
            if is_system_error(error):
                raise
            return True


def _own_file(place: Location, name: str, path: str) -> AddedFile | None:
    """Return the file that an ingest wrote, to be added to its table again; None if it is gone."""
    if is_damaged(place, f"{name}/{path}"):
        return None
    with place.reading(f"{name}/{path}") as source:
        rows = open_parquet(source).metadata.num_rows
        return AddedFile(path.partition("/")[0], path, rows, source.size())


def _find_lost(
    place: Location, readable: Files, damaged: Mapping[str, Collection[str]]
) -> dict[str, dict[tuple[str, str], LostRecording]]:
    """Return, per damaged table, the recordings that only the other table has, by their ids.

    A manifest also has no rows while its writer is between two commits. Its recording may then be
    returned, too: ingesting it again does no harm.
    """
    manifests: dict[str, dict[str, Any]] = {}
    for file in readable[RECORDINGS] if any(damaged.values()) else ():
        rows = place.read(f"{RECORDINGS}/{file.path}", columns=_LOST_COLUMNS).to_pylist()
        held = {one.ingest_id for one in file.ingests}
        manifests |= {row["ingest_id"]: row for row in rows if row["ingest_id"] in held}
    without_manifest: dict[tuple[str, str], LostRecording] = {}
    for file in readable[TRANSITIONS] if damaged[RECORDINGS] else ():
        if unlisted := [one for one in file.ingests if one.ingest_id not in manifests]:
            sources = _source_files(place, file)
            for one in unlisted:
                without_manifest[one.recording_id, one.ingest_id] = LostRecording(
                    one.recording_id, sources[one.ingest_id], one.rows, None
                )
    there = {one.recording_id for file in readable[TRANSITIONS] for one in file.ingests}
    newest = {
        row["recording_id"]: row
        for row in sorted(manifests.values(), key=lambda row: row["ingested_at"])
        if row["recording_id"] not in there
    }
    without_rows = {
        (recording, row["ingest_id"]): LostRecording(
            recording, row["source_file"], row["transitions"], len(row.get("corrections") or ())
        )
        for recording, row in newest.items()
        if damaged[TRANSITIONS]
    }
    return {TRANSITIONS: without_rows, RECORDINGS: without_manifest}


def _source_files(place: Location, file: StoredFile) -> dict[str, str]:
    """Return the `source_file` of each ingest in a file of rows, by ingest id."""
    names = ["ingest_id", "source_file"]
    rows = place.read(f"{TRANSITIONS}/{file.path}", columns=names)
    return dict(zip(*(rows[name].to_pylist() for name in names), strict=True))
