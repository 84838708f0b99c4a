"""A run's critic along some steps: what it expects of the action taken, and how wrong it was."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from restock.arrays import F32, F64, Ints
from restock.errors import RunError
from restock.replay.trace.moment import Moment
from restock.train.dqn.config import TrainConfig, parse_config
from restock.train.dqn.learner import Learner
from restock.train.evaluation.policies import load_agent
from restock.train.run import checkpoint
from restock.train.run.run import Run
from restock.train.run.run_profile import profile_of_run


@dataclass(frozen=True)
class Critic:
    """A critic's values over T steps, by the last checkpoint of a run, else by its kept policy."""

    run: str
    weights: str  # which networks: a text for people
    gradient_steps: int
    value: F64  # (T,) Q of the action that was taken; NaN if it is not plausible
    best: F64  # (T,) the largest Q
    greedy: Ints  # (T,) the action of that
    td: F64  # (T,) Q(s, a) less the target, over one step


def critic_along(path: str | Path, moment: Moment) -> Critic:
    """Compute what a run's critic says of a moment's steps.

    The target is that of one step, by the target network of the last checkpoint; a run of which
    only its best policy is left bootstraps from that.

    Raises:
        RunError: no such run, none of its checkpoints is left, or it is of another task.
    """
    run = Run.open(Path(path))
    task = profile_of_run(run).task
    if task.hash != moment.task.hash:
        raise RunError(
            f"was trained on task {task.hash}, these steps are of {moment.task.hash}",
            where=str(run.path),
            remedy="give a run of the same task with --critic, or leave out the critic: --critic "
            "none",
        )
    config = parse_config(run.document["config"], where=str(run.path / "config.json"))
    rows = _packed(moment, config.loss.discount)
    if run.latest.is_file():
        return _of_checkpoint(run, config, rows, moment)
    return _of_policy(run, rows, moment)


def _packed(moment: Moment, discount: float) -> F32:
    """Pack the steps as rows of a batch, (T, 2D + 3)."""
    after = np.asarray(moment.column("next_observation"), np.float32)
    goes_on = ~np.asarray(moment.column("terminated"), np.bool_)
    last = np.stack(
        [moment.column("action"), moment.column("reward"), discount * goes_on], axis=1
    ).astype(np.float32)
    return np.concatenate([moment.observations, after, last], axis=1)


def _of_checkpoint(run: Run, config: TrainConfig, rows: F32, moment: Moment) -> Critic:
    task = moment.task
    learner = Learner(config, task.observation_size, len(task.actions))
    state = checkpoint.load(run.latest)
    try:
        learner.load_state_dict(state["learner"])
    except (KeyError, ValueError, RunError) as error:
        raise RunError(
            f"contains no learner that this Restock can read: {error}",
            where=str(run.latest),
            remedy="choose another run with --critic, or --critic none",
        ) from error
    td, q, _ = learner.td_error(torch.from_numpy(rows).to(learner.device))
    named = f"its last checkpoint, after {learner.gradient_steps:,} updates"
    return _critic(run, named, learner.gradient_steps, q, td, moment)


@torch.no_grad()
def _of_policy(run: Run, rows: F32, moment: Moment) -> Critic:
    agent = load_agent(run)
    size = moment.task.observation_size
    q = agent.network(torch.from_numpy(rows[:, :size]))
    after = agent.network(torch.from_numpy(rows[:, size : 2 * size])).amax(dim=1)
    reward, discount = torch.from_numpy(rows[:, -2]), torch.from_numpy(rows[:, -1])
    action = torch.from_numpy(rows[:, -3]).long()
    td = q.gather(1, action[:, None])[:, 0] - (reward + discount * after)
    steps = 0 if agent.origin is None else agent.origin.gradient_steps
    named = f"the policy that it kept, from update {steps:,}, used as its own target"
    return _critic(run, named, steps, q, td, moment)


def _critic(
    run: Run, weights: str, steps: int, q: torch.Tensor, td: torch.Tensor, moment: Moment
) -> Critic:
    values = q.detach().cpu().numpy().astype(np.float64)
    taken = values[np.arange(len(values)), np.asarray(moment.column("action"), np.int64)]
    return Critic(
        run=str(run.path),
        weights=weights,
        gradient_steps=steps,
        value=np.where(np.isfinite(taken), taken, np.nan),
        best=values.max(axis=1),
        greedy=values.argmax(axis=1),
        td=np.where(np.isfinite(taken), td.detach().cpu().numpy().astype(np.float64), np.nan),
    )
