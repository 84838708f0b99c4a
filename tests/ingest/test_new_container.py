"""A container added by this test: one class and one row of `CONTAINERS`."""

import json
from collections.abc import Collection, Iterator
from pathlib import Path

from restock.ingest.containers import open_recording as opening
from restock.ingest.containers.open_recording import open_recording, recordings_in
from restock.ingest.containers.storage import Container, Storage, Watch, no_progress
from restock.ingest.decoding.columns import Channel, MessageBatch

MAGIC = b"#JSONLINES\n"


class JsonLines(Storage):
    """Container of one topic with one line per message, its time and its JSON."""

    def __init__(self, path: Path, *, salvage: bool = False, watch: Watch = no_progress) -> None:
        super().__init__()
        lines = [json.loads(line) for line in path.read_text().splitlines()[1:]]
        self.stamps = [line["ns"] for line in lines]
        self.payloads = [json.dumps(line["message"]).encode() for line in lines]
        self.channels = {1: Channel(1, "/speed", "Speed", "json")}
        self.counts = {1: len(lines)}
        self.span_ns = (min(self.stamps), max(self.stamps)) if lines else None

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        if 1 in channels:
            yield 1, MessageBatch.of(self.payloads, self.stamps, self.stamps)

    def close(self) -> None:
        pass


ROW = Container(
    name="jsonlines",
    endings=(".jsonl",),
    claims=lambda head: head.startswith(MAGIC),
    open=JsonLines,
    format="jsonlines",
    bag_format="jsonlines",
)


def test_new_container_needs_one_class_and_one_row(tmp_path, monkeypatch):
    monkeypatch.setattr(opening, "CONTAINERS", (*opening.CONTAINERS, ROW))
    lines = [json.dumps({"ns": ns, "message": {"mps": ns / 10}}) for ns in (10, 20, 30)]
    path = tmp_path / "run.jsonl"
    path.write_bytes(MAGIC + "\n".join(lines).encode())
    assert recordings_in(tmp_path) == [path]
    with open_recording(path) as recording:
        assert recording.format == "jsonlines"
        speed = recording.read({"/speed": ["mps"]})["/speed"]
    assert speed.fields["mps"].tolist() == [1.0, 2.0, 3.0]
    assert speed.log_time_ns.tolist() == [10, 20, 30]
