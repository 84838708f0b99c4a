"""`restock demo`: the whole way in one command, on recordings that come with Restock.

Each stage says why it is there, and shows the command that does it: one that a user could type.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from restock.cli.start import stages
from restock.cli.start.stages import Settings, Stage, fed_uniformly, from_logs_alone
from restock.cli.start.work import Work, escape
from restock.errors import ConfigError, ExitCode, policy_words, quoted
from restock.stats import wilson

if TYPE_CHECKING:
    from rich.console import Console

    from restock.replay.panel.panel import Panel
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
        from restock.cli.output import print_json, stderr, stdout

        if not 0 < self.seconds < math.inf:
            raise ConfigError(f"must be a number above 0, got {self.seconds:g}", where="--seconds")
        if self.episodes < 1:
            raise ConfigError(f"must be at least 1, got {self.episodes}", where="--episodes")
        to, plan = self._plan()
        console = stderr() if self.json else stdout()

        def say(line: str) -> None:
            console.print(line, soft_wrap=True)
            console.file.flush()  # what is on stderr comes after it

        work = Work(self.out, main, say, plan=self.dry_run, explain=True)
        if not self.dry_run:
            say(f"[bold]What you are about to see[/bold]\n\n{OPENING}")
        for stage in plan:
            ended = work.do(stage)
            if not ended.good:
                return ended.exit_code or int(ExitCode.USAGE)
        report = to.run / "report.html"
        if self.json:
            print_json({"stages": work.summary(), "report": str(report)})
        elif not self.dry_run:
            tell(to, console)
            say(f"\nThe report: [bold]{escape(str(report))}[/bold] (open it in a browser)")
        return int(ExitCode.OK)

    def _plan(self) -> tuple[Settings, list[Stage]]:
        """Return what the stages share, and the stages."""
        logs, record = find_logs(), []
        if logs is None:
            logs = self.out / "logs"
            record.append(stages.record(logs))
        to = Settings(
            logs=(str(logs),),
            out=self.out,
            seconds=self.seconds,
            episodes=self.episodes,
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

    if rows := before_and_after(to):
        console.print("\n[bold]Before and after fine-tuning[/bold]")
        console.print(
            "[dim]Missions that reached their goal without a contact; in brackets, in percent,"
            " what\nother missions of the kind might give (95 %).[/dim]"
        )
        print_table(rows)
        console.print(steps_line(to))
    show("What the critic was fed", shelves(to.run))
    show("Failing before, arriving after: films", films(to))
    show("One rare event, from its message to an update", rare_event(to))
    show("What to try next", next_steps(to))


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

_CELLS = 30  # length of a bar of 100 %
RARE = "all rare ones"
FULL_STEPS = 128_000  # in docs/evidence.md


def before_and_after(to: Settings) -> list[dict[str, str]]:
    """Count the missions of each kind that succeeded, before and after fine-tuning.

    Beside these stand the policy fed uniformly and the planner, all on the floor that was trained
    on. Empty if the task has no goal: nothing succeeds or fails.
    """
    from restock.train.run.kept_evaluations import shown_evaluation

    rows = shown_evaluation(to.run)[0].to_pylist()
    uniform = fed_uniformly(to)
    names = policy_words([from_logs_alone(to), uniform, "agent", "planner"])
    driven = {
        name: [row for row in rows if row["policy"] == policy and row["perturbation"] == "none"]
        for policy, name in names.items()
    }
    if not driven[names[uniform]]:
        del driven[names[uniform]]
    if any(row["success"] is None for rows in driven.values() for row in rows):
        return []
    kinds = sorted(
        {row["condition"] for rows in driven.values() for row in rows},
        key=lambda kind: (kind != "nominal", kind),
    )
    return [
        {"mission": kind} | {name: _arrived(rows, kind) for name, rows in driven.items()}
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
    from restock.train.run.run import Run

    steps: list[int] = Run.open(to.run).table("progress")["env_steps"].to_pylist()
    most = max(steps, default=0)
    lines = [f"The agent is the fine-tuned policy: {most:,} steps in the twin here."]
    if most < FULL_STEPS / 2:
        lines += [
            f"That is little: docs/evidence.md says what {FULL_STEPS:,} steps gave. Give more",
            "--seconds, or run nothing else beside it.",
        ]
    if not most:
        lines = ["The time was up before anything was driven: give more --seconds."]
    if to.uniform.is_dir():
        lines += [
            "Fed uniformly has the same network, settings and seed"
            + (", as many steps, and every" if most else ", and every"),
            "row of the logs has the same probability. This compares feeds, not methods, so",
            f"`restock compare {quoted(to.uniform)} {quoted(to.run)}` refuses",
            "(unless --treatment mixture is given). One seed each is a sample of one:",
            "docs/evidence.md has ten.",
        ]
    return "\n".join(lines)


def shelves(run: Path) -> list[str]:
    """Return a line a stratum: its share of the logs, its quota, and what the critic was fed."""
    from restock.train.run.replay_audit import fed_shares, shortfalls
    from restock.train.run.run import Run
    from restock.train.run.run_profile import run_panel

    trained = Run.open(run)
    panel: Panel | None = run_panel(trained.document)
    fed = fed_shares(trained)
    if panel is None or not fed:
        return []
    logged = {stratum.name: stratum.natural_share for stratum in panel.strata}
    width = max(len(row["stratum"]) for row in fed)
    lines = [f"{'stratum':<{width}}  in the logs  wanted    fed  of it logged, fresh"]
    for row in fed:
        of_logs = logged.get(row["stratum"], 0.0)
        natural, drawn = (round(_CELLS * s) for s in (of_logs, row["drawn_share"]))
        bar = "█" * min(natural, drawn) + "▒" * (drawn - natural) + "·" * (natural - drawn)
        lines.append(
            f"{row['stratum']:<{width}}  {of_logs:>11.1%}  {row['wanted_share']:>6.1%}"
            f"  {row['drawn_share']:>5.1%}  {row['logs_share']:>9.1%}, {row['fresh_share']:>5.1%}"
            f"  {bar}".rstrip()
        )
    return [
        *lines,
        "█ as in the logs   ▒ added by quota   · less than in the logs",
        f"In % of all {sum(row['drawn_rows'] for row in fed):,} rows that the critic was fed"
        " (`FROM fed` of the run).",
        *(f"warning: {line}" for line in shortfalls(fed)),
    ]


def films(to: Settings) -> list[str]:
    """Return where the films are, with the failing policy beside the fine-tuned one."""
    from restock.train.evaluation.film import FOLDER

    found = sorted((to.run / FOLDER).glob("*-rescue.webp"))
    reported = (
        ["The policy that failed is on the left; the report shows them, too."] if found else []
    )
    return [*map(str, found), *reported]


def rare_event(to: Settings) -> list[str]:
    """Follow a logged row of a rare condition from its message to an update, if there is one."""
    row = _chosen(to.run)
    if row is None:
        return []
    from restock.errors import RestockError
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

    audit: list[dict[str, Any]] = Run.open(run).table("audit").to_pylist()
    rows = [
        row
        for row in audit
        if row["source"] == "logs" and row["condition"] not in (None, "nominal", "unlabelled")
    ]
    if not rows:
        return None
    often: dict[str, int] = {}
    for row in rows:
        often[row["condition"]] = often.get(row["condition"], 0) + 1
    rarest = min(often, key=lambda condition: (often[condition], condition))
    return max(
        (row for row in rows if row["condition"] == rarest),
        key=lambda row: (abs(row["td"]), row["gradient_step"]),
    )


def _told(trace: Trace, to: Settings) -> list[str]:
    """Write the chain, with a line or two for each link."""
    from restock.replay.panel.panel import Panel
    from restock.train.run.replay_audit import fed_shares
    from restock.train.run.run import Run

    assert trace.audit is not None
    audit, origin, lines = trace.audit, trace.origin, []
    if origin is not None:
        moment = origin.moment["log_time"].replace("T", " ").split("+")[0]
        lines.append(f"recording  {origin.transition['source_file']}, {moment} UTC")
        for message in origin.messages:
            if said := _message(message.input, message.fields):
                lines.append(f"message    {message.topic}, {message.age_s:.2f} s before: {said}")
    panel = Panel.open(to.panel)
    stratum = next(stratum for stratum in panel.strata if stratum.name == audit["stratum"])
    ended = ", and its episode ends here" if audit["discount"] == 0 else ""
    drawn, even = _draws(to.run, panel, audit["episode"])
    fed = next(row for row in fed_shares(Run.open(to.run)) if row["stratum"] == audit["stratum"])
    target = audit["q"] - audit["td"]
    return [
        *lines,
        f"row        {audit['transition_id']}, driven by the {audit['behaviour_policy']}",
        f"           labelled {audit['condition']}; reward {audit['reward']:.2f}{ended}",
        f"stratum    {stratum.name}: {stratum.natural_share:.1%} of the logs,"
        f" {fed['drawn_share']:.1%} of the rows fed ({fed['logs_share']:.1%} logged)",
        f"           its episode's rows were drawn {drawn:,} times; with equal probability: "
        f"{even:,.0f}",
        f"update     {audit['gradient_step']:,}, row {audit['batch_row']} of its batch",
        f"           the critic predicted {audit['q']:.2f}, its target was {target:.2f}",
    ]


def _draws(run: Path, panel: Panel, episode: str) -> tuple[int, float]:
    """Count how often an episode's rows were drawn, and how often uniform draws would have."""
    from restock.train.run.run import Run

    logged = [
        row
        for row in Run.open(run).table("sampled_episodes").to_pylist()
        if row["source"] == "logs"
    ]
    drawn = sum(row["drawn_rows"] for row in logged if row["episode"] == episode)
    share = float((panel.meta_column("episode_id") == episode).mean())
    return drawn, share * sum(row["drawn_rows"] for row in logged)


def _message(name: str, fields: dict[str, Any]) -> str:
    """Summarise a message in a few words; "" if that would be of little use."""
    if name == "scan":
        ranges = [r for r in fields.get("ranges", ()) if r is not None and math.isfinite(r)]
        return f"the nearest return is {min(ranges):.2f} m away" if ranges else "no return"
    if name == "command":
        return (
            f"asked for {fields.get('linear.x', 0.0):.2f} m/s and"
            f" {fields.get('angular.z', 0.0):.2f} rad/s"
        )
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
