"""What a config leaves open, settled by the panel and the profile before a run begins."""

from __future__ import annotations

import msgspec

from restock.errors import ConfigError
from restock.ingest.profile.profile import Profile
from restock.ingest.task.task import Mirror, Task
from restock.replay.panel.panel import Panel
from restock.replay.sampling.share_controller import PlannedDraws
from restock.train.dqn.config import TeacherConfig, TrainConfig, refuse_untaught
from restock.train.feed.imitation import cloned
from restock.train.missions import mission_orders
from restock.train.twin.env.interface import AFTER_LOGS
from restock.train.twin.physics.perturbation import PERTURBATIONS, find_perturbation


def resolve_config(config: TrainConfig, panel: Panel | None) -> TrainConfig:
    """What the config leaves to whether there is a panel: how to begin online."""
    epsilon = config.epsilon
    if epsilon.start is None:
        learns_first = panel is not None and config.schedule.offline_updates > 0
        epsilon = msgspec.structs.replace(epsilon, start=AFTER_LOGS if learns_first else 1.0)
    env = config.env
    if env.perturbation not in PERTURBATIONS:  # what is in a file may change: the run keeps it
        perturbation = find_perturbation(env.perturbation, where="env.perturbation")
        env = msgspec.structs.replace(env, perturbation=msgspec.to_builtins(perturbation))
    if isinstance(env.missions, str):
        env = msgspec.structs.replace(env, missions=mission_orders(config))
    return msgspec.structs.replace(config, epsilon=epsilon, env=env)


FIRST_GUESS = 800.0  # environment steps a second, of a budget in seconds, until it is measured


def planned_env_steps(config: TrainConfig) -> int:
    """The environment steps that a budget allows, before the speed of this machine is known."""
    schedule = config.schedule
    if schedule.seconds is None:
        return schedule.env_steps
    return min(schedule.env_steps, round(FIRST_GUESS * schedule.seconds))


def planned_draws(config: TrainConfig, env_steps: int | None = None) -> PlannedDraws:
    """The rows that a run will draw in so many environment steps; None: `planned_env_steps`."""
    schedule, batch_size = config.schedule, config.replay.batch_size
    end = planned_env_steps(config) if env_steps is None else env_steps
    begin = min(schedule.warmup_env_steps, end)
    return PlannedDraws(
        offline=schedule.offline_updates * batch_size,
        online=(end - begin) * schedule.updates_per_env_step * batch_size,
        begin_env_steps=begin,
        end_env_steps=end,
    )


_ROWS_OF_UPDATES = 5_000  # as many cloned rows want as many updates as the critic makes
_MAX_UPDATES = 10.0  # times the critic's


def resolve_teacher(config: TrainConfig, profile: Profile, panel: Panel | None) -> TrainConfig:
    """What the config leaves open: the operator drives to goals; where there are none, nobody.

    Raises:
        ConfigError: rows are to be mirrored, and an action has no opposite; successes are to be
            cloned where no goals are logged; a setting has no effect, because nobody teaches.
    """
    teacher = config.teacher
    if teacher.source is None:
        source = "operator" if profile.task.goal == "route" else "none"
        teacher = msgspec.structs.replace(teacher, source=source)
    refuse_untaught(teacher)
    teacher = msgspec.structs.replace(teacher, successes=_clones_successes(teacher, profile))
    if teacher.offline_updates is None:
        rows = 0 if panel is None or not teacher.filters else int(cloned(panel, teacher).sum())
        times = min(max(rows / _ROWS_OF_UPDATES, 1.0), _MAX_UPDATES)
        count = round(config.schedule.offline_updates * times)
        teacher = msgspec.structs.replace(teacher, offline_updates=count)
    if teacher.mirror is not False:
        teacher = msgspec.structs.replace(teacher, mirror=mirrors(teacher, profile.task))
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
    # Where the twin's operator answers from the first step on, they slow it down: docs/train.md.
    return logged and not teacher.asks if teacher.successes is None else teacher.successes


def mirrors(teacher: TeacherConfig, task: Task) -> bool:
    """Whether the behaviour network learns from mirror images, where that is asked or left open.

    Raises ConfigError where it is asked, and an action has no opposite.
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
