"""Hostile files: a clear refusal or a counted loss; no crash, no hang, no memory without bound."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest
from bag_samples import write_bag

from restock.errors import RecordingError
from restock.ingest.readers import open_recording

# -- sqlite: programs in place of tables ----------------------------------------------------------


def bag_with(folder: Path, script: str) -> Path:
    """A bag's file after an SQL script."""
    file = next(write_bag(folder / "run", 2).glob("*.db3"))
    base = sqlite3.connect(file)
    base.executescript(script)
    base.close()
    return file


@pytest.mark.parametrize(
    ("script", "says"),
    [
        (
            "ALTER TABLE messages RENAME TO m; CREATE VIEW messages AS WITH RECURSIVE n(id) AS"
            " (SELECT 1 UNION ALL SELECT id + 1 FROM n) SELECT id, 1 AS topic_id,"
            " id AS timestamp, zeroblob(1000000) AS data FROM n",
            "messages is no plain table",
        ),
        (
            "ALTER TABLE topics RENAME TO t; CREATE VIEW topics AS SELECT * FROM t",
            "topics is no plain table",
        ),
        (
            "DROP TABLE messages; CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER,"
            " timestamp INTEGER, data BLOB AS (zeroblob(900000000)));"
            "INSERT INTO messages (topic_id, timestamp) VALUES (1, 1)",
            "messages has computed columns",
        ),
        ("DROP TABLE messages", "no such table"),
        ("ALTER TABLE messages RENAME COLUMN data TO datum", "no such column"),
    ],
)
def test_sqlite_files_that_are_programs_are_refused(script: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=says):
        open_recording(bag_with(tmp_path, script))


def test_sqlite_values_of_the_wrong_kind_are_counted(tmp_path: Path) -> None:
    file = bag_with(
        tmp_path,
        "UPDATE messages SET timestamp = 'noon' WHERE id = 1;"
        "UPDATE messages SET timestamp = 1.5 WHERE id = 2;"
        "UPDATE messages SET data = CAST(x'ff' AS TEXT) WHERE id = 3;"
        "UPDATE messages SET data = '' WHERE id = 4;"
        "UPDATE messages SET data = 17 WHERE id = 5;",
    )
    with open_recording(file) as recording:
        recording.read({topic: recording.leaves(topic) for topic in recording.topics})
        assert sum(account.decoded for account in recording.accounts.values()) == 14 - 5
        assert sum(account.lost for account in recording.accounts.values()) == 5
        assert recording.span_ns is not None


def test_a_sqlite_tree_that_multiplies_its_pages_is_interrupted(tmp_path: Path) -> None:
    """Interior pages whose every child is the same page: a few kB that hold 10^14 rows."""
    file = tmp_path / "loop.db3"
    base = sqlite3.connect(file)
    base.executescript(
        "PRAGMA page_size = 512;"
        "CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type, serialization_format);"
        "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data);"
        "INSERT INTO topics VALUES (1, '/t', 'std_msgs/msg/Bool', 'cdr')"
    )
    base.executemany(
        "INSERT INTO messages VALUES (?, 1, 5, x'0001000001')", [(n,) for n in range(5000)]
    )
    base.commit()
    (root,) = base.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
    base.close()
    content = bytearray(file.read_bytes())

    def pointers(page: int) -> list[int]:
        """Where an interior page keeps the numbers of its children."""
        at = (page - 1) * 512
        assert content[at] == 5
        count = int.from_bytes(content[at + 3 : at + 5], "big")
        cells = [
            int.from_bytes(content[at + 12 + 2 * n : at + 14 + 2 * n], "big") for n in range(count)
        ]
        return [at + 8, *(at + cell for cell in cells)]

    first = int.from_bytes(content[pointers(root)[1] : pointers(root)[1] + 4], "big")
    page = bytes(content[(first - 1) * 512 : first * 512])
    pages = len(content) // 512
    for level in range(7):  # a chain of pages: each child of one is the next
        content += page
        for at in pointers(pages + 1 + level):
            child = first if level == 6 else pages + 2 + level
            content[at : at + 4] = child.to_bytes(4, "big")
    for at in pointers(root):
        content[at : at + 4] = (pages + 1).to_bytes(4, "big")
    content[28:32] = (len(content) // 512).to_bytes(4, "big")
    file.write_bytes(content)
    with pytest.raises(RecordingError, match=r"interrupted|malformed"):
        open_recording(file)
