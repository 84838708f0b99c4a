"""Computes observations from live messages, with the same code as for recordings.

A recording is read in columns, and all its steps are made at once. On a robot there are only the
last few messages of each topic and the current tick. Both use the same holds, fills and
`restock.ingest.task.task.observe`; only the source of the columns differs. `LiveClock` computes the
median offset from the last messages, as `align` does from a whole recording.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.ingest.decoding.columns import FieldColumn, Ragged, TopicColumns, join
from restock.ingest.profile.profile import Profile, live_problems
from restock.ingest.profile.signal_paths import conventions_of, element_of
from restock.ingest.profile.tables import Input
from restock.ingest.steps.align import NS, ClockSegment, Samples
from restock.ingest.steps.aligned_inputs import AlignedInputs
from restock.ingest.steps.clocks import JUMP_S, ClockMap, median
from restock.ingest.steps.filling import Filling
from restock.ingest.steps.input_columns import InputColumns
from restock.ingest.steps.needs import field_paths
from restock.ingest.task.task import Signals, nearest_action, observe
from restock.ingest.task.task_sql import Past
from restock.ingest.task.tracks import Tracker

_DELAYS = 200  # last delays of each topic, whose median is used


class LiveClock:
    """Estimates the offset, log time less the robot's time, from messages in order of log time.

    A stamp disagrees with the clock if log time less stamp is over `jump_ns` from the offset.
    """

    def __init__(self, jump_ns: int) -> None:
        self._jump_ns = jump_ns
        self._delays_ns: dict[str, deque[int]] = {}  # log time less stamp, by topic
        self._offset_ns: int | None = 0  # None: to be computed

    def receive(self, topic: str, log_time_ns: int, stamp_ns: int) -> bool:
        """Return whether a message's stamp agrees with the clock; if so, use it for the offset."""
        if not self.agrees(log_time_ns, stamp_ns):
            return False
        delays = self._delays_ns.setdefault(topic, deque(maxlen=_DELAYS))
        delays.append(log_time_ns - stamp_ns)
        self._offset_ns = None
        return True

    def agrees(self, log_time_ns: int, stamp_ns: int) -> bool:
        """Return whether a stamp agrees with the clock; before any message, every stamp does."""
        away_ns = abs(log_time_ns - stamp_ns - self.offset_ns)
        return not self._delays_ns or away_ns <= self._jump_ns

    @property
    def offset_ns(self) -> int:
        """Return log time less the robot's time: the smallest of the topics' median delays.

        It is 0 before the first message.
        """
        if self._offset_ns is None:
            delays = self._delays_ns.values()
            self._offset_ns = min(median(np.array(each, np.int64)) for each in delays)
        return self._offset_ns


# Inputs that observations do not use.
PROVENANCE = ("behaviour_policy", "true_condition", "true_exposure", "perturbation")
_MAX_WAITING = 2000  # limit of a topic's messages that wait for a tick


@dataclass(frozen=True)
class Observed:
    """An observation at a tick, and whether it can be used."""

    observation: NDArray[np.float32]  # (D,)
    stamp_ns: int  # time of the tick on the alignment clock
    previous_action: int  # action nearest to the command since the last tick; 0 (stop) if none
    problem: str  # why the robot must not act on this observation, or ""
    signals: Signals  # at the tick, one row each; empty if nothing could be observed


@dataclass(frozen=True)
class _Message:
    log_time_ns: int
    stamp_ns: int  # on the alignment clock
    fields: dict[str, FieldColumn]  # one row each


class LiveObserver:
    """Takes messages as they are received, and computes the observation at a tick.

    A message is any object with the fields of its ROS type as attributes (rclpy's, rosbags').
    Messages that no later tick needs are dropped, so memory does not grow.

    Args:
        profile: which topics to observe, and how.
        max_ahead_s: refuse messages whose stamp is ahead of their log time by more than this. None:
            accept them, as in a recording, whose log time may come from another computer.

    Raises:
        ConfigError: the profile uses something that is `live_problems`.
    """

    def __init__(self, profile: Profile, max_ahead_s: float | None = None) -> None:
        if lacking := live_problems(profile):
            raise ConfigError(
                f"takes {' and '.join(lacking)}",
                where=f"profile {profile.name!r}",
                remedy="; ".join(lacking.values()),
            )
        self.profile, self.task = profile, profile.task
        self._inputs: dict[str, list[Input]] = {}
        for name, source in profile.inputs.items():
            if name not in PROVENANCE:
                self._inputs.setdefault(source.topic, []).append(source)
        self.left_out: dict[str, int] = {}  # topic -> messages whose stamp disagrees with the clock
        self.ahead: dict[str, int] = {}  # topic -> messages whose stamp is ahead of log time
        self._max_ahead_ns = None if max_ahead_s is None else round(max_ahead_s * NS)
        self.reset()

    def reset(self) -> None:
        """Discard all messages; needed if the clock was set or the robot was moved."""
        self._buffers: dict[str, list[_Message]] = {topic: [] for topic in self._inputs}
        self._clock = LiveClock(round(JUMP_S * NS))
        self._command: _Message | None = None  # first since the last tick, else an earlier command
        self._ticked = True
        self._before_ns: int | None = None
        self._tracker = Tracker(self.task) if self.task.tracks else None
        of_own = self.task.observed
        self._past = Past(self.task, "observed", 1, "a running robot") if of_own else None

    @property
    def topics(self) -> dict[str, str]:
        """Return the topics to subscribe to, with their message types."""
        return {topic: sources[0].type for topic, sources in self._inputs.items()}

    @property
    def offset_ns(self) -> int:
        """Return log time less the alignment clock, as ingest finds it."""
        return self._clock.offset_ns

    def receive(self, topic: str, message: Any, log_time_ns: int) -> None:
        """Take a message of one of `topics`, received at `log_time_ns`.

        Raises:
            KeyError: the profile does not use this topic.
            AttributeError, TypeError: it lacks fields of its type. Nothing of it is kept.
        """
        sources = self._inputs[topic]
        paths = dict.fromkeys(path for source in sources for path in field_paths(source))
        latched = all(source.max_age_s is None for source in sources)
        fields = {path: _column(message, path) for path in paths}
        fields |= _estimate_flags(message, sources)
        stamp_ns = self._stamp(topic, message, log_time_ns, latched)
        if stamp_ns is None:
            return
        taken = _Message(log_time_ns, stamp_ns, fields)
        if topic != self.profile.inputs.command.topic:
            self._buffers[topic].append(taken)
            if len(self._buffers[topic]) > _MAX_WAITING:  # nobody calls `observe`
                del self._buffers[topic][: _MAX_WAITING // 2]
        elif self._ticked:
            self._command, self._ticked = taken, False

    def observe(self, now_ns: int) -> Observed:
        """Compute the observation at a tick; `now_ns` is by the clock of the log times."""
        offset_ns = 0 if self.profile.clock.alignment == "log_time" else self.offset_ns
        stamp_ns = now_ns - offset_ns
        ticks = [stamp_ns] if self._before_ns is None else [self._before_ns, stamp_ns]
        topics: dict[str, TopicColumns] = {}
        samples: dict[str, Samples] = {}
        for topic, messages in self._buffers.items():
            if topic == self.profile.inputs.command.topic:
                topics[topic], samples[topic] = self._commands(ticks)
            elif messages or not all(source.optional for source in self._inputs[topic]):
                topics[topic] = _columns(messages)
                stamps = np.array([message.stamp_ns for message in messages], np.int64)
                order = np.argsort(stamps, kind="stable")
                samples[topic] = Samples(stamps[order], order)
        silent = [topic for topic, columns in topics.items() if not len(columns)]
        if silent:
            return self._unknown(stamp_ns, f"nothing received yet on {', '.join(sorted(silent))}")
        inputs = InputColumns(self.profile, topics)
        segment = ClockSegment(samples, ClockMap.constant(offset_ns))
        at = [np.array(ticks, np.int64)]
        filling = Filling(AlignedInputs(self.profile, inputs, [segment], at))
        signals = filling.fill(self._tracker, self._past)
        last = len(ticks) - 1
        before = last - int(filling.follows[last])
        now, then = (
            {name: column[[row]] for name, column in signals.items()} for row in (last, before)
        )
        action, _ = nearest_action(
            self.task, then["command_speed_mps"], then["command_yaw_rate_radps"]
        )
        previous = int(action[0]) if before != last else 0
        problem = str(filling.problem[last] or filling.route_problem[last])
        observation = observe(self.task, now, then, np.array([previous]))[0]
        self._tick(stamp_ns)
        return Observed(observation, stamp_ns, previous, problem, now)

    def _unknown(self, stamp_ns: int, problem: str) -> Observed:
        self._tick(stamp_ns)
        nothing = np.zeros(self.task.observation_size, np.float32)
        return Observed(nothing, stamp_ns, 0, problem, {})

    def _tick(self, stamp_ns: int) -> None:
        """Drop messages that neither this tick nor a later one needs."""
        self._before_ns, self._ticked = stamp_ns, True
        motion, pose = self.profile.motion, self.profile.inputs.pose
        for topic, messages in self._buffers.items():
            known = [message.stamp_ns for message in messages if message.stamp_ns <= stamp_ns]
            if known:
                newest = max(known)
                if motion is not None and pose is not None and topic == pose.topic:
                    newest -= round(2 * motion.window_s * NS)  # earlier poses give the speed
                self._buffers[topic] = [m for m in messages if m.stamp_ns >= newest]

    def _commands(self, ticks: Sequence[int]) -> tuple[TopicColumns, Samples]:
        """Return the command since the last tick, for all `ticks`; the next is not known yet."""
        fields: dict[str, FieldColumn] = {
            path: np.zeros(1) for path in field_paths(self.profile.inputs.command)
        }
        if self._command is not None:
            fields = self._command.fields
        stamps = np.array(ticks, np.int64)
        columns = TopicColumns(stamps[:1], stamps[:1], fields)
        return columns, Samples(stamps, np.zeros(len(stamps), np.intp))

    def _stamp(self, topic: str, message: Any, log_time_ns: int, latched: bool) -> int | None:
        """Return a message's alignment time; None for a refused message, which is counted."""
        if self.profile.clock.alignment == "log_time":
            return log_time_ns
        received_ns = log_time_ns - self.offset_ns
        header = getattr(message, "header", None)
        if header is None:
            return received_ns
        stamp_ns = int(header.stamp.sec) * NS + int(header.stamp.nanosec)
        ahead = self._max_ahead_ns is not None and stamp_ns - log_time_ns > self._max_ahead_ns
        if latched:  # it may have been published long ago, so it must not set the clock
            known = not ahead and self._clock.agrees(log_time_ns, stamp_ns)
            return stamp_ns if known else received_ns
        # A stamp that is ahead would set the clock ahead, and delayed messages would look fresh.
        if not ahead and self._clock.receive(topic, log_time_ns, stamp_ns):
            return stamp_ns
        refused = self.ahead if ahead else self.left_out
        refused[topic] = refused.get(topic, 0) + 1
        return None


def value_of(message: Any, path: str) -> Any:
    """Read a message's value at a path such as `twist.linear.x`, `data` or `buttons[4]`.

    Raises:
        AttributeError: the message has no such field.
        IndexError: its list is shorter.
    """
    head, place = element_of(path)
    value = _member(message, head)
    return value if place is None else value[place]


def _estimate_flags(message: Any, sources: Sequence[Input]) -> dict[str, FieldColumn]:
    """Return the fields that mark a message as having no estimate, as columns of one row."""
    rules = (
        rule
        for source in sources
        for path in source.fields.values()
        for rule in conventions_of(source.type, path)
        if rule.of_messages
    )
    with suppress(AttributeError):  # the type may be another package's and lack these fields
        return {path: _column(message, path) for rule in rules for path in rule.fields}
    return {}


def _columns(messages: Sequence[_Message]) -> TopicColumns:
    times = np.array([message.log_time_ns for message in messages], np.int64)
    paths = messages[0].fields if messages else {}
    return TopicColumns(
        times, times, {path: join([message.fields[path] for message in messages]) for path in paths}
    )


def _column(message: Any, path: str) -> FieldColumn:
    """Return one message's value at a field path, as a column of one row."""
    head, repeated, tail = path.partition("[].")
    value = _member(message, head)
    if repeated:
        value = [_member(item, tail) for item in value]
    if isinstance(value, str | bool | int | float):
        return np.array([value])
    values = np.asarray(value)
    if not values.ndim:
        return values[None]
    return Ragged(values, np.array([0, len(values)], np.int64))


def _member(value: Any, path: str) -> Any:
    for name in path.split("."):
        value = getattr(value, name)
    return value
