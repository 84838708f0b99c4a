"""Logs and fresh rows in the replay buffer of Tianshou's off-policy algorithms.

    buffer = MixtureVectorReplayBuffer(20_000, len(envs), panel="panel/", run="runs/tianshou")
    collector = Collector(policy, envs, buffer)
    … algorithm.run_training(…)
    buffer.close()

The logs are one more sub-buffer, behind those of the environments, so Tianshou's collectors, n-step
returns and statistics work as they do. Each batch is `logs_share` rows of the panel, by its quotas,
and fresh rows for the rest; all of it logs while nothing is fresh. Importance weights of the panel
are in `batch.weight`, which Tianshou's losses use (its DQN not together with `huber_loss_delta`),
and the TD errors that Tianshou hands back for priorities are recorded by condition.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Unpack, cast

import numpy as np
from numpy.typing import NDArray
from tianshou.data import Batch, ReplayBuffer, ReplayBufferManager

from restock.arrays import F32, Ints
from restock.errors import MixtureError
from restock.replay.panel.logged_sampler import BatchDraw
from restock.replay.panel.panel import Panel
from restock.replay.sampling.packed_rows import row_columns, row_width
from restock.train.libraries.mixed_feed import FeedOptions, MixedFeed, environment_profile

TIANSHOU = "tianshou"


class MixtureVectorReplayBuffer(ReplayBufferManager):
    """A buffer for `buffer_num` environments that mixes a panel of logs with what is collected.

    Args:
        total_size: fresh rows held, over all environments.
        buffer_num: environments.
        panel: a panel of single steps, or its directory; without one all rows are fresh. Its
            discount is not used: the algorithm has its own.
        commands: (n, 2), the command of every row of the panel, for a continuous action space; as
            the algorithm acts, so scaled to [-1, 1] where it scales actions.
        run, logs_share, profile, seed, audit_share, log_every: see `FeedOptions`.

    Raises:
        MixtureError: a panel of n-step rows: Tianshou makes its returns from single steps.
        PanelError: a panel of another task.
    """

    def __init__(
        self,
        total_size: int,
        buffer_num: int,
        *,
        panel: Panel | str | Path | None = None,
        commands: NDArray[Any] | None = None,
        **options: Unpack[FeedOptions],
    ) -> None:
        panel = Panel.open(panel, verify=True) if isinstance(panel, str | Path) else panel
        if panel is not None and panel.n_step != 1:
            raise MixtureError(
                f"its rows span {panel.n_step} steps, but Tianshou computes its own returns",
                where=str(panel.path),
                remedy="mix with `n_step = 1`",
            )
        size = -(-total_size // buffer_num)
        parts = [ReplayBuffer(size) for _ in range(buffer_num)]
        logs = [ReplayBuffer(len(panel))] if panel is not None else []
        super().__init__([*parts, *logs])
        profile = environment_profile(options.get("profile"), panel)
        if profile is not None:
            observation_size = profile.task.observation_size
        else:
            observation_size = panel.observation_size if panel is not None else 0
        self.feed = MixedFeed(TIANSHOU, buffer_num, observation_size, panel=panel, **options)
        self.fresh = self.feed.fresh_meta(size * buffer_num)
        self.feed.keep_record(self.fresh)
        self._columns, self._width = row_columns(observation_size), row_width(observation_size)
        self._sampled: tuple[BatchDraw, Ints] | None = None
        if panel is not None:
            self._lay_out(panel, commands)

    def _lay_out(self, panel: Panel, commands: NDArray[Any] | None) -> None:
        """Allocate memory for all rows, and copy the panel's into it."""
        rows, column, begin = panel.rows, panel.columns, self.fresh.capacity
        action = rows[:, column["action"]][:, 0].astype(np.int64)
        acts = action if commands is None else np.asarray(commands, np.float32)
        terminated = rows[:, column["discount"]][:, 0] == 0
        values = {
            "obs": rows[:, column["observation"]],
            "obs_next": rows[:, column["next_observation"]],
            "act": acts,
            "rew": rows[:, column["reward"]][:, 0].astype(np.float64),
            "terminated": terminated,
            "truncated": ~terminated,
            "done": np.ones(len(panel), np.bool_),  # so that no return reaches beyond a row
        }
        whole = Batch()
        for name, part in values.items():
            array = np.zeros((self.maxsize, *part.shape[1:]), part.dtype)
            array[begin:] = part
            whole[name] = array
        self.set_batch(cast(Any, whole))
        self._fill_logs(len(panel))

    def _fill_logs(self, count: int) -> None:
        """Mark the logs' sub-buffer as full."""
        logs = self.buffers[-1]
        logs._size, logs._insertion_idx = count, 0
        logs.last_index[0] = count - 1
        self._lengths[-1] = count
        self.last_index[-1] = self.fresh.capacity + count - 1

    def reset(self, keep_statistics: bool = False) -> None:
        """Empty the fresh part and keep the logs."""
        self.feed.flush()  # no labels will come of episodes that are cut off here
        super().reset(keep_statistics=keep_statistics)
        self.fresh.forget()
        if self.feed.panel is not None:
            self._fill_logs(len(self.feed.panel))

    def add(
        self, batch: Any, buffer_ids: NDArray[Any] | list[int] | None = None
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Add one step of some environments; `info` is used for labels only, and not kept."""
        envs = np.arange(self.fresh.num_envs) if buffer_ids is None else np.asarray(buffer_ids)
        names = ("obs", "act", "rew", "terminated", "truncated", "obs_next")
        step = Batch({name: batch[name] for name in names})
        step["done"] = np.logical_or(batch.terminated, batch.truncated)
        if self.feed.record is not None and np.ndim(batch.act) > 1:  # commands: they have no names
            self.feed.record.actions = None
        placed = super().add(cast(Any, step), envs)
        slots = np.asarray(placed[0], np.int64).ravel()
        ended = np.asarray(step["done"], np.bool_)
        keys = self.fresh.write(
            slots, envs, ended, env_step=self.feed.env_steps, gradient_step=self.feed.batches
        )
        info = batch.get("info", Batch())
        infos = [_one(info, place) for place in range(len(envs))]
        bad = np.array([bool(one.get("invalid", False)) for one in infos])
        self.fresh.filled[slots[bad]] = False  # whose physics blew up: never drawn
        self.feed.invalid_steps += int(bad.sum())
        self.feed.take(envs, keys, ended, infos)
        return placed

    def sample_indices(self, batch_size: int | None) -> NDArray[Any]:
        """Draw rows by the mixture, logs first; return all in order for 0 or None."""
        if not batch_size or batch_size < 0:
            return super().sample_indices(batch_size)
        drawing = self.feed.draw_logs(batch_size)
        filled = np.flatnonzero(self.fresh.filled)
        slots = self.feed.sample_fresh(filled, batch_size - len(drawing.rows))
        self._note(None)  # an algorithm that gave no TD errors for the batch before
        self._sampled = (drawing, slots)
        return np.concatenate([self.fresh.capacity + drawing.rows, slots])

    def sample(self, batch_size: int | None) -> tuple[Any, NDArray[Any]]:
        """Return a batch with its weights, and where its rows are."""
        index = self.sample_indices(batch_size)
        batch: Any = self[index]
        weight = np.ones(len(index), np.float32)
        if self._sampled is not None and (drawn := self._sampled[0].weight) is not None:
            weight[: len(drawn)] = drawn
        batch.weight = weight
        return batch, index

    def update_weight(self, index: NDArray[Any], new_weight: Any) -> None:
        """Take Tianshou's TD errors (target - Q) of the batch it just learnt from."""
        if hasattr(new_weight, "detach"):
            new_weight = new_weight.detach().cpu().numpy()
        td = -np.asarray(new_weight, np.float32).reshape(-1)
        self._note(td if len(td) == len(index) else None)

    def _note(self, td: F32 | None) -> None:
        if self._sampled is None:
            return
        (drawing, slots), self._sampled = self._sampled, None
        log_rows = drawing.rows
        packed = np.empty((len(log_rows) + len(slots), self._width), np.float32)
        weight = None
        if drawing.weight is not None:
            weight = np.ones(len(packed), np.float32)
            weight[: len(log_rows)] = drawing.weight
        if self.feed.panel is not None:
            packed[: len(log_rows)] = self.feed.panel.rows[log_rows]
        if len(slots):
            self._pack(packed[len(log_rows) :], slots)
        self.feed.drawn(packed, drawing, slots, weight=weight, td=td)

    def _pack(self, packed: F32, slots: Ints) -> None:
        """Pack fresh rows for the record; their discount only tells whether they terminated."""
        column, rows = self._columns, cast(Any, self._meta)
        packed[:, column["observation"]] = rows.obs[slots]
        packed[:, column["next_observation"]] = rows.obs_next[slots]
        act = np.asarray(rows.act[slots])
        packed[:, column["action"]] = act[:, None] if act.ndim == 1 else 0
        packed[:, column["reward"]] = np.asarray(rows.rew[slots])[:, None]
        packed[:, column["discount"]] = ~np.asarray(rows.terminated[slots])[:, None]

    def close(self) -> None:
        """Write the rest of the record; the run is complete after it."""
        self._note(None)
        self.feed.flush()


def _one(info: Any, place: int) -> dict[str, Any]:
    """Return one environment's info out of a Batch of infos."""
    one: dict[str, Any] = {}
    for name in info.get_keys():
        value = info[name]
        one[name] = _one(value, place) if isinstance(value, Batch) else value[place]
    return one
