"""Protobuf messages: their fields from the FileDescriptorSet in the recording, and their values.

A field that a message omits has protobuf's default: 0, an empty text, no element.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from graphlib import CycleError, TopologicalSorter
from itertools import chain
from typing import Any

import numpy as np
from google.protobuf.descriptor import FieldDescriptor  # type: ignore[import-untyped]
from google.protobuf.descriptor_pb2 import FileDescriptorSet  # type: ignore[import-untyped]
from google.protobuf.descriptor_pool import DescriptorPool  # type: ignore[import-untyped]
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from google.protobuf.message_factory import GetMessageClass  # type: ignore[import-untyped]
from numpy.typing import NDArray

from restock.ingest.decoding.columns import DTYPES, CannotDecode, FieldType, Leaf, Many, MessageType
from restock.ingest.decoding.row_by_row import Unparsable, objects

LARGEST = 256 << 20  # bytes of a message
MAX_DEFINITION = 4 << 20
KEPT = 256  # cached types, each with its descriptor pool
TIMES = ("google.protobuf.Timestamp", "google.protobuf.Duration")

_BASES = {
    FieldDescriptor.CPPTYPE_INT32: "int32",
    FieldDescriptor.CPPTYPE_INT64: "int64",
    FieldDescriptor.CPPTYPE_UINT32: "uint32",
    FieldDescriptor.CPPTYPE_UINT64: "uint64",
    FieldDescriptor.CPPTYPE_DOUBLE: "float64",
    FieldDescriptor.CPPTYPE_FLOAT: "float32",
    FieldDescriptor.CPPTYPE_BOOL: "bool",
    FieldDescriptor.CPPTYPE_ENUM: "int32",
    FieldDescriptor.CPPTYPE_STRING: "string",
}


@dataclass(eq=False)
class ProtobufType(MessageType):
    """A protobuf message type of one FileDescriptorSet."""

    name: str
    pool: DescriptorPool
    source: str = "embedded"
    times = TIMES
    recursive = True

    def fields_of(self, name: str) -> Sequence[FieldType]:
        return [_field(field) for field in self.pool.FindMessageTypeByName(name).fields]

    @property
    def message_class(self) -> Any:
        """Return the class that parses it."""
        return GetMessageClass(self.pool.FindMessageTypeByName(self.name))


def _field(field: Any) -> FieldType:
    many = Many(None) if field.is_repeated else None
    if field.message_type is not None:
        return FieldType(field.name, None, field.message_type.full_name, many)
    if field.type == FieldDescriptor.TYPE_BYTES:
        if many:
            raise CannotDecode(f"{field.name} repeats bytes, which is not supported")
        return FieldType(field.name, "uint8", None, Many(None))
    return FieldType(field.name, _BASES[field.cpp_type], None, many)


@lru_cache(KEPT)
def protobuf_type(name: str, definition: bytes) -> ProtobufType:
    """Return the type of this name in a serialised FileDescriptorSet.

    Raises:
        CannotDecode: the set cannot be parsed, lacks the type, or uses something unsupported.
    """
    if len(definition) > MAX_DEFINITION:
        raise CannotDecode(f"its definition of {len(definition):,} bytes is too long")
    pool = DescriptorPool()
    try:
        files = {file.name: file for file in FileDescriptorSet.FromString(definition).file}
        order = TopologicalSorter({name: file.dependency for name, file in files.items()})
        for file in order.static_order():  # dependencies first
            if file in files:
                pool.Add(files[file])
        pool.FindMessageTypeByName(name)
    except (DecodeError, TypeError, ValueError, CycleError) as error:
        why = (str(error).splitlines() or ["not a FileDescriptorSet"])[0]
        raise CannotDecode(f"its definition cannot be parsed: {why}") from error
    except KeyError:
        raise CannotDecode(
            f"its definition does not define {name or 'a type without a name'}"
        ) from None
    kind = ProtobufType(name, pool)
    kind.leaves()  # raises CannotDecode if something is not supported
    return kind


class ProtobufParser:
    """Parses protobuf messages and reads their values."""

    def __init__(self, kind: ProtobufType) -> None:
        self._class = kind.message_class

    def parse(self, payload: bytes) -> Any:
        if len(payload) > LARGEST:
            raise Unparsable(f"a message of more than {LARGEST:,} bytes")
        try:
            return self._class.FromString(payload)
        except DecodeError:
            raise Unparsable("not a protobuf message of its type") from None

    def member(self, message: Any, field: FieldType) -> Any:
        if isinstance(message, tuple):  # an entry of a map
            return message[field.name == "value"]
        value = getattr(message, field.name)
        return sorted(value.items()) if hasattr(value, "GetEntryClass") else value

    def stamp_ns(self, value: Any) -> int:
        return int(value.seconds * 1_000_000_000 + value.nanos)

    def array(self, values: Sequence[Any], leaf: Leaf) -> NDArray[Any]:
        return objects(values) if leaf.kind == "string" else np.array(values, DTYPES[leaf.kind])

    def concatenate(self, values: Sequence[Any], leaf: Leaf) -> NDArray[Any]:
        if values and isinstance(values[0], bytes):
            return np.frombuffer(b"".join(values), np.uint8)
        return self.array(list(chain.from_iterable(values)), leaf)
