"""What a new run is refused for, beyond its config's own ranges, before anything is written.

Settings that name what the panel does not have, settings without effect, and a run that the
machine's memory cannot hold.
"""

from __future__ import annotations

import os
from itertools import pairwise

from restock.errors import ConfigError
from restock.ingest.task.task import Task
from restock.replay.panel.panel import Panel
from restock.toml import changed
from restock.train.dqn.config import TrainConfig
from restock.train.feed.logs import check_terms
from restock.train.ring_capacity import row_bytes

_NATURAL = ("floor", "warmup_episodes")
_CRITICS = 6  # copies of the network: online, target, averaged, a gradient, Adam's two
_BEHAVIOURS = 4  # online, a gradient, Adam's two


def check_new_run(config: TrainConfig, task: Task, panel: Panel | None) -> None:
    """Refuse what would fail, or have no effect, once the run has begun.

    Raises:
        ConfigError: as the module says; names the setting.
    """
    _refuse_no_effect(config)
    check_terms(config.loss, panel)
    _refuse_too_large(config, task)


def _refuse_no_effect(config: TrainConfig) -> None:
    practice = config.practice
    if practice.rule == "natural" and (keys := changed(practice, _NATURAL)):
        raise ConfigError(
            f'has no effect under the rule "{practice.rule}"',
            where=f"practice.{keys[0]}",
            remedy="leave it out, or set practice.rule",
        )
    if config.env.missions is None and changed(config.env, ("missions_share",)):
        raise ConfigError(
            "has no effect without missions",
            where="env.missions_share",
            remedy="leave it out, or name a missions file with env.missions",
        )


def _refuse_too_large(config: TrainConfig, task: Task) -> None:
    """Raises ConfigError where the run's largest arrays exceed the machine's memory."""
    critic = _parameters(task.observation_size, config.network.hidden, len(task.actions))
    behaviour = _parameters(task.observation_size, config.teacher.hidden, len(task.actions))
    taken = {
        "replay.ring_capacity": config.replay.ring_rows * row_bytes(task.observation_size),
        "network.hidden": 4 * _CRITICS * critic,
        "teacher.hidden": 4 * _BEHAVIOURS * behaviour if config.teacher.filters else 0,
    }
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    needed, largest = sum(taken.values()), max(taken, key=taken.__getitem__)
    if needed > memory:
        raise ConfigError(
            f"the run needs at least {needed / 1e9:,.1f} GB of memory, {taken[largest] / 1e9:,.1f}"
            f" of them for {largest}; this machine has {memory / 1e9:,.1f}",
            where=largest,
            remedy="give less",
        )


def _parameters(inputs: int, hidden: tuple[int, ...], outputs: int) -> int:
    return sum((a + 1) * b for a, b in pairwise((inputs, *hidden, outputs)))


__all__ = ["check_new_run"]
