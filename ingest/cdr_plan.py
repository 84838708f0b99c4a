"""Message definitions compiled to column operations: fixed runs, texts and sequences.

Every operation reads its field in all messages of a frame at once and moves their cursors past
it. Only wanted fields are materialised; the others are stepped over, so that the cursor's end
still shows whether the definition fits.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from restock.ingest.cdr_frame import (
    ORDERS,
    UNTERMINATED,
    BadRows,
    Frame,
    Order,
    Position,
    gather_sequences,
    native,
    spread,
    texts,
    uniform,
)
from restock.ingest.columns import FieldColumn, Ragged, gather, join, offsets_of, take
from restock.ingest.definitions import TIMES, RosType
from restock.ingest.fields import DTYPES, CannotDecode, FieldType

Columns: TypeAlias = dict[str, FieldColumn]  # by field path

PADDING_BETWEEN = 64  # unwanted bytes that are gathered along with wanted ones around them
SECOND_NS = 1_000_000_000


class Operation(Protocol):
    """Reads one or more fields of all messages of a frame into `out`."""

    def run(self, frame: Frame, out: Columns) -> None: ...


@dataclass
class Plan:
    """The operations of one message type, in the order of its serialisation."""

    operations: list[Operation]
    paths: dict[str, tuple[str, tuple[int | None, ...]]]  # wanted -> kind, repetitions inside

    def run(self, frame: Frame) -> Columns:
        """The wanted fields of all messages of the frame; its cursor is then past the last field.

        Raises:
            BadRows: messages that end too early, or hold a text that is none.
        """
        out: Columns = {}
        for operation in self.operations:
            operation.run(frame, out)
        return out

    def empty(self) -> Columns:
        """The columns of no message."""
        return {path: empty_column(kind, dims) for path, (kind, dims) in self.paths.items()}


def empty_column(kind: str, dims: tuple[int | None, ...]) -> FieldColumn:
    """A column without rows, of the shape that rows would have."""
    dtype = {"string": np.dtype(object), "time": np.dtype(np.int64)}.get(kind) or DTYPES[kind]
    column: FieldColumn = np.zeros(0, dtype)
    for length in reversed(dims):
        column = wrap(column, length, 0, offsets_of(np.zeros(0, np.int64)))
    return column


def wrap(column: FieldColumn, length: int | None, rows: int, offsets: Any) -> FieldColumn:
    """Elements to rows: a fixed repetition of an array is a further axis, others are Ragged."""
    if length is not None and not isinstance(column, Ragged):
        return column.reshape(rows, length, *column.shape[1:])
    return Ragged(column, offsets)


@dataclass(frozen=True)
class Item:
    """One primitive, or a fixed array of them, in a run."""

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


class Run:
    """Consecutive fields of fixed size, gathered as structures."""

    def __init__(self, items: list[Item]) -> None:
        self.items = items
        self.mask = max(item.align for item in items) - 1
        self.layouts = [self._layout(phase) for phase in range(self.mask + 1)]
        self.sizes = np.array([layout.size for layout in self.layouts], np.int64)
        self.first_align = items[0].align

    def _layout(self, phase: int) -> _Layout:
        position = phase
        groups: list[list[tuple[str, Item, int]]] = []
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
        if isinstance(position, int):
            phase: Position = position & self.mask
        else:
            phase = uniform(position & self.mask)
        if isinstance(phase, int):
            layout = self.layouts[phase]
            frame.need(position + layout.size)
            self.take(frame, frame.origin + position, layout, out)
            frame.position = position + layout.size
        else:
            self._run_phases(frame, spread(position, len(frame)), phase, out)

    def _run_phases(self, frame: Frame, position: Any, phase: Any, out: Columns) -> None:
        stop = position + self.sizes[phase]
        frame.need(stop)
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

    def take(self, frame: Frame, at: Any, layout: _Layout, out: Columns) -> None:
        """The wanted items at these byte positions; they must fit."""
        times: dict[str, NDArray[np.int64]] = {}
        for first, structures in layout.groups:
            found = gather(frame.buffer, at + first, structures[frame.order])
            for name in found.dtype.names or ():
                item = self.items[int(name)]
                values = native(found[name])
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


def _structure(group: list[tuple[str, Item, int]]) -> tuple[int, dict[Order, np.dtype[Any]]]:
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


@dataclass
class Text:
    """A string: its length (CDR counts a terminating zero, ROS 1 has none), then its bytes."""

    path: str | None
    ros1: bool

    def run(self, frame: Frame, out: Columns) -> None:
        """Step over the strings, or decode them."""
        length = frame.word(1 if self.ros1 else 4)
        stop = frame.position + length
        frame.need(stop)
        start = frame.origin + frame.position
        if not self.ros1:
            # Some writers give an empty text no bytes at all, not even its zero.
            ends = frame.origin + stop - 1
            bad = (frame.buffer[np.maximum(ends, 0)] != 0) & (spread(length, len(frame)) > 0)
            if bad.any():
                raise BadRows(frame.rows[bad], UNTERMINATED)
            length = max(length - 1, 0) if isinstance(length, int) else np.maximum(length - 1, 0)
        if self.path is not None:
            out[self.path] = texts(frame, start, length)
        frame.position = stop


@dataclass
class Primitives:
    """A sequence of primitives."""

    dtype: np.dtype[Any]
    path: str | None
    ros1: bool

    def run(self, frame: Frame, out: Columns) -> None:
        """Step over the sequences, or gather them."""
        count = frame.word(1 if self.ros1 else 4)
        size = self.dtype.itemsize
        if size > 4 and not self.ros1:
            # An empty sequence takes no padding.
            aligned = (frame.position + (size - 1)) & -size
            if isinstance(count, int):
                frame.position = aligned if count else frame.position
            else:
                frame.position = np.where(count > 0, aligned, frame.position)
        stop = frame.position + count * size
        frame.need(stop)
        if self.path is not None:
            boolean = self.dtype == np.bool_
            dtype = np.dtype(np.uint8) if boolean else self.dtype.newbyteorder(frame.order)
            at = frame.origin + frame.position
            found = gather_sequences(frame.buffer, at, count, dtype)
            if boolean and not isinstance(found.values, Ragged):
                found = Ragged(found.values != 0, found.offsets)
            out[self.path] = found
        frame.position = stop


@dataclass
class Repeat:
    """A sequence or fixed array of messages, or of texts: the inner plan, once per element."""

    inner: Plan
    length: int | None  # of a fixed array
    ros1: bool
    names: list[str] = field(default_factory=list)

    @cached_property
    def _only_run(self) -> Run | None:
        operations = self.inner.operations
        only = operations[0] if len(operations) == 1 else None
        return only if isinstance(only, Run) else None

    def run(self, frame: Frame, out: Columns) -> None:
        """All elements of all messages, as far as possible at once."""
        count = self.length if self.length is not None else frame.word(1 if self.ros1 else 4)
        counts = spread(count, len(frame))
        # An element takes at least a byte: refuse counts that cannot be, before allocating.
        frame.need(frame.position + count)
        offsets = offsets_of(counts)
        if offsets[-1] == 0:
            elements = self.inner.empty()
        else:
            fixed = self._fixed(frame, counts, offsets)
            if fixed is None:
                fixed = _Elements(self.inner, frame, counts, offsets).read()
            elements = fixed
        for path, column in elements.items():
            out[path] = wrap(column, self.length, len(frame), offsets)

    def _fixed(self, frame: Frame, counts: Any, offsets: Any) -> Columns | None:
        """Elements of one fixed size lie at known places: one gather for all of them."""
        run = self._only_run
        if run is None:
            return None
        aligned = (frame.position + (run.first_align - 1)) & -run.first_align
        if isinstance(aligned, int):
            phase: Position = aligned & run.mask
        else:
            phase = uniform(aligned & run.mask)
        stride = run.stride(phase) if isinstance(phase, int) else None
        if stride is None or not isinstance(phase, int):
            return None
        stop = np.where(counts > 0, aligned + counts * stride, frame.position)
        frame.need(stop)
        within = np.arange(offsets[-1]) - np.repeat(offsets[:-1], counts)
        at = np.repeat(frame.origin + aligned, counts) + within * stride
        found: Columns = {}
        run.take(frame, at, run.layouts[phase], found)
        frame.position = uniform(stop)
        return found


class _Elements:
    """Elements of varying size: where the next one starts is known when this one has been read.

    The first two of every message are read one after the other. The rest are then guessed to be
    as long as the second, and read all at once: a guess is right where every element ends just
    where the next was thought to start. Messages where it was wrong go on one by one.
    """

    def __init__(self, inner: Plan, frame: Frame, counts: Any, offsets: Any) -> None:
        self.inner, self.frame = inner, frame
        self.counts, self.offsets = counts, offsets
        self.position = spread(frame.position, len(frame)).copy()
        self.places: list[Any] = []  # of the elements that were read, in the answer
        self.parts: list[Columns] = []

    def read(self) -> Columns:
        """All elements, in order; the frame's cursor is then past the last."""
        most = int(self.counts.max())
        left = self.counts.copy()
        step = 0
        while (rows := np.nonzero(left > 0)[0]).size:
            before = self.position[rows]
            self._read_one(rows, self.counts[rows] - left[rows])
            left[rows] -= 1
            step += 1
            if step == 2 and most > 4:
                stride = np.zeros(len(left), np.int64)
                stride[rows] = self.position[rows] - before
                left[self._guess(np.nonzero(left > 0)[0], left, stride)] = 0
        self.frame.position = uniform(self.position)
        place = np.concatenate(self.places)
        if len(self.parts) == 1 and (np.diff(place) == 1).all():
            return self.parts[0]
        back = np.argsort(place, kind="stable")
        return {
            path: take(join([part[path] for part in self.parts]), back) for path in self.parts[0]
        }

    def _read_one(self, rows: NDArray[np.intp], number: Any) -> None:
        frame = self.frame.select(rows, uniform(self.position[rows]))
        self.parts.append(self.inner.run(frame))
        self.places.append(self.offsets[rows] + number)
        self.position[rows] = frame.position

    def _guess(self, rows: NDArray[np.intp], left: Any, stride: Any) -> NDArray[np.intp]:
        """Read what is left of these messages by the guess; the rows where it was right."""
        none = np.zeros(0, np.intp)
        if not rows.size:
            return none
        counts = left[rows]
        starts = offsets_of(counts)
        within = np.arange(starts[-1]) - np.repeat(starts[:-1], counts)
        which = np.repeat(np.arange(len(rows)), counts)
        position = self.position[rows][which] + within * stride[rows][which]
        frame = self.frame.select(rows[which], position)
        try:
            found = self.inner.run(frame)
        except BadRows:
            return none
        stop = spread(frame.position, len(position))
        right = np.ones(len(position), np.bool_)
        right[:-1] = (stop[:-1] == position[1:]) | (which[:-1] != which[1:])
        whole = np.logical_and.reduceat(right, starts[:-1])
        elements = np.nonzero(whole[which])[0]
        if not elements.size:
            return none
        self.parts.append({path: take(column, elements) for path, column in found.items()})
        place = self.offsets[rows][which] + (self.counts[rows] - counts)[which] + within
        self.places.append(place[elements])
        good: NDArray[np.intp] = rows[whole]
        self.position[good] = stop[starts[1:] - 1][whole]
        return good


class _Compiler:
    """Walks a definition and collects its operations."""

    def __init__(self, message: RosType, wanted: Collection[str], ros1: bool) -> None:
        self.message, self.wanted, self.ros1 = message, wanted, ros1

    def plan(self, name: str, prefix: str) -> Plan:
        """The plan of a message whose fields' paths start with `prefix`."""
        plan = Plan([], {})
        run: list[Item] = []
        self._message(name, prefix, plan, run)
        self._close(plan, run)
        return plan

    def _close(self, plan: Plan, run: list[Item]) -> None:
        if run:
            plan.operations.append(Run(list(run)))
            run.clear()

    def _message(self, name: str, prefix: str, plan: Plan, run: list[Item]) -> None:
        fields = self.message.fields_of(name)
        if not fields and not self.ros1:  # C and C++ know no empty structure: a byte stands in
            run.append(Item(np.dtype(np.uint8), None, 1, None))
        for part in fields:
            self._field(part, prefix + part.name, plan, run)

    def _field(self, part: FieldType, path: str, plan: Plan, run: list[Item]) -> None:
        wanted = self._wanted(path)
        if part.base and part.base != "string":
            dtype = DTYPES[part.base]
            if part.many is None or part.many.length is not None:
                count = part.many.length if part.many else None
                run.append(self._item(dtype, count, wanted))
                self._note(plan, wanted, part.base, () if count is None else (count,))
                return
            self._close(plan, run)
            plan.operations.append(Primitives(dtype, wanted, self.ros1))
            self._note(plan, wanted, part.base, (None,))
        elif part.many:
            self._repeat(part, path, plan, run)
        elif part.base:
            self._close(plan, run)
            plan.operations.append(Text(wanted, self.ros1))
            self._note(plan, wanted, "string", ())
        elif part.message in TIMES:
            self._time(str(part.message), path, ".", plan, run)
        else:
            self._message(str(part.message), path + ".", plan, run)

    def _repeat(self, part: FieldType, path: str, plan: Plan, run: list[Item]) -> None:
        length = part.many.length if part.many else None
        self._close(plan, run)
        if part.base:
            wanted = self._wanted(path)
            inner = Plan([Text(wanted, self.ros1)], {})
            self._note(inner, wanted, "string", ())
        elif part.message in TIMES:
            inner, inside = Plan([], {}), list[Item]()
            self._time(str(part.message), path, "[].", inner, inside)
            self._close(inner, inside)
        else:
            inner = self.plan(str(part.message), path + "[].")
        plan.operations.append(Repeat(inner, length, self.ros1))
        for inner_path, (kind, dims) in inner.paths.items():
            plan.paths[inner_path] = (kind, (length, *dims))

    def _time(self, name: str, path: str, dot: str, plan: Plan, run: list[Item]) -> None:
        """Its two fields; wanted as nanoseconds of both, or each by its own path, or all."""
        fields = self.message.fields_of(name)
        bases = [field.base for field in fields]
        if len(fields) != 2 or not all(base in ("int32", "uint32") for base in bases):
            raise CannotDecode(f"{name} is defined otherwise than everywhere")
        whole = self._wanted(path)
        for part, one in zip(("sec", "nanosec"), fields, strict=True):
            dtype = DTYPES[str(one.base)]
            align = 1 if self.ros1 else 4
            own = self._wanted(path + dot + one.name)
            if whole is not None:
                run.append(Item(dtype, None, align, whole, part, own))
            else:
                run.append(Item(dtype, None, align, own))
            self._note(plan, own, str(one.base), ())
        self._note(plan, whole, "time", ())

    def _item(self, dtype: np.dtype[Any], count: int | None, wanted: str | None) -> Item:
        return Item(dtype, count, 1 if self.ros1 else dtype.itemsize, wanted)

    def _wanted(self, path: str) -> str | None:
        return path if path in self.wanted else None

    def _note(
        self, plan: Plan, wanted: str | None, kind: str, dims: tuple[int | None, ...]
    ) -> None:
        if wanted is not None:
            plan.paths[wanted] = (kind, dims)


def compile_plan(message: RosType, wanted: Iterable[str], *, ros1: bool = False) -> Plan:
    """The plan that reads these leaf paths of a message type (each as `Leaf.path` gives it).

    Raises:
        CannotDecode: the type uses something that cannot be read.
    """
    return _Compiler(message, frozenset(wanted), ros1).plan(message.name, "")
