"""Damaged `.db3` files are refused, and with `--salvage` every whole page is read."""

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
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """2,100 messages of a robot, and 60 texts that fill several pages each."""
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
            base.execute(  # pages of rows lie between those of the texts
                "INSERT INTO messages (topic_id, timestamp, data)"
                " SELECT topic_id, timestamp, data FROM messages WHERE id BETWEEN ? AND ?",
                (20 * number + 1, 20 * number + 20),
            )
    base.close()
    return file


def rows_of(file: Path) -> Counter[Row]:
    """Every row as SQLite reads it."""
    base = sqlite3.connect(file)
    query = "SELECT name, timestamp, data FROM messages JOIN topics ON topics.id = topic_id"
    rows = Counter((name, stamp, bytes(data)) for name, stamp, data in base.execute(query))
    base.close()
    return rows


def read(file: Path, *, salvage: bool) -> tuple[Counter[Row], int | None, list[str]]:
    """Every payload, how many messages are said to be lost, and what is said of it."""
    with open_recording(file, salvage=salvage) as recording:
        (storage,) = recording._storages
        rows = Counter[Row]()
        for channel, batch in storage.batches(list(storage.channels)):
            topic = storage.channels[channel].topic
            stamps = batch.log_time_ns.tolist()
            rows.update(zip([topic] * len(stamps), stamps, batch.payloads(), strict=True))
        counts = [sum(item.messages.values()) for item in storage.damage if item.messages]
        return rows, sum(counts), [item.what for item in storage.damage]


def kinds(content: bytes) -> dict[int, list[int]]:
    """Return the numbers of the pages, by their first byte, that hold the table of messages."""
    pages: dict[int, list[int]] = {}
    for number in range(3, len(content) // PAGE):
        pages.setdefault(content[number * PAGE], []).append(number)
    return pages


def put(content: bytearray, at: int, some: bytes) -> bytearray:
    content[at : at + len(some)] = some
    return content


def leaf(content: bytes, share: float = 0.5) -> int:
    """Where a leaf page of messages starts."""
    leaves = [n for n in kinds(content)[13] if content[n * PAGE + 4] > 3]
    return leaves[int(len(leaves) * share)] * PAGE


def interior(content: bytes) -> int:
    """Where the interior page with the most children starts."""
    pages = kinds(content)[5]
    return max(pages, key=lambda n: content[n * PAGE + 3 : n * PAGE + 5]) * PAGE


def long_page(content: bytes) -> int:
    """Where a page in the middle of a long text starts: it only names the next one."""
    numbers = range(3, len(content) // PAGE - 1)
    going_on = [
        n for n in numbers if int.from_bytes(content[n * PAGE : n * PAGE + 4], "big") == n + 2
    ]
    return going_on[len(going_on) // 2] * PAGE


def insert(at: int, some: bytes) -> Callable[[bytearray], bytearray]:
    return lambda content: content[:at] + some + content[at:]


def child(content: bytearray) -> int:
    """Where an interior page names one of its children."""
    at = interior(content)
    return at + int.from_bytes(content[at + 14 : at + 16], "big")


DAMAGE: dict[str, Callable[[bytearray], bytearray]] = {
    "a page of zeros is inserted": lambda c: insert(leaf(c), bytes(PAGE))(c),
    "a page of noise is inserted": lambda c: insert(leaf(c, 0.2), b"\x0d\x77" * (PAGE // 2))(c),
    "a page is inserted twice": lambda c: insert(leaf(c), bytes(c[leaf(c) : leaf(c) + PAGE]))(c),
    "three pages are inserted among texts": lambda c: insert(long_page(c), bytes(3 * PAGE))(c),
    "a page is missing": lambda c: c[: leaf(c)] + c[leaf(c) + PAGE :],
    "two leaves are exchanged": lambda c: put(
        put(bytearray(c), leaf(c), c[leaf(c, 0.7) : leaf(c, 0.7) + PAGE]),
        leaf(c, 0.7),
        c[leaf(c) : leaf(c) + PAGE],
    ),
    "a leaf is zeros": lambda c: put(c, leaf(c), bytes(PAGE)),
    "a leaf's first byte is wrong": lambda c: put(c, leaf(c), b"\x0a"),
    "a leaf counts fewer rows": lambda c: put(c, leaf(c) + 3, b"\0\1"),
    "a row's place is wrong": lambda c: put(c, leaf(c) + 8, b"\0\2"),
    "an interior page is zeros": lambda c: put(c, interior(c), bytes(PAGE)),
    "an interior page counts fewer children": lambda c: put(c, interior(c) + 3, b"\0\2"),
    "a child is another page": lambda c: put(c, child(c), (3).to_bytes(4, "big")),
    "the page for higher numbers is wrong": lambda c: put(c, interior(c) + 8, b"\0\0\0\2"),
    "a text goes on elsewhere": lambda c: put(c, long_page(c), (4).to_bytes(4, "big")),
    "cut in half": lambda c: c[: len(c) // 2 // PAGE * PAGE],
    "cut within a page": lambda c: c[: len(c) * 4 // 5 // PAGE * PAGE + 1000],
}
REPAIRED = {  # what can be read to the last message
    "a page of zeros is inserted",
    "a page of noise is inserted",
    "a page is inserted twice",
    "an interior page is zeros",
    "an interior page counts fewer children",
    "a child is another page",
    "the page for higher numbers is wrong",
}


@pytest.mark.parametrize("name", DAMAGE)
def test_planted_damage_is_refused_and_salvaged(name: str, whole: Path, tmp_path: Path) -> None:
    before = rows_of(whole)
    file = tmp_path / "run.db3"
    file.write_bytes(DAMAGE[name](bytearray(whole.read_bytes())))
    with pytest.raises(RecordingError, match=r"cut short|SQLite finds it damaged"):
        open_recording(file)
    rows, lost, said = read(file, salvage=True)
    assert not rows - before  # nothing that was not recorded
    missing = (before - rows).total()
    assert said
    if name in REPAIRED:
        assert missing == 0
    elif not name.startswith("cut"):
        assert 0 < missing <= 120
        assert lost is not None
        assert lost >= missing
    else:
        assert rows.total() > 0.4 * before.total()


def test_salvaged_columns_are_those_of_the_whole_file(whole: Path, tmp_path: Path) -> None:
    """Twice: what one reading takes is there for the next."""
    file = tmp_path / "run.db3"
    file.write_bytes(DAMAGE["a page of zeros is inserted"](bytearray(whole.read_bytes())))
    with open_recording(file, salvage=True) as left, open_recording(whole) as right:
        assert left.integrity == "damaged"
        for _ in range(2):
            one, other = (
                item.read({"/long": ["data"], "/odom": ["pose.pose.position.x"]})
                for item in (left, right)
            )
            for topic, columns in other.items():
                assert columns.log_time_ns.tolist() == one[topic].log_time_ns.tolist()
            assert one["/long"].fields["data"].tolist() == other["/long"].fields["data"].tolist()


def test_a_lost_message_is_counted_once(whole: Path, tmp_path: Path) -> None:
    file = tmp_path / "run.db3"
    file.write_bytes(DAMAGE["a text goes on elsewhere"](bytearray(whole.read_bytes())))
    with open_recording(file, salvage=True) as recording:
        reported = []
        for topics in (["/long"], ["/long"], ["/odom", "/long"]):
            recording.read({topic: [] for topic in topics})
            reported.append(recording.lost_messages)
    assert any(one.topic == "/long" and one.messages for one in reported[0])
    assert reported[1] == reported[2] == reported[0]


def test_exit_codes_of_a_damaged_file(whole, tmp_path, shell):
    file = tmp_path / "run.db3"
    file.write_bytes(DAMAGE["a leaf is zeros"](bytearray(whole.read_bytes())))
    assert "--salvage" in shell.err("info", file)
    assert "missing, by their row numbers" in shell.err("info", file, "--salvage", code=3)


def test_a_damaged_file_with_rows_in_a_wal_file(whole: Path, tmp_path: Path) -> None:
    file = tmp_path / "run.db3"
    file.write_bytes(whole.read_bytes())
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
    put(content := bytearray((copy / "run.db3").read_bytes()), leaf(content), bytes(PAGE))
    (copy / "run.db3").write_bytes(content)
    rows, lost, _ = read(copy / "run.db3", salvage=True)
    assert not rows - before
    assert lost == (before - rows).total() <= 20
    assert (copy / "run.db3").read_bytes() == content


def test_the_oldest_schema_is_read(tmp_path: Path) -> None:
    """rosbag2 of 2018: topics without a serialisation; all was CDR."""
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
