"""One profile for several drives of one kind of robot.

Drives show different things: one its description, another the fastest command, a third the longest
gap through which the robot drove on. What is the robot's is put together from all of them, and of
the clocks that the drives propose the one is taken that makes rows of most of their time, all
together. Drives of another kind of robot are left out, and named.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from restock.errors import RecordingError
from restock.ingest.containers.recording import Recording
from restock.ingest.propose.driven.command_hold import CommandHold, limit_of
from restock.ingest.propose.driven.steering import DriveEvidence
from restock.ingest.propose.evidence.clock_choice import drivable
from restock.ingest.propose.evidence.commands import Commands, commanded, settled_at_most
from restock.ingest.propose.evidence.footprint import Footprint
from restock.ingest.propose.evidence.gather import Evidence, gather
from restock.ingest.propose.evidence.goal_choice import GoalChoice
from restock.ingest.propose.kinds import RobotTraits, robot_kinds, robot_traits
from restock.ingest.propose.proposal_lines import profile_lines
from restock.ingest.propose.propose import (
    Proposal,
    RobotKind,
    propose_from,
    propose_profile,
    tried,
)
from restock.ingest.propose.trial import Advice, Trial

MOST_DRIVES = 12  # that are read
MOST_BASES = 4  # that are tried on all drives
# Poses on a map are worth so many times the time that odometry serves: where some drives have no
# map, most of the time would be lost for want of it.
LOCALISED_WORTH = 1.25
SAME_PACE = 1.5  # times the period: commands that are no further apart than this are of one pace


def propose_for_drives(
    recordings: Sequence[Recording],
    name: str,
    *,
    footprint: Footprint | None = None,
    urdf: Path | None = None,
    odometry_as_command: bool = False,
    hindsight_goals: bool = False,
) -> Proposal:
    """One profile for all of these recordings, as `propose_profile` makes it for one.

    Args:
        recordings: drives of one kind of robot; of several kinds those of the first are taken that
            has most drives with a command.
        name: of the profile.
        footprint, urdf, odometry_as_command, hindsight_goals: as of `propose_profile`.

    Raises:
        ConfigError: the URDF cannot be used; says why.
        RecordingError: there is no recording.
    """
    if not recordings:
        raise RecordingError("no recording given", remedy="give at least one")
    if len(recordings) == 1:
        return propose_profile(
            *(recordings[0], name),
            footprint=footprint,
            urdf=urdf,
            odometry_as_command=odometry_as_command,
            hindsight_goals=hindsight_goals,
        )
    traits = [robot_traits(recording) for recording in recordings]
    kinds = robot_kinds(traits)
    kind = max(kinds, key=lambda members: sum(bool(traits[one].command) for one in members))
    drives = [
        gather(
            *(recordings[one], footprint, urdf),
            odometry_as_command=odometry_as_command,
            hindsight_goals=hindsight_goals,
        )
        for one in kind
    ]
    seen = max(
        (pooled(base, drives) for base in _bases(drives)),
        key=lambda one: (
            sum(t.seconds for t in _trials(replace(one, goal=GoalChoice(None)), drives))
            * (LOCALISED_WORTH if _on_map(one) else 1.0)
        ),
    )
    usual = _trials(seen, drives)
    dropped: Counter[str] = sum((Counter(trial.dropped) for trial in usual), Counter())
    goal = seen.goal.tried(sum(trial.transitions for trial in usual), dropped)
    proposal = propose_from(replace(seen, goal=goal), name, goal_decided=True)
    trials = [tried(one.recording, proposal.toml) for one in drives]
    others = [(recordings[m], traits[m]) for members in kinds if members != kind for m in members]
    advice = [*proposal.advice, *_left_out(others)]
    return replace(
        proposal,
        problems=[*proposal.problems, *_in_another(proposal.missing, drives)],
        toml="\n".join([*_lines(drives, trials, others), proposal.toml]),
        advice=advice,
        kinds=[
            RobotKind(str(traits[of[0]]), [str(recordings[one].path) for one in of])
            for of in sorted(kinds, key=lambda members: members != kind)
            if len(kinds) > 1
        ],
        ticks=sum(trial.ticks for trial in trials),
        transitions=sum(trial.transitions for trial in trials),
    )


def _trials(seen: Evidence, drives: Sequence[Evidence]) -> list[Trial]:
    toml = "\n".join(profile_lines(seen, "robot", []))
    return [tried(one.recording, toml) for one in drives]


def drives_to_read(paths: Sequence[Path]) -> tuple[list[Path], int]:
    """The largest recordings, which a proposal reads; and how many it does not."""
    sizes = {path: _bytes(path) for path in paths}
    largest = sorted(paths, key=lambda path: -sizes[path])[:MOST_DRIVES]
    return [path for path in paths if path in largest], len(paths) - len(largest)


def _bytes(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def pooled(base: Evidence, drives: Sequence[Evidence]) -> Evidence:
    """What one drive says, with what is the robot's from all of them."""
    driven = [one for one in drives if one.commands.topic == base.commands.topic]
    described = max(drives, key=lambda one: len(one.robot.values))
    clocks = [one.clock for one in driven]
    # A measured outline before a guess, of guesses the smallest: it had the nearest return.
    outlined = min(
        (base, *drives), key=lambda one: (not one.footprint.measured, one.footprint.length_m)
    )
    turned = DriveEvidence.joined([one.turned for one in drives])
    described = base if len(base.robot.values) >= len(described.robot.values) else described
    return replace(
        base,
        commands=_commands(base.commands, driven),
        turned=turned,
        hold=_hold([one.hold for one in driven]),
        clock=replace(
            base.clock,
            command_age_s=max([base.clock.command_age_s, *(c.command_age_s for c in clocks)]),
            max_gap_s=max([base.clock.max_gap_s, *(c.max_gap_s for c in clocks)]),
        ),
        paces_s={
            topic: max(one.paces_s[topic] for one in drives if topic in one.paces_s)
            for topic in base.paces_s
        },
        footprint=outlined.footprint,
        footprint_notes=outlined.footprint_notes,
        outline=outlined.outline,
        robot=described.robot
        if base.commands.steered
        else described.robot.driven(turned, outlined.footprint.length_m),
    )


def _commands(base: Commands, drives: Sequence[Evidence]) -> Commands:
    """The fastest of the commands of all drives."""
    driven = [one for one in drives if one.commands.count]
    if not driven:
        return base
    told = [
        commanded(one.recording, one.roles["command"][0], one.robot.values.get("wheelbase_m"))
        for one in driven
    ]
    speed, turn = (np.concatenate([each[part] for each in told]) for part in (2, 3))
    count = sum(one.commands.count for one in driven)
    pooled = replace(base.fastest(speed, turn), count=count)
    settled = [
        settled_at_most(one.recording, one.roles, pooled, *each[1:])
        for one, each in zip(driven, told, strict=True)
    ]
    ahead, about = (np.concatenate([each[part] for each in settled]) for part in (0, 1))
    return pooled.limited(limit_of(ahead, pooled.speed_mps), limit_of(about, pooled.yaw_rate_radps))


def _hold(drives: Sequence[CommandHold]) -> CommandHold:
    """The longest that any drive shows; a command to stop holds where all say so."""
    told = [one for one in drives if one.comments]
    if not told:
        return CommandHold()
    best = max(told, key=lambda one: one.age_s or 0.0)
    return replace(best, stops_hold=all(one.stops_hold for one in told))


def _bases(drives: Sequence[Evidence]) -> list[Evidence]:
    """A drive of each clock and source of poses that is proposed, the fullest first.

    Where one drive was told what to do far more often than another, a tick a command would be
    another time in each: then there is a tick every period, the middle one of the drives.
    """
    fullest = sorted(drives, key=_fullness, reverse=True)
    usable = [one for one in fullest if _fullness(one)[0] == _fullness(fullest[0])[0]]
    periods = [one.clock.period_s for one in usable]
    if max(periods) > SAME_PACE * min(periods):
        middle = drivable(float(np.median(periods)))
        rate = f"a tick every period: the drives' commands are {min(periods):g} to"
        comments = (f"{rate} {max(periods):g} s apart.",)
        usable = [
            replace(
                one,
                clock=replace(
                    replace(one.clock, period_s=middle).at_a_rate(),
                    comments=(*one.clock.comments, *comments),
                ),
            )
            for one in usable
        ]
    bases: dict[tuple[str, str, bool], Evidence] = {}
    for one in usable:
        bases.setdefault((one.clock.alignment, one.clock.steps, one.poses_from_frames), one)
    return list(bases.values())[:MOST_BASES]


def _on_map(one: Evidence) -> bool:
    return one.poses_from_frames and one.frames is not None and one.frames.localised


def _fullness(one: Evidence) -> tuple[int, int, float]:
    """How many of the inputs that decide it has, how many of all, and for how long it drove."""
    located = bool(one.roles["pose"]) or one.poses_from_frames
    deciding = sum((bool(one.roles["command"]), located, bool(one.roles["wheels"])))
    return deciding, sum(map(bool, one.roles.values())), one.driven_s


def _lines(
    drives: Sequence[Evidence],
    trials: Sequence[Trial],
    others: Sequence[tuple[Recording, RobotTraits]],
) -> list[str]:
    """What comes of each drive, as comments."""
    rows = sum(trial.transitions for trial in trials)
    lines = [
        f"# For {len(drives)} drives of one kind of robot, by what they say: {rows:,} transitions."
    ]
    for drive, trial in zip(drives, trials, strict=True):
        why = f"  ({trial.problem})" if trial.problem else ""
        lines.append(f"#   {_name(drive.recording)}: {trial.transitions:,}{why}")
    lines += [f"# NOT OF THAT KIND: {_name(one)}: {told}" for one, told in others]
    return lines


def _name(recording: Recording) -> str:
    """Two parts of its path: bags of several robots often have the same names."""
    return "/".join(recording.path.parts[-2:])


def _in_another(missing: Sequence[str], drives: Sequence[Evidence]) -> list[str]:
    """Of what the profile's own drive lacks, which other one has it, without the rest."""
    found = []
    for role, lacks in (("pose", "command"), ("command", "pose")):
        for one in drives if role in missing else ():
            if (topics := one.roles[role]) and not one.roles[lacks]:
                found.append(
                    f"{_name(one.recording)} has a {role} ({topics[0][0].name}) and no {lacks}:"
                    " one recording must hold both"
                )
    return found


def _left_out(others: Sequence[tuple[Recording, RobotTraits]]) -> list[Advice]:
    if not others:
        return []
    names = ", ".join(_name(recording) for recording, _ in others[:5])
    more = f" and {len(others) - 5} more" if len(others) > 5 else ""
    text = f"{len(others)} recordings are of another kind of robot, by what they say: {names}{more}"
    return [Advice("name", f"{text}; propose another profile for them")]


__all__ = ["drives_to_read", "pooled", "propose_for_drives"]
