"""Rows that come batch by batch, put in order: by recording, episode, step and id.

Batches of a store come as the threads that read them finish, but the rows of one batch lie in
order already, recording by recording. So stretches are put in order and not rows, a column at a
time; rows are sorted only where stretches overlap. Numbers are kept as they come, text as codes in
as few bytes as its dictionary needs.
"""

from __future__ import annotations

from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from restock.arrays import Bools, Ints

KEYS = ("episode_index", "step_index", "transition_id")  # the id where all others are the same
# Stretches that are more, and shorter on average, take longer than sorting rows.
MAX_STRETCHES, STRETCH_ROWS = 1_000, 256
COLUMNS_AT_A_TIME = 2  # put in order: each holds memory
_LOOKED_AT = 1 << 20  # codes at a time


class RowsInOrder:
    """Collects batches of one schema: `add` each, then take the `table` of all, once.

    The schema has `recording_id` and KEYS. Columns named in `text` become dictionaries, whose codes
    are in the order of the first rows that have them; those in `dropped` are no columns of the
    table.
    """

    def __init__(
        self, schema: pa.Schema, *, text: Collection[str], dropped: Collection[str] = ()
    ) -> None:
        self._schema, self._dropped = schema, dropped
        self._parts: dict[str, list[pa.Array]] = {name: [] for name in schema.names}
        self._codes: dict[str, dict[str, int]] = {name: {} for name in schema.names if name in text}
        self._stretches: list[_Stretches] = []  # of each batch

    def add(self, batch: pa.RecordBatch) -> None:
        """Add one batch; nothing of its memory is kept."""
        if not len(batch):
            return
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            if (known := self._codes.get(name)) is not None:
                kept = _encoded(column, known)
            else:  # a copy: any column of DuckDB's batch holds all of it, text too
                kept = pa.concat_arrays([column, column[:0]])
            self._parts[name].append(kept)
        recording, *keys = (
            np.asarray(self._parts[name][-1].to_numpy(), np.int64)
            for name in ("recording_id", *KEYS)
        )
        self._stretches.append(_Stretches.of(recording, keys))

    def table(self) -> pa.Table:
        """Return all rows in order, and free the batches on the way."""
        rank = self._ranks()
        stretches = _in_order(self._stretches, rank)
        order = self._sorted_rows(rank) if stretches is None else None

        def column(name: str) -> pa.Array:
            parts, codes = self._parts.pop(name), self._codes.get(name)
            kind = self._schema.field(name).type if codes is None else _code_type(len(codes))
            if codes is not None:  # later batches may have needed wider codes
                parts = [part.cast(kind) for part in parts]
            if stretches is not None:
                parts = [parts[batch].slice(begin, size) for batch, begin, size in stretches]
            together = pa.concat_arrays([pa.array([], kind), *parts])
            del parts
            if order is not None:
                together = together.take(order)
            return together if codes is None else _by_appearance(together, list(codes))

        for name in self._dropped:
            del self._parts[name]
        names = list(self._parts)
        with ThreadPoolExecutor(COLUMNS_AT_A_TIME, "restock-columns") as pool:
            return pa.table(list(pool.map(column, names)), names)

    def _ranks(self) -> Ints:
        """Return the place of each recording's code in the order of their ids."""
        ids = pa.array(list(self._codes["recording_id"]), pa.string())
        rank = np.empty(len(ids), np.int64)
        rank[pc.array_sort_indices(ids).to_numpy()] = np.arange(len(ids))
        return rank

    def _sorted_rows(self, rank: Ints) -> pa.Array:
        """Return the order of single rows, (N,)."""
        keys = [pa.concat_arrays(self._parts[key]).to_numpy() for key in reversed(KEYS)]
        of_batches = [part.cast(pa.int32()) for part in self._parts["recording_id"]]
        return pa.array(np.lexsort([*keys, rank[pa.concat_arrays(of_batches).to_numpy()]]))


@dataclass(frozen=True)
class _Stretches:
    """The stretches of one batch: consecutive rows of one recording, (n,) each."""

    recording: Ints  # its code
    begin: Ints
    size: Ints
    first: list[Ints]  # KEYS of their first rows
    last: list[Ints]
    in_order: bool  # the rows of each

    @classmethod
    def of(cls, recording: Ints, keys: list[Ints]) -> _Stretches:
        begin = np.append(0, np.flatnonzero(recording[1:] != recording[:-1]) + 1)
        size = np.diff(begin, append=len(recording))
        in_order = _before([key[:-1] for key in keys], [key[1:] for key in keys])
        in_order[begin[1:] - 1] = True
        last = begin + size - 1
        return cls(
            recording[begin],
            begin,
            size,
            [key[begin] for key in keys],
            [key[last] for key in keys],
            bool(in_order.all()),
        )


def _in_order(batches: list[_Stretches], rank: Ints) -> list[tuple[int, int, int]] | None:
    """Return batch, begin and size of each stretch, in order; None if rows must be sorted.

    They must if a stretch is not in order, if two overlap, or if stretches are so short that
    sorting is faster.
    """
    if not all(one.in_order for one in batches):
        return None
    none = np.empty(0, np.int64)
    begin = np.concatenate([none, *(one.begin for one in batches)])
    size = np.concatenate([none, *(one.size for one in batches)])
    if len(size) > MAX_STRETCHES and size.sum() < len(size) * STRETCH_ROWS:
        return None
    batch = np.repeat(np.arange(len(batches)), [len(one.begin) for one in batches])
    recording = rank[np.concatenate([none, *(one.recording for one in batches)])]
    first, last = (
        [np.concatenate([none, *(of[key] for of in ends)]) for key in range(len(KEYS))]
        for ends in ([one.first for one in batches], [one.last for one in batches])
    )
    order = np.lexsort((*reversed(first), recording))
    one, behind = order[:-1], order[1:]
    alike = recording[one] == recording[behind]
    one, behind = one[alike], behind[alike]
    if not _before([key[one] for key in last], [key[behind] for key in first]).all():
        return None
    return list(
        zip(batch[order].tolist(), begin[order].tolist(), size[order].tolist(), strict=True)
    )


def _before(one: list[Ints], other: list[Ints]) -> Bools:
    """Return whether the keys of one come before those of the other, or are the same, (n,)."""
    result = one[-1] <= other[-1]
    for here, there in zip(one[-2::-1], other[-2::-1], strict=True):
        result = (here < there) | ((here == there) & result)
    return result


def _code_type(size: int) -> pa.DataType:
    """Return the smallest type that has the codes of so many texts."""
    return pa.int8() if size <= 1 << 7 else pa.int16() if size <= 1 << 15 else pa.int32()


def _encoded(column: pa.Array, known: dict[str, int]) -> pa.Array:
    """Text as codes of `known`, which gets what it has not yet."""
    local = column.cast(pa.string()).dictionary_encode()
    codes = pa.array(
        [known.setdefault(text, len(known)) for text in local.dictionary.to_pylist()],
        _code_type(len(known) + len(local.dictionary)),
    )
    return codes.take(local.indices)


def _by_appearance(codes: pa.Array, names: list[str]) -> pa.DictionaryArray:
    """Dictionary-encode names, numbered in the order in which they first appear.

    So the result does not depend on which thread read which rows first.
    """
    wide = codes.cast(pa.int32()).fill_null(len(names)) if codes.null_count else codes
    code = wide.to_numpy()
    first = np.full(len(names) + 1, len(code), np.int64)  # the last is of null
    for begin in reversed(range(0, len(code), _LOOKED_AT)):
        some = code[begin : begin + _LOOKED_AT]
        first[some[::-1]] = np.arange(begin + len(some) - 1, begin - 1, -1)
    order = np.argsort(first[: len(names)], kind="stable")
    dictionary = pa.array(names, pa.string()).take(pa.array(order))
    if (np.diff(order) == 1).all():  # as they are
        return pa.DictionaryArray.from_arrays(codes, dictionary)
    new = np.empty(len(order), np.int64)
    new[order] = np.arange(len(order))
    return pa.DictionaryArray.from_arrays(pa.array(new, codes.type).take(codes), dictionary)
