"""Messages decoded one by one through `rosbags`: the reference for the columnar decoder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.base import normalize_fieldname

from restock.ingest.columns import Batch, FieldColumn, Ragged, offsets_of
from restock.ingest.definitions import DTYPES, CannotDecode, Leaf, MessageType


@dataclass(frozen=True)
class Decoded:
    """What came of one batch: columns of the good rows, and why the others are none."""

    rows: NDArray[np.intp]  # (G,) of the batch
    fields: dict[str, FieldColumn]  # (G, …) each
    bad: dict[str, int]  # reason -> messages


class RowDecoder:
    """Decodes each message with rosbags' generated code, then lays the values out in columns."""

    def __init__(self, message: MessageType, leaves: Sequence[Leaf], *, ros1: bool = False) -> None:
        self._name, self._leaves, self._ros1 = message.name, leaves, ros1
        try:
            self._store = get_typestore(Stores.EMPTY)
            self._store.register(_family(message))
        except (TypesysError, SyntaxError, KeyError, RecursionError) as error:
            raise CannotDecode(f"its definition cannot be used: {error}") from error

    def empty(self) -> dict[str, FieldColumn]:
        """Columns without a row."""
        return {leaf.path: column_of([], leaf) for leaf in self._leaves}

    def decode(self, batch: Batch) -> Decoded:
        """The batch's columns; a message that does not decode is counted, by reason."""
        messages, rows, bad = [], [], dict[str, int]()
        read = self._store.deserialize_ros1 if self._ros1 else self._store.deserialize_cdr
        for row, payload in enumerate(batch.payloads()):
            try:
                messages.append(read(payload, self._name))
                rows.append(row)
            except (SerdeError, IndexError, ValueError, KeyError) as error:
                reason = str(error).split(":")[0]
                bad[reason] = bad.get(reason, 0) + 1
        fields = {leaf.path: column_of(messages, leaf) for leaf in self._leaves}
        return Decoded(np.asarray(rows, np.intp), fields, bad)


def _family(message: MessageType) -> dict[str, Any]:
    """The type and those it is made of: all that rosbags must compile."""
    wanted, family = [message.name], dict[str, Any]()
    while wanted:
        name = wanted.pop()
        if name not in family:
            fields = message.fields_of(name)
            family[name] = message.raw[name]
            wanted += [field.message for field in fields if field.message]
    return family


def column_of(messages: Sequence[Any], leaf: Leaf) -> FieldColumn:
    """The values at a field path of decoded messages, (N, …) or Ragged."""
    values: list[Any] = list(messages)
    levels: list[tuple[int | None, list[int]]] = []
    for step in leaf.steps:
        name = normalize_fieldname(step.name)
        values = [getattr(value, name) for value in values]
        if step.many:
            levels.append((step.many.length, [len(value) for value in values]))
            if step is leaf.steps[-1] and leaf.kind in DTYPES:
                column = _primitives(values, DTYPES[leaf.kind])
                return _wrap(column, levels)
            values = [item for value in values for item in value]
    if leaf.kind == "time":
        stamps = [value.sec * 1_000_000_000 + value.nanosec for value in values]
        return _wrap(np.array(stamps, np.int64), levels)
    if leaf.kind == "string":
        texts = np.empty(len(values), object)
        texts[:] = values
        return _wrap(texts, levels)
    if leaf.kind == "byte":  # an octet; rosbags gives it a sign
        return _wrap(np.array(values, np.int8).view(np.uint8), levels)
    return _wrap(np.array(values, DTYPES[leaf.kind]), levels)


def _primitives(values: list[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    if not values:
        return np.zeros(0, dtype)
    return np.concatenate([np.asarray(value, dtype) for value in values])


def _wrap(column: FieldColumn, levels: list[tuple[int | None, list[int]]]) -> FieldColumn:
    """Flat values to their nesting, from the innermost repetition out."""
    for length, counts in reversed(levels):
        if length is not None and not isinstance(column, Ragged):
            column = column.reshape(len(counts), length, *column.shape[1:])
        else:
            column = Ragged(column, offsets_of(np.asarray(counts, np.int64)))
    return column
