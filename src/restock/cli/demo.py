"""`restock demo`: the whole way once, on recordings that come with Restock."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from restock.cli.output import stdout


@dataclass
class Demo:
    """Run every stage on sample_logs/, say what each does and why, and end with a report.

    Takes recordings through info, ingest, sql, audit, mix, train, eval and report: at most five
    minutes on two cores. Every stage shows the command that it runs, so that you can run it on
    recordings of your own.

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
        import shlex
        import sys

        from restock.cli import main
        from restock.cli.output import print_json
        from restock.demo import Stage, find_logs, prepare, run_demo, stages

        logs = self.logs or find_logs()
        plan = []
        if logs is None:
            logs = self.out / "logs"
            record = ["record", "--out", str(logs / "sample.mcap"), "--missions", "60"]
            why = "No sample recordings beside this installation: the stand-in drives some."
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
