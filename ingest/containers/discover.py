"""Find recordings: files, bag folders, folders of many, globs; and say what a file is.

A new container is a file with its `Container`, and a row in CONTAINERS.
"""

from __future__ import annotations

import filecmp
import glob
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from ruamel.yaml import YAML

from restock.errors import RecordingError, visible
from restock.ingest.containers.formats import mcap_file, ros1_file, sqlite_file
from restock.ingest.containers.formats.compression import ZSTD_MAGIC
from restock.ingest.containers.formats.storage import (
    HEAD_BYTES,
    INVALID_YAML,
    NOT_KEPT,
    Container,
    Metadata,
    custom_data,
)

CONTAINERS: tuple[Container, ...] = (
    mcap_file.CONTAINER,
    sqlite_file.CONTAINER,
    ros1_file.CONTAINER,
)


def claiming(head: bytes) -> Container | None:
    """Return the container that claims a file by its first bytes, or None."""
    return next((one for one in CONTAINERS if one.claims(head)), None)


def endings() -> tuple[str, ...]:
    """Return how the names of recordings' files end, without and with rosbag2's compression."""
    plain = [ending for one in CONTAINERS for ending in one.endings]
    return (*plain, *(ending + packed for packed in (".zstd", ".zst") for ending in plain))


T = TypeVar("T")
LFS_MAGIC = b"version https://git-lfs"
METADATA = "metadata.yaml"
LOST_AND_FOUND = "lost+found"  # at the top of a disk, for root alone
MAX_METADATA = 2 << 20  # real ones have some kB, and the parser is slow
_PART = re.compile(r"(.*_)(\d{1,4})(\..+)")  # of a bag that is split; longer ones are dates
_NAMES = (
    f"recordings end in {', '.join(name for one in CONTAINERS for name in one.endings)}"
    " or are rosbag2 folders"
)
_ZSTD = re.compile(r"\.zstd?$")


def recording_path(path: Path | str) -> Path:
    """Return the given path; an empty one is refused, as Path takes it for the working directory.

    Raises:
        RecordingError: it is empty.
    """
    if not str(path).strip():
        raise RecordingError(
            "the path of a recording is empty",
            remedy='is a variable of the shell not set? "." is the working directory',
        )
    return Path(path)


def recordings_in(path: Path | str) -> list[Path]:
    """Find the recordings at a path: a file, a bag's folder, a folder of many, or a glob.

    Folders are searched deeply. A bag with all its split files is one recording, named by its
    folder.

    Raises:
        RecordingError: no such path, or no recording in it.
    """
    path = recording_path(path)
    try:
        return _found(path)
    except OSError as error:  # the folder itself; one within it is named as a recording would be
        raise cannot_be_read(error, path) from error


def cannot_be_read(error: OSError, path: Path) -> RecordingError:
    """Build the error for a path that the file system does not let us read."""
    return RecordingError(
        f"cannot be read: {error.strerror or error}",
        where=str(error.filename or path),
        remedy="check its permissions, and that its disk is mounted",
    )


def _found(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    _refuse_special(path)
    if path.is_dir():
        recordings = _in_folder(path)
        if not recordings:
            links = sum(item.is_symlink() and item.is_dir() for item in path.iterdir())
            raise RecordingError(
                "no recording in this folder",
                where=str(path),
                remedy=f"links to folders ({links} in it) are not followed: give them directly, "
                f"as {path}/*"
                if links
                else _NAMES,
            )
        return recordings
    matches = sorted(Path(name) for name in glob.glob(str(path), recursive=True))  # noqa: PTH207
    every = list(dict.fromkeys(item for match in matches for item in _matched(match)))
    if matches and not every:
        raise RecordingError(
            f"none of the {len(matches):,} files and folders that match is a recording",
            where=str(path),
            remedy=_NAMES,
        )
    if every:
        return every
    raise RecordingError("no such file or folder", where=str(path))


def _refuse_special(path: Path) -> None:
    """Refuse pipes, sockets and devices: reading one would wait, or never end."""
    if path.exists() and not path.is_file() and not path.is_dir():
        raise RecordingError(
            "a pipe, a socket or a device, not a file",
            where=str(path),
            remedy="write it to a file first: recordings are read from several places at once",
        )


def _matched(match: Path) -> list[Path]:
    if match.is_dir():
        return _within(match)
    return [match] if is_storage_name(match) else []


def _in_folder(folder: Path) -> list[Path]:
    """Return a folder's recordings, and items that cannot be looked at.

    Opening such an item raises an error for it alone.
    """
    if is_bag(folder):
        return [folder]
    recordings = []
    for item in sorted(folder.iterdir()):
        if item.name.startswith(".") or item.name == LOST_AND_FOUND:
            continue
        if item.is_dir():
            recordings += [] if item.is_symlink() else _within(item)
        elif is_storage_name(item):  # a link into nowhere, or a pipe, too
            recordings.append(item)
    return recordings


def _within(folder: Path) -> list[Path]:
    try:
        return _in_folder(folder)
    except OSError:
        return [folder]


def is_storage_name(path: Path) -> bool:
    """Return whether a file is named like a recording."""
    return path.name.endswith(endings())


def is_bag(folder: Path) -> bool:
    """Return whether a folder is one rosbag2 bag: metadata.yaml, or split files of its name."""
    if (folder / METADATA).is_file():
        return True
    files = [item for item in folder.iterdir() if item.is_file() and is_storage_name(item)]
    split = re.compile(re.escape(folder.name) + r"_\d+\.")
    return bool(files) and all(split.match(item.name) for item in files)


@dataclass(frozen=True)
class ClaimedTopic:
    """Topic as metadata.yaml claims it; None if a value is missing or of another type."""

    name: str | None
    serialization: str | None
    messages: int | None


@dataclass(frozen=True)
class BagMetadata:
    """Claims of a bag's metadata.yaml, none of which is trusted."""

    files: tuple[str, ...] = ()  # names without folders: only files in the bag's own are read
    topics: tuple[ClaimedTopic, ...] = ()
    custom_data: Metadata | None = None


def bag_files(folder: Path, metadata: BagMetadata) -> tuple[list[Path], list[str], list[str]]:
    """Return a bag's storage files in order, listed names that are missing, and copies in words.

    Messages of a copy would count twice, so it is not read.
    """
    present = {item.name: item for item in folder.iterdir() if item.is_file()}
    storages = {name: item for name, item in present.items() if is_storage_name(item)}
    order = []
    missing = []
    for name in dict.fromkeys(metadata.files):
        # File-mode compression adds its ending, to the names in some versions' metadata only.
        options = (name, name + ".zstd", name + ".zst")
        match = next((option for option in options if option in present), None)
        if match is None:
            missing.append(name)
        elif match not in order:
            order.append(match)
    rest = sorted(storages.keys() - set(order), key=_natural)
    files: dict[str, Path] = {}  # by name without the ending of compression
    copies = []
    for name in (*order, *rest):
        file, stem = present[name], _ZSTD.sub("", name)
        same = files.get(stem) or next((one for one in files.values() if _equal(one, file)), None)
        if same is None:
            files[stem] = file
        else:
            copies.append(f"{name} is a copy of {same.name}: read once")
    return [*files.values()], missing, copies


def _equal(one: Path, other: Path) -> bool:
    size = one.stat().st_size
    return 0 < size == other.stat().st_size and filecmp.cmp(one, other, shallow=False)


def holes(files: Sequence[Path], *, from_zero: bool) -> list[str]:
    """Return the names that a bag's files lack by their numbers (`run_0.db3`, `run_2.db3`).

    rosbag2 counts from 0, but leaves out the first files if it keeps only the last.
    """
    series: dict[str, dict[int, str]] = {}
    for file in files:
        if part := _PART.fullmatch(file.name):
            series.setdefault(part[1], {})[int(part[2])] = part[3]
    return [
        f"{name}{number}{ending}"
        for name, parts in series.items()
        for number in range(0 if from_zero else min(parts), max(parts))
        for ending in [parts[max(parts)]]
        if number not in parts
    ]


def _natural(name: str) -> list[int | str]:
    parts = re.split(r"(\d+)", name)
    return [int(part) if index % 2 else part for index, part in enumerate(parts)]


def read_metadata(folder: Path) -> tuple[BagMetadata, str | None]:
    """Read the claims of metadata.yaml, and say what is wrong if it cannot be used."""
    file = folder / METADATA
    if not file.is_file():
        return BagMetadata(), f"no {METADATA}: read from the storage files alone"
    try:
        if file.stat().st_size > MAX_METADATA:
            return BagMetadata(), f"{METADATA} has {file.stat().st_size:,} bytes: not read"
        text = file.read_text(encoding="utf-8")
        document = YAML(typ="safe", pure=True).load(text)
        content = document["rosbag2_bagfile_information"]
    except INVALID_YAML as error:
        why = (str(error).splitlines() or [type(error).__name__])[0]
        return BagMetadata(), f"{METADATA} cannot be used: {visible(why[:200])}"
    if not isinstance(content, dict):
        return BagMetadata(), f"{METADATA} cannot be used: not a mapping"
    custom, problem = None, None
    try:
        custom, left_out = custom_data(text, METADATA)
        if left_out:
            problem = f"{METADATA}: {left_out:,} entries of custom_data: {NOT_KEPT}"
    except ValueError as error:
        problem = f"{METADATA}: {error}"
    listed = _items(content.get("relative_file_paths"), str)
    topics = _items(content.get("topics_with_message_count"), dict)
    return BagMetadata(
        tuple(Path(name).name for name in listed),
        tuple(
            ClaimedTopic(
                _of_type(topic["topic_metadata"].get("name"), str),
                _of_type(topic["topic_metadata"].get("serialization_format"), str),
                _of_type(topic.get("message_count"), int),
            )
            for topic in topics
            if isinstance(topic.get("topic_metadata"), dict)
        ),
        custom,
    ), problem


def _items(value: object, kind: type[T]) -> list[T]:
    return [item for item in value if isinstance(item, kind)] if isinstance(value, list) else []


def _of_type(value: object, kind: type[T]) -> T | None:
    return value if isinstance(value, kind) else None


def container_of(path: Path) -> Container | None:
    """Return the container that claims a file by its first bytes; None if it is compressed.

    Raises:
        RecordingError: it is missing, empty, a Git LFS pointer or not a recording.
    """
    where = str(path)
    _refuse_special(path)
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise RecordingError(f"cannot be read: {error.strerror}", where=where) from error
    if not head:
        raise RecordingError(
            "an empty file",
            where=where,
            remedy="was its copy interrupted? `--salvage` reads the other files of a bag",
        )
    if head.startswith(LFS_MAGIC):
        raise RecordingError(
            "a Git LFS pointer, not the recording itself",
            where=where,
            remedy="`git lfs pull` fetches the recording",
        )
    if head.startswith(ZSTD_MAGIC):
        return None
    if container := claiming(head):
        return container
    raise RecordingError(
        "not a recording: neither an MCAP, a sqlite3 nor a ROS 1 bag file by its first bytes",
        where=where,
        remedy=_NAMES,
    )
