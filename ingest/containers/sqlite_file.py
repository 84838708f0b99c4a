"""Reads rosbag2's sqlite3 storage, one `.db3` file.

A sqlite file can be malicious: its views and computed columns run SQL that a stranger wrote, pages
that point to each other make a small file endless, and text may be invalid. So queries are limited,
and only plain tables are read.
"""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import tempfile
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

from restock.errors import RecordingError
from restock.ingest.containers.sqlite_salvage import SalvagedSqliteFile
from restock.ingest.containers.storage import (
    NOT_KEPT,
    Container,
    Storage,
    Watch,
    custom_data,
    no_progress,
)
from restock.ingest.decoding.columns import Channel, MessageBatch

MAGIC = b"SQLite format 3\x00"
BYTES_PER_BATCH = 8 << 20
MAX_MESSAGE = 256 << 20
MAX_METADATA = 2 << 20  # characters
MAX_QOS = 8192  # characters of a topic's offered profiles
MAX_FOUND = 10  # problems that SQLite's check lists: one is enough to refuse the file
STEPS_PER_BYTE = 64  # steps allowed to SQLite's virtual machine; reading short rows takes 1 or 2
MIN_STEPS = 10_000_000
STEPS_AT_ONCE = 100_000
# Problems of values, not of pages, in SQLite's check; ignored, as values are read as they are.
_OF_VALUES = re.compile(r"\S+ value in |\S+ constraint |CHECK ")

_Pending = dict[int, tuple[list[bytes], list[int]]]  # topic id -> payloads, log times


def open_sqlite(
    path: Path, *, salvage: bool = False, watch: Watch = no_progress
) -> SqliteFile | SalvagedSqliteFile:
    """Open a sqlite3 storage file.

    Raises:
        RecordingError: it is not rosbag2's, or is damaged (unless `salvage`).
    """
    try:
        return SqliteFile(path)
    except DamagedSqliteError as damage:
        if not salvage:
            raise
        return SalvagedSqliteFile(path, damage.what, _merge_copy(path))


class DamagedSqliteError(RecordingError):
    """A sqlite3 file that is cut short, or that SQLite finds damaged."""

    def __init__(self, what: str, path: Path) -> None:
        super().__init__(
            what, where=str(path), remedy="`--salvage` reads what can still be read of it"
        )


class SqliteFile(Storage):
    """An undamaged sqlite3 storage file, read only.

    rosbag2 has no checksums, so the file is never verified, but it must pass SQLite's own check of
    its pages.

    Rows that a writer left in a `-wal` or `-journal` file beside it are read, too. Then a private
    copy is read, so that nothing is ever written next to the user's recording.

    Raises:
        DamagedSqliteError: it is cut short or fails the check.
        RecordingError: it is not rosbag2's.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self._copy: tempfile.TemporaryDirectory[str] | None = None
        self._refuse_short()
        self._connection = self._connect()
        try:
            self._refuse_damaged()
            refuse_programs(self._connection, ("topics", "messages", "message_definitions"))
            self.channels = self._read_channels()
            self._connection.execute("SELECT id, topic_id, timestamp, data FROM messages LIMIT 0")
            self.counts, self.span_ns = self._count()
            self._read_metadata()
        except (sqlite3.Error, UnicodeError) as error:  # SQLite's messages may quote invalid text
            self.close()
            raise RecordingError(
                f"not a rosbag2 recording: {error}",
                where=str(path),
                remedy="rosbag2's sqlite3 files have the tables `topics` and `messages`",
            ) from error
        except RecordingError:
            self.close()
            raise

    def _refuse_short(self) -> None:
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            head = file.read(100)
        page = int.from_bytes(head[16:18], "big")
        page = 65536 if page == 1 else page
        # The page count in the header is only right when the two change counters agree.
        pages = int.from_bytes(head[28:32], "big") if head[24:28] == head[92:96] else 0
        if len(head) < 100:
            raise RecordingError(
                f"cut short: {size:,} bytes, less than its header", where=str(self.path)
            )
        if size < page * pages:
            raise DamagedSqliteError(f"cut short: {size:,} bytes of {page * pages:,}", self.path)

    def _refuse_damaged(self) -> None:
        """Run SQLite's quick check of all pages and their structure.

        It takes about as long as reading all rows.
        """
        self._connection.execute("PRAGMA ignore_check_constraints = ON")  # their SQL is untrusted
        try:
            found = self._connection.execute(f"PRAGMA quick_check({MAX_FOUND})").fetchall()
        except sqlite3.DatabaseError as error:
            raise DamagedSqliteError(f"SQLite finds it damaged: {error}", self.path) from error
        lines = [line for (text,) in found for line in str(text).splitlines()]
        lines = [line for line in lines if line != "ok" and not _OF_VALUES.match(line)]
        lines = [line for line in lines if not line.startswith("***")] or lines
        if lines:
            more = f" (and {len(lines) - 1} more)" if len(lines) > 1 else ""
            raise DamagedSqliteError(f"SQLite finds it damaged: {lines[0]}{more}", self.path)

    def _connect(self) -> sqlite3.Connection:
        path, immutable = self.path, "&immutable=1"
        self._copy = _private_copy(path)
        if self._copy:
            path, immutable = Path(self._copy.name) / path.name, ""
            names = ", ".join(item.name for item in _sidecars(self.path))
            self.notes.append(f"{names}: also read, as the writer had not merged it")
        try:
            connection = _open_connection(path, immutable)
            guard(connection, _size(self.path))
        except sqlite3.DatabaseError as error:
            raise DamagedSqliteError(str(error), self.path) from error
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
        names = {row[1] for row in self._connection.execute("PRAGMA table_info(topics)")}
        # Before rosbag2 0.0.5 there was no such column, and everything was CDR.
        encoding = "serialization_format" if "serialization_format" in names else "'cdr'"
        qos = f"substr(offered_qos_profiles, 1, {MAX_QOS})"
        qos = qos if "offered_qos_profiles" in names else "''"
        rows = self._connection.execute(
            f"SELECT id, name, type, {encoding}, {qos} FROM topics WHERE typeof(id) = 'integer'"
        )
        return {
            number: Channel(
                number,
                str(name),
                str(kind),
                str(encoding),
                *definitions.get(str(kind), ("", b"")),
                qos=str(offered or ""),
            )
            for number, name, kind, encoding, offered in rows
        }

    def _count(self) -> tuple[dict[int, int], tuple[int, int] | None]:
        counts = dict.fromkeys(self.channels, 0)
        stamps = list[int]()
        for number, count, first, last in self._connection.execute(
            "SELECT topic_id, count(*), min(stamp), max(stamp) FROM (SELECT topic_id, CASE"
            " typeof(timestamp) WHEN 'integer' THEN timestamp END AS stamp FROM messages)"
            " GROUP BY 1"
        ):
            if number not in self.channels:
                what = f"{count} messages of topic id {number}, which no topic has"
                self.damaged(what, {number: count})
                continue
            counts[number] = count
            stamps += [stamp for stamp in (first, last) if stamp is not None]
        return counts, (min(stamps), max(stamps)) if stamps else None

    def _read_metadata(self) -> None:
        """Read rosbag2's metadata.yaml from the database's last row, written when it was closed."""
        try:
            refuse_programs(self._connection, ("metadata",))
            row = self._connection.execute(
                "SELECT substr(metadata, 1, ?) FROM metadata ORDER BY id DESC LIMIT 1",
                (MAX_METADATA,),
            ).fetchone()
            custom, left_out = custom_data(str(row[0] or "") if row else "", self.path.name)
        except sqlite3.OperationalError:  # older bags have no such table
            return
        except (sqlite3.DatabaseError, ValueError) as problem:
            self.notes.append(f"its own metadata cannot be used: {problem}")
            return
        self.metadata.append(custom)
        if left_out:
            self.notes.append(f"{left_out:,} entries of its metadata: {NOT_KEPT}")

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """Yield the messages in one pass in rowid order, which is the order of arrival."""
        wanted = [channel for channel in channels if channel in self.channels]
        marks = ",".join("?" * len(wanted))
        query = (
            "SELECT topic_id, timestamp, CASE WHEN length(data) <= ? THEN data END, length(data),"
            f" id FROM messages NOT INDEXED WHERE topic_id IN ({marks})"
            " AND typeof(timestamp) = 'integer' ORDER BY id"
        )
        pending, size = _Pending(), 0
        try:
            for topic, stamp, data, length, row in self._connection.execute(
                query, (MAX_MESSAGE, *wanted)
            ):
                if data is None and length is not None:
                    self._refuse_large(topic, row, length)
                    continue
                payloads, stamps = pending.setdefault(topic, ([], []))
                payloads.append(data if isinstance(data, bytes) else str(data or "").encode())
                stamps.append(stamp)
                size += len(payloads[-1]) + 64
                if size >= BYTES_PER_BATCH:
                    yield from _batches(pending)
                    pending, size = _Pending(), 0
        except sqlite3.DatabaseError as error:
            self.damaged(f"rows after the damage are lost: {error}")
        yield from _batches(pending)

    def _refuse_large(self, topic: int, row: int, length: int) -> None:
        if len(self.damage) < MAX_FOUND:
            what = f"row {row:,} is not read: its message of {length:,} bytes is too large"
            self.damaged(what, {topic: 1})

    def close(self) -> None:
        """Close the file and remove the private copy, if there was one."""
        self._connection.close()
        if self._copy:
            self._copy.cleanup()


def _sidecars(path: Path) -> list[Path]:
    """Return the files beside a database that a writer left and SQLite has not merged into it."""
    beside = [path.with_name(path.name + end) for end in ("-wal", "-journal")]
    return [item for item in beside if item.is_file() and item.stat().st_size]


def _size(path: Path) -> int:
    return sum(item.stat().st_size for item in (path, *_sidecars(path)))


def _private_copy(path: Path) -> tempfile.TemporaryDirectory[str] | None:
    """Copy a database with its sidecars to a temporary folder; None if it has no sidecars."""
    if not (sidecars := _sidecars(path)):
        return None
    folder = tempfile.TemporaryDirectory(prefix="restock-")
    for item in (path, *sidecars):
        shutil.copyfile(item, Path(folder.name) / item.name)
    return folder


def _merge_copy(path: Path) -> tempfile.TemporaryDirectory[str] | None:
    """Copy a database and merge its sidecars as far as possible; None if it has no sidecars."""
    copy = _private_copy(path)
    if copy:
        with suppress(sqlite3.DatabaseError):
            connection = _open_connection(Path(copy.name) / path.name, "")
            try:
                guard(connection, _size(path))
                connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
            finally:
                connection.close()
    return copy


def _open_connection(path: Path, immutable: str) -> sqlite3.Connection:
    mode = "ro" if immutable else "rw"
    uri = f"file:{quote(os.fsencode(path.absolute()))}?mode={mode}{immutable}"
    return sqlite3.connect(uri, uri=True, check_same_thread=False)


def _batches(pending: _Pending) -> Iterator[tuple[int, MessageBatch]]:
    for topic, (payloads, stamps) in pending.items():
        yield topic, MessageBatch.of(payloads, stamps, stamps)


def guard(connection: sqlite3.Connection, size: int) -> None:
    """Limit the work of queries on a file of `size` bytes.

    All queries of the connection share a number of steps, more than an intact file of that size
    needs. Beyond them, a query raises sqlite3.OperationalError, as it does for damage.
    """
    connection.text_factory = lambda text: text.decode("utf-8", "backslashreplace")
    # No value in a file is longer than the file.
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(max(size, 1 << 20), (1 << 31) - 1))
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    left = [max(size * STEPS_PER_BYTE, MIN_STEPS)]

    def count() -> bool:
        left[0] -= STEPS_AT_ONCE
        return left[0] < 0

    connection.set_progress_handler(count, STEPS_AT_ONCE)


def refuse_programs(connection: sqlite3.Connection, tables: tuple[str, ...]) -> None:
    """Refuse a database if one of these tables is not a plain one.

    Raises:
        sqlite3.DatabaseError: one is a view or a virtual table, or has computed columns.
    """
    for table in tables:
        rows = connection.execute(
            "SELECT type, sql FROM sqlite_master WHERE name = ? COLLATE NOCASE", (table,)
        ).fetchall()
        for kind, sql in rows:
            words = str(sql).upper().split()[:2]
            if kind != "table" or words != ["CREATE", "TABLE"]:
                raise sqlite3.DatabaseError(f"{table} is not a plain table")
        # By the statement: a database can shadow the function `pragma_table_xinfo` with a table.
        if any(row[6] for row in connection.execute(f"PRAGMA table_xinfo({table})")):
            raise sqlite3.DatabaseError(f"{table} has computed columns")


CONTAINER = Container(
    name="sqlite3",
    endings=(".db3",),
    claims=lambda head: head.startswith(MAGIC),
    open=open_sqlite,
    format="rosbag2-sqlite3",
    bag_format="rosbag2-sqlite3",
)
