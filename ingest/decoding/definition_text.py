"""The text of a ROS message definition, as recordings and files have it, parsed by rosbags.

rosbag2 keeps the text of files: with `#include` lines, comments, and the line ends of the editor.
"""

from __future__ import annotations

import re

from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg
from rosbags.typesys.msg import normalize_msgtype

from restock.ingest.decoding.field_paths import CannotDecode

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
    """Say where parsing ended: rosbags' errors have a line of the whole text, one of the place in
    it, what is there, and perhaps a set of what was expected."""
    lines = re.sub(r"\n\{['\"].*\Z", "", str(error) or type(error).__name__).splitlines()
    if len(lines) < 3:
        return f": {' '.join(lines)}"
    rest = " ".join(" ".join(lines[3:]).split())[:MAX_PLACE]
    return f" at {rest!r}" if rest else " at its end"
