"""Find the source of a store's row: its ingest, its recording, and the messages of its tick."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import duckdb
import msgspec
import numpy as np

from restock.errors import ConfigError, RecordingError, StoreError
from restock.files import first_line
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.columns import FieldColumn, Ragged, TopicColumns
from restock.ingest.profile.profile import Profile, parse_profile
from restock.ingest.profile.signal_paths import AXES, TURN
from restock.ingest.steps.align import NS
from restock.ingest.steps.aligned_inputs import AlignedInputs, align_inputs
from restock.ingest.steps.custom_columns import column_of, latest_samples
from restock.ingest.steps.frames import PARENT
from restock.ingest.steps.needs import read_topics
from restock.ingest.store.location import FRAMES
from restock.ingest.task.schema import STEP_BITS
from restock.ingest.task.task import Task, reward_parts
from restock.process import was_interrupted
from restock.replay.store.definitions import install_named
from restock.replay.store.store import Store, is_store


@dataclass(frozen=True)
class MessageAtTick:
    """A message that was used at a tick, and the input that used it."""

    input: str  # input of the profile, or `signals.NAME`
    topic: str
    type: str
    log_time_ns: int
    publish_time_ns: int
    stamp_ns: int  # the message's time on the alignment clock
    age_s: float  # age at the tick; negative if the message is a bit later and the input allows it
    max_age_s: float | None  # None: latched
    fields: dict[str, Any]  # field path -> value


def messages_at_tick(
    path: str | Path, profile: Profile, *, recording_id: str, tick: int, stamp_ns: int
) -> list[MessageAtTick]:
    """Return the messages used at one tick of a recording, youngest first.

    These are the latest message of each input and custom signal, and, if the pose comes from
    transforms, each transform in the chain.

    Args:
        path: the recording.
        profile: the profile with which it was read.
        recording_id: the expected id of the recording.
        tick: number of the tick on the control clock, from 0: the low bits of a transition's id.
        stamp_ns: stamp of that tick, on the alignment clock.

    Raises:
        RecordingError: it cannot be read, has another id, does not fit the profile, or has no such
            tick at that stamp.
    """
    with open_recording(path, salvage=True) as recording:
        if recording.recording_id != recording_id:
            raise RecordingError(
                f"is recording {recording.recording_id}, the row is of {recording_id}",
                where=str(path),
                remedy="give the recording from which the row was made; the row contains its path "
                "at the time",
            )
        types = {name: info.type for name, info in recording.topics.items()}
        try:
            topics = read_topics(recording, profile, reduced=False)
            aligned = align_inputs(profile, topics).at(tick, stamp_ns)
        except RecordingError as error:
            raise RecordingError(error.what, where=str(path), remedy=error.remedy) from error
    if aligned is None:
        raise RecordingError(
            f"has no tick {tick} at {stamp_ns} ns with the profile {profile.name!r}",
            where=str(path),
            remedy="ingest the recording again: its profile has changed",
        )
    messages = [
        *_input_messages(aligned),
        *_transform_messages(aligned, stamp_ns),
        *_signal_messages(aligned),
    ]
    named = [
        MessageAtTick(
            input=name,
            topic=topic,
            type=types[topic],
            log_time_ns=int(columns.log_time_ns[row]),
            publish_time_ns=int(columns.publish_time_ns[row]),
            stamp_ns=stamp_ns - age_ns,
            age_s=age_ns / NS,
            max_age_s=max_age_s,
            fields=fields,
        )
        for name, topic, max_age_s, columns, row, age_ns, fields in messages
    ]
    return sorted(named, key=lambda message: message.age_s)


# Input, topic, maximum age (s), columns of the topic, row of the message in them, age (ns), fields.
_Message = tuple[str, str, float | None, TopicColumns, int, int, dict[str, Any]]


def _input_messages(aligned: AlignedInputs) -> Iterator[_Message]:
    for name, source in aligned.inputs.by_name.items():
        latest, columns = aligned.latest(name), aligned.inputs.topics[source.topic]
        if latest.fresh[0]:
            row = int(latest.row[0])
            fields = {path: _value(column, row) for path, column in columns.fields.items()}
            yield name, source.topic, source.max_age_s, columns, row, int(latest.age_ns[0]), fields


def _signal_messages(aligned: AlignedInputs) -> Iterator[_Message]:
    """Yield the message of each custom signal, with the signal's value under its path."""
    for name, signal in aligned.profile.signals.items():
        columns = aligned.inputs.topics.get(signal.topic)
        if columns is None:
            continue
        column = column_of(name, signal, columns)
        latest = latest_samples(aligned, column)
        if latest.fresh[0]:
            row, age_ns = int(latest.row[0]), int(latest.age_ns[0])
            value = {signal.path: column.take(latest.row, latest.fresh)[0].as_py()}
            yield f"signals.{name}", signal.topic, signal.max_age_s, columns, row, age_ns, value


def _transform_messages(aligned: AlignedInputs, stamp_ns: int) -> Iterator[_Message]:
    """Yield the transforms from the robot's frame to the fixed frame, if they give the pose."""
    tree = aligned.tree
    if tree is None or "pose" in aligned.inputs.by_name:
        return
    for topic, frame, row, measured_ns in tree.way(tree.frames.base, aligned.ticks):
        columns = tree.edges.topics[f"{topic} {frame}"]
        max_age_s = tree.frames.max_age_s if topic == tree.frames.topic else None
        names = (PARENT, *AXES, *TURN)
        fields = {"child": frame} | {name: _value(columns.fields[name], row) for name in names}
        yield "pose", topic, max_age_s, columns, row, stamp_ns - measured_ns, fields


def _value(column: FieldColumn, row: int) -> Any:
    """Convert one message's value to plain numbers, texts and lists."""
    value: Any = column[row]
    if isinstance(value, Ragged):
        return [_value(value, index) for index in range(len(value))]
    return value.tolist() if hasattr(value, "tolist") else value


# Messages of a tick are searched in this range of log times around it: topics have different rates,
# and some messages arrive late.
WINDOW_S = (-1.0, 0.1)
_RELABELLED = ("condition", "conditions", "labels_version", "profile_hash", "ingest_id", "reward")
# Long fields of a manifest that a trace leaves out.
_LEFT_OUT = (
    "task_json",
    "conditions_json",
    "exposures_json",
    "profile_toml",
    "topics",
    "label_scores",
    "label_counts",
)


StoreVersion = tuple[str, int | None]  # path of a store, and its version (None: the newest)


@dataclass
class Origin:
    """Everything known about a stored row. Unknown fields are None or empty; see `notes`."""

    transition: dict[str, Any]  # the row as stored
    store: dict[str, Any]
    moment: dict[str, Any]  # the row's times, as stamp and as log time
    reward_parts: dict[str, float] | None = None  # reward of each event in the step
    recording: dict[str, Any] | None = None  # the manifest of the ingest that wrote the row
    topics: list[dict[str, Any]] = field(default_factory=list)  # topics that the profile reads
    messages: list[MessageAtTick] = field(default_factory=list)  # messages used at the row's tick
    frames: list[dict[str, Any]] = field(default_factory=list)  # camera frames, with their file
    notes: list[str] = field(default_factory=list)


def find_origin(
    sources: Sequence[StoreVersion],
    transition: int,
    *,
    recording: Path | str | None = None,
) -> Origin:
    """Look up a transition in stores, first to last.

    Args:
        transition: its id.
        recording: its recording, to read the messages of its tick; None: do not read them.

    Raises:
        StoreError: a store does not exist, or no store has the row.
        RecordingError: `recording` is not the row's recording.
    """
    for path, version in sources:
        if not is_store(path):
            raise StoreError(
                "the store does not exist (any more)",
                where=path,
                remedy=f"trace the row where the store is now: `restock trace STORE {transition}`",
            )
        origin = _look_up(path, version, transition)
        if origin is not None:
            _interpret(origin, recording)
            return origin
    raise StoreError(
        f"no transition {transition} in it",
        where=", ".join(path for path, _ in sources),
        remedy="its recording was removed, or ingested again with other steps: `restock sql STORE"
        ' "FROM recordings"` lists what is there',
    )


def _look_up(path: str, version: int | None, transition: int) -> Origin | None:
    """Return the row at a version, or at the newest if that version cannot be read any more."""
    now = _read(path, None, transition)
    if version is None:
        return now
    then = _read(path, version, transition)
    if then is None and now is not None:
        now.notes.append(
            f"version {version} of the store can no longer be read: this is the row of "
            f"version {now.store['version']}"
        )
        return now
    if then is not None:
        then.store["newest_version"] = now.store["version"] if now else None
        then.notes += _changes(then.transition, now)
    return then


def _read(path: str, version: int | None, transition: int) -> Origin | None:
    """Read a row with its manifest, frames and reward; None if the row or version is gone."""
    try:
        with Store(path, version=version) as store:
            rows = rows_of(store.connection, sql_file("trace.sql"), {"id": transition})
            if not rows:
                return None
            row = rows[0]
            named = {"ingest": row["ingest_id"], "recording": row["recording_id"]}
            manifests = rows_of(store.connection, sql_file("trace_manifest.sql"), named)
            around = {"episode": row["episode_id"], "step": row["step_index"]}
            near = {
                r["step_index"]: r
                for r in rows_of(store.connection, sql_file("trace_around.sql"), around)
            }
            opened = store.version
            manifest = manifests[0] if manifests else None
            frames, lost = _frames(store, path, row, manifest)
    except (duckdb.IOException, StoreError):
        if version is None or was_interrupted():
            raise
        return None
    origin = Origin(
        transition=row,
        store={"path": path, "version": opened},
        moment=_moment(row, manifest),
        recording=manifest,
        frames=frames,
        notes=lost,
    )
    if manifest is None:
        origin.notes.append(
            "the manifest of its recording no longer exists: see the row's own provenance"
        )
        return origin
    if manifest["ingest_id"] != row["ingest_id"]:
        origin.notes.append("the manifest is of a later ingest of the same recording")
    origin.reward_parts = _reward_parts(row, near, manifest["task_json"])
    return origin


def _frames(
    store: Store, path: str, row: Mapping[str, Any], manifest: Mapping[str, Any] | None
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return each camera's frame at a row, with its file, and notes on frames that are missing.

    Frames are missing if the recording was ingested again later, which replaces rows and frames.
    """
    kept = {one["camera"]: one for one in (manifest or {}).get("cameras") or []}
    if manifest is None or not kept:
        return [], []
    if manifest["ingest_id"] != row["ingest_id"]:
        return [], ["the frames of its cameras were replaced by a later ingest"]
    install_named(store.bare, "transition_frames")
    try:
        found = rows_of(store.bare, sql_file("trace_frames.sql"), {"id": row["transition_id"]})
    except duckdb.Error as error:
        return [], [f"the frames of its cameras cannot be read: {first_line(error)}"]
    without = sorted(kept.keys() - {frame["camera"] for frame in found})
    notes = [f"no frame of {', '.join(without)} is in force at its step"] if without else []
    return [
        frame | {"file": f"{path}/{FRAMES}/{kept[frame['camera']]['file']}"} for frame in found
    ], notes


def rows_of(
    connection: duckdb.DuckDBPyConnection, sql: str, parameters: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Return the rows of a query as dicts."""
    relation = connection.sql(sql, params=dict(parameters))
    return [dict(zip(relation.columns, row, strict=True)) for row in relation.fetchall()]


def _changes(row: Mapping[str, Any], now: Origin | None) -> list[str]:
    """Return a note if a row changed, or is gone, in the newest version of the store."""
    if now is None:
        return ["the newest version of the store no longer has this row"]
    changed = [name for name in _RELABELLED if row.get(name) != now.transition.get(name)]
    if not changed:
        return []
    changes = ", ".join(f"{name} {row.get(name)} -> {now.transition.get(name)}" for name in changed)
    return [f"ingested or labelled again since (version {now.store['version']}): {changes}"]


def _interpret(origin: Origin, recording: Path | str | None) -> None:
    """Add the topics that the profile reads, and given a recording, the messages of the tick."""
    manifest, row = origin.recording, origin.transition
    if manifest is None:
        return
    topics = manifest["topics"] or []
    profile = profile_of(origin, manifest)
    if profile is not None:
        fills: dict[str, list[str]] = {}
        for input_name, source in profile.inputs.items():
            fills.setdefault(source.topic, []).append(input_name)
        topics = [t | {"fills": fills[t["topic"]]} for t in topics if t["topic"] in fills]
    origin.topics = topics
    origin.recording = {key: value for key, value in manifest.items() if key not in _LEFT_OUT}
    if recording is not None and profile is not None:
        origin.messages = messages_at_tick(
            recording,
            profile,
            recording_id=row["recording_id"],
            tick=origin.moment["tick"],
            stamp_ns=origin.moment["stamp_ns"],
        )


def _moment(row: Mapping[str, Any], manifest: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return a row's times: its stamp, its log time, and the window of its messages."""
    stamp = int(row["stamp_ns"])
    offset = (manifest or {}).get("clock_offset_ns") or 0
    logged = stamp + int(offset)
    return {
        "stamp_ns": stamp,
        "tick": int(row["transition_id"]) & ((1 << STEP_BITS) - 1),
        "log_time_ns": logged,
        "log_time": _utc(logged),
        "window_ns": [logged + round(edge * 1e9) for edge in WINDOW_S],
        "clock_jumps": (manifest or {}).get("clock_jumps"),
    }


def _utc(stamp_ns: int) -> str:
    try:
        return datetime.fromtimestamp(stamp_ns / 1e9, UTC).isoformat(timespec="milliseconds")
    except (OverflowError, OSError, ValueError):
        return ""


def _reward_parts(
    row: Mapping[str, Any], near: Mapping[int, Mapping[str, Any]], task_json: str
) -> dict[str, float] | None:
    """Return the reward of each event of a step; None at an episode's last step.

    The state after that step is not stored as a row.
    """
    after = near.get(row["step_index"] + 1)
    if after is None:
        return None
    task = msgspec.json.decode(task_json, type=Task)
    before = near.get(row["step_index"] - 1)
    previous = before["action"] if before is not None else 0

    def columns(signals: Mapping[str, Any]) -> dict[str, Any]:
        return {
            name: np.array([np.nan if value is None else value])  # null: unknown
            for name, value in signals.items()
            if value is None or isinstance(value, bool | int | float)
        }

    parts = reward_parts(
        task,
        columns(row),
        columns(after),
        np.array([row["progress_m"]], np.float64),
        np.array([row["action"]]),
        np.array([previous]),
    )
    if task.reward_terms:  # the rest of the reward: computing terms may need earlier steps
        parts[" + ".join(task.reward_terms)] = row["reward"] - np.asarray(sum(parts.values()))
    return {name: float(value[0]) + 0.0 for name, value in parts.items()}  # never -0


def profile_of(origin: Origin, manifest: Mapping[str, Any]) -> Profile | None:
    """Return the profile in the manifest of the recording; None if it cannot be read."""
    name = manifest["profile"]
    try:
        profile = parse_profile(manifest["profile_toml"], where=f"profile {name!r}")
    except ConfigError as error:
        origin.notes.append(f"profile {name!r} cannot be read from the store ({error.what})")
        return None
    if profile.hash != manifest["profile_hash"]:
        origin.notes.append(
            f"profile {name!r} is now {profile.hash}, but the recording was ingested with "
            f"{manifest['profile_hash']}: topics and ages may differ"
        )
    return profile


@cache
def sql_file(name: str) -> str:
    """Return the text of a query in this folder."""
    return (files("restock.replay.trace") / name).read_text(encoding="utf-8")
