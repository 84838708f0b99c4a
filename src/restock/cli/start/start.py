"""`restock start`: from a stranger's bag to a policy and a report, stage by stage."""

from __future__ import annotations

import math
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from restock.errors import ConfigError, ExitCode, RecordingError
from restock.words import quoted


@dataclass
class StartCommand:
    """Make a policy and a report from recordings of a robot, in one command.

    It proposes a profile (OUT/profile.toml), checks it, ingests, shows the coverage, mixes a panel,
    makes the floor, fits the twin, measures whether the twin can be trusted, trains, evaluates and
    reports. Each stage prints its command, its result and its files. If the twin cannot be trusted,
    a policy is trained on the logs alone, and evaluated on logs that it did not learn from.

    After an edit of OUT/profile.toml or an interruption, run the same command again: finished
    stages whose inputs have not changed are skipped. If a person must decide something, it stops,
    prints what to type, and exits with 3.

    Example: `restock start bags/ --out mine`
    """

    paths: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="BAG")]
    """Recordings of one kind of robot: files, bag folders, or folders of them."""
    out: Path
    """The output folder: profile.toml, store, panel, run, and run/report.html."""
    profile: str | None = None
    """Use this existing profile; do not propose one."""
    footprint: Annotated[str | None, tyro.conf.arg(metavar="LxW")] = None
    """For the proposal: the robot's length and width in metres, for example 0.6x0.5."""
    urdf: Path | None = None
    """For the proposal: the robot's URDF. It replaces the recording's /robot_description."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """For the proposal: which robot, if the recordings are of several: its namespace, for example
    /robot2."""
    odometry_as_command: bool = False
    """Let the proposal use odometry as the command if no command was recorded."""
    map: Path | None = None
    """The map.yaml in which the robot was localised, if the recordings do not contain the map."""
    salvage: bool = False
    """Also read what is intact in damaged or truncated recordings."""
    tag: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")
    ] = ()
    """A tag for the recordings: robot, site, or any other name. May be given several times."""
    typestore: str | None = None
    """ROS 2 distribution whose message definitions are used for recordings without their own.
    Default: humble."""
    definitions: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """A folder of .msg and .idl files (PACKAGE/msg/NAME.msg) that define a robot's own types, for
    recordings that do not contain the definitions."""
    mixture: str = "coverage"
    """The mixture that the learner is fed: the name of a shipped one, or a TOML file."""
    minutes: float = 5.0
    """About how long everything after ingest may take on two cores. Half of the time is
    training."""
    twin: Literal["auto", "yes", "no"] = "auto"
    """Whether to train and evaluate in the twin. auto: only if its gap in nominal driving is within
    the limits of `restock twin gap`."""
    accept: bool = False
    """Continue with the proposal as it is, even if it left a choice to a person."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the network trains."""
    dry_run: bool = False
    """Print the commands that would run; run nothing."""
    json: bool = False
    """Print one JSON document at the end: {"stages": [{"name", "command", "status", "outcome",
    "files", "seconds", …}], "stopped", "report"}."""

    def run(self) -> int:
        """Run all stages; return 3 if a person must decide or a needed stage failed."""
        from restock.cli import main
        from restock.cli.output import print_json, stderr, stdout
        from restock.cli.start.decisions import node_refuses
        from restock.cli.start.way import Way
        from restock.cli.start.work import Work, escape

        if not self.paths:
            raise RecordingError("no recording given", remedy="restock start BAG --out DIR")
        if not 0 < self.minutes < math.inf:
            raise ConfigError(f"must be a number above 0, got {self.minutes:g}", where="--minutes")
        self._check()
        first = self._expect_a_recording()
        console = stderr() if self.json else stdout()

        def say(line: str) -> None:
            console.print(line, soft_wrap=True)
            console.file.flush()  # what is on stderr comes after it

        work = Work(self.out, main, say, plan=self.dry_run)
        stopped = Way(self, work, first).go()
        page = self.out / "run" / "report.html"
        reported = stopped is None or any(e.name == "report" and e.good for e in work.ended)
        if self.json:
            print_json(
                {
                    "stages": work.summary(),
                    "stopped": None if stopped is None else asdict(stopped),
                    "report": str(page) if page.exists() and reported else None,
                }
            )
        if stopped is None:
            if not self.dry_run:
                onnx = f"restock export {quoted(self.out / 'run')} --to onnx --out policy.onnx"
                say(f"\nThe policy, for the robot: {escape(onnx)} (docs/deploy.md)")
                if (needs := node_refuses(self.profile or self.out / "profile.toml")) is not None:
                    say(f"   {escape(needs)} (docs/deploy.md#without-the-node)")
                say(f"The report: [bold]{escape(str(page))}[/bold] (open it in a browser)")
            return int(ExitCode.OK)
        say(f"\n[bold yellow]Stopped: {escape(stopped.why)}[/bold yellow]")
        for remedy in stopped.remedies:
            say(f"   {escape(remedy)}")
        sys.stdout.flush()
        return int(ExitCode.LOSSY)

    def _expect_a_recording(self) -> str:
        """Return the first path, or file in a folder, whose first bytes are a recording's.

        Raises:
            RecordingError: none is; what is wrong with the other paths is printed before.
        """
        from restock.ingest.containers.open_recording import recordings_in, refuse_no_recording

        errors: list[RecordingError] = []
        for name in self.paths:
            try:
                found = recordings_in(name)
            except RecordingError as error:
                errors.append(error)
                continue
            for path in found:
                try:
                    refuse_no_recording(path)
                except RecordingError as error:
                    errors.append(error)
                else:
                    return str(path)
        for other in errors[:-1]:
            sys.stderr.write(f"restock: {other}\n")
        last = errors[-1]
        known = "give a file, a bag's folder, or a folder of bags"
        raise RecordingError(last.what, where=last.where, remedy=last.remedy or known)

    def _check(self) -> None:
        """Check what is given beside the recordings, before anything is written.

        Raises:
            ConfigError, RecordingError: it cannot.
        """
        if self.tag:
            from restock.ingest.task.tags import parse_tags

            parse_tags(self.tag, empty=True)
        if self.out.exists() and not self.out.is_dir():
            raise ConfigError(
                "is a file",
                where=str(self.out),
                remedy="give a folder with --out: it need not exist",
            )
        from restock.ingest.containers.open_recording import with_definitions
        from restock.ingest.decoding.definitions import refuse_unknown
        from restock.replay.mixture.mixture import load_mixture

        if (types := with_definitions(self.typestore, self.definitions)) is not None:
            refuse_unknown(types)
        load_mixture(self.mixture)
        if self.profile is not None:
            from restock.ingest.profile.profile import load_profile

            load_profile(self.profile)
        if self.footprint is not None:
            from restock.ingest.propose.evidence.footprint import parse_footprint

            parse_footprint(self.footprint)
        if self.device != "cpu":
            from restock.train.dqn.learner import open_device

            open_device(self.device)
        if self.urdf is not None:
            from restock.ingest.propose.evidence.robot_choice import check_urdf

            check_urdf(self.urdf)
        if self.map is not None:
            from restock.train.twin.floors.occupancy_map import read_grid

            read_grid(self.map)


__all__ = ["StartCommand"]
