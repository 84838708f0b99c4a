"""A panel as a torch `IterableDataset` of whole batches, for any training loop with a DataLoader.

    dataset = PanelDataset("panel/", batch_size=256, batches=1000, seed=0)
    for batch in DataLoader(dataset, batch_size=None, num_workers=2): ...

Batches are those that `sampler_for` draws. Every worker draws the same sequence of row numbers,
which is cheap, and gathers only its own batches, which is expensive. So however many workers there
are, the loader gives the same batches in the same order, exact in their quotas, and no row comes
twice because of them. Ranks of `torch.distributed` share one sequence in the same way. A loop with
a DataLoader cannot pass TD errors and environment steps to its dataset: mixtures that depend on
them are refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, distributed
from torch.utils.data import IterableDataset, get_worker_info

from restock.errors import MixtureError
from restock.replay.panel.logged_sampler import (
    BatchDraw,
    LoggedSampler,
    controller_for,
    needs_td,
    planned_by,
    sampler_for,
)
from restock.replay.panel.panel import Panel

_MAX_WORKERS = 64


class PanelDataset(IterableDataset[dict[str, Tensor]]):
    """Batches of a panel by its mixture; give it to a DataLoader with `batch_size=None`.

    Each batch is a dict: `observation`, `next_observation` (B, D) float32, `action` (B,) int64,
    `reward` (the n-step return), `discount` (gamma^n, 0 where terminated), `weight` (B,) float32,
    `row` (of the panel, into `panel.meta`) and `stratum` (its place in `panel.strata`) (B,) int64.

    Args:
        panel: an open panel, or its directory.
        batch_size: rows of a batch.
        batches: of one pass, over all workers; None never ends.
        seed: of the draws.

    `set_epoch` makes the next pass another one, as a DistributedSampler's does; without it every
    pass is the same. Where the mixture has a `max_replays_per_row`, it is of all passes together:
    pass n goes on where pass n - 1 ended, and none is given twice.

    Each of R ranks of `torch.distributed` gets `batches` batches of its own, every R-th of the one
    sequence that all ranks draw: give every rank the same arguments.

    Raises:
        MixtureError: `batch_size` or `batches` below 1; a mixture whose draws follow TD errors or
            environment steps; while iterating, rows that were all drawn as often as they may be.
        PanelError: no panel there, or a damaged one.
    """

    def __init__(
        self, panel: Panel | str | Path, batch_size: int, *, batches: int | None = None, seed: int
    ) -> None:
        super().__init__()
        if batch_size < 1 or (batches is not None and batches < 1):
            raise MixtureError(f"batch_size {batch_size} and batches {batches} must be at least 1")
        self.path = panel.path if isinstance(panel, Panel) else Path(panel)
        self.panel = panel if isinstance(panel, Panel) else Panel.open(panel)
        self.batch_size, self.batches, self.seed, self.epoch = batch_size, batches, seed, 0
        self._limit = self.panel.header.mixture.most_draws
        # In memory that workers share: passes begun by each, and the next one, since persistent
        # workers keep a copy of this from before the first.
        self._begun = _shared(_MAX_WORKERS)
        self._next = _shared(1)
        self._persists = False  # this is a worker's copy, and had its first pass
        self._sent_by = (0, 1)  # the rank that sent this copy to a worker, and how many there are
        self._check()

    def set_epoch(self, epoch: int) -> None:
        """Set the pass that comes next; call it before iterating, on the loader's own dataset."""
        self.epoch = epoch
        self._next[0] = epoch

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        worker = get_worker_info()
        if worker is None:
            return self._pass(self.epoch, 0, 1)
        epoch = int(self._next[0]) if self._persists else self.epoch
        self._persists = True
        return self._pass(epoch, worker.id, worker.num_workers)

    def _pass(self, epoch: int, number: int, of: int) -> Iterator[dict[str, Tensor]]:
        """Yield the batches of worker `number` of so many."""
        rank, ranks = self._rank()
        sampler = self._sampler(epoch)
        try:
            if self._limit is not None:
                self._pass_on(sampler, epoch, number, ranks)
            for turn in count() if self.batches is None else range(self.batches * ranks):
                draw = self._draw(sampler)
                batch, whose = divmod(turn, ranks)
                if whose == rank and batch % of == number:
                    yield self._gather(sampler, draw)
        finally:
            sampler.close()

    def _rank(self) -> tuple[int, int]:
        """Return this process's rank and the number of ranks.

        A spawned worker has them from the process that spawned it.
        """
        if distributed.is_available() and distributed.is_initialized():
            return distributed.get_rank(), distributed.get_world_size()
        return self._sent_by

    def _sampler(self, epoch: int) -> LoggedSampler:
        of_pass = epoch if self._limit is None else 0
        return sampler_for(self.panel, self.batch_size, seed=(self.seed, 6, of_pass))

    def _check(self) -> None:
        """Raise MixtureError where draws follow what a data set does not receive."""
        moving = controller_for(self.panel, planned_by(self.panel.header.mixture)).strata_move
        if moving or needs_td(self.panel):
            follows = "environment steps" if moving else "TD errors"
            raise MixtureError(
                f"the mixture's draws depend on {follows}, which a data set does not receive",
                where=str(self.path),
                remedy="draw with `sampler_for(panel, …)`, which has `update` and `move_to`",
            )

    def _pass_on(self, sampler: LoggedSampler, epoch: int, number: int, ranks: int) -> None:
        """Skip the draws of earlier passes, which count towards the limit."""
        if epoch and self.batches is None:
            raise MixtureError(
                "an endless data set cannot start another pass if max_replays_per_row is set",
                where=str(self.path),
                remedy="give `batches`",
            )
        if epoch < int(self._begun[number % _MAX_WORKERS]):
            raise MixtureError(
                f"pass {epoch} was given already, and its rows may be drawn"
                f" {self._limit:g} times in all",
                where=str(self.path),
                remedy=f"continue with set_epoch({epoch + 1})",
            )
        self._begun[number % _MAX_WORKERS] = epoch + 1
        for _ in range(epoch * ranks * (self.batches or 0)):
            self._draw(sampler)

    def _draw(self, sampler: LoggedSampler) -> BatchDraw:
        draw = sampler.draw()
        if len(draw.rows) < self.batch_size:
            raise MixtureError(
                f"every row of the panel was drawn {self._limit} times",
                where=str(self.path),
                remedy="draw fewer batches, or mix with a larger max_replays_per_row",
            )
        return draw

    def _gather(self, sampler: LoggedSampler, draw: BatchDraw) -> dict[str, Tensor]:
        packed = np.empty((len(draw.rows), self.panel.rows.shape[1]), np.float32)
        sampler.gather(draw.rows, packed)
        ones = np.ones(len(packed), np.float32)

        def part(name: str) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(packed[:, self.panel.columns[name]]))

        return {
            "observation": part("observation"),
            "next_observation": part("next_observation"),
            "action": part("action")[:, 0].long(),
            "reward": part("reward")[:, 0],
            "discount": part("discount")[:, 0],
            "weight": torch.from_numpy(ones if draw.weight is None else draw.weight),
            "row": torch.from_numpy(draw.rows.copy()),
            "stratum": torch.from_numpy(draw.strata.copy()),
        }

    def __getstate__(self) -> dict[str, object]:
        """Leave out the panel's rows: workers map the files themselves."""
        state = {name: value for name, value in self.__dict__.items() if name != "panel"}
        return state | {"_sent_by": self._rank()}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        self.panel = Panel.open(self.path)


def _shared(size: int) -> Tensor:
    """Return zeros (size,) in memory shared by processes with a copy of the dataset."""
    zeros = torch.zeros(size, dtype=torch.int64)
    zeros.share_memory_()  # type: ignore[no-untyped-call]
    return zeros
