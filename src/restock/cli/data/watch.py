"""`restock ingest FOLDER --watch`: take recordings as they arrive, one line of log an event."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn

from restock.cli.data.night import Night, in_words, labels_of
from restock.cli.output import plain
from restock.errors import ConfigError, RestockError, StoreError, counted, visible
from restock.files import first_line
from restock.ingest.batch import IngestJob, Result, ingest_all
from restock.ingest.store.writer import StoreWriter, fold_if_many
from restock.ingest.watch import RETRY_S, Arrivals, transient
from restock.process import was_interrupted
from restock.replay.places import open_place
from restock.replay.store.audit import load_audits, load_thresholds, run_audits
from restock.replay.store.query import query
from restock.replay.store.store import is_store

POLL_S = 2.0


@dataclass
class Watch:
    """Watch folders until it is interrupted.

    After recordings were written: coverage, audits, and the command `hook`. It gets what is new as
    JSON on its standard input. All three also come once at the start, because an earlier process
    may have been killed before them.
    """

    folders: tuple[str, ...]
    job: IngestJob
    hook: str | None
    workers: int
    json: bool
    rows: dict[str, int] = field(default_factory=dict)  # of each condition, as last said

    def __post_init__(self) -> None:
        for folder in self.folders:
            if not Path(folder).is_dir():
                raise ConfigError("not a folder, so nothing can arrive in it", where=folder)
        if self.job.repeated == "keep":  # a part that was taken too early leaves for the whole
            self.job = replace(self.job, repeated="replace")
        self.arrivals = Arrivals(self.folders, self.job.salvage)
        self.night = Night([Path(folder) / "recording" for folder in self.folders])

    def run(self) -> NoReturn:
        """Look, take, and sleep."""
        self.say("watch", ", ".join(self.folders))
        written: list[dict[str, Any]] = []  # that no follow-up has had yet
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
        """Ingest what is complete; return what was written."""
        ready = self.arrivals.complete(time.monotonic())
        for event, there, why in self.arrivals.news:
            self.say(event, f"{self.night.name(there)}: {why}" if why else there)
        written: list[dict[str, Any]] = []
        known = 0
        for path, result in self._ingested(ready):
            error = result if isinstance(result, RestockError) else None
            new = self.arrivals.take(path, error, time.monotonic())
            if isinstance(result, RestockError):
                if new:
                    event = "failed" if transient(result) else "refused"
                    self.say(event, f"{self.night.name(path)}: {first_line(result.what)}")
            elif result.status == "unchanged":
                known += 1
            else:
                self.say(result.status, self.night.add(result).partition(" ")[2].strip())
                row = {key: result.manifest[key] for key in ("recording_id", "transitions")}
                written.append({"path": str(path), **row, "labels": labels_of(result.conditions)})
        if known:
            self.say("unchanged", f"{counted(known, 'recording')}, in the store already")
        return written

    def _ingested(self, ready: Sequence[Path]) -> Iterator[Result]:
        """Ingest; what fails for all of them (the store, the disk) fails for each."""
        left = list(ready)
        try:
            for path, result in ingest_all(ready, self.job, workers=self.workers):
                left.remove(path)
                yield path, result
        except (RestockError, OSError) as error:
            for path in left:
                yield path, StoreError(first_line(error))

    def follow_up(self, written: list[dict[str, Any]]) -> bool:
        """Print coverage and audits, and run the hook; return whether that could be done."""
        store, about = str(self.job.store), {"store": str(self.job.store), "recordings": written}
        try:
            StoreWriter(store).clean()
            fold_if_many(StoreWriter(store))
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
        """Print one line, whatever is in it."""
        _raise_interrupt()
        at = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        if self.json:
            line = json.dumps({"at": at, "event": event, "what": what})
        else:
            line = f"{at} {event:<9} {visible(what)}"
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


def _raise_interrupt() -> None:
    """Raise the interrupt of which a library made an error of its own, or which it lost."""
    if was_interrupted():
        raise KeyboardInterrupt
