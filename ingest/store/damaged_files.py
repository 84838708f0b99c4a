"""Find damaged files of a store, repair or remove them, and report the recordings that are lost.

Every page of a store's Parquet files has a checksum, which DuckDB does not verify. So each file is
read whole once before its rows are used, and the store keeps a list of the files that passed. A
damaged joined file (see `restock store compact`) is joined again from its source files while they
are kept. If they are gone, the file is removed from its table, and the recordings whose rows or
manifests were in it are reported: no view shows them until they are ingested again. A readable file
is never removed. Other writers may continue meanwhile.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pyarrow as pa
import pyarrow.fs

from restock.errors import StoreError, counted, quoted
from restock.ingest.store.commits import READ_ROWS, merge
from restock.ingest.store.lineage import (
    OWN_PATH,
    StoredFile,
    StoreReader,
    active_files,
    damage_named,
    damage_remedy,
    frame_files,
    is_system_error,
    read_stored_file,
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

    joined_again: list[str] = field(default_factory=list)
    dropped: list[str] = field(default_factory=list)
    lost: list[LostRecording] = field(default_factory=list)
    unnamed_transitions: int = 0  # lost rows of recordings whose manifests are lost as well


def drop_damaged(store: StoreWriter, *, dry_run: bool = False) -> Dropped:
    """Repair or remove the damaged files of a store's tables. Every file is read whole.

    Raises:
        StoreError: there is no store, it cannot be reached or written, or a file cannot be read
            for a reason other than damage.
    """
    store.expect_store()
    done = Dropped()
    lost_rows = 0  # as counted in Delta's log
    readable: dict[str, list[StoredFile]] = {}
    for name in (TRANSITIONS, RECORDINGS):  # rows first: only manifests of remaining rows are kept
        table = store.path.open_table(name)
        rows = {path: count or 0 for path, count, *_ in active_files(table)}
        broken = _find_damaged(store.path, _in_table(name, rows))
        damaged = [path.removeprefix(f"{name}/") for path in broken]
        readable[name] = stored_files(store.path, name, table, without=damaged)
        for path in damaged:
            sources = _sources(store.path, name, path, rows[path], readable)
            if not dry_run and not _replace(store, name, path, sources):
                continue  # another process has replaced or removed the file
            if sources:
                done.joined_again.append(f"{name}/{path}")
                readable[name] += sources
            else:
                done.dropped.append(f"{name}/{path}")
                lost_rows += rows[path] if name == TRANSITIONS else 0
    done.lost = _find_lost(store.path, readable, done.dropped)
    if any(path.startswith(f"{RECORDINGS}/") for path in done.dropped):
        named = sum(one.transitions for one in done.lost if one.corrections is not None)
        done.unnamed_transitions = max(0, lost_rows - named)
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


def _sources(place: Location, name: str, path: str, rows: int, readable: Files) -> list[StoredFile]:
    """Return the files that a damaged file was joined from, each with only the ingests to restore.

    The list is empty if a source is gone or damaged, or if the sources lack rows of the file. It is
    also empty for a file that one ingest wrote: its commit removed only rows that it replaced.
    """
    if OWN_PATH.fullmatch(path):
        return []
    paths = _find_joined_files(place, name, path)
    if any(is_damaged(place, one) for one in _in_table(name, paths)):
        return []
    there = [one for file in readable[TRANSITIONS] for one in file.ingests]
    known = {one.recording_id for one in there}  # these have rows, maybe of a newer ingest
    reported = {one.ingest_id for file in readable.get(RECORDINGS, ()) for one in file.ingests}
    unlisted = {one.ingest_id for one in there} - reported
    found = []
    for file in (read_stored_file(place, name, one) for one in paths):
        kept = [
            one
            for one in file.ingests
            if (one.recording_id not in known if name == TRANSITIONS else one.ingest_id in unlisted)
        ]
        if kept:
            found.append(file._replace(rows=sum(one.rows for one in kept), ingests=tuple(kept)))
    complete = name == RECORDINGS or sum(file.rows for file in found) == rows
    return found if complete else []


def _find_joined_files(place: Location, name: str, path: str) -> list[str]:
    """Return the files that were removed by the commit that added this file, from Delta's log.

    The list is empty if the log no longer has that commit.
    """
    log = f"{name}/_delta_log"
    commits = [one for one in place.times(log) if one.endswith(".json")]
    for commit in sorted(commits, reverse=True):
        with place.reading(f"{log}/{commit}") as source:
            actions = [json.loads(line) for line in source.read().splitlines()]
        if any(unquote(one["add"]["path"]) == path for one in actions if "add" in one):
            return [unquote(one["remove"]["path"]) for one in actions if "remove" in one]
    return []


def _replace(store: StoreWriter, name: str, path: str, sources: Sequence[StoredFile]) -> bool:
    """Replace a damaged file by its sources' rows; return False if it is gone from the table."""
    made = []
    if sources:
        schema = pa.schema(store.path.open_table(name).schema().to_arrow())
        kept = [one for file in sources for one in file.ingests]
        made.append(merge(store.path, name, sources, kept, schema))
    replaced = store.replace_files(name, {path}, made, OPERATION) is not None
    if replaced and name == RECORDINGS and OWN_PATH.fullmatch(path):
        store.path.delete([f"{name}/{path}"])  # readers would still find it by its path
    return replaced


def _find_lost(place: Location, readable: Files, dropped: Sequence[str]) -> list[LostRecording]:
    """Return the recordings that have rows but no manifest, or a manifest but no rows.

    A manifest also has no rows while its writer is between two commits. Its recording may then be
    returned, too: ingesting it again does no harm.
    """
    manifests: dict[str, dict[str, Any]] = {}
    for file in readable[RECORDINGS] if dropped else ():
        rows = place.read(f"{RECORDINGS}/{file.path}", columns=_LOST_COLUMNS).to_pylist()
        held = {one.ingest_id for one in file.ingests}
        manifests |= {row["ingest_id"]: row for row in rows if row["ingest_id"] in held}
    lost: dict[str, LostRecording] = {}
    if any(path.startswith(f"{RECORDINGS}/") for path in dropped):
        for file in readable[TRANSITIONS]:
            if unlisted := [one for one in file.ingests if one.ingest_id not in manifests]:
                sources = _source_files(place, file)
                for one in unlisted:
                    lost[one.recording_id] = LostRecording(
                        one.recording_id, sources[one.ingest_id], one.rows, None
                    )
    if any(path.startswith(f"{TRANSITIONS}/") for path in dropped):
        there = {one.recording_id for file in readable[TRANSITIONS] for one in file.ingests}
        for row in sorted(manifests.values(), key=lambda row: row["ingested_at"]):
            if (recording := row["recording_id"]) not in there:
                corrections = len(row.get("corrections") or ())
                lost[recording] = LostRecording(
                    recording, row["source_file"], row["transitions"], corrections
                )
    return sorted(lost.values(), key=lambda one: (one.source_file, one.recording_id))


def _source_files(place: Location, file: StoredFile) -> dict[str, str]:
    """Return the `source_file` of each ingest in a file of rows, by ingest id."""
    names = ["ingest_id", "source_file"]
    rows = place.read(f"{TRANSITIONS}/{file.path}", columns=names)
    return dict(zip(*(rows[name].to_pylist() for name in names), strict=True))


def _in_table(name: str, paths: Sequence[str] | Mapping[str, object]) -> list[str]:
    return [f"{name}/{path}" for path in paths]
