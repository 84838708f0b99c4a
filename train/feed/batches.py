"""Draw batches: rows of logs and fresh rows from the twin, both by quota.

This module builds the half-and-half batch of online learning with logs (RLPD, arXiv:2302.02948)
from two sources that share one packed row layout, by one gather each. The share controller
(`restock.replay.mixture.share_controller`) decides the share of each stratum, and how much of it
is logged.

`torch.index_select` copies one row after the other and waits for the memory of each. The compiled
gather (`restock.native`) prefetches rows well ahead of the one that it copies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from restock import native
from restock.arrays import F64, Bools, Ints
from restock.errors import ConfigError, MixtureError
from restock.replay.mixture.share_controller import PlannedDraws, ShareController
from restock.replay.panel.logged_sampler import BatchDraw, LoggedSampler
from restock.replay.panel.panel import Panel
from restock.replay.sampling.ring import FreshRing
from restock.replay.sampling.sampler import Quotas
from restock.state import Stateful
from restock.train.dqn.config import LossConfig, TrainConfig
from restock.train.feed.logs import Coded, Logs

_NO_ROWS: Ints = np.empty(0, np.int64)
_NO_SHARES = np.empty(0)
_NOTHING = BatchDraw(_NO_ROWS, _NO_ROWS, None, _NO_SHARES)


@dataclass(frozen=True)
class ReplayBatch:
    """One batch: first the logged rows, from K stores with S strata, then the fresh ones."""

    gather: Callable[[], Tensor]  # returns the packed rows, if none is overwritten in the ring yet
    weight: Tensor | None  # (B,) float32
    log_rows: Ints  # (L,) rows of the panel
    log_stratum: Ints = field(default_factory=lambda: _NO_ROWS)  # (L,)
    slots: Ints = field(default_factory=lambda: _NO_ROWS)  # (B - L,) slots of the ring
    quota: F64 = field(default_factory=lambda: np.empty(0))  # (K * S,) shares of the logged rows
    wanted: F64 = field(default_factory=lambda: np.empty(0))  # (S,) quotas of the whole batch

    @property
    def logged(self) -> int:
        return len(self.log_rows)

    @cached_property
    def rows(self) -> Tensor:
        """Return the rows packed, (B, W) float32."""
        return self.gather()


class Batches(Stateful):
    """A source of batches: all rows from logs while offline, `logs_share` of them online.

    Without logs every batch is fresh. Each source has its own generator, seeded from `seed`.

    Args:
        logs_share: logged rows' share of an online batch; None: as the panel's mixture says.
        fresh: (S,) which strata the ring's rows can be in; None: its rows are drawn uniformly.

    Raises:
        MixtureError: the panel has too few rows for the run's draws, and its mixture refuses that.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *("_rng", "_draws", "_logged", "_owed", "_taken_over", "_fresh_quotas"),
    )

    def __init__(
        self,
        logs: Logs | None,
        ring: FreshRing,
        *,
        batch_size: int,
        logs_share: float | None,
        seed: int,
        fresh: Bools | None = None,
    ) -> None:
        self.logs, self.ring = logs, ring
        self.batch_size = batch_size
        self._rng = np.random.default_rng([seed, 1])
        self._fresh = torch.from_numpy(ring.rows)  # shares memory with the ring
        self._draws: LoggedSampler | None = None
        self._max_age: int | None = None  # maximum age of fresh rows, in environment steps
        # Number of logged rows in an online batch, its rounding error (added to the next number),
        # and the share behind it. The last quota of fresh rows is for rows of any stratum.
        self._logged, self._owed, self._taken_over = 0, 0.0, 0.0
        strata = 0 if fresh is None else len(fresh)
        self._fresh_quotas = Quotas(np.append(np.zeros(strata), 1.0), batch_size)
        if logs is not None:
            self._draws = logs.sampler(batch_size, logs_share, seed, fresh)
            self._apply_shares()
            if logs.panel is not None:
                self._max_age = logs.panel.header.mixture.max_age_env_steps

    @property
    def controller(self) -> ShareController | None:
        """Return the controller of shares; None without logs."""
        return self._draws.controller if self._draws is not None else None

    @property
    def needs_td(self) -> bool:
        """Return whether the next batch depends on the TD errors of the last."""
        return self._draws is not None and self._draws.needs_td

    def describe(self) -> list[dict[str, Any]]:
        """Return rows for the run's table `shares`; none without logs."""
        return self._draws.describe() if self._draws is not None else []

    def draw_offline(self) -> ReplayBatch:
        """Draw a batch from logs alone.

        Raises:
            MixtureError: every row has reached its limit of draws.
        """
        if self._draws is None:
            raise RuntimeError("there are no logs to sample from")
        drawn = self._draws.draw(self.batch_size)
        if len(drawn.rows) < self.batch_size:
            raise MixtureError(
                f"every row of the panel was drawn {self._draws.controller.max_replays} times",
                remedy="train with fewer offline updates, or mix with more draws per row",
            )
        return self._gather(drawn, _NO_ROWS)

    def draw_online(self, env_steps: int = 0) -> ReplayBatch:
        """Draw a batch from logs and the fresh ring, after `env_steps` environment steps."""
        drawn = _NOTHING
        if self._draws is not None:
            stock = self.ring.by_stratum.counts / self.batch_size
            moved = self._draws.move_to(env_steps, stock)
            if moved or self._draws.controller.logs_share != self._taken_over:
                self._apply_shares()
            if self._logged:
                drawn = self._draws.draw(self._logged)
        slots = _NO_ROWS
        if (count := self.batch_size - len(drawn.rows)) > 0:
            slots = self._draw_fresh(count, env_steps)
        return self._gather(drawn, slots)

    def replan(self, planned: PlannedDraws) -> None:
        """Plan the shares again, for another number of draws."""
        if self._draws is not None:
            self._draws.replan(planned)
            self._apply_shares()

    def _apply_shares(self) -> None:
        """Set the numbers of logged and fresh rows by the controller's shares."""
        controller = self.controller
        if controller is None:
            return
        self._taken_over = controller.logs_share
        exact = self.batch_size * controller.logs_share + self._owed
        self._logged = min(max(round(exact), 0), self.batch_size)
        self._owed = min(max(exact - self._logged, -1.0), 1.0)
        fresh = controller.fresh_shares
        if len(fresh) == len(self._fresh_quotas.shares) and fresh.sum() > 0:
            self._fresh_quotas.set_shares(fresh / fresh.sum())

    def _draw_fresh(self, count: int, env_steps: int) -> Ints:
        """Draw `count` slots: each stratum's quota, and the rest from the whole ring."""
        quotas = self._fresh_quotas
        if quotas.shares[-1] == 1.0:
            return self._sample_fresh(count, env_steps)
        quotas.set_batch_size(count)
        limit = None if self.controller is None else self.controller.max_replays
        since = None if self._max_age is None else env_steps - self._max_age
        slots = self.ring.draw(quotas.next()[:-1], self._rng, limit, since)
        if (rest := count - len(slots)) > 0:
            slots = np.concatenate([slots, self._sample_fresh(rest, env_steps)])
        return slots

    def note_errors(self, batch: ReplayBatch, td: Tensor) -> None:
        """Update priorities and shares by the TD errors (B,) of a batch that was learnt from."""
        if self._draws is not None and self._draws.needs_td and batch.logged:
            td_abs = td[: batch.logged].detach().abs().cpu().numpy()
            self._draws.update(batch.log_rows, td_abs)

    def _sample_fresh(self, count: int, env_steps: int) -> Ints:
        if self._max_age is None:
            return self.ring.sample(count, self._rng)
        collected = self.ring.meta["env_step"][: len(self.ring)]
        young = np.flatnonzero(collected >= env_steps - self._max_age)
        if not len(young):
            raise MixtureError(
                f"no fresh row is younger than max_age_env_steps = {self._max_age}",
                remedy="mix with a larger value",
            )
        return young[self._rng.integers(len(young), size=count)]

    def _gather(self, drawn: BatchDraw, slots: Ints) -> ReplayBatch:
        weight = None
        if drawn.weight is not None:
            weight = torch.ones(len(drawn.rows) + len(slots))
            weight[: len(drawn.rows)] = torch.from_numpy(drawn.weight)

        def gather() -> Tensor:
            logged = len(drawn.rows)
            rows = torch.empty(logged + len(slots), self._fresh.shape[1])
            if self.logs is not None and logged:
                gather_rows(self.logs.rows, torch.from_numpy(drawn.rows), rows[:logged])
            if len(slots):
                gather_rows(self._fresh, torch.from_numpy(slots), rows[logged:])
            return rows

        wanted = _NO_SHARES if self.controller is None else self.controller.wanted
        return ReplayBatch(gather, weight, drawn.rows, drawn.strata, slots, drawn.quota, wanted)


@dataclass(frozen=True)
class LogTerms:
    """The panel's rows that a loss term applies to, as a mask on the learner's device."""

    expert: Tensor | None  # (n,) bool: rows with DQfD's margin term; None: the loss has none

    @classmethod
    def of(cls, config: TrainConfig, logs: Logs | None, device: torch.device) -> LogTerms:
        """Make the mask that the loss needs on these logs.

        Raises:
            ConfigError: the loss has a margin term, but there are no logs, or no rows of a policy.
        """
        if logs is None:
            _refuse_without_logs(config.loss)
            return cls(None)
        if not config.loss.margin:
            return cls(None)
        expert = _expert_mask(config.teacher.policies, logs.behaviour_policy)
        return cls(torch.from_numpy(expert).to(device))

    def expert_rows(self, log_rows: Ints) -> Tensor | None:
        """Return whether the margin term applies to each panel row (L,); None: it never does."""
        if self.expert is None:
            return None
        return self.expert[torch.from_numpy(log_rows).to(self.expert.device)]


def draw_ahead(
    draw: Callable[[], ReplayBatch], count: int
) -> tuple[list[ReplayBatch], MixtureError | None]:
    """Draw `count` batches; return them, and the error that ended the draws early, if any."""
    batches: list[ReplayBatch] = []
    for _ in range(count):
        try:
            batches.append(draw())
        except MixtureError as error:
            return batches, error
    return batches, None


def check_terms(config: TrainConfig, panel: Panel | None) -> None:
    """Raise the errors of `LogTerms.of` early, without reading the panel's packed rows."""
    if panel is None:
        _refuse_without_logs(config.loss)
    elif config.loss.margin:
        logged = Coded.of(panel.meta["behaviour_policy"]).names
        _refuse_unknown(config.teacher.policies, logged)


def _refuse_without_logs(loss: LossConfig) -> None:
    if loss.margin:
        raise ConfigError(
            "loss.margin applies to logged rows, but this run has no logs",
            remedy="give --panel, or leave it out",
        )


def _expert_mask(experts: Sequence[str], policy: Coded) -> Bools:
    """Select the rows (n,) that one of `experts` drove."""
    _refuse_unknown(experts, policy.names)
    return np.isin(policy.codes, [policy.names.index(name) for name in experts])


def _refuse_unknown(experts: Sequence[str], policies: list[str]) -> None:
    for name in experts:
        if name not in policies:
            raise ConfigError(
                f"loss.margin applies to rows of {name!r}, and the logs have none",
                where="teacher.policies",
                remedy=f"choose from what they have: {', '.join(dict.fromkeys(policies))}",
            )


def gather_rows(rows: Tensor, index: Tensor, out: Tensor | None = None) -> Tensor:
    """Gather rows `index` (B,) int64 of `rows` (n, W) into `out` (B, W), a new tensor if None.

    All bits equal those of `rows.index_select(0, index)`, NaN and infinities included.

    Raises:
        RuntimeError, IndexError: a row number outside the table.
    """
    on_cpu = rows.device.type == index.device.type == "cpu" and not rows.requires_grad
    is_plain = rows.dtype == torch.float32 and rows.dim() == 2 and rows.is_contiguous()
    if native.IS_USED and on_cpu and is_plain and index.is_contiguous():
        batch = rows.new_empty(len(index), rows.shape[1]) if out is None else out
        native.compiled.gather(rows.numpy(), index.numpy(), batch.numpy())
        return batch
    return torch.index_select(rows, 0, index, out=out)
