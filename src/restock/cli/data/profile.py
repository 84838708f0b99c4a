"""`restock profile`: propose a profile for a recording, or check one against it."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from restock.cli import output
from restock.cli.words import Option, Positional
from restock.errors import ConfigError, ExitCode, RecordingError, counted, visible
from restock.files import expect_file_place, write_text

if TYPE_CHECKING:
    from restock.ingest.containers.recording import Recording
    from restock.ingest.pipeline import IngestResult
    from restock.ingest.profile.profile import Profile
    from restock.ingest.propose.drives import Drives, RobotTraits

# Attributes of a proposal that are printed.
_PRINTED = ("missing", "signals", "ticks", "transitions", "problems", "commands", "kinds")
OFTEN = 0.5  # a label on more than this share of the transitions is reported


@dataclass
class ProfileCommand:
    """Propose a profile for an unknown robot, or check one against a recording.

    `restock profile new RECORDING` proposes a profile from the types and names of topics, rates,
    clocks, frames and commanded speeds, with a comment at each guess. Fields that might become
    custom columns are listed, commented out. The profile is printed, or written to --out. For
    several recordings, or a folder of them, it proposes one profile for all recordings of one kind
    of robot, and lists the others. If there are more than 12 of that kind, it reads the 12 largest
    and lists those that it did not read.

    `restock profile check PROFILE RECORDING` shows which inputs would be used, which are missing
    (and what the recording has instead), how many transitions would result, how many of them each
    condition would label, and what removes most rows, with advice. Nothing is written.

    `restock profile schema` prints what a TOML file may contain, for editors.

    Exit codes: `new` exits with 3 if the proposal cannot be used as it is (it is still written, and
    says why), and `check` with 2 if the profile does not fit. Both exit with 3 if data of a
    recording was lost, or a recording could not be read; the output says what.
    """

    action: Annotated[Literal["new", "check"], Positional()]
    """new RECORDING…, or check PROFILE RECORDING."""
    paths: Annotated[tuple[str, ...], Positional("PATH")]
    """For `new`: one or more recordings of one kind of robot. For `check`: the profile (a file or a
    shipped name), then the recording."""
    footprint: Annotated[str | None, Option("LxW")] = None
    """For `new`: the robot's length and width in metres, for example 0.6x0.5. Default: from the
    recording's /robot_description, else a guess."""
    urdf: Annotated[Path | None, Option("FILE")] = None
    """For `new`: the robot's URDF, for outline, wheels, mass and lidar. It replaces the recording's
    /robot_description. Convert xacro to URDF first; meshes are not read. See docs/robot.md."""
    robot: Annotated[str | None, Option("NAME")] = None
    """For `new`: which robot the profile is for, if the recordings are of several: its namespace,
    for example /robot2. Default: the one with most topics. The proposal lists all of them."""
    odometry_as_command: bool = False
    """For `new`: use odometry as the command if no command was recorded: the measured motion then
    stands for the commanded motion."""
    hindsight_goals: bool = False
    """For `new`: take goals in hindsight even if most of the drive has none, as when the robot
    mostly stood. Rows without a goal are then left out. See docs/task.md."""
    out: Path | None = None
    """Where `new` writes the profile. An existing file is not overwritten."""
    definitions: Annotated[str | None, Option("DISTRO|PATH")] = None
    """Message definitions for recordings without their own: a ROS distribution (default: humble),
    or a folder (PACKAGE/msg/NAME.msg or .idl) or file that defines a robot's own types."""
    salvage: bool = False
    """Also read what is intact in damaged or truncated files."""
    json: bool = False
    """Print one JSON document: `new`: {"toml", "missing", "signals", "ticks", "transitions",
    "problems", "advice", "commands", "kinds", "read" (first the one it was
    proposed from), "unread", "unreadable", "losses"}; `check`: {"inputs", "problems", "advice",
    "inside_outline", "outcome", …}."""

    def run(self) -> int:
        """Propose or check a profile."""
        wrong = not self.paths if self.action == "new" else len(self.paths) != 2
        if wrong:
            wanted = "at least 1 path" if self.action == "new" else "2 paths"
            raise ConfigError(
                f"`profile {self.action}` takes {wanted}, got {len(self.paths)}",
                remedy="restock profile new RECORDING…; restock profile check PROFILE RECORDING",
            )
        return self._new() if self.action == "new" else self._check()

    def _new(self) -> int:
        from restock.ingest.containers.open_recording import recordings_in
        from restock.ingest.propose.drives import propose_for_drives
        from restock.ingest.propose.footprint import parse_footprint
        from restock.ingest.propose.gather import Given

        if self.out is not None and self.out.exists():
            raise ConfigError("already exists", where=str(self.out), remedy="choose another --out")
        expect_file_place(self.out, "--out")
        given = Given(
            None if self.footprint is None else parse_footprint(self.footprint),
            self.urdf,
            self.odometry_as_command,
            self.hindsight_goals,
        )
        stem = (self.out or Path(self.paths[0])).stem
        if self.out is None and self.robot is not None:  # a different name for each robot
            stem += f"_{self.robot.strip('/')}"
        paths = list(dict.fromkeys(r for path in self.paths for r in recordings_in(path)))
        drives, unreadable = self._drives(paths)
        chosen = [drives.paths[one] for one in drives.read]
        with ExitStack() as opened:
            recordings = [opened.enter_context(self._open(path)) for path in chosen]
            with output.progress("proposing", None) as advance:
                for recording in recordings:
                    recording.watch = advance.part
                name = re.sub(r"\W+", "_", stem).strip("_") or "robot"
                proposal = propose_for_drives(recordings, drives, name, given)
            losses = _losses(recordings, proposal.toml)
        chosen.sort(key=lambda path: path != proposal.base)  # list the base recording first
        toml = "".join(f"# LOST: {loss}\n" for loss in losses) + proposal.toml
        if self.out is not None:
            write_text(self.out, toml)
            rows = f"{proposal.transitions:,} transitions of {proposal.ticks:,} ticks"
            output.say(f"wrote {self.out}" + (f": {rows}" if proposal.ticks else ""))
        if self.json:
            output.print_json(
                {
                    "toml": toml,
                    **{name: getattr(proposal, name) for name in _PRINTED},
                    "advice": [asdict(each) for each in proposal.advice],
                    "read": [str(path) for path in chosen],
                    "unread": [str(path) for path in drives.unread],
                    "unreadable": [str(path) for path in unreadable],
                    "losses": losses,
                    "findings": [one.as_row() for one in proposal.findings],
                }
            )
        elif self.out is None:
            sys.stdout.write(toml)
        lines = [str(each) for each in proposal.advice]
        lines += [f"lost: {loss}" for loss in losses]
        lines += [finding.reported for finding in proposal.findings]
        for line in lines:
            output.say(visible(line))
        for problem in proposal.problems:
            names = visible(", ".join(self.paths))
            sys.stderr.write(f"restock: {names}: cannot be used yet: {problem}\n")
        if self.out is not None and not proposal.problems:
            checking = visible(shlex.join(["profile", "check", str(self.out), str(chosen[0])]))
            output.say(f"next: restock {checking}")
        kept = any(not finding.repaired for finding in proposal.findings)
        lossy = proposal.problems or losses or unreadable or kept
        return ExitCode.LOSSY if lossy else ExitCode.OK

    def _drives(self, paths: Sequence[Path]) -> tuple[Drives, list[Path]]:
        """Group recordings by kind of robot, and list the recordings that cannot be read.

        Raises:
            RecordingError: no recording can be read.
        """
        from restock.ingest.propose.drives import Drives, drives_by_kind, robot_traits

        if len(paths) == 1:
            return Drives(paths, [], [[0]], [0]), []
        traits: dict[Path, RobotTraits] = {}
        unreadable: dict[Path, RecordingError] = {}
        for path in paths:
            try:
                with (
                    self._open(path) as recording,
                    output.progress(f"which robot: {path.name}", None) as advance,
                ):
                    recording.watch = advance.part
                    traits[path] = robot_traits(recording)
            except RecordingError as error:
                unreadable[path] = error
        if unreadable and not traits:
            raise next(iter(unreadable.values()))
        for why in unreadable.values():
            sys.stderr.write(f"restock: left out of the proposal: {why}\n")
        return drives_by_kind([*traits], [*traits.values()]), [*unreadable]

    def _open(self, path: Path | str) -> Recording:
        from restock.ingest.containers.open_recording import open_recording
        from restock.ingest.containers.storage import no_progress
        from restock.ingest.propose.roles import choose_robot

        with output.progress(f"opening {Path(path).name}", None) as advance:
            recording = open_recording(
                path, definitions=self.definitions, salvage=self.salvage, watch=advance.part
            )
        recording.watch = no_progress  # later reads have no progress bar
        if self.robot is not None:
            try:
                choose_robot(recording, self.robot)
            except ConfigError:
                recording.close()
                raise
        return recording

    def _check(self) -> int:
        from restock.cli.data.ingest import as_json, show
        from restock.ingest.pipeline import ingest
        from restock.ingest.profile.profile import load_profile
        from restock.ingest.steps.needs import input_problems

        profile = load_profile(self.paths[0])
        with self._open(self.paths[1]) as recording:
            topics = recording.topics
            leaves = {name: recording.fields(name) for name in profile.topics if name in topics}
            problems = input_problems(profile, topics, leaves)
            inputs = _inputs(profile, topics)
        document: dict[str, Any] = {"profile": profile.name, "hash": profile.hash, "inputs": inputs}
        if not self.json:
            output.print_table(inputs)
        outcome, code = None, ExitCode.OK
        advice: list[str] = []
        inside: float | None = None
        if not problems:
            try:
                with output.progress("checking", None) as advance:
                    outcome = ingest(
                        *(self.paths[1], profile),
                        store=None,
                        definitions=self.definitions,
                        salvage=self.salvage,
                        watch=advance.part,
                    )
            except RecordingError as error:
                problems = [error.what]
            advice, inside = self._advice(profile, outcome)
        if problems:
            code = ExitCode.USAGE
        elif outcome is not None and outcome.lossy:
            code = ExitCode.LOSSY
        if self.json:
            document |= {"problems": problems, "advice": advice, "inside_outline": inside}
            document["outcome"] = as_json(outcome) if outcome else None
            output.print_json(document)
        elif outcome is not None:
            show(outcome)
        for line in () if self.json else advice:
            sys.stdout.write(f"try: {line}\n")
        for problem in problems:
            sys.stderr.write(f"restock: {visible(self.paths[1])}: {problem}\n")
        return code

    def _advice(
        self, profile: Profile, outcome: IngestResult | None
    ) -> tuple[list[str], float | None]:
        """Return advice: what in the profile removes or labels most rows, and what to try.

        Also return the share of ticks at which the lidar sees something inside the robot's outline.
        """
        from restock.ingest.propose.trial import try_profile
        from restock.ingest.steps.needs import as_recorded, read_topics
        from restock.ingest.task.conditions import NOMINAL

        with (
            self._open(self.paths[1]) as recording,
            output.progress("looking for changes that would give more rows", None) as advance,
        ):
            recording.watch = advance.part
            as_read = as_recorded(profile, recording.topics)
            trial = try_profile(as_read, read_topics(recording, as_read))
        lines = [str(each) for each in trial.advice]
        rows = outcome.manifest["transitions"] if outcome else 0
        lines += [
            f"`{name}` holds on {count:,} of {rows:,} transitions: check its SQL for this robot, "
            "and the outline in [task.body]"
            for name, count in (outcome.conditions if outcome else {}).items()
            if name != NOMINAL and count > OFTEN * rows
        ]
        return lines, trial.inside_outline


def _losses(recordings: Sequence[Recording], toml: str) -> list[str]:
    """List the data that is lost in the recordings' files and in the topics that a profile uses.

    If the profile cannot be used yet, losses in all topics that were read are listed.
    """
    from restock.ingest.profile.profile import parse_profile

    topics = None
    with suppress(ConfigError):
        topics = parse_profile(toml, where="the proposal").topics
    return [
        visible(f"{recording.path}: {loss.topic or 'the file'}: {loss.reason}")
        + (f" ({counted(n, 'message')})" if (n := loss.messages) else "")
        for recording in recordings
        for loss in recording.lost_messages
        if loss.topic is None or topics is None or loss.topic in topics
    ]


def _inputs(profile: Any, topics: Any) -> list[dict[str, Any]]:
    """List where each input comes from, and how many messages it has."""

    from restock.ingest.steps.needs import near

    def row(name: str, topic: str, kind: str, age: float | None, optional: bool) -> dict[str, Any]:
        return {
            "input": name,
            "topic": topic,
            "type": kind,
            "messages": topics[topic].expected if topic in topics else 0,
            "at most s old": age,
            "optional": optional,
            "": near(topic, topics),
        }

    rows = [
        row(name, source.topic, source.type, source.max_age_s, source.optional)
        for name, source in profile.sources.items()
    ]
    for topic in profile.transform_topics:
        moving = topic == profile.frames.topic
        kind = topics[topic].type if topic in topics else ""
        rows.append(row("frames", topic, kind, profile.frames.max_age_s if moving else None, True))
    for name, signal in profile.signals.items():
        rows.append(row(f"signals.{name}", signal.topic, signal.type, signal.max_age_s, True))
    for name, camera in profile.cameras.items():
        kind = topics[camera.topic].type if camera.topic in topics else ""
        rows.append(row(f"cameras.{name}", camera.topic, kind, camera.max_age_s, True))
    return rows
