"""Compute the summary and the sketch of a recording's rows, which its manifest stores.

The summary answers common queries without a scan of rows. It has the episodes, the rows and
episodes of each coverage cell, the values per episode that drift compares, the flawed rows, and the
ends of episodes. Every writer of rows also writes their summary, so the two always agree.

The sketch shows whether a recording, a part or a copy of it is already in the store under another
id. Ids are computed from a file's bytes, so a salvaged part, another cut, or a drive that was
replayed and recorded again has another id. A sketch is the smallest hashes of a recording's rows
(bottom-k, Broder 1997). An ingest then compares the hashes of all distinctive rows, which manifests
store, of recordings with a similar sketch. The audit `repeated_steps` finds repeated drives in SQL.
"""

from __future__ import annotations

import atexit
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import Bools, Ints
from restock.errors import StoreError
from restock.ingest.task.schema import splitmix64

if TYPE_CHECKING:  # slow to import, and not needed if all recordings are in the store already
    import duckdb

ENDS = b"restock.episode_ends"  # key in the rows' metadata
# Rows of whole episodes that are queried together: bounds memory. Each part costs 40 ms to plan.
STRETCH_ROWS = 8192
# Table whose rows each depend on one episode (its .sql file has the same name) -> sort order.
BY_EPISODE = {
    "measured_signals": "episode_id, signal",
    "flawed_rows": "transition_id",
    "zone_steps": "ALL",
    "condition_steps": "ALL",
}
WIDE = ("observation", "next_observation")  # columns that only the queries of BY_EPISODE read


def _rows_of(**columns: pa.DataType) -> pa.DataType:
    return pa.list_(pa.struct([pa.field(name, kind) for name, kind in columns.items()]))


_TEXT, _TEXTS, _COUNT, _NUMBER = pa.string(), pa.list_(pa.string()), pa.int64(), pa.float64()
TABLES = {  # column of a manifest that holds a table of its recording -> Arrow type of the column
    "episode_rows": _rows_of(
        episode_id=_TEXT,
        episode_index=pa.int32(),
        start_ns=_COUNT,
        end_ns=_COUNT,
        steps=_COUNT,
        missing_steps=_COUNT,
        **{"return": _NUMBER},
        ended=_TEXT,
        ended_by=_TEXT,
        goal_source=_TEXT,
        success=pa.bool_(),
        progress_m=_NUMBER,
        bumped_steps=_COUNT,
        clearance_min_m=pa.float32(),
        conditions=_TEXTS,
        behaviour_policies=_TEXTS,
        first_policy=_TEXT,
        handovers=_COUNT,
        zones=_TEXTS,
    ),
    "cells": _rows_of(
        condition=_TEXT,
        action=pa.int16(),
        zone=_TEXT,
        behaviour_policy=_TEXT,
        rows_held=_COUNT,
        primary_rows=_COUNT,
        rewards=_COUNT,
        reward_sum=_NUMBER,
        known_ends=_COUNT,
        terminated=_COUNT,
        episodes_held=_COUNT,
        successes=_COUNT,
        goal_episodes=_COUNT,
    ),
    "condition_episodes": _rows_of(
        condition=_TEXT,
        episodes_held=_COUNT,
        rows_held=_COUNT,
        squared_rows=_COUNT,
        successes=_COUNT,
        goal_episodes=_COUNT,
        returns=_COUNT,
        return_sum=_NUMBER,
        primary_rows=_COUNT,
        primary_episodes=_COUNT,
    ),
    "measured_signals": _rows_of(episode_id=_TEXT, signal=_TEXT, value=_NUMBER, steps=_COUNT),
    "flawed_rows": _rows_of(
        transition_id=_COUNT,
        episode_id=_TEXT,
        step_index=pa.int32(),
        is_null=pa.bool_(),
        is_not_finite=pa.bool_(),
    ),
    "zone_steps": _rows_of(episode_id=_TEXT, zone=_TEXT, start_ns=_COUNT, steps=_COUNT),
    "condition_steps": _rows_of(
        episode_id=_TEXT, zone=_TEXT, condition=_TEXT, steps=_COUNT, events=_COUNT
    ),
    "distinctive_rows": _rows_of(transition_id=_COUNT, content=_COUNT),
}
# The summary's columns of `recordings`, besides those of `recording_schema`.
SUMMARY_SCHEMA = pa.schema(
    [
        pa.field("sketch", _TEXT),
        pa.field("packed_ends", _TEXT),
        *(pa.field(name, kind) for name, kind in TABLES.items()),
    ]
)


def summarised(manifest: pa.Table, rows: pa.Table) -> pa.Table:
    """Return a manifest row with the summary and the number of its recording's rows."""
    (found,) = summarise([(manifest, rows)])
    return found


def summarise(recordings: Sequence[tuple[pa.Table, pa.Table]]) -> list[pa.Table]:
    """Summarise several recordings, given as (manifest row, rows), like `summarised` does one.

    Recordings with the same columns are queried together: planning the queries takes longer than
    running them on some hundred rows.
    """
    counted: list[pa.Table] = []
    alike: dict[str, list[int]] = {}
    for place, (manifest, rows) in enumerate(recordings):
        at = manifest.schema.get_field_index("transitions")
        count = pa.array([len(rows)], manifest.schema.field(at).type)
        counted.append(manifest.set_column(at, manifest.schema.field(at), count))
        alike.setdefault(rows.schema.to_string(show_schema_metadata=False), []).append(place)
    for places in alike.values():
        tables = _tables([(counted[place], recordings[place][1]) for place in places])
        of = {n: np.asarray(rows["recording_id"], object) for n, rows in tables.items()}
        for place in places:
            mine = str(counted[place]["recording_id"][0])
            some = {n: rows.filter(pa.array(of[n] == mine)) for n, rows in tables.items()}
            counted[place] = _with_summary(counted[place], recordings[place][1], some)
    return counted


def _tables(recordings: Sequence[tuple[pa.Table, pa.Table]]) -> dict[str, pa.Table]:
    """Compute the tables of summary.sql and BY_EPISODE for recordings with the same columns."""
    manifests, rows = (pa.concat_tables(several) for several in zip(*recordings, strict=True))
    with _database().cursor() as connection:  # each cursor has its own temporary tables
        connection.register("recordings", manifests)
        rows = rows.rename_columns({"condition": "primary_condition"})  # as rows.sql does
        custom = any(manifests["signals"].to_pylist())  # whether a profile has its own signals
        tables = _of_episodes(connection, rows, custom=custom)
        connection.register("transitions", rows.drop_columns(list(WIDE)))
        connection.execute(_query("summary"))
        left = TABLES.keys() - tables.keys() - {"distinctive_rows"}
        return tables | {n: connection.table(n).to_arrow_table() for n in left}


def _with_summary(manifest: pa.Table, rows: pa.Table, tables: dict[str, pa.Table]) -> pa.Table:
    hashes, at = distinctive(rows)
    values: dict[str, Any] = {
        "sketch": sketch(hashes),
        "packed_ends": ((rows.schema.metadata or {}).get(ENDS) or b"").decode() or None,
    }
    in_order = np.argsort(at)
    tables["distinctive_rows"] = pa.table(
        {
            "transition_id": rows["transition_id"].take(pa.array(at[in_order])),
            "content": hashes[in_order].view(np.int64),
        }
    )
    for field in SUMMARY_SCHEMA:
        column = (
            _listed(tables[field.name], field.type)
            if field.name in tables
            else pa.array([values[field.name]], field.type)
        )
        manifest = manifest.append_column(field, column)
    return manifest


def _of_episodes(
    connection: duckdb.DuckDBPyConnection, rows: pa.Table, *, custom: bool
) -> dict[str, pa.Table]:
    """Compute the tables in BY_EPISODE, some whole episodes at a time.

    Each row depends only on the steps of one episode, and a window function over all steps would
    need twice their memory.
    """
    for number, (first, stop) in enumerate(_whole_episodes(rows)):
        connection.register("transitions", _unchunked(rows.slice(first, stop - first)))
        for name in BY_EPISODE:
            into = f"INSERT INTO {name}" if number else f"CREATE TEMP TABLE {name} AS"
            connection.execute(f"{into}\n{_query(name)}")
        if custom:
            added = _query("measured_custom_signals")
            connection.execute(f"INSERT INTO measured_signals\n{added}")
        connection.unregister("transitions")  # frees its copies before the next part is copied
    return {
        name: connection.sql(f"FROM {name} ORDER BY {order}").to_arrow_table()
        for name, order in BY_EPISODE.items()
    }


def _whole_episodes(rows: pa.Table) -> Iterator[tuple[int, int]]:
    """Cut the rows into parts of about STRETCH_ROWS; return (first row, one past the last) of each.

    No episode is in two parts. If the rows of an episode are not contiguous, all rows are one part.
    """
    coded = rows["episode_id"].combine_chunks().dictionary_encode()
    codes = coded.indices.fill_null(-1).to_numpy(zero_copy_only=False)
    begins = np.flatnonzero(np.diff(codes)) + 1
    cuts = begins[np.flatnonzero(np.diff(begins // STRETCH_ROWS, prepend=0))].tolist()
    together = len(begins) < len(np.unique(codes))
    return pairwise([0, *(cuts if together else []), len(rows)])


def _unchunked(rows: pa.Table) -> pa.Table:
    """Join the chunks of WIDE columns, one per episode: DuckDB reads each chunk as a batch."""
    for name in WIDE:
        place = rows.schema.get_field_index(name)
        rows = rows.set_column(place, name, rows[name].combine_chunks())
    return rows


def with_ends(rows: pa.Table, packed_ends: str | None) -> pa.Table:
    """Put the packed episode ends, which come from the rows' manifest, into the rows' metadata."""
    metadata = {ENDS: packed_ends.encode()} if packed_ends else None
    return rows.replace_schema_metadata(metadata)


@cache
def _database() -> duckdb.DuckDBPyConnection:
    """Return one connection for all recordings: opening one takes as long as a summary."""
    import duckdb

    atexit.register(_database.cache_clear)  # nanobind warns of objects that outlive their module
    return duckdb.connect(config={"threads": 1})


@cache
def _query(name: str) -> str:
    return with_included(f"-- include: {name}.sql")


def with_included(text: str, beside: Traversable | None = None) -> str:
    """Replace each `-- include: FILE.sql` in SQL by that file, which several statements share.

    Files are looked up in this folder, then in the folder `beside`.
    """

    def included(named: re.Match[str]) -> str:
        folder = files("restock.ingest.store")
        if beside is not None and not (folder / named[1]).is_file():
            folder = beside
        return with_included((folder / named[1]).read_text(encoding="utf-8"), beside)

    return re.sub(r"-- include: (\w+\.sql)", included, text)


def _listed(rows: pa.Table, kind: pa.DataType) -> pa.Array:
    """Return all rows of a table as a list column with a single value."""
    fields = list(kind.value_type)
    columns = [rows[field.name].cast(field.type).combine_chunks() for field in fields]
    values = pa.StructArray.from_arrays(columns, fields=fields)
    return pa.ListArray.from_arrays(pa.array([0, len(rows)], pa.int32()), values).cast(kind)


SKETCH_HASHES = 256
MIN_HASHES = 3  # least number of hashes that two recordings of the same drive share
LARGELY = 0.5  # and least part of the smaller recording's distinctive rows that is in both
NEARLY_ALL = 0.95  # less than 1: near its cut, a part has rows that the whole does not have
# Errors if another recording was replaced meanwhile or is damaged: the ingest ignores them.
UNREADABLE = (OSError, StoreError, pa.ArrowException)
PART_ROWS = 2048  # rows hashed at a time: bounds memory
_LARGE = 2e15  # stands for infinity, and limits scaled values
Hashes = NDArray[np.uint64]


@dataclass(frozen=True)
class RepeatedDrive:
    """A stored recording that has rows of the new recording."""

    recording_id: str
    source_file: str
    rows: int  # number of rows that both have
    share: float  # `rows` as a share of the new recording's rows
    share_of_other: float  # `rows` as a share of the stored recording's rows
    held: float  # `rows` as a share of the stored recording's distinctive rows

    @property
    def is_part(self) -> bool:
        """Return whether the new recording has (nearly) all that the stored one has, and more."""
        return self.has_less and self.held >= NEARLY_ALL

    @property
    def has_less(self) -> bool:
        """Return whether the stored recording has less of the drive than the new one."""
        return self.share_of_other > self.share

    def __str__(self) -> str:
        whole = min(self.share, self.share_of_other) >= NEARLY_ALL
        return (
            f"{self.rows:,} transitions ({self.share:.0%}) are also in {self.source_file} "
            f"(recording {self.recording_id}, {self.share_of_other:.0%} of it), with other ids: "
            f"{'the same drive' if whole else 'a part of the same drive'} twice"
        )


def sketch(hashes: Hashes) -> str:
    """Encode the sketch of a recording's `distinctive` hashes for its manifest."""
    return hashes[:SKETCH_HASHES].astype("<u8").tobytes().hex()


def read_sketch(text: str) -> Hashes:
    """Decode a manifest's sketch; "" gives no hashes, as in manifests that other tools wrote."""
    return np.frombuffer(bytes.fromhex(text), "<u8")


def row_hashes(rows: pa.Table) -> Hashes:
    """Hash each row's task, action, observation and pose (rounded to thousandths), (N,)."""
    parts = [_hashes(rows.slice(first, PART_ROWS)) for first in range(0, len(rows), PART_ROWS)]
    return np.concatenate([np.zeros(0, np.uint64), *parts])


def _hashes(rows: pa.Table) -> Hashes:
    count = len(rows)
    observation = rows["observation"].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    pose = [rows[name].to_numpy()[:, None] for name in ("pose_x_m", "pose_y_m")]
    numbers = np.concatenate([observation.reshape(count, -1), *pose], axis=1, dtype=np.float64)
    numbers = np.nan_to_num(numbers * 1000, posinf=_LARGE, neginf=-_LARGE).clip(-_LARGE, _LARGE)
    whole = np.concatenate(
        [np.rint(numbers).astype(np.int64), rows["action"].to_numpy()[:, None]], axis=1
    ).view(np.uint64)
    factors = splitmix64(np.arange(1, whole.shape[1] + 1, dtype=np.uint64)) | np.uint64(1)
    total = (whole * factors).sum(axis=1, dtype=np.uint64)
    tasks = rows["task_hash"].combine_chunks().dictionary_encode()
    seeds = [hashlib.blake2b(str(t).encode(), digest_size=8).digest() for t in tasks.dictionary]
    total ^= np.frombuffer(b"".join(seeds), "<u8")[tasks.indices.to_numpy()]
    return splitmix64(total)  # mixed, so that the smallest are a random sample of the rows


def sharing(mine: Hashes, sketches: Mapping[str, Hashes]) -> set[str]:
    """Return the names of sketches that share at least MIN_HASHES with `mine`, (N,) ascending."""
    if not len(mine):
        return set()
    hashes = np.concatenate([mine[:0], *sketches.values()])
    marked = np.zeros(1 << 16, np.bool_)  # by low 16 bits: quickly excludes most hashes
    marked[mine.astype(np.uint16)] = True
    at = np.flatnonzero(marked[hashes.astype(np.uint16)])
    at = at[mine[np.minimum(np.searchsorted(mine, hashes[at]), len(mine) - 1)] == hashes[at]]
    ends = np.cumsum([len(one) for one in sketches.values()])
    shared = np.bincount(np.searchsorted(ends, at, "right"), minlength=len(sketches))
    return {name for name, count in zip(sketches, shared, strict=True) if count >= MIN_HASHES}


def compare(mine: Hashes, rows: int, other: pa.Table) -> RepeatedDrive | None:
    """Return what a recording shares with the one of the manifest row `other`.

    `mine` are the ascending hashes of its distinctive rows, and `rows` is the number of all. None
    if it is not enough.
    """
    theirs = contents_of(other)
    same = len(np.intersect1d(mine, theirs, assume_unique=True))
    if same < MIN_HASHES or same < LARGELY * min(len(mine), len(theirs)):
        return None
    return RepeatedDrive(
        str(other["recording_id"][0]),
        str(other["source_file"][0]),
        same,
        same / rows,
        same / other["transitions"][0].as_py(),
        same / len(theirs),
    )


def contents_of(manifest: pa.Table) -> Hashes:
    """Return the hashes of a recording's distinctive rows, ascending, from its manifest row."""
    contents = manifest["distinctive_rows"].combine_chunks().flatten().field("content")
    ascending: Hashes = np.sort(contents.to_numpy().view(np.uint64))
    return ascending


def distinctive(rows: pa.Table) -> tuple[Hashes, Ints]:
    """Return the hashes that occur only once in a recording, ascending, and their rows' indices.

    Repeated hashes are left out because the rows of a robot that stands prove nothing.
    """
    found, first, counts = np.unique(row_hashes(rows), return_index=True, return_counts=True)
    once: Bools = counts == 1
    return found[once], first[once].astype(np.int64)
