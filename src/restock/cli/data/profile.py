"""`restock profile`: propose a profile for a recording, or check one against it."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from restock.errors import ConfigError, ExitCode, RecordingError
from restock.files import write_text

if TYPE_CHECKING:
    from restock.ingest.containers.recording import Recording
    from restock.ingest.prepared import IngestResult
    from restock.ingest.profile.profile import Profile

OFTEN = 0.5  # of the transitions: a label that holds on more is worth a look


@dataclass
class ProfileCommand:
    """Propose a profile for an unknown robot, or check one against a recording.

    `restock profile new RECORDING` proposes a profile from the types and names of topics, rates,
    clocks, frames and commanded speeds, with a comment at each guess. Fields that might become
    custom columns are listed, commented out. The profile is printed, or written to --out. For
    several recordings, or a folder of them, it proposes one profile for all recordings of one kind
    of robot, and lists the others.

    `restock profile check PROFILE RECORDING` shows which inputs would be used, which are missing
    (and what the recording has instead), how many transitions would result, how many of them each
    condition would label, and what removes most rows, with advice. Nothing is written.

    Exit codes: `new` exits with 3 if the proposal cannot be used as it is (it is still written, and
    says why); `check` exits with 2 if the profile does not fit.
    """

    action: Annotated[Literal["new", "check"], tyro.conf.Positional]
    """new RECORDING…, or check PROFILE RECORDING."""
    paths: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """For `new`: one or more recordings of one kind of robot. For `check`: the profile (a file or a
    shipped name), then the recording."""
    footprint: Annotated[str | None, tyro.conf.arg(metavar="LxW")] = None
    """For `new`: the robot's length and width in metres, for example 0.6x0.5. Default: from the
    recording's /robot_description or its costmap's footprint, else a guess."""
    urdf: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """For `new`: the robot's URDF, for outline, wheels, mass and lidar. It replaces the recording's
    /robot_description. Convert xacro to URDF first; meshes are not read. See docs/robot.md."""
    odometry_as_command: bool = False
    """For `new`: use odometry as the command if no command was recorded: the measured motion then
    stands for the commanded motion."""
    hindsight_goals: bool = False
    """For `new`: take goals in hindsight even if most of the drive has none, as when the robot
    mostly stood. Rows without a goal are then left out. See docs/goals.md."""
    out: Path | None = None
    """Where `new` writes the profile. An existing file is not overwritten."""
    typestore: str | None = None
    """ROS 2 distribution whose message definitions are used for recordings without their own.
    Default: humble."""
    definitions: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """A folder of .msg and .idl files (PACKAGE/msg/NAME.msg) that define a robot's own types, for
    recordings that do not contain the definitions."""
    salvage: bool = False
    """Also read what is intact in damaged or truncated files."""
    json: bool = False
    """Print one JSON document: `new`: {"toml", "missing", "signals", "ticks", "transitions",
    "problems", "advice", "commands", "kinds", "wheeled"}; `check`: {"inputs", "problems", "advice",
    "outcome", …}."""

    @property
    def _typestore(self) -> str | None:
        from restock.ingest.containers.open_recording import with_definitions

        return with_definitions(self.typestore, self.definitions)

    def run(self) -> int:
        """Do one of the two."""
        wrong = not self.paths if self.action == "new" else len(self.paths) != 2
        if wrong:
            wanted = "at least 1 path" if self.action == "new" else "2 paths"
            raise ConfigError(
                f"`profile {self.action}` takes {wanted}, got {len(self.paths)}",
                remedy="restock profile new RECORDING…; restock profile check PROFILE RECORDING",
            )
        return self._new() if self.action == "new" else self._check()

    def _new(self) -> int:
        from restock.cli import output
        from restock.ingest.containers.discover import recordings_in
        from restock.ingest.propose.drives import drives_to_read, propose_for_drives
        from restock.ingest.propose.evidence.footprint import parse_footprint

        if self.out is not None and self.out.exists():
            raise ConfigError("already exists", where=str(self.out), remedy="choose another --out")
        footprint = None if self.footprint is None else parse_footprint(self.footprint)
        stem = (self.out or Path(self.paths[0])).stem
        chosen, left_out = drives_to_read([r for path in self.paths for r in recordings_in(path)])
        with ExitStack() as opened:
            recordings = self._readable(chosen, opened)
            with output.progress("proposing", None) as advance:
                for recording in recordings:
                    recording.watch = advance.part
                proposal = propose_for_drives(
                    recordings,
                    re.sub(r"\W+", "_", stem).strip("_") or "robot",
                    footprint=footprint,
                    urdf=self.urdf,
                    odometry_as_command=self.odometry_as_command,
                    hindsight_goals=self.hindsight_goals,
                )
        if left_out:
            output.say(
                f"reading the {len(chosen)} largest of {len(chosen) + left_out:,} recordings"
            )
        if self.out is not None:
            write_text(self.out, proposal.toml)
            rows = f"{proposal.transitions:,} transitions of {proposal.ticks:,} ticks"
            output.say(f"wrote {self.out}" + (f": {rows}" if proposal.ticks else ""))
        if self.json:
            output.print_json(
                {
                    "toml": proposal.toml,
                    "missing": proposal.missing,
                    "signals": proposal.signals,
                    "ticks": proposal.ticks,
                    "transitions": proposal.transitions,
                    "problems": proposal.problems,
                    "advice": [{"key": each.key, "text": each.text} for each in proposal.advice],
                    "commands": proposal.commands,
                    "kinds": [asdict(kind) for kind in proposal.kinds],
                    "wheeled": proposal.wheeled,
                }
            )
        elif self.out is None:
            sys.stdout.write(proposal.toml)
        for each in proposal.advice:
            output.say(str(each))
        for problem in proposal.problems:
            sys.stderr.write(f"restock: {', '.join(self.paths)}: cannot be used yet: {problem}\n")
        if self.out is not None and not proposal.problems:
            checking = shlex.join(["profile", "check", str(self.out), str(chosen[0])])
            output.say(f"next: restock {checking}")
        return ExitCode.LOSSY if proposal.problems else ExitCode.OK

    def _readable(self, paths: Sequence[Path], opened: ExitStack) -> list[Recording]:
        """The recordings that can be read; the others are named, where there is any."""
        recordings, errors = [], []
        for path in paths:
            try:
                recordings.append(opened.enter_context(self._open(path)))
            except RecordingError as error:
                errors.append(error)
        if not recordings and errors:
            raise errors[0]
        for unread in errors:
            sys.stderr.write(f"restock: left out of the proposal: {unread}\n")
        return recordings

    def _open(self, path: Path | str) -> Recording:
        from restock.cli import output
        from restock.ingest.containers.open_recording import open_recording
        from restock.ingest.containers.storage import unwatched

        with output.progress(f"opening {Path(path).name}", None) as advance:
            recording = open_recording(
                path, typestore=self._typestore, salvage=self.salvage, watch=advance.part
            )
        recording.watch = unwatched  # the bar is over
        return recording

    def _check(self) -> int:
        from restock.cli import output
        from restock.cli.data.ingest import as_json, show
        from restock.ingest.pipeline import ingest
        from restock.ingest.profile.profile import load_profile
        from restock.ingest.steps.needs import input_problems

        profile = load_profile(self.paths[0])
        with self._open(self.paths[1]) as recording:
            topics = {n: t for n, t in recording.topics.items() if t.skipped is None}
            leaves = {name: recording.fields(name) for name in profile.topics if name in topics}
            problems = input_problems(profile, topics, leaves)
            inputs = _inputs(profile, topics)
        document: dict[str, Any] = {"profile": profile.name, "hash": profile.hash, "inputs": inputs}
        if not self.json:
            output.print_table(inputs)
        outcome, code = None, ExitCode.OK
        advice: list[str] = []
        if not problems:
            try:
                with output.progress("checking", None) as advance:
                    outcome = ingest(
                        *(self.paths[1], profile),
                        store=None,
                        typestore=self._typestore,
                        salvage=self.salvage,
                        watch=advance.part,
                    )
            except RecordingError as error:
                problems = [error.what]
            advice = self._advice(profile, outcome)
        if problems:
            code = ExitCode.USAGE
        if self.json:
            document |= {"problems": problems, "advice": advice}
            document["outcome"] = as_json(outcome) if outcome else None
            output.print_json(document)
        elif outcome is not None:
            show(outcome)
        for line in () if self.json else advice:
            sys.stdout.write(f"try: {line}\n")
        for problem in problems:
            sys.stderr.write(f"restock: {self.paths[1]}: {problem}\n")
        return code

    def _advice(self, profile: Profile, outcome: IngestResult | None) -> list[str]:
        """What of the profile removes most rows or labels most of them, and what to try."""
        from restock.cli import output
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
        return lines


def _inputs(profile: Any, topics: Any) -> list[dict[str, Any]]:
    """What the profile takes from where, and how many messages of it there are."""

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
