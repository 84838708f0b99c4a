"""A first profile for an unknown robot: from the topics and types of one of its recordings.

What each topic is for is guessed from its type and name; speeds of the actions, maximum ages, the
lidar's range and the frames come from the messages. The proposal is TOML with a comment at each
guess, and with all that might become custom signals, commented out.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field

import numpy as np

from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import TopicInfo
from restock.ingest.profile.profile import FALLBACKS
from restock.ingest.propose.candidates import candidates
from restock.ingest.propose.roles import (
    KINDS,
    LATCHED,
    MOTION,
    REQUIRED,
    SPENT,
    Kind,
    Roles,
    topics_for,
    transform_frames,
)
from restock.ingest.steps.clocks import odd as odd_clock
from restock.ingest.steps.clocks import topic_clock


@dataclass(frozen=True)
class Proposal:
    """The TOML of a profile, and what in it needs a person."""

    toml: str
    missing: list[str] = field(default_factory=list)  # required inputs that nothing fills
    signals: int = 0  # custom signals that stand in it, commented out


@dataclass(frozen=True)
class Commands:
    """What the commands of a recording say about the robot."""

    speed_mps: float = 0.5
    yaw_rate_radps: float = 1.0
    backs: bool = False
    period_s: float | None = None  # between two of them, mostly
    count: int = 0
    topic: str = ""


def propose_profile(recording: Recording, name: str) -> Proposal:
    """A profile for recordings like this one."""
    topics = {n: t for n, t in recording.topics.items() if t.skipped is None and t.expected}
    roles = {role: topics_for(topics, kinds) for role, kinds in KINDS.items()}
    if not (roles["goal"] and roles["plan"]):
        roles["goal"] = roles["plan"] = []
    frames = transform_frames(recording)
    # Odometry drifts: where transforms lead to a map, they are the better pose.
    drifts = all(topic.type == MOTION for topic, _ in roles["pose"])
    framed = frames is not None and (frames.localised or not roles["pose"]) and drifts
    commands = _commands(recording, roles)
    seconds = _driven_s(recording, commands)
    missing = [role for role in REQUIRED if not roles[role] and not (role == "pose" and framed)]
    best = [(role, *fitting[0]) for role, fitting in roles.items() if fitting]
    signals = candidates(
        recording,
        without={topic.name for role, topic, _ in best if role in SPENT},
        used={(topic.name, path) for _, topic, kind in best for path in kind.fields.values()},
    )
    lines = [
        f"# Proposed from {recording.path.name}: check what stands in comments, then run",
        f"# restock profile check THIS_FILE {recording.path.name}",
        "#",
        *_topic_lines(recording, roles, seconds),
        f'name = "{name}"',
        'conditions = ["recovery", "near_collision", "wheel_slip", "blocked_aisle"]',
        'behaviour_policy = "unknown"  # who drove, where no topic says',
        "",
        *_task_lines(recording, roles, commands),
        *_clock_lines(recording, roles, commands),
    ]
    for role, fitting in roles.items():
        if role == "pose" and framed:
            lines += ["# [inputs.pose]  # from transforms, by [frames]", ""]
        else:
            lines += _input_lines(role, fitting, seconds)
    lines += frames.lines(used=framed) if frames is not None else []
    if signals:
        lines += [
            "# Custom signals: columns of the table, for conditions and queries. To have one, take",
            "# away the first # of its lines; docs/profile.md says what a path may be.",
            "",
        ]
    for signal in signals:
        lines += ["# " + line for line in signal.toml(_max_age_s(signal.topic, seconds))] + [""]
    lines += [
        "# A condition of your own: one SQL expression over the steps of an episode:",
        "# [[condition]]",
        '# name = "tight"',
        '# timing = "pre"  # "post" may look ahead',
        '# sql = "clearance_m < 0.3 AND command_speed_mps > 0"',
        "",
        "# Named rectangles of the map, for coverage by place:",
        "# [[zone]]",
        '# name = "aisle_1"',
        "# box_m = [0.0, 0.0, 10.0, 1.8]  # x0, y0, x1, y1",
        "",
    ]
    return Proposal("\n".join(lines), missing, len(signals))


def _topic_lines(recording: Recording, roles: Roles, seconds: float) -> list[str]:
    """Every topic with its rate and what it is taken for, as a comment."""
    taken: dict[str, list[str]] = {}
    for role, found in roles.items():
        if found:
            taken.setdefault(found[0][0].name, []).append(role)
    width = max((len(name) for name in recording.topics), default=0)
    kinds = max((len(topic.type) for topic in recording.topics.values()), default=0)
    lines = []
    for name, topic in recording.topics.items():
        rate = f"{topic.expected / seconds:7.1f} Hz" if seconds > 0 else " " * 10
        why = f"skipped: {topic.skipped}" if topic.skipped else ", ".join(taken.get(name, []))
        lines.append(f"# {name:<{width}}  {topic.type:<{kinds}}  {rate}  {why}".rstrip())
    return [*lines, ""]


def _commands(recording: Recording, roles: Roles) -> Commands:
    """Read the commands: how fast, which way, how often."""
    if not roles["command"]:
        return Commands()
    topic, kind = roles["command"][0]
    paths = list(kind.fields.values())
    columns = recording.read({topic.name: paths})[topic.name]
    speed, turn = (np.asarray(columns.fields[path], np.float64) for path in paths)
    sane = np.isfinite(speed) & np.isfinite(turn)
    speed, turn = speed[sane], turn[sane]
    gaps = np.diff(np.sort(columns.log_time_ns)) * 1e-9
    # The fastest that is commanded now and then; a single outlier is no action.
    fast, sharp = (float(np.percentile(np.abs(c), 98)) if len(c) else 0.0 for c in (speed, turn))
    return Commands(
        fast or Commands.speed_mps,
        sharp or Commands.yaw_rate_radps,
        bool((speed < -0.05 * fast).any()),
        float(np.median(gaps)) if len(gaps) else None,
        len(columns),
        topic.name,
    )


def _driven_s(recording: Recording, commands: Commands) -> float:
    """How long the robot drove: recordings may pause between drives."""
    span = recording.span_ns
    whole = (span[1] - span[0]) * 1e-9 if span else 0.0
    if commands.period_s is None:
        return whole
    driven = commands.period_s * commands.count
    return min(driven, whole) if driven > whole / 10 else whole


def _task_lines(recording: Recording, roles: Roles, commands: Commands) -> list[str]:
    routed, (low, high) = bool(roles["goal"]), _lidar_range(recording, roles)
    speed, turn = commands.speed_mps, commands.yaw_rate_radps
    actions = [(0.0, 0.0), (speed / 2, 0.0), (speed, 0.0)]
    actions += [(0.8 * speed, 0.6 * turn), (0.8 * speed, -0.6 * turn), (0.0, turn), (0.0, -turn)]
    actions += [(-speed / 2, 0.0)] if commands.backs else []
    period = float(np.clip(round(commands.period_s or 0.2, 2), 0.1, 0.5))
    kind = "speeds" if roles["command"] and roles["command"][0][0].type == MOTION else "commands"
    seen = f"from {commands.count} {kind} of {commands.topic}" if commands.count else "a guess"
    return [
        "[task]",
        f'goal = "{"route" if routed else "none"}"'
        + ("" if routed else "  # no goal and plan seen: progress is forward displacement"),
        f"control_period_s = {period:g}",
        f"range_min_m = {low:g}",
        f"range_max_m = {high:g}  # lidar ranges beyond it count as free",
        f"actions = [  # (m/s, rad/s), {seen}; the first must be stop",
        *(f"  [{v:.3g}, {w:.3g}]," for v, w in actions),
        "]",
        "",
        "[task.body]  # MEASURE THESE: they decide what is near",
        "length_m = 0.6",
        "width_m = 0.5",
        "lidar_x_m = 0.0  # of the lidar, ahead of the middle",
        "",
    ]


def _lidar_range(recording: Recording, roles: Roles) -> tuple[float, float]:
    """The nearest and the farthest that the lidar says it sees; at most 4 m, where it matters."""
    if not roles["scan"]:
        return 0.05, 4.0
    topic = roles["scan"][0][0].name
    columns = recording.read({topic: ["range_min", "range_max"]})[topic].fields
    low, high = (float(np.median(np.asarray(columns[f"range_{end}"]))) for end in ("min", "max"))
    sane = 0 <= low < high < np.inf
    return (round(low, 3), min(round(high, 3), 4.0)) if sane else (0.05, 4.0)


def _clock_lines(recording: Recording, roles: Roles, commands: Commands) -> list[str]:
    sensors = [
        fitting[0][0] for role, fitting in roles.items() if fitting and role in (*REQUIRED, "scan")
    ]
    stamped = {t.name for t in sensors if "header.stamp" in recording.leaves(t.name)}
    sensing = [t for t in sensors if t.name != commands.topic or t.type == MOTION]
    by_stamp = bool(sensing) and all(t.name in stamped for t in sensing)
    clocks = [
        topic_clock(name, recording.read({name: ["header.stamp"]})[name], 1.0)
        for name in sorted(stamped)
    ]
    odd = [f"{clock.topic}: {what}" for clock in clocks if (what := odd_clock(clock.as_row()))]
    offsets = [clock.offset_ns * 1e-9 for clock in clocks if clock.offset_ns is not None]
    period = commands.period_s
    steady = period is not None and 0.08 <= period <= 0.5
    why = f"a command every {period:.2f} s, mostly" if period is not None else "no commands seen"
    offset = f"  # log time is {min(offsets):,.3f} s ahead of it" if by_stamp and offsets else ""
    return [
        "[clock]",
        *(f"# {what}" for what in odd),
        f'alignment = "{"header.stamp" if by_stamp else "log_time"}"' + offset,
        f'steps = "{"command" if steady else "rate"}"  # {why}',
        "max_gap_s = 0.5",
        "",
    ]


def _max_age_s(topic: TopicInfo, seconds: float) -> float | None:
    """Four periods of a topic, or None (latched) for one with few messages."""
    rate = topic.expected / seconds if seconds > 0 else 0.0
    if topic.expected < 3 or rate < 0.05:
        return None
    return float(np.clip(round(4 / rate, 1), 0.2, 10.0))


def _input_lines(role: str, fitting: list[tuple[TopicInfo, Kind]], seconds: float) -> list[str]:
    if not fitting:
        if role in REQUIRED:
            fits = " or ".join(dict.fromkeys(kind.type for kind in KINDS[role]))
            if role == "pose":
                fits += ", or transforms that join two frames"
            return [
                f"# MISSING, and required: no topic of {fits}.",
                f"# [inputs.{role}]",
                "",
            ]
        fallback = FALLBACKS.get(role, "progress without a goal")
        return [f"# [inputs.{role}]  # no topic seen; instead: {fallback}", ""]
    topic, kind = fitting[0]
    rate = topic.expected / seconds if seconds > 0 else 0.0
    motion = role == "command" and topic.type == MOTION
    others = ", ".join(other.name for other, _ in fitting[1:4])
    fields = ", ".join(f'{key} = "{path}"' for key, path in kind.fields.items())
    lines = [
        *(
            ["# No command was recorded: the measured motion is used in place of commands."]
            if motion
            else []
        ),
        f"[inputs.{role}]  # {rate:.1f} Hz" + (f"; or {others}?" if others else ""),
        f"topic = {json.dumps(topic.name)}",
        f'type = "{topic.type}"',
        f"fields = {{ {fields} }}",
    ]
    if role not in LATCHED:
        age = float(np.clip(round(4 / rate, 2) if rate else 1.0, 0.2, 1.0))
        lines.append(f"max_age_s = {age:g}")
    if role in FALLBACKS:
        lines.append("optional = true")
    return [*lines, ""]
