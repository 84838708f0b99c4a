"""`restock demo`: the whole way in one command, on recordings that come with Restock.

Each stage says why it is there, and shows the command that does it: one that a user could type.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from restock.cli.start import stages, story
from restock.cli.start.stages import Settings, Stage
from restock.cli.start.work import Work, escape
from restock.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from rich.console import Console


@dataclass
class DemoCommand:
    """Run every stage on sample_logs/, explain each one, and end with the results and a report.

    Runs info, ingest, sql, audit, mix, train, eval and report on the recordings: about five minutes
    on two cores. Every stage shows its command, so that you can run it on your own recordings. The
    results compare the policy before and after fine-tuning with one that was fed uniformly, show
    what the critic was fed of each condition, and follow one rare event from its message to an
    update.

    Example: `restock demo --out build/demo`
    """

    out: Path = Path("restock-demo")
    """The folder for store, panel, run and report. Stages that an earlier call finished there are
    kept."""
    logs: Path | None = None
    """Recordings to use. Default: sample_logs/ of the source tree; if it is missing, the demo
    records some."""
    profile: str | None = None
    """How topics become signals: the name of a shipped profile, or a TOML file. Default: the
    profile of the simulated robot (`restock start` proposes one for another robot)."""
    seconds: float = 200.0
    """Training time in seconds. Two policies train at the same time: one fed by quotas, one fed
    uniformly."""
    episodes: int = 20
    """Evaluation episodes per kind of episode, policy and perturbation."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the network trains."""
    dry_run: bool = False
    """Print the commands that would run; run nothing."""
    json: bool = False
    """At the end, print {"stages": [{"name", "command", "status", …}], "report"} as JSON."""

    def run(self) -> int:
        from restock.cli import main
        from restock.cli.output import print_json, stderr, stdout

        if not 0 < self.seconds < math.inf:
            raise ConfigError(f"must be a number above 0, got {self.seconds:g}", where="--seconds")
        if self.episodes < 1:
            raise ConfigError(f"must be at least 1, got {self.episodes}", where="--episodes")
        self._check()
        to, plan = self._plan()
        console = stderr() if self.json else stdout()

        def say(line: str) -> None:
            console.print(line, soft_wrap=True)
            console.file.flush()  # what is on stderr comes after it

        work = Work(self.out, main, say, plan=self.dry_run, explain=True)
        if not self.dry_run:
            say(f"[bold]What you are about to see[/bold]\n\n{story.OPENING}")
        for stage in plan:
            ended = work.do(stage)
            if not ended.good:
                return ended.exit_code or int(ExitCode.ERROR)
        report = to.run / "report.html"
        if self.json:
            print_json({"stages": work.summary(), "report": str(report)})
        elif not self.dry_run:
            tell(to, console)
            say(f"\nThe report: [bold]{escape(str(report))}[/bold] (open it in a browser)")
        return int(ExitCode.OK)

    def _check(self) -> None:
        """Raise RestockError if the user's recordings or profile cannot be found or read."""
        from restock.ingest.containers.discover import recordings_in
        from restock.ingest.profile.profile import load_profile

        if self.logs is not None:
            recordings_in(self.logs)
        if self.profile is not None:
            load_profile(self.profile)

    def _plan(self) -> tuple[Settings, list[Stage]]:
        """Return what the stages share, and the stages."""
        logs, record = self.logs or find_logs(), []
        if logs is None:
            logs = self.out / "logs"
            record.append(stages.record(logs))
        to = Settings(
            logs=(str(logs),),
            out=self.out,
            profile=self.profile,
            seconds=self.seconds,
            episodes=self.episodes,
            device=self.device,
            train=("practice.rule=success",),
        )
        return to, record + plan_of(to)


def tell(to: Settings, console: Console) -> None:
    """Print the results, read from what the stages wrote."""
    from restock.cli.output import print_table

    def show(title: str, lines: list[str]) -> None:
        if lines:
            console.print(f"\n[bold]{title}[/bold]")
            for line in lines:
                console.print(line, markup=False, soft_wrap=True)
        sys.stdout.flush()

    if rows := story.before_and_after(to):
        console.print("\n[bold]Before and after fine-tuning[/bold]")
        console.print(
            "[dim]Missions that reached their goal without a contact; in brackets, in percent,"
            " what\nother missions of the kind might give (95 %).[/dim]"
        )
        print_table(rows)
        console.print(story.trained(to))
    show("What the critic was fed", story.shelves(to.run))
    show("Failing before, arriving after: films", story.films(to))
    show("One rare event, from its message to an update", story.rare_event(to))
    show("What to try next", story.next_steps(to))


def plan_of(to: Settings) -> list[Stage]:
    """Return the stages of the demo, in order."""
    return [
        stages.info(to),
        stages.ingest(to),
        stages.coverage(to),
        stages.audit(to),
        stages.mix(to),
        stages.mix_uniform(to),
        stages.train_on_logs(to),
        stages.train_beside_uniform(to),
        stages.even_out(to),
        stages.evaluate_logs_alone(to),
        stages.evaluate_beside_uniform(to),
        stages.film(to),
        stages.report(to),
    ]


def find_logs() -> Path | None:
    """Return `sample_logs/` of the source tree that this code runs from, if it runs from one."""
    here = Path(__file__).resolve()
    logs = here.parents[4] / "sample_logs"
    if not logs.is_dir() or not any(logs.iterdir()):
        return None
    return logs.relative_to(Path.cwd()) if logs.is_relative_to(Path.cwd()) else logs
