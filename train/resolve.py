"""Fill in a config's open settings by panel and profile, and refuse runs that cannot be trained.

Refused are settings that name what the panel does not have, settings without effect, and a ring
larger than the machine's memory. Nothing is written before these checks.
"""

from __future__ import annotations

import os

import msgspec
import numpy as np

from restock.errors import ConfigError
from restock.ingest.profile.profile import Profile
from restock.ingest.task.task import Mirror, Task
from restock.replay.mixture.share_controller import PlannedDraws
from restock.replay.panel.panel import Panel
from restock.replay.sampling.packed_rows import row_width
from restock.replay.sampling.ring import META
from restock.toml import changed
from restock.train.dqn.config import PLANNER, TeacherConfig, TrainConfig, refuse_untaught
from restock.train.feed.batches import check_terms
from restock.train.feed.practice import mission_orders
from restock.train.feed.teacher import select_cloned
from restock.train.twin.env.interface import AFTER_LOGS
from restock.train.twin.physics.perturbation import PERTURBATIONS, find_perturbation


def resolve_config(config: TrainConfig, panel: Panel | None) -> TrainConfig:
    """Fill in the first epsilon, and the content of perturbation and missions files."""
    epsilon = config.epsilon
    if epsilon.start is None:
        learns_first = panel is not None and config.schedule.offline_updates > 0
        epsilon = msgspec.structs.replace(epsilon, start=AFTER_LOGS if learns_first else 1.0)
    env = config.env
    if env.perturbation not in PERTURBATIONS:  # keep a file's content, as it may change later
        perturbation = find_perturbation(env.perturbation, where="env.perturbation")
        env = msgspec.structs.replace(env, perturbation=msgspec.to_builtins(perturbation))
    if isinstance(env.missions, str):
        env = msgspec.structs.replace(env, missions=mission_orders(config))
    return msgspec.structs.replace(config, epsilon=epsilon, env=env)


ASSUMED_STEPS_PER_S = 800.0  # environment steps per second, assumed until the speed is measured


def planned_env_steps(config: TrainConfig) -> int:
    """Return how many environment steps the budget allows; seconds count at an assumed speed."""
    schedule = config.schedule
    if schedule.seconds is None:
        return schedule.env_steps
    return min(schedule.env_steps, round(ASSUMED_STEPS_PER_S * schedule.seconds))


def planned_draws(config: TrainConfig, env_steps: int | None = None) -> PlannedDraws:
    """Count the rows that a run draws in `env_steps`; None: in `planned_env_steps`."""
    schedule, batch_size = config.schedule, config.replay.batch_size
    end = planned_env_steps(config) if env_steps is None else env_steps
    begin = min(schedule.warmup_env_steps, end)
    return PlannedDraws(
        offline=schedule.offline_updates * batch_size,
        online=(end - begin) * schedule.updates_per_env_step * batch_size,
        begin_env_steps=begin,
        end_env_steps=end,
    )


_ROWS_OF_UPDATES = 5_000  # cloned rows up to which cloning makes as many updates as the critic
_MAX_UPDATES = 10.0  # most updates of the behaviour network, in multiples of the critic's


def resolve_teacher(config: TrainConfig, profile: Profile, panel: Panel | None) -> TrainConfig:
    """Fill in the teacher's open settings: the operator teaches if the task has a goal.

    Raises:
        ConfigError: a setting does not apply to the teacher's source, or the profile lacks what a
            setting needs: the planner's commands, logged goals, an opposite of each action.
    """
    teacher = config.teacher
    if teacher.source is None:
        source = "operator" if profile.task.goal == "route" else "none"
        teacher = msgspec.structs.replace(teacher, source=source)
    refuse_untaught(msgspec.structs.replace(config, teacher=teacher))
    if teacher.source == PLANNER and profile.inputs.nav_command is None:
        raise ConfigError(
            f"profile {profile.name} does not read what navigation proposes",
            where="teacher.source",
            remedy="name its topic under [inputs.nav_command], and ingest again; or choose another"
            " source",
        )
    teacher = msgspec.structs.replace(teacher, successes=_clones_successes(teacher, profile))
    if teacher.offline_updates is None:
        rows = 0
        if panel is not None and teacher.has_filter:
            rows = int(select_cloned(panel, teacher).sum())
        times = min(max(rows / _ROWS_OF_UPDATES, 1.0), _MAX_UPDATES)
        count = round(config.schedule.offline_updates * times)
        teacher = msgspec.structs.replace(teacher, offline_updates=count)
    if teacher.mirror is not False:
        teacher = msgspec.structs.replace(teacher, mirror=should_mirror(teacher, profile.task))
    return msgspec.structs.replace(config, teacher=teacher)


def _clones_successes(teacher: TeacherConfig, profile: Profile) -> bool:
    logged = profile.goal_source == "logged"
    if teacher.successes and not logged:
        goals = "are found in hindsight" if profile.goal_source else "do not exist"
        raise ConfigError(
            f"goals {goals} in these logs, so none of their episodes shows a success",
            where="teacher.successes",
            remedy="leave it out, or add drivers to teacher.policies",
        )
    # Cloned successes slow learning down if a teacher is queried in the twin (docs/train.md).
    return logged and not teacher.queried if teacher.successes is None else teacher.successes


def should_mirror(teacher: TeacherConfig, task: Task) -> bool:
    """Decide whether the behaviour network learns from mirror images.

    Raises:
        ConfigError: `teacher.mirror` is true, but an action has no opposite.
    """
    try:
        Mirror.of(task)
    except ValueError as error:
        if teacher.mirror is None:
            return False
        raise ConfigError(
            f"rows cannot be mirrored: {error}",
            where="teacher.mirror",
            remedy="leave it out, or give each turn in both directions in the profile's action "
            "table",
        ) from error
    return teacher.mirror is True or teacher.source == "operator"


_SLOT_BYTES = 18  # bytes of a slot's stratum, position in the stratum, and age


def row_bytes(observation_size: int) -> int:
    """Count the bytes of one row of a ring."""
    meta = sum(np.dtype(kind).itemsize for kind in META.values())
    return row_width(observation_size) * 4 + meta + _SLOT_BYTES


def check_new_run(config: TrainConfig, task: Task, panel: Panel | None) -> None:
    """Refuse settings that would fail, or have no effect, once the run has begun.

    Raises:
        ConfigError: the module's docstring lists when; names the setting.
    """
    _refuse_no_effect(config)
    check_terms(config, panel)
    _refuse_too_large(config, task)


def _refuse_no_effect(config: TrainConfig) -> None:
    if config.env.missions is None and changed(config.env, ("missions_share",)):
        raise ConfigError(
            "has no effect without missions",
            where="env.missions_share",
            remedy="leave it out, or name a missions file with env.missions",
        )


def _refuse_too_large(config: TrainConfig, task: Task) -> None:
    """Raise ConfigError if the ring exceeds the machine's memory.

    The ring takes memory only as it fills, so the run would be killed hours after it began.
    """
    needed = config.replay.ring_capacity * row_bytes(task.observation_size)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > memory:
        raise ConfigError(
            f"needs {needed / 1e9:,.1f} GB of memory; this machine has {memory / 1e9:,.1f}",
            where="replay.ring_capacity",
            remedy="give less",
        )


def without_twin(config: TrainConfig, panel: Panel | None) -> TrainConfig:
    """Return the config of a run without a twin: no environment steps, no teacher in the twin.

    Raises:
        ConfigError: there is no panel, or the teacher needs the twin.
    """
    where = "env.twin"
    if panel is None:
        raise ConfigError(
            "false means learning from the logs alone, but there is no panel",
            where=where,
            remedy="give --panel",
        )
    if config.teacher.source not in (None, "logs", "none", PLANNER):
        raise ConfigError(
            f"false, but the teacher {config.teacher.source!r} needs the twin",
            where=where,
            remedy='use teacher.source = "logs", "planner" or "none"',
        )
    teacher = config.teacher
    if teacher.source is None:
        teacher = msgspec.structs.replace(teacher, source="none")
    schedule = msgspec.structs.replace(config.schedule, env_steps=0)
    practice = msgspec.structs.replace(config.practice, rule="natural")
    return msgspec.structs.replace(config, teacher=teacher, schedule=schedule, practice=practice)
