"""`restock start`: from a stranger's bag to a policy and a report, stage by stage."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from restock.errors import ConfigError, ExitCode, RecordingError

if TYPE_CHECKING:
    from restock.cli.start.stage import Document, Stop
    from restock.cli.start.stages import Settings
    from restock.cli.start.work import Ended, Work


HELD_OUT = "evaluation split"  # of a panel's rows left out: those that judge
ODOMETRY = "--odometry-as-command"
UPDATES_A_MINUTE = 400  # on logs alone: 2,000 in five minutes, with the rest of the way
INTERVALS = 20  # at least so many points of every curve
DRIVERS = "behaviour_policies"  # of a row of the coverage


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
    typestore: str | None = None
    """Distribution whose message definitions serve recordings without their own (humble)."""
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
        """The whole way; 3 where a person must decide, 2 where a stage failed."""
        from restock.cli import main
        from restock.cli.output import print_json, stderr, stdout
        from restock.cli.start.work import Work, escape

        if not self.paths:
            raise RecordingError("no recording given", remedy="restock start BAG --out DIR")
        if self.minutes <= 0:
            raise ConfigError(f"must be above 0, got {self.minutes:g}", where="--minutes")
        console = stderr() if self.json else stdout()

        def say(line: str) -> None:
            console.print(line, soft_wrap=True)
            console.file.flush()  # what is on stderr comes after it

        work = Work(self.out, main, say, plan=self.dry_run)
        stopped = _way(self, work)
        page = self.out / "run" / "report.html"
        if self.json:
            stages = [{k: v for k, v in asdict(e).items() if k != "document"} for e in work.ended]
            print_json(
                {
                    "stages": stages,
                    "stopped": None if stopped is None else asdict(stopped),
                    "report": str(page) if page.exists() and stopped is None else None,
                }
            )
        if stopped is None:
            if not self.dry_run:
                say(f"\nThe report: [bold]{escape(str(page))}[/bold] (open it in a browser)")
            return int(ExitCode.OK)
        say(f"\n[bold yellow]Stopped: {escape(stopped.why)}[/bold yellow]")
        for remedy in stopped.remedies:
            say(f"   {escape(remedy)}")
        sys.stdout.flush()
        return int(ExitCode.LOSSY)


def _way(asked: StartCommand, work: Work) -> Stop | None:
    """Stage after stage; where a person must decide, why and what to do."""
    from restock.cli.start import stages
    from restock.cli.start.stage import Stop
    from restock.cli.start.stages import Settings
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
        map=asked.map,
    )
    found = work.do(stages.info(to))
    if not found.good:
        return Stop(
            "no recording can be read",
            (
                "name a file, a bag's folder, or a folder of bags; `restock ingest FILE --salvage"
                " --store STORE` reads what is intact of a damaged one",
            ),
        )
    recording = fullest(found.document) or asked.paths[0]

    if not own and not _edited(to.profile, asked.out):
        flags = [] if asked.footprint is None else ["--footprint", asked.footprint]
        flags += [] if asked.urdf is None else ["--urdf", str(asked.urdf)]
        flags += ["--odometry-as-command"] * asked.odometry_as_command
        several = len(found.document.get("recordings", ())) > 1
        sources = asked.paths if several else (recording,)
        proposed = work.do(stages.propose(to, sources, flags, asked.urdf))
        if not proposed.good:
            return Stop("no profile can be proposed", (f"write {to.profile}: docs/profile.md",))
        if problems := proposed.document.get("problems"):
            told = (f"edit {to.profile}: its first lines say what is missing", again)
            if any(ODOMETRY in problem for problem in problems):
                told = (f"add {ODOMETRY} to this command, or {told[0]}", again)
            return Stop("; ".join(problems), told)
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
    checked = work.do(stages.check(to, recording))
    if not checked.good:
        return Stop(
            "the profile does not fit this recording",
            (f"edit {to.profile}", again),
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
    settings = ["practice.rule=success"]
    if twin:
        floor = work.do(stages.floor(to))
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
    settings += updates_settings(mixed.document, asked.minutes, twin=twin)
    to = replace(to, train=tuple(settings))
    trained = work.do(stages.train(to, twin=twin))
    if not trained.good:
        return Stop("training did not come to its end", (*trained.errors[:2], again))
    if twin:
        goal = has_goal(to.profile)
        if goal and floor.good:
            work.do(stages.evaluate_on_ways(to))
        work.do(stages.evaluate(to, goal=goal))
    if work.plan or any(HELD_OUT in why for why in mixed.document["left_out"]):
        work.do(stages.judge(to))
    else:
        work.say(
            "\n[yellow]These logs are too short to hold any of them out: nothing says what the"
            " policy is worth. Ingest more.[/]"
        )
    reported = work.do(stages.report(to))
    return None if reported.good else Stop("there is no report", (again,))


def fullest(document: Document) -> str | None:
    """The recording that has most of what a profile needs: a command, a pose, and time."""
    from restock.ingest.propose.roles import KINDS

    def types(role: str) -> set[str]:
        return {kind.type for kind in KINDS[role]}

    def rank(row: Any) -> tuple[int, float]:
        there = {topic["type"] for topic in row["topics"].values() if topic["messages"]}
        roles = sum(bool(there & types(role)) for role in ("command", "pose", "wheels"))
        return roles, row["duration_s"] or 0.0

    rows = document.get("recordings", [])
    return str(max(rows, key=rank)["path"]) if rows else None


def _edited(profile: Path | str | None, out: Path) -> bool:
    """Whether the profile in the folder is a person's: not, byte for byte, what was proposed."""
    from restock.cli.start.work import FOLDER
    from restock.files import read_json

    path, proposed = Path(str(profile)), out / FOLDER / "propose.json"
    if not path.is_file():
        return False
    return not proposed.is_file() or read_json(proposed)["toml"] != path.read_text("utf-8")


def horizon(profile: Path | str | None) -> float:
    """Some 3 s in whole control periods: the twin's limits are of that."""
    from restock.ingest.profile.profile import load_profile

    if profile is None or (isinstance(profile, Path) and not profile.is_file()):
        return 3.0
    period_s = load_profile(str(profile)).task.control_period_s
    return round(max(round(3.0 / period_s), 1) * period_s, 6)


def has_goal(profile: Path | str | None) -> bool:
    """Whether the task has one: without, there is no success to compare."""
    from restock.ingest.profile.profile import load_profile

    if profile is None or (isinstance(profile, Path) and not profile.is_file()):
        return True
    return load_profile(str(profile)).task.goal != "none"


def no_room(floor: Ended) -> str | None:
    """Why nothing can be driven on the floor that there is; None where something can."""
    if floor.good and floor.document.get("episodes") == []:
        return "no mission fits on the floor that the recordings show"
    return None


def mistrust(floor: Ended, gap: Ended) -> str | None:
    """Why the twin is not to be trusted in nominal driving; None where it is."""
    from restock.cli.start.outcomes import of_nominal

    if not floor.good:
        return f"there is no floor to drive on: {'; '.join(floor.errors)}"
    if "nominal" not in floor.document["episodes"]:
        return "no mission fits on the floor that the recordings show"
    if not gap.good:
        return f"its gap to the logs cannot be measured: {'; '.join(gap.errors)}"
    verdict = of_nominal(gap.document)
    if verdict is None:
        return "these logs show no nominal driving"
    if verdict["verdict"] == "trusted":
        return None
    return f"in nominal driving it is {verdict['verdict']}: {'; '.join(verdict['reasons'])}"


def floor_settings(to: Settings, document: Document) -> list[str]:
    """Train on that floor, on the kinds of episode that it has room for."""
    from restock.toml import toml_value
    from restock.train.twin.env.interface import DEFAULT_CONDITIONS

    settings = [f"env.layouts={to.floor}"]
    fitting = document.get("episodes", [])
    kinds = {name: share for name, share in DEFAULT_CONDITIONS.items() if name in fitting}
    if fitting and len(kinds) < len(DEFAULT_CONDITIONS):
        settings.append(f"env.conditions={toml_value(kinds)}")
    return settings


def logs_alone_settings(coverage: Document) -> list[str]:
    """No twin, and no action that the logs' drivers would not plausibly have taken."""
    from restock.toml import toml_value

    drivers = sorted({name for row in coverage.get("rows", []) for name in row[DRIVERS] or ()})
    return ["env.twin=false", "teacher.source=logs", f"teacher.policies={toml_value(drivers)}"]


def updates_settings(mix: Document, minutes: float, *, twin: bool) -> list[str]:
    """As many offline updates as the panel's rows and the budget allow; each curve has points."""
    from restock.train.dqn.config import TrainConfig

    usual = TrainConfig()
    updates = usual.schedule.offline_updates
    if not twin:
        updates = max(round(UPDATES_A_MINUTE * minutes), INTERVALS)
    if (most := mix.get("max_replays_per_row")) is not None:
        updates = min(updates, int(mix["rows"] * most / usual.replay.batch_size))
    settings = []
    if updates != usual.schedule.offline_updates:
        settings.append(f"schedule.offline_updates={updates}")
    if not twin and updates < INTERVALS * usual.record.every_updates:
        settings.append(f"record.every_updates={max(updates // INTERVALS, 1)}")
    return settings


def robot_line(profile: Path | str | None) -> str:
    """What the twin builds, and where that is from."""
    from restock.ingest.profile.profile import load_profile

    robot = None if profile is None else load_profile(str(profile)).robot
    if robot is None:
        return "the stand-in's wheels and mass, as nothing says this one's; --urdf FILE would"
    values = {
        "wheels of": (robot.wheel_radius_m, "m radius"),
        "track": (robot.track_m, "m"),
        "mass": (robot.mass_kg, "kg"),
    }
    told = [f"{name} {value:g} {unit}" for name, (value, unit) in values.items() if value]
    origins = sorted(set(robot.origin.values()))
    own = ", ".join(told) or "the stand-in's wheels and mass"
    return f"{robot.drive}, {own} (from {', '.join(origins) or 'the profile'})"


__all__ = ["StartCommand", "fullest", "mistrust"]
