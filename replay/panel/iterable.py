"""A panel as a torch `IterableDataset` of whole batches, for any training loop with a DataLoader.

    dataset = PanelDataset("panel/", batch_size=256, batches=1000, seed=0)
    for batch in DataLoader(dataset, batch_size=None, num_workers=2): ...

Batches are those of the panel's quotas, rows of a stratum in shuffled order before any repeats.
Every worker draws the same sequence of row numbers, which is cheap, and gathers only its own
batches of it, which is not. So however many workers there are, the loader gives the same batches in
the same order, exact in their quotas, and no row comes twice because of them.
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
from restock.replay.mixture.packed_row import F32, Ints
from restock.replay.panel.panel import Panel


class PanelDataset(IterableDataset[dict[str, Tensor]]):
    """Batches of a panel by its quotas; give it to a DataLoader with `batch_size=None`.

    Each batch is a dict: `observation`, `next_observation` (B, D) float32, `action` (B,) int64,
    `reward` (the n-step return), `discount` (gamma^n, 0 where terminated), `weight` (B,) float32,
    `row` (of the panel, into `panel.meta`) and `stratum` (its place in `panel.strata`) (B,) int64.

    Args:
        panel: an open panel, or its directory.
        batch_size: rows of a batch.
        batches: of one pass, over all workers; None never ends.
        seed: of the draws.

    `set_epoch` makes the next pass another one, as a DistributedSampler's does; without it every
    pass is the same.

    Raises:
        MixtureError: `batch_size` or `batches` below 1.
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

    def set_epoch(self, epoch: int) -> None:
        """Which pass comes next; call it before iterating, on the loader's own dataset."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        worker = get_worker_info()
        mine, of = (0, 1) if worker is None else (worker.id, worker.num_workers)
        sampler = self.panel.sampler(
            self.batch_size, np.random.default_rng([self.seed, 6, self.epoch])
        )
        for number in count() if self.batches is None else range(self.batches):
            rows, stratum = sampler.draw()
            if number % of == mine:
                yield self._gather(rows, stratum, sampler.weights[rows])

    def _gather(self, rows: Ints, stratum: Ints, weight: F32) -> dict[str, Tensor]:
        panel = self.panel
        packed = panel.rows[rows]

        def part(name: str) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(packed[:, panel.columns[name]]))

        return {
            "observation": part("observation"),
            "next_observation": part("next_observation"),
            "action": part("action")[:, 0].long(),
            "reward": part("reward")[:, 0],
            "discount": part("discount")[:, 0],
            "weight": torch.from_numpy(weight),
            "row": torch.from_numpy(rows.copy()),
            "stratum": torch.from_numpy(stratum.copy()),
        }

    def __getstate__(self) -> dict[str, object]:
        """Workers open the panel themselves: its rows are mapped, not copied."""
        return {name: value for name, value in self.__dict__.items() if name != "panel"}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        self.panel = Panel.open(self.path)
