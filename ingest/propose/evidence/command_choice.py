"""Which topic drives the robot and whose commands it passes on, by what the commands say.

A multiplexer's output repeats its inputs: where a topic changes to what another one has just said,
and not the other way about, it comes after it. A joystick drives while a button is held, where the
commands of that time are an axis of its, times a scale.

A smoother or a collision monitor behind the multiplexer says nothing that anybody said: its command
goes from where it was towards what was chosen, or is a part of that. By this it is followed back to
the multiplexer, and from there to whose command that repeats.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from restock.arrays import F64, Ints
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import TopicInfo
from restock.ingest.decoding.columns import Ragged
from restock.ingest.propose.evidence.roles import BY_HAND, NAVIGATION, Kind

JOY = "sensor_msgs/msg/Joy"
WITHIN_S = 0.5
MIN_PASSED, MIN_SHARE, MOSTLY = 5, 0.02, 0.5  # changes that one topic took over from another
MIN_HELD, FITS = 10, 0.9  # commands while a button is held; of them, how many are an axis's
MIN_TOLD, FOLLOWS, EXACTLY = 20, 0.95, 0.98  # commands that tell; of them, how many follow
TARGET_S, SAME = 1.0, 1e-4  # how old what it goes towards may be; m/s and rad/s
_STEERED = "wheelbase_m"
Fit = tuple[TopicInfo, Kind]


@dataclass(frozen=True)
class CommandChoice:
    """The sources of the command that drives, as TOML; and who drives where no source says."""

    lines: list[str] = field(default_factory=list)
    policy: str = "unknown"
    why: str = "the driver, if no topic tells"

    def toml(self, wheelbase_m: float) -> list[str]:
        """The tables; a source that steers does so about the command's wheelbase."""
        steered = f"wheelbase_m = {round(wheelbase_m, 4):g}  # as of the command"
        return [steered if line == _STEERED else line for line in self.lines]


@dataclass(frozen=True)
class _Told:
    fit: Fit
    log_time_ns: Ints  # (N,) ascending
    values: F64  # (N, 2) speed and turn

    def passed_on(self, output: _Told) -> int:
        """How many changes of `output` are to what this topic said last."""
        changed = np.flatnonzero((np.diff(output.values, axis=0) != 0).any(axis=1)) + 1
        at = np.searchsorted(self.log_time_ns, output.log_time_ns[changed], "right") - 1
        age_s = (output.log_time_ns[changed] - self.log_time_ns[np.maximum(at, 0)]) * 1e-9
        same = (self.values[np.maximum(at, 0)] == output.values[changed]).all(axis=1)
        return int((same & (at >= 0) & (age_s <= WITHIN_S)).sum())

    @np.errstate(invalid="ignore", over="ignore")  # what is no number follows nothing
    def followed_by(self, output: _Told) -> float:
        """The share of the commands of `output` that lie towards what this topic said, or are a
        part of that; 0 where too few tell."""
        at = np.searchsorted(self.log_time_ns, output.log_time_ns[1:], "right") - 1
        fresh = at >= 1
        fresh &= output.log_time_ns[1:] - self.log_time_ns[np.maximum(at, 0)] <= TARGET_S * 1e9
        before, now = output.values[:-1], output.values[1:]
        good, telling = np.zeros(len(now), np.bool_), np.zeros(len(now), np.bool_)
        for late in (0, 1):  # the newest may have come too late to count
            target = self.values[np.maximum(at - late, 0)]
            low, high = np.minimum(before, target) - SAME, np.maximum(before, target) + SAME
            good |= ((now >= low) & (now <= high)).all(axis=1)
            part = (now * target).sum(axis=1) / np.maximum((target**2).sum(axis=1), 1e-12)
            near = np.abs(now - part[:, None] * target).max(axis=1) <= SAME
            good |= near & (part >= 0) & (part <= 1)
            telling |= (np.abs(target - before).max(axis=1) > SAME) | (now != before).any(axis=1)
        counted = fresh & telling
        return float(good[counted].mean()) if counted.sum() >= MIN_TOLD else 0.0

    @property
    def changes(self) -> int:
        return int((np.diff(self.values, axis=0) != 0).any(axis=1).sum())


def choose_command(
    recording: Recording, topics: dict[str, TopicInfo], fitting: Sequence[Fit]
) -> tuple[list[Fit], CommandChoice]:
    """The topics that may drive, what comes last first; and the sources of the first's commands."""
    if not fitting:
        return [], CommandChoice()
    reported = [one for one in (_read(recording, fit) for fit in fitting) if len(one.values)]
    if not reported:
        return list(fitting), CommandChoice()
    first = reported[0]
    for _ in reported:  # down a chain of multiplexers
        later = [one for one in reported if one is not first and _feeds(first, one, MOSTLY)]
        if not later:
            break
        first = max(later, key=first.passed_on)
    through, first = _through(reported, first)
    by_whom = first if through is None else through
    chosen = [first.fit, *(fit for fit in fitting if fit is not first.fit)]
    sources: dict[str, _Told] = {}
    inputs = [one for one in _inputs(reported, by_whom) if one is not first]
    for one in sorted(inputs, key=lambda one: -one.passed_on(by_whom)):
        sources.setdefault(_policy(one.fit[0].name), one)
    lines = [line for name, one in sources.items() for line in _lines(name, one, by_whom)]
    if "teleop" not in sources:
        lines += _joystick_lines(recording, topics, by_whom)
    if through is not None:
        lines += _through_lines(through, first)
    named = _policy(first.fit[0].name)
    if not sources and named in ("teleop", "navigation"):
        return chosen, CommandChoice(lines, named, f"by the name of {first.fit[0].name}")
    return chosen, CommandChoice(lines)


def _read(recording: Recording, fit: Fit) -> _Told:
    topic, kind = fit
    paths = list(kind.fields.values())
    columns = recording.read({topic.name: paths})[topic.name]
    values = np.stack([np.asarray(columns.fields[path], np.float64) for path in paths], axis=1)
    order = np.argsort(columns.log_time_ns, kind="stable")
    return _Told(fit, columns.log_time_ns[order], values[order])


def _inputs(reported: Sequence[_Told], output: _Told) -> list[_Told]:
    """Those whose commands it passes on."""
    return [one for one in reported if one is not output and _feeds(one, output, MIN_SHARE)]


def _through(reported: Sequence[_Told], first: _Told) -> tuple[_Told | None, _Told]:
    """The multiplexer's output that the driving command follows, smoothed; and that command.

    None where the command is the multiplexer's own, or nothing shows what it follows.
    """
    muxed: _Told | None = None
    if _inputs(reported, first):  # it may be one in the middle of a chain
        after = [one for one in reported if one is not first and _follows(first, one)]
        if after:
            muxed, first = first, max(after, key=lambda one: len(one.values))
    if muxed is None:
        before = [one for one in reported if one is not first and _follows(one, first)]
        before = [one for one in before if _inputs([o for o in reported if o is not first], one)]
        muxed = max(before, key=lambda one: one.followed_by(first), default=None)
    if muxed is not None and muxed.passed_on(first) >= EXACTLY * first.changes:
        muxed = None
    return muxed, first


def _follows(one: _Told, output: _Told) -> bool:
    """Whether `output` goes towards what `one` says, and not the other way about."""
    share = one.followed_by(output)
    return share >= FOLLOWS and share > output.followed_by(one)


def _through_lines(through: _Told, command: _Told) -> list[str]:
    topic, kind = through.fit
    fields = ", ".join(f'{key} = "{path}"' for key, path in kind.fields.items())
    return [
        f"# {through.followed_by(command):.0%} of the commands of {command.fit[0].name} move "
        "towards its last message, or are a part of it:",
        "[command_through]  # the driver is the source whose command it repeats; unknown while it "
        "is silent",
        f"topic = {json.dumps(topic.name)}",
        f'type = "{topic.type}"',
        f"fields = {{ {fields} }}",
        *([_STEERED] if "steering_rad" in kind.fields else []),
        f"max_age_s = {_age_s(through):g}",
        "",
    ]


def _age_s(one: _Told) -> float:
    """Four periods of it."""
    gaps = np.diff(one.log_time_ns) * 1e-9
    return float(np.clip(round(4 * float(np.median(gaps)), 2), 0.2, 1.0)) if len(gaps) else 0.5


def _feeds(one: _Told, output: _Told, share: float) -> bool:
    passed = one.passed_on(output)
    enough = passed >= max(MIN_PASSED, share * output.changes)
    return enough and passed > output.passed_on(one)


def _policy(topic: str) -> str:
    """Who drives by a topic of this name."""
    name = topic.lower()
    if any(word in name for word in BY_HAND):
        return "teleop"
    if any(word in name for word in NAVIGATION):
        return "navigation"
    parts = [part for part in name.split("/") if part and part not in ("cmd_vel", "input")]
    return parts[-1][:64] if parts else name


def _lines(name: str, one: _Told, output: _Told) -> list[str]:
    topic, kind = one.fit
    fields = ", ".join(f'{key} = "{path}"' for key, path in kind.fields.items())
    return [
        f"# {one.passed_on(output):,} of {output.changes:,} changes of {output.fit[0].name} "
        "follow its last message:",
        f"[command_sources.{json.dumps(name)}]  # the behaviour policy of rows with its command",
        f"topic = {json.dumps(topic.name)}",
        f'type = "{topic.type}"',
        f"fields = {{ {fields} }}",
        *([_STEERED] if "steering_rad" in kind.fields else []),
        f"max_age_s = {_age_s(one):g}",
        "",
    ]


def _joystick_lines(
    recording: Recording, topics: dict[str, TopicInfo], command: _Told
) -> list[str]:
    """The button that is held while a joystick drives, or what to say if the logs do not show."""
    for topic in topics.values():
        if topic.type != JOY:
            continue
        fields = recording.read({topic.name: ["axes", "buttons"]})[topic.name]
        button = _held(command, fields.log_time_ns, fields.fields["axes"], fields.fields["buttons"])
        mark = "" if button is not None else "# "
        why = (
            "while it is held, the commands are those of the stick"
            if button is not None
            else "no button follows from these commands: set the one that is held while it drives"
        )
        return [
            f"{mark}[command_sources.teleop]  # a joystick: {why}",
            f"{mark}topic = {json.dumps(topic.name)}",
            f'{mark}type = "{topic.type}"',
            f'{mark}fields = {{ pressed = "buttons[{button or 0}]" }}',
            "",
        ]
    return []


def _held(command: _Told, log_time_ns: Ints, axes: object, buttons: object) -> int | None:
    """The button while which is held the speed is an axis times a scale; None: there is none."""
    tables = []
    for column in (axes, buttons):
        if not isinstance(column, Ragged) or not len(column) or len(set(column.lengths)) != 1:
            return None
        tables.append(np.asarray(column.values, np.float64).reshape(len(column), -1))
    order = np.argsort(log_time_ns, kind="stable")
    at = np.searchsorted(log_time_ns[order], command.log_time_ns, "right") - 1
    known, rows = at >= 0, order[np.maximum(at, 0)]
    stick, pressed, speed = tables[0][rows], tables[1][rows] > 0, command.values[:, 0]
    best: tuple[int, int] | None = None  # commands, -button
    for button in range(pressed.shape[1]):
        held = known & pressed[:, button]
        moving = held & (speed != 0)
        if moving.sum() < MIN_HELD:
            continue
        for axis in stick.T:
            ratio = speed[moving & (axis != 0)] / axis[moving & (axis != 0)]
            if len(ratio) < MIN_HELD or len(np.unique(axis[moving])) < 3:
                continue
            near = np.abs(speed[held] - np.median(ratio) * axis[held]) <= 0.01 + 0.01 * np.abs(
                speed[held]
            )
            if near.mean() >= FITS:
                best = max(best or (0, 0), (int(held.sum()), -button))
    return None if best is None else -best[1]
