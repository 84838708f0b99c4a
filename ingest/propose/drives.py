"""Proposes a first profile for an unknown robot, from one of its recordings or from several drives.

What each topic is for is guessed from its type and name; the clock, the speeds of the actions,
maximum ages, the lidar's range, the outline and the frames come from the messages. The proposal is
then tried on the recording, to report what its choices cost.

Drives show different things: one its description, another the fastest command, a third the longest
gap through which the robot drove on. The robot's properties are combined from all drives. Of the
clocks that the drives propose, the one that turns most of their total time into rows is used.
Drives of another kind of robot are left out, and named. The kind of every recording is read from a
few of its topics; if there are many drives of one kind, the proposal reads the largest. Kinds are
judged by the contents of recordings, never by their file or folder. Two recordings that both have a
lidar, a description or odometry are of one kind only if these agree. A lidar or a description is
needed to distinguish robots: recordings with neither are of one kind if they have the same command,
pose and odometry, and at least half of their topics in common. A recording that fits two different
kinds belongs to neither.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from restock.errors import ConfigError, RecordingError, counted
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import TopicInfo
from restock.ingest.decoding.columns import Ragged
from restock.ingest.profile.profile import parse_profile
from restock.ingest.profile.signal_paths import FRAME_IDS, frame_id_path, plain
from restock.ingest.profile.tables import is_motion
from restock.ingest.propose.clock_choice import ClockChoice, by_log_time, drivable
from restock.ingest.propose.commands import CommandHold, Commands
from restock.ingest.propose.footprint import RobotText, descriptions
from restock.ingest.propose.gather import Evidence, Given, GoalChoice, gather, without_first
from restock.ingest.propose.pose_choice import on_map
from restock.ingest.propose.proposal_lines import advice_of, profile_lines
from restock.ingest.propose.roles import KINDS, REQUIRED, Kind, several_commands, topics_for
from restock.ingest.propose.trial import GAIN, UNEVEN, Advice, Trial, try_profile
from restock.ingest.steps.align import BY_LOG_TIME
from restock.ingest.steps.clocks import STAMP
from restock.ingest.steps.consistency import Finding
from restock.ingest.steps.needs import as_recorded, read_topics

# missing input -> what to do about it
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
    """The TOML of a proposed profile, what a person must check, and its result on the recording."""

    toml: str
    base: Path  # the recording that the profile was proposed from, and tried on
    missing: list[str] = field(default_factory=list)  # required inputs that no topic fills
    signals: int = 0  # number of custom signals in the TOML, all commented out
    ticks: int = 0
    transitions: int = 0
    problems: list[str] = field(default_factory=list)  # why the profile cannot be used yet
    advice: list[Advice] = field(default_factory=list)  # what choices cost, and what to try
    commands: list[str] = field(default_factory=list)  # topics, if several may drive the robot
    # One dict per kind of robot, if there are several: `robot` in words and `recordings`. The
    # profile's own kind is first.
    kinds: list[dict[str, Any]] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)  # contradictions in the recording


def propose_profile(recording: Recording, name: str, given: Given | None = None) -> Proposal:
    """Propose a profile of this name for recordings like this one, and try it on this one.

    Raises:
        ConfigError: the URDF cannot be used.
    """
    return propose_from(gather(recording, given or Given()), name)


def propose_from(seen: Evidence, name: str, *, goal_decided: bool = False) -> Proposal:
    """Propose a profile from gathered evidence, and try it on the evidence's recording.

    With `goal_decided`, the evidence's goal is kept even if hindsight finds few in this recording.
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
        trial = try_evidence(seen)
        if trial.problem and BY_LOG_TIME in trial.problem and seen.clock.alignment == STAMP:
            seen = replace(seen, clock=by_log_time(seen.gaps, trial.problem))
            trial = try_evidence(seen)
        seen, trial = _by_rate(*_without_contradicted(seen, trial))
        goal = seen.goal.after_trial(trial.transitions, trial.dropped)
        if goal != seen.goal and not goal_decided:
            seen = replace(seen, goal=goal)
            trial = try_evidence(seen)
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
    """Drop odometry and gyros whose speeds contradict the poses."""
    roles = {"wheels": "wheels", "gyro": "imu"}
    while off := [one for one in trial.findings if one.kind in roles]:
        why = f"{off[0].topic} is not used, as {off[0].what}"
        other = without_first(seen, roles[off[0].kind], why)
        if other is None:
            break
        seen, trial = other, try_evidence(other)
    return seen, trial


def _by_rate(seen: Evidence, trial: Trial) -> tuple[Evidence, Trial]:
    """Use one tick per period instead of one per command, if that is better.

    It is better if it turns much more time into rows, or if commands come too unevenly for the
    twin to follow.
    """
    clock = seen.clock
    if clock.steps != "command":
        return seen, trial
    goalless = replace(seen, goal=GoalChoice(None))  # pauses may also remove goals in hindsight
    now, other = try_evidence(goalless), try_evidence(replace(goalless, clock=clock.at_a_rate()))
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
    return seen, try_evidence(seen)


def try_evidence(seen: Evidence, recording: Recording | None = None) -> Trial:
    """Try the profile proposed from `seen` on a recording; default: the evidence's recording."""
    return try_toml(recording or seen.recording, "\n".join(profile_lines(seen, "robot")))


def try_toml(recording: Recording, toml: str) -> Trial:
    """Try the profile of this TOML on the recording."""
    try:
        profile = as_recorded(parse_profile(toml, where="the proposal"), recording.topics)
        return try_profile(profile, read_topics(recording, profile))
    except (ConfigError, RecordingError) as error:
        return Trial(problem=error.what)


MAX_DRIVES = 12  # largest number of drives that a proposal reads
MAX_NAMED = 5  # largest number of recordings that a list names
MAX_BASES = 4  # largest number of drives whose evidence is tried on all drives
# A second with poses on a map counts as this many seconds with odometry. If it counted more, drives
# without a map would be lost.
LOCALISED_WORTH = 1.25
SAME_PACE = 1.5  # control periods count as the same up to this ratio


@dataclass(frozen=True)
class Drives:
    """Recordings grouped by kind of robot, and which of them a proposal reads."""

    paths: Sequence[Path]
    traits: Sequence[RobotTraits]  # one per path
    kinds: Sequence[Sequence[int]]  # indices of `paths`; the proposal is for the first kind
    read: Sequence[int]  # indices of the recordings, of the first kind, that the proposal reads

    @property
    def unread(self) -> list[Path]:
        """Return the recordings of the first kind that the proposal does not read."""
        return [self.paths[one] for one in self.kinds[0] if one not in self.read]

    @property
    def others(self) -> list[tuple[Path, RobotTraits]]:
        """Return the recordings of other kinds, with the traits of their robots."""
        return [
            (self.paths[one], self.traits[one]) for kind in self.kinds[1:] for one in sorted(kind)
        ]

    @property
    def robots(self) -> list[dict[str, Any]]:
        """Return every kind with all its recordings, if there are several."""
        return [
            {"robot": str(self.traits[kind[0]]), "recordings": [str(self.paths[n]) for n in kind]}
            for kind in self.kinds
            if len(self.kinds) > 1
        ]


def drives_by_kind(
    paths: Sequence[Path], traits: Sequence[RobotTraits], *, most: int = MAX_DRIVES
) -> Drives:
    """Group recordings by kind, and choose what to read of the kind with most drives.

    At most `most` drives are read: those with a command first, then the largest.
    """
    kinds = robot_kinds(traits)
    own = max(kinds, key=lambda members: sum(bool(traits[one].command) for one in members))
    fullest = sorted(own, key=lambda one: (not traits[one].command, -_bytes(paths[one])))
    ordered = sorted(kinds, key=lambda members: members != own)
    return Drives(paths, traits, ordered, sorted(fullest[:most]))


def propose_for_drives(
    recordings: Sequence[Recording], drives: Drives, name: str, given: Given | None = None
) -> Proposal:
    """Propose one profile for all drives of a kind, as `propose_profile` does for one.

    Args:
        recordings: those in `drives.read`, in that order.
        drives: all recordings, grouped by kind.
        name: the profile's name.
        given: what a person states about the robot.
    Raises:
        ConfigError: the URDF cannot be used.
    """
    given = given or Given()
    if len(drives.paths) == 1:
        return propose_profile(recordings[0], name, given)
    evidence = [gather(recording, given) for recording in recordings]
    seen = _choose_evidence(evidence, evidence)
    usual = _trials(seen, evidence)
    giving = [one for one, trial in zip(evidence, usual, strict=True) if trial.transitions]
    if giving and not any(one.recording is seen.recording for one in giving):
        seen = _choose_evidence(giving, evidence)  # the fullest drive may have stood still
        usual = _trials(seen, evidence)
    dropped: Counter[str] = sum((Counter(trial.dropped) for trial in usual), Counter())
    goal = seen.goal.after_trial(sum(trial.transitions for trial in usual), dropped)
    proposal = propose_from(replace(seen, goal=goal), name, goal_decided=True)
    trials = [try_toml(one.recording, proposal.toml) for one in evidence]
    advice = [*proposal.advice, *_advise_left_out(drives, evidence, trials)]
    transitions = sum(trial.transitions for trial in trials)
    lines = [
        f"# For {counted(len(drives.kinds[0]), 'drive')} of one kind of robot: {transitions:,}"
        " transitions.",
        *(
            f"#   {_name(drive.recording.path)}: {trial.transitions:,}"
            + (f"  ({trial.problem})" if trial.problem else "")
            for drive, trial in zip(evidence, trials, strict=True)
        ),
        *(f"# {one.text}" for one in advice[len(proposal.advice) :]),
    ]
    return replace(
        proposal,
        problems=[*proposal.problems, *_report_other_drives(proposal.missing, evidence)],
        toml="\n".join([*lines, proposal.toml]),
        advice=advice,
        kinds=drives.robots,
        ticks=sum(trial.ticks for trial in trials),
        transitions=transitions,
    )


def _choose_evidence(bases: Sequence[Evidence], drives: Sequence[Evidence]) -> Evidence:
    """Return the pooled evidence of the base that turns most time of all drives into rows."""
    return max(
        (pool_evidence(base, drives) for base in _bases(bases)),
        key=lambda one: (
            sum(t.seconds for t in _trials(replace(one, goal=GoalChoice(None)), drives))
            * (LOCALISED_WORTH if one.poses_from_frames and on_map(one.frames) else 1.0)
        ),
    )


def _trials(seen: Evidence, drives: Sequence[Evidence]) -> list[Trial]:
    return [try_evidence(seen, one.recording) for one in drives]


def _bytes(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def pool_evidence(base: Evidence, drives: Sequence[Evidence]) -> Evidence:
    """Return the evidence of one drive, with the robot's properties combined from all drives."""
    driven = [one for one in drives if one.commands.topic == base.commands.topic]
    described = max((base, *drives), key=lambda one: len(one.robot.values))
    if base.commands.steered and not described.robot.described:
        described = base  # whose guess of the wheelbase also converted its steering commands
    # Prefer a measured outline to a guess, then an outline with a placed lidar, then the shortest
    # one: guesses come from the nearest return, so all of them are upper bounds.
    outlined = min(
        (base, *drives),
        key=lambda one: (
            not one.footprint.measured,
            bool(one.footprint.lidar_unplaced or not one.roles["scan"]),
            one.footprint.length_m,
        ),
    )
    return replace(
        base,
        commands=_commands(base.commands, driven),
        hold=_hold([one.hold for one in driven]),
        clock=replace(
            base.clock,
            command_age_s=max(one.clock.command_age_s for one in (base, *driven)),
            max_gap_s=max(one.clock.max_gap_s for one in (base, *driven)),  # base's gap may be new
        ),
        paces_s={
            topic: max(one.paces_s[topic] for one in drives if topic in one.paces_s)
            for topic in base.paces_s
        },
        footprint=outlined.footprint,
        footprint_notes=outlined.footprint_notes,
        outline=outlined.outline,
        robot=described.robot,
    )


def _commands(base: Commands, drives: Sequence[Evidence]) -> Commands:
    """Return the fastest commands of all drives."""
    driven = [one.driven for one in drives if one.driven is not None]
    known = {name: getattr(base, name) for name in ("topic", "measured", "steered", "wheelbase_m")}
    return Commands.of(driven, **known) if driven else base


def _hold(drives: Sequence[CommandHold]) -> CommandHold:
    """Return the longest hold of drives with evidence; stops hold if all these drives show it."""
    reported = [one for one in drives if one.comments]
    if not reported:
        return CommandHold()
    best = max(reported, key=lambda one: one.age_s or 0.0)
    return replace(best, stops_hold=all(one.stops_hold for one in reported))


def _bases(drives: Sequence[Evidence]) -> list[Evidence]:
    """Return one drive per proposed clock and source of poses, the fullest first.

    If some drives have far more frequent commands than others, one tick per command would last
    differently long in each. Then ticks have a fixed period, the median of the drives' periods.
    """
    fullest = sorted(drives, key=_fullness, reverse=True)
    usable = [one for one in fullest if _fullness(one)[0] == _fullness(fullest[0])[0]]
    periods = [one.clock.period_s for one in usable]
    if max(periods) > SAME_PACE * min(periods):
        middle = drivable(float(np.median(periods)))
        span = f"{min(periods):g} to {max(periods):g} s"
        why = f"one tick per period, as the periods of the drives are {span}"
        usable = [replace(one, clock=_at_rate(one.clock, middle, why)) for one in usable]
    bases: dict[tuple[str, str, bool], Evidence] = {}
    for one in usable:
        bases.setdefault((one.clock.alignment, one.clock.steps, one.poses_from_frames), one)
    return list(bases.values())[:MAX_BASES]


def _at_rate(clock: ClockChoice, period_s: float, why: str) -> ClockChoice:
    return replace(replace(clock, period_s=period_s).at_a_rate(), comments=(*clock.comments, why))


def _fullness(one: Evidence) -> tuple[int, int, float]:
    """Return a drive's number of deciding inputs, number of all inputs, and duration (s)."""
    located = bool(one.roles["pose"]) or one.poses_from_frames
    deciding = sum((bool(one.roles["command"]), located, bool(one.roles["wheels"])))
    return deciding, sum(map(bool, one.roles.values())), one.recorded_s


def names_of(paths: Sequence[Path]) -> str:
    """Name the first of these recordings, and count the others."""
    more = f" and {len(paths) - MAX_NAMED:,} more" if len(paths) > MAX_NAMED else ""
    return ", ".join(map(_name, paths[:MAX_NAMED])) + more


def _name(path: Path) -> str:
    """Return two parts of a path, as bags of several robots often have the same names."""
    return "/".join(path.parts[-2:])


def _report_other_drives(missing: Sequence[str], drives: Sequence[Evidence]) -> list[str]:
    """Report which other drives have an input that the profile's own drive lacks."""
    return [
        f"{_name(one.recording.path)} has a {role} ({one.roles[role][0][0].name}) and no {lacks}:"
        " one recording must hold both"
        for role, lacks in (("pose", "command"), ("command", "pose"))
        for one in drives
        if role in missing and one.roles[role] and not one.roles[lacks]
    ]


def _advise_left_out(
    drives: Drives, evidence: Sequence[Evidence], trials: Sequence[Trial]
) -> Iterator[Advice]:
    """Yield advice on recordings that were not read, give no rows, or are of another kind."""
    if drives.unread:
        yield Advice("name", f"not read, of that kind: {names_of(drives.unread)}")
    idle = [
        one.recording.path for one, t in zip(evidence, trials, strict=True) if not t.transitions
    ]
    if idle and len(idle) < len(trials):  # if all are idle, `problems` has it
        yield Advice(
            "name",
            f"{len(idle):,} of {len(trials):,} recordings give no transition: {names_of(idle)}",
        )
    if drives.others:
        others = names_of([path for path, _ in drives.others])
        kinds = "; ".join(dict.fromkeys(str(traits) for _, traits in drives.others))
        yield Advice("name", f"not of that kind: {others}: {kinds}; propose another profile for it")


SCANS = 40  # number of scans that are read, from the start of a recording
BEAMS = 0.1  # scans of one lidar may differ in beams by this share, as its speed may vary
RANGE = 0.01
SIMULATED_NS = 10**8 * 10**9  # stamps before 1973 are simulated: simulators start at 0
SHARED = 0.5  # least share of topics that recordings of one kind must have in common


@dataclass(frozen=True)
class Lidar:
    """A lidar, as its scans describe it."""

    frame: str
    beams: int
    range_max_m: float  # 0: unknown
    simulated: bool  # whether the stamps are a simulator's

    def agrees(self, other: Lidar) -> bool:
        return (
            (self.frame, self.simulated) == (other.frame, other.simulated)
            and abs(self.beams - other.beams) <= BEAMS * max(self.beams, other.beams)
            and math.isclose(self.range_max_m, other.range_max_m, rel_tol=RANGE)
        )

    def __str__(self) -> str:
        clock = ", simulated clock" if self.simulated else ""
        reach = f", {self.range_max_m:g} m" if self.range_max_m else ""
        return f"lidar {self.frame}, {self.beams} beams{reach}{clock}"


@dataclass(frozen=True)
class RobotTraits:
    """The traits of a robot in one recording; None and "" if it does not show them."""

    command: str  # type of the topic that drives it
    frames: str  # frames of its odometry, such as "odom -> base_link"
    lidar: Lidar | None
    description: str  # a digest of the description
    named: str  # the robot's name in the description
    inputs: frozenset[tuple[str, str]]  # topics, with their types, that command and locate it
    topics: frozenset[tuple[str, str]]  # all topics, with their types

    def fits(self, other: RobotTraits) -> bool:
        """Return whether both are of one kind: nothing differs, and something specific agrees."""
        for name in ("command", "frames", "description"):
            mine, its = getattr(self, name), getattr(other, name)
            if mine and its and mine != its:
                return False
        if self.lidar and other.lidar and not self.lidar.agrees(other.lidar):
            return False
        if (self.lidar and other.lidar) or (self.description and other.description):
            return True
        if self.lidar or other.lidar or self.description or other.description:
            return False
        shared = len(self.topics & other.topics)
        return self.inputs == other.inputs and shared >= SHARED * len(self.topics | other.topics)

    def __str__(self) -> str:
        reported = [
            self.named and f"described as {self.named}",
            str(self.lidar or ""),
            self.frames,
            self.command.split("/")[-1],
        ]
        topics = ", ".join(sorted(name for name, _ in self.inputs))
        return "; ".join(filter(None, reported)) or topics or "nothing that describes a robot"


def robot_traits(recording: Recording) -> RobotTraits:
    """Read the traits of a recording's robot, from a few of its scans and poses."""
    roles = {role: topics_for(recording, KINDS[role]) for role in ("command", "pose", "wheels")}
    command = roles["command"][0][0].type if roles["command"] else ""
    odometry = next((t for fits in roles.values() for t, _ in fits if is_motion(t.type)), None)
    frames = ""
    if odometry is not None:
        leaves = recording.leaves(odometry.name)
        paths = [path for path in (*FRAME_IDS, "child_frame_id") if path in leaves]
        ends = recording.read({odometry.name: paths})[odometry.name].fields
        frames = " -> ".join(plain(str(np.asarray(ends[path], object)[0])) for path in paths)
    text = next(descriptions(recording), RobotText("", ""))
    described = text.description
    return RobotTraits(
        command,
        frames,
        _lidar(recording, topics_for(recording, KINDS["scan"])[:1]),
        hashlib.blake2b(text.text.encode(), digest_size=8).hexdigest() if text.text else "",
        "" if isinstance(described, str) else described.name,
        frozenset((t.name, t.type) for fits in roles.values() for t, _ in fits),
        frozenset((name, topic.type) for name, topic in recording.topics.items() if topic.expected),
    )


def robot_kinds(traits: Sequence[RobotTraits]) -> list[list[int]]:
    """Group the recordings by kind, as indices of `traits`; each is in exactly one kind.

    Kinds are in the order of their first recording.
    """
    rich_first = sorted(range(len(traits)), key=lambda one: (-_count_known(traits[one]), one))
    kinds: list[list[int]] = []
    for index in rich_first:
        fitting = [k for k in kinds if all(traits[index].fits(traits[other]) for other in k)]
        if len(fitting) == 1:
            fitting[0].append(index)
        else:
            kinds.append([index])
    return sorted(sorted(kind) for kind in kinds)


def _count_known(traits: RobotTraits) -> int:
    reported = (traits.description, traits.lidar, traits.frames, traits.command)
    return sum(bool(each) for each in reported)


def _lidar(recording: Recording, best: Sequence[tuple[TopicInfo, Kind]]) -> Lidar | None:
    if not best:
        return None
    name, path = best[0][0].name, best[0][1].fields["ranges_m"]
    leaves = recording.leaves(name)
    wanted = [one for one in (*FRAME_IDS, "range_max", STAMP) if one in leaves]
    columns = recording.read({name: [path, *wanted]})[name]
    if not len(columns):
        return None
    fields, some = columns.fields, slice(SCANS)
    ranges, frame = fields[path], frame_id_path(fields)
    assert isinstance(ranges, Ragged)
    stamps = np.asarray(fields[STAMP], np.int64)[some] if STAMP in fields else np.zeros(0)
    return Lidar(
        "" if frame is None else plain(str(np.asarray(fields[frame], object)[0])),
        int(np.median(ranges.lengths[some])),
        round(float(np.median(np.asarray(fields.get("range_max", [0]), np.float64)[some])), 3),
        bool(len(stamps)) and 0 < int(np.median(stamps)) < SIMULATED_NS,
    )
