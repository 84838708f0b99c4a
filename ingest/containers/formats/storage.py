"""Interface that every container of messages implements, between file formats and recordings."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from restock.errors import visible
from restock.ingest.decoding.messages import Channel, MessageBatch

Integrity = Literal["verified", "unverified", "damaged"]
Watch = Callable[[str, int, int], None]  # what is being done, how much of it is done, of how much

# Of a file's metadata so much is kept; the rest is counted.
MAX_ENTRIES = 1_000
MAX_TEXT = 4_096  # characters of a name or value
MAX_CUSTOM_DATA = 64 << 10  # characters: the parser is slow
HEAD_BYTES = 64  # by which a container claims a file
NOT_KEPT = f"not text, longer than {MAX_TEXT:,} characters, or beyond entry {MAX_ENTRIES:,}"
# What the YAML library raises of an invalid document, or of one that it does not expect.
INVALID_YAML = (
    *(YAMLError, KeyError, IndexError, TypeError, ValueError, AttributeError, AssertionError),
    *(RecursionError, OverflowError, NotImplementedError),
)
# The key, and the lines further in: two spaces in metadata.yaml, none in what storages keep.
_CUSTOM_DATA = re.compile(
    r"^(?P<indent> {0,4})custom_data:(?P<value>.*)(?P<block>(?:\n(?:(?P=indent) .*|[ \t]*$))*)",
    re.MULTILINE,
)


def unwatched(doing: str, done: int, whole: int) -> None:
    """Ignore progress: a `Watch` that does nothing."""


@dataclass
class Damage:
    """Part of a file that could not be read, and how many messages that cost if known."""

    what: str
    messages: dict[int, int] = field(default_factory=dict)  # by channel id

    def __post_init__(self) -> None:
        self.what = visible(self.what)


@dataclass(frozen=True)
class Extra:
    """Attachment or metadata record of a file."""

    kind: Literal["attachment", "metadata"]
    name: str
    media_type: str
    size_bytes: int

    def __post_init__(self) -> None:
        for name in ("name", "media_type"):
            object.__setattr__(self, name, visible(getattr(self, name)))


class Packed(NamedTuple):
    """Chunks of a file that are compressed alike."""

    compression: str  # "" for none
    chunks: int
    stored_bytes: int
    plain_bytes: int  # as the chunks say


class Metadata(NamedTuple):
    """Metadata of a whole recording, by its recorder or added later: text by name."""

    source: str  # where it says so, for errors
    record: str  # name of the MCAP record; "" for the custom_data of a bag
    entries: Mapping[str, str]


def keep_entries(
    said: Mapping[str, str], kept: Collection[Metadata] = ()
) -> tuple[dict[str, str], int]:
    """Return the entries of a record that still fit beside `kept`, and how many do not."""
    room = MAX_ENTRIES - sum(len(item.entries) for item in kept)
    short = {n: v for n, v in said.items() if len(n) <= MAX_TEXT and len(v) <= MAX_TEXT}
    entries = dict(list(short.items())[: max(room, 0)])
    return {visible(n): visible(v) for n, v in entries.items()}, len(said) - len(entries)


def custom_data(text: str, source: str, kept: Collection[Metadata] = ()) -> tuple[Metadata, int]:
    """Read rosbag2's `custom_data` from the text of a bag's metadata, which is `source`.

    Also returns how many of its entries do not fit beside `kept`.

    Raises:
        ValueError: it is too long, or no YAML.
    """
    said, no_text = _custom_data(text)
    entries, beyond = keep_entries(said, kept)
    return Metadata(f"custom_data in {source}", "", entries), no_text + beyond


def _custom_data(text: str) -> tuple[dict[str, str], int]:
    """Return the entries, and how many of them are not text.

    Only those lines are parsed, and their values stay as they are written: `007` is no number.
    """
    found = _CUSTOM_DATA.search(text)
    if found is None:
        return {}, 0
    if found["value"].strip() in ("", "~", "null", "{}") and not found["block"].strip():
        return {}, 0
    lines = found[0]
    if len(lines) > MAX_CUSTOM_DATA:
        raise ValueError(f"custom_data has {len(lines):,} characters: not read")
    try:
        said = YAML(typ="base", pure=True).load(lines.strip())["custom_data"]
    except INVALID_YAML as error:
        why = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"custom_data cannot be used: {visible(why[:200])}") from error
    if not isinstance(said, dict):
        return {}, 1
    entries = {n: v for n, v in said.items() if isinstance(n, str) and isinstance(v, str)}
    return {n: v for n, v in entries.items() if v != "~"}, len(said) - len(entries)


class Storage(Protocol):
    """An open file of messages.

    `counts` are the messages by the container's own count, per channel id; `span_ns` the first and
    last log time, or None when it holds no message. `damage` is final once everything wanted
    has been read. `notes` are for the user to know and lose nothing. `extras` are listed, not read;
    `metadata` is what of them says something of the whole recording. `packed` is empty where a file
    has no chunks. `from_ros2` says whether a ROS 2 middleware serialised its messages.
    """

    channels: dict[int, Channel]
    counts: dict[int, int]
    span_ns: tuple[int, int] | None
    damage: list[Damage]
    notes: list[str]
    extras: list[Extra]
    metadata: list[Metadata]
    packed: list[Packed]
    from_ros2: bool

    @property
    def integrity(self) -> Integrity:
        """Return whether checksums confirm what was read so far."""
        ...

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """Yield the messages of these channels, in file order within each channel."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


class Opener(Protocol):
    """Opens one file of a container; with `salvage`, what can be read of a damaged one."""

    def __call__(self, path: Path, *, salvage: bool, watch: Watch) -> Storage: ...


@dataclass(frozen=True)
class Container:
    """A file format of recordings: a row of `containers.discover.CONTAINERS`."""

    name: str
    endings: tuple[str, ...]  # of its files' names
    claims: Callable[[bytes], bool]  # by a file's first `HEAD_BYTES`
    open: Opener
    format: str  # what a store calls a recording that is one such file
    bag_format: str  # and one that is a folder of them
