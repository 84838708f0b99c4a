"""A recording played to a policy: what it would have done beside what drove, without ROS."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from restock.errors import RecordingError
from restock.ingest.live.observer import value_of
from restock.ingest.live.pilot import OTHER_TYPE, Decision, Pilot
from restock.ingest.steps.align import NS
from restock.ingest.task.limiter import RULES
from restock.ingest.task.task import nearest_action


@dataclass(frozen=True)
class Played:
    """A decision at a recorded command."""

    log_time_ns: int
    decision: Decision
    took_s: float
    drove: int | None  # the action nearest to that command; None: it says none


def play(pilot: Pilot, recording: Path) -> Iterator[Played]:
    """Decisions just before each command of a recording, its messages in the order of log time.

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
        # Bags of old say nothing of their types: Humble's are taken, as ingest does.
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
                    yield Played(now_ns, decision, took_s, _action(pilot, message))
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
    """Counts, latency of decisions (observation and policy, ms) and agreement with what drove."""
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


def _action(pilot: Pilot, message: Any) -> int | None:
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


__all__ = ["Played", "play", "summary"]
