"""Damaged MCAP files: what can be proven to be there is read, what is lost is said in bytes."""

from pathlib import Path

import pytest
from mcap.writer import CompressionType
from support.bag_samples import write_mcap

from restock.errors import RecordingError
from restock.ingest.containers.mcap_file import McapFile
from restock.ingest.containers.mcap_records import MAGIC, Op, walk
from restock.ingest.containers.open_recording import open_recording

COUNT = 140


def chunks_of(path: Path) -> list[tuple[int, int]]:
    """Where each chunk's record and its index records are."""
    content = path.read_bytes()
    places: list[tuple[int, int]] = []
    for opcode, at, stop in walk(content, len(MAGIC), len(content) - len(MAGIC)):
        if opcode == Op.CHUNK:
            places.append((at - 9, stop))
        elif opcode == Op.MESSAGE_INDEX:
            places[-1] = (places[-1][0], stop)
    return places


def read(path: Path) -> tuple[int, list[str], int]:
    """Messages decoded, what was lost, and how many messages that was said to be."""
    with open_recording(path, salvage=True) as recording:
        recording.read({topic: recording.leaves(topic) for topic in recording.topics})
        accounts = recording.accounts.values()
        decoded = sum(account.decoded for account in accounts)
        assert recording.integrity == "damaged"
        lost = sum(account.lost for account in accounts)
        return decoded, [loss.reason for loss in recording.lost_messages], lost


def damaged(path: Path, at: int, content: bytes, *, drop_end: int = 0) -> Path:
    whole = bytearray(path.read_bytes())
    whole[at : at + len(content)] = content
    path.write_bytes(whole[: len(whole) - drop_end])
    with pytest.raises(RecordingError, match="cut short or damaged at byte"):
        open_recording(path)
    return path


HUGE = (1 << 60).to_bytes(8, "little")


@pytest.mark.parametrize("compression", list(CompressionType), ids=lambda c: c.name)
def test_by_the_chunk_index(compression: CompressionType, tmp_path: Path) -> None:
    """The length of the third chunk's record is damaged, and nothing else."""
    path = write_mcap(tmp_path / "run.mcap", compression=compression)
    third = chunks_of(path)[2][0]
    decoded, reasons, lost = read(damaged(path, third + 1, HUGE))
    assert decoded == COUNT
    assert lost == 0
    assert reasons[0].startswith(f"cut short or damaged at byte {third:,}")


def test_a_chunk_that_is_gone_is_counted(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", use_statistics=True)
    third = chunks_of(path)[2][0]
    held = sum(McapFile(path)._contents.chunks[2].counts().values())
    decoded, reasons, lost = read(damaged(path, third, b"\x05" + HUGE + b"\xff" * 60))
    assert decoded == COUNT - held
    assert lost == held
    assert any(f"chunk at byte {third:,} is lost" in loss for loss in reasons)


def test_a_wrong_length_that_leads_astray(tmp_path: Path) -> None:
    """The third chunk says that it ends within the fifth: the fourth is found all the same."""
    path = write_mcap(tmp_path / "run.mcap")
    places = chunks_of(path)
    third, fifth = places[2][0], places[4][0]
    length = (fifth + 500 - third).to_bytes(8, "little")
    decoded, _, lost = read(damaged(path, third + 1, length))
    assert decoded == COUNT
    assert lost == 0


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_without_a_summary_chunks_show_themselves(compression, tmp_path):
    path = write_mcap(tmp_path / "run.mcap", compression=compression)
    places = chunks_of(path)
    chunks = McapFile(path)._contents.chunks
    held = sum(sum(chunks[number].counts().values()) for number in (2, 4))
    channel = b"\x04" + (99).to_bytes(8, "little") + bytes(4) + b"\xff" * 4  # a long topic
    damaged(path, places[4][0], channel)
    decoded, reasons, _ = read(damaged(path, places[2][0], b"\x05" + HUGE, drop_end=50))
    assert decoded == COUNT - held
    for begin, end in ((places[2][0], places[3][0]), (places[4][0] + 17, places[5][0])):
        assert any(f"{end - begin:,} bytes from byte {begin:,} on" in loss for loss in reasons)


def test_of_a_chunk_that_is_cut_what_is_read_is_not_called_lost(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", compression=CompressionType.NONE, chunk_size=1 << 20)
    ((start, stop),) = chunks_of(path)
    path.write_bytes(path.read_bytes()[: (start + stop) // 2])
    decoded, reasons, _ = read(path)
    assert 0 < decoded < COUNT
    assert f"from byte {start:,} on are part of a chunk: only its complete" in reasons[1]
    assert not any("are lost" in reason for reason in reasons)


def test_a_chunk_that_only_looks_like_one(tmp_path: Path) -> None:
    """Bytes that name a compression within a message are no chunk."""
    path = write_mcap(tmp_path / "run.mcap", compression=CompressionType.NONE, use_chunking=False)
    fake = b"\x06" + bytes(36) + b"\x04\x00\x00\x00zstd" + HUGE
    content = path.read_bytes()
    records = list(walk(content, len(MAGIC), len(content) - len(MAGIC)))
    at = [start - 9 for opcode, start, _ in records if opcode == Op.MESSAGE][70]
    decoded, reasons, _ = read(damaged(path, at, b"\x05" + HUGE + fake, drop_end=50))
    assert decoded == 70
    assert any("bytes from byte" in loss for loss in reasons)
