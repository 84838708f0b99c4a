"""Choice of a channel's decoder, by the encoding of its messages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from restock.ingest.decoding.cdr import ColumnDecoder
from restock.ingest.decoding.definitions import RosType, message_type
from restock.ingest.decoding.field_paths import CannotDecode, Leaf, MessageType
from restock.ingest.decoding.json_messages import JsonParser, JsonType, Sample
from restock.ingest.decoding.messages import Channel
from restock.ingest.decoding.row_by_row import Decoder, ParsedDecoder

READABLE = ("cdr", "ros1", "json", "protobuf")
SAMPLE_BYTES = 4 << 20  # of first messages, from which fields are inferred
SAMPLE_MESSAGES = 1000


def type_of(channel: Channel, distro: str, payloads: Sample) -> MessageType:
    """Return the type of a channel's messages; the first messages show what no definition says.

    Raises:
        CannotDecode: an encoding or a type that is not supported, and why.
    """
    if channel.encoding not in READABLE:
        raise CannotDecode(f"messages encoded as {channel.encoding!r} are not supported")
    if channel.encoding in ("cdr", "ros1"):
        return message_type(channel, distro)
    if channel.encoding == "protobuf":
        if channel.definition_format != "protobuf":
            raise CannotDecode("protobuf messages without a protobuf definition are not supported")
        # Imported here: it takes a while, and few recordings need it.
        from restock.ingest.decoding.protobuf_messages import protobuf_type

        return protobuf_type(channel.type, channel.definition)
    schema = channel.definition if channel.definition_format == "jsonschema" else b""
    return JsonType(
        channel.type or "JSON",
        "embedded" if schema else "inferred",
        schema,
        lambda: _first(payloads()),
    )


def _first(payloads: Iterable[bytes]) -> list[bytes]:
    some, size = list[bytes](), 0
    for payload in payloads:
        some.append(payload)
        size += len(payload)
        if size >= SAMPLE_BYTES or len(some) >= SAMPLE_MESSAGES:
            break
    return some


def decoder_of(channel: Channel, kind: MessageType, leaves: Sequence[Leaf]) -> Decoder:
    """Make the decoder of these fields of a channel's messages.

    Raises:
        CannotDecode: the type uses something unsupported.
    """
    if isinstance(kind, RosType):
        return ColumnDecoder(kind, leaves, ros1=channel.encoding == "ros1")
    if isinstance(kind, JsonType):
        return ParsedDecoder(JsonParser(), leaves)
    from restock.ingest.decoding.protobuf_messages import ProtobufParser, ProtobufType

    if not isinstance(kind, ProtobufType):
        raise TypeError(f"no decoder for {type(kind).__name__}")
    return ParsedDecoder(ProtobufParser(kind), leaves)
