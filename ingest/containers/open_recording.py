"""Opening recordings: from a path to columns, whatever the container.

with open_recording(Path("logs/run.mcap")) as recording:
    columns = recording.read({"/odom": ["twist.twist.linear.x", "header.stamp"]})
columns["/odom"].fields["twist.twist.linear.x"]  # (N,) float64
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from restock.errors import RecordingError, visible
from restock.ingest.containers import discover
from restock.ingest.containers.discover import METADATA, BagMetadata, recordings_in
from restock.ingest.containers.formats.compression import decompress_file
from restock.ingest.containers.formats.storage import Container, Damage, Storage, Watch, unwatched
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import Account, LostMessages, TopicInfo
from restock.ingest.decoding.columns import Ragged, TopicColumns
from restock.ingest.decoding.decoders import READABLE
from restock.ingest.decoding.definitions import DEFAULT_DISTRO, refuse_unknown


def open_recording(
    path: Path | str,
    *,
    typestore: str | None = None,
    salvage: bool = False,
    watch: Watch | None = None,
) -> Recording:
    """Open an MCAP file, a rosbag2 folder or one of its files, or a ROS 1 bag.

    Args:
        path: the file or folder.
        typestore: the distribution ("humble", "jazzy", …) whose message definitions are used
            where a recording carries none, as older sqlite3 bags do; `humble+/a/folder` has those
            of the folder's .msg and .idl files on top.
        salvage: read what can still be read of a file that is cut short or damaged, instead of
            refusing it; what is missing is in the recording's `lost_messages`.
        watch: is told how far a long opening, and later a long read, is: what is being done, how
            much of it is done, and of how much.

    Raises:
        RecordingError: no such file, empty, a Git LFS pointer, no recording, cut short (unless
            `salvage`), or in a serialisation that is not CDR.
    """
    path = discover.recording_path(path)
    distro = typestore or DEFAULT_DISTRO
    refuse_unknown(distro)  # before anything is opened
    return _Opening(path, distro, salvage, watch or unwatched).open()


def refuse_no_recording(path: Path) -> None:
    """Refuse what is no recording by its files' names and first bytes, which are quick to read.

    Raises:
        RecordingError: it is none; one that is damaged further on is not refused.
    """
    opening = _Opening(path, DEFAULT_DISTRO, False, unwatched)
    for file in opening.files():
        discover.container_of(file)


def with_definitions(typestore: str | None, folder: Path | None) -> str | None:
    """Name a type store with a folder's .msg and .idl files on top: `humble+/the/folder`.

    Raises:
        RecordingError: no such distribution or folder, or no definition in it that can be read.
    """
    if folder is None:
        return typestore
    name = f"{typestore or DEFAULT_DISTRO}+{folder.absolute()}"
    refuse_unknown(name)
    return name


class _Opening:
    """Opens the files of one recording, and closes them again if one is refused."""

    def __init__(self, path: Path, distro: str, salvage: bool, watch: Watch) -> None:
        self.path, self.distro, self.salvage = path, distro, salvage
        self.watch = watch
        self.storages: list[Storage] = []
        self.containers: list[Container] = []
        self.damage: list[Damage] = []
        self.missing: list[str] = []  # files that metadata.yaml lists
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
                return self._bag()
            there = self.path.exists()
        except OSError as error:
            raise discover.cannot_be_read(error, self.path) from error
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
        files = self._opened(files)
        self._refuse_serialisation(metadata)
        self._compare(metadata, files)
        recording = Recording(
            *(self.path, self._format(), files, self.storages, self.distro),
            *(self.damage, self.notes, self.cleanup),
            metadata=[metadata.custom_data] if metadata.custom_data else [],
        )
        recording.watch = self.watch
        return recording

    def _opened(self, files: list[Path]) -> list[Path]:
        """Open these files; with `salvage`, one of several that cannot be opened is damage."""
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

    def _bag(self) -> tuple[list[Path], BagMetadata]:
        if not discover.is_bag(self.path):
            raise RecordingError(
                f"a folder that is not a bag: it has no {METADATA}",
                where=str(self.path),
                remedy="give one recording of it (`restock info` lists them)",
            )
        metadata, problem = discover.read_metadata(self.path)
        if problem:
            self.notes.append(problem)
        files, missing, copies = discover.bag_files(self.path, metadata)
        if not files:
            listed = f"; {METADATA} lists {', '.join(missing)}" if missing else ""
            raise RecordingError(
                f"a bag without its storage files{listed}",
                where=str(self.path),
                remedy="copy the whole folder",
            )
        self.missing, self.notes = missing, [*self.notes, *copies]
        lacking = discover.holes(files, from_zero=not metadata.files)
        if names := [name for name in lacking if name not in missing]:
            more = f" and {len(names) - 10:,} more" if len(names) > 10 else ""
            are = "is" if len(names) == 1 else "are"
            self.damage.append(
                Damage(f"{', '.join(names[:10])}{more} {are} missing, by the numbers of its files")
            )
        return files, metadata

    def _open_file(self, file: Path, *, inner: bool = False) -> None:
        container = discover.container_of(file)
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

    def _refuse_serialisation(self, metadata: BagMetadata) -> None:
        """rosbag2 can store what other middlewares serialise: only CDR can be decoded."""
        ros2 = [storage for storage in self.storages if storage.from_ros2]
        encodings = {channel.encoding for storage in ros2 for channel in storage.channels.values()}
        claimed = {topic.serialization for topic in metadata.topics if topic.serialization}
        for names in (encodings, claimed):
            if names and not names & set(READABLE):
                listed = ", ".join(sorted(map(repr, names)))
                raise RecordingError(
                    f"its messages are serialised as {listed}, and only CDR is supported",
                    where=str(self.path),
                    remedy="`ros2 bag convert` with that middleware installed rewrites it as cdr",
                )

    def _compare(self, metadata: BagMetadata, files: list[Path]) -> None:
        """Compare metadata.yaml with the files.

        Messages that it counts and they do not hold are lost; what they hold beyond it is noted.
        Names that it lists do not matter if every message is there.
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
        held = [sum(storage.counts.values()) for storage in self.storages]
        for file, here, later in zip(files, held, range(1, len(held) + 1), strict=True):
            if not here and any(held[later:]) and not whole:  # rosbag2 begins a file by a message
                self.damage.append(Damage(f"{file.name} holds no message"))
        for topic in metadata.topics:
            if topic.name is None or topic.messages is None:
                continue
            name = visible(topic.name)  # as the files' names are
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


__all__ = [
    "Account",
    "LostMessages",
    "Ragged",
    "Recording",
    "TopicColumns",
    "TopicInfo",
    "open_recording",
    "recordings_in",
    "refuse_no_recording",
]
