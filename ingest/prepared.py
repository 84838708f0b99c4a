"""Recordings whose files are written, and their commit: several at once where many are read.

Nothing of a recording shows before its commit, so a process that is killed loses what waited and no
more: the same command reads those again. The first one is committed when it is there; after that
those of GROUP_S seconds together, or as soon as MAX_WAITING wait.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from restock.errors import RecordingError, RestockError, StoreError
from restock.ingest.remove import remove_recordings
from restock.ingest.store.lineage import Ingest
from restock.ingest.store.repeated import RepeatedDrive
from restock.ingest.store.writer import Staged, StoreWriter
from restock.ingest.task.label_scores import LabelScore
from restock.ingest.task.tags import in_words
from restock.words import counted, quoted

GROUP_S = 5.0
MAX_WAITING = 64
Status = Literal["written", "tagged", "unchanged", "dry run"]
OnRepeat = Literal["keep", "refuse", "replace"]


@dataclass(frozen=True)
class IngestResult:
    """Outcome of one recording: the counts of its manifest, and its notes."""

    path: str
    status: Status
    manifest: dict[str, Any]  # the row of `recordings`, as plain values
    messages: dict[str, int] = field(default_factory=dict)  # of used topics; and of unused ones
    conditions: dict[str, int] = field(default_factory=dict)  # transitions a label holds on
    named: dict[str, int] = field(default_factory=dict)  # … and is the row's one condition
    exposures: dict[str, int] = field(default_factory=dict)  # transitions an exposure holds on
    scores: list[LabelScore] = field(default_factory=list)
    endings: dict[str, int] = field(default_factory=dict)  # episodes by what ended them
    lost_messages: list[str] = field(default_factory=list)  # or lost bytes, and why
    contradictions: list[str] = field(default_factory=list)  # of topics; kept in the rows
    notes: list[str] = field(default_factory=list)
    version: int | None = None  # of the store's transitions, where they were written
    repeats: RepeatedDrive | None = None  # one in the store with largely the same rows

    @property
    def lossy(self) -> bool:
        """Return whether data of the topics used was lost, or contradicts itself."""
        return bool(self.lost_messages or self.contradictions)


@dataclass(frozen=True)
class Prepared:
    """A recording that was read, and what is left to do: its commit, unless there is none."""

    result: IngestResult  # as it is once it is committed
    staged: Staged | None = None
    repeated: OnRepeat | None = None  # None: not looked for
    period_s: float = 0.0  # its control period


def commit_all(
    store: StoreWriter, prepared: Sequence[Prepared]
) -> list[IngestResult | StoreError | RecordingError]:
    """Commit recordings, several in one; what became of each, in their order.

    One that cannot be committed costs itself alone.
    """
    outcomes: dict[int, IngestResult | StoreError | RecordingError] = {}
    group: dict[int, Prepared] = {}
    for place, one in enumerate(prepared):
        # Of one recording the later ingest replaces the earlier, in a commit of its own.
        if one.staged and one.staged.recording_id in {_id(other) for other in group.values()}:
            outcomes |= _commit(store, group)
            group = {}
        if one.staged is None:
            outcomes[place] = one.result
        elif refused := _refusal(store, one, list(group.values())):
            store.discard([one.staged])
            outcomes[place] = refused
        else:
            group[place] = one
    outcomes |= _commit(store, group)
    return [outcomes[place] for place in range(len(prepared))]


def _id(one: Prepared) -> str | None:
    return one.staged.recording_id if one.staged else None


def _refusal(
    store: StoreWriter, one: Prepared, before: Sequence[Prepared]
) -> RecordingError | StoreError | None:
    """Why a recording is not to be committed: it is in the store, or before it in its group."""
    if one.staged is None or one.repeated in (None, "keep"):
        return None
    ahead = [other.staged for other in before if other.staged]
    try:
        found = store.repeated(one.staged, one.period_s, ahead=ahead)
    except StoreError as error:
        return error
    if found is None or (one.repeated == "replace" and found.the_less):
        return None
    remedy = "leave it out, or use --repeated keep to ingest it anyway"
    if found.the_less:  # as of a recording that was still being written, or salvaged
        remedy = (
            f"this one holds more of the drive: {_removal(store, found.recording_id)} takes that"
            " one out; then ingest this one again (--repeated replace does both), or keep both with"
            " --repeated keep"
        )
    return RecordingError(str(found), where=one.result.path, remedy=remedy)


def _removal(store: StoreWriter, recording_id: str) -> str:
    return f"`restock store remove {quoted(store.path)} {recording_id}`"


def _commit(
    store: StoreWriter, group: dict[int, Prepared], *, begun: bool = False
) -> dict[int, IngestResult | StoreError | RecordingError]:
    """Commit all in one, or if that fails, each alone; `begun` if a commit of several had begun."""
    staged = {place: one.staged for place, one in group.items() if one.staged}
    several = list(staged.values())
    if not several:
        return {}
    try:
        store.fit(several)
        begun = True
        version = store.commit_staged(several)
    except StoreError as error:
        if len(group) > 1:
            outcomes = [_commit(store, {place: one}, begun=begun) for place, one in group.items()]
            return {place: outcome for one in outcomes for place, outcome in one.items()}
        (store.take_back if begun else store.discard)(several)
        return dict.fromkeys(group, error)
    except BaseException:
        (store.take_back if begun else store.discard)(several)
        raise
    later = [Ingest(one.recording_id, one.ingest_id, 0) for one in staged.values()]
    found: dict[int, IngestResult | StoreError | RecordingError] = {}
    for place, one in group.items():
        later = later[1:]
        found[place] = _finished(store, one, staged[place], version, later)
    return found


def _finished(
    store: StoreWriter, one: Prepared, staged: Staged, version: int, later: Sequence[Ingest]
) -> IngestResult | StoreError:
    """Build the result of a committed recording, ignoring the `later` ones of its group."""
    repeats = None
    if one.repeated is not None:
        # Looked for after the commit: another process may have written the same drive meanwhile.
        try:
            repeats = store.repeated(staged, one.period_s, aside={i.ingest_id for i in later})
        except StoreError as error:
            return error
    notes = list(one.result.notes)
    if repeats is not None and one.repeated == "replace":
        try:
            replaced_by, note = _replaced(store, repeats)
        except StoreError as error:
            replaced_by, note = None, f"a part of it stays in the store: {error}"
        version = replaced_by or version
        notes.append(note)
    elif repeats is not None:
        until = f"{repeats}; the audit `repeated_steps` fails until one of them is removed:"
        if repeats.the_less:
            how = f"{_removal(store, repeats.recording_id)} takes out that one, which holds less"
        else:
            how = f"{_removal(store, staged.recording_id)} takes this one out"
        notes.append(f"{until} {how}")
    return replace(one.result, version=version, repeats=repeats, notes=notes)


def _replaced(store: StoreWriter, part: RepeatedDrive) -> tuple[int | None, str]:
    """Remove a recording that is only a part of what was just ingested.

    Returns the store's version (None if the part stays) and a note for the user.
    """
    why = "it has steps that this one has not"
    if part.is_part:
        (reported,) = remove_recordings(store, [part.recording_id], dry_run=True).recordings
        if not reported.corrections:
            removed = remove_recordings(store, [part.recording_id])
            return removed.version, (
                f"in place of {part.source_file} (recording {part.recording_id}), a part of it, "
                "which was removed"
            )
        why = f"people corrected {counted(reported.corrections, 'label')} of it"
    return None, f"{part}. It stays, as {why}: {_removal(store, part.recording_id)} takes it out"


class CommitGroup:
    """Recordings that wait for their commit, and `results`, what became of those before, by place.

    `store` None is a dry run; `clock` gives seconds.
    """

    def __init__(
        self, store: StoreWriter | None, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.store, self.clock = store, clock
        self.results: dict[int, IngestResult | RestockError] = {}
        self.waiting: dict[int, Prepared] = {}
        self._first: dict[str, IngestResult] = {}  # of each recording, by id, in this ingest
        self._last_s: float | None = None  # when the last commit was done

    def add(self, place: int, one: Prepared | RestockError) -> None:
        """Take in what was made of a recording; commit where it is time."""
        if isinstance(one, RestockError):
            self.results[place] = one
        elif self.store is not None and (copy := self._copy(one.result)) is not None:
            self.store.discard([one.staged] if one.staged else [])
            self.results[place] = copy
        elif one.staged is None:
            self.results[place] = one.result
        else:
            self.waiting[place] = one
        self.commit_if_due()

    def _copy(self, result: IngestResult) -> IngestResult | None:
        """Return the result of a recording that came before under another path with other tags.

        The first path's tags stay. Otherwise each ingest of the two paths would change them.
        """
        first = self._first.setdefault(result.manifest.get("recording_id", ""), result)
        tags = first.manifest.get("tags") or {}
        if (result.manifest.get("tags") or {}) == tags:
            return None
        note = f"the same recording as {first.path}, whose tags it keeps: {in_words(tags)}"
        return IngestResult(result.path, "unchanged", first.manifest, notes=[note])

    def due_in_s(self) -> float | None:
        """Return the seconds until waiting recordings must be committed; None if none waits."""
        if not self.waiting:
            return None
        if self._last_s is None or len(self.waiting) >= MAX_WAITING:
            return 0.0
        return max(0.0, self._last_s + GROUP_S - self.clock())

    def commit_if_due(self) -> None:
        """Commit what waits, where it is time."""
        if self.due_in_s() == 0.0:
            self.commit()

    def settle(self, recording_id: str) -> None:
        """Commit what waits, where this recording does: it is about to be looked up."""
        if recording_id in {_id(one) for one in self.waiting.values()}:
            self.commit()

    def commit(self) -> None:
        """Commit what waits."""
        if not self.waiting or self.store is None:
            return
        # Once a commit has begun, what it is about is not discarded.
        waiting, self.waiting = self.waiting, {}
        outcomes = commit_all(self.store, list(waiting.values()))
        self.results |= dict(zip(waiting, outcomes, strict=True))
        self._last_s = self.clock()

    def discard(self) -> None:
        """Delete the files of what still waits."""
        staged = [one.staged for one in self.waiting.values() if one.staged]
        self.waiting = {}
        if self.store is not None:
            self.store.discard(staged)
