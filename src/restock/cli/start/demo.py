"""`restock demo`: all stages in one command, on recordings that come with Restock.

Each stage prints its purpose, and its command as a user could type it.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from restock.cli.output import print_json, print_table, stderr, stdout
from restock.cli.start import stages
from restock.cli.start.outcomes import Document
from restock.cli.start.stages import Settings, Stage
from restock.cli.start.work import Work, escape, make_printer
from restock.errors import ConfigError, ExitCode, policy_words, quoted
from restock.stats import interval_text

if TYPE_CHECKING:
    from rich.console import Console


@dataclass
class DemoCommand:
    """Run every stage on sample_logs/, explain each one, and end with the results and a report.

    Runs info, ingest, sql, audit, mix, train, eval and report on the recordings: about five minutes
    on two cores. Every stage shows its command, and `restock start` takes your own recordings. The
    results compare the policy before and after fine-tuning with one that was fed uniformly, show
    what the critic was fed of each condition, and follow one rare event from its message to an
    update.

    Example: `restock demo --out build/demo`
    """

    out: Path = Path("restock-demo")
    """The folder for store, panel, run and report. Stages that an earlier call finished there are
    kept."""
    env_steps: int = 48_000
    """Steps in the twin of each training. Two policies train at the same time: one fed by quotas,
    one fed uniformly."""
    episodes: int = 20
    """Evaluation episodes per kind of episode, policy and perturbation."""
    dry_run: bool = False
    """Print the commands that would run; run nothing."""
    json: bool = False
    """At the end, print {"stages": [{"name", "command", "status", …}], "report"} as JSON."""

    def run(self) -> int:
        from restock.cli import main

        for name in ("env_steps", "episodes"):
            if (given := getattr(self, name)) < 1:
                option = f"--{name.replace('_', '-')}"
                raise ConfigError(f"must be at least 1, got {given}", where=option)
        found = find_logs()
        to = Settings(
            (str(found or self.out / "logs"),),
            self.out,
            episodes=self.episodes,
            train=("practice.rule=success", f"schedule.env_steps={self.env_steps}"),
        )
        plan = plan_of(to)
        if found is None:
            file = self.out / "logs" / "sample.mcap"
            command = ["twin", "record", "--out", str(file), "--missions", "60"]
            plan.insert(0, Stage("record", "Record", command, writes=(file.parent,)))
        console = stderr() if self.json else stdout()
        say = make_printer(console)
        work = Work(self.out, main, say, plan=self.dry_run, why=WHY)
        for stage in plan:
            ended = work.do(stage)
            if not ended.good:
                return ended.exit_code or int(ExitCode.USAGE)
        report = to.run / "report.html"
        if self.json:
            print_json({"stages": [ended.summary() for ended in work.ended], "report": str(report)})
        elif not self.dry_run:
            evaluated = next(ended for ended in work.ended if ended.name == "eval")
            print_results(to, evaluated.document, console)
            say(f"\nThe report: [bold]{escape(str(report))}[/bold] (open it in a browser)")
        return int(ExitCode.OK)


def find_logs() -> Path | None:
    """Return `sample_logs/` of this source tree; None if it has no logs, or is an installation."""
    here = Path(__file__).resolve()
    logs = here.parents[4] / "sample_logs"
    if not logs.is_dir() or not any(logs.iterdir()):
        return None
    return logs.relative_to(Path.cwd()) if logs.is_relative_to(Path.cwd()) else logs


def logs_alone(to: Settings) -> Path:
    """Return the folder of the run on logs alone, the baseline for fine-tuning in the twin."""
    return to.out / "logs-alone"


def fed_uniformly(to: Settings) -> Path:
    """Return the folder of the run that draws its rows uniformly."""
    return to.out / "fed-uniformly"


def plan_of(to: Settings) -> list[Stage]:
    """Return the stages of the demo, in order."""
    uniform_panel, uniform, alone = to.out / "panel-uniform", fed_uniformly(to), logs_alone(to)
    settings = "env.twin=false", "teacher.source=logs", f"schedule.offline_updates={UPDATES}"
    return [
        stages.info(to),
        stages.ingest(to),
        stages.coverage(to),
        stages.audit(to),
        stages.mix(to),
        Stage(
            "mix-uniform",
            "The same logs as they are, to compare with",
            ["mix", str(to.store), "--mixture", "uniform", "--out", str(uniform_panel)],
            writes=(uniform_panel,),
        ),
        Stage(
            "logs-alone",
            "Before fine-tuning: a policy from the logs alone",
            replace(to, train=settings).training(to.panel, alone),
            writes=(alone,),
        ),
        replace(
            stages.train(to),
            title="Train: first on the panel, then online in the twin; beside it one fed uniformly",
            command=to.training(to.panel, to.run),
            beside=tuple(to.training(uniform_panel, uniform)),
            writes=(to.run, uniform),
            resume=(),  # not resumed: one of the two trainings may have ended
        ),
        stages.evaluate(to, f"run:{uniform}", f"run:{alone}"),
        Stage(
            "film",
            "Film failures, and missions that only the fine-tuned policy completes",
            ["eval", str(to.run), "--episodes", "0", "--video", "--policies", "agent"],
        ),
        stages.report(to),
    ]


# stage -> its purpose, printed above its command
WHY = {
    "record": "This installation has no sample recordings: a simulated robot records some.",
    "info": "The recordings come first: topics, types, counts, durations.",
    "ingest": "Topics become steps of the control clock (held causally, never interpolated). Steps"
    " become observations, actions and rewards, and SQL labels each step with its conditions. If"
    " recordings contain the true condition, the labels are scored.",
    "coverage": "Hours of the easy aisle, seconds of the wet floor: the store is plain Parquet, and"
    " the query is plain SQL.",
    "audit": "Each audit is a query that returns the offending rows. In a pipeline the exit code"
    " stops you here.",
    "mix": "Each stratum holds the whole episodes that met its condition, and gets its share of"
    " every batch. The result is a pinned panel with an id.",
    "mix-uniform": "Every row has the same probability; strata are only used for the statistics.",
    "logs-alone": "Updates on the panel, by Q among the actions that its good drivers would"
    " plausibly take; nothing is driven in the twin.",
    "train": "Two trainings at once, with the same settings, seed and number of steps. In the"
    " first, each condition gets its quota of every batch, from logs and fresh rows; in the other,"
    " logs and fresh rows are drawn uniformly. Both practise the missions that go wrong more often."
    " The policy chooses by Q among actions that the twin's operator finds plausible. Every row is"
    " recorded.",
    "eval": "The kept checkpoint, the policy fed uniformly, the one from the logs alone, the"
    " scripted planner and a random policy, clean and with less friction and more latency than in"
    " training.",
    "film": "Episodes of the evaluation, driven again: failing before on the left, and after.",
    "report": "What the policy was fed, what it learned, and where it fails.",
}


def print_results(to: Settings, evaluated: Document, console: Console) -> None:
    """Print the results, read from what the stages wrote."""
    from restock.train.evaluation.film import FOLDER
    from restock.train.run.replay_audit import fed_shares, fed_table, shortfalls
    from restock.train.run.run import Run

    def show(title: str, lines: Sequence[str]) -> None:
        if lines:
            console.print(f"\n[bold]{title}[/bold]")
            for line in lines:
                console.print(line, markup=False, soft_wrap=True)
        sys.stdout.flush()

    what = "Missions that reached their goal without a contact, with 95 % intervals."
    show("Before and after fine-tuning", [what, *SAMPLE_OF_ONE])
    print_table(before_and_after(evaluated))
    fed = fed_shares(Run.open(to.run))
    what = "Shares of all rows, in % (`FROM fed` of the run)."
    show("What the critic was fed", [what, *shortfalls(fed)])
    print_table(fed_table(fed))
    films = sorted((to.run / FOLDER).glob("*-rescue.webp"))
    show("Failing before, arriving after: films, also in the report", [str(path) for path in films])
    show("One rare event, from its message to an update", rare_event(to))
    show("What to try next", NEXT.format(store=quoted(to.store), run=quoted(to.run)).splitlines())


NEXT = """\
restock start BAG --out mine
    the same stages on your own bag or MCAP file; it proposes how topics become signals
restock sql {store} "FROM coverage_by_condition"
    your questions, in SQL: docs/sql.md lists tables and columns
restock coverage gaps {store} --mixture coverage
    what the logs lack, and which missions would fill the gaps
restock diagnose {run}
    why a critic fails: because of what it was fed, or of its target?"""

SAMPLE_OF_ONE = (
    "The agent is the fine-tuned policy. Fed uniformly has the same network, settings, seed and"
    " steps; every row of the logs has the same probability.",
    "One seed each is a sample of one: docs/evidence.md has ten, and what 128,000 steps gave.",
)
UPDATES = 2000  # of the run on logs alone: as many as other runs make before driving


def before_and_after(evaluated: Document) -> list[dict[str, str]]:
    """Return a row for each kind of mission, with each policy's success on the training floor."""
    rows = [
        row
        for row in evaluated["results"]
        if row["perturbation"] == "none" and row["policy"] != "random"
    ]
    names = policy_words(row["policy"] for row in rows)
    table: dict[str, dict[str, str]] = {}
    for row in rows:
        value = row["success"], row["success_low"], row["success_high"]
        shown = table.setdefault(row["condition"], {"mission": row["condition"]})
        shown[names[row["policy"]]] = interval_text(*value)
    return list(table.values())


def rare_event(to: Settings) -> list[str]:
    """Follow a logged row of a rare condition to its update and its recording, if there is one.

    Of the audited rows of the rarest condition, it takes the row with the largest TD error.
    """
    from restock.replay.trace.trace import trace_row
    from restock.train.run.run import Run

    rows = [
        row
        for row in Run.open(to.run).table("audit").to_pylist()
        if row["source"] == "logs" and row["condition"] not in (None, "nominal", "unlabelled")
    ]
    if not rows:
        return []
    often = Counter(row["condition"] for row in rows)
    row = max(rows, key=lambda row: (-often[row["condition"]], row["condition"], abs(row["td"])))
    name = f"{row['gradient_step']}/{row['batch_row']}"
    trace = trace_row(to.run, name)
    recorded, command = [], f"restock trace {quoted(to.run)} {name}"
    if trace.origin is not None:
        file = trace.origin.transition["source_file"]
        recorded = [f"recording  {file}, {trace.origin.moment['log_time']}"]
        command += f" --recording {quoted(file)}" if Path(file).exists() else ""
    return [
        *recorded,
        f"row        {row['transition_id']}, driven by the {row['behaviour_policy']},"
        f" labelled {row['condition']}; reward {row['reward']:.2f}",
        f"update     {row['gradient_step']:,}, drawn from the stratum {row['stratum']}: the critic"
        f" predicted {row['q']:.2f}, its target was {row['q'] - row['td']:.2f}",
        f"All of it, with the messages: {command}",
    ]
