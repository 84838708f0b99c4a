"""Ingest of one recording: read columns, make steps, episodes, labels and rows, and commit them.

    profile = load_profile("warehouse_amr")
    outcome = ingest(Path("logs/run.mcap"), profile, store=StoreWriter("store"))

A recording is visible only after its commit. A killed process therefore loses only the recordings
that waited for theirs, and the same command reads those again. The first recording is committed at
once. Later ones are committed together every GROUP_S seconds, or as soon as MAX_WAITING wait.
"""

from __future__ import annotations

import time
import uuid
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from restock.errors import (
    ConfigError,
    RecordingError,
    RestockError,
    StoreError,
    counted,
    quoted,
    visible,
)
from restock.ingest.containers.mcap_file import metadata_of
from restock.ingest.containers.open_recording import file_state, identify, open_recording
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import Watch
from restock.ingest.profile.profile import Profile, parse_profile, profile_toml
from restock.ingest.profile.tag_rules import RecordingTags, in_words, resolve_tags
from restock.ingest.steps.cameras import OFF_CLOCK, KeptFrames, frame_rows
from restock.ingest.steps.episodes import Steps, explain_no_transitions, split, steps_of
from restock.ingest.steps.needs import as_recorded, read_topics, renamed_inputs
from restock.ingest.store.lineage import own_path
from restock.ingest.store.manifest import (
    LabelScore,
    correct_labels,
    corrections_in,
    definitions,
    label_scores,
    manifest_row,
    recorded_facts,
    rules_of,
    software_version,
    uncertain_conditions,
)
from restock.ingest.store.removal import remove_recordings
from restock.ingest.store.summary import RepeatedDrive, summarise
from restock.ingest.store.transitions import Provenance, recording_table, replaced
from restock.ingest.store.writer import Staged, StoreWriter, fold_if_many
from restock.ingest.task.conditions import NOMINAL, held
from restock.ingest.task.schema import recording_schema
from restock.process import Work, alone, interrupts_raised

GROUP_S = 5.0
MAX_WAITING = 64
Status = Literal["written", "tagged", "unchanged", "dry run"]
OnRepeat = Literal["keep", "refuse", "replace"]


@dataclass(frozen=True)
class IngestResult:
    """The outcome of ingesting one recording: its manifest, counts and notes."""

    path: str
    status: Status
    manifest: dict[str, Any]  # the row of `recordings`, as plain values
    messages: dict[str, int] = field(default_factory=dict)  # numbers of expected, decoded, unused
    conditions: dict[str, int] = field(default_factory=dict)  # label -> transitions it holds on
    named: dict[str, int] = field(default_factory=dict)  # label -> rows whose `condition` it is
    exposures: dict[str, int] = field(default_factory=dict)  # exposure -> transitions in it
    scores: list[LabelScore] = field(default_factory=list)
    endings: dict[str, int] = field(default_factory=dict)  # ending -> number of episodes
    lost_messages: list[str] = field(default_factory=list)  # lost messages or bytes, and why
    contradictions: list[str] = field(default_factory=list)  # topics that disagree; rows unchanged
    notes: list[str] = field(default_factory=list)
    version: int | None = None  # version of the table `transitions`, if this was committed
    repeats: RepeatedDrive | None = None  # a stored recording with largely the same rows

    @property
    def lossy(self) -> bool:
        """Return whether data of the used topics was lost or is contradictory."""
        return bool(self.lost_messages or self.contradictions)


Outcome = IngestResult | StoreError | RecordingError


@dataclass(frozen=True)
class Prepared:
    """A recording that was read and whose files are written, ready to commit."""

    result: IngestResult  # its version and `repeats` are filled in by the commit
    staged: Staged | None = None  # None: nothing to commit
    repeated: OnRepeat | None = None  # None: do not look for the same drive in the store


@interrupts_raised
def ingest(
    path: Path | str,
    profile: Profile,
    *,
    store: StoreWriter | None,
    force: bool = False,
    salvage: bool = False,
    definitions: str | None = None,
    repeated: OnRepeat = "keep",
    tags: Mapping[str, str] | None = None,
    watch: Watch | None = None,
) -> IngestResult:
    """Read one recording and write its transitions to the store (None: a dry run).

    A recording is skipped if it is in the store, written by this software with the same profile and
    conditions, unless `force`. `repeated` decides what happens if most of its rows are also in
    another stored recording (a copy, or a part of the same drive): "keep" keeps both and reports
    it, "refuse" raises, "replace" removes the other one if it is a part of this one and raises if
    this one holds no more. `tags` (robot, site, …) override the recording's own; "" removes a tag.
    If only tags or the profile's [robot] are new, the stored rows are written again with them, and
    the status is "tagged". `watch` is called with the activity, how much is done, and the total.

    Raises:
        RecordingError: it is not a recording, is damaged (unless `salvage`), does not fit the
            profile, gives no transition, has sources that contradict each other about a tag, or is
            refused as a repeated drive. The store is unchanged.
        StoreError: the store cannot be written.
    """
    options: dict[str, Any] = {"store": store, "force": force, "salvage": salvage, "watch": watch}
    options |= {"definitions": definitions, "repeated": repeated, "tags": tags or {}}
    prepared = alone(preparing(path, profile, **options))
    if store is None:
        return prepared.result
    (outcome,) = commit_all(store, [prepared])
    if not isinstance(outcome, IngestResult):
        raise outcome
    return outcome


def preparing(
    path: Path | str,
    profile: Profile,
    *,
    store: StoreWriter | None,
    force: bool,
    salvage: bool,
    definitions: str | None,
    repeated: OnRepeat,
    tags: Mapping[str, str],
    watch: Watch | None = None,
    settle: Callable[[str], None] = lambda recording_id: None,
) -> Work[Prepared]:
    """Prepare a recording in step with others, so that labels and summaries are computed together.

    `settle(recording_id)` is called before the recording is looked up in the store, so that the
    caller can first commit a waiting recording with this id.
    """
    file = before = None
    if store is not None and not force:
        file = identify(path, definitions=definitions, watch=watch)
    if store is not None and file is not None:
        settle(file.recording_id)
        before = store.manifest(file.recording_id)
        if before is not None and _unchanged(before, profile):
            metadata, stored = metadata_of(file.path), before.get("tags") or {}
            if metadata is not None and not _has_other_robot(before, profile):
                reported = resolve_tags(profile.tags, file.path, metadata, tags, stored)
                if reported.tags == stored:
                    return Prepared(IngestResult(str(path), "unchanged", before))
    with open_recording(path, definitions=definitions, salvage=salvage, watch=watch) as recording:
        renamed = renamed_inputs(profile, recording.topics)
        profile = as_recorded(profile, recording.topics)
        if file is not None and file.state == file_state(file.path):
            recording.recording_id = file.recording_id
        else:
            settle(recording.recording_id)
            before = store.manifest(recording.recording_id) if store is not None else None
        tagged = (before or {}).get("tags") or {}
        reported = resolve_tags(profile.tags, Path(path), recording.metadata, tags, tagged)
        if store is not None and before is not None and not force and _unchanged(before, profile):
            new: dict[str, Any] = {"tags": reported.tags}
            if _has_other_robot(before, profile):
                new["profile_toml"] = profile_toml(profile)
                new["uncertain_conditions"] = uncertain_conditions(profile)
            elif reported.tags == (before["tags"] or {}):
                return Prepared(IngestResult(str(path), "unchanged", before))
            staged = _tag(store, before, new)
            result = IngestResult(str(path), "tagged", before | new, notes=reported.notes)
            return Prepared(result, staged)
        try:
            reported = replace(reported, notes=[*reported.notes, *renamed])
            work = _Ingest(str(path), recording, profile, reported, repeated, before)
            return (yield from work.run(store))
        except RecordingError as error:
            if error.where:
                raise
            raise RecordingError(error.what, where=str(path), remedy=error.remedy) from error


def _unchanged(before: Mapping[str, Any], profile: Profile) -> bool:
    """Return whether the rows of this manifest were made with the profile's current definitions."""
    by_rules = {**before, "labels_version": rules_of(before["labels_version"])}
    return all(by_rules[name] == value for name, value in definitions(profile).items())


def _has_other_robot(before: Mapping[str, Any], profile: Profile) -> bool:
    """Return whether a recording was ingested with another [robot] in its profile."""
    stored = _stored_profile(before["profile_toml"])
    return stored is not None and stored.robot != profile.robot


@lru_cache(maxsize=64)  # many recordings share a profile
def _stored_profile(text: str) -> Profile | None:
    with suppress(ConfigError):  # a key of it may be gone from profiles since
        return parse_profile(text, where="profile_toml")
    return None


def _tag(store: StoreWriter, before: Mapping[str, Any], new: Mapping[str, Any]) -> Staged:
    """Stage a stored recording's rows again, with the `new` values in its manifest."""
    ingest_id = uuid.uuid4().hex[:16]
    manifest = {**before, "ingest_id": ingest_id, **new}
    rows = store.rows(before["recording_id"], before["ingest_id"])
    rows = replaced(rows, {"ingest_id": ingest_id})
    table = pa.Table.from_pylist([manifest], recording_schema())
    return store.stage(table, rows, instead_of=before["ingest_id"])


class _Ingest:
    """Runs the stages of ingest on one open recording."""

    def __init__(
        self,
        path: str,
        recording: Recording,
        profile: Profile,
        reported: RecordingTags,
        repeated: OnRepeat,
        before: Mapping[str, Any] | None,
    ) -> None:
        self.path, self.recording, self.profile, self.reported = path, recording, profile, reported
        self.repeated, self.before = repeated, before or {}
        self.corrections = corrections_in(before) if before else []
        self.ingest_id = uuid.uuid4().hex[:16]

    def run(self, store: StoreWriter | None) -> Work[Prepared]:
        profile, columns = self.profile, read_topics(self.recording, self.profile)
        steps = steps_of(profile, columns)
        del columns  # frees the values of all messages
        watch, ticks = self.recording.watch, len(steps)
        episodes = split(profile.task, steps)
        if not episodes.transitions:
            why, remedy = explain_no_transitions(steps, episodes)
            raise RecordingError(
                f"gives no transition with the profile {self.profile.name!r}: {why}",
                remedy=remedy
                or "choose another --profile, or correct its maximum ages; see docs/ingest.md",
            )
        provenance = Provenance(
            self.recording.recording_id, self.ingest_id, visible(self.path), software_version()
        )
        watch("rows and labels, ticks", 0, ticks)
        table, rows = yield from recording_table(
            *(profile, steps, episodes, provenance),
            done=lambda tick: watch("rows and labels, ticks", tick, ticks),
        )
        table, self.corrections = correct_labels(
            table, self.corrections, profile.conditions, steps.clock.offset_ns
        )
        named = Counter(table["condition"].to_pylist())
        first = {name: named[name] for name in (*rows.labels, NOMINAL)}
        scores = label_scores(table, rows.labels, profile.task.control_period_s)
        facts = recorded_facts(self.recording, steps, episodes, rows)
        facts |= {
            "tags": self.reported.tags,
            "labels_version": table["labels_version"][0].as_py(),
            "corrections": [asdict(one) for one in self.corrections],
        }
        kept = [KeptFrames.of(name, one, rows.tick) for name, one in steps.cameras.items()]
        losses, notes = self._describe_losses(steps), self._notes(steps, table)
        findings = [one.reported for one in steps.findings if not one.repaired]
        del steps  # frees the values of all ticks
        path = own_path(provenance.recording_id, self.ingest_id)
        file = path if sum(len(one.row) for one in kept) else ""
        facts["cameras"] = [one.manifest_row(self.recording, file) for one in kept]
        manifest = manifest_row(profile, provenance, table, scores, episodes.dropped, **facts)
        staged = None
        if store:
            row = pa.Table.from_pylist([manifest], recording_schema())
            row = yield summarise, (row, table)
            staged = self._stage(store, row, table, kept, file)
        holding = held(table["conditions"], list(rows.labels))
        counts = {name: int(holds.sum()) for name, holds in holding.items()}
        counts[NOMINAL] = first[NOMINAL]
        result = IngestResult(
            self.path,
            "written" if store else "dry run",
            manifest,
            self._count_messages(),
            counts,
            first,
            {name: int(holds[rows.starts].sum()) for name, holds in rows.exposures.items()},
            scores,
            dict(Counter(episode.ended_by for episode in episodes.episodes).most_common()),
            losses,
            findings,
            notes,
        )
        return Prepared(result, staged, self.repeated)

    def _stage(
        self,
        store: StoreWriter,
        row: pa.Table,
        table: pa.Table,
        kept: Sequence[KeptFrames],
        file: str,
    ) -> Staged:
        # With corrections, fail if another process has made further ones since they were read.
        read = self.before["ingest_id"] if self.corrections else None
        if not file:
            return store.stage(row, table, instead_of=read)
        try:
            self._write_frames(store, kept, file)
            return store.stage(row, table, instead_of=read)
        except BaseException:
            store.discard_frames(file)
            raise

    def _write_frames(self, store: StoreWriter, kept: Sequence[KeptFrames], file: str) -> None:
        """Write the camera frames to their file.

        Raises:
            RecordingError: a frame that was read before is missing now.
        """
        count = store.write_frames(
            file, (batch for one in kept for batch in frame_rows(self.recording, one))
        )
        if count != (due := sum(len(one.row) for one in kept)):
            raise RecordingError(
                f"{due - count} of {due} frames are missing: the recording changed in the meantime",
                where=self.path,
                remedy="ingest it again",
            )

    def _count_messages(self) -> dict[str, int]:
        accounts = self.recording.accounts.values()
        expected = sum(account.expected for account in accounts)
        return {
            "expected": expected,
            "decoded": sum(account.decoded for account in accounts),
            "unused": self.recording.messages - expected,
        }

    def _describe_losses(self, steps: Steps) -> list[str]:
        frames = [
            f"cameras.{name}: {reason} ({counted(count, 'message')})"
            for name, camera in steps.cameras.items()
            for reason, count in camera.problems.items()
            if count and reason != OFF_CLOCK  # reported for the topic, below
        ]
        lost = frames + [
            f"{loss.topic or 'the file'}: {loss.reason}"
            + (f" ({counted(loss.messages, 'message')})" if loss.messages is not None else "")
            for loss in self.recording.lost_messages
        ]
        return lost + [
            f"{topic}: left out, as their stamps do not fit the clock ({counted(count, 'message')})"
            for topic, count in steps.clock.off_clock.items()
        ]

    def _notes(self, steps: Steps, table: pa.Table) -> list[str]:
        clock = steps.clock
        notes = [*self.recording.notes, *self.reported.notes, *steps.notes]
        notes += [one.reported for one in steps.findings if one.repaired]
        if (other := self.before.get("profile", self.profile.name)) != self.profile.name:
            notes.append(
                f"replaces its {self.before['transitions']:,} transitions of the profile {other!r}:"
                " a store keeps one set of rows per recording (to keep both, as for several robots"
                " in it, ingest into another --store)"
            )
        if clock.pace is not None:
            notes.append(
                f"clock: header stamps run at {clock.pace:.1%} of log time; mapped piece by piece"
                f" by {clock.mapped_by}, within {clock.spread_ns * 1e-6:.1f} ms"
                " (1st to 99th percentile)"
            )
        elif clock.alignment == "header.stamp":
            where = "ahead of" if clock.offset_ns >= 0 else "behind"
            notes.append(
                f"clock: log time is {abs(clock.offset_ns) * 1e-9:,.3f} s {where} header stamps, "
                f"within {clock.spread_ns * 1e-6:.1f} ms (1st to 99th percentile)"
            )
        if clock.jumps:
            set_ = counted(clock.jumps, "time")
            notes.append(f"the alignment clock was set {set_}; each cuts an episode")
        for topic, count in clock.restamped.items():
            notes.append(
                f"{topic}: {counted(count, 'message')} older than the recording, put at log time"
            )
        if steps.commands_between:
            skipped = counted(steps.commands_between, "command")
            notes.append(f"{skipped} gave no step: less than 3/4 of a period after the last tick")
        residual = table["action_residual"].to_numpy()
        far = int((residual > 0.25).sum())
        if far:
            notes.append(
                f"{far} of {len(residual)} commands are more than 0.25 from the nearest action "
                f"(scaled distance; median {np.median(residual):.2f}, largest {residual.max():.2f})"
            )
        if self.corrections:
            idle = sum(not correction.rows for correction in self.corrections)
            notes.append(
                f"{len(self.corrections)} corrections of its labels are kept"
                + (
                    f"; {idle} of them are about conditions or steps that no longer exist"
                    if idle
                    else ""
                )
            )
        return notes


def commit_all(store: StoreWriter, prepared: Sequence[Prepared]) -> list[Outcome]:
    """Commit recordings together; return the result of each, in their order.

    If one cannot be committed, the others still are. Merges the manifest files if they are many.
    """
    outcomes: dict[int, Outcome] = {}
    group: dict[int, Prepared] = {}
    for place, item in enumerate(prepared):
        # A later ingest of the same recording replaces the earlier one, in a commit of its own.
        ids = {other.staged.recording_id for other in group.values() if other.staged}
        if item.staged and item.staged.recording_id in ids:
            outcomes |= _commit(store, group)
            group = {}
        if item.staged is None:
            outcomes[place] = item.result
        elif refused := _repeat_error(store, item, list(group.values())):
            store.discard([item.staged])
            outcomes[place] = refused
        else:
            group[place] = item
    outcomes |= _commit(store, group)
    fold_if_many(store)
    return [outcomes[place] for place in range(len(prepared))]


def _repeat_error(
    store: StoreWriter, prepared: Prepared, before: Sequence[Prepared]
) -> RecordingError | StoreError | None:
    """Return an error if a repeated drive is refused; search the store and `before` for it."""
    if prepared.staged is None or prepared.repeated in (None, "keep"):
        return None
    earlier = [other.staged for other in before if other.staged]
    try:
        found = store.repeated(prepared.staged, ahead=earlier)
    except StoreError as error:
        return error
    if found is None or (prepared.repeated == "replace" and found.has_less):
        return None
    remedy = "leave it out, or use --repeated keep to ingest it anyway"
    if found.has_less:  # the stored one was salvaged, or ingested before its end
        remedy = (
            f"this one holds more of the drive: {_removal(store, found.recording_id)} removes "
            "that one; then ingest this one again (--repeated replace does both), or keep both "
            "with --repeated keep"
        )
    return RecordingError(str(found), where=prepared.result.path, remedy=remedy)


def _removal(store: StoreWriter, recording_id: str) -> str:
    return f"`restock store remove {quoted(store.path)} {recording_id}`"


def _commit(
    store: StoreWriter, group: dict[int, Prepared], *, begun: bool = False
) -> dict[int, Outcome]:
    """Commit all at once or, if that fails, one by one; `begun`: a commit with them had begun."""
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
    later = [one.ingest_id for one in staged.values()]
    found: dict[int, Outcome] = {}
    for place, one in group.items():
        later = later[1:]
        found[place] = _build_result(store, one, staged[place], version, later)
    return found


def _build_result(
    store: StoreWriter, prepared: Prepared, staged: Staged, version: int, later: Sequence[str]
) -> IngestResult | StoreError:
    """Build the result of a committed recording, ignoring the `later` ingests of its commit."""
    repeats = None
    if prepared.repeated is not None:
        # Search only now, as another process may have written the same drive before the commit.
        try:
            repeats = store.repeated(staged, aside=later)
        except StoreError as error:
            return error
    notes = list(prepared.result.notes)
    if repeats is not None and prepared.repeated == "replace":
        try:
            replaced_by, note = _remove_part(store, repeats)
        except StoreError as error:
            replaced_by, note = None, f"a part of it stays in the store: {error}"
        version = replaced_by or version
        notes.append(note)
    elif repeats is not None:
        text = f"{repeats}; the audit `repeated_steps` fails until one of them is removed:"
        if repeats.has_less:
            command = f"{_removal(store, repeats.recording_id)} removes that one, which holds less"
        else:
            command = f"{_removal(store, staged.recording_id)} removes this one"
        notes.append(f"{text} {command}")
    return replace(prepared.result, version=version, repeats=repeats, notes=notes)


def _remove_part(store: StoreWriter, part: RepeatedDrive) -> tuple[int | None, str]:
    """Remove a recording that is only a part of what was just ingested.

    Returns the version of `transitions` (None if the part stays) and a note for the user.
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
    """Collects recordings and commits them together when it is time.

    `results` has the outcomes by place: the index of a recording in the ingest. `store` None is a
    dry run; `clock` gives seconds.
    """

    def __init__(
        self, store: StoreWriter | None, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.store, self.clock = store, clock
        self.results: dict[int, IngestResult | RestockError] = {}
        self.waiting: dict[int, Prepared] = {}
        self._first: dict[str, IngestResult] = {}  # recording id -> its first result in this ingest
        self._last_s: float | None = None  # time of the last commit

    def add(self, place: int, prepared: Prepared | RestockError) -> None:
        """Add a prepared recording or its error, and commit if it is time."""
        if isinstance(prepared, RestockError):
            self.results[place] = prepared
        elif self.store is not None and (copy := self._copy(prepared.result)) is not None:
            self.store.discard([prepared.staged] if prepared.staged else [])
            self.results[place] = copy
        elif prepared.staged is None:
            self.results[place] = prepared.result
        else:
            self.waiting[place] = prepared
        self.commit_if_due()

    def _copy(self, result: IngestResult) -> IngestResult | None:
        """Return a result if the recording came before with other tags; None if it did not.

        That happens if two paths have the same recording. The first path's tags stay: otherwise,
        every new ingest of both paths would change them.
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
        """Commit the waiting recordings if it is time."""
        if self.due_in_s() == 0.0:
            self.commit()

    def settle(self, recording_id: str) -> None:
        """Commit the waiting recordings if this one, about to be looked up, is among them."""
        if recording_id in {one.staged.recording_id for one in self.waiting.values() if one.staged}:
            self.commit()

    def commit(self) -> None:
        """Commit the waiting recordings."""
        if not self.waiting or self.store is None:
            return
        # Once their commit has begun, `discard` must not delete their files.
        waiting, self.waiting = self.waiting, {}
        outcomes = commit_all(self.store, list(waiting.values()))
        self.results |= dict(zip(waiting, outcomes, strict=True))
        self._last_s = self.clock()

    def discard(self) -> None:
        """Delete the files of the recordings that still wait."""
        staged = [one.staged for one in self.waiting.values() if one.staged]
        self.waiting = {}
        if self.store is not None:
            self.store.discard(staged)
