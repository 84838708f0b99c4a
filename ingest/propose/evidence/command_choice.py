"""Which topic drives the robot and whose commands it passes on, by what the commands say.

A multiplexer's output repeats its inputs: where a topic changes to what another one has just said,
and not the other way about, it comes after it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from restock.arrays import F64, Ints
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import TopicInfo
from restock.ingest.propose.evidence.roles import BY_HAND, NAVIGATION, Kind

WITHIN_S = 0.5
MIN_PASSED, MIN_SHARE, MOSTLY = 5, 0.02, 0.5  # changes that one topic took over from another
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

    @property
    def changes(self) -> int:
        return int((np.diff(self.values, axis=0) != 0).any(axis=1).sum())


def choose_command(recording: Recording, fitting: Sequence[Fit]) -> tuple[list[Fit], CommandChoice]:
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
    chosen = [first.fit, *(fit for fit in fitting if fit is not first.fit)]
    sources: dict[str, _Told] = {}
    inputs = [one for one in reported if one is not first and _feeds(one, first, MIN_SHARE)]
    for one in sorted(inputs, key=lambda one: -one.passed_on(first)):
        sources.setdefault(_policy(one.fit[0].name), one)
    lines = [line for name, one in sources.items() for line in _lines(name, one, first)]
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
