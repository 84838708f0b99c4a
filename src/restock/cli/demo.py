"""`restock demo`: the whole way in one command, on recordings that come with Restock.

Each stage says what it does and why, and the command that does it. A stage is a command line that
a user could type; the demo runs the very same code.
"""

from __future__ import annotations

import shlex
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from restock.errors import ExitCode, RestockError

MARKER = ".restock-demo"

COVERAGE = (
    "SELECT condition, rows, share, episodes, success_share, behaviour_policies"
    " FROM coverage_by_condition"
)


@dataclass
class DemoCommand:
    """Run every stage on sample_logs/, explain each, and end with a report.

    Takes recordings through info, ingest, sql, audit, mix, train, eval and report: at most five
    minutes on two cores. Every stage shows its command, so that you can run it on
    your own recordings.

    Example: `restock demo --out build/demo`
    """

    out: Path = Path("restock-demo")
    """Where store, panel, run and report go. What an earlier demo left there is replaced."""
    logs: Path | None = None
    """Recordings to use; default sample_logs/ of the source tree, else newly recorded ones."""
    seconds: float = 150.0
    """How long to train."""
    episodes: int = 20
    """Evaluation episodes per kind, policy and perturbation."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the network trains."""
    dry_run: bool = False
    """Print the commands that would run, and run none."""
    json: bool = False
    """At the end, print {"report", "store", "panel", "run"} as JSON."""

    def run(self) -> int | None:
        from restock.cli import main
        from restock.cli.output import print_json, stdout

        logs = self.logs or find_logs()
        plan = []
        if logs is None:
            logs = self.out / "logs"
            record = ["record", "--out", str(logs / "sample.mcap"), "--missions", "60"]
            why = "This installation has no sample recordings: a simulated robot drives some."
            plan.append(Stage("Record", why, record))
        plan += stages(logs, self.out, self.seconds, self.episodes, self.device)
        if self.dry_run:
            sys.stdout.writelines(f"restock {shlex.join(stage.command)}\n" for stage in plan)
            return None
        prepare(self.out)
        console = stdout()
        code = run_demo(plan, main, say=console.print)
        if code:
            return code
        report = self.out / "run" / "report.html"
        if self.json:
            parts = {name: str(self.out / name) for name in ("store", "panel", "run")}
            print_json({"report": str(report), **parts})
        else:
            console.print(f"The report: [bold]{report}[/bold] (open it in a browser)")
        return None


@dataclass(frozen=True)
class Stage:
    """One step of the demo."""

    title: str
    why: str
    command: list[str]
    expected: tuple[int, ...] = (0,)  # exit codes that do not stop the demo
    remark: str = ""  # printed where the exit code is not 0


def stages(logs: Path, out: Path, seconds: float, episodes: int, device: str) -> list[Stage]:
    """The stages, from recordings to a report."""
    store, panel, run = out / "store", out / "panel", out / "run"
    return [
        Stage(
            "What is in these recordings?",
            "The recordings come first: topics, types, counts, durations.",
            ["info", str(logs)],
        ),
        Stage(
            "Recordings to labelled transitions",
            "Topics become steps of the control clock (held causally, never interpolated), steps"
            " become observation, action and reward, and SQL labels each with its conditions."
            " These recordings contain the true condition, so the labels are scored.",
            ["ingest", str(logs), "--store", str(store)],
            expected=(0, 3),
            remark="some data was lost or skipped: see the table above",
        ),
        Stage(
            "What is on each shelf?",
            "Hours of the easy aisle, seconds of the wet floor: the store is plain Parquet, and"
            " the question is plain SQL.",
            ["sql", str(store), COVERAGE],
        ),
        Stage(
            "Is the coverage good enough?",
            "Each audit is a query that returns the offending rows. In a pipeline the exit code"
            " stops you here.",
            ["audit", str(store)],
            expected=(0, 1),
            remark="an audit failed: a pipeline would stop here, the demo goes on",
        ),
        Stage(
            "A replay panel that keeps the rare conditions in stock",
            "Each shelf has the whole episodes that met its condition. Natural, wanted, drawn and"
            " after weights stand side by side, and what is missing is told in rows and hours of"
            " logging; the result is a pinned panel with an id.",
            ["mix", str(store), "--mixture", "coverage", "--out", str(panel)],
        ),
        Stage(
            "Train: first on the panel, then online in the twin",
            f"About {seconds:.0f} s of double DQN. Half of each batch comes from the logs by"
            " quotas, half is fresh, of missions that go wrong more often. Q chooses among what"
            " the twin's operator finds plausible. Every row the critic is fed is recorded.",
            [
                *("train", "--panel", str(panel), "--out", str(run)),
                *("--seconds", f"{seconds:g}", "--device", device),
                *("--set", "practice.rule=success"),
            ],
        ),
        Stage(
            "Evaluate on the same seeded episodes",
            "The kept checkpoint, the scripted planner and a random policy, clean and with less"
            " friction and more latency than in training.",
            ["eval", str(run), "--episodes", str(episodes)],
        ),
        Stage(
            "One page with all of it",
            "What it was fed, what it learnt, where it fails.",
            ["report", str(run)],
        ),
    ]


def run_demo(
    plan: list[Stage], dispatch: Callable[[list[str]], int], *, say: Callable[[str], None]
) -> int:
    """Run the stages in order; stops at the first unexpected exit code and returns it."""
    began = time.monotonic()
    for number, stage in enumerate(plan, start=1):
        say(f"\n[bold]{number}/{len(plan)}  {stage.title}[/bold]")
        say(f"[dim]{stage.why}[/dim]")
        say(f"[cyan]$ restock {shlex.join(stage.command)}[/cyan]\n")
        sys.stdout.flush()
        started = time.monotonic()
        code = dispatch(stage.command)
        sys.stdout.flush()
        if code not in stage.expected:
            return code
        if code:
            say(f"[yellow]exit code {code}: {stage.remark}[/yellow]")
        say(f"[dim]{time.monotonic() - started:.1f} s[/dim]")
    say(f"\n[bold]Done in {time.monotonic() - began:.0f} s.[/bold]")
    return int(ExitCode.OK)


def find_logs() -> Path | None:
    """`sample_logs/` of the source tree that this code runs from, if it runs from one."""
    here = Path(__file__).resolve()
    logs = here.parents[3] / "sample_logs"
    return logs if logs.is_dir() and any(logs.iterdir()) else None


def prepare(out: Path) -> None:
    """An empty directory for the demo; one that an earlier demo left is replaced.

    Raises:
        RestockError: there is something at `out` that no demo made.
    """
    if out.exists() and not (out / MARKER).exists() and (not out.is_dir() or any(out.iterdir())):
        raise RestockError(
            "already exists, and not from a demo",
            where=str(out),
            remedy="give another --out",
        )
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    (out / MARKER).write_text("made by `restock demo`, which may replace it\n", encoding="utf-8")
