"""The grouping of messages while a recording is read does not change the result."""

import random
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from support.bag_samples import assert_same_columns, write_bag, write_mcap
from support.driven_robot import Drive
from support.driven_robot import write_bag as write_drive
from support.long import one_in

from restock.ingest.containers import mcap_file, sqlite_file
from restock.ingest.containers import storage as reading
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.store import transitions as transitions_module
from restock.ingest.store.writer import StoreWriter

WHOLE = 1 << 40
PROFILE = load_profile("warehouse_amr")


def set_group_sizes(patch: pytest.MonkeyPatch, size: int, rows: int) -> None:
    """Set the size of groups to `size` bytes and of batches to `rows` messages."""
    patch.setattr(mcap_file, "GROUP_BYTES", size)
    patch.setattr(sqlite_file, "BYTES_PER_BATCH", size)
    patch.setattr(reading, "SMALL_ROWS", rows)
    patch.setattr(reading, "TOGETHER_ROWS", rows)


def read_grouped(path: Path, size: int, rows: int, *, salvage: bool) -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        set_group_sizes(patch, size, rows)
        with open_recording(path, salvage=salvage) as recording:
            columns = recording.read({topic: recording.leaves(topic) for topic in recording.topics})
            return {
                "columns": columns,
                "accounts": recording.accounts,
                "lost_messages": recording.lost_messages,
                "integrity": recording.integrity,
            }


def write_shuffled(source: Path, target: Path, chunk_size: int, seed: int, **options: Any) -> Path:
    """Write the same messages out of order, as the buffers of several recorders leave them."""
    with source.open("rb") as file, target.open("wb") as sink:
        messages = list(make_reader(file).iter_messages(log_time_order=False))
        random.Random(seed).shuffle(messages)
        writer = Writer(sink, chunk_size=chunk_size, **options)
        writer.start(profile="ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in messages:
            if channel.id not in channels:
                assert schema is not None
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, kind
                )
            stamp = message.log_time
            writer.add_message(channels[channel.id], stamp, message.data, publish_time=stamp + 7)
        writer.finish()
    return target


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("mcap") / "run.mcap", count=25)


@pytest.mark.long
@settings(max_examples=20)
@given(
    chunk_size=st.integers(500, 30_000),
    size=st.sampled_from([1, 5_000, 50_000]),
    rows=st.integers(1, 30),
    seed=st.integers(0, 99),
    chunked=st.booleans(),
    compression=st.sampled_from(list(CompressionType)),
    index=st.sampled_from([IndexType.ALL, IndexType.NONE]),
    kept_share=st.one_of(st.none(), st.floats(0.3, 0.99)),
)
def test_mcap_grouping_does_not_change_columns(
    tmp_path_factory, sample, chunk_size, size, rows, seed, chunked, compression, index, kept_share
):
    path = write_shuffled(
        sample,
        tmp_path_factory.mktemp("shuffled") / "run.mcap",
        chunk_size,
        seed,
        use_chunking=chunked,
        compression=compression,
        index_types=index,
    )
    if kept_share is not None:
        path.write_bytes(path.read_bytes()[: int(path.stat().st_size * kept_share)])
    expected = read_grouped(path, WHOLE, 1, salvage=kept_share is not None)
    regrouped = read_grouped(path, size, rows, salvage=kept_share is not None)
    assert_same_columns(expected.pop("columns"), regrouped.pop("columns"))
    assert expected == regrouped


@pytest.mark.parametrize("size", [1, 3000, 40_000])
def test_sqlite_batch_size_does_not_change_columns(size: int, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run", count=60)
    expected = read_grouped(bag, WHOLE, 1, salvage=False)
    for salvage in (False, True):
        regrouped = read_grouped(bag, size, 7, salvage=salvage)
        assert_same_columns(expected["columns"], regrouped["columns"])
        assert expected["accounts"] == regrouped["accounts"]


@pytest.mark.parametrize("storage", one_in(2, ["mcap", "sqlite3"]))
def test_grouping_does_not_change_table(storage: str, tmp_path: Path) -> None:
    goals = [(0.0, 3.0, 1.0), (3.2, 4.5, 1.0), (5.5, 20.0, 1.0)]
    drive = Drive(duration_s=8.0, goals=goals, truth="nominal")
    bag = write_drive(drive, tmp_path / "drive", storage=storage)
    tables = []
    for size, rows, group in ((WHOLE, 1, WHOLE), (2000, 3, 1)):
        store = StoreWriter(tmp_path / f"store{len(tables)}")
        with pytest.MonkeyPatch.context() as patch:
            set_group_sizes(patch, size, rows)
            patch.setattr(transitions_module, "GROUP_ROWS", group)
            manifest = ingest(bag, PROFILE, store=store).manifest
        rows = store.rows(manifest["recording_id"], manifest["ingest_id"])
        tables.append(rows.drop_columns(["ingest_id"]))
    assert len(tables[0]) > 30
    assert tables[0].equals(tables[1], check_metadata=True)
