"""The messages of a recording that one tick was made of: where a row of the store came from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.columns import FieldColumn, Ragged, TopicColumns
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.align import NS
from restock.ingest.steps.aligned_inputs import AlignedInputs, align_inputs
from restock.ingest.steps.custom_columns import column_of, latest_samples
from restock.ingest.steps.frames import AXES, PARENT, TURN
from restock.ingest.steps.needs import read_topics


@dataclass(frozen=True)
class MessageAtTick:
    """A message that a tick was made of, and what it is for."""

    input: str  # of the profile, or `signals.NAME`
    topic: str
    type: str
    log_time_ns: int
    publish_time_ns: int
    stamp_ns: int  # on the alignment clock
    age_s: float  # at the tick; below 0 where it may come a moment later
    max_age_s: float | None  # None: latched
    fields: dict[str, Any]  # by field path


def messages_at_tick(
    path: str | Path, profile: Profile, *, recording_id: str, tick: int, stamp_ns: int
) -> list[MessageAtTick]:
    """Return the messages that one tick of a recording was made of, by age.

    Of each input and custom signal the latest one, and where the pose comes from transforms, each
    transform on the way.

    Args:
        path: the recording.
        profile: the one that read it.
        recording_id: which recording it must be.
        tick: of the control clock, from 0: the low bits of a transition's id.
        stamp_ns: of that tick, on the alignment clock.

    Raises:
        RecordingError: it cannot be read, is another recording, does not fit the profile, or has
            another tick there.
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
            remedy="give the profile with which it was ingested, with --profile",
        )
    messages = [*_of_inputs(aligned), *_of_transforms(aligned, stamp_ns), *_of_signals(aligned)]
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


# Input, topic, maximum age, the columns that the message is in and its row there, age, fields.
_Message = tuple[str, str, float | None, TopicColumns, int, int, dict[str, Any]]


def _of_inputs(aligned: AlignedInputs) -> Iterator[_Message]:
    for name, source in aligned.inputs.by_name.items():
        latest, columns = aligned.latest(name), aligned.inputs.topics[source.topic]
        if latest.fresh[0]:
            row = int(latest.row[0])
            fields = {path: _value(column, row) for path, column in columns.fields.items()}
            yield name, source.topic, source.max_age_s, columns, row, int(latest.age_ns[0]), fields


def _of_signals(aligned: AlignedInputs) -> Iterator[_Message]:
    """Yield what each custom signal makes of its message, by its path."""
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


def _of_transforms(aligned: AlignedInputs, stamp_ns: int) -> Iterator[_Message]:
    """Yield the transforms from the robot's frame up to the fixed one, where they give the pose."""
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
