"""The journal of a review: each verdict is on the disk before the page is told that it was taken.

It is a file of lines of JSON in the store's folder, `review.jsonl`, to which several servers may
append. A verdict names those that it replaces; it counts until another replaces it, or it was
written into the store. Two that count and say the opposite of a step are in conflict: neither is
written until somebody who saw both decides.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from restock.errors import LabelError, StoreError
from restock.files import first_line
from restock.ingest.relabel import Corrected, correct_store, open_for_relabel
from restock.ingest.store.location import Location
from restock.replay.review.verdicts import Reading, Verdicts, refuse
from restock.replay.store.store import Store

NAME = "review.jsonl"
MAX_NOTE = 2_000  # letters
Step = Annotated[int, Meta(ge=0, le=999_999_999)]
_TRIES = 3  # to write verdicts into a store that others write to


class Entry(msgspec.Struct, frozen=True, tag="verdict", tag_field="kind"):
    """One verdict: of a condition on some steps of an episode, as a review file's line has it."""

    id: Annotated[str, Meta(min_length=1, max_length=40)]
    by: Annotated[str, Meta(max_length=40)]  # the browser, a random name
    event: str
    episode_id: str
    condition: str
    first_step: Step
    last_step: Step
    # yes, no, FIRST..LAST; empty: takes back those that it replaces
    verdict: Annotated[str, Meta(pattern=r"^(yes|no|[0-9]{1,9}\.\.[0-9]{1,9}|)$")]
    start_s: float | None = None
    note: Annotated[str, Meta(max_length=MAX_NOTE)] = ""
    at: str = ""  # UTC, by the server's clock
    instead_of: tuple[str, ...] = ()

    @property
    def line(self) -> dict[str, str]:
        """Return it as a line of a review file."""
        names = ("episode_id", "condition", "first_step", "last_step", "verdict")
        start = "" if self.start_s is None else f"{self.start_s:.3f}"
        return {**{name: str(getattr(self, name)) for name in names}, "start_s": start}

    def says(self) -> list[tuple[int, int, bool]]:
        """Return what it says: first and last step of each stretch, and whether it holds there."""
        own = (self.first_step, self.last_step)
        first, dots, last = self.verdict.partition("..")
        if not dots:
            return [(*own, self.verdict == "yes")]
        true = (int(first), int(last))
        rest = [(own[0], min(own[1], true[0] - 1)), (max(own[0], true[1] + 1), own[1])]
        return [(*true, True), *((low, high, False) for low, high in rest if low <= high)]


class Applied(msgspec.Struct, frozen=True, tag="applied", tag_field="kind"):
    """A note that verdicts were written into the store."""

    ids: tuple[str, ...]
    version: int | None  # of the store
    at: str = ""


Line = Entry | Applied


def entries_of(text: str, where: str) -> list[Line]:
    """Read lines of a journal, or a page's file of verdicts, which is a JSON array of them.

    Raises:
        LabelError: a line is no verdict.
    """
    found: list[Line] = []
    what, remedy = (
        "is no file of verdicts",
        "give the file that the review page saved, or a .csv file",
    )
    try:
        if text.lstrip().startswith("["):
            return list(msgspec.json.decode(text, type=list[Line]))
        for number, line in enumerate(text.splitlines(), start=1):
            what, remedy = f"line {number} is no verdict", "remove or restore the line"
            if line.strip():
                found.append(msgspec.json.decode(line, type=Line))
    except msgspec.MsgspecError as error:
        raise LabelError(f"{what}: {error}", where=where, remedy=remedy) from error
    return found


class Journal:
    """The verdicts on one store. Without a `path` they are in memory only."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.lines: list[Line] = []
        self._read_bytes = 0

    @classmethod
    def of(cls, store: Location) -> Journal:
        """Open the journal of a store in a folder; that of another place is in memory."""
        journal = cls(None if store.folder is None else store.folder / NAME)
        journal.refresh()
        return journal

    def refresh(self) -> None:
        """Read what others have appended.

        A last line without an end is one that a killed server did not finish: it was not taken.
        """
        if self.path is None or not self.path.exists():
            return
        with self.path.open("rb") as stream:
            if os.fstat(stream.fileno()).st_size < self._read_bytes:  # restored from a copy
                self._read_bytes, self.lines = 0, []
            stream.seek(self._read_bytes)
            text = stream.read()
        whole = text[: text.rfind(b"\n") + 1]
        self.lines += entries_of(whole.decode("utf-8", "replace"), str(self.path))
        self._read_bytes += len(whole)

    def append(self, lines: Sequence[Line]) -> None:
        """Append lines together; they are on the disk when this returns.

        Raises:
            LabelError: the file cannot be written.
        """
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        lines = [msgspec.structs.replace(line, at=line.at or now) for line in lines]
        if self.path is None:
            self.lines += lines
            return
        try:
            with self.path.open("ab+") as stream:
                fcntl.flock(stream, fcntl.LOCK_EX)
                size = stream.seek(0, os.SEEK_END)
                if size:
                    stream.seek(size - 1)
                    if stream.read(1) != b"\n":  # what a killed server left is not a line
                        stream.seek(0)
                        stream.truncate(stream.read().rfind(b"\n") + 1)
                stream.write(b"".join(msgspec.json.encode(line) + b"\n" for line in lines))
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise LabelError(
                f"verdicts cannot be written: {error.strerror}",
                where=str(self.path),
                remedy="make the store's folder writable, or review in a file: `--out page.html`",
            ) from error
        self.refresh()

    def counting(self) -> list[Entry]:
        """Return the verdicts that count: not replaced, not taken back, not in the store yet."""
        gone = {
            name
            for line in self.lines
            for name in (line.ids if isinstance(line, Applied) else line.instead_of)
        }
        entries = [line for line in self.lines if isinstance(line, Entry)]
        return [one for one in entries if one.verdict and one.id not in gone]

    def conflicts(self) -> list[tuple[Entry, Entry]]:
        """Return pairs of verdicts that count and say the opposite of a step."""
        return list(conflicts_of(self.counting()))


def conflicts_of(entries: Iterable[Entry]) -> Iterable[tuple[Entry, Entry]]:
    """Yield pairs of verdicts that say the opposite of a step."""
    said: dict[tuple[str, str], list[Entry]] = {}
    for entry in entries:
        others = said.setdefault((entry.episode_id, entry.condition), [])
        for other in others:
            if any(
                value != theirs and first <= their_last and their_first <= last
                for first, last, value in entry.says()
                for their_first, their_last, theirs in other.says()
            ):
                yield other, entry
        others.append(entry)


@dataclass(frozen=True)
class Written:
    """What became of a journal's verdicts."""

    outcomes: list[Corrected] = field(default_factory=list)
    version: int | None = None  # of the store; None: its labels are as they were
    taken: int = 0
    held_back: list[str] = field(default_factory=list)  # why, a sentence each

    @property
    def document(self) -> dict[str, object]:
        """Return it as `--json` and the page have it."""
        return {
            "version": self.version,
            "verdicts": self.taken,
            "held_back": self.held_back,
            "recordings": [msgspec.to_builtins(one) for one in self.outcomes],
        }


def checked(entries: Sequence[Entry], store: Store) -> tuple[Verdicts, dict[int, str]]:
    """Check verdicts as the lines of a review file; return them, and problems by place."""
    reading = Reading(store)
    verdicts = reading.read(enumerate(entry.line for entry in entries))
    return verdicts, reading.problems


def write_verdicts(journal: Journal, place: Location, *, dry_run: bool = False) -> Written:
    """Write the verdicts that count into the store, in one commit.

    Those in conflict, and those whose rows were replaced, stay in the journal, and are named.

    Raises:
        StoreError: the store cannot be written, or others go on changing it.
    """
    for left in reversed(range(_TRIES)):
        try:
            return _write(journal, place, dry_run)
        except StoreError:  # perhaps another server has just written some of them
            if not left:
                raise
    raise AssertionError("unreachable")


def _write(journal: Journal, place: Location, dry_run: bool) -> Written:
    journal.refresh()
    held_back = []
    disputed: set[str] = set()
    for one, other in journal.conflicts():
        disputed |= {one.id, other.id}
        held_back.append(
            f"{one.condition} on {one.episode_id}: {one.verdict} for steps {one.first_step} to"
            f" {one.last_step}, but {other.verdict} for {other.first_step} to {other.last_step}"
        )
    entries = [one for one in journal.counting() if one.id not in disputed]
    with Store(place) as store:
        verdicts, problems = checked(entries, store)
        held_back += [problem for _, problem in sorted(problems.items())]
        entries = [one for number, one in enumerate(entries) if number not in problems]
    if not entries:
        return Written(held_back=held_back)
    outcomes, version = correct_store(open_for_relabel(str(place)), verdicts.given, dry_run=dry_run)
    if not dry_run:
        journal.append([Applied(tuple(one.id for one in entries), version)])
    return Written(outcomes, version, len(entries), held_back)


def take_file(path: Path, place: Location, *, dry_run: bool = False) -> Written:
    """Take the verdicts of a page's file into a store's journal, and from there into the store.

    Verdicts that were taken before are not taken again.

    Raises:
        LabelError: the file cannot be read, or a verdict does not fit the store; names it.
        StoreError: as `write_verdicts` does.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise LabelError(f"cannot be read: {first_line(error)}", where=str(path)) from error
    journal = Journal.of(place)
    known = {line.id for line in journal.lines if isinstance(line, Entry)}
    of_file = Journal(None)
    of_file.lines = entries_of(text, str(path))
    counting = {one.id for one in of_file.counting()}
    new = [one for one in of_file.lines if isinstance(one, Entry) and one.id not in known]
    with Store(place) as store:
        _, problems = checked([one for one in new if one.id in counting], store)
        refuse({number + 1: what for number, what in problems.items()}, str(path))
    if dry_run:
        rehearsal = Journal(None)
        rehearsal.lines = [*journal.lines, *new]
        return write_verdicts(rehearsal, place, dry_run=True)
    if new:
        journal.append(new)
    return write_verdicts(journal, place)
