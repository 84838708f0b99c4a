"""ROS message definitions: from the text in a recording, a named distribution, or a folder.

rosbag2 keeps the text of files: with `#include` lines, comments, and the line ends of the editor.
Bags of sqlite3 before 2023 carry no definitions: `--definitions PATH` reads those of a robot's own
packages from their sources: `DIR/**/PACKAGE/msg/NAME.msg` (or `PACKAGE/NAME.msg`) and `.idl`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from restock.errors import RecordingError
from restock.ingest.decoding.columns import (
    DTYPES,
    CannotDecode,
    Channel,
    FieldType,
    Many,
    MessageType,
)

# The line before each message inside another one names it, after a line of "=".
_RULE = re.compile(r"^=+[ \t]*\n\s*(?:MSG|IDL):[ \t]*([\w/]+)[ \t]*(?:\n|\Z)", re.MULTILINE)
# What no field depends on: strings, comments, and lines for a preprocessor. What an #include names
# is in the definition, too, and a guard against reading it twice always lets it be read once.
_ASIDE = re.compile(
    r'(?P<string>"(?:\\.|[^"\\])*(?:"|\\?\Z))|//[^\n]*|/\*.*?(?:\*/|\Z)'
    r"|^[ \t]*#[ \t]*(?:(?:include|pragma|ifndef|endif)\b|define[ \t]+\w+[ \t]*$)[^\n]*",
    re.DOTALL | re.MULTILINE,
)
_HEADER = re.compile(r"^[ \t]*Header\b", re.MULTILINE)
# The IDL parser's time is exponential in how deep these nest; rosidl writes none of either.
_ANNOTATION = re.compile(r"@\s*\w[\w:]*\s*\(")
_NESTED = re.compile(r"(?:<[^<>]*){4}")
MAX_PLACE = 60  # characters of a text that are named where it cannot be parsed


def types_in(content: bytes, name: str, form: str) -> Typesdict:
    """Parse the definition of a message, `name`, and of the messages inside it.

    `form` is "ros2msg", "ros1msg" or "ros2idl".

    Raises:
        CannotDecode: it cannot be parsed, and where.
    """
    types: Typesdict = {}
    try:
        text = re.sub(r"\r\n?", "\n", content.decode("utf-8-sig"))
        first, *rest = _RULE.split(text)
        parts = {normalize_msgtype(name): first}  # rosbag2 has no rule before it in .msg texts
        parts |= zip(map(normalize_msgtype, rest[::2]), rest[1::2], strict=True)
        for part, lines in parts.items():
            if form == "ros2idl":
                types.update(_idl_types(lines))
                continue
            own = f"{part.rpartition('/')[0]}/Header"  # ROS 1 and rosbags mean that of std_msgs
            if form == "ros2msg" and own in parts.keys() - {part}:
                lines = own.join(_HEADER.split(lines))
            types.update(get_types_from_msg(lines, part))
    except (TypesysError, RecursionError, ValueError, LookupError) as error:
        raise CannotDecode(f"cannot be parsed{_where(error)}") from error
    return types


def _idl_types(text: str) -> Typesdict:
    text = _ASIDE.sub(lambda found: '""' if found["string"] else " ", text)
    bare = _ANNOTATION.sub(" ", text)
    if "(" in bare or _NESTED.search(bare):
        raise CannotDecode("nests brackets, which is not supported")
    return get_types_from_idl(text) if text.strip() else {}


def _where(error: Exception) -> str:
    """Say where parsing ended.

    The errors of rosbags hold the whole text on one line, then the place, what is there, and
    perhaps what was expected.
    """
    lines = re.sub(r"\n\{['\"].*\Z", "", str(error) or type(error).__name__).splitlines()
    if len(lines) < 3:
        return f": {' '.join(lines)}"
    rest = " ".join(" ".join(lines[3:]).split())[:MAX_PLACE]
    return f" at {rest!r}" if rest else " at its end"


LARGEST = 512 << 10  # bytes of one file
MAX_FILES = 5000
# Part of no distribution's core, and what every robot that steers is driven by (ackermann_msgs).
ACKERMANN = {
    "ackermann_msgs/msg/AckermannDrive": (
        "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\n"
        "float32 acceleration\nfloat32 jerk\n"
    ),
    "ackermann_msgs/msg/AckermannDriveStamped": (
        "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n"
    ),
}


@cache
def ackermann_types() -> Typesdict:
    """Return the types of ackermann_msgs."""
    types: Typesdict = {}
    for name, text in ACKERMANN.items():
        types.update(get_types_from_msg(text, name))
    return types


@cache
def folder_types(folder: str) -> Typesdict:
    """Return every type that a `.msg` or `.idl` file defines, or all of them in a folder.

    Raises:
        RecordingError: no definition in it or too many, or one that cannot be read; names it.
    """
    root = Path(folder)
    files = sorted([*root.rglob("*.msg"), *root.rglob("*.idl")])
    if root.is_file():
        root, files = root.parent, [root]
    if len(files) > MAX_FILES:
        raise _refused(folder, f"it holds {len(files):,} definitions, more than {MAX_FILES:,}")
    types: Typesdict = {}
    for file in files:
        parts = [part for part in file.relative_to(root).parts[:-1] if part != "msg"]
        package = parts[-1] if parts else root.name if root.name != "msg" else root.parent.name
        try:
            if file.stat().st_size > LARGEST:
                raise ValueError("too long for a definition")
            form = "ros2idl" if file.suffix == ".idl" else "ros2msg"
            types.update(types_in(file.read_bytes(), f"{package}/msg/{file.stem}", form))
        except (CannotDecode, ValueError, OSError) as error:
            raise RecordingError(
                f"a definition that cannot be read: {error}",
                where=str(file),
                remedy="correct the file, or remove it from the folder",
            ) from error
    if not types:
        raise _refused(folder, "it contains no .msg and no .idl file")
    return types


def _refused(folder: str, why: str) -> RecordingError:
    remedy = "give a folder that contains PACKAGE/msg/NAME.msg (or .idl)"
    return RecordingError(why, where=folder, remedy=remedy)


DEFAULT_DISTRO = "humble"
_STORES = {store.value.removeprefix("ros2_"): store for store in Stores}
MAX_DEFINITION = 512 << 10  # real ones have up to some 50 kB, and the parser is slow
MAX_ARRAY = 1 << 20
KEPT = 1024  # types as recordings define them

EMPTY = "structure_needs_at_least_one_member"  # ROS's placeholder in a message without fields
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")


@dataclass(frozen=True, eq=False)  # one object a definition: plans are kept by it
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
    """Return a distribution's message definitions; for `humble+DIR`, with a folder's on top.

    Raises:
        RecordingError: no distribution of that name, or no definitions in that folder.
    """
    name, _, folder = distro.partition("+")
    hand = folder_types(folder) if folder else {}
    return {**ackermann_types(), **_distro_store(name).fielddefs, **hand}


def choose_definitions(definitions: str | None) -> str:
    """Name a distribution, and after a `+` the folder or file whose definitions are on top.

    `definitions` is a distribution, a folder or file, both with a `+` between them, or None. The
    distribution's definitions are not loaded.

    Raises:
        RecordingError: neither a distribution nor a place, or a place without definitions.
    """
    distro, _, place = (definitions or DEFAULT_DISTRO).partition("+")
    if distro not in _STORES:
        distro, place = DEFAULT_DISTRO, str(definitions)
    if not place:
        return distro
    path = Path(place).absolute()
    if not path.exists():
        raise RecordingError(
            f"no ROS distribution, folder or file of definitions named {place!r}",
            remedy=f"choose one of {', '.join(sorted(_STORES.keys() - {'empty', 'latest'}))};"
            " or a folder that contains PACKAGE/msg/NAME.msg",
        )
    folder_types(str(path))
    return f"{distro}+{path}"


@cache
def _distro_store(distro: str) -> Typestore:
    return get_typestore(_STORES[distro])


_normalized = lru_cache(KEPT)(normalize_msgtype)


def message_type(channel: Channel, distro: str) -> RosType:
    """Return the type of a channel's messages.

    Raises:
        CannotDecode: a service or action event, an undefined type, or a definition
            that cannot be parsed.
    """
    name = _normalized(channel.type) if channel.type else ""
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
            f" nor in {distro!r} (--definitions PATH reads .msg and .idl files)"
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
    """Return the messages that fields of these types consist of."""
    fields = [_field(*item) for _, items in types.values() for item in items]
    return {field.message for field in fields if field.message}
