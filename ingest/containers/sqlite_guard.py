"""What a sqlite file may make sqlite do: it is a program as much as it is data.

Views and computed columns run what a stranger wrote, pages that point to each other make a small
file endless, and texts need not be texts.
"""

from __future__ import annotations

import sqlite3

STEPS_PER_BYTE = 64  # of sqlite's machine; reading rows of a few bytes takes one or two
FEWEST_STEPS = 10_000_000
STEPS_AT_ONCE = 100_000


def guard(connection: sqlite3.Connection, size: int) -> None:
    """Bound what queries on a file of `size` bytes may take.

    A query that goes on for longer than the file can have rows is interrupted: that raises
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
                raise sqlite3.DatabaseError(f"{table} is no plain table")
        # Not as a function in FROM: in a schema that is not trusted, that is not allowed.
        if any(row[6] for row in connection.execute(f"PRAGMA table_xinfo({table})")):
            raise sqlite3.DatabaseError(f"{table} has computed columns")
