"""Stable-Baselines3's DQN and PPO in the twin, with a record of what they learnt from.

Both return how many environment steps and updates they made. DQN's rows are drawn and recorded by
`MixtureReplayBuffer` without a panel: uniformly, from the last `buffer_size`. PPO keeps nothing:
each step of a rollout is learnt from `n_epochs` times, and that is what its record says.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from restock.arrays import Ints
from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile
from restock.train.dqn.config import TrainConfig
from restock.train.feed.batch_record import check_kept
from restock.train.feed.collector import conditions_in_twin
from restock.train.feed.practice import mission_orders
from restock.train.libraries.library_arm import Evaluations, as_network
from restock.train.libraries.mixed_feed import InfoLabels, PartialTables, episode_row
from restock.train.libraries.sb3_buffer import MixtureReplayBuffer, dqn_critic
from restock.train.run.run import Run
from restock.train.twin.physics.perturbation import find_perturbation

UNLABELLED = "unlabelled"


def _environment(config: TrainConfig) -> Any:
    return make_vec_env(
        "restock/Warehouse-v0",
        n_envs=config.env.num_envs,
        seed=config.seed,
        env_kwargs={
            "conditions": dict(config.env.conditions),
            "perturbation": find_perturbation(config.env.perturbation, where="env.perturbation"),
            "layouts": config.env.layouts,
            "missions": mission_orders(config),
            "missions_share": config.env.missions_share,
        },
    )


def _made(kind: Any, config: TrainConfig, arguments: dict[str, Any], **ours: Any) -> Any:
    """Return the algorithm. Raises ConfigError for arguments that it does not take."""
    torch.set_num_threads(config.threads)
    env = _environment(config)
    try:
        return kind("MlpPolicy", env, seed=config.seed, device=config.device, **ours, **arguments)
    except (TypeError, ValueError, AssertionError) as error:
        raise ConfigError(
            f"Stable-Baselines3's {kind.__name__} refused its arguments: {error}",
            where="arguments",
            remedy="see its documentation for its arguments, and docs/compare.md for those that "
            "Restock sets",
        ) from error


def dqn(
    config: TrainConfig, arguments: dict[str, Any], run: Run, evaluations: Evaluations
) -> tuple[int, int]:
    """Train a DQN to the end of the budget."""
    model = _made(
        DQN,
        config,
        arguments,
        replay_buffer_class=MixtureReplayBuffer,
        replay_buffer_kwargs={
            "n_step": config.loss.n_step,
            "discount": arguments["gamma"],
            "profile": config.profile,
            "seed": config.seed,
            "audit_share": config.record.audit_share,
            "log_every": config.record.every_updates,
        },
        policy_kwargs={"net_arch": list(config.network.hidden)},
    )
    buffer: Any = model.replay_buffer
    buffer.critic = dqn_critic(model)
    buffer.feed.run = run
    drive = _Drive(config, evaluations, [model.q_net.q_net], lambda: buffer.feed.batches)
    model.learn(config.schedule.env_steps, callback=drive)
    buffer.close()
    return drive.end()


def ppo(
    config: TrainConfig, arguments: dict[str, Any], run: Run, evaluations: Evaluations
) -> tuple[int, int]:
    """Train a PPO; its last rollout ends at the budget, and is not learnt from if that cuts it."""
    model = _made(
        PPO,
        config,
        arguments,
        policy_kwargs={
            "net_arch": list(config.network.hidden),
            "activation_fn": torch.nn.ReLU,  # so that the actor is a network of Restock's
        },
    )
    fed = _OnPolicyFeed(config, run, model)
    parts = [model.policy.mlp_extractor.policy_net, model.policy.action_net]
    drive = _Drive(config, evaluations, parts, lambda: fed.updates)
    try:
        model.learn(config.schedule.env_steps, callback=[fed, drive])
    except ValueError:  # what its distributions say of logits that are NaN
        drive.check()
        raise
    fed.close()
    return drive.end()


class _Drive(BaseCallback):
    """A callback that evaluates the linear layers of `parts` at intervals and at the end."""

    def __init__(
        self,
        config: TrainConfig,
        evaluations: Evaluations,
        parts: list[torch.nn.Module],
        updates: Callable[[], int],
    ) -> None:
        super().__init__()
        self.config, self.evaluations, self.updates = config, evaluations, updates
        modules = [module for part in parts for module in part.modules()]
        self.linears = [module for module in modules if isinstance(module, torch.nn.Linear)]

    def _on_step(self) -> bool:
        if self.evaluations.due(self.num_timesteps):
            self._evaluate()
        return True

    def end(self) -> tuple[int, int]:
        """Return how many environment steps and updates were made, the last of them evaluated."""
        if self.evaluations.at != self.num_timesteps:
            self._evaluate()
        return self.num_timesteps, self.updates()

    def _on_rollout_start(self) -> None:
        self.check()

    def check(self) -> None:
        """Raise NotFinite if an update has left a parameter that is not finite."""
        finite = all(p.isfinite().all() for layer in self.linears for p in layer.parameters())
        steps = {"env_steps": self.num_timesteps, "gradient_steps": self.updates()}
        check_kept(finite, self.evaluations.run.path, steps)

    def _evaluate(self) -> None:
        self.check()
        network = as_network(self.config, self.evaluations.task, self.linears)
        self.evaluations.drive(network, self.num_timesteps, self.updates())


class _OnPolicyFeed(BaseCallback):
    """The record of an on-policy algorithm's feed: all steps of a rollout, for some epochs."""

    def __init__(self, config: TrainConfig, run: Run, model: PPO) -> None:
        super().__init__()
        definition = load_profile(config.profile)
        self.run, self.tables = run, PartialTables(run)
        self.count, self.epochs = model.n_envs, int(model.n_epochs)
        self.budget, self.rollout_calls = config.schedule.env_steps, model.n_steps
        rollout = model.n_steps * model.n_envs
        self.updates_a_rollout = self.epochs * math.ceil(rollout / model.batch_size)
        self.updates = self.shown = self.calls = self.fed_calls = 0
        self.labels = InfoLabels(
            conditions_in_twin(
                definition.conditions, definition.signals, lidar=definition.task.lidar
            )[0],
            self.count,
        )
        self.keys = np.arange(self.count)
        self.began = np.zeros(self.count, np.int64)  # the call that each episode began with
        self.ended: dict[int, tuple[int, int, dict[str, Any]]] = {}  # key -> first, steps, row
        self.clock = time.monotonic()

    def _on_step(self) -> bool:
        self.calls += 1
        for env, (info, done) in enumerate(
            zip(self.locals["infos"], self.locals["dones"].tolist(), strict=True)
        ):
            key = int(self.keys[env])
            self.labels.step(env, info, ended=done, key=key)
            if done:
                clocks = {"env_steps": self.num_timesteps, "gradient_steps": self.updates}
                first = int(self.began[env])
                row = episode_row(env, key, info) | clocks
                self.ended[key] = first, self.calls - first, row
                self.keys[env] += self.count
                self.began[env] = self.calls
        # The budget may cut a rollout short; one that just became whole is learnt from first.
        return self.num_timesteps < self.budget or self.calls % self.rollout_calls == 0

    def _on_rollout_end(self) -> None:
        """Count the updates of a complete rollout, just before they are made."""
        self.updates += self.updates_a_rollout
        self.fed_calls = self.calls
        self._write()

    def close(self) -> None:
        """Write the remaining episodes, which began before the last rollout's end."""
        self._write()
        running = {
            int(key): max(self.fed_calls - int(first), 0)
            for key, first in zip(self.keys, self.began, strict=True)
        }
        self._fed([(UNLABELLED, key, steps) for key, steps in running.items() if steps])
        self.run.flush()

    def _write(self) -> None:
        codes: dict[int, Ints] = {}
        for labelled in self.labels.label(all_of_them=True):
            codes[labelled.key] = labelled.codes
            self.ended[labelled.key][2]["conditions"] = labelled.conditions
        rows = []
        for key, (first, steps, _) in self.ended.items():
            learnt = min(max(self.fed_calls - first, 0), steps)
            names = [self.labels.names[code] for code in codes.get(key, [])[:learnt]]
            names = names or [UNLABELLED] * learnt
            rows += [(name, key, names.count(name)) for name in dict.fromkeys(names)]
        self._fed(rows)
        self.tables.append("episodes", [row for *_, row in self.ended.values()])
        self.tables.append(
            "progress",
            [
                {
                    "env_steps": self.num_timesteps,
                    "gradient_steps": self.updates,
                    "wall_s": time.monotonic() - self.clock,
                    "phase": "online",
                    "updates": self.updates - self.shown,
                    "target_rule": "none",
                    "logs_share": 0.0,
                    "ring_rows": 0,
                }
            ],
        )
        self.ended, self.shown = {}, self.updates
        self.run.flush()

    def _fed(self, rows: list[tuple[str, int, int]]) -> None:
        clocks = {"env_steps": self.num_timesteps, "gradient_steps": max(self.updates, 1)}
        self.run.append(
            "sampled_episodes",
            [
                {
                    **clocks,
                    "source": "fresh",
                    "stratum": name,
                    "condition": name,
                    "episode": str(key),
                    "drawn_rows": steps * self.epochs,
                    "weight": float(steps * self.epochs),
                }
                for name, key, steps in rows
            ],
        )
