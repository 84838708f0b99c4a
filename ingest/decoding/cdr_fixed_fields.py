"""Consecutive fields of fixed size in many messages: gathered at once, as structures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.ingest.decoding.cdr_frame import (
    ORDERS,
    Columns,
    Frame,
    Order,
    native,
    spread,
    uniform,
)
from restock.ingest.decoding.columns import I64, gather, join, take

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


@dataclass
class _Layout:
    """A run's items laid out from one starting phase (the cursor modulo the alignment)."""

    size: int  # from the cursor to past the last item, padding before the first included
    groups: list[tuple[int, dict[Order, np.dtype[Any]]]]  # first byte; byte order -> structure


class FixedFields:
    """Consecutive fields of fixed size, gathered as structures."""

    def __init__(self, items: list[FixedField]) -> None:
        self.items = items
        self.mask = max(item.align for item in items) - 1
        self.layouts = [self._layout(phase) for phase in range(self.mask + 1)]
        self.sizes = np.array([layout.size for layout in self.layouts], np.int64)
        self.first_align = items[0].align

    def _layout(self, phase: int) -> _Layout:
        position = phase
        groups: list[list[tuple[str, FixedField, int]]] = []
        last = 0
        for number, item in enumerate(self.items):
            position = (position + item.align - 1) & -item.align
            if item.path is not None:
                if not groups or position - last > PADDING_BETWEEN:
                    groups.append([])
                groups[-1].append((str(number), item, position - phase))
                last = position + item.dtype.itemsize * (1 if item.count is None else item.count)
            position += item.dtype.itemsize * (1 if item.count is None else item.count)
        return _Layout(position - phase, [_structure(group) for group in groups])

    def run(self, frame: Frame, out: Columns) -> None:
        """Gather the run in all messages."""
        position = frame.position
        phase = uniform(position & self.mask)
        if isinstance(phase, int):
            layout = self.layouts[phase]
            frame.check_bounds(position + layout.size)
            self.take(frame, frame.origin + position, layout, out)
            frame.position = position + layout.size
        else:
            self._run_phases(frame, spread(position, len(frame)), phase, out)

    def _run_phases(self, frame: Frame, position: I64, phase: I64, out: Columns) -> None:
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

    def take(self, frame: Frame, at: I64, layout: _Layout, out: Columns) -> None:
        """The wanted items at these byte positions; they must fit."""
        times: dict[str, NDArray[np.int64]] = {}
        for first, structures in layout.groups:
            structs = gather(frame.buffer, at + first, structures[frame.order])
            for name in structs.dtype.names or ():
                item = self.items[int(name)]
                values = native(structs[name])
                if item.dtype == np.bool_:
                    values = values != 0
                if item.also is not None:
                    out[item.also] = values
                if item.part == "sec":
                    times[str(item.path)] = values.astype(np.int64) * SECOND_NS
                elif item.part:
                    out[str(item.path)] = times[str(item.path)] + values
                else:
                    out[str(item.path)] = values

    def stride(self, phase: int) -> int | None:
        """The size of one more run after itself, where that is the same every time."""
        size = self.layouts[phase].size
        return size if (phase + size) & self.mask == phase else None


def _structure(group: list[tuple[str, FixedField, int]]) -> tuple[int, dict[Order, np.dtype[Any]]]:
    first = group[0][2]
    structures: dict[Order, np.dtype[Any]] = {}
    for order in ORDERS:
        formats: list[Any] = []
        for _, item, _ in group:
            one = np.dtype(np.uint8) if item.dtype == np.bool_ else item.dtype.newbyteorder(order)
            formats.append(one if item.count is None else (one, (item.count,)))
        structures[order] = np.dtype(
            {
                "names": [name for name, _, _ in group],
                "formats": formats,
                "offsets": [at - first for _, _, at in group],
            }
        )
    return first, structures
