"""Salvages damaged `.db3` files: reads the messages in whole pages, and counts the others.

SQLite itself stops at the first damage.

A leaf page of a table is recognised by its structure, wherever it is, and a row by its columns. If
pages were inserted or removed, the page numbers in the file are wrong. The interior pages, which
name the leaf of each row number, show by how much. See https://www.sqlite.org/fileformat2.html.
"""

from __future__ import annotations

import itertools
import struct
import tempfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from restock.arrays import Bools, Ints
from restock.errors import RecordingError
from restock.ingest.containers.storage import Damage, Storage
from restock.ingest.decoding.columns import Channel, MessageBatch, PendingBatch

LEAF, INTERIOR = 0x0D, 0x05  # first byte of a table's pages, by their kind
MIN_CELL = 4  # bytes of the shortest row
INT_SIZES = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}  # serial type -> bytes of an integer


class Cell(NamedTuple):
    """A row in a leaf page."""

    rowid: int
    types: tuple[int, ...]  # serial types of the columns
    body: int  # offset of the columns in the payload
    size: int  # bytes of the whole payload
    local: bytes  # the part of the payload in this page
    overflow: int  # the page with the next part; 0: none


class NotAPage(Exception):
    """A page that is not an intact page of a table."""


@dataclass(frozen=True)
class Moves:
    """How far pages moved: the file's page `named[i]` (ascending) is at `named[i] + by[i]`."""

    named: Ints
    by: Ints

    def of(self, page: int) -> int | None:
        """Return how far a page moved; None if its neighbours moved differently."""
        if not len(self.named):
            return 0
        at = int(np.searchsorted(self.named, page))
        around = {int(self.by[near]) for near in (at - 1, at) if 0 <= near < len(self.by)}
        return around.pop() if len(around) == 1 else None


class Pages:
    """The pages of a sqlite file, read one by one."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        head = self._file.read(100)
        size = int.from_bytes(head[16:18], "big")
        self.page_size = 65536 if size == 1 else size
        if self.page_size < 512 or self.page_size & (self.page_size - 1):
            self.page_size = 4096  # the default, as the header is damaged
        self.usable = self.page_size - (head[20] if head[20] < 32 else 0)
        self.count = path.stat().st_size // self.page_size

    def page(self, number: int) -> bytes:
        """Read a page; the first is number 1."""
        self._file.seek((number - 1) * self.page_size)
        return self._file.read(self.page_size)

    def tables(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield number, kind and content of every page that starts like a page of a table."""
        for number in range(1, self.count + 1):
            content = self.page(number)
            kind = content[0] if number > 1 and content else 0
            if kind in (LEAF, INTERIOR):
                yield number, kind, content

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def cells(self, page: bytes) -> list[Cell]:
        """Parse the rows of a leaf page.

        Raises:
            NotAPage: it does not have the structure of a leaf page.
        """
        cells = [self.cell(page, at) for at in _pointers(page, 8)]
        if any(left.rowid >= right.rowid for left, right in itertools.pairwise(cells)):
            raise NotAPage
        return cells

    def cell(self, page: bytes, at: int) -> Cell:
        """Parse the row at an offset in a leaf page."""
        size, start = _varint(page, at)
        rowid, start = _varint(page, start)
        rowid -= (rowid >> 63) << 64
        most = self.usable - 35
        local = size
        if size > most:
            least = (self.usable - 12) * 32 // 255 - 23
            local = least + (size - least) % (self.usable - 4)
            local = local if local <= most else least
        stop = start + local
        if stop + (4 if local < size else 0) > self.usable:
            raise NotAPage
        content = page[start:stop]
        overflow = int.from_bytes(page[stop : stop + 4], "big") if local < size else 0
        return Cell(rowid, *_types(content, size), size, content, overflow)

    def payload(self, cell: Cell, moves: Moves, taken: Bools) -> bytes | None:
        """Read a row's whole content; None if a page of it is missing or may belong elsewhere.

        `taken` marks the pages that are in use; those of this row are added.
        """
        parts, left, number = [cell.local], cell.size - len(cell.local), cell.overflow
        used = list[int]()
        while left:
            by = moves.of(number)
            place = number + by if by is not None else 0
            if 1 < place <= self.count and not taken[place]:
                taken[place] = True
                used.append(place)
                page = self.page(place)
                number = int.from_bytes(page[:4], "big")
                parts.append(page[4 : min(self.usable, left + 4)])
                left -= len(parts[-1])
                if bool(left) == bool(number):
                    continue
            taken[used] = False
            return None
        return b"".join(parts)


def children(page: bytes) -> list[tuple[int, int]]:
    """Return the pages below an interior page, each with the last row number it may hold.

    Raises:
        NotAPage: it does not have the structure of an interior page.
    """
    found = []
    for at in _pointers(page, 12):
        if at + 4 >= len(page):
            raise NotAPage
        found.append((int.from_bytes(page[at : at + 4], "big"), _varint(page, at + 4)[0]))
    if any(left[1] >= right[1] for left, right in itertools.pairwise(found)):
        raise NotAPage
    return found


def find_moves(leaves: list[tuple[int, int]], interiors: list[list[tuple[int, int]]]) -> Moves:
    """Find how far pages moved, from the leaves (last row number, page) and interior pages.

    Only interior pages right above leaves are used: they give each leaf's page number with its
    last row number, by which the leaf is recognised.
    """
    leaves = sorted(leaves)
    place = {last: (order, page) for order, (last, page) in enumerate(leaves)}
    named: dict[int, int] = {}
    for below in interiors:
        known = [(child, *place[key]) for child, key in below if key in place]
        for one, (child, order, page) in enumerate(known):
            beside = one and order == known[one - 1][1] + 1
            beside = beside or (one + 1 < len(known) and known[one + 1][1] == order + 1)
            if child == page or beside:
                named[child] = page - child
    items = sorted(named.items())
    pages, by = zip(*items, strict=True) if items else ((), ())
    return Moves(np.array(pages, np.int64), np.array(by, np.int64))


def integer(cell: Cell, column: int) -> int | None:
    """Read the integer in a column of a row; None if it holds something else."""
    at = cell.body + sum(map(_size, cell.types[:column]))
    kind = cell.types[column]
    if kind not in INT_SIZES or at + INT_SIZES[kind] > len(cell.local):
        return None
    return (
        kind - 8
        if kind in (8, 9)
        else int.from_bytes(cell.local[at : at + INT_SIZES[kind]], "big", signed=True)
    )


def column(cell: Cell, payload: bytes, number: int) -> bytes:
    """Return the bytes of a text or blob column."""
    at = cell.body + sum(map(_size, cell.types[:number]))
    return payload[at : at + _size(cell.types[number])]


def _pointers(page: bytes, start: int) -> tuple[int, ...]:
    count = int.from_bytes(page[3:5], "big")
    if not count or start + 2 * count > len(page):
        raise NotAPage
    places: tuple[int, ...] = struct.unpack_from(f">{count}H", page, start)
    if min(places) < start + 2 * count or max(places) + MIN_CELL > len(page):
        raise NotAPage
    return places


def _types(content: bytes, size: int) -> tuple[tuple[int, ...], int]:
    """Read the types of a record's columns, and where the columns start."""
    stop, at = _varint(content, 0)
    if not at <= stop <= len(content):
        raise NotAPage
    types = []
    while at < stop:
        kind, at = _varint(content, at)
        types.append(kind)
    if at != stop or stop + sum(map(_size, types)) != size:
        raise NotAPage
    return tuple(types), stop


def _size(kind: int) -> int:
    if kind >= 12:
        return (kind - 12) // 2
    return 8 if kind == 7 else INT_SIZES.get(kind, 0)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Read an integer of one to nine bytes; also return where it ends."""
    value = 0
    for place in range(at, min(at + 8, len(data))):
        byte = data[place]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, place + 1
    if at + 9 > len(data):
        raise NotAPage
    return value << 8 | data[at + 8], at + 9


BYTES_PER_BATCH = 8 << 20
MAX_MESSAGE = 256 << 20
PIECE_ROWS = 4096


class SalvagedSqliteFile(Storage):
    """A damaged sqlite3 storage file, of which every row in an intact page is read.

    A row that is in several pages counts once. rosbag2 numbers rows without gaps, so the numbers
    show how many are missing.

    Raises:
        RecordingError: no topic can be found in it.
    """

    def __init__(
        self, path: Path, what: str, copy: tempfile.TemporaryDirectory[str] | None = None
    ) -> None:
        super().__init__()
        self.path, self._copy = path, copy  # a private copy includes the rows of a `-wal` file
        self.damaged(what)
        # One entry for all calls of `batches`, as each finds the losses of its topics again.
        self._unread = Damage("their pages are missing, damaged or too many")
        self._pages = Pages(Path(copy.name) / path.name if copy else path)
        self._taken = np.zeros(self._pages.count + 2, np.bool_)
        self._texts: list[Cell] = []  # rows of `topics` and `message_definitions`
        self._last = 0  # highest row number in the interior pages
        rows = self._survey()
        self.channels = self._channels()
        if not self.channels:
            self.close()
            raise RecordingError(
                f"{what}; and no topic can be found in what is left of it", where=str(path)
            )
        self._rows = self._drop_unknown_topics(rows)
        topics, counts = np.unique(self._rows[:, 1], return_counts=True)
        self.counts = dict.fromkeys(self.channels, 0)
        self.counts |= dict(zip(topics.tolist(), counts.tolist(), strict=True))
        stamps = self._rows[:, 2]
        self.span_ns = (int(stamps.min()), int(stamps.max())) if len(stamps) else None

    def _survey(self) -> Ints:
        """Return messages' row number, topic id, log time, page and index in the page, (N, 5)."""
        pieces, rows = [np.zeros((0, 5), np.int64)], list[tuple[int, int, int, int, int]]()
        leaves, interiors = list[tuple[int, int]](), list[list[tuple[int, int]]]()
        for number, kind, page in self._pages.tables():
            try:
                if kind == INTERIOR:
                    interiors.append(children(page))
                    continue
                cells = self._pages.cells(page)
            except NotAPage:
                continue
            self._taken[number] = True
            rows += self._messages(cells, number)
            if _is_message(cells[0].types):
                leaves.append((cells[-1].rowid, number))
            if len(rows) >= PIECE_ROWS:
                pieces.append(np.array(rows, np.int64))
                rows = []
        if rows:
            pieces.append(np.array(rows, np.int64))
        self._moves = find_moves(leaves, interiors)
        lasts = {last for last, _ in leaves}
        above = [below for below in interiors if any(key in lasts for _, key in below)]
        self._last = max((below[-1][1] for below in above), default=0)
        return np.concatenate(pieces)

    def _messages(self, cells: list[Cell], page: int) -> Iterator[tuple[int, int, int, int, int]]:
        """Yield the messages of a leaf page; keep the rows of other tables in `_texts`."""
        for place, cell in enumerate(cells):
            if _is_message(cell.types):
                topic, stamp = integer(cell, 1), integer(cell, 2)
                if topic is not None and stamp is not None:
                    yield cell.rowid, topic, stamp, page, place
            elif (
                len(cell.types) >= 3
                and cell.types[0] == 0
                and all(kind >= 13 and kind % 2 for kind in cell.types[1:])
            ):
                self._texts.append(cell)

    def _channels(self) -> dict[int, Channel]:
        topics = dict[int, tuple[str, ...]]()
        definitions = dict[str, tuple[str, bytes]]()
        taken = self._taken.copy()
        for cell in self._texts:
            payload = self._pages.payload(cell, self._moves, taken)
            if payload is None:
                continue
            texts = [column(cell, payload, at) for at in range(1, len(cell.types))]
            words = [text.decode("utf-8", "backslashreplace") for text in texts[:3]]
            if "/" in words[1]:
                topics.setdefault(cell.rowid, (*words[:2], words[2] if len(words) > 2 else "cdr"))
            elif len(texts) >= 3:
                definitions.setdefault(words[0], (words[1], texts[2]))
        return {
            number: Channel(number, name, kind, encoding, *definitions.get(kind, ("", b"")))
            for number, (name, kind, encoding) in topics.items()
        }

    def _drop_unknown_topics(self, rows: Ints) -> Ints:
        """Return the messages of known topics in the order of row numbers; the rest is damage."""
        _, first = np.unique(rows[:, 0], return_index=True)
        rows = rows[first]
        named = np.isin(rows[:, 1], list(self.channels))
        if lost := int((~named).sum()):
            self.damaged(f"{lost:,} messages of topics without a name", {-1: lost})
        last = max(self._last, int(rows[-1, 0]) if len(rows) else 0)
        missing = last - int((rows[:, 0] > 0).sum())
        room = self._pages.count * self._pages.page_size // MIN_CELL
        if missing > 0 and last <= room:
            what = f"at least {missing:,} messages are missing, by their row numbers"
            self.damaged(what, {-1: missing})
        return rows[named]

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """Yield the messages in one pass in the order of row numbers, the order of arrival."""
        pending: dict[int, PendingBatch] = {}
        size, lost, wanted = 0, dict[int, int](), list(channels)
        taken = self._taken.copy()
        page, cells = 0, list[Cell]()
        for _, topic, stamp, number, place in self._rows[np.isin(self._rows[:, 1], wanted)]:
            if number != page:
                page, cells = int(number), self._pages.cells(self._pages.page(int(number)))
            whole = cells[place].size <= MAX_MESSAGE
            payload = self._pages.payload(cells[place], self._moves, taken) if whole else None
            if payload is None:
                lost[int(topic)] = lost.get(int(topic), 0) + 1
                continue
            data, at = column(cells[place], payload, 3), np.array([stamp])
            pending.setdefault(int(topic), PendingBatch()).add([data], at, at)
            size += len(data) + 64
            if size >= BYTES_PER_BATCH:
                yield from ((channel, some.batch()) for channel, some in pending.items())
                pending, size = {}, 0
        yield from ((channel, some.batch()) for channel, some in pending.items())
        self._unread.messages |= {
            topic: max(count, self._unread.messages.get(topic, 0)) for topic, count in lost.items()
        }
        if lost and self._unread not in self.damage:
            self.damage.append(self._unread)

    def close(self) -> None:
        """Close the file and remove the private copy, if there was one."""
        self._pages.close()
        if self._copy:
            self._copy.cleanup()


def _is_message(types: tuple[int, ...]) -> bool:
    """Return whether a row is of `messages`: a null for its id, a topic, a log time, a blob."""
    return (
        len(types) == 4
        and types[0] == 0
        and types[1] in INT_SIZES
        and types[2] in INT_SIZES
        and types[3] >= 12  # even: a blob; odd: a text
        and types[3] % 2 == 0
    )
