"""ROS message definitions: from the text in a recording, or a named distribution's."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from restock.errors import RecordingError
from restock.ingest.decoding.definition_text import types_in
from restock.ingest.decoding.field_paths import DTYPES, CannotDecode, FieldType, Many, MessageType
from restock.ingest.decoding.hand_definitions import ackermann_types, folder_types
from restock.ingest.decoding.messages import Channel

DEFAULT_DISTRO = "humble"
_STORES = {store.value.removeprefix("ros2_"): store for store in Stores}
MAX_DEFINITION = 512 << 10  # real ones have up to some 50 kB, and the parser is slow
MAX_ARRAY = 1 << 20
KEPT = 1024  # types as recordings define them

EMPTY = "structure_needs_at_least_one_member"  # ROS's placeholder in a message without fields
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")


@dataclass(frozen=True)
class RosType(MessageType):
    """A ROS message type with everything it is made of."""

    name: str
    source: str  # "embedded" or the distribution's name
    raw: Typesdict  # as rosbags has them: the row-wise decoder registers
    times = TIMES

    def fields_of(self, name: str) -> list[FieldType]:
        if name not in self.raw:
            raise CannotDecode(f"{name} is not defined in the recording or in {self.source!r}")
        fields = [_field(field, description) for field, description in self.raw[name][1]]
        return [] if [field.name for field in fields] == [EMPTY] else fields


def _field(name: str, description: Any) -> FieldType:
    node, rest = description
    many = None
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        (node, rest), length = rest
        fixed = description[0] == Nodetype.ARRAY
        if fixed and not 0 < length <= MAX_ARRAY:
            raise CannotDecode(f"{name} is an array of {length:,}, which is not supported")
        many = Many(length if fixed else None)
    if node == Nodetype.NAME:
        return FieldType(name, None, str(rest), many)
    base = str(rest[0])
    if base != "string" and base not in DTYPES:
        raise CannotDecode(f"{name} is a {base}, which is not supported")
    return FieldType(name, base, None, many)


def distro_types(distro: str) -> Typesdict:
    """A distribution's message definitions; of `humble+DIR`, those of a folder on top.

    Raises:
        RecordingError: no distribution of that name, or no definitions in that folder.
    """
    name, _, folder = distro.partition("+")
    hand = folder_types(folder) if folder else {}
    return {**ackermann_types(), **_distro_store(name).fielddefs, **hand}


def refuse_unknown(distro: str) -> None:
    """Check a distribution's name, without loading its definitions; and the folder after a `+`.

    Raises:
        RecordingError: no distribution of that name, or no definitions in that folder.
    """
    distro, _, folder = distro.partition("+")
    if folder:
        folder_types(folder)
    if distro not in _STORES:
        raise RecordingError(
            f"no type store named {distro!r}",
            remedy=f"choose one of {', '.join(sorted(_STORES.keys() - {'empty', 'latest'}))}",
        )


@cache
def _distro_store(distro: str) -> Typestore:
    refuse_unknown(distro)
    return get_typestore(_STORES[distro])


def message_type(channel: Channel, distro: str) -> RosType:
    """The type of a channel's messages.

    Raises:
        CannotDecode: a service or action event, an undefined type, or a definition
            that cannot be parsed.
    """
    name = normalize_msgtype(channel.type) if channel.type else ""
    for part, kind in (("/srv/", "service"), ("/action/", "action")):
        if part in name:
            raise CannotDecode(f"{kind} events are not supported")
    # An empty definition is that of a message without fields, or was left out by the writer.
    embedded = channel.definition_format in ("ros2msg", "ros2idl", "ros1msg")
    # Loading a distribution takes a quarter of a second: not where a recording defines all.
    types = {} if embedded and channel.definition else distro_types(distro)
    if embedded and (channel.definition or name not in types):
        if len(channel.definition) > MAX_DEFINITION:
            raise CannotDecode(f"its definition of {len(channel.definition):,} bytes is too long")
        return _embedded(name, channel.definition_format, channel.definition, distro)
    if name not in types:
        raise CannotDecode(
            f"unknown type {channel.type or '(unnamed)'}: not defined in the recording"
            f" nor in {distro!r} (--definitions DIR reads .msg and .idl files)"
        )
    return _from_distro(name, distro)


@cache
def _from_distro(name: str, distro: str) -> RosType:
    kind = RosType(name, distro, distro_types(distro))
    kind.leaves()  # refuses what is not supported
    return kind


@lru_cache(KEPT)
def _embedded(name: str, form: str, definition: bytes, distro: str) -> RosType:
    try:
        types = types_in(definition, name, form)
    except CannotDecode as error:
        raise CannotDecode(f"its definition {error}") from error
    if form == "ros1msg":  # time and duration are primitives there
        types = {**distro_types("ros1_noetic"), **types}
    source = "embedded"
    missing = _named(types) - types.keys()
    if missing:  # some writers leave out the messages inside; their sizes will tell if they differ
        types = {**distro_types(distro), **types}
        source = f"embedded, and {distro}"
    kind = RosType(name, source, types)
    kind.leaves()  # refuses what is not supported
    return kind


def _named(types: Typesdict) -> set[str]:
    """The messages that fields of these types are made of."""
    fields = [_field(*item) for _, items in types.values() for item in items]
    return {field.message for field in fields if field.message}
