"""The live state of a training run: its parts and clocks, and how to save and restore them.

Every random draw comes from a generator that belongs to one of the parts, and every part is in the
checkpoint, so a resumed run continues exactly as if it had never stopped.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, ClassVar

import msgspec
import numpy as np
import torch

from restock.errors import RunError
from restock.ingest.task.conditions import Condition
from restock.ingest.task.task import Mirror, Task
from restock.replay.sampling.ring import FreshRing
from restock.state import Stateful
from restock.toml import by_path
from restock.train.dqn.config import TrainConfig
from restock.train.dqn.learner import Learner
from restock.train.evaluation.evaluate import EvaluationBuffer, Score, fixed_episodes
from restock.train.evaluation.policies import kept_one, load_kept, make_learner, save_agent
from restock.train.feed.batch_record import FeedRecord
from restock.train.feed.batches import Batches, LogTerms
from restock.train.feed.collector import Collector, FreshStrata, ring_conditions
from restock.train.feed.logs import PROBE_ROWS, LogFidelity, Logs, Probe
from restock.train.feed.practice import Practice
from restock.train.feed.teacher import CheckedTeacher, Imitation
from restock.train.feed.update_blocks import UpdateBlocks
from restock.train.resolve import ASSUMED_STEPS_PER_S, planned_draws, planned_env_steps
from restock.train.run import checkpoint
from restock.train.run.events import Events, tracker_sinks
from restock.train.run.run import Run, RunLock
from restock.train.twin.env.interface import Twin
from restock.train.twin.physics.episode import EpisodeSpec

_MAY_CHANGE = ("schedule.env_steps", "schedule.seconds", "device")  # in a resumed run


@dataclass
class Progress:
    """The counters and times of a run; the learner counts gradient steps."""

    env_steps: int = 0
    online_from: int | None = None  # environment steps when online updates began
    online_updates: int = 0
    evaluated_at: int = -1  # environment steps at the last evaluation
    checkpointed_at: int = 0
    wall_s: float = 0.0  # training time up to the last checkpoint
    driving_from_s: float | None = None  # training time when driving in the twin began
    online_from_s: float | None = None  # training time when online updates began
    offline_update_s: float = 0.0  # mean time of an update on the logs
    evaluation_s: float = 0.0  # time of the last evaluation; before the first, an estimate
    planned_env_steps: int = 0  # environment steps that the shares of batches are planned for


@dataclass
class Interval:
    """Sums since the last row of `progress`."""

    updates: int = 0
    loss: float = 0.0
    episodes: int = 0
    successes: int = 0
    returns: float = 0.0
    env_steps_before: int = 0
    wall_s_before: float = 0.0
    lag_before_sync: float | None = None
    distance_before_sync: float | None = None


@dataclass
class Session(Stateful):
    """The parts of one run. `open_session` puts them together."""

    STATE: ClassVar[tuple[str, ...]] = (
        "progress",
        "interval",
        "best",
        "last",
        "learner",
        "batches",
        "ring",
        "env",
        "collector",
        "practice",
        "feed",
        "probe",
        "imitation",
        "exploration",
    )
    STATE_TYPES: ClassVar[Mapping[str, Any]] = {
        "best": Score | None,
        "last": Score | None,
        "probe": Probe | None,
    }

    run: Run
    config: TrainConfig
    task: Task
    env: Twin
    evaluation_buffer: EvaluationBuffer
    learner: Learner
    ring: FreshRing
    batches: Batches
    collector: Collector
    fixed_episodes: Sequence[EpisodeSpec]  # driven by every evaluation: of all kinds in the config
    feed: FeedRecord
    events: Events
    probe: Probe | None
    exploration: np.random.Generator
    executor: ThreadPoolExecutor
    logs: Logs | None
    log_terms: LogTerms
    practice: Practice
    imitation: Imitation | None  # batches for the behaviour network
    lock: RunLock | None = None  # held while this process writes the run
    blocks: UpdateBlocks | None = None  # makes updates, if the learner is not on the CPU
    progress: Progress = field(default_factory=Progress)
    interval: Interval = field(default_factory=Interval)
    best: Score | None = None
    last: Score | None = None
    _started: float = field(default_factory=time.monotonic)

    @property
    def wall_s(self) -> float:
        """Return the seconds of training, over all processes of the run."""
        return self.progress.wall_s + time.monotonic() - self._started

    @property
    def steps(self) -> dict[str, int]:
        """Return the run's two clocks, the first columns of most of its tables."""
        return {
            "env_steps": self.progress.env_steps,
            "gradient_steps": self.learner.gradient_steps,
        }

    def plan(self) -> None:
        """Plan the shares of batches for the number of environment steps that the budget allows.

        A budget in seconds is converted to steps by the speed so far. After online updates have
        begun, call this only just before a checkpoint, so that a resumed run has the same plan.
        """
        config, progress = self.config, self.progress
        schedule = config.schedule
        end = schedule.env_steps
        if schedule.seconds is not None and progress.online_from is not None:
            left_s = max(schedule.seconds - progress.evaluation_s - self.wall_s, 0.0)
            steps = round(self._steps_per_s() * left_s)
            end = min(end, max(progress.env_steps + steps, progress.env_steps + self.env.num_envs))
        if end != progress.planned_env_steps:
            progress.planned_env_steps = end
            self.batches.replan(planned_draws(config, end))

    def _steps_per_s(self) -> float:
        """Return environment steps per second, updates and evaluations included."""
        progress, wall_s = self.progress, self.wall_s
        if progress.online_from_s is None or progress.driving_from_s is None:
            return ASSUMED_STEPS_PER_S
        made = progress.env_steps - (progress.online_from or 0)
        if made >= self.config.record.every_updates:
            return made / max(wall_s - progress.online_from_s, 1e-9)
        # Too few online steps to measure: add the measured times of a driving step and its updates.
        step_s = (wall_s - progress.driving_from_s) / max(progress.env_steps, 1)
        update_s = self.config.schedule.updates_per_env_step * progress.offline_update_s
        return 1.0 / max(step_s + update_s, 1e-9)

    def save(self) -> None:
        """Write all state to the run's latest checkpoint, and the tables to match it."""
        self.progress.checkpointed_at = self.progress.env_steps
        self.progress.wall_s, self._started = self.wall_s, time.monotonic()
        self.run.flush()
        self.events.flush()
        tables = self.run.row_counts()
        extra = {"tables": tables, "config": self.run.document.get("config")}
        checkpoint.save(self.run.latest, {**self.state_dict(), **extra})

    def write_held(self) -> None:
        """Also write the rows whose episodes have not ended, so that the tables are complete.

        Call this after `save`. A resumed run drops these rows and takes them from its checkpoint.
        """
        self.feed.write_held()
        self.run.flush()

    def open_events(self) -> None:
        """Open the trackers' curves; a resumed run removes points after its checkpoint."""
        run, record = self.run, self.config.record
        from_step = self.progress.env_steps if run.latest.exists() else None
        self.events = Events(run.path, tracker_sinks(run, record.trackers, from_step))

    def restore(self) -> None:
        """Continue from the run's latest checkpoint.

        Raises:
            RunError: there is no checkpoint, the kept policy is missing or damaged, or config.json
                or the logged rows have changed since the run began.
        """
        state = checkpoint.load(self.run.latest)
        _refuse_edited(self.run, state.get("config"))
        if kept_one(state):
            load_kept(self.run)
        before, now = state["probe"], self.probe
        if before is not None and now is not None and before["hash"] != now.hash:
            raise RunError(
                f"was made with other logged rows: its probe is {before['hash']}, that of the "
                f"panel is {now.hash}",
                where=str(self.run.latest),
                remedy="resume with the panel that the run began with, or start another run",
            )
        self.load_state_dict(state)
        schedule = state["config"].get("schedule") if state.get("config") else None
        if schedule is not None and schedule != msgspec.to_builtins(self.config.schedule):
            self.plan()  # the budget was changed
        self.run.truncate(state["tables"])
        self._started = time.monotonic()

    def save_best(self, results: Score) -> None:
        """Keep the current policy as the run's best."""
        save_agent(self.run, self.learner.policy, self.task, results, self.steps)

    def close(self) -> None:
        """Release the thread, the event files and the run."""
        self.executor.shutdown()
        self.events.close()
        if self.lock is not None:
            self.lock.release()


def _refuse_edited(run: Run, before: Mapping[str, Any] | None) -> None:
    """Raise RunError if config.json was edited after the checkpoint, whose config is `before`.

    `before` is None if an earlier Restock wrote the checkpoint.
    """
    if before is None:
        return
    now = dict(by_path(run.document["config"]))
    for key, value in by_path(before):
        if key in now and now[key] != value and key not in _MAY_CHANGE:
            raise RunError(
                f"{key} is {now[key]}, but the run was trained with {value}",
                where=str(run.path / "config.json"),
                remedy="put it back, or train a new run with the other value",
            )


def open_session(
    run: Run,
    config: TrainConfig,
    *,
    task: Task,
    conditions: Sequence[Condition],
    env: Twin,
    evaluation_env: Twin,
    logs: Logs | None,
    teacher: CheckedTeacher | None = None,
    resume: bool = False,
    exposures: Sequence[Condition] = (),
) -> Session:
    """Build the parts of a run, new or from its latest checkpoint."""
    torch.set_num_threads(config.threads)
    seed, judged = config.seed, config.evaluation
    learner = make_learner(config, task)
    names = ring_conditions(conditions)
    strata = None
    if logs is not None and logs.panel is not None:
        strata = FreshStrata.of(logs.panel, [*conditions, *exposures])
    reserved = int(config.replay.ring_capacity * config.replay.ring_reserved / len(names))
    ring = FreshRing(
        config.replay.ring_capacity,
        env.num_envs,
        task.observation_size,
        discount=config.loss.discount,
        n_step=config.loss.n_step,
        conditions=names,
        strata=None if strata is None else strata.names,
        behaviour_policies=("dqn",),
        reserved=dict.fromkeys(names, reserved),
    )
    batches = Batches(
        logs,
        ring,
        batch_size=config.replay.batch_size,
        logs_share=config.replay.logs_share,
        seed=seed,
        fresh=None if strata is None else strata.known,
    )
    executor = ThreadPoolExecutor(1, "twin")
    collector = Collector(env, ring, conditions, task, executor, teacher, strata)
    fidelity = LogFidelity.of(logs, task.observation_size) if logs is not None else None
    session = Session(
        run=run,
        config=config,
        task=task,
        env=env,
        evaluation_buffer=EvaluationBuffer(evaluation_env, task, conditions, ring, fidelity),
        learner=learner,
        ring=ring,
        batches=batches,
        collector=collector,
        fixed_episodes=fixed_episodes(list(config.env.conditions), judged.episodes, judged.seed),
        feed=FeedRecord(
            run,
            logs,
            ring,
            audit_share=config.record.audit_share,
            seed=seed,
            actions=task.action_names,
            greedy=learner.greedy,
            labels=collector.labels,
            perturbations=collector.perturbations,
            quotas=None if strata is None else batches.controller,
        ),
        events=Events(),
        probe=Probe.of_logs(logs, PROBE_ROWS) if logs is not None else None,
        exploration=np.random.default_rng([seed, 5]),
        executor=executor,
        logs=logs,
        log_terms=LogTerms.of(config, logs, learner.device),
        practice=Practice(
            config.practice, env.mission_arms(), env.set_mission_shares, goal=task.goal != "none"
        ),
        imitation=Imitation(
            config.teacher,
            logs,
            ring,
            batch_size=config.replay.batch_size,
            seed=seed,
            mirror=Mirror.of(task) if config.teacher.mirror else None,
        )
        if config.teacher.has_filter
        else None,
    )
    session.collector.check_conditions()
    if resume:
        session.restore()
    else:
        session.collector.reset(seed)
        session.progress.planned_env_steps = planned_env_steps(config)
    if learner.device.type != "cpu":
        session.blocks = UpdateBlocks(
            config, learner, batches, session.imitation, session.log_terms
        )
    return session
