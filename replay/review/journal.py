"""The journal of a review: each verdict is on disk before the page gets its confirmation.

It is a JSON Lines file in the store's folder, `review.jsonl`. Several servers may append to it. A
verdict names the verdicts that it replaces. It counts until another verdict replaces it, or it is
written into the store.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Annotated

import msgspec
from msgspec import Meta

from restock.errors import LabelError
from restock.ingest.relabel import Corrected, correct_store, open_for_relabel
from restock.ingest.store.location import Location
from restock.replay.review.verdicts import Line, check
from restock.replay.store.store import Store

NAME = "review.jsonl"
MAX_NOTE = 2_000  # characters


class Entry(Line, frozen=True, kw_only=True, tag="verdict", tag_field="kind"):
    """One verdict from a page; an empty verdict takes back the verdicts in `instead_of`."""

    id: Annotated[str, Meta(min_length=1, max_length=40)]
    by: Annotated[str, Meta(max_length=40)]  # a random name that stands for the browser
    event: str
    note: Annotated[str, Meta(max_length=MAX_NOTE)] = ""
    at: str = ""  # UTC, by the server's clock
    instead_of: tuple[str, ...] = ()  # ids of verdicts that it replaces


class Applied(msgspec.Struct, frozen=True, tag="applied", tag_field="kind"):
    """A journal line that says which verdicts were written into the store, and when."""

    ids: tuple[str, ...]
    version: int | None  # version of the store; None: no label changed
    at: str = ""


_LINES = msgspec.json.Decoder(Entry | Applied)


class Journal:
    """The verdicts on the labels of a store.

    Raises:
        LabelError: the store has no folder.
    """

    def __init__(self, place: Location) -> None:
        if place.folder is None:
            raise LabelError(
                "verdicts are kept in the store's folder, and this store has none",
                where=str(place),
                remedy=f"review it in a file: `restock review {place} --out review.csv`",
            )
        self.path = place.folder / NAME
        self.lines: list[Entry | Applied] = []
        self.refresh()

    def refresh(self) -> None:
        """Read the file again, because other servers may have appended to it.

        A last line without a newline is ignored: a killed server did not finish it.

        Raises:
            LabelError: a line is not valid.
        """
        text = self.path.read_bytes() if self.path.exists() else b""
        try:
            self.lines = _LINES.decode_lines(text[: text.rfind(b"\n") + 1])
        except msgspec.MsgspecError as error:
            raise LabelError(
                f"contains an invalid line: {error}",
                where=str(self.path),
                remedy="remove or restore the line",
            ) from error

    def append(self, lines: Sequence[Entry | Applied]) -> None:
        """Append all lines at once; they are on disk when this returns.

        Raises:
            LabelError: the file cannot be written.
        """
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        lines = [msgspec.structs.replace(line, at=line.at or now) for line in lines]
        try:
            with self.path.open("ab+") as stream:
                fcntl.flock(stream, fcntl.LOCK_EX)
                stream.seek(0)  # remove an unfinished last line of a killed server
                stream.truncate(stream.read().rfind(b"\n") + 1)
                stream.write(b"".join(msgspec.json.encode(line) + b"\n" for line in lines))
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise LabelError(
                f"verdicts cannot be written: {error.strerror}",
                where=str(self.path),
                remedy="make the store's folder writable, or review in a file: `--out review.csv`",
            ) from error
        self.refresh()

    def counting(self) -> list[Entry]:
        """Return the verdicts that are not replaced, not taken back, and not yet in the store."""
        gone = {
            name
            for line in self.lines
            for name in (line.ids if isinstance(line, Applied) else line.instead_of)
        }
        entries = [line for line in self.lines if isinstance(line, Entry)]
        return [one for one in entries if one.verdict and one.id not in gone]


@dataclass(frozen=True)
class Written:
    """The result of writing a journal's verdicts into the store."""

    outcomes: list[Corrected] = field(default_factory=list)
    version: int | None = None  # new version of the store; None: no label changed
    taken: int = 0  # number of verdicts written
    held_back: list[str] = field(default_factory=list)  # reason for each verdict not written

    @property
    def document(self) -> dict[str, object]:
        """Return the result as JSON values, for `--json` and for the page."""
        return {
            "version": self.version,
            "verdicts": self.taken,
            "held_back": self.held_back,
            "recordings": [msgspec.to_builtins(one) for one in self.outcomes],
        }


def write_verdicts(journal: Journal, place: Location) -> Written:
    """Write the verdicts that count into the store, in one commit.

    Verdicts that no longer fit the store's rows stay in the journal, and are reported.

    Raises:
        StoreError: the store cannot be written.
    """
    journal.refresh()
    entries = journal.counting()
    with Store(place) as store:
        found = check(enumerate(entries), store)
    held_back = [problem for _, problem in sorted(found.problems.items())]
    ids = tuple(one.id for number, one in enumerate(entries) if number not in found.problems)
    if not ids:
        return Written(held_back=held_back)
    outcomes, version = correct_store(open_for_relabel(str(place)), found.given)
    journal.append([Applied(ids, version)])
    return Written(outcomes, version, len(ids), held_back)
