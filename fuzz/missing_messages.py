"""No message goes missing without a word: damaged recordings, read beside another reader.

    python fuzz/missing_messages.py FOLDER … --seconds 600

Every recording of one file below the folders (MCAP, sqlite3, ROS 1) is damaged in one of several
ways: bytes changed, a piece cut out, zeroed, repeated or inserted, the end cut off. `mcap`'s
streaming reader, plain SQLite or `rosbags` count what they can recover of it. Restock must report
at least as many messages, or say that some are lost, or refuse the file (topics are not compared:
a name may be what was damaged, and be written twice). The exit code is 1 where it did not; each
such file is kept in --out. Folders are drawn alike, whatever the number of files in them.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import sqlite3
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from rosbags.rosbag1 import Reader as Ros1Reader

from restock.errors import RestockError
from restock.ingest import open_recording

MAX_BYTES = 8 << 20
PAGE = 4096


def damaged(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    """Return a name of the damage, and the bytes with it."""
    kind = rng.choice(["change", "cut out", "zero", "repeat", "insert", "cut short"])
    unit = rng.choice([1, 8, 512, PAGE])
    at = rng.randrange(max(len(data) // unit, 1)) * unit
    size = min(rng.choice([1, 4, 64, PAGE, 16 * PAGE]), len(data) - at)
    if kind == "change":
        changed = bytearray(data)
        for _ in range(rng.choice([1, 1, 4, 32])):
            changed[rng.randrange(len(data))] = rng.randrange(256)
        return kind, bytes(changed)
    piece = {
        "cut out": b"",
        "zero": bytes(size),
        "repeat": data[at : at + size] * 2,
        "insert": rng.randbytes(size) + data[at : at + size],
    }
    if kind == "cut short":
        return kind, data[: rng.randrange(1, len(data))]
    return f"{kind} {size} at {at}", data[:at] + piece[kind] + data[at + size :]


def recoverable(path: Path) -> Counter[str]:
    """Messages by topic, as far as another reader comes."""
    found: Counter[str] = Counter()
    # Whatever it raises at the damage: what it gave before counts.
    with contextlib.suppress(Exception):
        if path.suffix == ".mcap":
            topics: dict[int, str] = {}
            with path.open("rb") as file, contextlib.suppress(McapError):
                for record in StreamReader(file, record_size_limit=64 << 20).records:
                    if isinstance(record, Channel):
                        topics[record.id] = record.topic
                    elif isinstance(record, Message):
                        found[topics[record.channel_id]] += 1
        elif path.suffix == ".db3":
            address = f"file:{path}?immutable=1"
            with contextlib.closing(sqlite3.connect(address, uri=True)) as connection:
                names = dict(connection.execute("SELECT id, name FROM topics"))
                for topic, _ in connection.execute("SELECT topic_id, data FROM messages"):
                    found[names[topic]] += 1
        else:
            with Ros1Reader(path) as reader:
                for connection, _, _ in reader.messages():
                    found[connection.topic] += 1
    return found


def reported(path: Path, salvage: bool) -> tuple[Counter[str], bool] | None:
    """Messages that Restock reads by topic, and whether it says that some are lost.

    None where it refuses the file.
    """
    try:
        with open_recording(path, salvage=salvage) as recording:
            readable = [name for name, info in recording.topics.items() if info.skipped is None]
            counts = Counter({name: info.expected for name, info in recording.topics.items()})
            recording.read({name: [] for name in readable})
            for name, account in recording.accounts.items():
                counts[name] = account.read
            return counts, bool(recording.lost_messages)
    except RestockError:
        return None


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("build/missing_messages"))
    options = parser.parse_args(argv)
    files = sorted(
        file
        for folder in options.folders
        for ending in ("mcap", "db3", "bag")
        for file in folder.rglob(f"*.{ending}")
        if file.is_file() and 0 < file.stat().st_size <= MAX_BYTES
    )
    if not files:
        parser.error(f"no recording below {', '.join(map(str, options.folders))}")
    by_folder: dict[Path, list[Path]] = {}
    for file in files:
        by_folder.setdefault(file.parents[0], []).append(file)
    rng, outcomes, kept = random.Random(options.seed), Counter[str](), 0
    deadline = time.monotonic() + options.seconds
    with tempfile.TemporaryDirectory() as folder:
        while time.monotonic() < deadline:
            file = rng.choice(rng.choice(list(by_folder.values())))
            damage, data = damaged(file.read_bytes(), rng)
            path = Path(folder) / f"damaged{file.suffix}"
            path.write_bytes(data)
            there = recoverable(path)
            for salvage in (False, True):
                result = reported(path, salvage)
                if result is None:
                    left = salvage and there
                    outcomes["refused, though messages are left" if left else "refused"] += 1
                    continue
                counts, lost = result
                outcomes["lost, and said so" if lost else "whole"] += 1
                if there.total() > counts.total() and not lost:
                    outcomes["MISSING"] += 1
                    options.out.mkdir(parents=True, exist_ok=True)
                    copy = options.out / f"{kept}-{file.stem}{file.suffix}"
                    copy.write_bytes(data)
                    kept += 1
                    missing = dict(there - counts)
                    sys.stdout.write(f"{copy}: {damage} of {file}, {salvage=}: {missing}\n")
    ended = ", ".join(f"{name}: {count:,}" for name, count in sorted(outcomes.items()))
    sys.stdout.write(ended + "\n")
    return int(outcomes["MISSING"] > 0)


if __name__ == "__main__":
    sys.exit(main())
