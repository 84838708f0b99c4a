"""Logs and fresh rows in the replay buffer of Stable-Baselines3's off-policy algorithms.

    model = DQN(
        "MlpPolicy",
        env,
        replay_buffer_class=MixtureReplayBuffer,
        replay_buffer_kwargs={"panel": "panel/", "run": "runs/sb3", "ignore_weights": True},
    )
    model.learn(20_000)
    model.replay_buffer.close()

The panel is opened and the run is made when the first step is added or the first batch is drawn:
`DQN.load` creates the buffer, too, and a model that is loaded to act needs neither.

A batch has `logs_share` rows of the panel, by its quotas, and fresh rows for the rest. While there
are no fresh rows, all are logged, so `model.train` can be called before `model.learn`. Each row has
its own discount (gamma^n, with n of the panel or `n_step`), which replaces the model's gamma.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from restock.arrays import F32
from restock.errors import MixtureError
from restock.replay.panel.panel import Panel
from restock.replay.sampling.ring import FreshRing
from restock.replay.sampling.rules import RULES
from restock.replay.store.store import Store
from restock.train.libraries.mixed_feed import FeedOptions, MixedFeed

Critic = Callable[[ReplayBufferSamples], tuple[torch.Tensor, torch.Tensor]]


class MixtureReplayBuffer(ReplayBuffer):
    """A `replay_buffer_class` that mixes a panel of logs with the rows that the algorithm collects.

    `replay_buffer_kwargs` may hold:

    - `panel`: a panel or its directory; without a panel, all rows are fresh.
    - `n_step`, `discount`: of fresh rows; default 1, and the panel's discount or .99.
    - `ignore_weights`: True accepts a panel with importance weights but ignores the weights, which
      Stable-Baselines3's losses cannot use. By default, such a panel is refused.
    - `commands`: (n, 2), the logged command of every row of the panel, for a continuous action
      space; see `logged_commands`. Default: the command of the task's action in the row.
    - `run`, `logs_share`, `profile`, `seed`, `audit_share`, `log_every`: see `FeedOptions`.

    The attribute `critic`, if set, computes (Q, TD) of every batch, (B,) each, for the record.
    `dqn_critic(model)` makes a critic. It costs additional forward passes.

    Raises:
        MixtureError: `optimize_memory_usage` is True; at first use, the panel has weights, or
            `commands` has another shape.
        PanelError: at first use, there is no such panel, or it has another task.
        RunError: at first use, something is at `run` already.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: torch.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        *,
        panel: Panel | str | Path | None = None,
        n_step: int = 1,
        discount: float | None = None,
        ignore_weights: bool = False,
        commands: NDArray[Any] | None = None,
        **options: Any,
    ) -> None:
        if optimize_memory_usage:
            raise MixtureError("optimize_memory_usage is unsupported with a mixture")
        # The parent's arrays are kept tiny: the ring holds the rows, packed like the panel's.
        super().__init__(n_envs, observation_space, action_space, device, n_envs=n_envs)
        self.handle_timeout_termination = handle_timeout_termination
        self.buffer_size = max(buffer_size, n_envs * n_step)
        self.continuous = isinstance(action_space, spaces.Box)
        self._panel, self._commands, self._ignore_weights = panel, commands, ignore_weights
        self._n_step, self._discount = n_step, discount
        self._options = FeedOptions(**options)
        self._fresh_actions = np.zeros((self.buffer_size, self.action_dim), np.float32)
        self._waiting_actions: dict[tuple[int, int], F32] = {}
        self._steps = np.zeros(n_envs, np.int64)  # steps so far in each running episode
        self._log_actions: F32 | None = None
        self.critic: Critic | None = None

    @cached_property
    def feed(self) -> MixedFeed:
        """Return the feed; its first use opens the panel and makes the run."""
        panel = self._panel
        panel = Panel.open(panel, verify=True) if isinstance(panel, str | Path) else panel
        if panel is not None and not self._ignore_weights and is_weighted(panel):
            raise MixtureError(
                "its rows have importance weights, but the losses of Stable-Baselines3 do not use "
                "any",
                where=str(panel.path),
                remedy='mix with `correction = {pre = "none", post = "none"}` and a `within` of'
                f" {', '.join(n for n, rule in RULES.items() if not rule.has_weights)}; or say"
                " ignore_weights=True",
            )
        self._log_actions = self._logged_actions(panel, self._commands)
        return MixedFeed(
            self.buffer_size,
            self.n_envs,
            int(np.prod(self.obs_shape)),
            panel,
            self._options,
            n_step=self._n_step,
            discount=self._discount,
        )

    @property
    def ring(self) -> FreshRing:
        """Return the fresh rows, packed like the panel's."""
        return self.feed.ring

    def _logged_actions(self, panel: Panel | None, commands: NDArray[Any] | None) -> F32 | None:
        """Return logged actions (n, A) in Stable-Baselines3's form: indices or scaled commands."""
        if panel is None:
            return None
        index = panel.rows[:, panel.columns["action"]]
        if not self.continuous:
            return np.ascontiguousarray(index)
        if commands is None:
            commands = np.asarray(panel.task.actions)[index[:, 0].astype(np.int64)]
        if commands.shape != (len(panel), self.action_dim):
            raise MixtureError(
                f"commands have the shape {commands.shape}, not {(len(panel), self.action_dim)}",
                where=str(panel.path),
            )
        low, high = self.action_space.low, self.action_space.high  # type: ignore[attr-defined]
        scaled: F32 = np.float32(2) * (commands - low) / (high - low) - np.float32(1)
        return np.clip(scaled, -1, 1).astype(np.float32)

    def reset(self) -> None:
        """Reset the parent's position; Stable-Baselines3 calls this only to create the buffer."""
        self.pos, self.full = 0, False

    def add(
        self,
        obs: NDArray[Any],
        next_obs: NDArray[Any],
        action: NDArray[Any],
        reward: NDArray[Any],
        done: NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        """Add one step of every environment; `next_obs` is the last of an episode that ended."""
        ring = self.ring
        done = np.asarray(done, np.bool_)
        cut = np.array([bool(info.get("TimeLimit.truncated", False)) for info in infos]) & done
        cut &= self.handle_timeout_termination
        chosen = action.reshape(self.n_envs, self.action_dim)
        index = chosen[:, 0]
        if self.continuous:  # the packed row has the task's nearest action
            index = np.array([info.get("action", 0) for info in infos])
        before = ring.appended
        keys = ring.append(
            observation=np.reshape(obs, (self.n_envs, -1)),
            action=index,
            reward=reward,
            terminated=done & ~cut,
            truncated=cut,
            next_observation=np.reshape(next_obs, (self.n_envs, -1)),
            env_step=self.feed.env_steps,
            gradient_step=self.feed.batches,
            policy_version=self.feed.batches,
        )
        for key, step, taken in zip(keys.tolist(), self._steps.tolist(), chosen, strict=True):
            self._waiting_actions[key, step] = np.array(taken, np.float32)
        # The ring adds an n-step row up to n steps later: look its action up by episode and step.
        for slot in (np.arange(before, ring.appended) % ring.capacity).tolist():
            place = int(ring.meta["episode"][slot]), int(ring.meta["episode_step"][slot])
            self._fresh_actions[slot] = self._waiting_actions.pop(place)
        for env in (env for env, info in enumerate(infos) if info.get("invalid", False)):
            self._drop(int(keys[env]), int(self._steps[env]))
        self._steps = np.where(done, 0, self._steps + 1)
        self.feed.take(np.arange(self.n_envs), keys, done, infos)
        self.pos, self.full = ring.appended % ring.capacity, ring.appended >= ring.capacity

    def _drop(self, key: int, step: int) -> None:
        """Overwrite the row of a step whose physics diverged with a copy of the row before it."""
        meta, ring = self.ring.meta, self.ring
        rows = np.flatnonzero(meta["episode"][: len(ring)] == key)
        steps = meta["episode_step"][rows]
        bad, good = rows[steps == step], rows[steps < step]
        if len(bad) and len(good):
            before = good[np.argmax(meta["episode_step"][good])]
            ring.rows[bad] = ring.rows[before]
            self._fresh_actions[bad] = self._fresh_actions[before]
        self.feed.invalid_steps += 1

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Return a batch: logs first, then fresh rows."""
        feed, ring = self.feed, self.ring
        drawing = feed.draw_logs(batch_size)
        slots = feed.draw_fresh(batch_size - len(drawing.rows))
        parts, actions = [ring.rows[slots]], [self._fresh_actions[slots]]
        if feed.panel is not None and self._log_actions is not None:
            parts.insert(0, feed.panel.rows[drawing.rows])
            actions.insert(0, self._log_actions[drawing.rows])
        packed, action = np.concatenate(parts), np.concatenate(actions)
        samples = self._samples(packed, action, env)
        td = q = None
        if self.critic is not None:
            with torch.no_grad():
                q, td = (part.float().cpu().numpy().ravel() for part in self.critic(samples))
        feed.drawn(packed, drawing, slots, td=td, q=q)
        return samples

    def _samples(self, packed: F32, action: F32, env: VecNormalize | None) -> ReplayBufferSamples:
        column = self.ring.columns
        shape = (len(packed), *self.obs_shape)

        def observed(name: str) -> torch.Tensor:
            part = np.ascontiguousarray(packed[:, column[name]]).reshape(shape)
            return self.to_torch(np.asarray(self._normalize_obs(part, env)))

        discount = packed[:, column["discount"]]
        return ReplayBufferSamples(
            observations=observed("observation"),
            actions=self.to_torch(action if self.continuous else action.astype(np.int64)),
            next_observations=observed("next_observation"),
            dones=self.to_torch((discount == 0).astype(np.float32)),
            rewards=self.to_torch(self._normalize_reward(packed[:, column["reward"]], env)),
            discounts=self.to_torch(discount),
        )

    def close(self) -> None:
        """Write the rest of the record, which completes the run."""
        if "feed" in vars(self):  # else the buffer was never used, and has made no run
            self.feed.flush()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the critic: it refers to the model, which Stable-Baselines3 saves itself."""
        return vars(self) | {"critic": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the buffer, and begin new episodes, as a loaded model resets its environments."""
        vars(self).update(state)
        if "feed" in vars(self):
            self.feed.begin_episodes()
        self._waiting_actions.clear()
        self._steps[:] = 0


def is_weighted(panel: Panel) -> bool:
    """Return whether a panel's rows have importance weights, by a correction or a draw rule."""
    by_rule = any(RULES[stratum.within].has_weights for stratum in panel.strata)
    return by_rule or any(stratum.correction != "none" for stratum in panel.strata)


def dqn_critic(model: Any) -> Critic:
    """Return a function that computes Q and TD of a batch as `stable_baselines3.DQN` does."""

    def critic(samples: ReplayBufferSamples) -> tuple[torch.Tensor, torch.Tensor]:
        after = model.q_net_target(samples.next_observations).max(dim=1, keepdim=True).values
        discount = samples.discounts if samples.discounts is not None else model.gamma
        target = samples.rewards + (1 - samples.dones) * discount * after
        q = model.q_net(samples.observations).gather(1, samples.actions.long())
        return q, q - target

    return critic


def logged_commands(panel: Panel | str | Path, store: str | Path) -> F32:
    """Read the command (m/s, rad/s) of every row of a panel, (n, 2), from the panel's store.

    Raises:
        MixtureError: the store lacks rows of the panel.
    """
    if not isinstance(panel, Panel):
        panel = Panel.open(panel)
    with Store(store) as opened:
        opened.connection.register("wanted", panel.meta.select(["transition_id"]))
        table = opened.connection.sql(
            "SELECT transition_id, command_speed_mps, command_yaw_rate_radps"
            " FROM transitions SEMI JOIN wanted USING (transition_id) ORDER BY transition_id"
        ).to_arrow_table()
    ids = table["transition_id"].to_numpy()
    wanted = panel.meta["transition_id"].to_numpy()
    if (missing := ~np.isin(wanted, ids)).any():
        raise MixtureError(
            f"{missing.sum()} rows of the panel are not in this store",
            where=str(store),
            remedy="give the store from which the panel was made",
        )
    row = np.searchsorted(ids, wanted)
    names = ("command_speed_mps", "command_yaw_rate_radps")
    return np.stack([table[name].to_numpy()[row] for name in names], axis=1).astype(np.float32)
