"""`restock demo`: the whole way in one command, on recordings that come with Restock.

Each stage says why it is there, and shows the command that does it: one that a user could type.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from restock.cli.output import print_json, print_table, stderr, stdout
from restock.cli.start import stages
from restock.cli.start.stages import Settings, Stage
from restock.cli.start.work import Work, escape, speaker
from restock.errors import ConfigError, ExitCode, RestockError, policy_words, quoted
from restock.stats import wilson

if TYPE_CHECKING:
    from rich.console import Console

    from restock.replay.trace.trace import Trace


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
    seconds: float = 200.0
    """Training time in seconds. Two policies train at the same time: one fed by quotas, one fed
    uniformly."""
    episodes: int = 20
    """Evaluation episodes per kind of episode, policy and perturbation."""
    dry_run: bool = False
    """Print the commands that would run; run nothing."""
    json: bool = False
    """At the end, print {"stages": [{"name", "command", "status", …}], "report"} as JSON."""

    def run(self) -> int:
        from restock.cli import main

        if not 0 < self.seconds < math.inf:
            raise ConfigError(f"must be a number above 0, got {self.seconds:g}", where="--seconds")
        if self.episodes < 1:
            raise ConfigError(f"must be at least 1, got {self.episodes}", where="--episodes")
        found = find_logs()
        logs = self.out / "logs" if found is None else found
        rule = ("practice.rule=success",)
        to = Settings(
            (str(logs),), self.out, seconds=self.seconds, episodes=self.episodes, train=rule
        )
        plan = plan_of(to) if found is not None else [record(logs), *plan_of(to)]
        console = stderr() if self.json else stdout()
        say = speaker(console)
        work = Work(self.out, main, say, plan=self.dry_run, why=WHY)
        if not self.dry_run:
            say(f"[bold]What you are about to see[/bold]\n\n{OPENING}")
        for stage in plan:
            ended = work.do(stage)
            if not ended.good:
                return ended.exit_code or int(ExitCode.USAGE)
        report = to.run / "report.html"
        if self.json:
            print_json({"stages": [ended.summary() for ended in work.ended], "report": str(report)})
        elif not self.dry_run:
            tell(to, console)
            say(f"\nThe report: [bold]{escape(str(report))}[/bold] (open it in a browser)")
        return int(ExitCode.OK)


def find_logs() -> Path | None:
    """Return `sample_logs/` of the source tree that this code runs from, if it runs from one."""
    here = Path(__file__).resolve()
    logs = here.parents[4] / "sample_logs"
    if not logs.is_dir() or not any(logs.iterdir()):
        return None
    return logs.relative_to(Path.cwd()) if logs.is_relative_to(Path.cwd()) else logs


def logs_alone(to: Settings) -> Path:
    """Return the run that never drives, to compare fine-tuning with."""
    return to.out / "logs-alone"


def fed_uniformly(to: Settings) -> Path:
    """Return the run that is fed the logs as they are."""
    return to.out / "fed-uniformly"


def record(logs: Path) -> Stage:
    command = ["twin", "record", "--out", str(logs / "sample.mcap"), "--missions", "60"]
    return Stage("record", "Record", command, writes=(logs,))


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
            replace(to, train=settings).training(to.panel, alone, timed=False),
            writes=(alone,),
        ),
        replace(
            stages.train(to),
            title="Train: first on the panel, then online in the twin; beside it one fed uniformly",
            beside=tuple(to.training(uniform_panel, uniform)),
            writes=(to.run, uniform),
            resume=(),  # one of the two may have ended
        ),
        Stage(
            "even-out",
            "As many steps for both",
            ["train", "--resume", str(uniform), "--env-steps", "AS_THE_OTHER"],
            shows_progress=True,
            decided=lambda: catch_up(to),
        ),
        stages.evaluate(to, f"run:{uniform}", f"run:{alone}"),
        Stage(
            "film",
            "Film failures, and missions that only the fine-tuned policy completes",
            ["eval", str(to.run), "--episodes", "0", "--video", "--policies", "agent"],
        ),
        stages.report(to),
    ]


# stage -> why it is there
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
    "train": "Two trainings at once, with the same settings and seed. In the first, each condition"
    " gets its quota of every batch, from logs and fresh rows; in the other, logs and fresh rows"
    " are drawn uniformly. Both practise the missions that go wrong more often. The policy chooses"
    " by Q among actions that the twin's operator finds plausible. Every row is recorded.",
    "even-out": "The one that has driven less continues until both have made the same number of"
    " steps.",
    "eval": "The kept checkpoint, the policy fed uniformly, the one from the logs alone, the"
    " scripted planner and a random policy, clean and with less friction and more latency than in"
    " training.",
    "film": "Episodes of the evaluation, driven again: failing before on the left, and after.",
    "report": "What the policy was fed, what it learned, and where it fails.",
}


def catch_up(to: Settings) -> list[str] | None:
    """Continue the run that drove less: a comparison of feeds needs equally many steps."""
    steps = {path: steps_of(path) for path in (to.run, fed_uniformly(to))}
    behind, ahead = sorted(steps, key=lambda path: steps[path])
    if steps[behind] == steps[ahead]:
        return None
    longest_s = f"{10 * to.seconds + 600:g}"  # the steps end it
    budget = ("--env-steps", str(steps[ahead]), "--seconds", longest_s)
    return ["train", "--resume", str(behind), *budget]


def steps_of(run: Path) -> int:
    """Return how many steps a run made in the twin."""
    from restock.train.run.run import Run

    return max(Run.open(run).table("progress")["env_steps"].to_pylist(), default=0)


def tell(to: Settings, console: Console) -> None:
    """Print the results, read from what the stages wrote."""
    from restock.train.run.replay_audit import fed_shares, fed_table, shortfalls
    from restock.train.run.run import Run

    def show(title: str, lines: Sequence[str]) -> None:
        if lines:
            console.print(f"\n[bold]{title}[/bold]")
            for line in lines:
                console.print(line, markup=False, soft_wrap=True)
        sys.stdout.flush()

    if rows := before_and_after(to):
        what = "Missions that reached their goal without a contact; in brackets, in percent,"
        show("Before and after fine-tuning", [f"{what} what other missions might give (95 %)."])
        print_table(rows)
        console.print(steps_line(to))
    if fed := fed_shares(Run.open(to.run)):
        show("What the critic was fed, in % of all rows (`FROM fed` of the run)", shortfalls(fed))
        print_table(fed_table(fed))
    show("Failing before, arriving after: films", films(to))
    show("One rare event, from its message to an update", rare_event(to))
    show("What to try next", next_steps(to))


OPENING = """\
Recordings of a robot in a warehouse become a policy. Most of the driving is in
an easy aisle. Wet floors, blocked aisles and people who step out are rare, and
a learner hardly sees them.

  1. Recordings become rows, each labelled with what happened at that moment.
  2. Rare conditions get quotas, so that every batch contains all of them.
  3. A network learns from the logs alone: the policy before fine-tuning.
  4. Another one continues in a simulation, the twin: the policy after it.
  5. A third one continues, too, but is fed uniformly, with the logs as they are.
  6. All drive the same missions as the robot's scripted planner.

At the end you see the policies before and after, what the critic was fed of
each condition, one rare event followed from the recording's message
to the update that learned from it, and what to try with your own recordings."""

UPDATES = 2000  # of the policy from the logs alone, as many as before driving in the twin
RARE = "all rare ones"
FULL_STEPS = 128_000  # in docs/evidence.md


def before_and_after(to: Settings) -> list[dict[str, str]]:
    """Count the missions of each kind that succeeded, before and after fine-tuning.

    Beside these stand the policy fed uniformly and the planner, all on the floor that was trained
    on. Empty if the task has no goal: nothing succeeds or fails.
    """
    from restock.train.run.kept_evaluations import shown_evaluation

    rows = [row for row in shown_evaluation(to.run)[0].to_pylist() if row["perturbation"] == "none"]
    others = [f"run:{path}" for path in (logs_alone(to), fed_uniformly(to))]
    there = {row["policy"] for row in rows}
    names = policy_words(one for one in (*others, "agent", "planner") if one in there)
    driven = {n: [row for row in rows if row["policy"] == policy] for policy, n in names.items()}
    if any(row["success"] is None for of in driven.values() for row in of):
        return []
    found = {row["condition"] for of in driven.values() for row in of}
    kinds = sorted(found, key=lambda kind: (kind != "nominal", kind))
    return [
        {"mission": kind} | {name: _arrived(of, kind) for name, of in driven.items()}
        for kind in [*kinds, RARE]
    ]


def _arrived(rows: Sequence[dict[str, Any]], kind: str) -> str:
    """Count missions of a kind that arrived without a contact, with a 95 % interval."""
    of = [
        bool(row["success"])
        for row in rows
        if row["condition"] == kind or (kind == RARE and row["condition"] != "nominal")
    ]
    if not of:
        return ""
    low, high = wilson(sum(of), len(of))
    return f"{sum(of)} of {len(of)} [{100 * low:.0f}, {100 * high:.0f}]"


def steps_line(to: Settings) -> str:
    """Say how far fine-tuning came, and how the other policy was fed."""
    most, uniform = steps_of(to.run), fed_uniformly(to)
    lines = [f"The agent is the fine-tuned policy: {most:,} steps in the twin here."]
    if not most:
        lines = ["The time was up before anything was driven: give more --seconds."]
    if uniform.is_dir():
        lines += [
            "Fed uniformly has the same network, settings, seed and steps; every row of the logs"
            " has the same probability.",
            "One seed each is a sample of one: docs/evidence.md has ten, and says what"
            f" {FULL_STEPS:,} steps gave.",
        ]
    return "\n".join(lines)


def films(to: Settings) -> list[str]:
    """Return where the films are, with the failing policy beside the fine-tuned one."""
    from restock.train.evaluation.film import FOLDER

    found = [str(path) for path in sorted((to.run / FOLDER).glob("*-rescue.webp"))]
    where = "The policy that failed is on the left; the report shows them, too."
    return [*found, where] if found else []


def rare_event(to: Settings) -> list[str]:
    """Follow a logged row of a rare condition from its message to an update, if there is one."""
    row = _chosen(to.run)
    if row is None:
        return []
    from restock.replay.trace.trace import trace_row

    name = f"{row['gradient_step']}/{row['batch_row']}"
    trace = trace_row(to.run, name)
    recording = trace.origin.transition["source_file"] if trace.origin is not None else ""
    command = f"restock trace {quoted(to.run)} {name}"
    if recording and Path(recording).exists():
        command += f" --recording {quoted(recording)}"
        with suppress(RestockError):  # one that changed since is no reason to end the demo
            trace = trace_row(to.run, name, recording=Path(recording))
    return [*_told(trace, to), f"All of it: {command}"]


def _chosen(run: Path) -> dict[str, Any] | None:
    """Return the audited logged row of the rarest condition with the largest TD error."""
    from restock.train.run.run import Run

    rows = [
        row
        for row in Run.open(run).table("audit").to_pylist()
        if row["source"] == "logs" and row["condition"] not in (None, "nominal", "unlabelled")
    ]
    often = Counter(row["condition"] for row in rows)

    def rank(row: dict[str, Any]) -> tuple[int, str, float]:
        return -often[row["condition"]], row["condition"], abs(row["td"])

    return max(rows, key=rank, default=None)


def _told(trace: Trace, to: Settings) -> list[str]:
    """Write the chain, with a line or two for each link."""
    from restock.replay.panel.panel import Panel
    from restock.train.run.replay_audit import fed_shares
    from restock.train.run.run import Run

    assert trace.audit is not None
    audit, origin, run, panel = trace.audit, trace.origin, Run.open(to.run), Panel.open(to.panel)
    lines = []
    if origin is not None:
        moment = origin.moment["log_time"].replace("T", " ").split("+")[0]
        lines.append(f"recording  {origin.transition['source_file']}, {moment} UTC")
        for message in origin.messages:
            if said := _message(message.input, message.fields):
                lines.append(f"message    {message.topic}, {message.age_s:.2f} s before: {said}")
    stratum = next(one for one in panel.strata if one.name == audit["stratum"])
    fed = next(row for row in fed_shares(run) if row["stratum"] == audit["stratum"])
    drawn = [r for r in run.table("sampled_episodes").to_pylist() if r["source"] == "logs"]
    often = sum(row["drawn_rows"] for row in drawn if row["episode"] == audit["episode"])
    share = float((panel.meta_column("episode_id") == audit["episode"]).mean())
    even = share * sum(row["drawn_rows"] for row in drawn)
    ended = ", and its episode ends here" if audit["discount"] == 0 else ""
    return [
        *lines,
        f"row        {audit['transition_id']}, driven by the {audit['behaviour_policy']}",
        f"           labelled {audit['condition']}; reward {audit['reward']:.2f}{ended}",
        f"stratum    {stratum.name}: {stratum.natural_share:.1%} of the logs,"
        f" {fed['drawn_share']:.1%} of the rows fed ({fed['logs_share']:.1%} logged)",
        f"           its episode's rows were drawn {often:,} times; with equal probability: "
        f"{even:,.0f}",
        f"update     {audit['gradient_step']:,}, row {audit['batch_row']} of its batch",
        f"           the critic predicted {audit['q']:.2f}, its target was"
        f" {audit['q'] - audit['td']:.2f}",
    ]


def _message(name: str, fields: dict[str, Any]) -> str:
    """Summarise a message in a few words; "" if that would be of little use."""
    if name == "scan":
        ranges = [r for r in fields.get("ranges", ()) if r is not None and math.isfinite(r)]
        return f"the nearest return is {min(ranges):.2f} m away" if ranges else "no return"
    if name == "command":
        speed, turn = fields.get("linear.x", 0.0), fields.get("angular.z", 0.0)
        return f"asked for {speed:.2f} m/s and {turn:.2f} rad/s"
    return ""


def next_steps(to: Settings) -> list[str]:
    """List what to try on one's own logs: a command, and what it does."""
    run, store = to.run, to.store
    return [
        "restock start BAG --out mine",
        "    the same stages on your own bag or MCAP file; it proposes how topics become signals",
        f'restock sql {quoted(store)} "FROM coverage_by_condition"',
        "    your questions, in SQL: docs/sql.md lists tables and columns",
        f"restock coverage gaps {quoted(store)} --mixture coverage",
        "    what the logs lack, and which missions would fill the gaps",
        f"restock diagnose {quoted(run)}",
        "    why a critic fails: because of what it was fed, or of its target?",
        "docs/tutorial.md, docs/your-robot.md",
        "    what replay and target do, cell by cell; your robot, from bags to a policy",
    ]
