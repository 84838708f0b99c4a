"""`restock start`: from a stranger's bag to a policy and a report, stage by stage."""

from __future__ import annotations

import math
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from restock.errors import ConfigError, ExitCode, RecordingError

if TYPE_CHECKING:
    from restock.cli.start.stage import Stop
    from restock.cli.start.work import Work


HELD_OUT = "evaluation split"  # of a panel's rows left out: those that judge
ODOMETRY = "--odometry-as-command"


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
        """The whole way; 3 where a person must decide, or a stage failed that it needs."""
        from restock.cli import main
        from restock.cli.output import print_json, stderr, stdout
        from restock.cli.start.work import Work, escape

        if not self.paths:
            raise RecordingError("no recording given", remedy="restock start BAG --out DIR")
        if not 0 < self.minutes < math.inf:
            raise ConfigError(f"must be a number above 0, got {self.minutes:g}", where="--minutes")
        self._check()
        console = stderr() if self.json else stdout()

        def say(line: str) -> None:
            console.print(line, soft_wrap=True)
            console.file.flush()  # what is on stderr comes after it

        work = Work(self.out, main, say, plan=self.dry_run)
        stopped = _way(self, work)
        page = self.out / "run" / "report.html"
        reported = stopped is None or any(e.name == "report" and e.good for e in work.ended)
        if self.json:
            stages = [{k: v for k, v in asdict(e).items() if k != "document"} for e in work.ended]
            print_json(
                {
                    "stages": stages,
                    "stopped": None if stopped is None else asdict(stopped),
                    "report": str(page) if page.exists() and reported else None,
                }
            )
        if stopped is None:
            if not self.dry_run:
                onnx = f"restock export {self.out / 'run'} --to onnx --out policy.onnx"
                say(f"\nThe policy, for the robot: {escape(onnx)} (docs/deploy.md)")
                say(f"The report: [bold]{escape(str(page))}[/bold] (open it in a browser)")
            return int(ExitCode.OK)
        say(f"\n[bold yellow]Stopped: {escape(stopped.why)}[/bold yellow]")
        for remedy in stopped.remedies:
            say(f"   {escape(remedy)}")
        sys.stdout.flush()
        return int(ExitCode.LOSSY)

    def _check(self) -> None:
        """That what is given beside the recordings can be used: said before anything is written.

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
            from restock.ingest.propose.evidence.robot_lines import check_urdf

            check_urdf(self.urdf)
        if self.map is not None:
            from restock.train.twin.floors.occupancy_map import read_grid

            read_grid(self.map)


def _way(asked: StartCommand, work: Work) -> Stop | None:
    """Stage after stage; where a person must decide, why and what to do."""
    from restock.cli.start import stages
    from restock.cli.start.decisions import (
        edited,
        floor_settings,
        fullest,
        has_goal,
        horizon,
        logs_alone_settings,
        mistrust,
        no_room,
        of_other_kinds,
        practice_settings,
        robot_line,
        several_kinds,
        updates_settings,
    )
    from restock.cli.start.settings import Settings
    from restock.cli.start.stage import Stop
    from restock.cli.start.work import escape

    again = f"then run the same command again: finished stages are kept in {asked.out}"
    own = asked.profile is not None
    to = Settings(
        logs=asked.paths,
        out=asked.out,
        profile=asked.profile or asked.out / "profile.toml",
        seconds=30.0 * asked.minutes,
        episodes=max(round(4 * asked.minutes), 1),
        device=asked.device,
        mixture=asked.mixture,
        typestore=asked.typestore,
        definitions=asked.definitions,
        salvage=asked.salvage,
        tags=asked.tag,
        map=asked.map,
    )
    found = work.do(stages.info(to))
    readable = found.document.get("recordings", ())
    salvaging = "add --salvage to this command: it reads what is intact in damaged recordings"
    if not (found.good or readable):
        known = "give a file, a bag's folder, or a folder of bags"
        if any("cannot be read" in why for why in found.errors):
            known = "see the message for each above, or give other recordings"
        return Stop(
            "no recording can be read",
            (salvaging if any("--salvage" in why for why in found.errors) else known,),
        )
    if not found.good:
        work.say(f"   continuing with the {len(readable)} that can be read; or {salvaging}")
    recording = fullest(found.document) or asked.paths[0]

    if not own and not edited(to.profile, asked.out):
        flags = [] if asked.footprint is None else ["--footprint", asked.footprint]
        flags += [] if asked.urdf is None else ["--urdf", str(asked.urdf)]
        flags += ["--odometry-as-command"] * asked.odometry_as_command
        several = len(readable) > 1
        sources = asked.paths if several else (recording,)
        proposed = work.do(stages.propose(to, sources, flags, asked.urdf))
        if not proposed.good:
            return Stop("no profile can be proposed", (f"write {to.profile}: docs/profile.md",))
        if not proposed.document.get("wheeled", True):
            Path(str(to.profile)).unlink(missing_ok=True)  # there is nothing in it to edit
            return Stop(
                "; ".join(proposed.document["problems"]),
                ("give recordings of a robot on wheels",),
            )
        if problems := proposed.document.get("problems"):
            told = (f"edit {to.profile}: its first lines list what is missing", again)
            if proposed.document.get("missing"):
                told = (
                    "give recordings that contain it; or, if a topic in these recordings does, "
                    f"edit {to.profile}, whose first lines list the topics",
                    again,
                )
            if any(ODOMETRY in problem for problem in problems):
                told = (f"add {ODOMETRY} to this command, or {told[0]}", again)
            return Stop("; ".join(problems), told)
        if (kinds := proposed.document.get("kinds")) and not asked.accept:
            return several_kinds(kinds, asked.out)
        driving = proposed.document.get("commands", [])
        if driving and not asked.accept:
            return Stop(
                f"several topics may be the command that drives the robot: {', '.join(driving)}; "
                "the profile uses the first",
                (
                    f"edit `topic` of [inputs.command] in {to.profile}, and run the same command"
                    " again",
                    "or add --accept to it, if the first one is right",
                ),
            )
    elif asked.urdf is not None or asked.footprint is not None:
        work.say(
            f"   [yellow]{escape(str(to.profile))} was edited: --urdf and --footprint apply only "
            "to a proposed profile, and have no effect[/]"
        )
    if others := [] if own or work.plan else of_other_kinds(asked.out):
        mine = [row for row in readable if row["path"] not in others]
        to = replace(to, logs=tuple(row["path"] for row in mine))
        recording = fullest({"recordings": mine}) or recording
    checked = work.do(stages.check(to, recording))
    if not checked.good:
        known = "; if it is of another robot, give only the recordings of this one"
        return Stop(
            f"the profile does not fit {recording}",
            (f"edit {to.profile}{known if len(readable) > 1 else ''}", again),
        )
    if not work.plan:
        work.say(f"   the robot in the twin: {escape(robot_line(to.profile))}")
    ingested = work.do(stages.ingest(to))
    if not ingested.good:
        return Stop("nothing could be ingested", (f"edit {to.profile}", again))
    covered = work.do(stages.coverage(to))
    work.do(stages.audit(to))
    mixed = work.do(stages.mix(to))
    if not mixed.good:
        return Stop(
            "the mixture does not fit these logs",
            (
                "write one that fits (docs/mixture.md), and add --mixture FILE to the command",
                again,
            ),
        )
    twin = asked.twin != "no"
    settings = practice_settings(to.profile)
    if twin:
        floor = work.do(stages.floor(to))
        if not floor.good and to.map is not None:
            sized = ("measure the robot, and add --footprint LxW to this command",)
            return Stop(
                f"{to.map} cannot be the floor of these recordings",
                (
                    *(sized if any("--footprint" in why for why in floor.errors) else ()),
                    "give the map.yaml in which the robot was localised, or leave out --map: the "
                    "floor is then made from the recordings",
                    again,
                ),
            )
        if floor.good:
            settings += floor_settings(to, floor.document)
        horizon_s = horizon(to.profile)
        fitted = work.do(stages.fit(to, horizon_s))
        if fitted.good:
            settings.append(f"env.perturbation={to.fitted}")
        gap = work.do(stages.gap(to, horizon_s, fitted=fitted.good))
        why, remedy = no_room(floor), ""
        if why is None and asked.twin != "yes" and not work.plan:
            why, remedy = mistrust(floor, gap), " (--twin yes overrides)"
        if why is not None:
            work.say(f"   [yellow]no training in the twin{remedy}: {escape(why)}[/]")
            twin = False
    if not twin:
        settings = logs_alone_settings(covered.document)
    settings += updates_settings(mixed.document, asked.minutes, twin=twin, seconds=to.seconds)
    to = replace(to, train=tuple(settings))
    trained = work.do(stages.train(to, twin=twin))
    if not trained.good:
        return Stop("training did not finish", (*trained.errors[:2], again))
    judged = []
    if twin:
        goal = has_goal(to.profile)
        if goal and floor.good:
            judged.append(work.do(stages.evaluate_on_ways(to)))
        judged.append(work.do(stages.evaluate(to, goal=goal)))
    if work.plan or any(HELD_OUT in why for why in mixed.document["left_out"]):
        judged.append(work.do(stages.judge(to)))
    else:
        work.say(
            "\n[yellow]These logs are too short to hold any of them out, so the policy cannot be "
            "evaluated. Ingest more recordings.[/]"
        )
    reported = work.do(stages.report(to))
    if not reported.good:
        return Stop("there is no report", (again,))
    if failed := [ended for ended in judged if not ended.good]:
        why_failed = [one for ended in failed for one in ended.errors[:1]]
        names = " and ".join(f"`{ended.command}`" for ended in failed)
        return Stop(f"the report lacks the stages that failed: {names}", (*why_failed, again))
    return None


__all__ = ["StartCommand"]
