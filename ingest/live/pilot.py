"""Decides by an exported policy from live messages: observation, proposal, limiter, takeovers.

`restock export RUN --to onnx` writes the policy. The file contains all that the robot needs: the
profile as TOML, with the topics to subscribe to, the observation, actions and limits. Neither ROS
nor PyTorch is needed: the node, a played recording and the tests all use this module.

The decision is to stop, with a reason, if an input is silent, stale or unreadable, a clock went
back, no beam of a scan is valid, or the policy's output is not a number.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from restock.errors import RecordingError, RestockError
from restock.ingest.live.observer import LiveObserver, Observed, value_of
from restock.ingest.live.policy_file import PolicyFile
from restock.ingest.profile.tables import Input
from restock.ingest.steps.align import NS
from restock.ingest.task.robot import NONE, RULES, UNKNOWN, Limits, limit
from restock.ingest.task.task import nearest_action

OPERATORS = ("operator", "teleop", "joystick")  # command sources that are people
BOOL = "std_msgs/msg/Bool"
ACTIVE_S = 0.5  # a person drives for this long after their last command
OTHER_TYPE = (AttributeError, IndexError, TypeError, ValueError)  # raised by reading another type


@dataclass(frozen=True)
class Decision:
    """The policy's decision at a tick."""

    observed: Observed
    action: int | None  # index of the proposed action; None: nothing could be decided
    proposal: tuple[float, float]  # speed m/s, yaw rate rad/s; a stop without an action
    command: tuple[float, float]  # the proposal within the limits
    rule: int  # index in `restock.ingest.task.robot.RULES`
    reason: str  # why it is a stop, or ""
    taken_over: bool  # a person drives, so the command must not be published


class Pilot:
    """Takes messages as they are received, and decides when `decide` is called.

    Args:
        policy: the policy, with its profile.
        limits: those of the limiter; None: no limiter, but an unknown input still stops the robot.
        takeover_topic: a Bool that is true while a person drives; "": none. The profile's
            `command_sources` in OPERATORS count as well: a pressed button, or commands within the
            last ACTIVE_S.
        max_ahead_s: as in `LiveObserver`.

    Raises:
        ConfigError: the profile cannot be observed live.
    """

    def __init__(
        self,
        policy: PolicyFile,
        limits: Limits | None,
        takeover_topic: str = "",
        max_ahead_s: float | None = None,
    ) -> None:
        self.policy, self.limits, self.profile = policy, limits, policy.profile
        self.observer = LiveObserver(self.profile, max_ahead_s)
        self._people = [
            source for name, source in self.profile.command_sources.items() if name in OPERATORS
        ]
        if takeover_topic:
            self._people.append(Input(takeover_topic, BOOL, {"pressed": "data"}))
        self._active_ns: dict[str, int | None] = {}  # a person's topic -> when they last drove
        self._now_ns: int | None = None
        self.counts: Counter[str] = Counter()  # decisions, and each kind of stop and limit
        self.unreadable: Counter[str] = Counter()  # topic -> messages of another type
        self._was_taken = False
        self.reason = "no decision yet"  # why the last decision was a stop, or ""

    @property
    def topics(self) -> dict[str, str]:
        """Return the topics to subscribe to, with their message types."""
        return {source.topic: source.type for source in self._people} | self.observer.topics

    @property
    def latched(self) -> set[str]:
        """Return topics whose last message is valid at any age, such as goals, plans and maps."""
        inputs = [source for _, source in self.profile.inputs.items()]
        aging = {source.topic for source in inputs if source.max_age_s is not None}
        return {source.topic for source in inputs} & self.observer.topics.keys() - aging

    def receive(self, topic: str, message: Any, now_ns: int) -> None:
        """Take a message of one of `topics`; count and ignore one of another type."""
        try:
            for source in self._people:
                if source.topic == topic:
                    self._note_person(source, message, now_ns)
            if topic in self.observer.topics:
                self.observer.receive(topic, message, now_ns)
        except OTHER_TYPE:
            self.unreadable[topic] += 1

    def _note_person(self, source: Input, message: Any, now_ns: int) -> None:
        path = source.fields.get("pressed")
        drives = path is None or bool(value_of(message, path))
        self._active_ns[source.topic] = now_ns if drives else None

    def taken_over(self, now_ns: int) -> bool:
        """Return whether a person drives."""
        for source in self._people:
            at_ns = self._active_ns.get(source.topic)
            held = source.max_age_s
            if held is None and "pressed" not in source.fields:
                held = ACTIVE_S
            if at_ns is not None and (held is None or now_ns - at_ns <= held * NS):
                return True
        return False

    def decide(self, now_ns: int) -> Decision:
        """Decide what to do at a tick; `now_ns` is by the same clock as in `receive`."""
        observed, reason = self._observe(now_ns)
        action, proposal = None, (0.0, 0.0)
        if not reason:
            action = self.policy.act(observed.observation)
            if action is None:
                reason = "policy: the value of its action is not a finite number"
            else:
                speed, turn = self.profile.task.actions[action]
                proposal = float(speed), float(turn)
        command, rule = self._limit(observed, proposal, unknown=bool(reason))
        taken = self.taken_over(now_ns)
        self.counts["decisions"] += 1
        self.counts["taken over"] += taken
        self.counts["takeovers"] += taken and not self._was_taken
        if reason:
            self.counts[f"stop: {reason}"] += 1
        elif rule != NONE:
            self.counts[f"limited: {RULES[rule]}"] += 1
        self._was_taken, self.reason = taken, reason
        return Decision(observed, action, proposal, command, rule, reason, taken)

    def _observe(self, now_ns: int) -> tuple[Observed, str]:
        before, self._now_ns = self._now_ns, now_ns
        if before is not None and now_ns < before:
            self.observer.reset()
            self._active_ns.clear()
            return self.observer.observe(now_ns), "clock: went back"
        try:
            observed = self.observer.observe(now_ns)
        except (RestockError, *OTHER_TYPE) as error:
            self.observer.reset()
            unreadable = f"unreadable: {str(error).splitlines()[0]}"
            return self.observer.observe(now_ns), unreadable
        return observed, observed.problem

    def _limit(
        self, observed: Observed, proposal: tuple[float, float], *, unknown: bool
    ) -> tuple[tuple[float, float], int]:
        if unknown:
            return (0.0, 0.0), UNKNOWN
        if self.limits is None:
            return proposal, NONE
        signals = observed.signals
        before = [signals["command_speed_mps"], signals["command_yaw_rate_radps"]]
        limited = limit(
            self.limits,
            np.array([proposal]),
            signals["sector_clearance_m"],
            np.stack(before, axis=-1),
        )
        speed, turn = limited.command[0].tolist()
        return (speed, turn), int(limited.rule[0])


@dataclass(frozen=True)
class Played:
    """A pilot's decision just before a recorded command."""

    log_time_ns: int
    decision: Decision
    took_s: float
    drove: int | None  # the action nearest to the recorded command; None if unreadable


def play(pilot: Pilot, recording: Path) -> Iterator[Played]:
    """Play a recording in the order of log time; yield a decision just before its commands.

    A command that comes less than 3/4 of a control period after the last decision gets no decision.

    Raises:
        RecordingError: it cannot be read, or has no commands.
    """
    from rosbags import rosbag1, rosbag2
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, get_typestore

    if not recording.exists():
        raise RecordingError(
            "no such file or folder",
            where=str(recording),
            remedy="give an MCAP file or a rosbag2 folder",
        )
    profile = pilot.profile
    command, task = profile.inputs.command, profile.task
    period_ns, fired_ns = round(task.control_period_s * NS), None
    try:
        # Old bags have no definitions: Humble's are used, as in ingest.
        with AnyReader([recording], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            topics = pilot.topics
            chosen = [c for c in reader.connections if topics.get(c.topic) == c.msgtype]
            if command.topic not in {connection.topic for connection in chosen}:
                raise RecordingError(
                    f"has no {command.topic} ({command.type})",
                    where=str(recording),
                    remedy=f"profile {profile.name!r} reads the command from that topic",
                )
            for connection, now_ns, raw in reader.messages(chosen):
                message = reader.deserialize(raw, connection.msgtype)
                if connection.topic == command.topic and (
                    fired_ns is None or now_ns - fired_ns >= 0.75 * period_ns
                ):
                    fired_ns, began_s = now_ns, time.perf_counter()
                    decision = pilot.decide(now_ns)
                    took_s = time.perf_counter() - began_s
                    yield Played(now_ns, decision, took_s, _nearest_action(pilot, message))
                pilot.receive(connection.topic, message, now_ns)
    except (
        *(AnyReaderError, SerdeError, rosbag1.ReaderError, rosbag2.ReaderError),
        OSError,
    ) as error:
        raise RecordingError(
            f"cannot be played: {error}",
            where=str(recording),
            remedy="give a whole rosbag2 or MCAP file; `restock info` shows what is damaged",
        ) from error


def summary(pilot: Pilot, played: list[Played]) -> dict[str, Any]:
    """Summarise counts, latency of decisions (ms) and agreement with the recorded commands."""
    took_ms = np.array([one.took_s for one in played]) * 1e3
    both = [
        (one.decision.action, one.drove)
        for one in played
        if one.decision.action is not None and one.drove is not None
    ]
    limited = Counter(RULES[one.decision.rule] for one in played if not one.decision.reason)
    return {
        "decisions": len(played),
        "latency_ms": {
            f"p{q}": round(float(np.percentile(took_ms, q)), 3) if len(played) else None
            for q in (50, 99)
        },
        "stopped_for": dict(Counter(one.decision.reason for one in played if one.decision.reason)),
        "limited": {rule: count for rule, count in limited.items() if rule != "none"},
        "taken_over": sum(one.decision.taken_over for one in played),
        "agreement": round(sum(a == b for a, b in both) / len(both), 4) if both else None,
        "unreadable": dict(pilot.unreadable),
        "off_the_clock": dict(pilot.observer.left_out),
    }


def _nearest_action(pilot: Pilot, message: Any) -> int | None:
    command = pilot.profile.inputs.command
    try:
        speed = float(value_of(message, command.fields["speed_mps"]))
        if command.wheelbase_m is not None:
            steering = float(value_of(message, command.fields["steering_rad"]))
            turn = speed * np.tan(steering) / command.wheelbase_m
        else:
            turn = float(value_of(message, command.fields["yaw_rate_radps"]))
    except OTHER_TYPE:
        return None
    if not np.isfinite([speed, turn]).all():
        return None
    action, _ = nearest_action(pilot.profile.task, np.array([speed]), np.array([turn]))
    return int(action[0])
