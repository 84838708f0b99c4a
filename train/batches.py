"""What a batch is made of: rows of logs by quota, and fresh rows from the twin.

The half-and-half batch of online learning with logs (RLPD, arXiv:2302.02948) is put together here,
from two sources that share one packed row layout, by one gather each.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from torch import Tensor

from restock.replay.layout import F32, Ints
from restock.replay.ring import FreshRing
from restock.replay.sampler import QuotaSampler
from restock.train.checkpoint import generator_state, restore_generator

if TYPE_CHECKING:
    from restock.replay.panel import Panel

_NO_ROWS: Ints = np.empty(0, np.int64)
_IN_MEMORY_BYTES = 4 << 30  # larger panels stay memory-mapped


@dataclass(frozen=True)
class Coded:
    """A column of few distinct values: a code per row into `names`."""

    codes: NDArray[np.int32]  # (n,)
    names: list[str]

    @classmethod
    def of(cls, column: pa.ChunkedArray) -> Coded:
        encoded = column.combine_chunks().dictionary_encode()
        if isinstance(encoded, pa.ChunkedArray):
            encoded = encoded.combine_chunks()
        codes = encoded.indices.fill_null(len(encoded.dictionary))
        names = [*encoded.dictionary.to_pylist(), "unknown"]
        return cls(np.asarray(codes, np.int32), names)

    def name(self, row: int) -> str:
        return str(self.names[self.codes[row]])


@dataclass(frozen=True)
class Logs:
    """The logged rows that a run draws from, with what is to be recorded about them."""

    rows: Tensor  # (n, W) float32
    strata: list[str]
    timings: list[str]  # pre | post, of each stratum
    stratum_rows: list[Ints]  # the rows of each stratum
    shares: NDArray[np.float64]  # (S,)
    weights: F32 | None  # (n,) importance weights, or None where all are 1
    as_of_ns: int  # calendar ages are against it
    transition_id: Ints  # (n,)
    stamp_ns: Ints  # (n,), when each was logged: measurement stamps may be a simulator's
    condition: Coded
    behaviour_policy: Coded
    behaviour_version: Coded
    episode: Coded

    @classmethod
    def of_panel(cls, panel: Panel) -> Logs:
        """A panel's rows in memory (memory-mapped where it is larger than 4 GiB)."""
        rows = np.asarray(panel.rows)
        if rows.nbytes <= _IN_MEMORY_BYTES:
            rows = np.array(rows)
        with warnings.catch_warnings():  # a read-only map is fine: nothing writes to it
            warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
            tensor = torch.from_numpy(rows)
        weights = panel.weights
        meta = panel.meta
        return cls(
            rows=tensor,
            strata=[stratum.name for stratum in panel.strata],
            timings=[stratum.timing for stratum in panel.strata],
            stratum_rows=panel.stratum_rows(),
            shares=np.array([stratum.share for stratum in panel.strata]),
            weights=None if np.all(weights == 1) else weights,
            as_of_ns=panel.header.newest_ns,
            transition_id=np.asarray(meta["transition_id"], np.int64),
            stamp_ns=np.asarray(meta["logged_ns"], np.int64),
            condition=Coded.of(meta["condition"]),
            behaviour_policy=Coded.of(meta["behaviour_policy"]),
            behaviour_version=Coded.of(meta["behaviour_version"]),
            episode=Coded.of(meta["episode_id"]),
        )

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class Batch:
    """One batch: the logged rows first, then the fresh ones."""

    rows: Tensor  # (B, W) float32, on the learner's device; valid until the next draw
    weight: Tensor | None  # (B,) float32
    log_rows: Ints  # (L,) rows of the panel
    log_stratum: Ints = field(default_factory=lambda: _NO_ROWS)  # (L,)
    slots: Ints = field(default_factory=lambda: _NO_ROWS)  # (B - L,) slots of the ring

    @property
    def logged(self) -> int:
        return len(self.log_rows)


class Batches:
    """Draws batches: all from logs while offline, `logs_share` of them from logs online.

    Without logs every batch is fresh. Each source has its own generator, seeded from `seed`.
    """

    def __init__(
        self,
        logs: Logs | None,
        ring: FreshRing,
        *,
        batch_size: int,
        logs_share: float,
        seed: int,
        device: torch.device,
    ) -> None:
        self.logs, self.ring, self.device = logs, ring, device
        self.batch_size = batch_size
        self.logged = round(batch_size * logs_share) if logs is not None else 0
        self._rng = np.random.default_rng([seed, 1])
        self._fresh = torch.from_numpy(ring.rows)  # shares memory with the ring
        self._buffer = torch.empty((batch_size, ring.rows.shape[1]))
        self._logs_on_device = logs.rows.to(device) if logs is not None else None
        self._offline: QuotaSampler | None = None
        self._online: QuotaSampler | None = None
        if logs is not None:
            self._offline = self._sampler(logs, batch_size, [seed, 2])
            if self.logged:
                self._online = self._sampler(logs, self.logged, [seed, 3])

    @staticmethod
    def _sampler(logs: Logs, batch_size: int, seed: list[int]) -> QuotaSampler:
        rng = np.random.default_rng(seed)
        return QuotaSampler(logs.stratum_rows, logs.shares, batch_size, rng, replacement=False)

    def draw_offline(self) -> Batch:
        """A batch from logs alone."""
        if self._offline is None:
            raise RuntimeError("there are no logs to draw from")
        rows, stratum = self._offline.draw()
        return self._gather(rows, stratum, _NO_ROWS)

    def draw_online(self) -> Batch:
        """A batch from logs and the fresh ring."""
        rows, stratum = self._online.draw() if self._online else (_NO_ROWS, _NO_ROWS)
        slots = _NO_ROWS
        if self.logged < self.batch_size:
            slots = self.ring.sample(self.batch_size - self.logged, self._rng)
        return self._gather(rows, stratum, slots)

    def _gather(self, log_rows: Ints, log_stratum: Ints, slots: Ints) -> Batch:
        logged = len(log_rows)
        weight = None
        if self.device.type == "cpu":
            packed = self._buffer
            if logged:
                index = torch.from_numpy(log_rows)
                torch.index_select(self._logs_tensor, 0, index, out=packed[:logged])
            if len(slots):
                torch.index_select(self._fresh, 0, torch.from_numpy(slots), out=packed[logged:])
        else:
            parts = []
            if logged:
                index = torch.from_numpy(log_rows).to(self.device)
                parts.append(self._logs_tensor.index_select(0, index))
            if len(slots):
                fresh = self._fresh.index_select(0, torch.from_numpy(slots))
                parts.append(fresh.to(self.device))
            packed = torch.cat(parts)
        if logged and self.logs is not None and self.logs.weights is not None:
            weight = torch.ones(logged + len(slots))
            weight[:logged] = torch.from_numpy(self.logs.weights[log_rows])
            weight = weight.to(self.device)
        return Batch(packed, weight, log_rows, log_stratum, slots)

    @property
    def _logs_tensor(self) -> Tensor:
        if self._logs_on_device is None:
            raise RuntimeError("there are no logs to draw from")
        return self._logs_on_device

    def state_dict(self) -> dict[str, Any]:
        """Arrays and JSON values."""
        return {
            "fresh": generator_state(self._rng),
            "offline": self._offline.state_dict() if self._offline else None,
            "online": self._online.state_dict() if self._online else None,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts the draws to come where `state_dict` found them."""
        restore_generator(self._rng, state["fresh"])
        for sampler, name in ((self._offline, "offline"), (self._online, "online")):
            if sampler is not None:
                sampler.load_state_dict(state[name])
