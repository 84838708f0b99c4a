"""Ingest of one recording, end to end: columns, steps, episodes, labels, rows, and the commit.

profile = load_profile("warehouse_amr")
outcome = ingest(Path("logs/run.mcap"), profile, store=StoreWriter("store"))
"""

from __future__ import annotations

import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pyarrow as pa

from restock.errors import ConfigError, RecordingError, counted, expect, visible
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import Watch
from restock.ingest.decoding.columns import Ragged
from restock.ingest.prepared import IngestResult, OnRepeat, Prepared, commit_all
from restock.ingest.profile.description import BASE_FRAMES
from restock.ingest.profile.profile import Profile, profile_toml, read_profile_toml
from restock.ingest.profile.signal_paths import FIELDS, frame_id_path, plain, transform_fields
from restock.ingest.profile.tag_rules import RecordingTags, resolve_tags
from restock.ingest.steps.cameras import OFF_CLOCK, KeptFrames, frame_rows
from restock.ingest.steps.episodes import Steps, split, steps_of, why_none
from restock.ingest.steps.needs import as_recorded, read_topics, renamed_inputs
from restock.ingest.store.lineage import own_path
from restock.ingest.store.manifest import (
    correction_rows,
    corrections_in,
    definitions,
    label_scores,
    lay_over,
    manifest_row,
    recorded_facts,
    rules_of,
    software_version,
    uncertain_conditions,
)
from restock.ingest.store.transitions import Provenance, recording_table, replaced
from restock.ingest.store.writer import Staged, StoreWriter
from restock.ingest.task.conditions import NOMINAL, held
from restock.ingest.task.schema import recording_schema
from restock.process import interrupts_raised


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

    A recording is skipped if this profile, these conditions and this software have already put it
    into the store, unless `force`. `repeated` decides about a recording whose rows are largely
    those of another one in the store (a part of it, a copy): it is kept and reported, refused, or
    replaces a part of itself. `tags` say whose drive it is and override the recording's own; ""
    removes a tag. If only tags or the profile's [robot] are new, the stored rows are written again
    with them: the status is "tagged". `watch` gets the progress: what is being done, how much of it
    is done, and of how much.

    Raises:
        RecordingError: no recording, damaged (unless `salvage`), not of this profile, it gives
            no transition, its sources contradict each other about a tag, or it is repeated and to
            be refused. The store is as it was.
        StoreError: the store cannot be written.
        ConfigError: an argument that is of another kind, or no rule for `repeated`.
    """
    how = Reading(force, salvage, definitions, repeated, tags or {})
    prepared = prepare(path, profile, how, store=store, watch=watch)
    if store is None:
        return prepared.result
    (outcome,) = commit_all(store, [prepared])
    if not isinstance(outcome, IngestResult):
        raise outcome
    return outcome


@dataclass(frozen=True)
class Reading:
    """Options for reading a recording: the arguments of `ingest` by these names."""

    force: bool = False
    salvage: bool = False
    definitions: str | None = None
    repeated: OnRepeat = "keep"
    tags: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise ConfigError for values that the command line does not allow."""
        if self.repeated not in get_args(OnRepeat):
            has = ", ".join(get_args(OnRepeat))
            raise ConfigError(f"no rule for repeated: {self.repeated!r}", remedy=f"give {has}")
        expect("tags", self.tags, Mapping, 'give them by name, as {"robot": "amr-07"}')
        for name, value in self.tags.items():
            expect("the name of a tag", name, str, "write it as text")
            expect(f"the tag {name}", value, str, "write it as text")


def prepare(
    path: Path | str,
    profile: Profile,
    how: Reading,
    *,
    store: StoreWriter | None,
    watch: Watch | None = None,
    settle: Callable[[str], None] = lambda recording_id: None,
) -> Prepared:
    """Read one recording and write its files, for a commit to come (`commit_all`).

    `settle(recording_id)` is called before the recording is looked up in the store, which does not
    show recordings that wait for their commit.

    Raises as `ingest`, which does both.
    """
    expect("profile", profile, Profile, "`load_profile(NAME_OR_FILE)` gives one")
    if store is not None:
        expect("store", store, StoreWriter, 'make it as StoreWriter("store")')
    with open_recording(
        path, definitions=how.definitions, salvage=how.salvage, watch=watch
    ) as recording:
        renamed = renamed_inputs(profile, recording.topics)
        profile = as_recorded(profile, recording.topics)
        settle(recording.recording_id)
        before = _before(store, recording)
        tagged = (before or {}).get("tags") or {}
        reported = resolve_tags(profile.tags, Path(path), recording.metadata, how.tags, tagged)
        if (
            store is not None
            and before is not None
            and not how.force
            and _unchanged(before, profile)
        ):
            new: dict[str, Any] = {"tags": reported.tags}
            if _other_robot(before, profile):
                new["profile_toml"] = profile_toml(profile)
                new["uncertain_conditions"] = uncertain_conditions(profile)
            elif reported.tags == (before["tags"] or {}):
                return Prepared(IngestResult(str(path), "unchanged", before))
            staged = _tag(store, before, new)
            result = IngestResult(str(path), "tagged", before | new, notes=reported.notes)
            return Prepared(result, staged)
        try:
            reported = replace(reported, notes=[*reported.notes, *renamed])
            return _Ingest(str(path), recording, profile, reported, how.repeated, before).run(store)
        except RecordingError as error:
            if error.where:
                raise
            raise RecordingError(error.what, where=str(path), remedy=error.remedy) from error


def _before(store: StoreWriter | None, recording: Recording) -> dict[str, Any] | None:
    """Return the manifest row of the same recording if it is in the store."""
    if store is None:
        return None
    rows = store.live(recording.recording_id).to_pylist(maps_as_pydicts="strict")
    return dict(rows[0]) if rows else None


def _unchanged(before: Mapping[str, Any], profile: Profile) -> bool:
    """Return whether the rows of this manifest were made by the same definitions."""
    by_rules = {**before, "labels_version": rules_of(before["labels_version"])}
    return all(by_rules[name] == value for name, value in definitions(profile).items())


def _other_robot(before: Mapping[str, Any], profile: Profile) -> bool:
    """Return whether a recording was ingested with another [robot] in its profile."""
    try:
        return (
            read_profile_toml(before["profile_toml"], where="profile_toml").robot != profile.robot
        )
    except ConfigError:  # as another version wrote it
        return False


def _tag(store: StoreWriter, before: Mapping[str, Any], new: Mapping[str, Any]) -> Staged:
    """Write a recording's rows again with what is `new` in its manifest."""
    ingest_id = uuid.uuid4().hex[:16]
    manifest = {**before, "ingest_id": ingest_id, **new}
    rows = store.rows(before["recording_id"], before["ingest_id"])
    rows = replaced(rows, {"ingest_id": ingest_id})
    table = pa.Table.from_pylist([manifest], recording_schema())
    return store.stage(table, rows, instead_of=before["ingest_id"])


class _Ingest:
    """The stages over one open recording."""

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

    def run(self, store: StoreWriter | None) -> Prepared:
        profile, columns = self.profile, read_topics(self.recording, self.profile)
        steps = steps_of(profile, columns)
        # The next stages need to know which topics had messages, not their values: free those.
        columns = {name: column.times(0, 1) for name, column in columns.items()}
        watch, ticks = self.recording.watch, len(steps)
        episodes = split(profile.task, steps)
        if not episodes.transitions:
            why, remedy = why_none(steps, episodes)
            raise RecordingError(
                f"gives no transition with the profile {self.profile.name!r}: {why}",
                remedy=remedy
                or "choose another --profile, or correct its maximum ages; see docs/ingest.md",
            )
        provenance = Provenance(
            self.recording.recording_id, self.ingest_id, visible(self.path), software_version()
        )
        watch("rows and labels, ticks", 0, ticks)
        table, rows = recording_table(
            *(profile, steps, episodes, provenance),
            done=lambda tick: watch("rows and labels, ticks", tick, ticks),
        )
        table, self.corrections = lay_over(
            table, self.corrections, profile.conditions, steps.clock.offset_ns
        )
        named = Counter(table["condition"].to_pylist())
        first = {name: named[name] for name in (*rows.labels, NOMINAL)}
        scores = label_scores(table, rows.labels, profile.task.control_period_s)
        facts = recorded_facts(self.recording, profile, columns, steps, episodes, rows)
        facts |= {
            "tags": self.reported.tags,
            "labels_version": table["labels_version"][0].as_py(),
            "corrections": correction_rows(self.corrections),
        }
        steps = steps.without_values()
        kept = [KeptFrames.of(name, one, rows.tick) for name, one in steps.cameras.items()]
        path = own_path(provenance.recording_id, self.ingest_id)
        file = path if sum(len(one.row) for one in kept) else ""
        facts["cameras"] = [one.manifest_row(self.recording, file) for one in kept]
        manifest = manifest_row(profile, provenance, table, scores, episodes.dropped, **facts)
        staged = self._stage(store, manifest, table, kept) if store else None
        holding = held(table["conditions"], list(rows.labels))
        counts = {name: int(holds.sum()) for name, holds in holding.items()}
        counts[NOMINAL] = first[NOMINAL]
        result = IngestResult(
            self.path,
            "written" if store else "dry run",
            manifest,
            self._messages(),
            counts,
            first,
            {name: int(holds[rows.starts].sum()) for name, holds in rows.exposures.items()},
            scores,
            dict(Counter(episode.ended_by for episode in episodes.episodes).most_common()),
            self._lost_messages(steps),
            [one.reported for one in steps.findings if not one.repaired],
            self._notes(steps, table),
        )
        return Prepared(result, staged, self.repeated, profile.task.control_period_s)

    def _stage(
        self,
        store: StoreWriter,
        manifest: dict[str, Any],
        table: pa.Table,
        kept: Sequence[KeptFrames],
    ) -> Staged:
        # What another process corrects meanwhile is not written over.
        read = self.before["ingest_id"] if self.corrections else None
        with self._frames_written(store, manifest, kept):
            row = pa.Table.from_pylist([manifest], recording_schema())
            return store.stage(row, table, instead_of=read)

    @contextmanager
    def _frames_written(
        self, store: StoreWriter, manifest: Mapping[str, Any], kept: Sequence[KeptFrames]
    ) -> Iterator[None]:
        """Write the frames to their file, and delete it again if the block fails.

        Raises:
            RecordingError: a frame that was read before is not there any more.
        """
        file = next((row["file"] for row in manifest["cameras"] if row["file"]), "")
        if not file:
            yield
            return
        count = store.write_frames(
            file, (batch for one in kept for batch in frame_rows(self.recording, one))
        )
        try:
            if count != (due := sum(len(one.row) for one in kept)):
                raise RecordingError(
                    f"{due - count} of {due} frames are missing: the recording changed in the "
                    "meantime",
                    where=self.path,
                    remedy="ingest it again",
                )
            yield
        except BaseException:
            store.discard_frames(file)
            raise

    def _messages(self) -> dict[str, int]:
        accounts = self.recording.accounts.values()
        expected = sum(account.expected for account in accounts)
        return {
            "expected": expected,
            "decoded": sum(account.decoded for account in accounts),
            "unused": self.recording.messages - expected,
        }

    def _lost_messages(self, steps: Steps) -> list[str]:
        frames = [
            f"cameras.{name}: {reason} ({counted(count, 'message')})"
            for name, camera in steps.cameras.items()
            for reason, count in camera.problems.items()
            if count and reason != OFF_CLOCK  # which is said of the topic
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
        notes += unknown_directions(self.recording, self.profile)
        notes += [one.reported for one in steps.findings if one.repaired]
        if (other := self.before.get("profile", self.profile.name)) != self.profile.name:
            notes.append(
                f"in place of its {self.before['transitions']:,} transitions by the profile"
                f" {other!r}: a store keeps one set of rows per recording (ingest another robot's "
                "rows of it into another --store)"
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
            closer = counted(steps.commands_between, "command")
            notes.append(f"{closer} closer than a control period: no step")
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


MAX_TRANSFORMS = 20_000  # messages of a topic; what places a lidar is published all the time
_ENDS = ("tf", "tf_static", "robot_description")


def unknown_directions(recording: Recording, profile: Profile) -> list[str]:
    """Return a note for each lidar whose zero is taken to point ahead though nothing says so.

    A profile says so by an angle other than 0, or by any angle in the lidar's own input. Transforms
    say so if one places the frame of the scans; a recorded description may say it.
    """
    unsaid = {
        name: source
        for name, source in profile.inputs.scans.items()
        if source.lidar_yaw_rad is None
        and (source.lidar_at_m is not None or profile.task.body.lidar_yaw_rad == 0)
        and source.topic in recording.topics
    }
    if not unsaid or any(name.endswith("/robot_description") for name in recording.topics):
        return []
    frames = {name: _first_frame(recording, source.topic) for name, source in unsaid.items()}
    frames = {
        name: frame
        for name, frame in frames.items()
        if frame and frame.split("/")[-1] not in BASE_FRAMES
    }
    left = set(frames.values())
    for topic in recording.topics if left else ():
        for child in _children(recording, topic):
            left.discard(child)
            if not left:
                return []
    return [
        f"{name}: no transform places {frame}, the frame of {unsaid[name].topic}: its zero is "
        "assumed to point straight ahead; if it does, set lidar_at_m and lidar_yaw_rad = 0 in "
        f"[inputs.{name}]"
        for name, frame in frames.items()
        if frame in left
    ]


def _first_frame(recording: Recording, topic: str) -> str:
    path = frame_id_path(recording.leaves(topic))
    if path is not None:
        for _, fields in recording.batches(topic, [path]):
            for frame in np.asarray(fields[path], object)[:1]:
                return plain(str(frame))
    return ""


def _children(recording: Recording, topic: str) -> Iterator[str]:
    """Yield the frames that a topic of transforms places, again and again."""
    layout = transform_fields(recording.leaves(topic))
    if layout is None or recording.topics[topic].skipped:
        return
    path, count = layout[FIELDS.index("transforms[].child_frame_id")], 0
    for times, fields in recording.batches(topic, [path]):
        column = fields[path]
        values = column.values if isinstance(column, Ragged) else column
        children = set(map(str, np.asarray(values, object).ravel()))
        yield from {plain(child) for child in children}
        count += len(times)
        if count > MAX_TRANSFORMS:
            return
