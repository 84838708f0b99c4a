"""Where a batch of messages is being read: a cursor per message, and gathers from one buffer.

A cursor that is the same for all messages is one int, not an array: as long as messages are laid
out alike, as most of a topic's are, position arithmetic costs nothing.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.ingest.decoding.columns import FieldColumn, Ragged, gather, offsets_of

Order: TypeAlias = Literal["<", ">"]
ORDERS: tuple[Order, Order] = ("<", ">")
Position: TypeAlias = "int | Ints"
Columns: TypeAlias = dict[str, FieldColumn]  # by field path

TOO_SHORT = "mis-sized: it ends before its last field"
TOO_LONG = "mis-sized: bytes are left after its last field"
NOT_TEXT = "text that is not valid UTF-8"
UNTERMINATED = "text without its terminating zero"
_LOOP_BYTES = 512  # rows longer than this are copied one by one: cheaper than an index per value


class BadRows(Exception):
    """Messages (their rows in the batch) that do not decode, and why."""

    def __init__(self, rows: NDArray[np.intp], reason: str) -> None:
        super().__init__(reason)
        self.rows, self.reason = rows, reason


class TextBuffer:
    """A buffer that holds little but these messages, as one text, made when it is first needed.

    Slicing it takes a third of the time of copying and decoding bytes.
    """

    def __init__(self, buffer: NDArray[np.uint8]) -> None:
        base: Any = buffer.base
        self._whole: bytes | None = base if isinstance(base, bytes) else None
        self._text: str | None = None

    def texts(self, at: Ints, stop: Ints) -> list[str] | None:
        """The texts at these places; None where they are not all ASCII, or not in such a buffer."""
        if self._whole is None:
            return None
        if self._text is None:
            self._text = self._whole.decode("latin-1")  # which never fails
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
        self.origin = origin  # (N,) of the message's first byte in the buffer: alignment is from it
        self.end = end  # (N,) of the message, from its origin
        self.rows = rows  # (N,) of the message in the batch
        self.position = position  # from the origin

    def __len__(self) -> int:
        return len(self.origin)

    def select(self, rows: NDArray[np.intp], position: Position) -> Frame:
        """Some of the messages (or some of them several times), at these positions."""
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
        """Read a uint32: one int where all messages have the same."""
        if align > 1:
            self.align(4)
        self.check_bounds(self.position + 4)
        words = gather(self.buffer, self.origin + self.position, np.dtype(self.order + "u4"))
        self.position = self.position + 4
        return uniform(words.astype(np.int64))


def uniform(values: Position) -> Position:
    """One int where all values are the same."""
    if isinstance(values, int):
        return values
    if len(values) and (values == values[0]).all():
        return int(values[0])
    return values


def spread(value: Position, count: int) -> Ints:
    """An array of `count`, whatever it was."""
    return np.full(count, value, np.int64) if isinstance(value, int) else value


def native(values: NDArray[Any]) -> NDArray[Any]:
    """The same values in this machine's byte order."""
    return values if values.dtype.isnative else values.astype(values.dtype.newbyteorder("="))


def gather_sequences(
    buffer: NDArray[np.uint8], at: Ints, counts: Position, dtype: np.dtype[Any]
) -> Ragged:
    """`counts` consecutive values of `dtype` from each byte position."""
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
    """Texts of these byte lengths as an object array of str, (N,)."""
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
    """Each distinct text is decoded, and made, once."""
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
