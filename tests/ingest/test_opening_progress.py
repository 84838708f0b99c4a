"""How far the opening of a file is, that has no summary to tell what it holds."""

from __future__ import annotations

from pathlib import Path

from mcap.writer import IndexType, Writer

from restock.ingest.containers.open_recording import open_recording


def test_messages_without_statistics_are_counted_before_the_eyes(tmp_path: Path) -> None:
    path = tmp_path / "plain.mcap"
    writer = Writer(
        str(path),
        chunk_size=1000,
        index_types=IndexType.NONE,
        use_statistics=False,
        use_summary_offsets=False,
        repeat_schemas=False,
        repeat_channels=False,
    )
    writer.start()
    schema = writer.register_schema("std_msgs/msg/Bool", "ros2msg", b"bool data")
    channel = writer.register_channel("/bumper", "cdr", schema)
    for number in range(200):
        writer.add_message(channel, number, b"\x00\x01\x00\x00\x01", number)
    writer.finish()
    reported: list[tuple[str, int, int]] = []
    with open_recording(path, watch=lambda *how: reported.append(how)) as recording:
        assert recording.topics["/bumper"].expected == 200
    counting = [(done, whole) for doing, done, whole in reported if doing.startswith("counting")]
    assert len(counting) > 3
    assert counting == [(done, len(counting)) for done in range(len(counting))]
    assert ("looking through the file, bytes", path.stat().st_size) in {
        (doing, whole) for doing, _, whole in reported
    }
