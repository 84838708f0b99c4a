"""`restock start`: from a user's recordings to a policy and a report, stage by stage."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from restock.cli.output import print_json, stderr, stdout
from restock.cli.start import decisions, stages
from restock.cli.start.decisions import NO_ROOM, Stop
from restock.cli.start.outcomes import Document
from restock.cli.start.stages import Settings
from restock.cli.start.work import StageResult, Work, escape, make_printer
from restock.cli.words import Option, Positional, Repeated
from restock.errors import ConfigError, ExitCode, RecordingError, quoted

HELD_OUT = "evaluation split"  # in a panel's reason for rows that it holds out to evaluate on
AGAIN = "then run the same command again: finished stages are kept"
SALVAGING = "add --salvage to this command: it reads what is intact in damaged recordings"


class Pipeline:
    """The stages from recordings to a report, run one after the other.

    `to` has the settings that the stages share; later stages get settings that earlier ones found.
    `first` is one of the recordings, for the commands of a dry run, which reads no recording.
    """

    def __init__(self, requested: StartCommand, work: Work, first: str | None = None) -> None:
        self.requested, self.work = requested, work
        self.first = requested.paths[0] if first is None else first
        self.to = Settings(
            logs=requested.paths,
            out=requested.out,
            profile=requested.profile or requested.out / "profile.toml",
            seconds=30.0 * requested.minutes,
            episodes=max(round(4 * requested.minutes), 1),
            mixture=requested.mixture,
            definitions=requested.definitions,
            salvage=requested.salvage,
            tags=requested.tag,
            map=requested.map,
        )

    def go(self) -> Stop | None:
        """Run all stages; return a Stop if a person must decide, else None."""
        try:
            readable = self._recordings()
            self._profile(readable)
            coverage, panel = self._panel()
            twin = self._twin()
            self._policy(twin, coverage, panel)
            self._judge(twin, panel)
        except Stop as stop:
            return stop
        return None

    def _warn(self, text: str) -> None:
        self.work.say(f"   [yellow]{escape(text)}[/]")

    def _recordings(self) -> list[Document]:
        """Return the recordings that can be read, as `restock info` describes them."""
        found = self.work.do(stages.info(self.to))
        readable = list(found.document.get("recordings", ()))
        if not (found.good or readable):
            damaged = any("--salvage" in why for why in found.errors)
            other = "give other recordings: the messages above say why"
            raise Stop("no recording can be read", SALVAGING if damaged else other)
        if not found.good:
            intact = f"the {len(readable)} that can be read"
            self.work.say(f"   continuing with {intact}; or {SALVAGING}")
        return readable

    def _longest(self, recordings: list[Document]) -> str:
        """Return the path of the longest of these recordings; `self.first` if there are none."""
        times = {row["path"]: row["duration_s"] or 0.0 for row in recordings}
        return str(max(times, key=times.__getitem__, default=self.first))

    def _profile(self, readable: list[Document]) -> None:
        """Take the user's profile or propose one, and check it against a recording."""
        requested, to = self.requested, self.to
        recording = self._longest(readable)
        own = requested.profile is not None
        if not own and not decisions.edited(to.profile, requested.out):
            self._propose(requested.paths if len(readable) != 1 else (recording,))
        elif requested.urdf is not None:
            self._warn(f"--urdf can only change a proposal, and has no effect on {to.profile}")
        left_out, base = ([], None) if own or self.work.plan else decisions.proposal(requested.out)
        mine = [row for row in readable if row["path"] not in left_out]
        if len(mine) < len(readable):
            self.to = to = replace(to, logs=tuple(row["path"] for row in mine))
            recording = self._longest(mine)
        checked = self.work.do(stages.check(to, base or recording))
        if not checked.good:
            raise Stop(f"the profile does not fit {base or recording}", f"edit {to.profile}", AGAIN)
        outline = decisions.stop_for_outline(checked.document, to.profile)
        if outline is not None and not requested.accept:
            raise outline

    def _propose(self, sources: tuple[str, ...]) -> None:
        requested, to = self.requested, self.to
        flags = [] if requested.urdf is None else ["--urdf", str(requested.urdf)]
        flags.append("--hindsight-goals")  # without a goal there is no success to train for
        proposed = self.work.do(stages.propose(to, sources, flags, requested.urdf))
        if not proposed.good:
            raise Stop("no profile can be proposed", f"write {to.profile}: docs/profile.md")
        document = proposed.document
        if problems := document.get("problems"):
            raise Stop(
                "; ".join(problems),
                f"edit {to.profile}, whose first lines list the topics and what is missing; or give"
                " recordings that contain it, or a profile of your own (--profile)",
                AGAIN,
            )
        if requested.accept:
            return
        if kinds := document.get("kinds"):
            raise decisions.several_kinds(kinds, requested.out)
        if driving := document.get("commands", []):
            raise Stop(
                f"several topics may be the command that drives the robot: {', '.join(driving)}; "
                "the profile uses the first",
                f"edit `topic` of [inputs.command] in {to.profile}, and run the same command again",
                "or add --accept to it, if the first one is right",
            )

    def _panel(self) -> tuple[Document, Document]:
        """Ingest and mix; return the documents of coverage and panel."""
        to, do = self.to, self.work.do
        if not do(stages.ingest(to)).good:
            raise Stop("nothing could be ingested", f"edit {to.profile}", AGAIN)
        covered = do(stages.coverage(to))
        do(stages.audit(to))
        mixed = do(stages.mix(to))
        if not mixed.good:
            raise Stop(
                "the mixture does not fit these logs",
                "write one that fits (docs/mixture.md), and add --mixture FILE to the command",
                AGAIN,
            )
        return covered.document, mixed.document

    def _twin(self) -> StageResult | None:
        """Make the floor and fit the twin; return the floor, or None to train on logs alone."""
        requested, to = self.requested, self.to
        if requested.twin == "no":
            return None
        floor = self.work.do(stages.floor(to))
        if not floor.good and to.map is not None:
            raise Stop(
                f"{to.map} cannot be the floor of these recordings",
                *floor.errors[:1],
                "give the map.yaml in which the robot was localised, or leave out --map: the "
                "floor is then made from the recordings",
                AGAIN,
            )
        settings = ["practice.rule=success"] if decisions.has_goal(to.profile) else []
        if floor.good:
            kinds, unseen = decisions.split_kinds(to, floor.document)
            settings += decisions.floor_settings(to, kinds)
            if unseen:
                names = ", ".join(unseen).replace("_", " ")
                self._warn(
                    f"no missions of {names}: without a lidar, a robot finds a block only by "
                    "driving into it"
                )
                to = replace(to, kinds=tuple(kinds))
        horizon_s = decisions.horizon(to.profile)
        fitted = self.work.do(stages.fit(to, horizon_s)).good
        gap = self.work.do(stages.gap(to, horizon_s, fitted=fitted))
        if fitted:
            settings.append(f"env.perturbation={to.fitted}")
        nothing = floor.good and floor.document.get("episodes") == []
        why, remedy = NO_ROOM if nothing else None, ""
        if why is None and requested.twin != "yes" and not self.work.plan:
            why, remedy = decisions.explain_mistrust(floor, gap), " (--twin yes overrides)"
        if why is not None:
            self._warn(f"no training in the twin{remedy}: {why}")
            return None
        self.to = replace(to, train=tuple(settings))
        return floor

    def _policy(self, floor: StageResult | None, coverage: Document, panel: Document) -> None:
        requested, twin = self.requested, floor is not None
        settings = [*self.to.train] if twin else decisions.logs_alone_settings(coverage)
        settings += decisions.updates_settings(
            panel, requested.minutes, twin=twin, seconds=self.to.seconds
        )
        self.to = replace(self.to, train=tuple(settings))
        trained = self.work.do(stages.train(self.to, twin=twin))
        if not trained.good:
            raise Stop("training did not finish", *trained.errors[:2], AGAIN)

    def _judge(self, floor: StageResult | None, panel: Document) -> None:
        """Evaluate in the twin and on held-out logs, and write the report."""
        to, do, judged = self.to, self.work.do, []
        if floor is not None:
            judged.append(do(stages.evaluate(to, "cloned")))
        if self.work.plan or any(HELD_OUT in why for why in panel["left_out"]):
            judged.append(do(stages.judge(to)))
        else:
            self.work.say(
                "\n[yellow]These logs are too short to hold any of them out, so the policy cannot "
                f"be evaluated{'' if floor is None else ' on logs'}. Ingest more recordings.[/]"
            )
        if not do(stages.report(to)).good:
            raise Stop("there is no report", AGAIN)
        if failed := [ended for ended in judged if not ended.good]:
            why_failed = [one for ended in failed for one in ended.errors[:1]]
            names = " and ".join(f"`{ended.command}`" for ended in failed)
            raise Stop(f"the report lacks the stages that failed: {names}", *why_failed, AGAIN)


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

    paths: Annotated[tuple[str, ...], Positional("BAG")]
    """Recordings of one kind of robot: files, bag folders, or folders of them."""
    out: Path
    """The output folder: profile.toml, store, panel, run, and run/report.html."""
    profile: str | None = None
    """Use this existing profile; do not propose one."""
    urdf: Path | None = None
    """For the proposal: the robot's URDF. It replaces the recording's /robot_description."""
    map: Path | None = None
    """The map.yaml in which the robot was localised, if the recordings do not contain the map."""
    salvage: bool = False
    """Also read what is intact in damaged or truncated recordings."""
    tag: Annotated[tuple[str, ...], Repeated("KEY=VALUE")] = ()
    """A tag for the recordings: robot, site, or any other name. May be given several times."""
    definitions: Annotated[str | None, Option("DISTRO|PATH")] = None
    """Message definitions for recordings without their own: a ROS distribution (default: humble),
    or a folder (PACKAGE/msg/NAME.msg or .idl) or file that defines a robot's own types."""
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
    dry_run: bool = False
    """Print the commands that would run; run nothing."""
    json: bool = False
    """Print one JSON document at the end: {"stages": [{"name", "command", "status", "outcome",
    "files", "seconds", …}], "stopped", "report"}."""

    def run(self) -> int:
        """Run all stages; return 3 if a person must decide or a needed stage failed."""
        from restock.cli import main

        if not self.paths:
            raise RecordingError("no recording given", remedy="restock start BAG --out DIR")
        if not 0 < self.minutes < math.inf:
            raise ConfigError(f"must be a number above 0, got {self.minutes:g}", where="--minutes")
        self._check()
        first = self._expect_a_recording()
        say = make_printer(stderr() if self.json else stdout())
        work = Work(self.out, main, say, plan=self.dry_run)
        stopped = Pipeline(self, work, first).go()
        page = self.out / "run" / "report.html"
        reported = stopped is None or any(e.name == "report" and e.good for e in work.ended)
        if self.json:
            print_json(
                {
                    "stages": [ended.summary() for ended in work.ended],
                    "stopped": stopped and {"why": stopped.why, "remedies": list(stopped.remedies)},
                    "report": str(page) if page.exists() and reported else None,
                }
            )
        if stopped is None:
            if not self.dry_run:
                onnx = f"restock export {quoted(self.out / 'run')} --to onnx --out policy.onnx"
                say(f"\nThe policy, for the robot: {escape(onnx)} (docs/deploy.md)")
                say(f"The report: [bold]{escape(str(page))}[/bold] (open it in a browser)")
            return int(ExitCode.OK)
        say(f"\n[bold yellow]Stopped: {escape(stopped.why)}[/bold yellow]")
        for remedy in stopped.remedies:
            say(f"   {escape(remedy)}")
        sys.stdout.flush()
        return int(ExitCode.LOSSY)

    def _expect_a_recording(self) -> str:
        """Return the first recording at the paths, judged by names and first bytes of files.

        Raises:
            RecordingError: nothing at a path looks like a recording, or no file begins like one.
        """
        from restock.ingest.containers.open_recording import recordings_in, reject_non_recording

        wrong: list[RecordingError] = []
        for path in [path for name in self.paths for path in recordings_in(name)]:
            try:
                reject_non_recording(path)
                return str(path)
            except RecordingError as error:
                wrong.append(error)
        raise wrong[0]

    def _check(self) -> None:
        """Check the options and files beside the recordings, before anything is written.

        Raises:
            ConfigError, RecordingError: one of them is wrong or cannot be read.
        """
        from restock.ingest.decoding.definitions import choose_definitions
        from restock.ingest.profile.profile import load_profile
        from restock.ingest.profile.tag_rules import parse_tags
        from restock.ingest.propose.robot_choice import read_urdf
        from restock.replay.mixture.mixture import load_mixture

        parse_tags(self.tag, empty=True)
        choose_definitions(self.definitions)
        load_mixture(self.mixture)
        if self.profile is not None:
            load_profile(self.profile)
        if self.urdf is not None:
            read_urdf(self.urdf)
        if self.map is not None:
            from restock.train.twin.floors.floor_files import read_grid

            read_grid(self.map)
