"""What a recording's messages said at one tick: where a row of the store came from.

The same alignment and holds as in an ingest, so these are the messages the row was made of.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.containers.recording import Recording
from restock.ingest.decoding.columns import FieldColumn, Ragged, TopicColumns
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.align import NS, STAMP, Segment, align, ticks_of
from restock.ingest.steps.filling import PROVENANCE_LEAD_S


@dataclass(frozen=True)
class HeldMessage:
    """What one input of the profile said at a tick."""

    input: str
    topic: str
    type: str
    log_time_ns: int
    publish_time_ns: int
    stamp_ns: int  # on the alignment clock
    age_s: float  # at the tick; below 0 where provenance may come a moment later
    max_age_s: float | None  # None: latched
    fields: dict[str, Any]  # by field path


def held_messages(
    path: str | Path, profile: Profile, *, recording_id: str, tick: int, stamp_ns: int
) -> list[HeldMessage]:
    """The latest message of every input at one tick of a recording, by age.

    Args:
        path: the recording.
        profile: the one that read it.
        recording_id: which recording it must be.
        tick: of the control clock, from 0: the low bits of a transition's id.
        stamp_ns: of that tick, on the alignment clock.

    Raises:
        RecordingError: it cannot be read, is another recording, or has another tick there.
    """
    with open_recording(path, salvage=True) as recording:
        if recording.recording_id != recording_id:
            raise RecordingError(
                f"is recording {recording.recording_id}, the row is of {recording_id}",
                where=str(path),
                remedy="give the recording it was made from; its path then is in the row",
            )
        topics = recording.read(_wanted(recording, profile))
        types = {name: info.type for name, info in recording.topics.items()}
    segments, _ = align(topics, profile.clock, _latched(profile, topics))
    segment = _segment_of(segments, profile, tick, stamp_ns, str(path))
    found = []
    for name, source in profile.inputs.items():
        samples = segment.topics.get(source.topic)
        if samples is None:
            continue
        lead_ns = round(_lead_s(name, profile) * NS)
        held = samples.hold(np.array([stamp_ns + lead_ns]), source.max_age_s)
        if not held.known[0]:
            continue
        row, columns = int(held.row[0]), topics[source.topic]
        age_ns = int(held.age_ns[0]) - lead_ns
        found.append(
            HeldMessage(
                input=name,
                topic=source.topic,
                type=types[source.topic],
                log_time_ns=int(columns.log_time_ns[row]),
                publish_time_ns=int(columns.publish_time_ns[row]),
                stamp_ns=stamp_ns - age_ns,
                age_s=age_ns / NS,
                max_age_s=source.max_age_s,
                fields={field: _value(column, row) for field, column in columns.fields.items()},
            )
        )
    return sorted(found, key=lambda message: message.age_s)


def _wanted(recording: Recording, profile: Profile) -> dict[str, list[str]]:
    """topic -> the field paths that the profile's inputs read of it, and its stamp."""
    readable = {name for name, info in recording.topics.items() if info.skipped is None}
    wanted: dict[str, list[str]] = {}
    for _, source in profile.inputs.items():
        if source.topic not in readable:
            continue
        has = set(recording.leaves(source.topic))
        paths = wanted.setdefault(source.topic, [])
        for key, path in source.fields.items():
            named = [f"{path}.{axis}" for axis in "xyzw"] if key == "orientation" else [path]
            paths += [path for path in named if path in has]
        paths += [STAMP] if STAMP in has else []
    return {topic: list(dict.fromkeys(paths)) for topic, paths in wanted.items()}


def _latched(profile: Profile, topics: Mapping[str, TopicColumns]) -> frozenset[str]:
    inputs = [source for _, source in profile.inputs.items() if source.topic in topics]
    aging = {source.topic for source in inputs if source.max_age_s is not None}
    return frozenset({source.topic for source in inputs} - aging)


def _segment_of(
    segments: list[Segment], profile: Profile, tick: int, stamp_ns: int, where: str
) -> Segment:
    """The stretch of the clock that a tick is in."""
    first = 0
    for segment in segments:
        end = max((int(s.stamp_ns[-1]) for s in segment.topics.values() if len(s.row)), default=0)
        command = segment.topics.get(profile.inputs.command.topic)
        if command is None:
            break
        stamps, _ = ticks_of(command, profile.clock, profile.task.control_period_s, end)
        if tick < first + len(stamps):
            if int(stamps[tick - first]) == stamp_ns:
                return segment
            break
        first += len(stamps)
    raise RecordingError(
        f"has no tick {tick} at {stamp_ns} ns by the profile {profile.name!r}",
        where=where,
        remedy="give the profile that read it with --profile",
    )


def _lead_s(name: str, profile: Profile) -> float:
    """How much after the tick an input may come: provenance alone, never what the robot knew."""
    leads = {
        "behaviour_policy": PROVENANCE_LEAD_S,
        "perturbation": PROVENANCE_LEAD_S,
        "true_condition": profile.task.control_period_s / 2,
    }
    return leads.get(name, 0.0)


def _value(column: FieldColumn, row: int) -> Any:
    """One message's value as plain numbers, texts and lists."""
    value: Any = column[row]
    if isinstance(value, Ragged):
        return [_value(value, index) for index in range(len(value))]
    return value.tolist() if hasattr(value, "tolist") else value
