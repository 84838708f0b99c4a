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
    """From recordings of a robot to a policy for it and a report, in one command.

    Proposes a profile (OUT/profile.toml), checks it, ingests, shows the coverage, mixes a panel,
    makes the floor, fits the twin, measures whether it may be trusted, trains, evaluates and
    reports. Each stage prints the command that it is, what came of it, and its file. Where the twin
    is not to be trusted, a policy is trained on the logs alone, and judged on logs that it did not
    learn from.

    Run the same command again after an edit of OUT/profile.toml or an interruption: stages that are
    done and whose inputs are the same are not done again. Where a person must decide it stops, says
    what to type, and exits with 3.

    Example: `restock start bags/ --out mine`
    """

    paths: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="BAG")]
    """Recordings of one kind of robot: files, bag folders, or folders of them."""
    out: Path
    """Where everything goes: profile.toml, store, panel, run, and run/report.html."""
    profile: str | None = None
    """A profile that is there already, in place of a proposed one."""
    footprint: Annotated[str | None, tyro.conf.arg(metavar="LxW")] = None
    """The robot's length and width in metres, as 0.6x0.5, for the proposal."""
    urdf: Path | None = None
    """The robot's URDF, for the proposal, in place of the recording's /robot_description."""
    odometry_as_command: bool = False
    """Let the proposal take odometry for commands where none was recorded."""
    map: Path | None = None
    """The map.yaml that the robot localised in, where the recordings do not hold their map."""
    salvage: bool = False
    """Read what is intact of truncated or damaged recordings."""
    tag: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")
    ] = ()
    """Whose drives the recordings are: robot, site, or any other name. May be given several
    times."""
    typestore: str | None = None
    """Distribution whose message definitions serve recordings without their own (humble)."""
    definitions: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """A folder of .msg and .idl files (PACKAGE/msg/NAME.msg): definitions of a robot's own types,
    for recordings that carry none."""
    mixture: str = "coverage"
    """What the learner is fed: a shipped mixture's name, or a TOML file."""
    minutes: float = 5.0
    """About how long all of it may take, on two cores, once the logs are ingested: half of it is
    training."""
    twin: Literal["auto", "yes", "no"] = "auto"
    """Whether to train and evaluate in the twin: auto is where its gap to nominal driving is within
    the limits of `restock twin gap`."""
    accept: bool = False
    """Go on with the proposal as it is where it left a choice to a person."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the network trains."""
    dry_run: bool = False
    """Print the commands that would run, and run none."""
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
                "is a file", where=str(self.out), remedy="name a folder with --out: it may be new"
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

    again = f"then run the same command again: what is done is kept in {asked.out}"
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
    salvaging = "add --salvage to this command: it reads what is intact of damaged recordings"
    if not (found.good or readable):
        known = "name a file, a bag's folder, or a folder of bags"
        if any("cannot be read" in why for why in found.errors):
            known = "what can be done for each is said above; or name other recordings"
        return Stop(
            "no recording can be read",
            (salvaging if any("--salvage" in why for why in found.errors) else known,),
        )
    if not found.good:
        work.say(f"   going on with the {len(readable)} that can be read; or {salvaging}")
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
                ("name recordings of a robot on wheels",),
            )
        if problems := proposed.document.get("problems"):
            told = (f"edit {to.profile}: its first lines say what is missing", again)
            if proposed.document.get("missing"):
                told = (
                    "name recordings that hold it; or, where a topic in these does,"
                    f" edit {to.profile}, whose first lines list their topics",
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
                f"several topics may be what drives the robot: {', '.join(driving)}; the first of"
                " them was taken",
                (
                    f"edit `topic` of [inputs.command] in {to.profile}, and run the same command"
                    " again",
                    "or add --accept to it, where the first one is right",
                ),
            )
    elif asked.urdf is not None or asked.footprint is not None:
        work.say(
            f"   [yellow]{escape(str(to.profile))} is a person's: --urdf and --footprint are for a"
            " proposal, and change nothing[/]"
        )
    if others := [] if own or work.plan else of_other_kinds(asked.out):
        mine = [row for row in readable if row["path"] not in others]
        to = replace(to, logs=tuple(row["path"] for row in mine))
        recording = fullest({"recordings": mine}) or recording
    checked = work.do(stages.check(to, recording))
    if not checked.good:
        known = "; where that is of another robot, name only the recordings of this one"
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
                "write one for them (docs/mixture.md), and add --mixture FILE to the command",
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
                    "name the map.yaml that the robot localised in, or leave out --map: the floor"
                    " is then that of the recordings",
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
        return Stop("training did not come to its end", (*trained.errors[:2], again))
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
            "\n[yellow]These logs are too short to hold any of them out: nothing says what the"
            " policy is worth. Ingest more.[/]"
        )
    reported = work.do(stages.report(to))
    if not reported.good:
        return Stop("there is no report", (again,))
    if failed := [ended for ended in judged if not ended.good]:
        why_failed = [one for ended in failed for one in ended.errors[:1]]
        names = " and ".join(f"`{ended.command}`" for ended in failed)
        return Stop(f"the report is without what failed: {names}", (*why_failed, again))
    return None


__all__ = ["StartCommand"]
