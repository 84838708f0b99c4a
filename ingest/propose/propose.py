"""Propose a first profile for an unknown robot, from one of its recordings.

What each topic is for is guessed from its type and name; the clock, the speeds of the actions,
maximum ages, the lidar's range, the outline and the frames come from the messages. The proposal is
then tried on the recording, so that it can say what its choices cost.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from restock.errors import ConfigError, RecordingError
from restock.ingest.containers.recording import Recording
from restock.ingest.profile.profile import parse_profile
from restock.ingest.propose.clock_choice import by_log_time
from restock.ingest.propose.gather import Evidence, Given, GoalChoice, gather, without_first
from restock.ingest.propose.proposal_lines import advice_of, profile_lines
from restock.ingest.propose.roles import REQUIRED, several_commands
from restock.ingest.propose.trial import GAIN, UNEVEN, Advice, Trial, try_profile
from restock.ingest.steps.align import BY_LOG_TIME
from restock.ingest.steps.clocks import STAMP
from restock.ingest.steps.consistency import Finding
from restock.ingest.steps.needs import as_recorded, read_topics

# What a recording lacks -> what to do about it.
REMEDIES = {
    "command": "record the topic of the command that drives the robot (geometry_msgs/msg/Twist)",
    "pose": "no topic contains the robot's pose; record localisation, odometry, or the transforms "
    "of /tf and /tf_static",
}
INSTEAD_OF_COMMANDS = (
    "; or, if the measured motion may be used as the command, `profile new --odometry-as-command`"
)


@dataclass(frozen=True)
class Proposal:
    """The TOML of a profile, what in it needs a person, and what it makes of the recording."""

    toml: str
    base: Path  # the recording that it was proposed from, and tried on
    missing: list[str] = field(default_factory=list)  # required inputs that nothing fills
    signals: int = 0  # custom signals that stand in it, commented out
    ticks: int = 0
    transitions: int = 0
    problems: list[str] = field(default_factory=list)  # why it cannot be used as it is
    advice: list[Advice] = field(default_factory=list)  # what choices cost, and what to try
    commands: list[str] = field(default_factory=list)  # topics, if several may drive the robot
    # Of each kind, if there are several: its `robot` in words and `recordings`; its own first.
    kinds: list[dict[str, Any]] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)  # contradictions in the recording


def propose_profile(recording: Recording, name: str, given: Given | None = None) -> Proposal:
    """Propose a profile of this name for recordings like this one, tried on it.

    Raises:
        ConfigError: the URDF cannot be used; says why.
    """
    return propose_from(gather(recording, given or Given()), name)


def propose_from(seen: Evidence, name: str, *, goal_decided: bool = False) -> Proposal:
    """Propose a profile from gathered evidence, tried on the recording that it is from.

    With `goal_decided` its goal is not left out where this recording alone has few in hindsight.
    """
    recording = seen.recording
    located = bool(seen.roles["pose"]) or seen.poses_from_frames
    missing = [role for role in REQUIRED if not (located if role == "pose" else seen.roles[role])]
    problems = [
        f"no topic for {role}, which every profile needs: {REMEDIES[role]}"
        + (INSTEAD_OF_COMMANDS if role == "command" and seen.roles["wheels"] else "")
        for role in missing
    ]
    if seen.motion is not None and seen.motion.problem:
        problems.append(seen.motion.problem)
    trial = Trial()
    if not problems:
        trial = trial_of(seen)
        if trial.problem and BY_LOG_TIME in trial.problem and seen.clock.alignment == STAMP:
            seen = replace(seen, clock=by_log_time(seen.gaps, trial.problem))
            trial = trial_of(seen)
        seen, trial = _by_rate(*_without_contradicted(seen, trial))
        goal = seen.goal.tried(trial.transitions, trial.dropped)
        if goal != seen.goal and not goal_decided:
            seen = replace(seen, goal=goal)
            trial = trial_of(seen)
        if trial.problem:
            problems.append(trial.problem)
    advice = [*advice_of(seen), *trial.advice]
    return Proposal(
        "\n".join(profile_lines(seen, name, problems, trial, advice)),
        recording.path,
        missing=missing,
        signals=len(seen.signals),
        ticks=trial.ticks,
        transitions=trial.transitions,
        problems=problems,
        advice=advice,
        commands=several_commands(recording),
        findings=trial.findings,
    )


def _without_contradicted(seen: Evidence, trial: Trial) -> tuple[Evidence, Trial]:
    """Leave out odometry and gyros whose speeds are not those of the poses."""
    roles = {"wheels": "wheels", "gyro": "imu"}
    while off := [one for one in trial.findings if one.kind in roles]:
        why = f"{off[0].topic} is not used, as {off[0].what}"
        other = without_first(seen, roles[off[0].kind], why)
        if other is None:
            break
        seen, trial = other, trial_of(other)
    return seen, trial


def _by_rate(seen: Evidence, trial: Trial) -> tuple[Evidence, Trial]:
    """Use a tick every period instead of one per command, if that pays.

    It does if it makes rows of much more time, or if commands come too unevenly for the twin to
    follow.
    """
    clock = seen.clock
    if clock.steps != "command":
        return seen, trial
    goalless = replace(seen, goal=GoalChoice(None))  # pauses may cost the goals of a drive, too
    now, other = trial_of(goalless), trial_of(replace(goalless, clock=clock.at_a_rate()))
    longer = other.seconds > GAIN * now.seconds
    evener = other.even_s > UNEVEN * now.even_s and GAIN * other.seconds > now.seconds
    if other.problem or not (longer or evener):
        return seen, trial
    why = (
        f"one tick per command gives {now.seconds:.0f} s of rows ({now.even_s:.0f} s that the twin"
        f" can follow), one per period {other.seconds:.0f} s ({other.even_s:.0f} s)."
    )
    rate = replace(clock.at_a_rate(), comments=(*clock.comments, why))
    seen = replace(seen, clock=rate)
    return seen, trial_of(seen)


def trial_of(seen: Evidence, recording: Recording | None = None) -> Trial:
    """Try what `seen` proposes on a recording, else on its own."""
    return tried(recording or seen.recording, "\n".join(profile_lines(seen, "robot")))


def tried(recording: Recording, toml: str) -> Trial:
    """Try the profile of this TOML on the recording."""
    try:
        profile = as_recorded(parse_profile(toml, where="the proposal"), recording.topics)
        return try_profile(profile, read_topics(recording, profile))
    except (ConfigError, RecordingError) as error:
        return Trial(problem=error.what)
