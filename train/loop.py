"""The training loop: offline on the logs, then online in the twin on logs and fresh experience.

Double DQN (arXiv:1509.06461) with n-step returns and half of each online batch from logs (RLPD,
arXiv:2302.02948), after an offline phase on the logs and warm-up rollouts without updates (WSRL,
arXiv:2412.07762). `_train` is the whole algorithm, from top to bottom.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from torch import Tensor

from restock.arrays import Bools
from restock.errors import ExitCode, RestockError
from restock.process import interrupts_raised
from restock.train.dqn.algorithm import Loss
from restock.train.dqn.config import GIVEN, Hard
from restock.train.dqn.network import clone
from restock.train.evaluation.evaluate import Score, score
from restock.train.evaluation.ope import OpeConfig, evaluate_off_policy, measures_of, notes_of
from restock.train.evaluation.ope_dataset import load_ope_dataset
from restock.train.evaluation.policies import GreedyPolicy
from restock.train.feed.batch_record import LEAVE_OUT, TRAIN_SLOWER, refuse
from restock.train.feed.batches import ReplayBatch, draw_ahead
from restock.train.feed.logs import PROBE_ROWS, Probe
from restock.train.feed.teacher import TeacherFailed
from restock.train.feed.update_blocks import LONGEST, MadeUpdate
from restock.train.run.run import resume_command
from restock.train.session import Interval, Session
from restock.train.twin.env.interface import epsilon_greedy

_CONSERVATIVE_STEPS = 20_000  # online environment steps until the CQL term's weight is 0
_OFFLINE_BLOCK = 64  # updates between two checks of the clock and of Ctrl-C
# Parts of a budget in seconds after which cloning and the updates on the logs must end. The second
# half of the budget is for the twin.
_CLONING_UNTIL, _LOGS_UNTIL = 0.25, 0.5
Notify = Callable[[str, dict[str, Any]], None]  # name of an event, its values


class TrainingInterrupted(RestockError):
    """The run was interrupted, and has a checkpoint to resume from."""

    exit_code = ExitCode.INTERRUPTED


@dataclass(frozen=True)
class TrainResult:
    """The counts and scores of a run at its end."""

    env_steps: int
    gradient_steps: int
    online_updates: int  # gradient steps made while driving in the twin
    wall_s: float
    best: Score | None
    last: Score | None


@interrupts_raised
def train(
    session: Session,
    *,
    stop: Callable[[], bool] = lambda: False,
    notify: Notify = lambda event, values: None,
) -> TrainResult:
    """Train to the end of the session's budget; do nothing if the budget is used up.

    Args:
        stop: called between steps and while the policy is evaluated; True ends the run with a
            checkpoint. An evaluation under way is abandoned, and repeated when the run is resumed.
        notify: called with every row of `progress`, every evaluation, and the notes of an
            off-policy evaluation on the logs.

    Raises:
        TrainingInterrupted: `stop` returned True.
        TeacherFailed: the teacher raised an error or returned invalid actions. The step for which
            the teacher was queried was not made, and a checkpoint was written.
        NotFinite: a loss or gradient is NaN or infinite; names the rows of the batch.
    """
    if nothing_to_do(session) is not None:
        return _result(session)
    session.open_events()
    try:
        return _train(session, stop, notify)
    except TeacherFailed as error:
        _save(session)
        session.write_held()
        again = f"; then continue with {resume_command(session.run.path)}"
        raise TeacherFailed(
            f"{error.what}; a checkpoint was written",
            where=error.where,
            remedy=f"{error.remedy}{'' if session.config.teacher.source == GIVEN else again}",
        ) from error


def _train(session: Session, stop: Callable[[], bool], notify: Notify) -> TrainResult:
    config, progress, learner = session.config, session.progress, session.learner
    schedule, epsilon_at = config.schedule, config.epsilon.at
    offline_updates = schedule.offline_updates if session.logs is not None else 0

    # 1. Offline, on the logs alone: clone the teacher, then learn values.
    _clone_teacher(session, stop)
    logs_until = _LOGS_UNTIL if config.env.twin else 1.0
    began_s, made = session.wall_s, learner.gradient_steps
    while (left := offline_updates - learner.gradient_steps) > 0 and time_left(session, logs_until):
        _stop_if_requested(session, stop)
        _run_updates(
            session, min(left, 1 if session.blocks is None else _OFFLINE_BLOCK), "offline", notify
        )
    if learner.gradient_steps > made:
        progress.offline_update_s = (session.wall_s - began_s) / (learner.gradient_steps - made)
    if progress.evaluated_at < 0 and offline_updates:
        if session.interval.updates:
            _close_interval(session, "offline", notify)
        if config.evaluation.off_policy:
            _evaluate_off_policy(session, notify, stop)  # the policy has not driven yet
        _evaluate(session, notify, stop)

    if progress.driving_from_s is None:
        progress.driving_from_s = session.wall_s
    _evaluate_if_due(session, notify, stop)  # due if an evaluation was interrupted
    while progress.env_steps < schedule.env_steps and time_left(session):
        _stop_if_requested(session, stop)
        # 2. Warm-up: the policy learnt from the logs drives, but no updates are made yet.
        warm = progress.env_steps >= schedule.warmup_env_steps
        if progress.online_from is None and warm and len(session.ring) >= config.replay.batch_size:
            progress.online_from, progress.online_from_s = progress.env_steps, session.wall_s
            if schedule.seconds is not None:
                session.plan()
            _close_interval(session, "warmup", notify)

        # 3. Act, epsilon-greedy; the twin steps on its own thread …
        greedy = learner.greedy(session.collector.observation)
        epsilon = epsilon_at(progress.env_steps)
        action, probability = epsilon_greedy(
            greedy, learner.network.actions, epsilon, session.exploration
        )
        acting_step = learner.gradient_steps
        session.collector.start(action, probability)

        # 4. … while ended episodes are labelled, and the learner learns from the rows that the ring
        # had before this step.
        session.run.append("episodes", session.collector.label())
        due = _count_due_updates(session)
        _run_updates(session, due, "online", notify)
        progress.online_updates += due

        # 5. The step's transitions go into the ring.
        ended = session.collector.finish(
            env_steps=progress.env_steps,
            gradient_steps=learner.gradient_steps,
            acting_step=acting_step,
        )
        progress.env_steps += session.env.num_envs
        for episode in ended:
            session.interval.episodes += 1
            session.interval.successes += bool(episode.success)
            session.interval.returns += episode.undiscounted_return
        # … and if a practice interval is over, the twin gets new shares for its next missions.
        session.practice.note(ended)
        session.run.append("practice", session.practice.advance(session.steps))

        # 6. At intervals: evaluate the fixed episodes greedily, and write a checkpoint.
        _evaluate_if_due(session, notify, stop)
        if (
            progress.env_steps - progress.checkpointed_at
            >= config.record.checkpoint_every_env_steps
            and progress.env_steps < schedule.env_steps
        ):
            if schedule.seconds is not None:
                session.plan()
            _save(session)

    session.run.append("episodes", session.collector.label(all_of_them=True))
    session.run.append("practice", session.practice.advance(session.steps, last=True))
    if _interval_is_open(session):
        _close_interval(session, "warmup" if progress.online_from is None else "online", notify)
    if progress.evaluated_at != progress.env_steps:
        _evaluate(session, notify, stop)
    _save(session)
    session.write_held()
    return _result(session)


def _result(session: Session) -> TrainResult:
    progress = session.progress
    return TrainResult(
        progress.env_steps,
        session.learner.gradient_steps,
        progress.online_updates,
        session.wall_s,
        session.best,
        session.last,
    )


def _interval_is_open(session: Session) -> bool:
    interval = session.interval
    return bool(interval.updates) or session.progress.env_steps > interval.env_steps_before


def _clone_teacher(session: Session, stop: Callable[[], bool]) -> None:
    """Train the behaviour network on the logged rows to clone, if no update was made yet."""
    behaviour, imitation = session.learner.behaviour, session.imitation
    if behaviour is None or imitation is None or session.learner.gradient_steps:
        return
    seconds = session.config.schedule.seconds
    limit_s = math.inf if seconds is None else _CLONING_UNTIL * seconds
    while behaviour.updates < imitation.offline_updates and (
        session.wall_s < limit_s or behaviour.updates < session.config.record.every_updates
    ):
        _stop_if_requested(session, stop)
        behaviour.learn(imitation.draw_offline())


def _count_due_updates(session: Session) -> int:
    progress = session.progress
    if progress.online_from is None:
        return 0
    collected = progress.env_steps + session.env.num_envs - progress.online_from
    return int(collected * session.config.schedule.updates_per_env_step) - progress.online_updates


def _run_updates(session: Session, count: int, phase: str, notify: Notify) -> None:
    """Make `count` gradient steps, record each, and advance the target."""
    while count > 0:
        made = _updates_to_make(session, count)
        target = session.learner.target
        sync = target.last_sync
        for number, (batch, loss, tail) in enumerate(_make_updates(session, made, phase), start=1):
            _record_update(session, batch, loss, sync, tail, phase)
            if number < made:  # after the last update, `_advance_target` does this
                target.after(session.learner.gradient_steps)
            sync = target.last_sync
        _advance_target(session, phase, notify)
        count -= made


def _updates_to_make(session: Session, count: int) -> int:
    """Return how many of `count` updates to make until a record or a copy to the target is due."""
    if session.blocks is None:
        count = 1 if session.batches.needs_td else min(count, LONGEST)
    step, rule = session.learner.gradient_steps, session.learner.target.rule
    due = [session.config.record.every_updates]
    if isinstance(rule, Hard):
        due.append(rule.every)
    return min(count, *(every - step % every for every in due))


def _make_updates(session: Session, count: int, phase: str) -> Iterator[MadeUpdate]:
    """Make `count` updates, and yield each."""
    progress, learner = session.progress, session.learner
    conservative = _conservative_weight(session, phase)
    imitation = session.imitation if phase == "online" else None

    def draw() -> ReplayBatch:
        if phase == "offline":
            return session.batches.draw_offline()
        return session.batches.draw_online(progress.env_steps)

    if session.blocks is not None:
        yield from session.blocks.make(
            count, draw, conservative=conservative, labelled=imitation is not None
        )
        return
    # Draw all batches first: an update evicts the data that draws use from the CPU's caches.
    drawn, failed = draw_ahead(draw, count)
    labelled = [None if imitation is None else imitation.draw_online() for _ in drawn]
    for batch, labels in zip(drawn, labelled, strict=True):
        expert = session.log_terms.expert_rows(batch.log_rows)
        loss = learner.update(
            batch.rows,
            weight=batch.weight,
            logged=batch.logged,
            conservative=conservative,
            expert=expert,
            labelled=labels,
        )
        yield batch, loss, None
    if failed is not None:
        raise failed


def _record_update(
    session: Session,
    batch: ReplayBatch,
    loss: Loss,
    last_sync: int,
    tail: Tensor | None,
    phase: str,
) -> None:
    """Record the last update; `last_sync` is the target's last sync before it."""
    interval, update = session.interval, session.learner.gradient_steps
    session.feed.batch(update, session.progress.env_steps, batch, loss, last_sync, tail=tail)
    value = float(loss.value.detach())
    _check_loss(session, batch, loss, value, phase)
    session.batches.note_errors(batch, loss.td)
    interval.updates += 1
    interval.loss += value


def _advance_target(session: Session, phase: str, notify: Notify) -> None:
    """Advance the target after the last update, and close the interval if it ends here."""
    learner, interval = session.learner, session.interval
    step, every = learner.gradient_steps, session.config.record.every_updates
    rule = learner.target.rule
    last_of_interval = (step - 1) // every != (step - 1 + getattr(rule, "every", 1)) // every
    if isinstance(rule, Hard) and learner.target.is_due(step) and last_of_interval:
        # A hard sync makes the distance to the target 0, so measure the distance just before it.
        interval.distance_before_sync = learner.target.distance()
        if session.probe is not None:
            interval.lag_before_sync = session.probe.measure(learner)[1]
    learner.target.after(step)
    if step % every == 0:
        _close_interval(session, phase, notify)


def _conservative_weight(session: Session, phase: str) -> float:
    """Return the CQL term's weight: constant until online updates begin, then linear to 0."""
    loss, progress = session.config.loss, session.progress
    if phase == "offline" or progress.online_from is None:
        return loss.conservative
    part = min((progress.env_steps - progress.online_from) / _CONSERVATIVE_STEPS, 1.0)
    return loss.conservative * (1 - part)


def _close_interval(session: Session, phase: str, notify: Notify) -> None:
    """Write one row of `progress`, with the feed's sums and the probe's measures."""
    check_parameters(session)
    progress, learner, interval = session.progress, session.learner, session.interval
    means = session.feed.flush(progress.env_steps, learner.gradient_steps, phase)
    if session.probe is None and phase == "online":
        session.probe = Probe.of_ring(session.ring, PROBE_ROWS)
    lag = None
    if session.probe is not None:
        measured, lag = session.probe.measure(learner)
        session.run.append("probe", [{**session.steps, **row} for row in measured])
    if session.imitation is not None:
        filtered = session.imitation.measure(learner)
        session.run.append("teacher", [{**session.steps, **row} for row in filtered])
    before_sync = interval.distance_before_sync is not None
    wall_s = session.wall_s
    elapsed_s = max(wall_s - interval.wall_s_before, 1e-9)
    steps = progress.env_steps - interval.env_steps_before
    episodes = interval.episodes
    row = {
        **session.steps,
        **means,
        "wall_s": wall_s,
        "phase": phase,
        "updates": interval.updates,
        "loss": interval.loss / interval.updates if interval.updates else None,
        "epsilon": session.config.epsilon.at(progress.env_steps) if phase != "offline" else None,
        "target_rule": str(learner.target.rule),
        "target_param_distance": interval.distance_before_sync
        if before_sync
        else learner.target.distance(),
        "target_q_lag": interval.lag_before_sync if before_sync else lag,
        "target_sampled": "before_sync" if before_sync else "now",
        "last_sync": learner.target.last_sync,
        "steps_since_sync": learner.gradient_steps - learner.target.last_sync,
        "ring_rows": len(session.ring),
        "planned_env_steps": progress.planned_env_steps,
        "episodes": episodes,
        "success": interval.successes / episodes if episodes and session.collector.goal else None,
        "return_mean": interval.returns / episodes if episodes else None,
        "env_steps_per_s": steps / elapsed_s,
        "updates_per_s": interval.updates / elapsed_s,
    }
    session.run.append("progress", [row])
    session.run.append("shares", [{**session.steps, **row} for row in session.batches.describe()])
    session.run.flush(everything=False)
    session.events.scalars(progress.env_steps, "train", row)
    session.interval = Interval(env_steps_before=progress.env_steps, wall_s_before=wall_s)
    notify("progress", row)


def _evaluate_off_policy(session: Session, notify: Notify, stop: Callable[[], bool]) -> None:
    """Evaluate the policy on held-out logs, if there are any, and write the table `off_policy`."""
    if session.logs is None or session.logs.panel is None or not session.logs.panel.splits:
        return
    if session.run.table("off_policy").num_rows:  # done before the run was stopped
        return
    config, learner = session.config, session.learner
    ope = OpeConfig(seed=config.seed)
    dataset = load_ope_dataset(session.logs.panel, session.task, seed=config.seed)
    notify("off_policy", {"notes": notes_of(session.task, dataset, ope)})
    rows = evaluate_off_policy(
        clone(learner.policy).to("cpu"),
        dataset,
        discount=config.loss.discount,
        measures=measures_of(session.task, dataset),
        config=ope,
        between=lambda: _stop_if_requested(session, stop),
    )
    session.run.append("off_policy", [{**session.steps, **row} for row in rows])


def _evaluate_if_due(session: Session, notify: Notify, stop: Callable[[], bool]) -> None:
    progress, every = session.progress, session.config.evaluation.every_env_steps
    if progress.env_steps - max(progress.evaluated_at, 0) >= every:
        _evaluate(session, notify, stop)


def _evaluate(session: Session, notify: Notify, stop: Callable[[], bool]) -> None:
    """Drive the fixed episodes greedily, and keep the policy if it is the best so far.

    Without a twin there are no episodes: the current policy is kept.
    """
    check_parameters(session)
    if not session.config.env.twin:
        session.progress.evaluated_at = session.progress.env_steps
        session.save_best(Score({}, 0.0, 0.0))
        return
    config, progress, learner = session.config, session.progress, session.learner
    policy = GreedyPolicy(learner.policy)
    discount = config.loss.discount
    began_s = session.wall_s
    results = session.evaluation_buffer.drive(
        policy, session.fixed_episodes, discount, between=lambda: _stop_if_requested(session, stop)
    )
    measured = session.evaluation_buffer.measure(learner)
    session.run.append("evaluation_buffer", [{**session.steps, **row} for row in measured])
    progress.evaluated_at = progress.env_steps
    progress.evaluation_s = session.wall_s - began_s
    session.last = score(results)
    best = session.last.beats(session.best)
    if best:
        session.best = session.last
        session.save_best(session.last)
    session.run.append(
        "evaluations",
        [{**session.steps, **result.row, "best": best} for result in results],
    )
    session.run.flush(everything=False)
    summary = {
        **session.last.success,
        "mean": session.last.success_mean if session.last.success else None,
    }
    session.events.scalars(progress.env_steps, "evaluation", summary)
    notify("evaluation", {"env_steps": progress.env_steps, "best": best, **summary})


def _save(session: Session) -> None:
    check_parameters(session)
    session.save()


def time_left(session: Session, part: float = 1.0) -> bool:
    """Return whether the first `part` of the budget in seconds leaves time besides evaluating.

    The budget covers all that a user waits for: cloning, updates on the logs, driving, evaluations.
    It is not checked in the first interval of updates, so that there is something to report.
    """
    seconds = session.config.schedule.seconds
    if seconds is None or session.learner.gradient_steps < session.config.record.every_updates:
        return True
    return session.wall_s + session.progress.evaluation_s < part * seconds


def nothing_to_do(session: Session) -> str | None:
    """Return why a resumed run would end at once, and what to do; None if there is work left."""
    progress, schedule = session.progress, session.config.schedule
    if progress.evaluated_at != progress.env_steps or _interval_is_open(session):
        return None  # the last evaluation or the end of an interval is missing
    if not session.config.env.twin:
        return "it learns from logs alone, and has made its updates"
    if progress.env_steps >= schedule.env_steps:
        return (
            f"its budget of {schedule.env_steps:,} environment steps is used up;"
            " give more with --env-steps N"
        )
    if not time_left(session):
        return f"its budget of {schedule.seconds:g} s is used up; give more with --seconds S"
    return None


def _stop_if_requested(session: Session, stop: Callable[[], bool]) -> None:
    """Save and end the run if `stop` returns True.

    An evaluation or another stage that is abandoned here is repeated from its beginning when the
    run is resumed.
    """
    if stop():
        _save(session)
        session.write_held()
        raise TrainingInterrupted(
            f"interrupted after {session.progress.env_steps:,} environment steps and"
            f" {session.learner.gradient_steps:,} updates; a checkpoint was written",
            where=str(session.run.path),
            remedy=f"continue with {resume_command(session.run.path)}",
        )


def _check_loss(session: Session, batch: ReplayBatch, loss: Loss, value: float, phase: str) -> None:
    """Check the loss of the last update, `value`; `session.feed` still has the batch's row ids.

    Raises:
        NotFinite: the loss is not finite; names the rows of the batch that made it so.
    """
    if math.isfinite(value):
        return
    bad_rows = ~np.isfinite(batch.rows.cpu().numpy()).all(axis=1)
    td = loss.td.cpu().numpy()
    bad = bad_rows | ~np.isfinite(td)
    if not bad.any():  # each error is finite, but their sum is not
        bad = np.abs(td) == np.abs(td).max()
    what = f"the loss is {value} ({phase})"
    if bad_rows.any():
        _stop_not_finite(session, what, bad_rows, "hold values that are not finite", LEAVE_OUT)
    if bad.all():
        why = "have such TD errors, after an update that made the parameters NaN or infinite"
        _stop_not_finite(session, what, bad, why, TRAIN_SLOWER, before=True)
    _stop_not_finite(session, what, bad, "have such TD errors, or the largest", TRAIN_SLOWER)


def check_parameters(session: Session) -> None:
    """Check that the parameters are finite, before they are recorded, evaluated or kept.

    Raises:
        NotFinite: a parameter is not finite; names the rows of the last batch.
    """
    if session.learner.is_finite:
        return
    everything = np.ones(len(session.feed.last_batch()), np.bool_)
    what = "the gradient was not finite, and with it the network's parameters"
    _stop_not_finite(session, what, everything, "gave it", TRAIN_SLOWER)


def _stop_not_finite(
    session: Session, what: str, bad: Bools, why: str, remedy: str, *, before: bool = False
) -> NoReturn:
    """Write the run's tables and the batch's rows, then raise NotFinite."""
    session.write_held()
    rows_before = session.feed.last_batch(before=True) if before else []
    rows, path = session.feed.last_batch(), session.run.path
    refuse(what, bad, why, remedy, rows, path, session.steps, rows_before)
