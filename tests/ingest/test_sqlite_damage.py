"""Damaged `.db3` files are rejected; with `--salvage` every intact page is read."""

import sqlite3
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from support.bag_samples import write_bag

from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording

PAGE = 4096
Row = tuple[str, int, bytes]


@pytest.fixture(scope="module")
def intact_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag file of 2,100 robot messages and 60 texts that span several pages each."""
    file = next(write_bag(tmp_path_factory.mktemp("bag") / "run", 300).glob("*.db3"))
    with sqlite3.connect(file) as base:
        base.execute(
            "INSERT INTO topics SELECT 99, '/long', 'std_msgs/msg/String', serialization_format,"
            " offered_qos_profiles, type_description_hash FROM topics LIMIT 1"
        )
        for number in range(60):
            text = f"{number} ".encode() * (900 + 150 * number)
            data = b"\0\1\0\0" + (len(text) + 1).to_bytes(4, "little") + text + b"\0"
            stamp = 1_700_000_000_000_000_000 + number
            base.execute(
                "INSERT INTO messages (topic_id, timestamp, data) VALUES (99, ?, ?)", (stamp, data)
            )
            base.execute(  # puts pages of rows between those of the texts
                "INSERT INTO messages (topic_id, timestamp, data)"
                " SELECT topic_id, timestamp, data FROM messages WHERE id BETWEEN ? AND ?",
                (20 * number + 1, 20 * number + 20),
            )
    base.close()
    return file


def rows_of(file: Path) -> Counter[Row]:
    """Return every row as SQLite reads it."""
    base = sqlite3.connect(file)
    query = "SELECT name, timestamp, data FROM messages JOIN topics ON topics.id = topic_id"
    rows = Counter((name, stamp, bytes(data)) for name, stamp, data in base.execute(query))
    base.close()
    return rows


def read_rows(file: Path, *, salvage: bool) -> tuple[Counter[Row], int | None, list[str]]:
    """Return every payload, the number of messages reported lost, and the damage reports."""
    with open_recording(file, salvage=salvage) as recording:
        (storage,) = recording._storages
        rows = Counter[Row]()
        for channel, batch in storage.batches(list(storage.channels)):
            topic = storage.channels[channel].topic
            stamps = batch.log_time_ns.tolist()
            rows.update(zip([topic] * len(stamps), stamps, batch.payloads(), strict=True))
        counts = [sum(item.messages.values()) for item in storage.damage if item.messages]
        return rows, sum(counts), [item.what for item in storage.damage]


def pages_by_kind(content: bytes) -> dict[int, list[int]]:
    """Return page numbers of the messages table by the page's first byte."""
    pages: dict[int, list[int]] = {}
    for number in range(3, len(content) // PAGE):
        pages.setdefault(content[number * PAGE], []).append(number)
    return pages


def overwrite(content: bytearray, at: int, part: bytes) -> bytearray:
    content[at : at + len(part)] = part
    return content


def leaf(content: bytes, share: float = 0.5) -> int:
    """Return the offset of a leaf page of messages."""
    leaves = [n for n in pages_by_kind(content)[13] if content[n * PAGE + 4] > 3]
    return leaves[int(len(leaves) * share)] * PAGE


def interior(content: bytes) -> int:
    """Return the offset of the interior page with the most children."""
    pages = pages_by_kind(content)[5]
    return max(pages, key=lambda n: content[n * PAGE + 3 : n * PAGE + 5]) * PAGE


def long_page(content: bytes) -> int:
    """Return the offset of an overflow page in the middle of a long text."""
    numbers = range(3, len(content) // PAGE - 1)
    overflow = [
        n for n in numbers if int.from_bytes(content[n * PAGE : n * PAGE + 4], "big") == n + 2
    ]
    return overflow[len(overflow) // 2] * PAGE


def insert(at: int, part: bytes) -> Callable[[bytearray], bytearray]:
    return lambda content: content[:at] + part + content[at:]


def child_pointer(content: bytearray) -> int:
    """Return the offset at which an interior page names a child."""
    at = interior(content)
    return at + int.from_bytes(content[at + 14 : at + 16], "big")


DAMAGES: dict[str, Callable[[bytearray], bytearray]] = {
    "zero page inserted": lambda c: insert(leaf(c), bytes(PAGE))(c),
    "noise page inserted": lambda c: insert(leaf(c, 0.2), b"\x0d\x77" * (PAGE // 2))(c),
    "page duplicated": lambda c: insert(leaf(c), bytes(c[leaf(c) : leaf(c) + PAGE]))(c),
    "three pages inserted among texts": lambda c: insert(long_page(c), bytes(3 * PAGE))(c),
    "page missing": lambda c: c[: leaf(c)] + c[leaf(c) + PAGE :],
    "leaves swapped": lambda c: overwrite(
        overwrite(bytearray(c), leaf(c), c[leaf(c, 0.7) : leaf(c, 0.7) + PAGE]),
        leaf(c, 0.7),
        c[leaf(c) : leaf(c) + PAGE],
    ),
    "leaf zeroed": lambda c: overwrite(c, leaf(c), bytes(PAGE)),
    "leaf kind wrong": lambda c: overwrite(c, leaf(c), b"\x0a"),
    "leaf row count too low": lambda c: overwrite(c, leaf(c) + 3, b"\0\1"),
    "row offset wrong": lambda c: overwrite(c, leaf(c) + 8, b"\0\2"),
    "interior page zeroed": lambda c: overwrite(c, interior(c), bytes(PAGE)),
    "interior child count too low": lambda c: overwrite(c, interior(c) + 3, b"\0\2"),
    "child pointer wrong": lambda c: overwrite(c, child_pointer(c), (3).to_bytes(4, "big")),
    "right pointer wrong": lambda c: overwrite(c, interior(c) + 8, b"\0\0\0\2"),
    "overflow pointer wrong": lambda c: overwrite(c, long_page(c), (4).to_bytes(4, "big")),
    "cut in half": lambda c: c[: len(c) // 2 // PAGE * PAGE],
    "cut within a page": lambda c: c[: len(c) * 4 // 5 // PAGE * PAGE + 1000],
}
REPAIRED = {  # every message can be recovered
    "zero page inserted",
    "noise page inserted",
    "page duplicated",
    "interior page zeroed",
    "interior child count too low",
    "child pointer wrong",
    "right pointer wrong",
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_rejected_or_salvaged(name: str, intact_file: Path, tmp_path: Path) -> None:
    before = rows_of(intact_file)
    file = tmp_path / "run.db3"
    file.write_bytes(DAMAGES[name](bytearray(intact_file.read_bytes())))
    with pytest.raises(RecordingError, match=r"cut short|SQLite finds it damaged"):
        open_recording(file)
    rows, lost, damage = read_rows(file, salvage=True)
    assert not rows - before  # salvage invents no row
    missing = (before - rows).total()
    assert damage
    if name in REPAIRED:
        assert missing == 0
    elif not name.startswith("cut"):
        assert 0 < missing <= 120
        assert lost is not None
        assert lost >= missing
    else:
        assert rows.total() > 0.4 * before.total()


def test_salvaged_columns_match_intact_file(intact_file: Path, tmp_path: Path) -> None:
    """Read twice: the first reading must not use up the rows."""
    file = tmp_path / "run.db3"
    file.write_bytes(DAMAGES["zero page inserted"](bytearray(intact_file.read_bytes())))
    with open_recording(file, salvage=True) as left, open_recording(intact_file) as right:
        assert left.integrity == "damaged"
        for _ in range(2):
            salvaged, expected = (
                item.read({"/long": ["data"], "/odom": ["pose.pose.position.x"]})
                for item in (left, right)
            )
            for topic, columns in expected.items():
                assert columns.log_time_ns.tolist() == salvaged[topic].log_time_ns.tolist()
            assert (
                salvaged["/long"].fields["data"].tolist()
                == expected["/long"].fields["data"].tolist()
            )


def test_lost_message_is_counted_once(intact_file: Path, tmp_path: Path) -> None:
    file = tmp_path / "run.db3"
    file.write_bytes(DAMAGES["overflow pointer wrong"](bytearray(intact_file.read_bytes())))
    with open_recording(file, salvage=True) as recording:
        reported = []
        for topics in (["/long"], ["/long"], ["/odom", "/long"]):
            recording.read({topic: [] for topic in topics})
            reported.append(recording.lost_messages)
    assert any(loss.topic == "/long" and loss.messages for loss in reported[0])
    assert reported[1] == reported[2] == reported[0]


def test_exit_codes_of_a_damaged_file(intact_file, tmp_path, shell):
    file = tmp_path / "run.db3"
    file.write_bytes(DAMAGES["leaf zeroed"](bytearray(intact_file.read_bytes())))
    assert "--salvage" in shell.err("info", file)
    assert "missing, by their row numbers" in shell.err("info", file, "--salvage", code=3)


def test_damaged_file_with_wal_file_is_salvaged(intact_file: Path, tmp_path: Path) -> None:
    file = tmp_path / "run.db3"
    file.write_bytes(intact_file.read_bytes())
    base = sqlite3.connect(file)
    base.executescript("PRAGMA journal_mode = WAL; PRAGMA wal_autocheckpoint = 0")
    base.execute(
        "INSERT INTO messages (topic_id, timestamp, data)"
        " SELECT topic_id, timestamp + 1, data FROM messages LIMIT 50"
    )
    base.commit()
    before = rows_of(file)
    copy = tmp_path / "copy"
    copy.mkdir()
    for item in tmp_path.glob("run.db3*"):
        (copy / item.name).write_bytes(item.read_bytes())
    base.close()
    overwrite(content := bytearray((copy / "run.db3").read_bytes()), leaf(content), bytes(PAGE))
    (copy / "run.db3").write_bytes(content)
    rows, lost, _ = read_rows(copy / "run.db3", salvage=True)
    assert not rows - before
    assert lost == (before - rows).total() <= 20
    assert (copy / "run.db3").read_bytes() == content


def test_oldest_schema_is_read(tmp_path: Path) -> None:
    """In 2018 rosbag2 stored topics without a serialisation format; all were CDR."""
    file = tmp_path / "test.db3"
    with sqlite3.connect(file) as base:
        base.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
            " timestamp INTEGER NOT NULL, data BLOB NOT NULL);"
            "INSERT INTO topics VALUES (1, '/bumper', 'std_msgs/Bool');"
        )
        base.executemany(
            "INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, x'0001000001')",
            [(stamp,) for stamp in range(7)],
        )
    base.close()
    for salvage in (False, True):
        with open_recording(file, salvage=salvage) as recording:
            assert recording.topics["/bumper"].encoding == "cdr"
            assert recording.read({"/bumper": ["data"]})["/bumper"].fields["data"].all()
            assert recording.accounts["/bumper"].decoded == 7
