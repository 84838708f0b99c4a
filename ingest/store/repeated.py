"""Whether a recording is already in the store under another id: a part of it, or a copy.

Ids come from bytes, so a salvaged part, another cut or a drive that was replayed and recorded again
has another one. Rows are compared by what they hold. Beside each manifest lies a sketch of its
recording, the smallest hashes of its rows (bottom-k, Broder 1997), so that an ingest reads the rows
of those recordings alone that look alike. The audit `repeated_steps` finds the same in SQL, of all
rows.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import Bools, Ints, splitmix64
from restock.errors import StoreError

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
        """Whether the new one holds (nearly) all that it has, and more."""
        return self.the_less and self.held >= NEARLY_ALL

    @property
    def the_less(self) -> bool:
        """Whether it holds less of the drive than the new one: a part of it, or a cut of it."""
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
        """That of a recording with these `distinctive` hashes."""
        return cls(recording_id, ingest_id, hashes[:SKETCH_HASHES])


def sketch(hashes: Hashes) -> str:
    """Write the sketch of a recording's `distinctive` hashes as a manifest keeps it."""
    return hashes[:SKETCH_HASHES].astype("<u8").tobytes().hex()


def read_sketch(text: str) -> Hashes:
    """Read a manifest's sketch; "" gives none, as of a manifest that another tool wrote."""
    return np.frombuffer(bytes.fromhex(text), "<u8")


def row_hashes(rows: pa.Table) -> Hashes:
    """A hash of each row's task, action, observation and pose, (N,), to a thousandth."""
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


def looks_alike(mine: Hashes, other: Sketch) -> bool:
    """Whether the rows (N,) and a sketch may be largely the same."""
    if not len(other.hashes):
        return False
    # Below its largest hash, a full sketch has all of its recording's.
    full = len(other.hashes) == SKETCH_HASHES
    compared = mine[mine <= other.hashes[-1]] if full else mine
    both = len(np.intersect1d(compared, other.hashes))
    least = min(len(compared), len(other.hashes))
    return both >= MIN_HASHES and both >= LARGELY / 2 * least


def compare(rows: pa.Table, other: pa.Table, period_s: float) -> RepeatedDrive | None:
    """What the new rows have in common with those of another recording, if they largely do.

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
    """The recording that holds the most of the rows, of those that `compare` finds the same.

    `mine` are the rows' `distinctive` hashes; `rows()`, and `read(recording_id, ingest_id)` of one
    whose sketch looks alike, are asked for where there is one.
    """
    found = []
    for one in sketches:
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
    """The hashes of the rows that look like no other of their recording, ascending, and which rows
    they are of. A robot that stands proves nothing."""
    found, first, counts = np.unique(row_hashes(rows), return_index=True, return_counts=True)
    once: Bools = counts == 1
    return found[once], first[once].astype(np.int64)


def _stamps(rows: pa.Table) -> Ints:
    return np.asarray(rows["stamp_ns"].to_numpy(), np.int64)
