"""ROS message definitions: from the text in a recording, a named distribution, or a folder.

rosbag2 stores the text of definition files unchanged, with `#include` lines, comments and the
editor's line endings. sqlite3 bags from before 2023 have no definitions. `--definitions PATH` reads
those of a robot's own packages from their sources: `DIR/**/PACKAGE/msg/NAME.msg` (or
`PACKAGE/NAME.msg`) and `.idl`.
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

# A message inside another one is preceded by a line of "=" and a line with its name.
_RULE = re.compile(r"^=+[ \t]*\n\s*(?:MSG|IDL):[ \t]*([\w/]+)[ \t]*(?:\n|\Z)", re.MULTILINE)
# Text that no field depends on: strings, comments, and preprocessor lines. Included files are part
# of the definition anyway, so lines with #include or an include guard can be ignored.
_ASIDE = re.compile(
    r'(?P<string>"(?:\\.|[^"\\])*(?:"|\\?\Z))|//[^\n]*|/\*.*?(?:\*/|\Z)'
    r"|^[ \t]*#[ \t]*(?:(?:include|pragma|ifndef|endif)\b|define[ \t]+\w+[ \t]*$)[^\n]*",
    re.DOTALL | re.MULTILINE,
)
_HEADER = re.compile(r"^[ \t]*Header\b", re.MULTILINE)
# Nested brackets, which rosidl does not write, would take the IDL parser exponential time.
_ANNOTATION = re.compile(r"@\s*\w[\w:]*\s*\(")
_NESTED = re.compile(r"(?:<[^<>]*){4}")
MAX_PLACE = 60  # characters of the text that an error quotes


def types_in(content: bytes, name: str, form: str) -> Typesdict:
    """Parse the definition of the message `name` and of the messages inside it.

    `form` is "ros2msg", "ros1msg" or "ros2idl".

    Raises:
        CannotDecode: it cannot be parsed. The error quotes the place.
    """
    types: Typesdict = {}
    try:
        text = re.sub(r"\r\n?", "\n", content.decode("utf-8-sig"))
        first, *rest = _RULE.split(text)
        parts = {normalize_msgtype(name): first}  # in .msg texts, no `_RULE` precedes it
        parts |= zip(map(normalize_msgtype, rest[::2]), rest[1::2], strict=True)
        for part, lines in parts.items():
            if form == "ros2idl":
                types.update(_idl_types(lines))
                continue
            own = f"{part.rpartition('/')[0]}/Header"  # ROS 1 and rosbags take std_msgs/Header
            if form == "ros2msg" and own in parts.keys() - {part}:
                lines = own.join(_HEADER.split(lines))
            types.update(get_types_from_msg(lines, part))
    except (TypesysError, RecursionError, ValueError, LookupError) as error:
        raise CannotDecode(f"cannot be parsed{_parse_end(error)}") from error
    return types


def _idl_types(text: str) -> Typesdict:
    text = _ASIDE.sub(lambda found: '""' if found["string"] else " ", text)
    plain = _ANNOTATION.sub(" ", text)
    if "(" in plain or _NESTED.search(plain):
        raise CannotDecode("nests brackets, which is not supported")
    return get_types_from_idl(text) if text.strip() else {}


def _parse_end(error: Exception) -> str:
    """Return where parsing ended, as the end of an error message.

    An error of rosbags has the whole text on one line, then the position, the text there, and
    perhaps what was expected.
    """
    lines = re.sub(r"\n\{['\"].*\Z", "", str(error) or type(error).__name__).splitlines()
    if len(lines) < 3:
        return f": {' '.join(lines)}"
    rest = " ".join(" ".join(lines[3:]).split())[:MAX_PLACE]
    return f" at {rest!r}" if rest else " at its end"


LARGEST = 512 << 10  # bytes of one file
MAX_FILES = 5000
# No distribution's core has ackermann_msgs, but every robot that steers has it for commands.
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
    """Return every type that a `.msg` or `.idl` file defines, or all such files in a folder.

    Raises:
        RecordingError: there are no definitions or too many, or a file cannot be read.
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
MAX_DEFINITION = 512 << 10  # bytes; real definitions have up to some 50 kB, and parsing is slow
MAX_ARRAY = 1 << 20
KEPT = 1024  # cached types of recordings

EMPTY = "structure_needs_at_least_one_member"  # ROS's placeholder in a message without fields
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")


@dataclass(frozen=True, eq=False)  # hashed by identity, for the cache of plans
class RosType(MessageType):
    """A ROS message type, with the messages that it contains."""

    name: str
    source: str  # "embedded" or the distribution's name
    raw: Typesdict  # the definitions in the form of rosbags
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
    """Return a distribution's message definitions; `humble+DIR` overrides them by a folder's.

    Raises:
        RecordingError: there are no definitions in the folder, or one cannot be read.
    """
    name, _, folder = distro.partition("+")
    own = folder_types(folder) if folder else {}
    return {**ackermann_types(), **_distro_store(name).fielddefs, **own}


def choose_definitions(definitions: str | None) -> str:
    """Return the distribution, and after a `+` the path whose definitions override it.

    `definitions` is a distribution ("jazzy"), the path of a folder or file (on top of Humble), both
    with a `+` between them, or None (Humble). The distribution's definitions are not loaded.

    Raises:
        RecordingError: it is neither a distribution nor an existing path, or the path has no
            definitions.
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
        CannotDecode: it is a service or action event, or its type is not defined or cannot be
            parsed.
    """
    name = _normalized(channel.type) if channel.type else ""
    for part, kind in (("/srv/", "service"), ("/action/", "action")):
        if part in name:
            raise CannotDecode(f"{kind} events are not supported")
    # If a definition is empty, the message has no fields or the writer left its definition out.
    embedded = channel.definition_format in ("ros2msg", "ros2idl", "ros1msg")
    # Loading a distribution takes a quarter of a second: skip it if the recording has a definition.
    types = {} if embedded and channel.definition else distro_types(distro)
    if embedded and (channel.definition or name not in types):
        if len(channel.definition) > MAX_DEFINITION:
            raise CannotDecode(f"its definition of {len(channel.definition):,} bytes is too long")
        return _embedded_type(name, channel.definition_format, channel.definition, distro)
    if name not in types:
        raise CannotDecode(
            f"unknown type {channel.type or '(unnamed)'}: not defined in the recording"
            f" nor in {distro!r} (--definitions PATH reads .msg and .idl files)"
        )
    return _distro_type(name, distro)


@cache
def _distro_type(name: str, distro: str) -> RosType:
    kind = RosType(name, distro, distro_types(distro))
    kind.leaves()  # raises CannotDecode if something is not supported
    return kind


@lru_cache(KEPT)
def _embedded_type(name: str, form: str, definition: bytes, distro: str) -> RosType:
    try:
        types = types_in(definition, name, form)
    except CannotDecode as error:
        raise CannotDecode(f"its definition {error}") from error
    if form == "ros1msg":  # time and duration are not defined in them, as ROS 1 has them built in
        types = {**distro_types("ros1_noetic"), **types}
    source = "embedded"
    missing = _referenced_messages(types) - types.keys()
    if missing:  # some writers omit inner messages; a wrong substitute will not fit in size
        types = {**distro_types(distro), **types}
        source = f"embedded, and {distro}"
    kind = RosType(name, source, types)
    kind.leaves()  # raises CannotDecode if something is not supported
    return kind


def _referenced_messages(types: Typesdict) -> set[str]:
    """Return the names of the messages that these types have as fields."""
    fields = [_field(*item) for _, items in types.values() for item in items]
    return {field.message for field in fields if field.message}
