"""What a cut or damaged `.db3` file still holds: the messages in its whole pages, and a count of
those that are missing. SQLite itself stops at the first damage.
"""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from restock.arrays import Ints
from restock.errors import RecordingError
from restock.ingest.containers.formats.sqlite_pages import (
    INT_SIZES,
    INTERIOR,
    MIN_CELL,
    Cell,
    NotAPage,
    Pages,
    children,
    column,
    integer,
    is_blob,
    is_text,
    moves_of,
)
from restock.ingest.containers.storage import Damage, Extra, Integrity, Metadata, Packed
from restock.ingest.decoding.messages import Channel, MessageBatch, PendingBatch

BYTES_PER_BATCH = 8 << 20
MAX_MESSAGE = 256 << 20
PIECE_ROWS = 4096


class SalvagedSqliteFile:
    """A damaged sqlite3 storage file, of which every row in a whole page is read.

    Rows that lie in the pages more than once count once. rosbag2 numbers its rows one by one: by
    their numbers it shows how many are missing.

    Raises:
        RecordingError: no topic can be found in it.
    """

    from_ros2 = True

    def __init__(
        self, path: Path, what: str, copy: tempfile.TemporaryDirectory[str] | None = None
    ) -> None:
        self.path, self._copy = path, copy  # a private copy has what a `-wal` file held
        self.integrity: Integrity = "damaged"
        self.damage = [Damage(what)]
        # By all passes: each finds what others have found, of its own topics.
        self._unread = Damage("their pages are missing, damaged or too many")
        self.notes, self.extras = list[str](), list[Extra]()
        self.packed: list[Packed] = []
        self.metadata = list[Metadata]()  # what of it is in the file is not looked for
        self._pages = Pages(Path(copy.name) / path.name if copy else path)
        self._taken = np.zeros(self._pages.count + 2, np.bool_)
        self._texts: list[Cell] = []  # rows of `topics` and `message_definitions`
        self._last = 0  # row number that the file's interior pages name
        rows = self._survey()
        self.channels = self._channels()
        if not self.channels:
            self.close()
            raise RecordingError(
                f"{what}; and no topic can be found in what is left of it", where=str(path)
            )
        self._rows = self._known(rows)
        topics, counts = np.unique(self._rows[:, 1], return_counts=True)
        self.counts = dict.fromkeys(self.channels, 0)
        self.counts |= dict(zip(topics.tolist(), counts.tolist(), strict=True))
        stamps = self._rows[:, 2]
        self.span_ns = (int(stamps.min()), int(stamps.max())) if len(stamps) else None

    def _survey(self) -> Ints:
        """Row number, topic, stamp, page and place in it of every message, by one pass."""
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
        self._moves = moves_of(leaves, interiors)
        lasts = {last for last, _ in leaves}
        above = [below for below in interiors if any(key in lasts for _, key in below)]
        self._last = max((below[-1][1] for below in above), default=0)
        return np.concatenate(pieces)

    def _messages(self, cells: list[Cell], page: int) -> Iterator[tuple[int, int, int, int, int]]:
        """The messages of a leaf page; the rows of the other tables are kept."""
        for place, cell in enumerate(cells):
            if _is_message(cell.types):
                topic, stamp = integer(cell, 1), integer(cell, 2)
                if topic is not None and stamp is not None:
                    yield cell.rowid, topic, stamp, page, place
            elif len(cell.types) >= 3 and cell.types[0] == 0 and all(map(is_text, cell.types[1:])):
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

    def _known(self, rows: Ints) -> Ints:
        """The messages of topics in the order of their row numbers; the rest is counted."""
        _, first = np.unique(rows[:, 0], return_index=True)
        rows = rows[first]
        named = np.isin(rows[:, 1], list(self.channels))
        if lost := int((~named).sum()):
            self._lost(f"{lost:,} messages of topics without a name", lost)
        last = max(self._last, int(rows[-1, 0]) if len(rows) else 0)
        missing = last - int((rows[:, 0] > 0).sum())
        room = self._pages.count * self._pages.page_size // MIN_CELL
        if missing > 0 and last <= room:
            self._lost(f"at least {missing:,} messages are missing, by their row numbers", missing)
        return rows[named]

    def _lost(self, what: str, count: int) -> None:
        self.damage.append(Damage(what, {-1: count}))

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """One pass in the order of row numbers, which is the order of arrival."""
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
        """Close the file."""
        self._pages.close()
        if self._copy:
            self._copy.cleanup()


def _is_message(types: tuple[int, ...]) -> bool:
    """Whether a row is one of `messages`: no id of its own, a topic, a stamp and the data."""
    return (
        len(types) == 4
        and types[0] == 0
        and types[1] in INT_SIZES
        and types[2] in INT_SIZES
        and is_blob(types[3])
    )
