"""Custom signals: values of any topic that become columns of the transitions, by the profile.

`[signals.battery_v]` of a profile names the column `battery_v` and says where it comes from. At
every step it is what the topic said last (at or before the step, at most `max_age_s` ago), or
null. Conditions and queries see it as they see Restock's own signals; observation and reward do
not.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import duckdb
import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.errors import RecordingError
from restock.ingest.align import Samples, Segment
from restock.ingest.columns import FieldColumn, Ragged, TopicColumns, offsets_of
from restock.ingest.reading import Fields, Reduction
from restock.ingest.schema import COLUMNS
from restock.ingest.signal_paths import Found, PathProblem, SignalPath

if TYPE_CHECKING:
    from restock.ingest.fields import Leaf

Reduce = Literal["min", "max", "mean", "sum", "count", "yaw"]
NUMBER = pa.float64()
LIST = pa.list_(pa.field("element", pa.float32()))
# Columns that a store's views add to a transition's, and that labelling adds.
_TAKEN = {"logged_ns", "row_", "observation_size"} | {column.name for column in COLUMNS}
_QUATERNION = ("x", "y", "z", "w")


class CustomSignal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One `[signals.NAME]` of a profile."""

    topic: str
    type: str
    path: str  # see `restock.ingest.signal_paths`
    unit: str  # "V", "m", "1", …
    max_age_s: float | None = None  # None: latched, held until the next message
    reduce: Reduce | None = None  # a list to one number; a quaternion to its yaw
    values: dict[str, float] | None = None  # what a text, bool or number stands for
    scale: float = 1.0  # stored = found * scale + offset
    offset: float = 0.0
    doc: str = ""

    def __post_init__(self) -> None:
        try:
            path = SignalPath.read(self.path)
        except PathProblem as problem:
            raise ValueError(f"path {self.path!r} {problem}") from None
        if self.reduce is None and path.lists > 1:
            raise ValueError(
                f"path {self.path!r} gives lists of lists: name one element, or say reduce"
            )
        if self.reduce == "yaw" and path.lists:
            raise ValueError(
                f'path {self.path!r} gives a list: reduce = "yaw" takes one quaternion'
            )
        if self.reduce not in (None, "yaw") and not path.lists:
            raise ValueError(f"path {self.path!r} gives one value: there is nothing to reduce")
        if self.max_age_s is not None and not self.max_age_s > 0:
            raise ValueError(f"max_age_s must be above 0, got {self.max_age_s}")

    @property
    def read(self) -> SignalPath:
        return SignalPath.read(self.path)

    @property
    def ends(self) -> tuple[str, ...]:
        """Fields of the message at the end of the path that are read, where it is a message."""
        return _QUATERNION if self.reduce == "yaw" else ()

    @property
    def is_list(self) -> bool:
        return self.reduce is None and self.read.lists > 0

    @property
    def picks(self) -> bool:
        """Whether it means one certain element, which a message may not have."""
        return any(s.choice is not None and not s.choice.many for s in self.read.steps)

    def wanted(self) -> list[str]:
        """The field paths to read for it."""
        return self.read.wanted(*self.ends)

    def field(self, name: str) -> pa.Field:
        """Its column, with unit and source in the metadata."""
        about = {"unit": self.unit, "topic": self.topic, "path": self.path, "meaning": self.doc}
        kind = LIST if self.is_list else NUMBER
        return pa.field(name, kind, nullable=True, metadata={k: v for k, v in about.items() if v})

    def problem(self, leaves: Sequence[Leaf]) -> str | None:
        """Why messages with these fields do not have it, or None."""
        try:
            kinds = self.read.check(leaves, *self.ends)
        except PathProblem as problem:
            return str(problem)
        if self.reduce == "yaw" and "string" in kinds:
            return "is no quaternion"
        return None


def name_problem(name: str) -> str | None:
    """Why a custom signal may not have this name, or None."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        return "a name has small letters, digits and _"
    if name in _TAKEN:
        return "Restock has a column of that name: choose another"
    if name in _reserved():
        return "SQL has a word of that name: choose another"
    return None


def _reserved() -> set[str]:
    with duckdb.connect() as connection:
        rows = connection.sql(
            "SELECT keyword_name FROM duckdb_keywords() WHERE keyword_category = 'reserved'"
        ).fetchall()
    return {name for (name,) in rows}


@dataclass(frozen=True)
class CustomColumn:
    """A custom signal's values in one recording, message by message."""

    signal: CustomSignal
    values: Ragged  # (N,) of a signal that is no list: one value a message, or none
    unread: Sequence[str] = ()  # of each message that has one: a text that is no number

    @cached_property
    def samples(self) -> NDArray[np.bool_]:
        """(N,) which messages say something: those without the one element meant do not."""
        if not self.signal.picks:
            return np.ones(len(self.values), np.bool_)
        return np.asarray(self.values.lengths > 0, np.bool_)

    def take(self, message: NDArray[np.intp], known: NDArray[np.bool_]) -> pa.Array:
        """The values of these messages (T,), null where not `known` or not finite."""
        if not len(self.values):
            return pa.nulls(len(message), LIST if self.signal.is_list else NUMBER)
        if not self.signal.is_list:
            every = np.append(np.asarray(self.values.values, np.float64), np.nan)
            has = self.values.lengths[message] > 0
            values = every[np.where(has, self.values.offsets[message], -1)]
            return pa.array(values, NUMBER, mask=~known | ~np.isfinite(values))
        rows = self.values.take(message)
        values = np.asarray(rows.values, np.float32)
        flat = pa.array(values, pa.float32(), mask=~np.isfinite(values))
        offsets = pa.array(rows.offsets, pa.int32())
        return pa.ListArray.from_arrays(offsets, flat, type=LIST, mask=pa.array(~known))


def custom_reduction(signals: Mapping[str, CustomSignal]) -> Reduction:
    """What makes the columns of these signals, all of one topic, of its messages' fields."""
    fields = [path for signal in signals.values() for path in signal.wanted()]

    def apply(columns: Fields) -> dict[str, FieldColumn]:
        found: dict[str, FieldColumn] = {}
        for name, signal in signals.items():
            found |= _per_message(name, signal, columns)
        return found

    return Reduction(tuple(dict.fromkeys(fields)), apply)


def _per_message(name: str, signal: CustomSignal, columns: Fields) -> dict[str, FieldColumn]:
    """A signal's values in N messages, and the texts among them that are no number.

    Raises:
        RecordingError: it is not a number a message, or a list of numbers.
    """
    path, count = signal.read, len(columns[signal.wanted()[0]])
    texts: dict[str, FieldColumn] = {}
    try:
        if signal.reduce == "yaw":
            parts = [path.find(columns, end) for end in _QUATERNION]
            x, y, z, w = (np.asarray(part.values, np.float64) for part in parts)
            found = Found(parts[0].message, yaw_of(x, y, z, w))
        else:
            found = path.find(columns)
            if signal.reduce == "count":
                counts = np.bincount(found.message, minlength=count).astype(np.float64)
                found = Found(np.arange(count), counts)
            elif signal.values is not None or found.values.dtype.kind not in "biuf":
                values, unread = _numbers(found.values, signal.values)
                texts[f"{_key(name)}, no number"] = first = np.full(count, "", object)
                first[found.message[unread]] = found.values[unread].astype(str)
                found = Found(found.message, values)
    except (PathProblem, ValueError, TypeError) as problem:
        raise RecordingError(
            f"`signals.{name}.path`: {signal.path!r} of {signal.topic} {problem}"
        ) from None
    if signal.reduce in ("min", "max", "mean", "sum"):
        found = _reduced(found, signal.reduce)
    stored = np.asarray(found.values, np.float64) * signal.scale + signal.offset
    lengths = np.bincount(found.message, minlength=count)
    return {
        _key(name): Ragged(stored.astype(np.float32) if signal.is_list else stored,
                           offsets_of(lengths)),
        **texts,
    }  # fmt: skip


def _key(name: str) -> str:
    """A signal among the columns of its topic; names of fields hold no space."""
    return f"signal {name}"


def yaw_of(
    x: NDArray[Any], y: NDArray[Any], z: NDArray[Any], w: NDArray[Any]
) -> NDArray[np.float64]:
    """Quaternions (N,) to yaw in (-pi, pi], REP 103: about z, counter-clockwise."""
    with np.errstate(over="ignore", invalid="ignore"):  # what is no number stays none
        return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), np.float64)


def _numbers(
    values: NDArray[Any], mapping: Mapping[str, float] | None
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Values (V,) as numbers, NaN where they are none; and which of them say no number."""
    kinds, inverse = np.unique(values.astype(str), return_inverse=True)
    known = np.full(len(kinds), np.nan)
    unread = np.zeros(len(kinds), np.bool_)
    told = {key.lower(): value for key, value in mapping.items()} if mapping is not None else None
    for index, text in enumerate(kinds.tolist()):
        plain = text.removesuffix(".0") if values.dtype.kind == "f" else text
        try:
            known[index] = float(text) if told is None else told[plain.lower()]
        except (ValueError, KeyError):
            unread[index] = True
    return known[inverse], unread[inverse]


def _reduced(found: Found, how: Reduce | None) -> Found:
    """The finite elements of each message as one number; a message without any has none."""
    finite = np.isfinite(found.values)
    values, owner = np.asarray(found.values, np.float64)[finite], found.message[finite]
    message, start, counts = np.unique(owner, return_index=True, return_counts=True)
    if not len(message):
        return Found(message, values)
    if how in ("min", "max"):
        reduce = np.minimum if how == "min" else np.maximum
        return Found(message, reduce.reduceat(values, start))
    total = np.add.reduceat(values, start)
    return Found(message, total / counts if how == "mean" else total)


@dataclass(frozen=True)
class Custom:
    """The custom signals of a recording at its T steps."""

    table: pa.Table  # T rows, a column a signal
    columns: dict[str, CustomColumn]  # of the topics that the recording has

    def take(self, ticks: NDArray[np.int64]) -> pa.Table:
        """The columns at these ticks."""
        return self.table.take(pa.array(ticks))


def custom_signals(
    signals: Mapping[str, CustomSignal],
    topics: Mapping[str, TopicColumns],
    segments: Sequence[Segment],
    ticks: Sequence[NDArray[np.int64]],
) -> Custom:
    """Every custom signal at every tick of every segment, causally held; null where it is not."""
    count = sum(len(stamps) for stamps in ticks)
    found: dict[str, CustomColumn] = {}
    table = pa.table({"tick": np.arange(count)})
    for name, signal in signals.items():
        array = pa.nulls(count, signal.field(name).type)
        if signal.topic in topics:
            column = found[name] = _column_of(name, signal, topics[signal.topic])
            parts = [
                _at(column, segment.topics[signal.topic], stamps)
                for segment, stamps in zip(segments, ticks, strict=True)
            ]
            array = pa.concat_arrays(parts) if parts else array
        table = table.append_column(signal.field(name), array)
    return Custom(table.drop_columns("tick"), found)


def _column_of(name: str, signal: CustomSignal, topic: TopicColumns) -> CustomColumn:
    fields: Fields = topic.fields
    if _key(name) not in fields:  # columns of whole messages, as no recording's reader gives them
        fields = custom_reduction({name: signal}).apply(fields)
    values, texts = fields[_key(name)], fields.get(f"{_key(name)}, no number", np.zeros(0))
    assert isinstance(values, Ragged)
    return CustomColumn(signal, values, [text for text in np.asarray(texts).tolist() if text])


def _at(column: CustomColumn, samples: Samples, stamps: NDArray[np.int64]) -> pa.Array:
    keep = column.samples[samples.row]
    held = Samples(samples.stamp_ns[keep], samples.row[keep]).hold(stamps, column.signal.max_age_s)
    return column.take(held.row, held.fresh)
