"""A start by the logs' behaviour: it drives the first steps of episodes, ever fewer of them.

A network that was cloned from the logs (`restock.train.dqn.fitted_q.cloned_behaviour`) acts as
whoever drove then, for a number of steps drawn for each episode, and hands over to what is
being learnt. So the first fresh rows are from where the logs have been, and exploration begins at
ever earlier places (jump-start reinforcement learning, arXiv:2204.02372, with random switching).
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.errors import ConfigError
from restock.state import Stateful
from restock.train.dqn.config import JumpStartConfig
from restock.train.dqn.fitted_q import FittedQConfig, cloned_behaviour, cloned_probabilities
from restock.train.dqn.network import QNetwork
from restock.train.feed.logs import Logs

POLICIES = ("dqn", "cloned", "start")  # who acts, by its code in the ring


class JumpStart(Stateful):
    """Drives N environments for the first steps of their episodes."""

    STATE: ClassVar[tuple[str, ...]] = ("network", "_until", "_rng")

    def __init__(
        self, config: JumpStartConfig, network: QNetwork, num_envs: int, seed: int
    ) -> None:
        self.config, self.network = config, network
        self._until: Ints = np.zeros(num_envs, np.int64)  # step of the episode at which it stops
        self._rng = np.random.default_rng([seed, 6])

    @classmethod
    def of(
        cls,
        config: JumpStartConfig,
        logs: Logs | None,
        size: tuple[int, int, int],
        seed: int,
        *,
        resume: bool = False,
    ) -> JumpStart | None:
        """Cloned from all rows of the logs alike; None where it never drives.

        Args:
            size: environments, observation values, actions.
            resume: its weights come with the checkpoint, so nothing is cloned.

        Raises:
            ConfigError: there are no logs.
        """
        if not config.env_steps:
            return None
        if logs is None:
            raise ConfigError(
                "jump_start.env_steps needs the logs' behaviour, but this run has no logs",
                remedy="give --panel, or leave it out",
            )
        num_envs, observation_size, actions = size
        rows = logs.rows.numpy()
        fit = FittedQConfig(cloning_updates=0) if resume else FittedQConfig()
        network = cloned_behaviour(
            rows[:, :observation_size], rows[:, -3].astype(np.int64), actions, config=fit, seed=seed
        )
        return cls(config, network, num_envs, seed)

    def take_over(
        self,
        action: Ints,
        probability: NDArray[np.float32],
        observation: NDArray[np.float32],
        step: Ints,
        env_steps: int,
        driver: int = 0,
    ) -> tuple[Ints, NDArray[np.float32], NDArray[np.int16]]:
        """Who acts, and how: action (N,), its probability (N,), and the code into POLICIES (N,).

        `action` and `probability` are of who drives otherwise, whose code `driver` is; `step` (N,)
        counts in each episode from 0.
        """
        policy = np.full(len(action), driver, np.int16)
        begins, horizon = np.flatnonzero(step == 0), self.config.horizon(env_steps)
        self._until[begins] = self._rng.integers(horizon + 1, size=len(begins))
        cloned = np.flatnonzero(step < self._until)
        if not len(cloned):
            return action, probability, policy
        of_each = cloned_probabilities(
            self.network, np.ascontiguousarray(observation[cloned])
        )  # (n, A)
        chosen = (self._rng.random((len(cloned), 1)) > of_each.cumsum(axis=1)).sum(axis=1)
        chosen = np.minimum(chosen, of_each.shape[1] - 1)
        action, probability = action.copy(), probability.copy()
        action[cloned] = chosen
        probability[cloned] = of_each[np.arange(len(cloned)), chosen]
        policy[cloned] = POLICIES.index("cloned")
        return action, probability, policy


__all__ = ["POLICIES", "JumpStart"]
