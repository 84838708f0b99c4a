"""Custom signals of one recording: from messages to the columns of its steps."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from textwrap import shorten
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.errors import RecordingError
from restock.ingest.containers.storage import Fields, Reduction
from restock.ingest.decoding.columns import FieldColumn, Ragged, TopicColumns, offsets_of
from restock.ingest.profile.signal_paths import (
    Convention,
    PathProblem,
    PathValues,
    conventions_of,
    read_element,
)
from restock.ingest.profile.tables import LIST, NUMBER, QUATERNION, CustomSignal, Reduce
from restock.ingest.steps.align import LatestMessages
from restock.ingest.steps.aligned_inputs import AlignedInputs
from restock.ingest.task.task import yaw_of


@dataclass(frozen=True)
class CustomColumn:
    """A custom signal's values in the N messages of its topic."""

    signal: CustomSignal
    values: Ragged  # (N,) lists; if the signal is not a list, each holds one value or none
    unread: Sequence[str] = ()  # one text of each message that has texts that are not numbers
    unmeasured: int = 0  # number of messages that mark the signal as not measured

    @cached_property
    def samples(self) -> NDArray[np.bool_]:
        """Return which messages have the element that the path selects, (N,)."""
        if not self.signal.picks:
            return np.ones(len(self.values), np.bool_)
        return np.asarray(self.values.lengths > 0, np.bool_)

    @cached_property
    def whole(self) -> NDArray[np.bool_]:
        """Return which messages have a list of the required length, (N,)."""
        lengths, due = self.values.lengths, self.signal.length
        return np.asarray(lengths > 0 if due is None else lengths == due, np.bool_)

    @property
    def of_other_length(self) -> int:
        """Count the messages whose vector has another length than required."""
        return 0 if self.signal.length is None else int((~self.whole).sum())

    @property
    def found(self) -> int:
        """Count the messages with a value: a finite number, or a list of the required length."""
        if self.signal.is_list:
            return int(self.whole.sum())
        return int(np.isfinite(np.asarray(self.values.values, np.float64)).sum())

    def take(self, message: NDArray[np.intp], known: NDArray[np.bool_]) -> pa.Array:
        """Return the values of these messages (T,), null if not `known` or not finite."""
        if not len(self.values):
            return pa.nulls(len(message), LIST if self.signal.is_list else NUMBER)
        if not self.signal.is_list:
            every = np.append(np.asarray(self.values.values, np.float64), np.nan)
            has = self.values.lengths[message] > 0
            values = every[np.where(has, self.values.offsets[message], -1)]
            return pa.array(values, NUMBER, mask=~known | ~np.isfinite(values))
        if self.signal.length is not None:
            known = known & self.whole[message]
        rows = self.values.take(message[known])
        values = np.asarray(rows.values, np.float32)
        flat = pa.array(values, pa.float32(), mask=~np.isfinite(values))
        offsets = np.zeros(len(message) + 1, np.int32)
        offsets[1:][known] = rows.lengths  # a null keeps length 0, or writing Parquet may fail
        offsets = np.cumsum(offsets, dtype=np.int32)
        return pa.ListArray.from_arrays(pa.array(offsets), flat, type=LIST, mask=pa.array(~known))


def custom_reduction(signals: Mapping[str, CustomSignal], has: Collection[str] = ()) -> Reduction:
    """Build the reduction that computes the columns of these signals, all of one topic.

    `has` are all fields of the topic's messages.
    """
    fields = [path for signal in signals.values() for path in signal.wanted()]
    for signal in signals.values():
        for rule in conventions_of(signal.type, signal.path, has):
            fields += rule.fields

    def apply(columns: Fields) -> dict[str, FieldColumn]:
        made: dict[str, FieldColumn] = {}
        for name, signal in signals.items():
            made |= _per_message(name, signal, columns)
        return made

    return Reduction(tuple(dict.fromkeys(fields)), apply)


def _per_message(name: str, signal: CustomSignal, columns: Fields) -> dict[str, FieldColumn]:
    """Compute a signal's columns in N messages: values, texts that are not numbers, and flags.

    A flag marks a message in which the signal was not measured.

    Raises:
        RecordingError: the signal is not a number, or a list of numbers, per message.
    """
    path, count = signal.read, len(columns[signal.wanted()[0]])
    texts: dict[str, FieldColumn] = {}
    try:
        if signal.reduce == "yaw":
            parts = [path.find(columns, end) for end in QUATERNION]
            x, y, z, w = (np.asarray(part.values, np.float64) for part in parts)
            read = PathValues(parts[0].message, yaw_of(x, y, z, w))
        else:
            read = path.find(columns)
            if signal.reduce == "count":
                counts = np.bincount(read.message, minlength=count).astype(np.float64)
                read = PathValues(np.arange(count), counts)
            elif signal.values is not None or read.values.dtype.kind not in "biuf":
                values, unread = _numbers(read.values, signal.values)
                texts[f"{_key(name)}, no number"] = first = np.full(count, "", object)
                first[read.message[unread]] = _texts(read.values[unread])
                read = PathValues(read.message, values)
    except (PathProblem, ValueError, TypeError) as problem:
        raise RecordingError(
            f"`signals.{name}.path`: {signal.path!r} of {signal.topic} {problem}"
        ) from None
    if signal.reduce != "count":
        for rule in conventions_of(signal.type, signal.path, columns):
            read = _mask_unmeasured(rule, columns, read)
            gone = np.bincount(read.message, np.isnan(read.values), count)
            every = np.bincount(read.message, minlength=count)
            texts[f"{_key(name)}, not measured"] = (every > 0) & (gone == every)
    if signal.reduce in ("min", "max", "mean", "sum"):
        read = _reduce(read, signal.reduce)
    stored = np.asarray(read.values, np.float64) * signal.scale + signal.offset
    lengths = np.bincount(read.message, minlength=count)
    return {
        _key(name): Ragged(stored.astype(np.float32) if signal.is_list else stored,
                           offsets_of(lengths)),
        **texts,
    }  # fmt: skip


def _mask_unmeasured(rule: Convention, columns: Fields, read: PathValues) -> PathValues:
    """Replace the values that messages mark as not measured by NaN."""
    markings = (read_element(columns, path)[read.message] for path in rule.marked_by)
    return PathValues(read.message, rule.read(np.asarray(read.values, np.float64), *markings))


def _key(name: str) -> str:
    """Return the name of a signal's column; it has a space, so as not to clash with fields."""
    return f"signal {name}"


def _numbers(
    values: NDArray[Any], mapping: Mapping[str, float] | None
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Convert values (V,) to numbers or NaN; also return which values are not numbers."""
    texts = _texts(values)
    found: dict[str, float | None] = {}  # text -> its number; None: not a number
    numbers = (
        {key.lower(): value for key, value in mapping.items()} if mapping is not None else None
    )
    for text in set(texts):
        plain = text.removesuffix(".0") if values.dtype.kind == "f" else text
        try:
            found[text] = float(text) if numbers is None else numbers[plain.lower()]
        except (ValueError, KeyError):
            found[text] = None
    read = [found[text] for text in texts]
    return np.array(read, np.float64), np.array([one is None for one in read], np.bool_)


def _texts(values: NDArray[Any]) -> list[str]:
    """Convert values (V,) to a list of texts.

    A list, as in a NumPy array, each text would take the memory of the longest.
    """
    return [str(value) for value in (values if values.dtype.kind == "O" else values.astype(str))]


def _reduce(read: PathValues, how: Reduce | None) -> PathValues:
    """Reduce the finite elements of each message to one number; a message without any has none."""
    finite = np.isfinite(read.values)
    values, owner = np.asarray(read.values[finite], np.float64), read.message[finite]
    message, start, counts = np.unique(owner, return_index=True, return_counts=True)
    if not len(message):
        return PathValues(message, values)
    if how in ("min", "max"):
        reduce = np.minimum if how == "min" else np.maximum
        return PathValues(message, reduce.reduceat(values, start))
    total = np.add.reduceat(values, start)
    return PathValues(message, total / counts if how == "mean" else total)


@dataclass(frozen=True)
class Custom:
    """The custom signals of a recording at its T steps."""

    table: pa.Table  # T rows, one column per signal
    columns: dict[str, CustomColumn]  # signals whose topic is in the recording

    @property
    def notes(self) -> list[str]:
        """Describe values that could not be used, signal by signal."""
        return (
            [
                f"signals.{name}: {len(column.unread):,} of {len(column.values):,} messages have"
                f" a value that is not a number, such as {shorten(column.unread[0], 60)!r}"
                for name, column in self.columns.items()
                if column.unread
            ]
            + [
                f"signals.{name}: {column.unmeasured:,} of {len(column.values):,} messages of"
                f" {column.signal.topic} mark it as not measured ({_marking(column.signal)}): null"
                for name, column in self.columns.items()
                if column.unmeasured
            ]
            + [
                f"signals.{name}: {count:,} of {len(column.values):,} messages do not have the"
                f" length {column.signal.length}: null"
                for name, column in self.columns.items()
                if (count := column.of_other_length)
            ]
        )

    def rows(self) -> list[dict[str, Any]]:
        """Return the counts of each signal, as rows of `recordings.signals`."""
        rows = []
        for column in self.table.schema:
            about = {key.decode(): text.decode() for key, text in (column.metadata or {}).items()}
            read = self.columns.get(column.name)
            rows.append(
                {
                    "name": column.name,
                    "unit": about.get("unit", ""),
                    "type": _type_name(column.type == LIST, about.get("length")),
                    "topic": about["topic"],
                    "path": about["path"],
                    "meaning": about.get("meaning", ""),
                    "messages": len(read.values) if read else 0,
                    "found": read.found if read else 0,
                    "unread": len(read.unread) + read.of_other_length if read else 0,
                    "steps": len(self.table) - self.table[column.name].null_count,
                }
            )
        return rows

    def take(self, ticks: NDArray[np.int64]) -> pa.Table:
        """Return the columns at these ticks."""
        return self.table.take(pa.array(ticks))


def _type_name(is_list: bool, length: str | None) -> str:
    return (f"list[{length}]" if length else "list") if is_list else "number"


def custom_signals(aligned: AlignedInputs) -> Custom:
    """Compute every custom signal at every tick: its latest value, or null if unknown or stale."""
    columns: dict[str, CustomColumn] = {}
    count = sum(map(len, aligned.ticks))
    table = pa.table({"tick": np.arange(count)})
    for name, signal in aligned.profile.signals.items():
        array = pa.nulls(count, signal.field(name).type)
        topic = aligned.inputs.topics.get(signal.topic)
        if topic is not None:
            column = columns[name] = column_of(name, signal, topic)
            latest = latest_samples(aligned, column)
            array = column.take(latest.row, latest.fresh)
        table = table.append_column(signal.field(name), array)
    return Custom(table.drop_columns("tick"), columns)


def latest_samples(aligned: AlignedInputs, column: CustomColumn) -> LatestMessages:
    """Return the latest message that has a custom signal, at every tick."""
    signal = column.signal
    return aligned.latest_of(signal.topic, signal.max_age_s, keep=column.samples)


def column_of(name: str, signal: CustomSignal, topic: TopicColumns) -> CustomColumn:
    """Return a signal's values from its topic's columns."""
    fields: Fields = topic.fields
    if _key(name) not in fields:  # the topic was read without its reduction
        fields = custom_reduction({name: signal}).apply(fields)
    values, texts = fields[_key(name)], fields.get(f"{_key(name)}, no number", np.zeros(0))
    assert isinstance(values, Ragged)
    unmeasured = int(np.sum(np.asarray(fields.get(f"{_key(name)}, not measured", 0))))
    unread = [text for text in np.asarray(texts).tolist() if text]
    return CustomColumn(signal, values, unread, unmeasured)


def _marking(signal: CustomSignal) -> str:
    return " or ".join(rule.words for rule in conventions_of(signal.type, signal.path))
