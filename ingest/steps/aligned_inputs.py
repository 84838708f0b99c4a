"""A profile's inputs in a recording, on one clock, and the latest message of each at every tick.

Ingest, the observer on a robot and `trace` use this to find an input's message at a tick.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from restock.arrays import Bools, Ints
from restock.errors import RecordingError, counted
from restock.ingest.decoding.columns import FieldColumn, TopicColumns
from restock.ingest.profile.profile import Profile
from restock.ingest.profile.signal_paths import element_of, factor_of, plain
from restock.ingest.profile.tables import (
    COMMAND_SOURCES,
    FALLBACKS,
    POSE_FALLBACK,
    Input,
)
from restock.ingest.steps.align import (
    NS,
    ClockReport,
    ClockSegment,
    LatestMessages,
    Samples,
    align,
    refuse_still_log_time,
    ticks_of,
)
from restock.ingest.steps.cameras import CameraFrames, usable_frames
from restock.ingest.steps.frames import Edges, Placement, PoseSeries, Tree, poses_along
from restock.ingest.steps.input_columns import InputColumns

# Messages about the driver or the simulator may arrive a moment after the tick from which they
# apply: a tick uses them if they are at most this late. They are never what the robot knew.
PROVENANCE_LEAD_S = 0.1
SAME_COMMAND = 1e-6  # m/s or rad/s; if commands of two topics differ by less, one repeats the other
SIDEWAYS_MPS = 1e-3  # slower sideways speeds count as 0
T = TypeVar("T")


@dataclass(frozen=True)
class AlignedInputs:
    """A profile's inputs on the alignment clock, and the ticks of the control clock on it."""

    profile: Profile
    inputs: InputColumns
    segments: Sequence[ClockSegment]
    ticks: Sequence[Ints]  # times of the ticks of each segment; T ticks in total
    tree: Tree | None = None  # None: the profile has no [frames]
    clock: ClockReport = field(default_factory=lambda: ClockReport(""))
    commands_between: int = 0  # commands without a tick of their own
    notes: Sequence[str] = ()  # notes on unusual frames, and on ignored parts of commands

    def at(self, tick: int, stamp_ns: int) -> AlignedInputs | None:
        """Return the inputs at a single tick, or None if that tick is not at `stamp_ns`."""
        ends = np.cumsum([len(stamps) for stamps in self.ticks])
        segment = int(np.searchsorted(ends, tick, "right"))
        stamps = np.concatenate(self.ticks)[tick : tick + 1]
        if stamps.tolist() != [stamp_ns]:
            return None
        ticks = [stamps if index == segment else stamps[:0] for index in range(len(ends))]
        return replace(self, ticks=ticks)

    def latest(self, name: str) -> LatestMessages:
        """Return an input's latest message at each tick; one after the tick has a negative age.

        Messages of what the robot knew are never after the tick. Those of the command at a fixed
        rate, of provenance and of truth may come up to `_lead_s` after it.
        """
        source, lead_ns = self.inputs.by_name[name], round(self._lead_s(name) * NS)
        latest = self.latest_of(source.topic, source.max_age_s, lead_ns=lead_ns)
        fresh = latest.fresh
        if source.stop_holds and len(self.inputs.topics[source.topic]):
            keys = ("speed_mps", "yaw_rate_radps")
            stops = np.all([self.inputs.numbers(name, key) == 0 for key in keys], axis=0)
            fresh = fresh | (latest.known & stops[latest.row])
        age_ns = latest.age_ns - np.where(latest.known, lead_ns, 0)
        return replace(latest, age_ns=age_ns, fresh=fresh)

    def latest_of(
        self, topic: str, max_age_s: float | None, *, lead_ns: int = 0, keep: Bools | None = None
    ) -> LatestMessages:
        """Return a topic's latest message up to `lead_ns` after each tick.

        With `keep` (N,), messages for which it is False are skipped.
        """
        parts = []
        for segment, stamps in zip(self.segments, self.ticks, strict=True):
            samples = segment.topics[topic]
            if keep is not None:
                chosen = keep[samples.row]
                samples = Samples(samples.stamp_ns[chosen], samples.row[chosen])
            parts.append(samples.hold(stamps + lead_ns, max_age_s))
        return LatestMessages.join(parts)

    def camera_frames(self) -> dict[str, CameraFrames]:
        """Return, for each recorded camera, its frames and which of them each tick uses."""
        found: dict[str, CameraFrames] = {}
        for name, camera in self.profile.cameras.items():
            columns = self.inputs.topics.get(camera.topic)
            if columns is None:
                continue
            stamp_ns = np.full(len(columns), -1)
            usable = np.zeros(len(columns), np.bool_)
            for segment in self.segments:  # separately, as a clock that is set back repeats times
                samples = segment.topics[camera.topic]
                stamp_ns[samples.row] = samples.stamp_ns
                usable[samples.row] = usable_frames(
                    columns, samples.row, samples.stamp_ns, camera.max_hz
                )
            latest = self.latest_of(camera.topic, camera.max_age_s, keep=usable)
            at_tick = np.where(latest.fresh, latest.row, -1).astype(np.int64)
            found[name] = CameraFrames(camera, columns, stamp_ns, usable, at_tick)
        return found

    def commanded_by(self) -> list[str | None]:
        """Return the source whose command is in force at each tick, or None.

        The source of a command is the one whose own last command up to then is equal to it. If
        several are, it is the one that sent its command last; if none is, one whose button is
        pressed.
        """
        topics, keys = self.inputs.topics, ("speed_mps", "yaw_rate_radps")
        topic = self.profile.inputs.command.topic
        by = np.full(len(topics[topic]), None, object)
        command = np.stack([self.inputs.numbers("command", key) for key in keys])
        sources = [
            (name.removeprefix(f"{COMMAND_SOURCES}."), name, source)
            for name, source in self.inputs.by_name.items()
            if name.startswith(f"{COMMAND_SOURCES}.") and len(topics[source.topic])
        ]
        for segment in self.segments:
            given = segment.topics[topic]
            latest_ns = np.full(len(given.row), np.iinfo(np.int64).min)
            for policy, name, source in sources:
                last = segment.topics[source.topic].hold(given.stamp_ns, source.max_age_s)
                if "pressed" in source.fields:
                    pressed = self.inputs.numbers(name, "pressed")[last.row] > 0
                    unclaimed = np.array([by[row] is None for row in given.row], np.bool_)
                    drives = last.fresh & pressed & unclaimed
                else:
                    its = np.stack([self.inputs.numbers(name, key)[last.row] for key in keys])
                    same = (np.abs(its - command[:, given.row]) <= SAME_COMMAND).all(axis=0)
                    at_ns = given.stamp_ns - last.age_ns
                    drives = last.fresh & same & (at_ns > latest_ns)
                    latest_ns[drives] = at_ns[drives]
                by[given.row[drives]] = policy
        return [by[row] for row in self.latest("command").row]

    def poses(self) -> list[PoseSeries]:
        """Return all poses in the fixed frame, per segment."""
        if "pose" in self.inputs.by_name:
            topic = self.inputs.by_name["pose"].topic
            columns = [self.inputs.numbers("pose", key) for key in ("x_m", "y_m", "yaw_rad")]
            samples = [segment.topics[topic] for segment in self.segments]
            return [
                PoseSeries.of(one.stamp_ns, *(column[one.row] for column in columns))
                for one in samples
            ]
        assert self.tree is not None  # a profile without [inputs.pose] must have [frames]
        return poses_along(self.tree)

    def _lead_s(self, name: str) -> float:
        """Return how long after a tick a message of this input may come and still belong to it."""
        half_s, by_rate = self.profile.task.control_period_s / 2, self.profile.clock.steps == "rate"
        leads = {
            # At a fixed rate, a command may come at any time after the tick. The one in force half
            # a period later holds for most of the step. With steps by command, it starts the step.
            "command": half_s if by_rate else 0.0,
            "true_condition": half_s,  # the message nearest to the tick
            "true_exposure": half_s,
            "behaviour_policy": PROVENANCE_LEAD_S,
            "perturbation": PROVENANCE_LEAD_S,
        }
        return leads.get(name, 0.0)


def align_inputs(profile: Profile, topics: Mapping[str, TopicColumns]) -> AlignedInputs:
    """Align a recording's columns (those of `wanted_fields`) to one clock.

    Raises:
        RecordingError: the alignment clock is `header.stamp` and no topic has one, or log time
            cannot be mapped to it; log times are all equal, or span years; or no transform leads
            to the pose.
    """
    inputs = InputColumns(profile, topics)
    edges = transforms_of(profile, inputs)
    ages = [(source.topic, source.max_age_s) for source in inputs.by_name.values()]
    ages += [(signal.topic, signal.max_age_s) for signal in profile.signals.values()]
    ages += [(camera.topic, camera.max_age_s) for camera in profile.cameras.values()]
    latched = {topic for topic, age in ages if age is None}
    latched -= {topic for topic, age in ages if age is not None}
    if profile.clock.alignment == "log_time":
        refuse_still_log_time(profile.inputs.command.topic, topics[profile.inputs.command.topic])
    segments, report = align(
        {**topics, **edges.topics},
        profile.clock,
        edges.static.union(latched),
        frozenset(edges.topics)
        | frozenset(topics.keys() - without_cameras(profile, topics).keys()),
        _command_topics(inputs),
        tolerance_s=profile.task.control_period_s / 2,
    )
    ticks, between = [], 0
    for segment in segments:
        ends = without_cameras(profile, segment.topics).values()
        end = max((int(s.stamp_ns[-1]) for s in ends if len(s.row)), default=0)
        command = segment.topics[profile.inputs.command.topic]
        stamps, extra = ticks_of(command, profile.clock, profile.task.control_period_s, end)
        ticks.append(stamps)
        between += extra
    tree = Tree(profile.frames, edges, segments) if profile.frames else None
    if tree is not None:
        place_messages(inputs, tree, segments)
    commanded = profile.inputs.command
    notes = frame_notes(profile, inputs, edges)
    notes += sideways_notes(commanded, inputs.topics[commanded.topic].fields)
    return AlignedInputs(profile, inputs, segments, ticks, tree, report, between, notes)


def _command_topics(inputs: InputColumns) -> frozenset[str]:
    """Return topics read only for commands: a command takes effect when it is received."""
    topics: dict[bool, set[str]] = {True: set(), False: set()}
    for name, source in inputs.by_name.items():
        commands = name in ("command", "nav_command") or name.startswith(f"{COMMAND_SOURCES}.")
        topics[commands].add(source.topic)
    return frozenset(topics[True] - topics[False])


def fallbacks_used(profile: Profile, topics: Mapping[str, TopicColumns]) -> dict[str, str]:
    """Return what replaces each input and signal that this recording does not fill."""
    absent = {
        name: FALLBACKS.get(name, POSE_FALLBACK)
        for name, source in profile.inputs.items()
        if source.optional and not (source.topic in topics and len(topics[source.topic]))
    }
    beside = [(f"signals.{name}", "null", one.topic) for name, one in profile.signals.items()]
    beside += [(f"cameras.{name}", "no frame", one.topic) for name, one in profile.cameras.items()]
    silent = {
        name: f"{instead}: no message of {topic}"
        for name, instead, topic in beside
        if not (topic in topics and len(topics[topic]))
    }
    return profile.fallbacks | absent | silent


def without_cameras(profile: Profile, topics: Mapping[str, T]) -> dict[str, T]:
    """Return the topics without those that are read only for images.

    Keeping frames must not change rows, so cameras affect neither the clock nor the end of a
    recording.
    """
    named = {source.topic for source in profile.sources.values()}
    named |= {signal.topic for signal in profile.signals.values()}
    beside = {camera.topic for camera in profile.cameras.values()} - named
    return {name: one for name, one in topics.items() if name not in beside}


def transforms_of(profile: Profile, inputs: InputColumns) -> Edges:
    """Return the transforms that pose, goals and plans need; none if the profile has no [frames].

    Raises:
        RecordingError: the pose must come from transforms, and they do not connect its frames.
    """
    frames = profile.frames
    if frames is None:
        return Edges({}, frozenset(), {})
    edges = Edges.of(frames, inputs.topics)
    if "pose" not in inputs.by_name and (why := edges.missing(frames.base, frames.fixed)):
        raise RecordingError(
            why, remedy="correct `frames` in the profile; see `restock profile check`"
        )
    named = {frame for name in ("goal", "plan") for frame in inputs.frames_of(name)}
    return edges.only({frames.base, frames.fixed, *named})


def place_messages(inputs: InputColumns, tree: Tree, segments: Sequence[ClockSegment]) -> None:
    """Set `inputs.placed`: poses of the frames of goals and plans that are not in the fixed one."""
    fixed = plain(tree.frames.fixed)
    for name in ("goal", "plan"):
        frames = np.array([*inputs.frames_of(name), None], object)[:-1]
        others = sorted(set(frames.tolist()) - {fixed, ""})
        if not others:
            continue
        at = inputs.placed[name] = Placement.nowhere(len(frames))
        topic = inputs.by_name[name].topic
        for frame in others:
            samples = [segment.topics[topic] for segment in segments]
            inside = [frames[one.row] == frame for one in samples]
            times = [one.stamp_ns[keep] for one, keep in zip(samples, inside, strict=True)]
            rows = np.concatenate(
                [one.row[keep] for one, keep in zip(samples, inside, strict=True)]
            )
            # Later segments repeat a latched message; filled backwards, its first time counts.
            at.fill(rows[::-1], tree.place(frame, times), slice(None, None, -1))


def frame_notes(profile: Profile, inputs: InputColumns, edges: Edges) -> list[str]:
    """Describe the origin of positions, and what is unusual about the frames of a recording."""
    notes = []
    if profile.origin_m is not None:
        x, y = profile.origin_m
        notes.append(f"positions: metres from ({x:.12g}, {y:.12g}), the profile's origin_m")
    if edges.parent_changes:
        changes = counted(edges.parent_changes, "time")
        notes.append(f"transforms: a frame was given another parent {changes}")
    if profile.frames is None:
        found = {name: set(inputs.frames_of(name)) - {""} for name in ("pose", "goal", "plan")}
        reported = [
            f"{name} {', '.join(sorted(frames))}" for name, frames in found.items() if frames
        ]
        if ("goal" in inputs.by_name) and len(set().union(*found.values())) > 1:
            notes.append(
                f"frames: {'; '.join(reported)}: they are treated as one frame, as the profile "
                "has no [frames]"
            )
    return notes


def sideways_path(source: Input) -> str:
    """Return the path of a command's sideways speed (to the left); "" if unknown."""
    if given := source.fields.get("sideways_mps"):
        return element_of(given)[0]
    path = source.fields.get("speed_mps", "")
    return path[:-1] + "y" if path.split(".")[-2:] == ["linear", "x"] else ""


def sideways_notes(source: Input, fields: Mapping[str, FieldColumn]) -> list[str]:
    """Return a note that counts commands with a sideways speed, which no action has."""
    aside = np.asarray(fields.get(sideways_path(source), np.zeros(0)), np.float64)
    aside = aside * (factor_of("sideways_mps", source.fields.get("sideways_mps", "")) or 1.0)
    count = int((np.abs(aside) > SIDEWAYS_MPS).sum())
    if not count:
        return []
    return [
        f"command: {count:,} of {len(aside):,} messages of {source.topic} contain a sideways "
        f"speed, up to {np.nanmax(np.abs(aside)):.2g} m/s, which is ignored: actions have none"
    ]
