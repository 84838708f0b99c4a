"""Read other people's robots by the proposed profile: how much of their time becomes rows.

    python benchmarks/strangers.py --bags FOLDER [--only TEXT] [--json] [--check]

Each recording under FOLDER with a command (a Twist or an Ackermann command, stamped or not) and a
pose (odometry, a pose with a header, transforms) goes through `restock profile new` and a dry
`restock ingest`. Its rows are compared with the time in which a command is in force and the pose is
known, found here by plain loops over log time that share no code with ingest: a command is in force
for 1 s; longer as long as the robot does what it says, until the next one. A pose is known for 1 s.
A recording with nothing of either kind must be refused; the table says with which words.

"usable" is the time that would be rows if the profile had no goals: a drive without a goal topic
gets them by hindsight, and where it stands at one of them, or goes nowhere, it has none.

With a `fleets.json` in FOLDER only the recordings that it lists are taken, and those that it says
have a command and a pose count. `--check` exits 1 unless nine in ten of them give rows, and 85 % of
that time is rows.
"""

from __future__ import annotations

import json
import math
import re
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from harness import finish, markdown, option_parser

from restock.errors import RestockError
from restock.ingest import open_recording, recordings_in
from restock.ingest.containers.recording import Recording
from restock.ingest.profile.profile import GoalRules, parse_profile
from restock.ingest.propose.drives import propose_profile
from restock.ingest.steps.align import NS
from restock.ingest.steps.episodes import Split, Steps, split, steps_of
from restock.ingest.steps.needs import read_topics

MIN_RECORDINGS, MIN_TIME = 0.9, 0.85
STEP_S = 0.05  # of the loops over log time
KNOWN_S = 1.0
MOVED_M, TURNED_RAD = 0.02, 0.04  # within KNOWN_S: less is standing
COMMANDS = {
    "geometry_msgs/msg/Twist": ("linear.x", "angular.z"),
    "geometry_msgs/msg/TwistStamped": ("twist.linear.x", "twist.angular.z"),
    "ackermann_msgs/msg/AckermannDrive": ("speed", "steering_angle"),
    "ackermann_msgs/msg/AckermannDriveStamped": ("drive.speed", "drive.steering_angle"),
}
POSES = {
    "nav_msgs/msg/Odometry": "pose.pose",
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
}
TRANSFORMS = ("/tf", "tf2_msgs/msg/TFMessage")
NO_POSE = ("goal", "initial", "target", "waypoint")


@dataclass
class Stranger:
    """One recording: what there is, and what comes of it."""

    recording: str
    rows: int
    rows_s: float  # in log time
    usable_s: float  # the same if it had no goals: time without a mission by hindsight included
    known_s: float  # a command in force, and the pose known
    counts: bool
    missing: str

    @property
    def share(self) -> float:
        return self.rows_s / self.known_s if self.known_s else 0.0


def main() -> int:
    parser = option_parser(__doc__)
    parser.add_argument("--bags", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--only", default="", metavar="TEXT", help="paths that hold this text")
    options = parser.parse_args()
    strangers = []
    for path, counts in recordings_of(options.bags):
        if options.only in path.as_posix():
            strangers.append(measure(path, path.relative_to(options.bags).as_posix(), counts))
            print(strangers[-1], file=sys.stderr)
    figures = summary(strangers)
    lines = [
        markdown(
            ["recording", "rows", "s of rows", "s usable", "s known", "share", "what is missing"],
            [
                [
                    s.recording,
                    s.rows,
                    f"{s.rows_s:.1f}",
                    f"{s.usable_s:.1f}",
                    f"{s.known_s:.1f}",
                    f"{s.share:.0%}" if s.counts else "",
                    s.missing,
                ]
                for s in strangers
            ],
        ),
        "",
        *(f"{name}: {value}" for name, value in figures.items()),
    ]
    missed = []
    if figures["give_rows"] < MIN_RECORDINGS * figures["recordings"]:
        missed.append(f"{figures['give_rows']} of {figures['recordings']} recordings give rows")
    if figures["usable_s"] < MIN_TIME * figures["known_s"]:
        missed.append(f"{figures['usable_s']:.0f} of {figures['known_s']:.0f} s are usable")
    whole = {**figures, "strangers": [asdict(s) for s in strangers]}
    return finish(options, whole, missed, lines)


def recordings_of(bags: Path) -> list[tuple[Path, bool]]:
    """Return the recordings, and whether each has a command and a pose by `fleets.json`."""
    listed = bags / "fleets.json"
    if not listed.is_file():
        return [(path, True) for path in recordings_in(bags)]
    return [
        (bags / one["file"], one["has"]["command"] and one["has"]["pose"])
        for one in json.loads(listed.read_text())
    ]


def summary(strangers: list[Stranger]) -> dict[str, Any]:
    """Over the recordings that count. Time beyond what is known is not counted for another one."""
    counted = [one for one in strangers if one.counts]
    return {
        "recordings": len(counted),
        "give_rows": sum(one.rows > 0 for one in counted),
        "half_of_their_time": sum(one.share >= 0.5 for one in counted),
        "rows_s": round(sum(min(one.rows_s, one.known_s) for one in counted), 1),
        "usable_s": round(sum(min(one.usable_s, one.known_s) for one in counted), 1),
        "known_s": round(sum(one.known_s for one in counted), 1),
        "beyond": sum(one.share > 1.1 for one in counted),
    }


def measure(path: Path, name: str, counts: bool) -> Stranger:
    """Propose a profile, try it, and compare."""
    try:
        with open_recording(path) as recording:
            known_s = command_and_pose_s(recording)
            proposal = propose_profile(recording, "robot")
            if proposal.problems:
                return Stranger(name, 0, 0.0, 0.0, known_s, counts, "; ".join(proposal.problems))
            profile = parse_profile(proposal.toml, where="the proposal")
            topics = read_topics(recording, profile)
            steps = steps_of(profile, topics)
            goalless = msgspec.structs.replace(
                profile, task=msgspec.structs.replace(profile.task, goal="none"), goal=GoalRules()
            )
            usable = steps_of(goalless, topics)
    except RestockError as error:
        return Stranger(name, 0, 0.0, 0.0, 0.0, counts, error.what)
    episodes = split(profile.task, steps)
    dropped = sorted(episodes.dropped.items(), key=lambda item: -item[1])
    missing = [f"{reason} {count}" for reason, count in dropped[:3]]
    missing += [f"no {name}" for name in profile.fallbacks if name in ("pose", "wheels", "command")]
    return Stranger(
        name,
        episodes.transitions,
        _seconds(steps, episodes),
        _seconds(usable, split(goalless.task, usable)),
        known_s,
        counts,
        "; ".join(missing),
    )


def _seconds(steps: Steps, episodes: Split) -> float:
    """Return what the transitions span, in log time."""
    stamps, pace = steps.signals["stamp_ns"], steps.clock.pace or 1.0
    return sum(int(stamps[one.last] - stamps[one.first]) for one in episodes.episodes) / NS / pace


def command_and_pose_s(recording: Recording) -> float:
    """Seconds in which a command is in force and the pose is known; plain loops over log time."""
    topics = [t for t in recording.topics.values() if t.expected and not t.skipped]
    commanding = [t for t in topics if t.type in COMMANDS]
    posing = [t for t in topics if t.type in POSES and not re.search("|".join(NO_POSE), t.name)]
    if not commanding or recording.span_ns is None:
        return 0.0
    command = max(commanding, key=lambda t: (t.name.endswith("cmd_vel"), t.expected))
    paths = list(COMMANDS[command.type])
    columns = recording.read({command.name: paths})[command.name]
    reported = sorted(
        (int(t) / NS, float(v), float(w))
        for t, v, w in zip(columns.log_time_ns, *(columns.fields[p] for p in paths), strict=True)
    )
    if posing:
        # Of several the one that comes most often.
        pose = max(posing, key=lambda t: t.expected)
        base = POSES[pose.type]
        at = [f"{base}.position.{a}" for a in "xy"] + [f"{base}.orientation.{a}" for a in "xyzw"]
        found = recording.read({pose.name: at})[pose.name]
        numbers = [np.asarray(found.fields[path], float).tolist() for path in at]
        poses = sorted(
            (int(t) / NS, x, y, math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)))
            for t, x, y, qx, qy, qz, qw in zip(found.log_time_ns, *numbers, strict=True)
        )
    else:
        poses = _transformed(recording)
    return STEP_S * sum(_in_force_and_known(reported, poses, recording.span_ns[1] / NS))


def _transformed(recording: Recording) -> list[tuple[float, float, float, float]]:
    """Return the moving transforms by child frame, without those of a robot's wheels."""
    name, kind = TRANSFORMS
    if name not in recording.topics or recording.topics[name].type != kind:
        return []
    paths = ["transforms[].child_frame_id", "transforms[].header.frame_id"]
    parts = [f"transforms[].transform.translation.{a}" for a in "xy"]
    turns = [f"transforms[].transform.rotation.{a}" for a in "zw"]
    found = recording.read({name: [*paths, *parts, *turns]})[name]
    poses = []
    for row, log_time in enumerate(found.log_time_ns):
        values = [list(found.fields[path][row]) for path in (*paths, *parts, *turns)]
        for child, parent, x, y, z, w in zip(*values, strict=True):
            if parent.strip("/") in ("odom", "map") and child.strip("/") != "odom":
                poses.append((int(log_time) / NS, x, y, 2 * math.atan2(z, w)))
    return sorted(poses)


def _in_force_and_known(
    reported: list[tuple[float, float, float]],
    poses: list[tuple[float, float, float, float]],
    end: float,
) -> list[bool]:
    """Every STEP_S from the first command to the end: whether both are so."""
    both = []
    command, pose, since = 0, -1, 0.0  # since: how long the robot has done something else
    now, earlier = reported[0][0], 0
    while now <= end:
        while command + 1 < len(reported) and reported[command + 1][0] <= now:
            command, since = command + 1, 0.0
        while pose + 1 < len(poses) and poses[pose + 1][0] <= now:
            pose += 1
        known = pose >= 0 and now - poses[pose][0] <= KNOWN_S
        in_force = now - reported[command][0] <= KNOWN_S
        if not in_force and known and since < KNOWN_S:
            while poses[earlier][0] < now - KNOWN_S and earlier < pose:
                earlier += 1
            (_, x0, y0, yaw0), (_, x, y, yaw) = poses[earlier], poses[pose]
            turned = (yaw - yaw0 + math.pi) % (2 * math.pi) - math.pi
            moved, (_, speed, turn) = math.hypot(x - x0, y - y0) > MOVED_M, reported[command]
            if abs(speed) > 1e-3:
                obeys = moved
            elif abs(turn) > 1e-3:
                obeys = turned * math.copysign(1.0, turn) > TURNED_RAD
            else:
                obeys = not moved and abs(turned) <= TURNED_RAD
            since = 0.0 if obeys else since + STEP_S
            in_force = since < KNOWN_S
        both.append(known and in_force)
        now += STEP_S
    return both


if __name__ == "__main__":
    sys.exit(main())
