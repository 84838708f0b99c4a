"""Recordings whose files are written, and their commit: several at once where many are read.

A recording is visible only after its commit, so a killed process loses only those that waited: the
same command reads them again. The first recording is committed at once; after that, those of
GROUP_S seconds together, or as soon as MAX_WAITING wait. Recordings are also removed in one commit.
Neither their files nor their manifests are deleted then: earlier versions need them until the
retention is over, as they need replaced ones.
"""

from __future__ import annotations

import os.path
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path, PurePath
from typing import Any, Literal

from restock.errors import RecordingError, RestockError, StoreError, counted, expect, quoted
from restock.ingest.profile.tag_rules import in_words
from restock.ingest.store.lineage import Ingest
from restock.ingest.store.manifest import LabelScore
from restock.ingest.store.summary import RepeatedDrive
from restock.ingest.store.writer import Staged, StoreWriter

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
    """Commit recordings, several in one; return the result of each, in their order.

    If one cannot be committed, the others still are.
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
    """Return why a recording is not to be committed: it is in the store or earlier in its group."""
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
            f"this one holds more of the drive: {_removal(store, found.recording_id)} removes "
            "that one; then ingest this one again (--repeated replace does both), or keep both "
            "with --repeated keep"
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
            how = f"{_removal(store, repeats.recording_id)} removes that one, which holds less"
        else:
            how = f"{_removal(store, staged.recording_id)} removes this one"
        notes.append(f"{until} {how}")
    return replace(one.result, version=version, repeats=repeats, notes=notes)


def _replaced(store: StoreWriter, part: RepeatedDrive) -> tuple[int | None, str]:
    """Remove a recording that is only a part of what was just ingested.

    Returns the store's version (None if the part stays) and a note for the user.
    """
    why = "it has steps that this one lacks"
    if part.is_part:
        (reported,) = remove_recordings(store, [part.recording_id], dry_run=True).recordings
        if not reported.corrections:
            removed = remove_recordings(store, [part.recording_id])
            return removed.version, (
                f"in place of {part.source_file} (recording {part.recording_id}), a part of it, "
                "which was removed"
            )
        why = f"people corrected {counted(reported.corrections, 'label')} of it"
    return None, f"{part}. It stays, as {why}: {_removal(store, part.recording_id)} removes it"


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


OPERATION = "restock store remove"
ID_DIGITS = 16
PREFIX_DIGITS = 6  # of an id, at least
_MAX_NAMED = 5
_HEX = re.compile(rf"[0-9a-f]{{1,{ID_DIGITS}}}")


@dataclass(frozen=True)
class RemovedRecording:
    """A recording that was taken out of a store, or would be."""

    recording_id: str
    source_file: str  # as it was ingested
    transitions: int
    episodes: int
    corrections: int  # of its labels, by people: what ingesting it again does not bring back
    tags: Mapping[str, str]


@dataclass(frozen=True)
class Removed:
    """Recordings that were removed from a store, or would be."""

    recordings: list[RemovedRecording] = field(default_factory=list)
    left: int = 0  # recordings that stay
    version_before: int | None = None  # of the store: it has what was removed
    version: int | None = None  # without it; None where nothing was written


def remove_recordings(
    store: StoreWriter, names: Sequence[str], *, dry_run: bool = False
) -> Removed:
    """Take recordings out of a store, all or none of them.

    A recording is named by its id, by the first digits of it (PREFIX_DIGITS at least), or by the
    path that it was ingested by, of which the last parts are enough.

    Raises:
        StoreError: a name is of no recording in the store, or of several; one was ingested again
            meanwhile; the store cannot be written. Nothing is removed.
    """
    expect("store", store, StoreWriter, 'make it as StoreWriter("store")')
    store.expect_store()
    live = sorted(store.live().to_pylist(maps_as_pydicts="strict"), key=_by_path)
    chosen = _chosen(live, names, str(store.path))
    removed = [_removed(row) for row in chosen]
    left = len(live) - len(chosen)
    if dry_run or not chosen:
        return Removed(removed, left)
    ingests = {row["recording_id"]: row["ingest_id"] for row in chosen}
    before, version = store.remove_recordings(ingests, OPERATION)
    return Removed(removed, left, before, version)


def _removed(row: Mapping[str, Any]) -> RemovedRecording:
    return RemovedRecording(
        row["recording_id"],
        row["source_file"],
        row["transitions"],
        row["episodes"],
        len(row["corrections"] or ()),
        row["tags"] or {},
    )


def _by_path(row: Mapping[str, Any]) -> tuple[str, str]:
    return row["source_file"], row["recording_id"]


def _chosen(
    live: Sequence[dict[str, Any]], names: Iterable[str], where: str
) -> list[dict[str, Any]]:
    """Return the named manifests, each once. Raise StoreError if a name is ambiguous or unknown."""
    chosen: dict[str, dict[str, Any]] = {}
    problems = []
    for name in dict.fromkeys(names):
        found = _named(live, name)
        if len(found) == 1:
            chosen[found[0]["recording_id"]] = found[0]
        else:
            problems.append(_problem(live, name, found))
    if problems:
        raise StoreError(
            "\n    ".join(["nothing was removed:", *problems]),
            where=where,
            remedy="name each recording by its id (or at least its first"
            f" {PREFIX_DIGITS} digits) or its path; `restock sql {quoted(where)}"
            ' "SELECT recording_id, source_file FROM recordings"` lists them',
        )
    return sorted(chosen.values(), key=_by_path)


def _named(live: Sequence[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """Find the recordings that a name fits: by id or exact path, else by the path's end."""
    digits = name.lower()
    if len(digits) == ID_DIGITS and (found := [r for r in live if r["recording_id"] == digits]):
        return found
    is_prefix = len(digits) >= PREFIX_DIGITS and _HEX.fullmatch(digits)
    found = [
        row
        for row in live
        if (is_prefix and row["recording_id"].startswith(digits)) or _same_path(row, name)
    ]
    return found or [row for row in live if _ends_with(row, name)]


def _same_path(row: Mapping[str, Any], name: str) -> bool:
    return row["source_file"] == name or _absolute(row["source_file"]) == _absolute(name)


def _absolute(path: str) -> str:
    return os.path.normpath(Path(path).absolute())


def _ends_with(row: Mapping[str, Any], name: str) -> bool:
    """Return whether a path ends in these parts, as `logs/b.mcap` ends in `b.mcap`."""
    given = PurePath(name).parts
    return bool(given) and PurePath(row["source_file"]).parts[-len(given) :] == given


def _problem(live: Sequence[dict[str, Any]], name: str, found: Sequence[dict[str, Any]]) -> str:
    """Say why a name does not select one recording, and which ones it may mean."""
    if found:
        what = f"{name!r} is the name of {len(found)} recordings"
        return f"{what}: {_listed(found)}"
    digits = name.lower()
    if len(digits) < PREFIX_DIGITS and _HEX.fullmatch(digits):
        begin = [row for row in live if row["recording_id"].startswith(digits)]
        if begin:
            least = f"{PREFIX_DIGITS} digits at least"
            return f"{name!r} is too short for the beginning of an id ({least}): {_listed(begin)}"
    by_path = {row["source_file"]: row for row in live}
    files = {PurePath(path).name: path for path in by_path}
    near = [
        *get_close_matches(name, by_path, n=_MAX_NAMED),
        *(files[one] for one in get_close_matches(PurePath(name).name, files, n=_MAX_NAMED)),
    ]
    what = f"no recording {name!r} is in the store"
    if near := list(dict.fromkeys(near)):
        return f"{what}; similar: {_listed([by_path[path] for path in near])}"
    if not live:
        return f"{what}, which has no recordings"
    return f"{what}; it has {counted(len(live), 'recording')}: {_listed(live)}"


def _listed(rows: Sequence[dict[str, Any]]) -> str:
    named = [f"{row['recording_id']} ({row['source_file']})" for row in rows[:_MAX_NAMED]]
    more = len(rows) - len(named)
    return ", ".join(named) + (f", and {more:,} more" if more else "")
