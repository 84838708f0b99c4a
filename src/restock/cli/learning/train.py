"""`restock train`: trains offline on the panel, then online in the twin."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Thread
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Literal

from restock.cli.output import print_json, print_table, progress, say
from restock.cli.words import Repeated
from restock.errors import RestockError, quoted
from restock.process import went_on_after_interrupt

if TYPE_CHECKING:
    from restock.replay.panel.panel import Panel
    from restock.train.dqn.config import TeacherConfig, TrainConfig
    from restock.train.loop import TrainResult
    from restock.train.prepare import Prepared

_STOPPING = (
    "stopping: a checkpoint is written after the updates or the step under way; Ctrl-C again ends"
    " at once, with the last checkpoint"
)


@dataclass
class TrainCommand:
    """Train a DQN: offline on a panel of logs, then online in the twin on logs and fresh rows.

    Writes a run directory: resolved config, metrics and replay audit as Parquet, checkpoints (the
    latest, and the best by greedy evaluation on fixed episodes) and TensorBoard events. Ctrl-C
    writes a checkpoint and exits 130, a second Ctrl-C ends at once with the last checkpoint;
    `--resume RUN` continues exactly where it stopped.
    docs/train.md explains the recipe and every key of the config.

    `restock train STUDY.toml` trains every arm of a study with every seed, and compares them; it
    has its own options: `restock train STUDY.toml --help`.
    """

    out: Path | None = None
    """Directory of the new run. It must not exist yet."""
    panel: Path | None = None
    """A panel from `restock mix`. Without one, training is online only."""
    config: Path | None = None
    """A TOML file with any of the config's keys (docs/train.md)."""
    set: Annotated[tuple[str, ...], Repeated()] = ()
    """Set one key of the config, e.g. --set optimizer.learning_rate=1e-4. May be repeated."""
    resume: Path | None = None
    """Continue this run from its latest checkpoint."""
    env_steps: int | None = None
    """Budget in environment steps (schedule.env_steps)."""
    seconds: float | None = None
    """Stop after this time, even if the step budget is not used up (schedule.seconds). It counts
    everything but starting up: cloning, updates on the logs (at most half of it), driving and
    evaluations, the last one too."""
    seed: int | None = None
    """Seed of networks, exploration, batches and episodes."""
    device: Literal["cpu", "cuda"] | None = None
    """Device of the network."""
    dry_run: bool = False
    """Check everything and print the resolved config; write nothing."""
    json: bool = False
    """Print the outcome as JSON."""

    def run(self) -> int:
        from restock.train.dqn.config import apply_overrides, parse_config
        from restock.train.prepare import prepare_new, prepare_resumed

        given = {
            "schedule.env_steps": self.env_steps,
            "schedule.seconds": self.seconds,
            "seed": self.seed,
            "device": self.device,
        }
        options = {key: f"{key}={value}" for key, value in given.items() if value is not None}
        for key, override in options.items():
            option = key.rpartition(".")[2].replace("_", "-")
            parse_config(apply_overrides({}, [override]), where=f"--{option}")
        overrides = [*self.set, *options.values()]
        if self.resume is not None:
            if self.out or self.panel or self.config or self.set or self.seed is not None:
                raise RestockError(
                    "--resume continues with the run's own panel, config and seed",
                    remedy="with --resume, give only --env-steps, --seconds or --device",
                )
            prepared = prepare_resumed(self.resume, overrides)
        else:
            if self.out is None:
                raise RestockError("no --out given", remedy="give --out RUN (or --resume RUN)")
            prepared = prepare_new(self.out, self.panel, self.config, overrides)
        if self.dry_run:
            say(describe_run(prepared))
            print_json(prepared.document)
            return 0
        _print(prepared, _train(prepared), as_json=self.json)
        return 0


def _train(prepared: Prepared) -> TrainResult:
    """Train to the end of the budget, with a progress bar."""
    from restock.train.loop import TrainingInterrupted, nothing_to_do, train
    from restock.train.run.run import resume_command

    config = prepared.config
    session = prepared.open()
    say(describe_run(prepared))
    if prepared.resumed is not None and (why := nothing_to_do(session)) is not None:
        say(f"nothing to do: {why}")
    seconds = config.schedule.seconds

    def spent() -> int:
        """Return how much of the budget is used, in seconds or environment steps."""
        return session.progress.env_steps if seconds is None else round(session.wall_s)

    budget = config.schedule.env_steps if seconds is None else round(seconds)
    try:
        with (
            progress("training", budget) as advance,
            _stop_on_interrupt() as stop,
        ):
            seen = spent()
            advance(seen)

            def notify(event: str, values: dict[str, Any]) -> None:
                nonlocal seen
                if event == "evaluation":
                    say(_evaluation_line(values, session.wall_s))
                elif event == "off_policy":
                    for note in values["notes"]:
                        say(f"off-policy evaluation: {note}")
                elif event == "progress":
                    advance(spent() - seen, _progress_note(values))
                    seen = spent()

            try:
                return train(session, stop=stop, notify=notify)
            except KeyboardInterrupt:
                went_on_after_interrupt()
                path, kept = session.run.path, session.run.latest.exists()
                raise TrainingInterrupted(
                    "ended at once; what was learnt since its last checkpoint is lost"
                    if kept
                    else "ended at once, before its first checkpoint",
                    where=str(path),
                    remedy=f"continue with {resume_command(path)}"
                    if kept
                    else "remove it, and train again",
                ) from None
    finally:
        session.close()


@contextmanager
def _stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Make the first Ctrl-C stop training with a checkpoint, and the second stop it at once."""
    # Print on a thread, because the signal handler may interrupt code that is printing.
    reported = Thread(target=say, args=(_STOPPING,))
    stopping = False

    def on_interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal stopping
        if not stopping:
            stopping = True
            reported.start()
        elif callable(before):
            before(number, frame)
        else:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield lambda: stopping
    finally:
        signal.signal(signal.SIGINT, before)
        if stopping:
            reported.join()


def _progress_note(values: dict[str, Any]) -> str:
    success = "" if values["success"] is None else f", success {values['success']:.2f}"
    return (
        f"{values['phase']}: {values['env_steps_per_s']:,.0f} steps/s,"
        f" {values['updates_per_s']:,.0f} updates/s{success}"
    )


def _evaluation_line(values: dict[str, Any], wall_s: float) -> str:
    skip = ("env_steps", "best", "mean")
    cells = "  ".join(f"{name} {value:.2f}" for name, value in values.items() if name not in skip)
    mark = "  <- best so far" if values["best"] else ""
    cells = cells or "no goal"
    return f"{wall_s:6.0f} s {values['env_steps']:>9,} steps  success: {cells}{mark}"


def _print(prepared: Prepared, outcome: TrainResult, *, as_json: bool) -> None:
    from restock.train.run.replay_audit import fed_shares, fed_table, shortfalls
    from restock.train.run.run import Run

    run = Run.open(prepared.path)
    fed = fed_shares(run)
    for why in (explain_no_update(outcome, prepared.config), *shortfalls(fed)):
        if why is not None:
            say(f"warning: {why}")
    path = str(prepared.path)
    if as_json:
        scores = asdict(outcome)
        for kept in (scores["best"], scores["last"]):
            if kept is not None and not kept["success"]:  # empty if the task has no goal
                kept["success_mean"] = None
        given = {"run": path, "panel": prepared.document["panel"], "fed": fed}
        print_json({**given, **scores})
        return
    rows = []
    for name, result in (("best (kept)", outcome.best), ("last", outcome.last)):
        if result is not None:
            mean = result.success_mean if result.success else "no goal"
            rows.append({"policy": name, **result.success, "mean": mean})
    if rows:  # empty if no evaluation episode was driven
        print_table(rows, title="success on the fixed episodes, greedy")
    if fed:
        print_table(fed_table(fed), title="what the critic was fed: % of all rows")
    say(
        f"{outcome.env_steps:,} environment steps and {outcome.gradient_steps:,} updates in"
        f" {outcome.wall_s:.0f} s\nnext: restock eval {quoted(path)}"
        + ("" if rows else " --on-logs own")
    )


def describe_run(prepared: Prepared) -> str:
    """Describe the run, and list settings and conditions that will have no effect, one per line."""
    from restock.train.dqn.config import PLANNER
    from restock.train.twin.floors.floors import open_floors
    from restock.train.twin.physics.episode import report_unreachable

    config, panel, document = prepared.config, prepared.panel, prepared.document
    schedule = config.schedule
    fed = "no panel: online only"
    if panel is not None:
        fed = f"panel {panel.id} ({len(panel):,} rows)"
    steps = f"up to {schedule.env_steps:,} environment steps"
    if not config.env.twin:
        steps = f"{schedule.offline_updates:,} updates on the logs alone, without a twin"
    if schedule.seconds is not None:
        steps += f" or {schedule.seconds:g} s"
    lines = [
        f"run {prepared.path}: {fed}; target {config.target}; {steps};"
        f" seed {config.seed}, {config.device}"
    ]
    if panel is not None:
        lines += describe_forecast(document["panel"], config)
    if config.teacher.has_filter:
        lines.append(_describe_teacher(config.teacher, panel))
    elif config.teacher.source == PLANNER:
        lines.append(
            "teacher planner: the policy does what navigation proposes, unless Q is more than"
            f" {config.teacher.margin:g} better for another action"
        )
    if config.evaluation.off_policy and (panel is None or not panel.splits):
        has = "there is no panel" if panel is None else "the panel holds out no rows"
        lines.append(
            f"evaluation.off_policy has no effect: {has} ([evaluation_split] of a mixture)"
        )
    if config.env.twin:
        lines += [
            f"condition {name!r} is not evaluated in the twin, which has no {', '.join(signals)}"
            for name, signals in document.get("not_evaluated", {}).items()
        ]
        lines += report_unreachable(open_floors(config.env.layouts))
    return "\n".join(lines)


def describe_forecast(fed: dict[str, Any], config: TrainConfig) -> list[str]:
    """Describe which quotas will fill a run's batches, and which strata will be short.

    `fed` is the part of config.json about the panel.
    """
    from restock.train.run.replay_audit import SHORT

    rows, planned = fed["forecast"], fed["planned_draws"]
    total = planned["offline"] + planned["online"]
    steps = planned["end_env_steps"]
    budget = f"{total:,.0f} rows"
    if config.env.twin:
        budget += f" in {steps:,} environment steps"
        if config.schedule.seconds is not None:
            budget += (
                f" (a first guess for {config.schedule.seconds:g} s; planned again from the"
                " measured speed)"
            )
    parts = ", ".join(
        f"{row['stratum']} {row['wanted_share']:.1%} ({row['logs_share']:.1%} logged"
        + (f", {row['fresh_share']:.1%} fresh)" if config.env.twin else ")")
        for row in rows
    )
    lines = [f"quotas of the {budget} that the critic is fed: {parts}"]
    lines += [
        f"warning: {row['stratum']} will be short by {row['short_share']:.1%} of the rows fed, of"
        f" {row['wanted_share']:.1%} wanted: {row['reason']}; log more of it, let the twin drive"
        " it, raise max_replays_per_row, or lower its share in the mixture"
        for row in rows
        if row["short_share"] >= SHORT
        or (row["wanted_share"] and row["short_share"] > 0.5 * row["wanted_share"])
    ]
    return lines


def explain_no_update(outcome: TrainResult, config: TrainConfig) -> str | None:
    """Explain why a run has learned nothing, or nothing in the twin; None if it has learned."""
    if outcome.online_updates:
        return None
    if not outcome.gradient_steps:
        learnt = "as random as at the beginning"
    elif outcome.env_steps:
        learnt = f"that of the {outcome.gradient_steps:,} updates on the logs alone"
    else:
        return None
    return (
        f"no update was made in {outcome.env_steps:,} environment steps, so the policy is {learnt};"
        " online updates begin after"
        f" schedule.warmup_env_steps={config.schedule.warmup_env_steps:,}, once there are"
        f" replay.batch_size={config.replay.batch_size:,} rows: give more"
        f" {'--env-steps' if config.schedule.seconds is None else '--seconds'}"
    )


def _describe_teacher(teacher: TeacherConfig, panel: Panel | None) -> str:
    from restock.train.feed.teacher import select_cloned
    from restock.train.prepare import rows_by_policy

    first = "no logged rows to clone: all actions are plausible at first"
    if panel is not None and (rows := int(select_cloned(panel, teacher).sum())):
        logged = rows_by_policy(panel)
        cloned = {name: logged[name] for name in teacher.policies}
        if teacher.successes:
            cloned["the successes of others"] = rows - sum(cloned.values())
        drivers = ", ".join(f"{count:,} of {name}" for name, count in cloned.items())
        first = f"{rows:,} logged rows are cloned first ({drivers})"
    mirrored = "; half of the teacher's rows are mirrored left to right" if teacher.mirror else ""
    return (
        f"teacher {teacher.source}: the policy chooses by Q among the actions that it finds"
        f" plausible; {first}{mirrored}"
    )
