"""The summary of an MCAP file repeats what its chunks say: without a CRC, the chunks count."""

from pathlib import Path

import pytest
from support.bag_samples import STORE, TOPICS, assert_same_columns, write_mcap
from support.long import one_in

from restock.ingest.containers.mcap_records import Op, parse, walk
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.containers.recording import Recording
from restock.ingest.decoding.columns import TopicColumns

WANTED = {"/odom": ["pose.pose.position.x"], "/bumper": ["data"], "/plan": ["header.stamp"]}


def read(recording: Recording) -> dict[str, TopicColumns]:
    return recording.read(WANTED)


def flip_summary(path: Path, old: bytes, new: bytes, *, keep_crc: bool = True) -> Path:
    """Replace bytes of the summary alone; the summary's CRC is kept or removed."""
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
        (b"PoseWithCovariance pose", b"PoseWithCovariancE pose"),  # of a schema: cannot be parsed
        (b"nav_msgs/msg/Odometry", b"nav_msgs/msg/Odometri"),  # its name
        (b"/bumper", b"/bumpes"),  # the topic of a channel
        (b"cdr\x00", b"cdq\x00"),  # the encoding of a channel
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
def test_the_data_counts_where_the_summary_differs(tmp_path, keep_crc, old, new, options):
    whole = write_mcap(tmp_path / "whole.mcap", **options)
    changed = flip_summary(whole, old, new, keep_crc=keep_crc)
    with open_recording(whole) as one, open_recording(changed) as other:
        assert_same_columns(read(one), read(other))
        assert one.integrity == "verified"
        assert {n: t.type for n, t in other.topics.items()} == TOPICS
        assert other.messages == 140
        assert other.integrity == "damaged"
        (lost,) = other.lost_messages
        assert "summary" in lost.reason
        assert lost.messages is None


def test_counts_of_a_wrong_summary_are_not_used(tmp_path):
    whole = write_mcap(tmp_path / "whole.mcap")
    content = whole.read_bytes()
    for opcode, start, stop in walk(content, 8, len(content)):
        if opcode == Op.STATISTICS:
            old = content[start:stop]
        if opcode == Op.FOOTER:
            break
    new = (old[:8].replace(b"\x8c", b"\x8d") + old[8:])[:-8] + (21).to_bytes(8, "little")
    with open_recording(flip_summary(whole, old, new)) as recording:
        read(recording)
        assert recording.messages == 140
        assert [loss.messages for loss in recording.lost_messages] == [None]


def test_a_summary_with_a_crc_counts(tmp_path):
    """A definition that is damaged in a chunk without CRC, and whole in a summary with one."""
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
    with open_recording(whole) as one, open_recording(tmp_path / "changed.mcap") as other:
        assert_same_columns(read(one), read(other))
        assert other.integrity == "unverified"


def test_a_late_topic_is_compared_where_it_begins(tmp_path):
    """As rosbag2 writes them: a channel's definition lies right before its first message."""
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
