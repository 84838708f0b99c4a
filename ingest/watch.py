"""A folder in which recordings arrive: which of them are complete, and not taken yet.

A recording is complete if its files have kept their names, sizes and times for `STILL_S`, and if it
says so itself: an MCAP file ends with its footer, and a bag's folder has the metadata.yaml that
rosbag2 writes last, and every file that it lists. Nothing is remembered on disk: the store knows
recordings by their content, so a process that was killed takes them all again, and those that are
in the store are unchanged.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from restock.errors import RecordingError, RestockError, StoreError
from restock.ingest.containers.mcap_records import MAGIC
from restock.ingest.containers.open_recording import (
    METADATA,
    bag_files,
    read_metadata,
    recordings_in,
)

STILL_S = 10.0
RETRY_S = 60.0  # after a failure that is not the recording's: a full disk, a store out of reach
SALVAGE_AFTER_S = 600.0  # with --salvage: what does not become complete is taken as it is

Stamp = tuple[tuple[str, int, int], ...]  # name, bytes and time of each file


@dataclass
class _Arrival:
    stamp: Stamp
    since_s: float
    done: bool = False
    said: str = ""  # why it waits, or failed
    not_before_s: float = 0.0


@dataclass
class Arrivals:
    """The recordings below some folders. `news`, (event, path, why), is what the last look saw."""

    folders: Sequence[str]
    salvage: bool = False
    news: list[tuple[str, str, str]] = field(default_factory=list)
    _known: dict[Path, _Arrival] = field(default_factory=dict)
    _absent: set[str] = field(default_factory=set)

    def complete(self, now_s: float) -> list[Path]:
        """Look at the folders; return the recordings that can be taken now."""
        self.news = []
        there = {path: stamp for path in self._found() if (stamp := stamp_of(path))}
        if not self._absent:  # a disk that is away forgets nothing
            self._known = {path: one for path, one in self._known.items() if path in there}
        ready = []
        for path, stamp in there.items():
            one = self._known.get(path)
            if one is None or one.stamp != stamp:
                self._known[path] = _Arrival(stamp, now_s)
            elif not one.done and now_s >= max(one.since_s + STILL_S, one.not_before_s):
                why = incomplete(path)
                if why and not (self.salvage and now_s >= one.since_s + SALVAGE_AFTER_S):
                    self._wait(path, why)
                else:
                    ready.append(path)
        return ready

    def take(self, path: Path, error: RestockError | None, now_s: float) -> bool:
        """Note how an ingest ended; return whether that is new.

        A recording that was refused is tried again if its files change; any other failure is tried
        again later.
        """
        one = self._known.get(path)
        if one is None:
            return True
        if error is not None and transient(error):
            one.not_before_s = now_s + RETRY_S
        else:
            one.done = True
        new, one.said = error is None or error.what != one.said, "" if error is None else error.what
        return new

    def _found(self) -> Iterable[Path]:
        for folder in self.folders:
            if not Path(folder).is_dir():
                if folder not in self._absent:
                    self._absent.add(folder)
                    self.news.append(("gone", folder, ""))
                continue
            if folder in self._absent:
                self._absent.discard(folder)
                self.news.append(("back", folder, ""))
            try:
                yield from recordings_in(folder)
            except RecordingError:  # none yet; or it went away just now, as the next look will say
                continue

    def _wait(self, path: Path, why: str) -> None:
        one = self._known[path]
        if one.said != why:
            one.said = why
            self.news.append(("waiting", str(path), why))


def stamp_of(path: Path) -> Stamp:
    """Return what changes while a recording is written; empty if it is gone."""
    try:
        beside = path.with_name(f"{path.name}-wal")  # where sqlite keeps what it wrote last
        files = sorted(path.rglob("*")) if path.is_dir() else [path, beside]
        found = [(file, file.stat()) for file in files if file.is_file()]
        return tuple((str(file), about.st_size, about.st_mtime_ns) for file, about in found)
    except OSError:  # it is being moved or removed
        return ()


def incomplete(path: Path) -> str:
    """Return why a recording whose files are still is not complete; "" if it is."""
    try:
        if not path.is_dir():
            return _unfinished(path)
        if not (path / METADATA).is_file():
            return f"no {METADATA} yet"
        files, missing, _ = bag_files(path, read_metadata(path)[0])
        if missing:
            return f"{METADATA} lists {missing[0]}, which is not there yet"
        return next(filter(None, map(_unfinished, files)), "")
    except OSError as error:
        return f"cannot be read: {error.strerror}"


def _unfinished(file: Path) -> str:
    with file.open("rb") as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            return "" if file.stat().st_size else f"{file.name} is empty"
        stream.seek(-len(MAGIC), 2)
        ended = stream.read() == MAGIC and stream.tell() > len(MAGIC)
    return "" if ended else f"{file.name} has no MCAP footer yet"


def transient(error: RestockError) -> bool:
    """Return whether a failure may be over later although the recording stays as it is."""
    return isinstance(error, StoreError) or error.what.startswith(
        ("cannot be read", "out of memory", "the process that read it")
    )
