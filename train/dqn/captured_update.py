"""Updates on a GPU without the host in between: one CUDA graph, replayed once an update.

A GPU is done with a batch of a network of this size in a fifth of a millisecond, in some seventy
small kernels: launched one by one they take the host six times as long. So an update's kernels
(gather, losses, gradients, Adam, the averages, the target's pull) are captured once. What differs
between updates (row numbers, weights, rates) lies on the device for a block of them, a cursor says
which is next, and TD errors and losses stay there until the block is done: nothing waits for the
device in between.

The same operations run on the CPU, one after the other, where nothing can be captured.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from restock.train.dqn.behaviour import Labelled
from restock.train.dqn.learner import Learner, Terms

_WARM_UP = 3  # updates before the capture: libraries take their memory at the first calls


@dataclass(frozen=True)
class UpdateBlock:
    """What K updates in a row are made of, on the host."""

    rows: Tensor  # (K, B) int64, of the table
    packed: Tensor | None  # (K, B, W) float32 those rows, where the table is not on the device
    weight: Tensor  # (K, B) float32
    logged: Tensor  # (K,) float32: how many of the first rows are from logs
    conservative: Tensor  # (K,) float32
    labelled: Labelled | None  # (K, M, D), (K, M): what the behaviour network learns from

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class Outcome:
    """What K updates came to, on the host."""

    td: Tensor  # (K, B) float32
    q: Tensor  # (K, B) float32
    tail: Tensor  # (K, B, 3) float32: action, reward and discount of the rows
    loss: Tensor  # (K,) float32


class Launched:
    """Updates that the device may still be at."""

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
        """Wait for them."""
        if self._event is not None:
            self._event.synchronize()
        td, q, *tail = self._per_row.unbind(dim=1)
        return Outcome(td, q, torch.stack(tail, dim=2), self._loss)


class CapturedUpdates:
    """A learner's updates, up to `longest` in a row.

    `Learner.count` is to be called for each update whose outcome was taken note of.

    Args:
        learner: whose parameters move.
        table: (n, W) float32 on its device, which blocks name rows of; None: they bring their rows.
        batch_size: B.
        width: W.
        longest: K, of a block.
        labelled: M of the behaviour network's batches; 0: none.
        has_conservative: whether the CQL term may come in.
        expert: (n,) bool, where the margin term applies; None: nowhere.
    """

    def __init__(
        self,
        learner: Learner,
        table: Tensor | None,
        *,
        batch_size: int,
        width: int,
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
        self._packed = torch.zeros((*batch, width) if table is None else 0, device=device)
        self._weight = torch.ones(batch, device=device)
        # Of each update: logged rows, weight of CQL, rates of the two averages.
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
        """Set the device to work on the block's updates, and return before it is done.

        `ahead` updates were launched and not counted yet.
        """
        count, labels = len(block), block.labelled is not None
        if count > self.longest:
            raise ValueError(f"a block of {count} updates; at most {self.longest}")
        self._send(self._rows, block.rows)
        self._send(self._weight, block.weight)
        self._send(self._scalars, self._scalars_of(block, ahead))
        if block.packed is not None:
            self._send(self._packed, block.packed)
        if block.labelled is not None and self._labelled is not None:
            self._send(self._labelled.observation, block.labelled.observation)
            self._send(self._labelled.action, block.labelled.action)
        if self._rows.is_cuda and labels not in self._graphs:
            self._graphs[labels] = self._captured(labels)
        self._cursor.zero_()
        for _ in range(count):
            if self._rows.is_cuda:
                self._graphs[labels].replay()
            else:
                self._one(labels)
        return Launched(self._per_row[:count], self._loss[:count])

    def _scalars_of(self, block: UpdateBlock, ahead: int) -> Tensor:
        learner, behaviour = self.learner, self.learner.behaviour
        columns = [block.logged, block.conservative]
        updates = torch.arange(len(block)) + 1 + ahead
        rates = [learner.averaging_rate(learner.gradient_steps + k) for k in updates.tolist()]
        slow = [0.0] * len(block)
        if behaviour is not None:
            slow = [behaviour.averaging_rate(behaviour.updates + k) for k in updates.tolist()]
        columns += [torch.tensor(rates), torch.tensor(slow)]
        return torch.stack(columns, dim=1)

    def _send(self, place: Tensor, values: Tensor) -> None:
        if place.is_cuda and not values.is_cuda:
            values = values.pin_memory()
        place[: len(values)].copy_(values, non_blocking=True)

    def _now(self, of_block: Tensor) -> Tensor:
        """Return what the update under way has of (K, ...)."""
        return of_block.index_select(0, self._cursor).squeeze(0)

    def _one(self, labels: bool) -> None:
        """Make the update that the cursor is at."""
        row = self._now(self._rows)
        rows = self._now(self._packed) if self.table is None else self.table.index_select(0, row)
        logged, conservative, rate, behaviour_rate = self._now(self._scalars).unbind()
        is_logged = self._place < logged
        expert = None if self._expert is None else self._expert[row]
        terms = Terms(
            weight=self._now(self._weight),
            logged=len(rows),
            conservative=is_logged * conservative if self._has_conservative else 0.0,
            expert=expert,
        )
        labelled = None
        if labels and self._labelled is not None:
            given = self._labelled
            labelled = Labelled(self._now(given.observation), self._now(given.action))
        loss = self.learner.move(rows, terms, labelled, rate, behaviour_rate)
        tail = rows[:, -3:].T
        per_row = torch.cat([loss.td.unsqueeze(0), loss.q.unsqueeze(0), tail])
        self._per_row.index_copy_(0, self._cursor, per_row.unsqueeze(0))
        self._loss.index_copy_(0, self._cursor, loss.value.view(1))
        self._cursor.add_(1)

    def _captured(self, labels: bool) -> torch.cuda.CUDAGraph:
        """Capture an update as a graph; the parameters stay as before."""
        moved = self.learner.moved
        before = [tensor.clone() for tensor in moved]
        self._cursor.zero_()
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(min(_WARM_UP, self.longest)):
                self._one(labels)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self._one(labels)
        with torch.no_grad():
            for tensor, value in zip(moved, before, strict=True):
                tensor.copy_(value)
        return graph


__all__ = ["CapturedUpdates", "Launched", "Outcome", "UpdateBlock"]
