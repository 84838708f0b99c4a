"""MCAP's conformance suite: every record of every file matches its JSON."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.paths import SHARED

from restock.ingest.containers.chunks import inflate
from restock.ingest.containers.mcap_file import McapFile
from restock.ingest.containers.mcap_records import MAGIC, Chunk, Op, parse, walk

pytestmark = pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")

FILES = sorted((SHARED / "mcap-conformance").rglob("*.mcap"))
KINDS = {op: "".join(word.capitalize() for word in op.name.split("_")) for op in Op}
SPANS = ("data", "records")  # fields that are byte ranges of the file


def expected(file: Path) -> list[tuple[str, dict[str, Any]]]:
    records = json.loads(file.with_suffix(".json").read_text())["records"]
    return [(record["type"], dict(record["fields"])) for record in records]


def written(content: bytes) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the records of a file as our parser reads them, chunk contents in place."""
    for opcode, start, stop in walk(content, len(MAGIC), len(content) - len(MAGIC)):
        record = parse(Op(opcode), content, start, stop)
        if opcode == Op.CHUNK:
            low, high = record["records"]
            span = record["message_start_time"], record["message_end_time"]
            size, crc = record["uncompressed_size"], record["uncompressed_crc"]
            chunk = Chunk(start, low, high, size, crc, record["compression"], span)
            data = inflate(chunk, content[chunk.start : chunk.stop])
            for inner, at, end in walk(data, 0, len(data)):
                yield KINDS[Op(inner)], plain(parse(Op(inner), data, at, end), data)
        elif opcode != Op.MESSAGE_INDEX:  # the JSON omits message indexes
            yield KINDS[Op(opcode)], plain(record, content)


def plain(record: dict[str, Any], content: bytes) -> dict[str, Any]:
    """Return a record as the JSON writes it: numbers as strings, bytes as lists of strings."""

    def value(name: str, item: Any) -> Any:
        if name in SPANS:
            return [str(byte) for byte in content[item[0] : item[1]]]
        if isinstance(item, dict):
            return {str(key): str(inner) for key, inner in item.items()}
        return str(item)

    fields = {name: value(name, item) for name, item in record.items()}
    if "media_type" in fields:
        fields.pop("crc", None)  # the JSON omits the CRC of attachments
    return fields


def test_parser_reads_every_conformance_record() -> None:
    assert len(FILES) == 416
    kinds = set[str]()
    for file in FILES:
        records = expected(file)
        assert list(written(file.read_bytes())) == records, file.name
        kinds |= {kind for kind, _ in records}
    assert kinds == set(KINDS.values()) - {"Chunk", "MessageIndex"}


def test_reader_yields_conformance_contents() -> None:
    for file in FILES:
        records = expected(file)
        storage = McapFile(file)

        def of(kind: str, among: list[tuple[str, dict[str, Any]]] = records) -> list[Any]:
            return [fields for name, fields in among if name == kind]

        messages = of("Message")
        got = [
            (str(channel), str(log), str(publish), [str(byte) for byte in payload])
            for channel, batch in storage.batches(list(storage.channels))
            for log, publish, payload in zip(
                batch.log_time_ns.tolist(),
                batch.publish_time_ns.tolist(),
                batch.payloads(),
                strict=True,
            )
        ]
        keys = ("channel_id", "log_time", "publish_time", "data")
        assert got == [tuple(fields[key] for key in keys) for fields in messages], file.name
        assert sum(storage.counts.values()) == len(messages)

        schemas = {fields["id"]: fields for fields in of("Schema")}
        channels = {fields["id"]: fields for fields in of("Channel")}
        assert {
            str(channel.id): (
                channel.topic,
                channel.encoding,
                channel.type,
                channel.definition_format,
                [str(byte) for byte in channel.definition],
            )
            for channel in storage.channels.values()
        } == {
            number: (
                fields["topic"],
                fields["message_encoding"],
                *(
                    schemas.get(fields["schema_id"], {}).get(key, default)
                    for key, default in (("name", ""), ("encoding", ""), ("data", []))
                ),
            )
            for number, fields in channels.items()
        }, file.name

        extras = [(extra.kind, extra.name, extra.media_type) for extra in storage.extras]
        attachments = [
            ("attachment", item["name"], item["media_type"]) for item in of("Attachment")
        ]
        assert extras == attachments + [("metadata", item["name"], "") for item in of("Metadata")]
        for extra, item in zip(storage.extras, of("Attachment"), strict=False):
            assert extra.size_bytes == len(item["data"])
        stamps = [int(fields["log_time"]) for fields in messages]
        assert storage.span_ns == ((min(stamps), max(stamps)) if stamps else None), file.name
        assert not storage.damage
        storage.close()
