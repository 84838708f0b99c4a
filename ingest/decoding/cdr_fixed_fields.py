"""Consecutive fields of fixed size in many messages: gathered at once, as structures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.ingest.decoding.cdr_frame import (
    ORDERS,
    Columns,
    Frame,
    Order,
    native,
    spread,
    uniform,
)
from restock.ingest.decoding.columns import gather, join, take

PADDING_BETWEEN = 64  # unwanted bytes that are gathered along with wanted ones around them
SECOND_NS = 1_000_000_000


@dataclass(frozen=True)
class FixedField:
    """One primitive, or a fixed array of them, among fields of fixed size."""

    dtype: np.dtype[Any]  # "<" is implied
    count: int | None  # of a fixed array
    align: int
    path: str | None  # None: not wanted
    part: str = ""  # "sec" or "nanosec" of a time
    also: str | None = None  # its own path, where both it and the whole time are wanted

    @property
    def size(self) -> int:
        """Bytes of all its values."""
        return self.dtype.itemsize * (1 if self.count is None else self.count)


@dataclass
class _Layout:
    """The fields laid out from one starting phase (the cursor modulo the alignment)."""

    size: int  # from the cursor to past the last field, padding before the first included
    groups: list[tuple[int, dict[Order, np.dtype[Any]]]]  # first byte; byte order -> structure


class FixedFields:
    """Consecutive fields of fixed size, gathered as structures."""

    def __init__(self, fields: list[FixedField]) -> None:
        self.fields = fields
        self.mask = max(field.align for field in fields) - 1
        self.layouts = [self._layout(phase) for phase in range(self.mask + 1)]
        self.sizes = np.array([layout.size for layout in self.layouts], np.int64)
        self.first_align = fields[0].align

    def _layout(self, phase: int) -> _Layout:
        position = phase
        groups: list[list[tuple[str, FixedField, int]]] = []
        last = 0
        for number, field in enumerate(self.fields):
            position = (position + field.align - 1) & -field.align
            if field.path is not None:
                if not groups or position - last > PADDING_BETWEEN:
                    groups.append([])
                groups[-1].append((str(number), field, position - phase))
                last = position + field.size
            position += field.size
        return _Layout(position - phase, [_structure(group) for group in groups])

    def decode(self, frame: Frame, out: Columns) -> None:
        """Gather the fields in all messages."""
        position = frame.position
        phase = uniform(position & self.mask)
        if isinstance(phase, int):
            layout = self.layouts[phase]
            frame.check_bounds(position + layout.size)
            self.take(frame, frame.origin + position, layout, out)
            frame.position = position + layout.size
        else:
            self._decode_phases(frame, spread(position, len(frame)), phase, out)

    def _decode_phases(self, frame: Frame, position: Ints, phase: Ints, out: Columns) -> None:
        stop = position + self.sizes[phase]
        frame.check_bounds(stop)
        parts: list[Columns] = []
        order: list[NDArray[np.intp]] = []
        for value in np.unique(phase):
            rows = np.nonzero(phase == value)[0]
            part: Columns = {}
            self.take(frame, (frame.origin + position)[rows], self.layouts[value], part)
            parts.append(part)
            order.append(rows)
        back = np.argsort(np.concatenate(order), kind="stable")
        for path in parts[0]:
            out[path] = take(join([part[path] for part in parts]), back)
        frame.position = stop

    def take(self, frame: Frame, at: Ints, layout: _Layout, out: Columns) -> None:
        """The wanted items at these byte positions; they must fit."""
        times: dict[str, NDArray[np.int64]] = {}
        for first, structures in layout.groups:
            structs = gather(frame.buffer, at + first, structures[frame.order])
            for name in structs.dtype.names or ():
                field = self.fields[int(name)]
                values = native(structs[name])
                if field.dtype == np.bool_:
                    values = values != 0
                if field.also is not None:
                    out[field.also] = values
                if field.part == "sec":
                    times[str(field.path)] = values.astype(np.int64) * SECOND_NS
                elif field.part:
                    out[str(field.path)] = times[str(field.path)] + values
                else:
                    out[str(field.path)] = values

    def stride(self, phase: int) -> int | None:
        """The size of one more element of these fields, where that is the same every time."""
        size = self.layouts[phase].size
        return size if (phase + size) & self.mask == phase else None


def _structure(group: list[tuple[str, FixedField, int]]) -> tuple[int, dict[Order, np.dtype[Any]]]:
    first = group[0][2]
    structures: dict[Order, np.dtype[Any]] = {}
    for order in ORDERS:
        formats: list[Any] = []
        for _, field, _ in group:
            one = np.dtype(np.uint8) if field.dtype == np.bool_ else field.dtype.newbyteorder(order)
            formats.append(one if field.count is None else (one, (field.count,)))
        structures[order] = np.dtype(
            {
                "names": [name for name, _, _ in group],
                "formats": formats,
                "offsets": [at - first for _, _, at in group],
            }
        )
    return first, structures
