"""Finds and opens recordings of all containers.

with open_recording(Path("logs/run.mcap")) as recording:
    columns = recording.read({"/odom": ["twist.twist.linear.x", "header.stamp"]})
columns["/odom"].fields["twist.twist.linear.x"]  # (N,) float64

A path may be a file, a bag's folder, a folder of recordings or a glob. To add a container, write a
module that defines its `Container`, and add that to CONTAINERS.
"""

from __future__ import annotations

import filecmp
import glob
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple, TypeVar

from restock.errors import RecordingError, visible
from restock.ingest.containers import mcap_file, ros1_file, sqlite_file
from restock.ingest.containers.recording import Recording, content_id
from restock.ingest.containers.storage import (
    HEAD_BYTES,
    LEROBOT_DATA,
    LEROBOT_INFO,
    NOT_KEPT,
    ZSTD_MAGIC,
    Container,
    Damage,
    Metadata,
    Storage,
    Watch,
    custom_data,
    decompress_file,
    no_progress,
    yaml_value,
)
from restock.ingest.decoding.definitions import DEFAULT_DISTRO, choose_definitions


def _open_lerobot(path: Path, *, salvage: bool, watch: Watch) -> Storage:
    from restock.ingest.containers.lerobot_folder import LeRobotFolder  # loads PyArrow, slow

    return LeRobotFolder(path, salvage=salvage, watch=watch)


def _lerobot_files(folder: Path) -> Iterator[Path]:
    yield folder / LEROBOT_INFO
    yield from sorted(folder.glob(LEROBOT_DATA))


LEROBOT = Container(
    name="LeRobot",
    endings=(),
    claims=lambda head: b'"codebase_version"' in head,
    open=_open_lerobot,
    format="lerobot-v3",
    bag_format="lerobot-v3",
    files=_lerobot_files,
)
CONTAINERS: tuple[Container, ...] = (
    *(mcap_file.CONTAINER, sqlite_file.CONTAINER, ros1_file.CONTAINER),
    LEROBOT,
)


def folder_container(folder: Path) -> Container | None:
    """Return the container whose format is this whole folder, or None."""
    for one in CONTAINERS:
        if one.files and (file := next(one.files(folder))).is_file():
            with file.open("rb") as stream:
                if one.claims(stream.read(FOLDER_HEAD_BYTES)):
                    return one
    return None


def endings() -> tuple[str, ...]:
    """Return the file name endings of recordings, without and with rosbag2's compression."""
    plain = [ending for one in CONTAINERS for ending in one.endings]
    return (*plain, *(ending + packed for packed in (".zstd", ".zst") for ending in plain))


T = TypeVar("T")
LFS_MAGIC = b"version https://git-lfs"
METADATA = "metadata.yaml"
LOST_AND_FOUND = "lost+found"  # at the top of a disk, readable by root alone
MAX_METADATA = 2 << 20  # bytes; real files have some kB, and the parser is slow
FOLDER_HEAD_BYTES = 1 << 20  # bytes read of the file by which a container recognises a folder
_PART = re.compile(r"(.*_)(\d{1,4})(\..+)")  # name of a bag's part; longer numbers are dates
_NAMES = (
    f"recordings end in {', '.join(name for one in CONTAINERS for name in one.endings)}"
    " or are folders of rosbag2 or LeRobot"
)
# The publishers' QoS profiles: most of metadata.yaml, not needed here, and slow to parse.
_QOS = re.compile(r"(?m)^( +)offered_qos_profiles:[ \t]*\n(?:\1[ -].*\n)+")
_ZSTD = re.compile(r"\.zstd?$")


def recording_path(path: Path | str) -> Path:
    """Return the path, unless it is empty: `Path` would make that the working directory.

    Raises:
        RecordingError: the path is empty.
    """
    if not str(path).strip():
        raise RecordingError(
            "the path of a recording is empty",
            remedy='is a variable of the shell not set? "." is the working directory',
        )
    return Path(path)


def recordings_in(path: Path | str) -> list[Path]:
    """Find the recordings at a path: a file, a bag's folder, a folder of recordings, or a glob.

    Folders are searched with all subfolders. A bag with all its split files is one recording, whose
    path is its folder.

    Raises:
        RecordingError: the path does not exist, or has no recording.
    """
    path = recording_path(path)
    try:
        return _find_recordings(path)
    except OSError as error:  # `path` cannot be read; an unreadable subfolder raises no error
        raise cannot_be_read(error, path) from error


def cannot_be_read(error: OSError, path: Path) -> RecordingError:
    """Build the error for a path that the file system refuses to read."""
    return RecordingError(
        f"cannot be read: {error.strerror or error}",
        where=str(error.filename or path),
        remedy="check its permissions, and that its disk is mounted",
    )


def _find_recordings(path: Path) -> list[Path]:
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
    found = [_search_folder(m) if m.is_dir() else [m] * is_storage_name(m) for m in matches]
    every = list(dict.fromkeys(chain.from_iterable(found)))
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


def _in_folder(folder: Path) -> list[Path]:
    """Return a folder's recordings, and its subfolders that cannot be read.

    Opening such a subfolder later raises an error for it alone.
    """
    if is_bag(folder) or folder_container(folder):
        return [folder]
    recordings = []
    for item in sorted(folder.iterdir()):
        if item.name.startswith(".") or item.name == LOST_AND_FOUND:
            continue
        if item.is_dir():
            recordings += [] if item.is_symlink() else _search_folder(item)
        elif is_storage_name(item):  # by name only: also a broken link or a pipe
            recordings.append(item)
    return recordings


def _search_folder(folder: Path) -> list[Path]:
    try:
        return _in_folder(folder)
    except OSError:
        return [folder]


def is_storage_name(path: Path) -> bool:
    """Return whether a file is named like a recording."""
    return path.name.endswith(endings())


def is_bag(folder: Path) -> bool:
    """Return whether a folder is a bag: with metadata.yaml or only storage files named after it."""
    if (folder / METADATA).is_file():
        return True
    files = [item for item in folder.iterdir() if item.is_file() and is_storage_name(item)]
    split = re.compile(re.escape(folder.name) + r"_\d+\.")
    return bool(files) and all(split.match(item.name) for item in files)


@dataclass(frozen=True)
class ClaimedTopic:
    """A topic in metadata.yaml. Values that are missing or of a wrong type are None."""

    name: str | None
    messages: int | None


@dataclass(frozen=True)
class BagMetadata:
    """The contents of a bag's metadata.yaml, which are not trusted."""

    files: tuple[str, ...] = ()  # names without folders: all are looked for in the bag's folder
    topics: tuple[ClaimedTopic, ...] = ()
    custom_data: Metadata | None = None


def bag_files(folder: Path, metadata: BagMetadata) -> tuple[list[Path], list[str], list[str]]:
    """Return a bag's storage files in order, names of missing ones, and notes on copies.

    A copy is not read, as its messages would count twice.
    """
    present = {item.name: item for item in folder.iterdir() if item.is_file()}
    storages = {name: item for name, item in present.items() if is_storage_name(item)}
    order = []
    missing = []
    for name in dict.fromkeys(metadata.files):
        # File-mode compression adds its ending to the file name; some versions do not list it.
        options = (name, name + ".zstd", name + ".zst")
        match = next((option for option in options if option in present), None)
        if match is None:
            missing.append(name)
        elif match not in order:
            order.append(match)
    rest = sorted(storages.keys() - set(order), key=_natural_key)
    files: dict[str, Path] = {}  # file name without .zstd or .zst -> file
    copies = []
    for name in (*order, *rest):
        file, stem = present[name], _ZSTD.sub("", name)
        same = files.get(stem) or next((f for f in files.values() if _same_content(f, file)), None)
        if same is None:
            files[stem] = file
        else:
            copies.append(f"{name} is a copy of {same.name}: read once")
    return [*files.values()], missing, copies


def _same_content(one: Path, other: Path) -> bool:
    size = one.stat().st_size
    return 0 < size == other.stat().st_size and filecmp.cmp(one, other, shallow=False)


def missing_numbers(files: Sequence[Path], *, from_zero: bool) -> list[str]:
    """Return the names of files missing in a bag's numbering (`run_0.db3`, `run_2.db3`).

    rosbag2 counts from 0. It may be set to keep only the last files: with `from_zero` False,
    missing first files are not reported.
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


def _natural_key(name: str) -> list[int | str]:
    parts = re.split(r"(\d+)", name)
    return [int(part) if index % 2 else part for index, part in enumerate(parts)]


def read_metadata(folder: Path) -> tuple[BagMetadata, str | None]:
    """Read metadata.yaml; also return what is wrong with it, or None."""
    file = folder / METADATA
    if not file.is_file():
        return BagMetadata(), f"no {METADATA}: read from the storage files alone"
    try:
        if file.stat().st_size > MAX_METADATA:
            return BagMetadata(), f"{METADATA} has {file.stat().st_size:,} bytes: not read"
        text = file.read_text(encoding="utf-8")
        content = yaml_value(_QOS.sub("", text), "rosbag2_bagfile_information")
    except ValueError as error:
        return BagMetadata(), f"{METADATA} cannot be used: {error}"
    if not isinstance(content, dict):
        return BagMetadata(), f"{METADATA} cannot be used: not a mapping"
    custom, problem = None, None
    try:
        custom, left_out = custom_data(text, METADATA)
        if left_out:
            problem = f"{METADATA}: {left_out:,} entries of custom_data: {NOT_KEPT}"
    except ValueError as error:
        problem = f"{METADATA}: {error}"
    listed = _list_of(content.get("relative_file_paths"), str)
    topics = _list_of(content.get("topics_with_message_count"), dict)
    return BagMetadata(
        tuple(Path(name).name for name in listed),
        tuple(
            ClaimedTopic(
                _of_type(topic["topic_metadata"].get("name"), str),
                _of_type(topic.get("message_count"), int),
            )
            for topic in topics
            if isinstance(topic.get("topic_metadata"), dict)
        ),
        custom,
    ), problem


def _list_of(value: object, kind: type[T]) -> list[T]:
    return [item for item in value if isinstance(item, kind)] if isinstance(value, list) else []


def _of_type(value: object, kind: type[T]) -> T | None:
    return value if isinstance(value, kind) else None


def container_of(path: Path) -> Container | None:
    """Return the container of a file, by its first bytes; None if it is compressed.

    Raises:
        RecordingError: it is missing, empty, a Git LFS pointer or not a recording.
    """
    where = str(path)
    if path.is_dir():
        return folder_container(path)
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
    if claim := next((one for one in CONTAINERS if not one.files and one.claims(head)), None):
        return claim
    raise RecordingError(
        "not a recording: neither an MCAP, a sqlite3 nor a ROS 1 bag file by its first bytes",
        where=where,
        remedy=_NAMES,
    )


class IdentifiedFile(NamedTuple):
    """An MCAP file, its recording id, and its state when that was computed."""

    path: Path
    recording_id: str
    state: tuple[int, ...]


def identify(
    path: Path | str, *, definitions: str | None = None, watch: Watch | None = None
) -> IdentifiedFile | None:
    """Return the id of a recording that is one MCAP file; None for others, which must be opened.

    Raises:
        RecordingError: `definitions` do not exist.
    """
    choose_definitions(definitions)
    path = Path(path)
    try:
        if not path.is_file():
            return None
        with path.open("rb") as file:
            if not mcap_file.CONTAINER.claims(file.read(HEAD_BYTES)):
                return None
        state = file_state(path)
        return IdentifiedFile(path, content_id([path], watch or no_progress), state)
    except OSError:  # opening the recording reports it
        return None


def file_state(path: Path) -> tuple[int, ...]:
    """Return a file's inode, size and time of change, to detect changes."""
    state = path.stat()
    return state.st_ino, state.st_size, state.st_mtime_ns


def open_recording(
    path: Path | str,
    *,
    definitions: str | None = None,
    salvage: bool = False,
    watch: Watch | None = None,
) -> Recording:
    """Open an MCAP file, a rosbag2 folder or one of its files, a ROS 1 bag or a LeRobot data set.

    Args:
        path: the file or folder.
        definitions: where message definitions come from if a recording carries none, as older
            sqlite3 bags do: a distribution ("humble", "jazzy", …), or a folder or file of .msg and
            .idl definitions, which is used on top of Humble's; "jazzy+a/folder" names both.
        salvage: read what can still be read of a file that is cut short or damaged, instead of
            refusing it; what is missing is in the recording's `lost_messages`.
        watch: called with the progress of a long opening or read: activity, how much is done,
            total.

    Raises:
        RecordingError: the file does not exist, is empty, a Git LFS pointer or not a recording,
            or cut short (unless `salvage`).
    """
    path = recording_path(path)
    distro = choose_definitions(definitions)  # may raise, so before a file is opened
    return _Opening(path, distro, salvage, watch or no_progress).open()


def reject_non_recording(path: Path) -> None:
    """Reject paths that are not recordings, by file name and magic bytes.

    Raises:
        RecordingError: the path is not a recording. Damage later in a file is not detected.
    """
    opening = _Opening(path, DEFAULT_DISTRO, False, no_progress)
    for file in opening.files():
        container_of(file)


class _Opening:
    """Opens the files of one recording, and closes them again if one is refused."""

    def __init__(self, path: Path, distro: str, salvage: bool, watch: Watch) -> None:
        self.path, self.distro, self.salvage = path, distro, salvage
        self.watch = watch
        self.storages: list[Storage] = []
        self.containers: list[Container] = []
        self.damage: list[Damage] = []
        self.missing: list[str] = []  # files that metadata.yaml lists but that do not exist
        self.notes: list[str] = []
        self.cleanup: list[Callable[[], None]] = []

    def open(self) -> Recording:
        try:
            return self._open()
        except BaseException:
            for storage in self.storages:
                storage.close()
            for clean in self.cleanup:
                clean()
            raise

    def files(self) -> list[Path]:
        """Return the recording's storage files."""
        return self._files()[0]

    def _files(self) -> tuple[list[Path], BagMetadata]:
        try:
            if self.path.is_dir():
                if folder_container(self.path):
                    return [self.path], BagMetadata()
                return self._find_bag_files()
            there = self.path.exists()
        except OSError as error:
            raise cannot_be_read(error, self.path) from error
        if not there and self.path.is_symlink():
            raise RecordingError(
                f"a link to {self.path.readlink()}, which is not there",
                where=str(self.path),
                remedy="is its disk mounted? Otherwise remove the link",
            )
        if not there:
            raise RecordingError("no such file or folder", where=str(self.path))
        return [self.path], BagMetadata()

    def _open(self) -> Recording:
        files, metadata = self._files()
        files = self._open_files(files)
        self._compare(metadata, files)
        if files_of := self.containers[0].files:
            files = [*files_of(self.path)]
        recording = Recording(
            *(self.path, self._format(), files, self.storages, self.distro),
            *(self.damage, self.notes, self.cleanup),
            metadata=[metadata.custom_data] if metadata.custom_data else [],
        )
        recording.watch = self.watch
        return recording

    def _open_files(self, files: list[Path]) -> list[Path]:
        """Open files; return those that opened. With `salvage`, the others count as damage."""
        opened, refused = [], []
        for file in files:
            try:
                self._open_file(file)
                opened.append(file)
            except RecordingError as error:
                if not self.salvage:
                    raise
                self.damage.append(Damage(f"{file.name}: {error.what}"))
                refused.append(error)
        if not opened:
            raise refused[0]
        return opened

    def _find_bag_files(self) -> tuple[list[Path], BagMetadata]:
        if not is_bag(self.path):
            raise RecordingError(
                f"a folder that is not a bag: it has no {METADATA}",
                where=str(self.path),
                remedy="give one recording of it (`restock info` lists them)",
            )
        metadata, problem = read_metadata(self.path)
        if problem:
            self.notes.append(problem)
        files, missing, copies = bag_files(self.path, metadata)
        if not files:
            listed = f"; {METADATA} lists {', '.join(missing)}" if missing else ""
            raise RecordingError(
                f"a bag without its storage files{listed}",
                where=str(self.path),
                remedy="copy the whole folder",
            )
        self.missing, self.notes = missing, [*self.notes, *copies]
        lacking = missing_numbers(files, from_zero=not metadata.files)
        if names := [name for name in lacking if name not in missing]:
            more = f" and {len(names) - 10:,} more" if len(names) > 10 else ""
            are = "is" if len(names) == 1 else "are"
            self.damage.append(
                Damage(f"{', '.join(names[:10])}{more} {are} missing, by the numbers of its files")
            )
        return files, metadata

    def _open_file(self, file: Path, *, inner: bool = False) -> None:
        container = container_of(file)
        if container is not None:
            self.storages.append(container.open(file, salvage=self.salvage, watch=self.watch))
            self.containers.append(container)
        elif inner:
            raise RecordingError("compressed twice", where=str(self.path))
        else:
            self._open_compressed(file)

    def _open_compressed(self, file: Path) -> None:
        folder = tempfile.TemporaryDirectory(prefix="restock-")
        self.cleanup.append(folder.cleanup)
        plain = Path(folder.name) / file.with_suffix("").name
        if problem := decompress_file(file, plain, salvage=self.salvage):
            self.damage.append(Damage(f"{file.name}: {problem}"))
        try:
            self._open_file(plain, inner=True)
        except RecordingError as error:
            raise RecordingError(
                f"{error.what} (decompressed)", where=str(file), remedy=error.remedy
            ) from error

    def _format(self) -> str:
        names = {container.name for container in self.containers}
        if len(names) > 1:
            raise RecordingError(
                f"a bag that mixes {' and '.join(sorted(names))} files",
                where=str(self.path),
                remedy="give its files one by one",
            )
        container = self.containers[0]
        return container.bag_format if self.path.is_dir() else container.format

    def _compare(self, metadata: BagMetadata, files: list[Path]) -> None:
        """Compare metadata.yaml with the files.

        Counted messages that the files lack are lost; messages beyond the count are noted. A file
        that is listed but missing is only noted if the others have every counted message.
        """
        counts = Counter[str]()
        for storage in self.storages:
            for channel in storage.channels.values():
                counts[channel.topic] += storage.counts.get(channel.id, 0)
        claimed = {visible(t.name): t.messages or 0 for t in metadata.topics if t.name}
        whole = any(claimed.values()) and all(counts[name] == claimed[name] for name in claimed)
        for name in self.missing:
            what = f"{METADATA} lists {name}, which is missing"
            if whole:
                self.notes.append(f"{what}; every message that it counts is in the other files")
            else:
                self.damage.append(Damage(what))
        in_files = [sum(storage.counts.values()) for storage in self.storages]
        for file, count, later in zip(files, in_files, range(1, len(in_files) + 1), strict=True):
            if not count and any(in_files[later:]) and not whole:  # rosbag2 starts no empty file
                self.damage.append(Damage(f"{file.name} holds no message"))
        for topic in metadata.topics:
            if topic.name is None or topic.messages is None:
                continue
            name = visible(topic.name)  # as names are written in `counts`
            counted = counts[name]
            if counted == topic.messages:
                continue
            what = (
                f"{METADATA} counts {topic.messages} messages on {name}, the files hold {counted}"
            )
            if counted < topic.messages:
                self.damage.append(Damage(what, {-1: topic.messages - counted}))
            else:
                self.notes.append(what)
