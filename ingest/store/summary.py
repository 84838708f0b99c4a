"""What is kept of a recording in its manifest: a summary of its rows, and a sketch of them.

The summary answers common questions without a scan of rows: episodes, how many rows and episodes
each cell of coverage has, what drift compares, the rows that are flawed, one number per signal, and
the ends of episodes. Every writer of rows writes it, so it is true for as long as the rows are
there.

The sketch tells whether a recording is already in the store under another id: a part of it, or a
copy. Ids come from bytes, so a salvaged part, another cut or a drive that was replayed and recorded
again has another one. A sketch is the smallest hashes of a recording's rows (bottom-k, Broder
1997): an ingest reads only the rows of those recordings that look alike. The audit `repeated_steps`
finds the same in SQL, of all rows.
"""

from __future__ import annotations

import atexit
import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
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

if TYPE_CHECKING:  # slow to import, and not for what is in the store already
    import duckdb

ENDS = b"restock.episode_ends"  # key in the rows' metadata
# Of whole episodes that are looked at together: bounds memory. Each time costs 40 ms of planning.
STRETCH_ROWS = 8192
# Tables whose rows are made of one episode's each, by queries of their names, and their order.
BY_EPISODE = {
    "measured_signals": "episode_id, signal",
    "flawed_rows": "transition_id",
    "zone_steps": "ALL",
    "condition_steps": "ALL",
}
WIDE = ("observation", "next_observation")  # columns that only those look at


def _rows_of(**columns: pa.DataType) -> pa.DataType:
    return pa.list_(pa.struct([pa.field(name, kind) for name, kind in columns.items()]))


_TEXT, _TEXTS, _COUNT, _NUMBER = pa.string(), pa.list_(pa.string()), pa.int64(), pa.float64()
TABLES = {  # of summary.sql, and `distinctive_rows`; each a column
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
# Beside the columns of `recording_schema`.
SUMMARY_SCHEMA = pa.schema(
    [
        pa.field("sketch", _TEXT),
        pa.field("packed_ends", _TEXT),
        *(pa.field(name, kind) for name, kind in TABLES.items()),
    ]
)


def summarised(manifest: pa.Table, rows: pa.Table) -> pa.Table:
    """Return a manifest row with the summary of its recording's rows, and their number."""
    (found,) = summarise([(manifest, rows)])
    return found


def summarise(recordings: Sequence[tuple[pa.Table, pa.Table]]) -> list[pa.Table]:
    """Return what `summarised` does of each recording, those with the same columns in one go.

    They are several recordings: planning the queries takes longer than some hundred rows do.
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
    """Return the tables of summary.sql and BY_EPISODE, of recordings with the same columns."""
    manifests, rows = (pa.concat_tables(several) for several in zip(*recordings, strict=True))
    with _database().cursor() as connection:  # with temporary tables of its own
        connection.register("recordings", manifests)
        rows = rows.rename_columns({"condition": "primary_condition"})  # as rows.sql
        custom = any(manifests["signals"].to_pylist())  # whether the profile has its own
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
    """Make the tables BY_EPISODE, some whole episodes at a time.

    An episode's rows of them depend on its own steps alone. A window over all steps would hold them
    all twice.
    """
    for number, (first, stop) in enumerate(_whole_episodes(rows)):
        connection.register("transitions", _unchunked(rows.slice(first, stop - first)))
        for name in BY_EPISODE:
            into = f"INSERT INTO {name}" if number else f"CREATE TEMP TABLE {name} AS"
            connection.execute(f"{into}\n{_query(name)}")
        if custom:
            added = _query("measured_custom_signals")
            connection.execute(f"INSERT INTO measured_signals\n{added}")
        connection.unregister("transitions")  # its copies go before the next are made
    return {
        name: connection.sql(f"FROM {name} ORDER BY {order}").to_arrow_table()
        for name, order in BY_EPISODE.items()
    }


def _whole_episodes(rows: pa.Table) -> Iterator[tuple[int, int]]:
    """Return where to cut the rows, as first and one past the last, some STRETCH_ROWS apart.

    No episode lies in two parts. All rows are one part if an episode's do not lie together.
    """
    coded = rows["episode_id"].combine_chunks().dictionary_encode()
    codes = coded.indices.fill_null(-1).to_numpy(zero_copy_only=False)
    begins = np.flatnonzero(np.diff(codes)) + 1
    cuts = begins[np.flatnonzero(np.diff(begins // STRETCH_ROWS, prepend=0))].tolist()
    together = len(begins) < len(np.unique(codes))
    return pairwise([0, *(cuts if together else []), len(rows)])


def _unchunked(rows: pa.Table) -> pa.Table:
    """Join the chunks of WIDE columns, one per episode: for DuckDB each is a batch."""
    for name in WIDE:
        place = rows.schema.get_field_index(name)
        rows = rows.set_column(place, name, rows[name].combine_chunks())
    return rows


def with_ends(rows: pa.Table, packed_ends: str | None) -> pa.Table:
    """Return a recording's rows with the ends of episodes from its manifest in their metadata."""
    metadata = {ENDS: packed_ends.encode()} if packed_ends else None
    return rows.replace_schema_metadata(metadata)


@cache
def _database() -> duckdb.DuckDBPyConnection:
    """Return one connection for all recordings: opening it takes as long as a summary."""
    import duckdb

    atexit.register(_database.cache_clear)  # nanobind complains of what outlives its module
    return duckdb.connect(config={"threads": 1})


@cache
def _query(name: str) -> str:
    return with_included(f"-- include: {name}.sql")


def with_included(text: str, beside: Traversable | None = None) -> str:
    """Insert into SQL the files that it names: definitions which several statements share.

    They are in this folder or else in the one `beside`.
    """

    def included(named: re.Match[str]) -> str:
        folder = files("restock.ingest.store")
        if beside is not None and not (folder / named[1]).is_file():
            folder = beside
        return with_included((folder / named[1]).read_text(encoding="utf-8"), beside)

    return re.sub(r"-- include: (\w+\.sql)", included, text)


def _listed(rows: pa.Table, kind: pa.DataType) -> pa.Array:
    """Return all rows of a table as the one value of a list column."""
    fields = list(kind.value_type)
    columns = [rows[field.name].cast(field.type).combine_chunks() for field in fields]
    values = pa.StructArray.from_arrays(columns, fields=fields)
    return pa.ListArray.from_arrays(pa.array([0, len(rows)], pa.int32()), values).cast(kind)


SKETCH_HASHES = 256
MIN_HASHES = 3  # that two recordings must share
LARGELY = 0.5  # of the smaller recording's rows
NEARLY_ALL = 0.95  # at its cut, a part has rows of its own
# Replaced meanwhile, or damaged: no fault of the recording that is being ingested.
UNREADABLE = (OSError, StoreError, pa.ArrowException)
PART_ROWS = 2048  # hashed at a time: bounds memory
_LARGE = 2e15  # what stands for infinity
Hashes = NDArray[np.uint64]


@dataclass(frozen=True)
class RepeatedDrive:
    """A recording of the store that holds the same rows."""

    recording_id: str
    source_file: str
    rows: int  # of the new recording that it holds too
    share: float  # of the new recording's rows
    share_of_other: float  # of its own rows
    held: float  # of its own rows that look like no other of it

    @property
    def is_part(self) -> bool:
        """Return whether the new one holds (nearly) all that it has, and more."""
        return self.the_less and self.held >= NEARLY_ALL

    @property
    def the_less(self) -> bool:
        """Return whether it holds less of the drive than the new one: a part or a cut of it."""
        return self.share_of_other > self.share

    def __str__(self) -> str:
        whole = min(self.share, self.share_of_other) >= NEARLY_ALL
        return (
            f"{self.rows:,} transitions ({self.share:.0%}) are also in {self.source_file} "
            f"(recording {self.recording_id}, {self.share_of_other:.0%} of it), with other ids: "
            f"{'the same drive' if whole else 'a part of the same drive'} twice"
        )


@dataclass(frozen=True)
class Sketch:
    """The smallest hashes of a stored recording, (k,) ascending, and where its rows are."""

    recording_id: str
    ingest_id: str
    hashes: Hashes

    @classmethod
    def of(cls, recording_id: str, ingest_id: str, hashes: Hashes) -> Sketch:
        """Return the sketch of a recording with these `distinctive` hashes."""
        return cls(recording_id, ingest_id, hashes[:SKETCH_HASHES])


def sketch(hashes: Hashes) -> str:
    """Write the sketch of a recording's `distinctive` hashes as a manifest keeps it."""
    return hashes[:SKETCH_HASHES].astype("<u8").tobytes().hex()


def read_sketch(text: str) -> Hashes:
    """Read a manifest's sketch; "" gives none, as of a manifest that another tool wrote."""
    return np.frombuffer(bytes.fromhex(text), "<u8")


def row_hashes(rows: pa.Table) -> Hashes:
    """Hash each row's task, action, observation and pose, (N,), to a thousandth."""
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
    return splitmix64(total)  # mixed: the smallest are a random sample of the rows


def sharing(mine: Hashes, sketches: Sequence[Sketch]) -> list[Sketch]:
    """Return the sketches that have MIN_HASHES of a recording's hashes (N,), ascending."""
    if not len(mine):
        return []
    hashes = np.concatenate([one.hashes for one in sketches] or [mine[:0]])
    marked = np.zeros(1 << 16, np.bool_)  # most have other low bits, which are quick to look up
    marked[mine.astype(np.uint16)] = True
    at = np.flatnonzero(marked[hashes.astype(np.uint16)])
    at = at[mine[np.minimum(np.searchsorted(mine, hashes[at]), len(mine) - 1)] == hashes[at]]
    ends = np.cumsum([len(one.hashes) for one in sketches])
    shared = np.bincount(np.searchsorted(ends, at, "right"), minlength=len(sketches))
    return [sketches[place] for place in np.flatnonzero(shared >= MIN_HASHES).tolist()]


def looks_alike(mine: Hashes, other: Sketch) -> bool:
    """Return whether the rows (N,) and a sketch may be largely the same."""
    if not len(other.hashes):
        return False
    # Below its largest hash, a full sketch has all of its recording's.
    full = len(other.hashes) == SKETCH_HASHES
    compared = mine[mine <= other.hashes[-1]] if full else mine
    both = len(np.intersect1d(compared, other.hashes))
    least = min(len(compared), len(other.hashes))
    return both >= MIN_HASHES and both >= LARGELY / 2 * least


def compare(rows: pa.Table, other: pa.Table, period_s: float) -> RepeatedDrive | None:
    """Return what the new rows share with those of another recording, if they largely do.

    One constant shift between the stamps of the two is taken out; rows further apart than half a
    control period do not count.
    """
    mine, at = distinctive(rows)
    theirs, there = distinctive(other)
    _, here, where = np.intersect1d(mine, theirs, assume_unique=True, return_indices=True)
    if not len(here):
        return None
    later = _stamps(rows)[at[here]] - _stamps(other)[there[where]]
    shift = np.sort(later)[len(later) // 2]
    same = int((np.abs(later - shift) <= period_s * 1e9 / 2).sum())
    least = min(len(mine), len(theirs))
    if same < MIN_HASHES or same < LARGELY * least:
        return None
    return RepeatedDrive(
        str(other["recording_id"][0]),
        str(other["source_file"][0]),
        same,
        same / len(rows),
        same / len(other),
        same / len(theirs),
    )


def find_repeat(
    mine: Hashes,
    rows: Callable[[], pa.Table],
    sketches: Iterable[Sketch],
    read: Callable[[str, str], pa.Table],
    period_s: float,
) -> RepeatedDrive | None:
    """Return the recording with the most of the rows, of those that `compare` finds the same.

    `mine` are the rows' `distinctive` hashes; `rows()`, and `read(recording_id, ingest_id)` of one
    whose sketch looks alike, are asked for where there is one.
    """
    found = []
    for one in sharing(mine, list(sketches)):
        if looks_alike(mine, one):
            with suppress(*UNREADABLE):
                other = read(one.recording_id, one.ingest_id)
                found.append(compare(rows(), other, period_s))
    return max(
        (repeat for repeat in found if repeat is not None),
        key=lambda repeat: (repeat.rows, repeat.recording_id),
        default=None,
    )


def distinctive(rows: pa.Table) -> tuple[Hashes, Ints]:
    """Return the hashes of rows that look like no other of their recording, ascending.

    Also return which rows they are of. A robot that stands proves nothing.
    """
    found, first, counts = np.unique(row_hashes(rows), return_index=True, return_counts=True)
    once: Bools = counts == 1
    return found[once], first[once].astype(np.int64)


def _stamps(rows: pa.Table) -> Ints:
    return np.asarray(rows["stamp_ns"].to_numpy(), np.int64)
