"""MCAP files: salvage, differing summaries, and checksums."""

import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType
from support.bag_samples import STORE, TOPICS, assert_same_columns, write_mcap
from support.long import one_in

from restock.errors import RecordingError
from restock.ingest.containers.chunks import _fastest_crc32, crc32
from restock.ingest.containers.mcap_file import McapFile
from restock.ingest.containers.mcap_records import MAGIC, Op, parse, walk
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.containers.recording import Recording
from restock.ingest.decoding.columns import TopicColumns

WANTED = {"/odom": ["pose.pose.position.x"], "/bumper": ["data"], "/plan": ["header.stamp"]}


def read_wanted(recording: Recording) -> dict[str, TopicColumns]:
    return recording.read(WANTED)


def flip_summary(path: Path, old: bytes, new: bytes, *, keep_crc: bool = True) -> Path:
    """Replace bytes of the summary only; keep or remove the summary's CRC."""
    assert len(old) == len(new)
    content = bytearray(path.read_bytes())
    footer = len(content) - 37
    start = int.from_bytes(content[footer + 9 : footer + 17], "little")
    at = content.index(old, start)
    content[at : at + len(old)] = new
    if not keep_crc:
        content[footer + 25 : footer + 29] = bytes(4)
    changed = path.with_name("changed.mcap")
    changed.write_bytes(content)
    return changed


@pytest.mark.parametrize("keep_crc", [True, False])
@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"PoseWithCovariance pose", b"PoseWithCovariancE pose"),  # a schema that cannot be parsed
        (b"nav_msgs/msg/Odometry", b"nav_msgs/msg/Odometri"),  # a schema's name
        (b"/bumper", b"/bumpes"),  # a channel's topic
        (b"cdr\x00", b"cdq\x00"),  # a channel's encoding
    ],
)
@pytest.mark.parametrize(
    "options",
    one_in(
        2,
        [
            {},
            {"chunk_size": 1 << 20},
            {"use_chunking": False, "enable_data_crcs": True},
            {"use_statistics": False},
        ],
    ),
)
def test_data_section_overrides_differing_summary(tmp_path, keep_crc, old, new, options):
    whole = write_mcap(tmp_path / "whole.mcap", **options)
    changed = flip_summary(whole, old, new, keep_crc=keep_crc)
    with open_recording(whole) as original, open_recording(changed) as other:
        assert_same_columns(read_wanted(original), read_wanted(other))
        assert original.integrity == "verified"
        assert {n: t.type for n, t in other.topics.items()} == TOPICS
        assert other.messages == 140
        assert other.integrity == "damaged"
        (lost,) = other.lost_messages
        assert "summary" in lost.reason
        assert lost.messages is None


def test_counts_of_damaged_summary_are_ignored(tmp_path):
    whole = write_mcap(tmp_path / "whole.mcap")
    content = whole.read_bytes()
    for opcode, start, stop in walk(content, 8, len(content)):
        if opcode == Op.STATISTICS:
            old = content[start:stop]
        if opcode == Op.FOOTER:
            break
    new = (old[:8].replace(b"\x8c", b"\x8d") + old[8:])[:-8] + (21).to_bytes(8, "little")
    with open_recording(flip_summary(whole, old, new)) as recording:
        read_wanted(recording)
        assert recording.messages == 140
        assert [loss.messages for loss in recording.lost_messages] == [None]


def test_summary_with_crc_overrides_chunk_without_crc(tmp_path):
    """A definition is damaged in a chunk without CRC and intact in a summary with CRC."""
    whole = write_mcap(tmp_path / "whole.mcap")
    content = bytearray(write_mcap(tmp_path / "plain.mcap", compression=0).read_bytes())
    for opcode, start, stop in walk(bytes(content), 8, len(content)):
        if opcode == Op.CHUNK:
            content[start + 24 : start + 28] = bytes(4)
            low, high = parse(Op.CHUNK, bytes(content), start, stop)["records"]
            at = content.find(b"PoseWithCovariance pose", low, high)
            if at >= 0:
                content[at + 17 : at + 18] = b"E"
        if opcode == Op.FOOTER:
            break
    (tmp_path / "changed.mcap").write_bytes(content)
    with open_recording(whole) as original, open_recording(tmp_path / "changed.mcap") as other:
        assert_same_columns(read_wanted(original), read_wanted(other))
        assert other.integrity == "unverified"


def test_late_topic_is_compared_at_its_first_message(tmp_path):
    """rosbag2 writes a channel's definition right before its first message."""
    from mcap.writer import Writer

    path = tmp_path / "late.mcap"
    kind = "std_msgs/msg/Bool"
    definition = STORE.generate_msgdef(kind, ros_version=2)[0].encode()
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1000)
        writer.start(profile="ros2", library="test")
        channels = []
        for step in range(300):
            if step in (0, 200):
                schema = writer.register_schema(kind, "ros2msg", definition + b"# %d" % step)
                channels.append(writer.register_channel(f"/at_{step}", "cdr", schema))
            for channel in channels:
                writer.add_message(channel, step, b"\x00\x01\x00\x00\x01", step)
        writer.finish()
    with open_recording(path) as recording:
        assert recording.integrity != "damaged"
    with open_recording(flip_summary(path, b"/at_200", b"/at_20x", keep_crc=False)) as recording:
        assert list(recording.topics) == ["/at_0", "/at_200"]
        assert recording.integrity == "damaged"
        assert len(recording.read({"/at_200": ["data"]})["/at_200"]) == 100


COUNT = 140


def chunks_of(path: Path) -> list[tuple[int, int]]:
    """Return the start and end of each chunk record with its index records."""
    content = path.read_bytes()
    spans: list[tuple[int, int]] = []
    for opcode, at, stop in walk(content, len(MAGIC), len(content) - len(MAGIC)):
        if opcode == Op.CHUNK:
            spans.append((at - 9, stop))
        elif opcode == Op.MESSAGE_INDEX:
            spans[-1] = (spans[-1][0], stop)
    return spans


def salvage_counts(path: Path) -> tuple[int, list[str], int]:
    """Return the number of decoded messages, the losses, and the number of lost messages."""
    with open_recording(path, salvage=True) as recording:
        recording.read({topic: recording.leaves(topic) for topic in recording.topics})
        accounts = recording.accounts.values()
        decoded = sum(account.decoded for account in accounts)
        assert recording.integrity == "damaged"
        lost = sum(account.lost for account in accounts)
        return decoded, [loss.reason for loss in recording.lost_messages], lost


def write_damage(path: Path, at: int, content: bytes, *, drop_end: int = 0) -> Path:
    whole = bytearray(path.read_bytes())
    whole[at : at + len(content)] = content
    path.write_bytes(whole[: len(whole) - drop_end])
    with pytest.raises(RecordingError, match="cut short or damaged at byte"):
        open_recording(path)
    return path


HUGE = (1 << 60).to_bytes(8, "little")


@pytest.mark.parametrize("compression", list(CompressionType), ids=lambda c: c.name)
def test_chunk_index_recovers_damaged_record_length(
    compression: CompressionType, tmp_path: Path
) -> None:
    """Only the length of the third chunk's record is damaged."""
    path = write_mcap(tmp_path / "run.mcap", compression=compression)
    third = chunks_of(path)[2][0]
    decoded, reasons, lost = salvage_counts(write_damage(path, third + 1, HUGE))
    assert decoded == COUNT
    assert lost == 0
    assert reasons[0].startswith(f"cut short or damaged at byte {third:,}")


def test_lost_chunk_is_counted(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", use_statistics=True)
    third = chunks_of(path)[2][0]
    held = sum(McapFile(path)._contents.chunks[2].counts().values())
    decoded, reasons, lost = salvage_counts(
        write_damage(path, third, b"\x05" + HUGE + b"\xff" * 60)
    )
    assert decoded == COUNT - held
    assert lost == held
    assert any(f"chunk at byte {third:,} is lost" in loss for loss in reasons)


def test_wrong_chunk_length_does_not_hide_next_chunk(tmp_path: Path) -> None:
    """The third chunk claims to end within the fifth, and the fourth is still found."""
    path = write_mcap(tmp_path / "run.mcap")
    places = chunks_of(path)
    third, fifth = places[2][0], places[4][0]
    length = (fifth + 500 - third).to_bytes(8, "little")
    decoded, _, lost = salvage_counts(write_damage(path, third + 1, length))
    assert decoded == COUNT
    assert lost == 0


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_chunks_are_found_without_summary(compression, tmp_path):
    path = write_mcap(tmp_path / "run.mcap", compression=compression)
    places = chunks_of(path)
    chunks = McapFile(path)._contents.chunks
    held = sum(sum(chunks[number].counts().values()) for number in (2, 4))
    # a topic name that claims to be very long
    channel = b"\x04" + (99).to_bytes(8, "little") + bytes(4) + b"\xff" * 4
    write_damage(path, places[4][0], channel)
    decoded, reasons, _ = salvage_counts(
        write_damage(path, places[2][0], b"\x05" + HUGE, drop_end=50)
    )
    assert decoded == COUNT - held
    for begin, end in ((places[2][0], places[3][0]), (places[4][0] + 17, places[5][0])):
        assert any(f"{end - begin:,} bytes from byte {begin:,} on" in loss for loss in reasons)


def test_messages_read_from_truncated_chunk_are_not_lost(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", compression=CompressionType.NONE, chunk_size=1 << 20)
    ((start, stop),) = chunks_of(path)
    path.write_bytes(path.read_bytes()[: (start + stop) // 2])
    decoded, reasons, _ = salvage_counts(path)
    assert 0 < decoded < COUNT
    assert f"from byte {start:,} on are part of a chunk: only its complete" in reasons[1]
    assert not any("are lost" in reason for reason in reasons)


def test_message_bytes_resembling_chunk_are_ignored(tmp_path: Path) -> None:
    """Bytes within a message name a compression."""
    path = write_mcap(tmp_path / "run.mcap", compression=CompressionType.NONE, use_chunking=False)
    fake = b"\x06" + bytes(36) + b"\x04\x00\x00\x00zstd" + HUGE
    content = path.read_bytes()
    records = list(walk(content, len(MAGIC), len(content) - len(MAGIC)))
    at = [start - 9 for opcode, start, _ in records if opcode == Op.MESSAGE][70]
    decoded, reasons, _ = salvage_counts(write_damage(path, at, b"\x05" + HUGE + fake, drop_end=50))
    assert decoded == 70
    assert any("bytes from byte" in loss for loss in reasons)


@given(st.binary(max_size=300), st.integers(0, 300))
def test_crc32_equals_zlib(data: bytes, cut: int) -> None:
    assert crc32(data) == zlib.crc32(data)
    assert crc32(data[cut:], crc32(data[:cut])) == zlib.crc32(data)
    assert crc32(np.frombuffer(data, np.uint8).data) == zlib.crc32(data)


def test_crc32_is_zlib_without_isal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "isal", None)
    assert _fastest_crc32() is zlib.crc32
