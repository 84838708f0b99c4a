"""Restock's updates from a full buffer, as its benchmarks time them, and an update's products."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from train_peers import ACTIONS, DISCOUNT, OBSERVATION, ROWS, Arrays, Updates

from restock.replay.sampling.ring import FreshRing
from restock.train.dqn.config import TrainConfig, parse_config
from restock.train.dqn.learner import Learner
from restock.train.dqn.network import UpdatePath
from restock.train.feed.batch_record import FeedRecord
from restock.train.feed.batches import Batches, LogTerms
from restock.train.feed.fresh_labels import EpisodeLabels
from restock.train.feed.logs import Coded, Logs
from restock.train.feed.update_blocks import MadeUpdate, UpdateBlocks
from restock.train.run.run import Run


def products(
    batch: int, forward: int = 2, backward: int = 1, observation: int = OBSERVATION
) -> Updates:
    """Return the matrix products of an update alone, of so many passes of the batch."""
    sizes = [observation, 256, 256, ACTIONS]
    weights = [torch.randn(after, before) for before, after in itertools.pairwise(sizes)]
    values = [torch.randn(batch, size) for size in sizes]
    into = [torch.empty_like(weight) for weight in weights]

    def update(updates: int) -> None:
        for _ in range(updates):
            for layer in (0, 1, 2) * forward:
                torch.mm(values[layer], weights[layer].t())
            for layer in (2, 1, 0) * backward:
                torch.mm(values[layer + 1].t(), values[layer], out=into[layer])
                if layer:
                    torch.mm(values[layer + 1], weights[layer])

    return update


def config(batch: int, **changes: Any) -> TrainConfig:
    base = {"replay": {"batch_size": batch}, "optimizer": {"learning_rate": 3e-4}}
    return parse_config({**base, **changes}, where="benchmark")


class Restock:
    """Restock's update; with `logs`, half of the batch from logs; with `run`, recorded.

    In `blocks`, as a run on a GPU makes them.
    """

    def __init__(
        self,
        settings: TrainConfig,
        arrays: Arrays,
        *,
        run: Run | None = None,
        logs: bool = False,
        path: UpdatePath | None = None,
        blocks: bool = False,
    ) -> None:
        ring = FreshRing(ROWS, 16, OBSERVATION, discount=DISCOUNT, conditions=("rare", "nominal"))
        discount = DISCOUNT * (1 - arrays["done"])
        columns = [arrays["observation"], arrays["next_observation"], arrays["action"]]
        ring.rows[:] = np.concatenate([*columns, arrays["reward"], discount], axis=1)
        ring.appended = ROWS
        shelf = self._logs(torch.from_numpy(ring.rows.copy())) if logs else None
        self.learner = Learner(settings, OBSERVATION, ACTIONS, path=path)
        self.batches = Batches(
            shelf,
            ring,
            batch_size=settings.replay.batch_size,
            logs_share=0.5 if logs else 0.0,
            seed=0,
        )
        ring.by_condition.move(np.arange(ROWS), 1)  # as where episodes have ended
        self.blocks: UpdateBlocks | None = None
        if blocks:
            none = LogTerms(None)
            self.blocks = UpdateBlocks(settings, self.learner, self.batches, None, none)
        self.feed = None
        if run is not None:
            self.feed = FeedRecord(
                run,
                shelf,
                ring,
                audit_share=0.01,
                seed=0,
                actions=[f"action {index}" for index in range(ACTIONS)],
                greedy=self.learner.greedy,
                labels=EpisodeLabels(),
            )

    @staticmethod
    def _logs(rows: torch.Tensor) -> Logs:
        rare = np.arange(ROWS) < ROWS // 50
        codes = Coded(rare.astype(np.int32), ["nominal", "rare"])
        return Logs(
            rows=rows,
            strata=["nominal", "rare"],
            timings=["pre", "pre"],
            stratum_rows=[np.flatnonzero(~rare), np.flatnonzero(rare)],
            shares=np.array([0.8, 0.2]),
            weights=None,
            as_of_ns=0,
            transition_id=np.arange(ROWS),
            stamp_ns=np.zeros(ROWS, np.int64),
            condition=codes,
            behaviour_policy=codes,
            behaviour_version=codes,
            episode=codes,
        )

    def __call__(self, updates: int) -> None:
        learner = self.learner
        for batch, loss, tail in self._made(updates):
            step = learner.gradient_steps
            if self.feed is not None:
                self.feed.batch(step, step * 4, batch, loss, learner.target.last_sync, tail=tail)
            learner.target.after(step)
            if self.feed is not None and step % 500 == 0:
                self.feed.flush(step * 4, step, "online")

    def _made(self, updates: int) -> Iterator[MadeUpdate]:
        draw, learner = self.batches.draw_online, self.learner
        if self.blocks is not None:
            yield from self.blocks.make(updates, draw, conservative=0.0, labelled=False)
            return
        for _ in range(updates):
            batch = draw()
            rows = batch.rows.to(learner.device)
            yield batch, learner.update(rows, weight=batch.weight, logged=batch.logged), None
