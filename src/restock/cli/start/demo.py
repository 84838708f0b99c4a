"""`restock demo`: the whole way in one command, on recordings that come with Restock.

Each stage says what it does and why, and the command that does it. A stage is a command line that
a user could type; the demo runs the very same code.
"""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from restock.cli.start import stages, story
from restock.cli.start.stages import Settings, Stage
from restock.cli.start.work import escape
from restock.errors import ConfigError, ExitCode, RestockError

if TYPE_CHECKING:
    from rich.console import Console

MARKER = ".restock-demo"
LAST_LINES = 20  # shown of a command that runs beside another and fails


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
    """The folder for store, panel, run and report. The output of an earlier demo there is
    replaced."""
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
    """At the end, print {"report", "store", "panel", "run"} as JSON."""

    def run(self) -> int | None:
        from restock.cli import main
        from restock.cli.output import print_json, stdout

        if not 0 < self.seconds < math.inf:
            raise ConfigError(f"must be a number above 0, got {self.seconds:g}", where="--seconds")
        if self.episodes < 1:
            raise ConfigError(f"must be at least 1, got {self.episodes}", where="--episodes")
        logs = self.logs or find_logs()
        plan = []
        if logs is None:
            logs = self.out / "logs"
            record = ["twin", "record", "--out", str(logs / "sample.mcap"), "--missions", "60"]
            why = "This installation has no sample recordings: a simulated robot records some."
            plan.append(Stage("record", "Record", why, record))
        to = Settings(
            logs=(str(logs),),
            out=self.out,
            profile=self.profile,
            seconds=self.seconds,
            episodes=self.episodes,
            device=self.device,
            train=("practice.rule=success",),
        )
        plan += plan_of(to)
        if self.dry_run:
            sys.stdout.writelines(f"{stage.line()}\n" for stage in plan)
            return None
        prepare(self.out, self._given())
        console = stdout()
        if not self.json:
            console.print(f"[bold]What you are about to see[/bold]\n\n{story.OPENING}")
        code = run_demo(plan, main, say=console.print)
        if code:
            return code
        report = self.out / "run" / "report.html"
        if self.json:
            parts = {name: str(self.out / name) for name in ("store", "panel", "run")}
            print_json({"report": str(report), **parts})
        else:
            tell(to, console)
            console.print(
                f"\nThe report: [bold]{escape(str(report))}[/bold] (open it in a browser)"
            )
        return None

    def _given(self) -> list[Path]:
        """Return the user's own files, which must exist: the recordings and the profile.

        Raises:
            RestockError: they cannot be found or read.
        """
        from restock.ingest.containers.discover import recordings_in
        from restock.ingest.profile.profile import load_profile

        given = [] if self.logs is None else [self.logs, *recordings_in(self.logs)]
        if self.profile is not None:
            load_profile(self.profile)
            given += [Path(self.profile)] if Path(self.profile).is_file() else []
        return given


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


def run_demo(
    plan: list[Stage], dispatch: Callable[[list[str]], int], *, say: Callable[[str], None]
) -> int:
    """Run the stages in order; stops at the first unexpected exit code and returns it."""
    began = time.monotonic()
    for number, stage in enumerate(plan, start=1):
        say(f"\n[bold]{number}/{len(plan)}  {stage.title}[/bold]")
        say(f"[dim]{stage.why}[/dim]")
        if stage.decided is not None:
            command = stage.decided()
            if command is None:
                say("[dim]They already have: nothing to do.[/dim]")
                continue
            stage = replace(stage, command=command)
        say(f"[cyan]$ {escape(stage.line())}[/cyan]\n")
        sys.stdout.flush()
        started = time.monotonic()
        with _beside(stage, say) as other:
            code = dispatch(stage.command)
            sys.stdout.flush()
            code = code if code not in stage.expected else other() or code
        if code not in stage.expected:
            return code
        if code:
            say(f"[yellow]exit code {code}: {stage.remark}[/yellow]")
        say(f"[dim]{time.monotonic() - started:.1f} s[/dim]")
    say(f"\n[bold]Done in {time.monotonic() - began:.0f} s.[/bold]")
    return int(ExitCode.OK)


@contextmanager
def _beside(stage: Stage, say: Callable[[str], None]) -> Iterator[Callable[[], int]]:
    """Run a stage's other command in a process of its own; yields what waits for its exit code.

    Its output is shown if it fails. It does not outlive the block.
    """
    if not stage.beside:
        yield lambda: int(ExitCode.OK)
        return
    environment = os.environ | {"OMP_NUM_THREADS": "1"}  # beside another, each has a core
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "restock", *stage.beside],
            stdout=subprocess.DEVNULL,
            stderr=said,
            env=environment,
        )

        def wait() -> int:
            if code := process.wait():
                said.seek(0)
                say(f"[red]beside it: {escape(stage.line().splitlines()[0])}[/red]")
                sys.stderr.write("".join(said.readlines()[-LAST_LINES:]))
            return code

        try:
            yield wait
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()


def find_logs() -> Path | None:
    """`sample_logs/` of the source tree that this code runs from, if it runs from one."""
    here = Path(__file__).resolve()
    logs = here.parents[4] / "sample_logs"
    if not logs.is_dir() or not any(logs.iterdir()):
        return None
    return logs.relative_to(Path.cwd()) if logs.is_relative_to(Path.cwd()) else logs


def prepare(out: Path, given: Sequence[Path] = ()) -> None:
    """Make an empty directory for the demo, in place of what an earlier demo left.

    Raises:

    Raises:
        RestockError: there is something at `out` that no demo made, or that is one of the user's
            files that were given.
    """
    for path in given:  # by its name too: a link in `out` to a file elsewhere would be lost
        if path.absolute().is_relative_to(out.absolute()) or path.resolve().is_relative_to(
            out.resolve()
        ):
            raise RestockError(
                f"is inside --out {out}, which the demo replaces",
                where=str(path),
                remedy="choose another --out",
            )
    if out.exists() and not (out / MARKER).exists() and (not out.is_dir() or any(out.iterdir())):
        raise RestockError(
            "already exists, and was not made by a demo",
            where=str(out),
            remedy="choose another --out",
        )
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    (out / MARKER).write_text("made by `restock demo`, which may replace it\n", encoding="utf-8")
