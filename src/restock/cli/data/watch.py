"""`restock ingest FOLDER --watch`: ingest recordings as they arrive, with a line of log per event.

A recording is complete if its files have kept their names, sizes and times for `STILL_S`, and if
its format has its end: an MCAP file has its footer; a bag's folder has the metadata.yaml that
rosbag2 writes last, and every file listed there; a LeRobot folder has as many frames as its info
counts. No state is kept on disk. A process that is started again ingests all recordings again; the
store recognises those that it holds by their content, and they are reported as unchanged.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn

from restock.cli.data.totals import IngestSummary, in_words, labels_of
from restock.cli.output import plain
from restock.errors import ConfigError, RecordingError, RestockError, StoreError, counted, visible
from restock.files import first_line
from restock.ingest.batch import IngestJob, Result, ingest_all
from restock.ingest.containers.mcap_records import MAGIC
from restock.ingest.containers.open_recording import (
    METADATA,
    bag_files,
    folder_container,
    read_metadata,
    recordings_in,
)
from restock.ingest.containers.storage import no_progress
from restock.ingest.store.writer import StoreWriter
from restock.process import was_interrupted
from restock.replay.places import open_place
from restock.replay.store.audit import load_audits, load_thresholds, run_audits
from restock.replay.store.query import query
from restock.replay.store.store import is_store

POLL_S = 2.0
STILL_S = 10.0
RETRY_S = 60.0  # after a failure that the recording did not cause: full disk, unreachable store
SALVAGE_AFTER_S = 600.0  # wait before --salvage ingests an incomplete recording

Stamp = tuple[tuple[str, int, int], ...]  # name, bytes and modification time of each file


@dataclass
class Watch:
    """Watches folders until it is interrupted.

    After it has written recordings, it prints coverage and audits and runs the command `hook`,
    which gets a JSON document about the new recordings on standard input. It does all three at the
    start too, because an earlier process may have been killed before it did.
    """

    folders: tuple[str, ...]
    job: IngestJob
    hook: str | None
    workers: int
    json: bool
    rows: dict[str, int] = field(default_factory=dict)  # rows of each condition, as last printed

    def __post_init__(self) -> None:
        for folder in self.folders:
            if not Path(folder).is_dir():
                raise ConfigError("not a folder, so nothing can arrive in it", where=folder)
        if self.job.repeated == "keep":  # replace recordings that were ingested incomplete
            self.job = replace(self.job, repeated="replace")
        self.arrivals = Arrivals(self.folders, self.job.salvage)
        self.summary = IngestSummary([Path(folder) / "recording" for folder in self.folders])

    def run(self) -> NoReturn:
        """Ingest complete recordings and follow up, again and again."""
        self.say("watch", ", ".join(self.folders))
        written: list[dict[str, Any]] = []  # rows for the next `follow_up`
        due_s = time.monotonic() if is_store(str(self.job.store)) else math.inf
        while True:
            _raise_interrupt()
            if new := self.take():
                written += new
                due_s = time.monotonic()
            if time.monotonic() >= due_s:
                done = self.follow_up(written)
                written, due_s = ([], math.inf) if done else (written, time.monotonic() + RETRY_S)
            time.sleep(POLL_S)

    def take(self) -> list[dict[str, Any]]:
        """Ingest the complete recordings; return a row about each that was written."""
        ready = self.arrivals.complete(time.monotonic())
        for event, there, why in self.arrivals.news:
            self.say(event, f"{self.summary.name(there)}: {why}" if why else there)
        written: list[dict[str, Any]] = []
        known = 0
        for path, result in self._ingested(ready):
            error = result if isinstance(result, RestockError) else None
            new = self.arrivals.take(path, error, time.monotonic())
            if isinstance(result, RestockError):
                if new:
                    event = "failed" if transient(result) else "refused"
                    self.say(event, f"{self.summary.name(path)}: {first_line(result.what)}")
            elif result.status == "unchanged":
                known += 1
            else:
                self.say(result.status, self.summary.add(result).partition(" ")[2].strip())
                row = {key: result.manifest[key] for key in ("recording_id", "transitions")}
                written.append({"path": str(path), **row, "labels": labels_of(result.conditions)})
        if known:
            self.say("unchanged", f"{counted(known, 'recording')}, in the store already")
        return written

    def _ingested(self, ready: Sequence[Path]) -> Iterator[Result]:
        """Ingest recordings; if the store or disk fails, yield an error for each remaining one."""
        left = list(ready)
        try:
            for path, result in ingest_all(ready, self.job, workers=self.workers):
                left.remove(path)
                yield path, result
        except (RestockError, OSError) as error:
            for path in left:
                yield path, StoreError(first_line(error))

    def follow_up(self, written: list[dict[str, Any]]) -> bool:
        """Print coverage and audits, and run the hook; return False if coverage or audits fail."""
        store, about = str(self.job.store), {"store": str(self.job.store), "recordings": written}
        try:
            StoreWriter(store).clean()
            with open_place(store, only_store=True) as opened:
                coverage = query(opened, "FROM coverage_by_condition", where=store)
                held = coverage.to_arrow_table().to_pylist()
                findings = run_audits(opened, load_audits(None), load_thresholds(None))
        except Exception as error:  # noqa: BLE001  (the recordings are in, and more will come)
            self.say("failed", f"coverage and audits: {first_line(error)}")
            return False
        rows = {row["condition"]: row["rows_held"] or 0 for row in held}
        grown = {name: number - self.rows.get(name, 0) for name, number in rows.items()}
        more = f" (new: {in_words({k: n for k, n in grown.items() if n}) or 'none'})"
        self.say("coverage", in_words(rows) + (more if self.rows else ""))
        self.rows = rows
        found = {
            status: [one.audit.name for one in findings if one.status == status]
            for status in ("fail", "warn")
        }
        wrong = [f"{status}: {', '.join(names)}" for status, names in found.items() if names]
        self.say("audit", "; ".join(wrong) or "passed")
        if self.hook is not None:
            self._run_hook({**about, "coverage": rows, "audit": found})
        return True

    def _run_hook(self, about: dict[str, Any]) -> None:
        assert self.hook is not None
        text = json.dumps(plain(about))
        done = subprocess.run(self.hook, shell=True, input=text, text=True, stdout=sys.stderr)
        self.say("hook", f"exit {done.returncode}")

    def say(self, event: str, what: str) -> None:
        """Print one line of log."""
        _raise_interrupt()
        at = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        if self.json:
            line = json.dumps({"at": at, "event": event, "what": what})
        else:
            line = f"{at} {event:<9} {visible(what)}"
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


def _raise_interrupt() -> None:
    """Raise KeyboardInterrupt if a library turned an interrupt into another error, or lost it."""
    if was_interrupted():
        raise KeyboardInterrupt


@dataclass
class _Arrival:
    stamp: Stamp
    since_s: float
    done: bool = False
    reported: str = ""  # the reason last reported for waiting or failing
    not_before_s: float = 0.0


@dataclass
class Arrivals:
    """The recordings in some folders. `news` has the events of the last scan: event, path, why."""

    folders: Sequence[str]
    salvage: bool = False
    news: list[tuple[str, str, str]] = field(default_factory=list)
    _known: dict[Path, _Arrival] = field(default_factory=dict)
    _absent: set[str] = field(default_factory=set)

    def complete(self, now_s: float) -> list[Path]:
        """Scan the folders; return the complete recordings that are not ingested yet."""
        self.news = []
        there = {path: stamp for path in self._found() if (stamp := stamp_of(path))}
        if not self._absent:  # keep all while a folder is missing: it may come back
            self._known = {path: arrival for path, arrival in self._known.items() if path in there}
        ready = []
        for path, stamp in there.items():
            arrival = self._known.get(path)
            if arrival is None or arrival.stamp != stamp:
                self._known[path] = _Arrival(stamp, now_s)
            elif not arrival.done and now_s >= max(arrival.since_s + STILL_S, arrival.not_before_s):
                why = incomplete(path)
                if why and not (self.salvage and now_s >= arrival.since_s + SALVAGE_AFTER_S):
                    self._report_wait(path, why)
                else:
                    ready.append(path)
        return ready

    def take(self, path: Path, error: RestockError | None, now_s: float) -> bool:
        """Record how an ingest ended; return False if the same error was reported before.

        A recording that was refused is tried again if its files change; any other failure is tried
        again later.
        """
        arrival = self._known.get(path)
        if arrival is None:
            return True
        if error is not None and transient(error):
            arrival.not_before_s = now_s + RETRY_S
        else:
            arrival.done = True
        what = "" if error is None else error.what
        new = error is None or what != arrival.reported
        arrival.reported = what
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
            except RecordingError:  # the folder is empty, or has just disappeared
                continue

    def _report_wait(self, path: Path, why: str) -> None:
        arrival = self._known[path]
        if arrival.reported != why:
            arrival.reported = why
            self.news.append(("waiting", str(path), why))


def stamp_of(path: Path) -> Stamp:
    """Return name, size and time of each file of a recording; empty if the recording is gone."""
    try:
        beside = path.with_name(f"{path.name}-wal")  # SQLite's write-ahead log
        files = sorted(path.rglob("*")) if path.is_dir() else [path, beside]
        found = [(file, file.stat()) for file in files if file.is_file()]
        return tuple((str(file), about.st_size, about.st_mtime_ns) for file, about in found)
    except OSError:  # it is being moved or removed
        return ()


def incomplete(path: Path) -> str:
    """Return why a recording whose files no longer change is incomplete; "" if it is complete."""
    try:
        if not path.is_dir():
            return _unfinished(path)
        if container := folder_container(path):
            with suppress(RecordingError):  # ingest reports this error
                damage = container.open(path, salvage=True, watch=no_progress).damage
                return damage[0].what if damage else ""
            return ""
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
    """Return whether a later attempt may succeed although the recording has not changed."""
    return isinstance(error, StoreError) or error.what.startswith(
        ("cannot be read", "out of memory", "the process that read it")
    )
