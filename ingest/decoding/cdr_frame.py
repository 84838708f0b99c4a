"""Reads CDR fields of many messages at once: a cursor per message, and gathers from one buffer.

If the cursor is the same for all messages, it is one int and not an array. Most messages of a topic
have the same layout, so that computing positions costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.ingest.decoding.columns import FieldColumn, Ragged, gather, join, offsets_of, take

Order: TypeAlias = Literal["<", ">"]
ORDERS: tuple[Order, Order] = ("<", ">")
Position: TypeAlias = "int | Ints"
Columns: TypeAlias = dict[str, FieldColumn]  # by field path

TOO_SHORT = "mis-sized: it ends before its last field"
TOO_LONG = "mis-sized: bytes are left after its last field"
NOT_TEXT = "text that is not valid UTF-8"
UNTERMINATED = "text without its terminating zero"
_LOOP_BYTES = 512  # rows with more bytes on average are copied one by one, which is faster then


class BadRows(Exception):
    """Messages (rows of the batch) that cannot be decoded, and the reason."""

    def __init__(self, rows: NDArray[np.intp], reason: str) -> None:
        super().__init__(reason)
        self.rows, self.reason = rows, reason


class TextBuffer:
    """The buffer of some messages as one text, decoded on first use.

    Slicing it takes a third of the time of copying and decoding bytes. Only a buffer made from a
    `bytes` object has a text: it contains little besides the messages.
    """

    def __init__(self, buffer: NDArray[np.uint8]) -> None:
        base: Any = buffer.base
        self._whole: bytes | None = base if isinstance(base, bytes) else None
        self._text: str | None = None

    def texts(self, at: Ints, stop: Ints) -> list[str] | None:
        """Return the texts at these positions; None if one is not ASCII, or there is no text."""
        if self._whole is None:
            return None
        if self._text is None:
            self._text = self._whole.decode("latin-1")  # never fails
        whole = self._text
        pieces = [whole[a:b] for a, b in zip(at.tolist(), stop.tolist(), strict=True)]
        if not "".join(pieces).isascii():
            return None
        known: dict[str, str] = {}
        return [known.setdefault(piece, piece) for piece in pieces]  # one object for equal texts


class Frame:
    """N messages, or N elements of a sequence in them, being read at the same time."""

    __slots__ = ("buffer", "end", "order", "origin", "position", "rows", "text_buffer")

    def __init__(
        self,
        buffer: NDArray[np.uint8],
        order: Order,
        origin: Ints,
        end: Ints,
        rows: NDArray[np.intp],
        position: Position,
        text_buffer: TextBuffer | None = None,
    ) -> None:
        self.buffer = buffer
        self.text_buffer = text_buffer or TextBuffer(buffer)
        self.order = order  # "<" or ">"
        self.origin = origin  # (N,) first byte of each message in the buffer; fields align to it
        self.end = end  # (N,) end of each message, in bytes from `origin`
        self.rows = rows  # (N,) row of the message in the batch
        self.position = position  # cursor, in bytes from `origin`

    def __len__(self) -> int:
        return len(self.origin)

    def select(self, rows: NDArray[np.intp], position: Position) -> Frame:
        """Return a frame of these messages (repeats allowed) with the cursor at `position`."""
        return Frame(
            self.buffer,
            self.order,
            self.origin[rows],
            self.end[rows],
            self.rows[rows],
            position,
            self.text_buffer,
        )

    def check_bounds(self, stop: Position) -> None:
        """Refuse the messages that end before `stop`."""
        bad = self.end < stop
        if bad.any():
            raise BadRows(self.rows[bad], TOO_SHORT)

    def align(self, size: int) -> None:
        """Advance to a multiple of `size` (a power of two)."""
        self.position = (self.position + (size - 1)) & -size

    def read_uint32(self, align: int) -> Position:
        """Read a uint32 from each message; return one int if all are the same."""
        if align > 1:
            self.align(4)
        self.check_bounds(self.position + 4)
        words = gather(self.buffer, self.origin + self.position, np.dtype(self.order + "u4"))
        self.position = self.position + 4
        return uniform(words.astype(np.int64))


def uniform(values: Position) -> Position:
    """Return one int if all values are the same, else the values."""
    if isinstance(values, int):
        return values
    if len(values) and (values == values[0]).all():
        return int(values[0])
    return values


def spread(value: Position, count: int) -> Ints:
    """Return an array of `count` values, from one int or an array."""
    return np.full(count, value, np.int64) if isinstance(value, int) else value


def native(values: NDArray[Any]) -> NDArray[Any]:
    """Convert values to this machine's byte order."""
    return values if values.dtype.isnative else values.astype(values.dtype.newbyteorder("="))


def gather_sequences(
    buffer: NDArray[np.uint8], at: Ints, counts: Position, dtype: np.dtype[Any]
) -> Ragged:
    """Gather `counts` consecutive values of `dtype` from each byte position."""
    if isinstance(counts, int):
        if counts == 0:
            return Ragged(np.zeros(0, dtype.newbyteorder("=")), np.zeros(len(at) + 1, np.int64))
        values = gather(buffer, at, np.dtype((dtype, (counts,)))).reshape(-1)
        return Ragged(native(values), np.arange(len(at) + 1, dtype=np.int64) * counts)
    offsets = offsets_of(counts)
    size = dtype.itemsize
    total = int(offsets[-1])
    if total * size > _LOOP_BYTES * len(at):
        out = np.empty(total * size, np.uint8)
        bounds = (offsets * size).tolist()
        for row, start in enumerate(at.tolist()):
            low, high = bounds[row], bounds[row + 1]
            out[low:high] = buffer[start : start + high - low]
        return Ragged(native(out.view(dtype)), offsets)
    each = np.repeat(at - offsets[:-1] * size, counts) + np.arange(total) * size
    return Ragged(native(gather(buffer, each, dtype)), offsets)


def texts(frame: Frame, at: Ints, lengths: Position) -> FieldColumn:
    """Read texts of these byte lengths as an object array of str, (N,)."""
    count = len(at)
    out = np.empty(count, object)
    if not count:
        return out
    if isinstance(lengths, int):
        if lengths == 0:
            out[:] = ""
            return out
        raw = gather(frame.buffer, at, np.dtype((np.void, lengths)))
        if (
            count > 1
            and (
                raw.view(np.uint8).reshape(count, -1) == frame.buffer[at[0] : at[0] + lengths]
            ).all()
        ):
            out[:] = _decode(raw[:1].tolist(), frame, {})[0]
            return out
    stop = at + lengths
    strings = frame.text_buffer.texts(at, stop)
    if strings is None:
        view = frame.buffer.data
        bounds = zip(at.tolist(), stop.tolist(), strict=True)
        strings = _decode([bytes(view[a:b]) for a, b in bounds], frame, {})
    out[:] = strings
    return out


def _decode(pieces: list[bytes], frame: Frame, known: dict[bytes, str]) -> list[str]:
    """Decode each distinct text once."""
    decoded = []
    for row, piece in enumerate(pieces):
        text = known.get(piece)
        if text is None:
            try:
                text = known[piece] = piece.decode()
            except UnicodeDecodeError:
                raise BadRows(frame.rows[row : row + 1], NOT_TEXT) from None
        decoded.append(text)
    return decoded


PADDING_BETWEEN = 64  # most bytes between wanted fields that are gathered together
SECOND_NS = 1_000_000_000


@dataclass(frozen=True)
class FixedField:
    """A field of fixed size: a primitive, or a fixed array of primitives."""

    dtype: np.dtype[Any]  # in any byte order: the messages' is set later
    count: int | None  # length of a fixed array; None: one value
    align: int
    path: str | None  # None: not wanted
    part: str = ""  # "sec" or "nanosec" of the time at `path`

    @property
    def size(self) -> int:
        """Return the size of all its values in bytes."""
        return self.dtype.itemsize * (1 if self.count is None else self.count)


@dataclass
class _Layout:
    """The layout of fields for one starting phase (the cursor modulo the alignment)."""

    size: int  # bytes from the cursor to the end of the last field, with padding before the first
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
        """Gather the wanted fields at byte positions `at`; the caller has checked the bounds."""
        times: dict[str, NDArray[np.int64]] = {}
        for first, structures in layout.groups:
            structs = gather(frame.buffer, at + first, structures[frame.order])
            for name in structs.dtype.names or ():
                field = self.fields[int(name)]
                values = native(structs[name])
                if field.dtype == np.bool_:
                    values = values != 0
                if field.part == "sec":
                    times[str(field.path)] = values.astype(np.int64) * SECOND_NS
                elif field.part:
                    out[str(field.path)] = times[str(field.path)] + values
                else:
                    out[str(field.path)] = values

    def stride(self, phase: int) -> int | None:
        """Return the bytes from one element of these fields to the next; None if that varies."""
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
