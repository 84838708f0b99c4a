"""Tries a profile on a recording: what it gives, and what to try instead."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import msgspec
import numpy as np

from restock.arrays import Ints
from restock.errors import RecordingError
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.align import NS
from restock.ingest.steps.aligned_inputs import align_inputs
from restock.ingest.steps.consistency import Finding
from restock.ingest.steps.episodes import Split, Steps, explain_no_transitions, split, steps_of
from restock.ingest.task.conditions import in_steps
from restock.ingest.task.task import Task

MUCH = 0.1  # a choice that costs at least this share of the ticks is reported
GAIN = 1.1  # a choice that multiplies the transitions by more than this is suggested
OFTEN_NEAR = 0.4  # if things are near in a larger share of ticks, the outline is probably wrong
OFTEN_INSIDE = 0.02
MOVING, MIN_MOVING = 0.2, 30  # share of top speed above which a robot moves; ticks needed with it
SLIP_OVER = "{0.2 m}"  # window of driving over which slip is measured, as in wheel_slip
NOISE_IN_LIMIT = 1.25  # the limit of slip is this multiple of twice the noise
EVEN_S = 3.0  # length of a segment, as in the comparison of twin and log
EVEN = 0.25  # largest deviation of an even tick, as a share of a control period
UNEVEN = 4.0  # ticks per period are better if the twin can follow them this many times longer


@dataclass(frozen=True)
class Advice:
    """The cost of a choice, and what to try."""

    key: str  # a key of the profile, such as `inputs.command.max_age_s`
    text: str

    def __str__(self) -> str:
        return f"`{self.key}`: {self.text}"


@dataclass(frozen=True)
class Trial:
    """The outcome of a profile on a recording."""

    ticks: int = 0
    transitions: int = 0
    seconds: float = 0.0  # time that the transitions span
    even_s: float = 0.0  # part of `seconds` that a simulator can follow tick by tick
    dropped: dict[str, int] = field(default_factory=dict)  # reason -> ticks in no episode
    advice: list[Advice] = field(default_factory=list)
    problem: str = ""  # why there are no transitions
    findings: list[Finding] = field(default_factory=list)  # contradictions in the recording
    pose_noise_m: float | None = None  # noise of poses relative to wheels, over a control period
    inside_outline: float | None = None  # share of usable ticks with a return inside the robot


def try_profile(profile: Profile, topics: Mapping[str, TopicColumns]) -> Trial:
    """Try a profile on a recording; `topics` are the columns that `read_topics` returns for it."""
    try:
        steps = steps_of(profile, topics)
    except RecordingError as error:
        return Trial(problem=f"{error.what}; {error.remedy}" if error.remedy else error.what)
    episodes = split(profile.task, steps)
    why, remedy = explain_no_transitions(steps, episodes)
    why = f"{why}; {remedy}" if remedy else why
    if not len(steps):
        return Trial(problem=why)
    inside, advice = _outline(profile, topics, steps)
    advice = [*_ages(profile, topics, steps, episodes), *advice]
    problem = "" if episodes.transitions else f"no transition: {why}"
    stamps = steps.signals["stamp_ns"]
    stretches = [stamps[one.first : one.last + 1] for one in episodes.episodes]
    return Trial(
        ticks=len(steps),
        transitions=episodes.transitions,
        seconds=sum(int(one[-1] - one[0]) for one in stretches) / NS,
        even_s=sum(_even_s(one, profile.task.control_period_s) for one in stretches),
        dropped=dict(sorted(episodes.dropped.items(), key=lambda item: -item[1])),
        advice=advice,
        problem=problem,
        findings=steps.findings,
        pose_noise_m=(
            _pose_noise_m(steps, profile.task) if all(f.repaired for f in steps.findings) else None
        ),
        inside_outline=None if problem else inside,
    )


def _pose_noise_m(steps: Steps, task: Task) -> float | None:
    """Return the noise of poses over a control period; None if the robot hardly moved.

    Limits of slip are computed from this noise. They should be well above the difference between
    poses and wheels over a window of SLIP_OVER, at 90 % of the ticks at which either moved.
    """
    limits = task.condition_limits
    window = int(in_steps(SLIP_OVER, limits)) + 1
    wheels_mps, poses_mps = (steps.signals[f"{name}_speed_mps"] for name in ("wheel", "localised"))
    driven_mps = np.concatenate([wheels_mps[:1], (wheels_mps[1:] + wheels_mps[:-1]) / 2])
    moved = np.maximum(np.abs(driven_mps), np.abs(poses_mps)) > MOVING * limits["fastest_mps"]
    off_m = np.where(steps.follows, driven_mps - poses_mps, 0.0) * task.control_period_s
    summed_m, breaks = np.cumsum(off_m), np.cumsum(~steps.follows)
    ends = np.arange(window, len(steps))  # last ticks of windows
    ends = ends[(breaks[ends] == breaks[ends - window]) & moved[ends]]
    if len(ends) < MIN_MOVING:
        return None
    apart_m = np.abs(summed_m[ends] - summed_m[ends - window])
    return float(np.percentile(apart_m, 90)) / (2 * NOISE_IN_LIMIT)


def _even_s(stamp_ns: Ints, period_s: float) -> float:
    """Return how much time (s) of an episode's ticks (N,) is in even segments of about 3 s.

    In an even segment, each tick is within a quarter of a period of its due time. The twin is
    calibrated and compared on such segments.
    """
    ticks, even_s, at = max(round(EVEN_S / period_s), 1), 0.0, 0
    off_s = (stamp_ns - stamp_ns[0]) / NS - np.arange(len(stamp_ns)) * period_s
    while at + ticks < len(off_s):
        late = np.abs(off_s[at : at + ticks + 1] - off_s[at]) > EVEN * period_s
        even_s += 0.0 if late.any() else ticks * period_s
        at += int(late.argmax()) if late.any() else ticks
    return even_s


def _ages(
    profile: Profile, topics: Mapping[str, TopicColumns], steps: Steps, episodes: Split
) -> Iterator[Advice]:
    """Yield advice on inputs that are often stale: how old they get, and the result if latched."""
    for name, source in profile.inputs.items():
        count = episodes.dropped.get(f"{name}: stale", 0)
        if source.max_age_s is None or count < MUCH * len(steps):
            continue
        latest = align_inputs(profile, topics).latest(name)
        oldest_s = float(latest.age_ns[latest.known].max(initial=0)) * 1e-9
        held = msgspec.structs.replace(source, max_age_s=None)
        inputs = msgspec.structs.replace(profile.inputs, **{name: held})
        other = split(
            profile.task, steps_of(msgspec.structs.replace(profile, inputs=inputs), topics)
        )
        text = (
            f"{source.max_age_s:g} s drops {count:,} of {len(steps):,} ticks: {source.topic} is up"
            f" to {oldest_s:.1f} s old; {episodes.transitions:,} transitions"
        )
        if other.transitions > GAIN * episodes.transitions:
            text += f", without it (latched) {other.transitions:,}"
            if name == "command":
                text += " (correct only if the robot continues with its last command)"
        yield Advice(f"inputs.{name}.max_age_s", text)


def _outline(
    profile: Profile, topics: Mapping[str, TopicColumns], steps: Steps
) -> tuple[float | None, list[Advice]]:
    """Return the share of usable ticks at which the lidar sees something inside the outline.

    Also return advice on such returns, and on returns that are very near the outline.
    """
    scan, body = profile.inputs.scan, profile.task.body
    usable = np.array([problem == "" for problem in steps.problem], np.bool_)
    if scan is None or scan.topic not in topics or not usable.any():
        return None, []
    clearance = steps.signals["clearance_m"][usable]
    near_m = profile.task.rewards.tight_clearance_m  # also the limit of near_collision and recovery
    inside, near = float((clearance <= 0).mean()), float((clearance < near_m).mean())
    if inside <= OFTEN_INSIDE and near <= OFTEN_NEAR:
        return inside, []
    text = (
        f"with an outline of {body.length_m:g} x {body.width_m:g} m, the lidar sees something"
        f" nearer than {near_m:g} m at {near:.0%} of the ticks, and inside the robot at"
        f" {inside:.0%}: these are labelled near_collision and recovery. Measure the robot"
    )
    return inside, [Advice("task.body", text)]
