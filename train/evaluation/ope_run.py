"""Off-policy evaluation of a run: of the policy it kept, or of the one that is about to drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from restock.errors import RunError
from restock.files import write_table
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import Task
from restock.train.dqn.config import parse_config
from restock.train.dqn.network import clone
from restock.train.evaluation.eval_run import load_agent
from restock.train.evaluation.ope import Judging, judge
from restock.train.evaluation.ope_dataset import Evidence, Measure, find_evidence, run_panel
from restock.train.run.run import Run
from restock.train.run.run_tables import TABLES

if TYPE_CHECKING:
    from restock.train.session import Session

FILE = "off_policy.parquet"  # in RUN/eval


@dataclass(frozen=True)
class Judged:
    """The rows of `off_policy`, and what is worth saying of the logs."""

    rows: list[dict[str, Any]]
    notes: tuple[str, ...]
    version: str  # of the policy


def measures_of(task: Task) -> tuple[Measure, ...]:
    """What can be measured of a task: where a contact ends the episode for good, or there is no
    goal, logs do not tell an arrival from another end."""
    told = task.goal == "route" and not task.bump_terminates
    return ("return", "success") if told else ("return",)


def judge_run(
    path: Path,
    logs: str | None,
    how: Judging,
    progress: Callable[[int], None] | None = None,
    *,
    write: bool = True,
) -> Judged:
    """Judge the policy that a run kept, and write `RUN/eval/off_policy.parquet`.

    Args:
        path: the run.
        logs: a store, or a panel whose held-out episodes count; default the run's own panel.
        how: which policy exactly, and what weights must be worth.
        progress: told of every measure done.
        write: or only say.

    Raises:
        RunError: no such run, no policy kept, or no episode that it did not learn from.
        StoreError, PanelError: no such logs.
    """
    run = Run.open(path)
    config = parse_config(run.document["config"], where=str(path / "config.json"))
    if not run.best.exists():
        raise RunError(
            "has kept no policy yet: its first evaluation is still to come",
            where=str(path),
            remedy=f"go on with `restock train --resume {path}`",
        )
    agent = load_agent(run)
    task = load_profile(config.profile).task
    evidence = find_evidence(run_panel(run.document), task, logs, seed=how.seed)
    rows = judge(
        agent.network,
        evidence,
        discount=config.loss.discount,
        measures=measures_of(task),
        how=how,
        progress=progress,
    )
    if not write:
        return Judged(rows, evidence.notes, agent.version)
    steps = int(agent.version.rpartition("@")[2])
    clocks = {"env_steps": None, "gradient_steps": steps}
    table = pa.Table.from_pylist([{**clocks, **row} for row in rows], TABLES["off_policy"])
    write_table(table, path / "eval" / FILE)
    return Judged(rows, evidence.notes, agent.version)


def judge_session(session: Session) -> Evidence | None:
    """Judge the policy of a run as it is now, into its table `off_policy`; None without logs."""
    if session.logs is None or session.logs.panel is None:
        return None
    learner, config = session.learner, session.config
    evidence = find_evidence(session.logs.panel, session.task, seed=config.seed)
    rows = judge(
        clone(learner.policy_network).to("cpu"),
        evidence,
        discount=config.loss.discount,
        measures=measures_of(session.task),
        how=Judging(seed=config.seed),
    )
    clocks = {
        "env_steps": session.clock.env_steps,
        "gradient_steps": learner.gradient_steps,
    }
    session.run.append("off_policy", [{**clocks, **row} for row in rows])
    return evidence


__all__ = ["Judged", "judge_run", "judge_session"]
