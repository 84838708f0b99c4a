"""`restock train`: offline warm-up on the panel, then online in the twin."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from restock.train.loop import Outcome
    from restock.train.prepare import Prepared


@dataclass
class Train:
    """Train a DQN: offline on a panel of logs, then online in the twin on logs and fresh rows.

    Writes a run directory: resolved config, metrics and replay audit as Parquet, checkpoints (the
    latest, and the best by greedy evaluation on fixed episodes) and TensorBoard events. Ctrl-C
    writes a checkpoint and exits 130; `--resume RUN` goes on exactly where it was. docs/train.md
    explains the recipe and every key of the config.
    """

    out: Path | None = None
    """Directory of the new run; it must not be there yet."""
    panel: Path | None = None
    """Panel from `restock mix`. Without one, training is online only."""
    config: Path | None = None
    """TOML with any of the config's keys (docs/train.md)."""
    set: Annotated[list[str], tyro.conf.UseAppendAction] = field(default_factory=list)
    """One key of the config, e.g. --set optimizer.learning_rate=1e-4; may be repeated."""
    resume: Path | None = None
    """Go on with this run, from its latest checkpoint."""
    env_steps: int | None = None
    """Budget in environment steps (schedule.env_steps)."""
    seconds: float | None = None
    """Stop after this much training time, if the budget is not spent before (schedule.seconds)."""
    seed: int | None = None
    """Seed of networks, exploration, batches and episodes."""
    device: Literal["cpu", "cuda"] | None = None
    """Where the network lives."""
    dry_run: bool = False
    """Check everything and print the resolved config; write nothing."""
    json: bool = False
    """Print the outcome as JSON."""

    def run(self) -> int:
        from restock.cli.output import print_json
        from restock.errors import RestockError
        from restock.train.prepare import prepare_new, prepare_resumed

        given = {
            "schedule.env_steps": self.env_steps,
            "schedule.seconds": self.seconds,
            "seed": self.seed,
            "device": self.device,
        }
        overrides = self.set + [
            f"{key}={value}" for key, value in given.items() if value is not None
        ]
        if self.resume is not None:
            if self.out or self.panel or self.config or self.set or self.seed is not None:
                raise RestockError(
                    "--resume goes on with the run's own panel, config and seed",
                    remedy="give only --env-steps, --seconds or --device beside it",
                )
            prepared = prepare_resumed(self.resume, overrides)
        else:
            if self.out is None:
                raise RestockError(
                    "where should the run be written?", remedy="give --out RUN (or --resume RUN)"
                )
            prepared = prepare_new(self.out, self.panel, self.config, overrides)
        if self.dry_run:
            print_json(prepared.document)
            return 0
        outcome = _train(prepared)
        _print(prepared, outcome, as_json=self.json)
        return 0


def _train(prepared: Prepared) -> Outcome:
    from restock.cli.output import progress, stderr
    from restock.train.loop import train

    config = prepared.config
    session = prepared.open()
    # Soft: a line a reader greps for must not be wrapped.
    say = partial(stderr().print, soft_wrap=True, highlight=False)
    say(prepared.describe())
    try:
        with (
            progress("training", config.schedule.env_steps) as advance,
            _stop_on_interrupt() as stop,
        ):
            seen = session.clock.env_steps
            advance(seen)

            def notify(event: str, values: dict[str, Any]) -> None:
                nonlocal seen
                if event == "evaluation":
                    say(_evaluation_line(values, session.wall_s))
                elif event == "progress":
                    advance(values["env_steps"] - seen, _progress_note(values))
                    seen = values["env_steps"]

            return train(session, stop=stop, notify=notify)
    finally:
        session.close()


@contextmanager
def _stop_on_interrupt() -> Iterator[Any]:
    """The first Ctrl-C asks the loop to stop with a checkpoint, the second one stops at once."""
    asked = False

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    before = signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, before)


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
    return f"{wall_s:6.0f} s {values['env_steps']:>9,} steps  success: {cells}{mark}"


def _print(prepared: Prepared, outcome: Outcome, *, as_json: bool) -> None:
    from dataclasses import asdict

    from restock.cli.output import print_json, print_table, say

    path = str(prepared.path)
    if as_json:
        print_json({"run": path, "panel": prepared.document["panel"], **asdict(outcome)})
        return
    rows = []
    for name, result in (("best (kept)", outcome.best), ("last", outcome.last)):
        if result is not None:
            rows.append({"policy": name, **result.success, "mean": result.success_mean})
    print_table(rows, title="success on the fixed episodes, greedy")
    say(
        f"{outcome.env_steps:,} environment steps and {outcome.gradient_steps:,} updates in"
        f" {outcome.wall_s:.0f} s\nnext: restock eval {path}"
    )
