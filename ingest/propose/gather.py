"""Gathers what a recording shows about its robot, for a proposal."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import TopicInfo
from restock.ingest.profile.description import BASE_FRAMES
from restock.ingest.profile.signal_paths import conventions_of, plain
from restock.ingest.profile.tables import HINDSIGHT, Frames, Input, is_motion
from restock.ingest.propose.candidates import Candidate, candidates
from restock.ingest.propose.clock_choice import ClockChoice, Gaps, choose_clock
from restock.ingest.propose.commands import (
    CommandChoice,
    CommandedDrive,
    CommandHold,
    CommandLog,
    Commands,
    choose_command,
    read_commands,
    turning_evidence,
)
from restock.ingest.propose.footprint import (
    GUESS,
    Footprint,
    ScannedOutline,
    descriptions,
    footprint_of,
    scanned_outline,
    scans_of,
    with_lidar,
)
from restock.ingest.propose.pose_choice import (
    MotionChoice,
    choose_motion,
    on_map,
    pose_series,
    transform_edges,
    transform_frames,
)
from restock.ingest.propose.robot_choice import RobotProposal, propose_robot, read_urdf
from restock.ingest.propose.roles import (
    KINDS,
    LATCHED,
    ODOMETRY_AS_COMMAND,
    REQUIRED,
    SPENT,
    Kind,
    Roles,
    own_bumpers,
    topics_for,
)
from restock.ingest.steps.clocks import STAMP
from restock.ingest.steps.frames import PoseSeries
from restock.ingest.steps.input_columns import estimate_reduction
from restock.ingest.task.hindsight import NO_MISSION, GoalSource

RADIUS_M = (0.1, 0.4)  # smallest and largest radius of a goal
MIN_ROWS = 100  # wanted goals are kept if at least this many rows have a goal in hindsight


@dataclass(frozen=True)
class GoalChoice:
    """The goal of a proposal; `source` None: the task has none."""

    source: GoalSource | None
    why: str = ""  # why the task has no goal
    hindsight_wanted: bool = False  # keep hindsight even if it finds no goal for most of the drive

    def after_trial(self, transitions: int, dropped: Mapping[str, int]) -> GoalChoice:
        """Return the choice after a trial.

        The goal is dropped if hindsight finds none for most of the drive or, if hindsight is
        wanted, for all but a few rows.
        """
        without = sum(count for why, count in dropped.items() if why.startswith(NO_MISSION))
        enough = self.hindsight_wanted and transitions >= MIN_ROWS
        if self.source != "hindsight" or without <= transitions or enough:
            return self
        why = f"in hindsight, {without:,} ticks have no goal and {transitions:,} have one"
        return GoalChoice(None, why)

    def task_lines(self, length_m: float) -> list[str]:
        """Write the goal's keys of [task], for a robot of this length."""
        if self.source is None:
            return [f'goal = "none"  # {self.why or "no goal and plan"}: progress is forward']
        lines = ['goal = "route"']
        if self.source == "hindsight":
            radius_m = min(max(length_m / 3, RADIUS_M[0]), RADIUS_M[1])
            lines.append(f"goal_radius_m = {round(radius_m, 2):g}  # a third of a robot's length")
        return lines

    def fallback(self, role: str) -> str:
        """Return what is used instead of the input `goal` or `plan`."""
        return HINDSIGHT[role] if self.source == "hindsight" else "progress without a goal"

    def table_lines(self) -> list[str]:
        """Write the [goal] table, if the profile needs one."""
        if self.source != "hindsight":
            return []
        why = "where a drive stopped, turned back or went far enough"
        return ["[goal]  # no goal and plan seen", f'source = "hindsight"  # {why}', ""]


# input -> the field that a topic must measure to fill the input
MEASURED = {"imu": "yaw_rate_radps", "wheels": "speed_mps", "pose": "x_m"}
MILLIMETRES_UP_TO_M = 1e4  # up to this distance, float32 resolves about 1 mm


@dataclass(frozen=True)
class Evidence:
    """What a recording shows about its robot, and the choices that follow."""

    recording: Recording
    roles: Roles
    frames: Frames | None  # the fixed frame and the base frame, if transforms connect them
    poses_from_frames: bool
    motion: MotionChoice | None  # how speeds follow from poses, if no topic has wheel speeds
    commands: Commands
    chosen: CommandChoice
    driven: CommandedDrive | None
    hold: CommandHold
    paces_s: dict[str, float]  # topic -> usual time between its messages, in log time
    clock: ClockChoice
    gaps: Gaps
    footprint: Footprint
    footprint_notes: list[str]
    outline: ScannedOutline | None  # None: too few scans
    goal: GoalChoice
    signals: list[Candidate]
    robot: RobotProposal
    unmeasured: dict[str, str]  # input -> why topics were not used for it, or ""
    origin_m: tuple[int, int] | None  # point subtracted from positions, if poses are far from 0

    @property
    def recorded_s(self) -> float:
        """Return how long the recording is."""
        span = self.recording.span_ns
        return (span[1] - span[0]) * 1e-9 if span else 0.0


@dataclass(frozen=True)
class Given:
    """What a person states about a robot, besides its recordings."""

    footprint: Footprint | None = None  # the robot's outline; None: read it from the recording
    urdf: Path | None = None  # a file that replaces the recording's description
    odometry_as_command: bool = False  # use the measured motion if commands are missing
    # Use goals in hindsight even if most of the drive has none; rows without a goal are left out.
    hindsight_goals: bool = False


def gather(recording: Recording, given: Given) -> Evidence:
    """Gather what a recording shows about its robot.

    Raises:
        ConfigError: the URDF cannot be used.
    """
    roles = {role: topics_for(recording, kinds) for role, kinds in KINDS.items()}
    if not roles["bumper"]:
        roles["bumper"] = own_bumpers(recording)
    unmeasured: dict[str, str] = {}
    for role, key in MEASURED.items():
        roles[role], unmeasured[role] = _measured(recording, roles[role], key)
    if not roles["command"] and given.odometry_as_command:
        roles["command"] = fits = topics_for(recording, ODOMETRY_AS_COMMAND)
        chosen = CommandChoice(CommandLog.read(recording, fits[0]) if fits else None)
    else:
        roles["command"], chosen = choose_command(recording, roles["command"])
    drives = {topic.name for topic, _ in roles["command"][:1]}
    roles["nav_command"] = [fit for fit in roles["nav_command"] if fit[0].name not in drives]
    if not (roles["goal"] and roles["plan"]):
        roles["goal"] = roles["plan"] = []
    edges = transform_edges(recording)
    frames = transform_frames(recording, edges)
    if frames is not None and all(kind.by_fix for _, kind in roles["pose"]):
        roles["pose"] = []  # use transforms: unlike satellite fixes, they give the heading
    # If the only poses are odometry, which drifts, transforms to a map frame are better.
    drifts = all(is_motion(topic.type) for topic, _ in roles["pose"])
    framed = frames is not None and (on_map(frames) or not roles["pose"]) and drifts
    poses, poses_from = None, ""
    if framed or roles["pose"]:
        poses, poses_from = pose_series(recording, roles, frames if framed else None, edges)
    scanned = scans_of(recording, roles["scan"])
    # Of several lidars, the scan in the base frame is usually the merged one.
    roles["scan"].sort(key=lambda fit: plain(scanned[fit[0].name].frame) not in BASE_FRAMES)
    scan = roles["scan"][0][0].name if roles["scan"] else None
    frame = scanned[scan].frame if scan is not None else ""
    texts = list(descriptions(recording))
    if given.urdf is not None:
        texts.insert(0, read_urdf(given.urdf))
    footprint, notes = given.footprint, list[str]()
    if footprint is None:
        footprint, notes = footprint_of(texts, frame)
    outline = scanned_outline(recording, roles["scan"][0], poses) if roles["scan"] else None
    if footprint is None:
        footprint = (outline.footprint(GUESS) if outline else None) or GUESS
    if footprint.lidar_x_m is None and scan is not None:
        footprint = with_lidar(footprint, edges, frame)
    if footprint.lidar_yaw_rad is None and plain(frame).split("/")[-1] not in BASE_FRAMES:
        footprint = replace(footprint, lidar_unplaced=plain(frame))
    robot = propose_robot(
        texts,
        scanned[scan] if scan is not None else None,
        upside_down=footprint.upside_down,
        lidar_yaw_rad=(footprint.lidar_yaw_rad or 0.0) if footprint.lidar_aside else 0.0,
    )
    turned, command_rad = turning_evidence(chosen.log, poses)
    robot = robot.driven(turned, footprint.length_m, command_rad=command_rad)
    wheelbase_m = robot.values.get("wheelbase_m")
    driven, commands, hold = read_commands(
        recording, chosen.log, roles["wheels"], poses, wheelbase_m
    )
    best = {role: fits[0] for role, fits in roles.items() if fits}
    used = {role: topic.name for role, (topic, _) in best.items()}
    paces_s = _paces(recording, {*used.values()})
    gaps = Gaps() if chosen.log is None else chosen.log.gaps
    gaps = replace(gaps, hold_s=hold.age_s, sensor_s=_slowest_s(paces_s, used, poses))
    motion = None
    if not roles["wheels"] and poses is not None:
        motion = choose_motion(recording, poses, poses_from)
    sensors = {used[role] for role in (*REQUIRED, "scan") if role in used}
    if not commands.measured:
        sensors.discard(commands.topic)
    clock = choose_clock(
        recording,
        list(dict.fromkeys(used.values())),
        frozenset(name for role, name in used.items() if role in LATCHED),
        gaps,
        stamped=bool(sensors) and all(STAMP in recording.leaves(name) for name in sensors),
    )
    signals = candidates(
        recording,
        without={name for role, name in used.items() if role in SPENT},
        used={(topic.name, path) for topic, kind in best.values() for path in kind.fields.values()},
    )
    return Evidence(
        recording=recording,
        roles=roles,
        frames=frames,
        poses_from_frames=framed,
        motion=motion,
        commands=commands,
        chosen=chosen,
        driven=driven,
        hold=hold,
        paces_s=paces_s,
        clock=clock,
        gaps=gaps,
        footprint=footprint,
        footprint_notes=notes,
        outline=outline,
        goal=GoalChoice(
            "logged" if roles["goal"] else "hindsight", hindsight_wanted=given.hindsight_goals
        ),
        signals=signals,
        robot=robot,
        unmeasured=unmeasured,
        origin_m=None if poses is None else _origin_m(poses),
    )


def _origin_m(poses: PoseSeries) -> tuple[int, int] | None:
    """Return the median position (m), rounded, if it is far from 0; None if it is near.

    A store has positions in float32, which would round far positions to more than a millimetre.
    """
    x, y = (float(np.median(column)) if len(poses) else 0.0 for column in (poses.x_m, poses.y_m))
    return (round(x), round(y)) if max(abs(x), abs(y)) > MILLIMETRES_UP_TO_M else None


def _measured(
    recording: Recording, fits: list[tuple[TopicInfo, Kind]], key: str
) -> tuple[list[tuple[TopicInfo, Kind]], str]:
    """Drop an input's topics before the first that measures `key`; also return the reasons."""
    reasons: list[str] = []
    for place, (topic, kind) in enumerate(fits):
        leaves = set(recording.leaves(topic.name))
        path = kind.fields.get(key, "")
        source = Input(topic.name, topic.type, {key: path})
        said = estimate_reduction([source], leaves)
        if said is None:
            return fits[place:], "; ".join(reasons)
        flags = recording.read({topic.name: []}, {topic.name: said})[topic.name].fields
        if not all(len(column) and np.asarray(column).all() for column in flags.values()):
            return fits[place:], "; ".join(reasons)
        (rule,) = conventions_of(topic.type, path)
        reasons.append(
            f"all {topic.expected:,} messages of {topic.name} have no estimate of"
            f" {rule.values[0]} ({rule.words})"
        )
    return [], "; ".join(reasons)


def without_first(seen: Evidence, role: str, why: str) -> Evidence | None:
    """Drop the first topic of an input; `why` goes into the profile.

    The input's next topic replaces it. If wheels have no next topic, speeds are computed from
    poses; returns None if there are too few poses.
    """
    roles = {**seen.roles, role: seen.roles[role][1:]}
    reasons = "; ".join(filter(None, [seen.unmeasured.get(role, ""), why]))
    seen = replace(seen, roles=roles, unmeasured={**seen.unmeasured, role: reasons})
    if roles[role] or role != "wheels":
        return seen
    frames = seen.frames if seen.poses_from_frames else None
    poses = pose_series(seen.recording, roles, frames, transform_edges(seen.recording))
    motion = choose_motion(seen.recording, *poses)
    if motion.problem:
        return None
    return replace(seen, motion=motion)


def _paces(recording: Recording, names: Collection[str]) -> dict[str, float]:
    """Return the usual time between two messages of each topic (s, log time)."""
    found = {}
    for name, columns in recording.read({name: [] for name in sorted(names)}).items():
        gaps = columns.gaps_s()
        if len(gaps) > 1:
            # Use the median gap, or half the 90th percentile if messages come in bursts.
            found[name] = max(float(np.median(gaps)), float(np.percentile(gaps, 90)) / 2)
    return found


def _slowest_s(
    paces: Mapping[str, float], used: Mapping[str, str], poses: PoseSeries | None
) -> float:
    """Return the time (s) between messages of pose or of wheels, whichever is longer."""
    names = [used[role] for role in ("pose", "wheels") if role in used]
    known = [paces[name] for name in names if name in paces]
    if poses is not None and len(poses) > 1 and not names:
        known.append(float(np.median(np.diff(poses.stamp_ns))) * 1e-9)
    return max(known, default=0.0)
