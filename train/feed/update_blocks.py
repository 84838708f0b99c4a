"""Updates with the learner on a GPU: batches are drawn and recorded on the host.

The batches are drawn by the same samplers as on the CPU, so that a seed feeds the same rows to
both. Only row numbers, a few kilobytes, go to the device, which holds the logs' rows and a copy of
the ring. While the device makes one block of updates, the next block is drawn and the one before is
recorded: the host waits once per block, if at all. If a draw depends on the TD errors of the batch
before (priorities), a block has one update, and the host waits after each.

A GPU makes an update of such a network in a fifth of a millisecond, in some seventy small kernels;
launching them one by one takes the host six times as long. So an update's kernels (gather, losses,
gradients, Adam, the averages, the target's update) are captured in a CUDA graph once. The inputs
that differ between updates (row numbers, weights, rates) are copied to the device for a whole
block, with a cursor to the next update. On the CPU, the same operations run one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from restock.replay.sampling.ring import FreshRing
from restock.train.dqn.algorithm import Loss
from restock.train.dqn.behaviour import Labelled
from restock.train.dqn.config import TrainConfig
from restock.train.dqn.learner import Learner, Terms
from restock.train.dqn.network import averaging_rate
from restock.train.feed.batches import Batches, LogTerms, ReplayBatch, draw_ahead
from restock.train.feed.teacher import Imitation

LONGEST = 16  # most updates in a block
# A batch, its loss, and its rows' action, reward and discount (B, 3); None: read from the batch.
MadeUpdate = tuple[ReplayBatch, Loss, Tensor | None]


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
        """Copy the slots that were written into the ring since the last call."""
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
    """A learner's updates in blocks. It copies the ring, so create it after restoring a session."""

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
        self._table = DeviceTable(None if logs is None else logs.rows, ring, learner.device)
        self._logs = 0 if logs is None else len(logs)

        expert = log_terms.expert
        if expert is not None:
            expert = torch.cat([expert, expert.new_zeros(ring.capacity)])

        self._updates = CapturedUpdates(
            learner,
            self._table.rows,
            batch_size=config.replay.batch_size,
            longest=LONGEST,
            labelled=0 if imitation is None else imitation.batch_size,
            has_conservative=logs is not None and config.loss.conservative > 0,
            expert=expert,
        )

    def make(
        self, count: int, draw: Callable[[], ReplayBatch], *, conservative: float, labelled: bool
    ) -> Iterator[MadeUpdate]:
        """Make `count` updates, and yield each once the learner has counted it.

        Args:
            draw: draws the next batch.
            conservative: weight of the CQL term.
            labelled: whether the behaviour network learns, too.

        Raises:
            MixtureError: `draw` raised it; the updates on all earlier batches were yielded.
        """
        longest = 1 if self.batches.needs_td else LONGEST
        waiting: list[ReplayBatch] = []
        launched: Launched | None = None
        while count:
            drawn, failed = draw_ahead(draw, min(longest, count))
            before, made = waiting, launched
            if drawn:
                launched = self._launch(drawn, conservative, labelled, ahead=len(before))
            if made is not None:
                yield from self._yield_updates(before, made, labelled)
            waiting, count = drawn, count - len(drawn)
            if launched is not None and (self.batches.needs_td or failed is not None):
                yield from self._yield_updates(waiting, launched, labelled)
                waiting, launched = [], None
            if failed is not None:
                raise failed
        if launched is not None:
            yield from self._yield_updates(waiting, launched, labelled)

    def _launch(
        self, drawn: Sequence[ReplayBatch], conservative: float, labelled: bool, ahead: int
    ) -> Launched:
        self._table.follow()
        rows = [np.concatenate([batch.log_rows, self._logs + batch.slots]) for batch in drawn]
        ones = torch.ones(len(rows[0]))
        weight = [ones if batch.weight is None else batch.weight for batch in drawn]
        labels: Labelled | None = None
        if labelled and self.imitation is not None:
            batches = [self.imitation.draw_online() for _ in drawn]
            labels = Labelled(
                torch.stack([batch.observation for batch in batches]),
                torch.stack([batch.action for batch in batches]),
            )
        block = UpdateBlock(
            rows=torch.from_numpy(np.stack(rows)),
            weight=torch.stack(weight),
            logged=torch.tensor([float(batch.logged) for batch in drawn]),
            conservative=torch.full((len(drawn),), conservative),
            labelled=labels,
        )
        return self._updates.launch(block, ahead)

    def _yield_updates(
        self, drawn: Sequence[ReplayBatch], launched: Launched, labelled: bool
    ) -> Iterator[MadeUpdate]:
        outcome = launched.outcome()
        for k, batch in enumerate(drawn):
            self.learner.count(1, labelled=labelled)
            yield batch, Loss(outcome.loss[k], outcome.td[k], outcome.q[k]), outcome.tail[k]


_WARM_UP = 3  # updates before the capture: libraries allocate memory in their first calls


@dataclass(frozen=True)
class UpdateBlock:
    """The inputs of K consecutive updates, on the host."""

    rows: Tensor  # (K, B) int64, row numbers in the table
    weight: Tensor  # (K, B) float32
    logged: Tensor  # (K,) float32: how many of the first rows are from logs
    conservative: Tensor  # (K,) float32
    labelled: Labelled | None  # (K, M, D), (K, M): what the behaviour network learns from

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class Outcome:
    """The results of K updates, on the host."""

    td: Tensor  # (K, B) float32
    q: Tensor  # (K, B) float32
    tail: Tensor  # (K, B, 3) float32: action, reward and discount of the rows
    loss: Tensor  # (K,) float32


class Launched:
    """Updates that the device may still be computing."""

    def __init__(self, per_row: Tensor, loss: Tensor) -> None:
        pinned = per_row.is_cuda
        self._per_row, self._loss = (
            torch.empty(each.shape, dtype=each.dtype, pin_memory=pinned).copy_(
                each, non_blocking=True
            )
            for each in (per_row, loss)
        )
        self._event: torch.cuda.Event | None = None
        if pinned:
            self._event = torch.cuda.Event()  # type: ignore[no-untyped-call]
            self._event.record()

    def outcome(self) -> Outcome:
        """Wait for the updates, and return their results."""
        if self._event is not None:
            self._event.synchronize()
        td, q, *tail = self._per_row.unbind(dim=1)
        return Outcome(td, q, torch.stack(tail, dim=2), self._loss)


class CapturedUpdates:
    """A learner's updates as a captured graph, in blocks of up to `longest`.

    Call `Learner.count` for each update when its outcome is used.

    Args:
        learner: the learner whose parameters are updated.
        table: (n, W) float32 on the learner's device; the rows of a block are rows of this table.
        batch_size: B.
        longest: K, most updates in a block.
        labelled: M, the behaviour network's batch size; 0: it does not learn.
        has_conservative: whether the CQL term may have a weight above 0.
        expert: (n,) bool, rows to which the margin term applies; None: no row.
    """

    def __init__(
        self,
        learner: Learner,
        table: Tensor,
        *,
        batch_size: int,
        longest: int,
        labelled: int = 0,
        has_conservative: bool = False,
        expert: Tensor | None = None,
    ) -> None:
        self.learner, self.table, self.longest = learner, table, longest
        self._has_conservative = has_conservative
        self._expert = expert
        device, batch = learner.device, (longest, batch_size)
        self._place = torch.arange(batch_size, device=device)
        self._cursor = torch.zeros(1, dtype=torch.int64, device=device)
        self._rows = torch.zeros(batch, dtype=torch.int64, device=device)
        self._weight = torch.ones(batch, device=device)
        # For each update: logged rows, weight of CQL, rates of the two averages.
        self._scalars = torch.zeros(longest, 4, device=device)
        self._labelled: Labelled | None = None
        if labelled:
            states = torch.zeros(
                (longest, labelled, learner.network.observation_size), device=device
            )
            answers = torch.zeros((longest, labelled), dtype=torch.int64, device=device)
            self._labelled = Labelled(states, answers)
        # TD error, Q, action, reward and discount of each row; the loss of each update.
        self._per_row = torch.zeros(longest, 5, batch_size, device=device)
        self._loss = torch.zeros(longest, device=device)
        self._graphs: dict[bool, torch.cuda.CUDAGraph] = {}

    def launch(self, block: UpdateBlock, ahead: int = 0) -> Launched:
        """Start the block's updates on the device, and return before they are done.

        `ahead` is the number of updates that were launched before and are not counted yet.
        """
        count, labels = len(block), block.labelled is not None
        if count > self.longest:
            raise ValueError(f"a block of {count} updates; at most {self.longest}")
        self._send(self._rows, block.rows)
        self._send(self._weight, block.weight)
        self._send(self._scalars, self._scalars_of(block, ahead))
        if block.labelled is not None and self._labelled is not None:
            self._send(self._labelled.observation, block.labelled.observation)
            self._send(self._labelled.action, block.labelled.action)
        if self._rows.is_cuda and labels not in self._graphs:
            self._graphs[labels] = self._capture(labels)
        self._cursor.zero_()
        for _ in range(count):
            if self._rows.is_cuda:
                self._graphs[labels].replay()
            else:
                self._update_once(labels)
        return Launched(self._per_row[:count], self._loss[:count])

    def _scalars_of(self, block: UpdateBlock, ahead: int) -> Tensor:
        learner, behaviour = self.learner, self.learner.behaviour
        columns = [block.logged, block.conservative]
        updates = torch.arange(len(block)) + 1 + ahead
        rates = [averaging_rate(learner.gradient_steps + k) for k in updates.tolist()]
        slow = [0.0] * len(block)
        if behaviour is not None:
            slow = [averaging_rate(behaviour.updates + k) for k in updates.tolist()]
        columns += [torch.tensor(rates), torch.tensor(slow)]
        return torch.stack(columns, dim=1)

    def _send(self, place: Tensor, values: Tensor) -> None:
        if place.is_cuda and not values.is_cuda:
            values = values.pin_memory()
        place[: len(values)].copy_(values, non_blocking=True)

    def _at_cursor(self, of_block: Tensor) -> Tensor:
        """Return the current update's slice of (K, ...)."""
        return of_block.index_select(0, self._cursor).squeeze(0)

    def _update_once(self, labels: bool) -> None:
        """Make the update at the cursor, and advance the cursor."""
        row = self._at_cursor(self._rows)
        rows = self.table.index_select(0, row)
        logged, conservative, rate, behaviour_rate = self._at_cursor(self._scalars).unbind()
        is_logged = self._place < logged
        expert = None if self._expert is None else self._expert[row]
        terms = Terms(
            weight=self._at_cursor(self._weight),
            logged=len(rows),
            conservative=is_logged * conservative if self._has_conservative else 0.0,
            expert=expert,
        )
        labelled = None
        if labels and self._labelled is not None:
            given = self._labelled
            labelled = Labelled(self._at_cursor(given.observation), self._at_cursor(given.action))
        loss = self.learner.move(rows, terms, labelled, rate, behaviour_rate)
        tail = rows[:, -3:].T
        per_row = torch.cat([loss.td.unsqueeze(0), loss.q.unsqueeze(0), tail])
        self._per_row.index_copy_(0, self._cursor, per_row.unsqueeze(0))
        self._loss.index_copy_(0, self._cursor, loss.value.view(1))
        self._cursor.add_(1)

    def _capture(self, labels: bool) -> torch.cuda.CUDAGraph:
        """Capture an update as a graph, and restore the parameters that warming up changed."""
        moved = self.learner.moved
        before = [tensor.clone() for tensor in moved]
        self._cursor.zero_()
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(min(_WARM_UP, self.longest)):
                self._update_once(labels)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self._update_once(labels)
        with torch.no_grad():
            for tensor, value in zip(moved, before, strict=True):
                tensor.copy_(value)
        return graph
