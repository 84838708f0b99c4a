"""rosbag2's sqlite3 storage: one `.db3` file.

A sqlite file is a program as much as it is data: views and computed columns run what a stranger
wrote, pages that point to each other make a small file endless, and texts need not be texts. So
queries are bounded, and only plain tables are read.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from restock.errors import RecordingError
from restock.ingest.containers.storage import Damage, Extra, Integrity
from restock.ingest.decoding.messages import Channel, MessageBatch, PendingBatch

MAGIC = b"SQLite format 3\x00"
ROWS_PER_FETCH = 1000
BYTES_PER_BATCH = 8 << 20
LONGEST_GAP = 64 << 30  # of a short file, filled with holes in a private copy
STEPS_PER_BYTE = 64  # of sqlite's machine; reading rows of a few bytes takes one or two
FEWEST_STEPS = 10_000_000
STEPS_AT_ONCE = 100_000


class SqliteFile:
    """One sqlite3 storage file, read only. rosbag2 keeps no checksums: it is never verified.

    Rows that a writer left in a `-wal` or `-journal` file beside it count too: such a file is
    read from a private copy, so that nothing next to the user's recording is ever written.
    """

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        self.path, self.salvage = path, salvage
        self.integrity: Integrity = "unverified"
        self.damage: list[Damage] = []
        self.notes: list[str] = []
        self.extras: list[Extra] = []
        self._copy: tempfile.TemporaryDirectory[str] | None = None
        self._full_size = self._refuse_short()
        self._connection = self._connect()
        try:
            refuse_programs(self._connection, ("topics", "messages", "message_definitions"))
            self.channels = self._read_channels()
            self._connection.execute("SELECT id, topic_id, timestamp, data FROM messages LIMIT 0")
            self.counts, self.span_ns = self._count()
        except (sqlite3.Error, UnicodeError) as error:  # its messages, too, quote what they read
            self.close()
            raise RecordingError(
                f"not a rosbag2 recording: {error}",
                where=str(path),
                remedy="rosbag2's sqlite3 files have the tables `topics` and `messages`",
            ) from error

    def _refuse_short(self) -> int:
        """How long the file should be, by its own header."""
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            head = file.read(100)
        page = int.from_bytes(head[16:18], "big")
        page = 65536 if page == 1 else page
        # The page count in the header is only right when the two change counters agree.
        pages = int.from_bytes(head[28:32], "big") if head[24:28] == head[92:96] else 0
        if len(head) == 100 and size >= page * pages:
            return size
        what = f"cut short: {size:,} bytes of {page * pages:,}"
        if not self.salvage or len(head) < 100:
            raise RecordingError(
                what, where=str(self.path), remedy="`--salvage` reads what can still be read of it"
            )
        self.damage.append(Damage(what))
        self.integrity = "damaged"
        return min(page * pages, LONGEST_GAP + size)

    def _connect(self) -> sqlite3.Connection:
        path = self.path
        sidecars = [path.with_name(path.name + end) for end in ("-wal", "-journal")]
        sidecars = [item for item in sidecars if item.is_file() and item.stat().st_size]
        immutable = "&immutable=1"
        short = self._full_size > path.stat().st_size
        if sidecars or short:
            self._copy = tempfile.TemporaryDirectory(prefix="restock-")
            for item in (path, *sidecars):
                shutil.copyfile(item, Path(self._copy.name) / item.name)
            path, immutable = Path(self._copy.name) / path.name, ""
            if short:  # sqlite refuses a short file outright: give it the pages, as holes
                os.truncate(path, self._full_size)
            if sidecars:
                names = ", ".join(item.name for item in sidecars)
                self.notes.append(f"{names}: read too, the writer had not merged it")
        mode = "ro" if immutable else "rw"
        uri = f"file:{quote(str(path.absolute()))}?mode={mode}{immutable}"
        try:
            connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
            guard(connection, sum(item.stat().st_size for item in (self.path, *sidecars)))
        except sqlite3.DatabaseError as error:
            raise RecordingError(str(error), where=str(self.path)) from error
        return connection

    def _read_channels(self) -> dict[int, Channel]:
        definitions: dict[str, tuple[str, bytes]] = {}
        if self._connection.execute(
            "SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'"
        ).fetchone():
            rows = self._connection.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            )
            definitions = {
                str(name): (str(form), text if isinstance(text, bytes) else str(text).encode())
                for name, form, text in rows
            }
        rows = self._connection.execute(
            "SELECT id, name, type, serialization_format FROM topics WHERE typeof(id) = 'integer'"
        )
        return {
            number: Channel(
                number,
                str(name),
                str(kind),
                str(encoding),
                *definitions.get(str(kind), ("", b"")),
            )
            for number, name, kind, encoding in rows
        }

    def _count(self) -> tuple[dict[int, int], tuple[int, int] | None]:
        counts = dict.fromkeys(self.channels, 0)
        stamps = list[int]()
        try:
            for number, count, first, last in self._connection.execute(
                "SELECT topic_id, count(*), min(stamp), max(stamp) FROM (SELECT topic_id, CASE"
                " typeof(timestamp) WHEN 'integer' THEN timestamp END AS stamp FROM messages)"
                " GROUP BY 1"
            ):
                if number not in self.channels:
                    what = f"{count} messages of topic id {number}, which no topic has"
                    self.damage.append(Damage(what, {number: count}))
                    continue
                counts[number] = count
                stamps += [stamp for stamp in (first, last) if stamp is not None]
        except sqlite3.DatabaseError:
            if not self.salvage:
                raise
            # Which rows are whole is only known by reading them one after the other.
            for number, stamp in self._whole_rows("topic_id, timestamp"):
                if number in counts:
                    counts[number] += 1
                    stamps += [stamp] if isinstance(stamp, int) else []
        return counts, (min(stamps), max(stamps)) if stamps else None

    def _whole_rows(self, columns: str) -> Iterator[tuple[int, int]]:
        cursor = self._connection.execute(f"SELECT {columns} FROM messages NOT INDEXED ORDER BY id")
        while True:
            try:
                row = cursor.fetchone()
            except sqlite3.DatabaseError as error:
                self._damaged(f"rows after the damage are lost: {error}")
                return
            if row is None:
                return
            yield row

    def _damaged(self, what: str) -> None:
        self.integrity = "damaged"
        if all(item.what != what for item in self.damage):
            self.damage.append(Damage(what))

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """One pass in rowid order, which is the order of arrival."""
        wanted = [channel for channel in channels if channel in self.channels]
        marks = ",".join("?" * len(wanted))
        query = (
            "SELECT topic_id, timestamp, data FROM messages NOT INDEXED"
            f" WHERE topic_id IN ({marks}) AND typeof(timestamp) = 'integer' ORDER BY id"
        )
        try:
            cursor = self._connection.execute(query, wanted)
        except sqlite3.DatabaseError as error:
            self._damaged(f"its rows are lost: {error}")
            return
        pending: dict[int, PendingBatch] = {}
        size = count = 0
        while rows := self._fetch(cursor, size // count if count else BYTES_PER_BATCH // 16):
            if size >= BYTES_PER_BATCH:
                yield from ((channel, some.batch()) for channel, some in pending.items())
                pending, size, count = {}, 0, 0
            size += _add_rows(rows, pending)
            count += len(rows)
        yield from ((channel, some.batch()) for channel, some in pending.items())

    def _fetch(self, cursor: sqlite3.Cursor, row_bytes: int) -> list[tuple[int, int, Any]]:
        """Some rows, fewer of larger ones: how large they are shows in those before."""
        # A failing fetch loses all its rows: where damage is expected, one row at a time.
        some = min(max(BYTES_PER_BATCH // max(row_bytes, 1), 1), ROWS_PER_FETCH)
        try:
            return cursor.fetchmany(1 if self.salvage else some)
        except sqlite3.DatabaseError as error:
            self._damaged(f"rows after the damage are lost: {error}")
            return []

    def close(self) -> None:
        """Close the file and remove the private copy, if there was one."""
        self._connection.close()
        if self._copy:
            self._copy.cleanup()


def _add_rows(rows: list[tuple[int, int, Any]], pending: dict[int, PendingBatch]) -> int:
    """Sort (topic, stamp, data) rows by topic; returns how many bytes they take."""
    topics, stamps, payloads = zip(*rows, strict=True)
    if set(map(type, payloads)) != {bytes}:
        payloads = tuple(
            data if isinstance(data, bytes) else str(data or "").encode() for data in payloads
        )
    topic_of, stamp_ns = np.array(topics), np.array(stamps, np.int64)
    for topic in np.unique(topic_of).tolist():
        chosen = np.flatnonzero(topic_of == topic)
        some = [payloads[row] for row in chosen.tolist()]
        pending.setdefault(topic, PendingBatch()).add(some, stamp_ns[chosen], stamp_ns[chosen])
    return sum(map(len, payloads)) + 64 * len(rows)


def guard(connection: sqlite3.Connection, size: int) -> None:
    """Bound what queries on a file of `size` bytes may take.

    A query that runs for longer than the file can have rows is interrupted: that raises
    sqlite3.OperationalError, as damage does.
    """
    connection.text_factory = lambda text: text.decode("utf-8", "backslashreplace")
    # No value in a file is longer than the file.
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(max(size, 1 << 20), (1 << 31) - 1))
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    left = [max(size * STEPS_PER_BYTE, FEWEST_STEPS)]

    def count() -> bool:
        left[0] -= STEPS_AT_ONCE
        return left[0] < 0

    connection.set_progress_handler(count, STEPS_AT_ONCE)


def refuse_programs(connection: sqlite3.Connection, tables: tuple[str, ...]) -> None:
    """Only plain tables are read.

    Raises:
        sqlite3.DatabaseError: one of these is a view, a virtual table, or has computed columns.
    """
    for table in tables:
        rows = connection.execute(
            "SELECT type, sql FROM sqlite_master WHERE name = ? COLLATE NOCASE", (table,)
        ).fetchall()
        for kind, sql in rows:
            words = str(sql).upper().split()[:2]
            if kind != "table" or words != ["CREATE", "TABLE"]:
                raise sqlite3.DatabaseError(f"{table} is not a plain table")
        # Not as a function in FROM: in a schema that is not trusted, that is not allowed.
        if any(row[6] for row in connection.execute(f"PRAGMA table_xinfo({table})")):
            raise sqlite3.DatabaseError(f"{table} has computed columns")
