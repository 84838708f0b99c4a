"""A panel as a torch `IterableDataset` of whole batches, for any training loop with a DataLoader.

    dataset = PanelDataset("panel/", batch_size=256, batches=1000, seed=0)
    for batch in DataLoader(dataset, batch_size=None, num_workers=2): ...

Batches are those that `sampler_for` draws. Every worker draws the same sequence of row numbers,
which is cheap, and gathers only its own batches of it, which is not. So however many workers there
are, the loader gives the same batches in the same order, exact in their quotas, and no row comes
twice because of them. What a loop with a DataLoader cannot tell its dataset, TD errors and
environment steps, is refused where the mixture asks for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
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

_MOST_WORKERS = 64


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
        # Passes begun by each worker, in memory that the workers of every pass share.
        self._begun = torch.zeros(_MOST_WORKERS, dtype=torch.int16).share_memory_()  # type: ignore[no-untyped-call]
        self._check()

    def set_epoch(self, epoch: int) -> None:
        """Which pass comes next; call it before iterating, on the loader's own dataset."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        worker = get_worker_info()
        number, of = (0, 1) if worker is None else (worker.id, worker.num_workers)
        sampler = self._sampler()
        try:
            if self._limit is not None:
                self._pass_on(sampler, number)
            for batch in count() if self.batches is None else range(self.batches):
                draw = self._draw(sampler)
                if batch % of == number:
                    yield self._gather(sampler, draw)
        finally:
            sampler.close()

    def _sampler(self) -> LoggedSampler:
        epoch = self.epoch if self._limit is None else 0
        return sampler_for(self.panel, self.batch_size, seed=(self.seed, 6, epoch))

    def _check(self) -> None:
        """Raises MixtureError where draws follow what a data set does not receive."""
        moving = controller_for(self.panel, planned_by(self.panel.header.mixture)).strata_move
        if moving or needs_td(self.panel):
            follows = "environment steps" if moving else "TD errors"
            raise MixtureError(
                f"the mixture's draws follow {follows}, which a data set does not receive",
                where=str(self.path),
                remedy="draw with `sampler_for(panel, …)`, which has `update` and `move_to`",
            )

    def _pass_on(self, sampler: LoggedSampler, number: int) -> None:
        """Let the draws of the passes before go by: they count towards the limit."""
        if self.epoch and self.batches is None:
            raise MixtureError(
                "an endless pass has no next one where max_replays_per_row is of all passes",
                where=str(self.path),
                remedy="give `batches`",
            )
        if self.epoch < int(self._begun[number % _MOST_WORKERS]):
            raise MixtureError(
                f"pass {self.epoch} was given already, and its rows may be drawn"
                f" {self._limit:g} times in all",
                where=str(self.path),
                remedy=f"go on with set_epoch({self.epoch + 1})",
            )
        self._begun[number % _MOST_WORKERS] = self.epoch + 1
        for _ in range(self.epoch * (self.batches or 0)):
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
        """Workers open the panel themselves: its rows are mapped, not copied."""
        return {name: value for name, value in self.__dict__.items() if name != "panel"}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        self.panel = Panel.open(self.path)
