"""A run's updates with its learner on a GPU: drawn and recorded here, made there.

The samplers that a run on the CPU has draw the batches, so that a seed feeds the same rows to both;
row numbers, a few kilobytes, go to the device, which holds the logs' rows and a mirror of the ring.
While the device makes one block of updates, the next is drawn and the one before is recorded: the
host waits once a block, if at all. If a draw depends on the TD errors of the batch before
(priorities), a block has one update, and the host waits after each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from restock.errors import MixtureError
from restock.replay.sampling.ring import FreshRing
from restock.train.dqn.algorithm import Loss
from restock.train.dqn.behaviour import Labelled
from restock.train.dqn.captured_update import CapturedUpdates, Launched, UpdateBlock
from restock.train.dqn.config import TrainConfig
from restock.train.dqn.learner import Learner
from restock.train.feed.batches import Batches, ReplayBatch
from restock.train.feed.imitation import Imitation
from restock.train.feed.logs import LogTerms

LONGEST = 16  # updates of a block
# A batch, its loss and its rows' action, reward and discount (B, 3), if they are at hand.
Made = tuple[ReplayBatch, Loss, Tensor | None]


class DeviceTable:
    """The packed rows of logs and ring on the device: the logs' first, then the ring's slots."""

    def __init__(self, logs: Tensor | None, ring: FreshRing, device: torch.device) -> None:
        self.logs = 0 if logs is None else len(logs)
        self._ring, self._ring_rows = ring, torch.from_numpy(ring.rows)
        self.rows = torch.empty(
            (self.logs + ring.capacity, ring.rows.shape[1]), dtype=torch.float32, device=device
        )
        if logs is not None:
            self.rows[: self.logs] = logs
        self.rows[self.logs :] = self._ring_rows
        ring.written = []

    def follow(self) -> None:
        """Take over what was written into the ring since the last call."""
        if not self._ring.written:
            return
        slots = torch.from_numpy(np.unique(np.concatenate(self._ring.written)))
        self._ring.written.clear()
        values, place = self._ring_rows[slots], self.logs + slots
        if self.rows.is_cuda:
            values, place = values.pin_memory(), place.pin_memory()
        device = self.rows.device
        self.rows.index_copy_(
            0, place.to(device, non_blocking=True), values.to(device, non_blocking=True)
        )


class UpdateBlocks:
    """Makes a learner's updates in blocks; create it after the session is restored."""

    def __init__(
        self,
        config: TrainConfig,
        learner: Learner,
        batches: Batches,
        imitation: Imitation | None,
        log_terms: LogTerms,
    ) -> None:
        self.learner, self.batches, self.imitation = learner, batches, imitation
        logs, ring = batches.logs, batches.ring
        self._table: DeviceTable | None = None
        if not batches.reads_chunks:
            self._table = DeviceTable(None if logs is None else logs.rows, ring, learner.device)
        self._logs = 0 if logs is None else len(logs)

        expert = log_terms.expert
        if expert is not None:
            expert = torch.cat([expert, expert.new_zeros(ring.capacity)])

        self._updates = CapturedUpdates(
            learner,
            None if self._table is None else self._table.rows,
            batch_size=config.replay.batch_size,
            width=ring.rows.shape[1],
            longest=LONGEST,
            labelled=0 if imitation is None else imitation.batch_size,
            has_conservative=logs is not None
            and max(config.loss.conservative, config.loss.conservative_online) > 0,
            expert=expert,
        )

    def make(
        self, count: int, draw: Callable[[], ReplayBatch], *, conservative: float, labelled: bool
    ) -> Iterator[Made]:
        """`count` updates, each counted by the learner when it is given out.

        Args:
            draw: the next batch.
            conservative: weight of the CQL term.
            labelled: whether the behaviour network learns too.

        Raises:
            MixtureError: `draw` did; the updates before it were made and given out.
        """
        longest = 1 if self.batches.needs_td else LONGEST
        waiting: list[ReplayBatch] = []
        launched: Launched | None = None
        while count:
            drawn, failed = _drawn(draw, min(longest, count))
            before, made = waiting, launched
            if drawn:
                launched = self._launch(drawn, conservative, labelled, ahead=len(before))
            if made is not None:
                yield from self._given_out(before, made, labelled)
            waiting, count = drawn, count - len(drawn)
            if launched is not None and (self.batches.needs_td or failed is not None):
                yield from self._given_out(waiting, launched, labelled)
                waiting, launched = [], None
            if failed is not None:
                raise failed
        if launched is not None:
            yield from self._given_out(waiting, launched, labelled)

    def _launch(
        self, drawn: Sequence[ReplayBatch], conservative: float, labelled: bool, ahead: int
    ) -> Launched:
        if self._table is not None:
            self._table.follow()
        rows = [np.concatenate([batch.log_rows, self._logs + batch.slots]) for batch in drawn]
        ones = torch.ones(len(rows[0]))
        weight = [ones if batch.weight is None else batch.weight for batch in drawn]
        labels: Labelled | None = None
        if labelled and self.imitation is not None:
            each = [self.imitation.draw_online() for _ in drawn]
            labels = Labelled(
                torch.stack([of.observation for of in each]),
                torch.stack([of.action for of in each]),
            )
        block = UpdateBlock(
            rows=torch.from_numpy(np.stack(rows)),
            packed=torch.stack([batch.rows for batch in drawn]) if self._table is None else None,
            weight=torch.stack(weight),
            logged=torch.tensor([float(batch.logged) for batch in drawn]),
            conservative=torch.full((len(drawn),), conservative),
            labelled=labels,
        )
        return self._updates.launch(block, ahead)

    def _given_out(
        self, drawn: Sequence[ReplayBatch], launched: Launched, labelled: bool
    ) -> Iterator[Made]:
        outcome = launched.outcome()
        for k, batch in enumerate(drawn):
            self.learner.count(1, labelled=labelled)
            yield batch, Loss(outcome.loss[k], outcome.td[k], outcome.q[k]), outcome.tail[k]


def _drawn(
    draw: Callable[[], ReplayBatch], count: int
) -> tuple[list[ReplayBatch], MixtureError | None]:
    """Batches, and what ended them early."""
    batches: list[ReplayBatch] = []
    for _ in range(count):
        try:
            batches.append(draw())
        except MixtureError as error:
            return batches, error
    return batches, None


__all__ = ["DeviceTable", "UpdateBlocks"]
