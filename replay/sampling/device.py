"""Batches drawn where the panel lies: row numbers, priorities and generator on one torch device.

On a GPU the host decides the quotas of a block of batches (a few hundred integers) and sends them
over once; between blocks nothing crosses the bus. The same code runs on the CPU.

panel = torch.from_numpy(np.array(panel.rows)).to(device)
sampler = DeviceSampler(stratum_rows, shares, 256, seed=0, device=device, rule=Per())
rows, strata = sampler.draw()                             # (B,) int64 each, on the device
torch.index_select(panel, 0, rows, out=batch)             # no copy leaves the device
sampler.update(rows, td.abs())                            # nor does this wait for it
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from restock.arrays import F64, Ints
from restock.errors import MixtureError
from restock.replay.sampling.priorities import Exponents, Lap, Per, Rule
from restock.replay.sampling.quotas import Quotas
from restock.replay.sampling.sampler import BLOCK, another_sampler
from restock.state import Stateful

_SUM_BITS = 62  # priorities are summed as integers, which add up alike in any order


class DeviceSampler(Stateful):
    """Exact quotas per batch over strata; within one uniformly, in shuffled turns or by priority.

    Args:
        stratum_rows: the row numbers of each stratum, S arrays (n_s,).
        shares: of each stratum, (S,), summing to 1.
        batch_size: rows per draw.
        seed: of the generator, which lives on the device.
        device: where rows are drawn.
        rule: `Per()` or `Lap()`, of all strata or of each, (S,); None draws a stratum's rows alike.
        replacement: False, where there is no rule, goes through a stratum in shuffled order before
            any row repeats; for all strata or for each, (S,).

    Raises:
        MixtureError: shares that are no distribution, or a share on an empty stratum.
    """

    SAME: ClassVar[tuple[str, ...]] = ("sizes", "_turns", "_ruled")
    STATE: ClassVar[tuple[str, ...]] = (
        *("quotas", "generator", "_orders", "_returned", "_cursor"),
        *("_quota_ahead", "_rows_ahead", "_strata_ahead", "_weights_ahead", "_next", "_batches"),
        *("_priority", "_new", "_largest", "_finite"),
    )

    def __init__(
        self,
        stratum_rows: Sequence[NDArray[Any]],
        shares: Sequence[float] | F64,
        batch_size: int,
        *,
        seed: int,
        device: torch.device | str,
        rule: Rule | Sequence[Rule | None] | None = None,
        replacement: bool | Sequence[bool] = True,
    ) -> None:
        if len(stratum_rows) != len(shares):
            raise MixtureError(f"{len(stratum_rows)} strata but {len(shares)} shares")
        self.device = torch.device(device)
        self.sizes: Ints = np.array([len(rows) for rows in stratum_rows], np.int64)
        self.quotas = Quotas(shares, batch_size, self.sizes)
        strata = len(self.sizes)
        whole = rule is None or isinstance(rule, Per | Lap)
        self.rules: list[Rule | None] = [rule] * strata if whole else list(rule)  # type: ignore
        again = [replacement] * strata if isinstance(replacement, bool) else list(replacement)
        if len(self.rules) != strata or len(again) != strata:
            raise MixtureError(f"{len(self.rules)} rules for {strata} strata")
        self._turns = [s for s in range(strata) if not again[s] and self.rules[s] is None]
        self.generator = torch.Generator(self.device).manual_seed(seed)
        joined = np.concatenate([np.asarray(rows, np.int64) for rows in stratum_rows])
        self._members = torch.from_numpy(joined).to(self.device)  # (N,) stratum by stratum
        self._first: Ints = np.concatenate([[0], np.cumsum(self.sizes)])[:-1].astype(np.int64)
        # Of each stratum, where it is gone through in turns.
        self._orders = [
            self._shuffled(stratum) if stratum in self._turns else self._members[:0]
            for stratum in range(strata)
        ]
        self._returned = [self._members[:0]] * strata
        self._cursor = [0] * strata
        self._quota_ahead: Ints = np.zeros((0, len(self.sizes)), np.int64)
        self._rows_ahead = self._strata_ahead = self._members.new_zeros((0, batch_size))
        self._weights_ahead: Tensor | None = None
        self._next = 0  # of those drawn ahead
        self._batches = 0  # handed out
        self._ruled = any(rule_of is not None for rule_of in self.rules)
        self._priority = self._largest = torch.zeros(0, device=self.device)
        self._new = self._finite = torch.zeros(0, dtype=torch.bool, device=self.device)
        if self._ruled:
            self._place = torch.full((int(joined.max()) + 1,), -1, device=self.device)
            self._place[self._members] = torch.arange(len(joined), device=self.device)
            if len(np.unique(joined)) != len(joined):
                raise MixtureError("a row is in two strata")
            codes = np.repeat(np.arange(strata), self.sizes)
            self._stratum = torch.from_numpy(codes).to(self.device)  # of each place, (N,)
            exponents = Exponents(self.rules)
            self._epsilon, self._floor, self._alpha = (
                torch.from_numpy(values).to(self.device)
                for values in (exponents.epsilon, exponents.floor, exponents.alpha)
            )
            every = torch.arange(strata, device=self.device)
            self._largest = self._priority_of(torch.ones(strata, device=self.device), every)
            self._priority = self._largest[self._stratum]  # (N,)
            self._new = torch.ones(len(joined), dtype=torch.bool, device=self.device)
            self._finite = torch.ones((), dtype=torch.bool, device=self.device)

    @property
    def batch_size(self) -> int:
        return self.quotas.batch_size

    @property
    def shares(self) -> F64:
        return self.quotas.shares

    @property
    def drawn_weights(self) -> Tensor | None:
        """Importance weights (B,) that the batch last drawn needs, on the device; None for ones."""
        return None if self._weights_ahead is None else self._weights_ahead[self._next - 1]

    def draw(self) -> tuple[Tensor, Tensor]:
        """Row numbers (B,) and the stratum of each (B,), int64, on the device."""
        if self._next == len(self._rows_ahead):
            self._draw_block()
        self._next += 1
        self._batches += 1
        return self._rows_ahead[self._next - 1], self._strata_ahead[self._next - 1]

    def update(self, rows: Tensor, td_abs: Tensor) -> None:
        """|TD error| (n,) of rows (n,) just learnt from, on the device; counts from the next block.

        Of a row that is there more than once the largest: which is written last is not defined
        on a GPU, and a run is to repeat itself. A TD error that is negative or not finite is
        refused when the next block is drawn: to look at it here would wait for the device.
        """
        if not self._ruled:
            return
        place, errors = self._place[rows], td_abs.detach().float()
        stratum = self._stratum[place]
        priority = self._priority_of(errors, stratum)
        self._priority.scatter_reduce_(0, place, priority, "amax", include_self=False)
        self._new[place] = False
        self._largest.scatter_reduce_(0, stratum, priority, "amax")
        self._finite &= ((errors >= 0) & (errors < math.inf)).all()

    def set_shares(self, shares: Sequence[float] | F64) -> None:
        """Other shares (S,) from the next batch on; what was drawn ahead goes back.

        Raises:
            MixtureError: shares that are no distribution, or a share on an empty stratum.
        """
        given = self.quotas.checked(shares)
        if not np.array_equal(given, self.quotas.shares):
            self._hand_back()
            self.quotas.set_shares(given)

    def set_batch_size(self, batch_size: int) -> None:
        """Batches of another size from the next one on; what was drawn ahead goes back."""
        if batch_size != self.batch_size:
            self._hand_back()
            self.quotas.set_batch_size(batch_size)
            self._rows_ahead = self._strata_ahead = self._members.new_zeros((0, batch_size))

    def _priority_of(self, td_abs: Tensor, stratum: Tensor) -> Tensor:
        raised = torch.maximum(td_abs + self._epsilon[stratum], self._floor[stratum])
        return raised ** self._alpha[stratum]

    def _draw_block(self) -> None:
        quota = self.quotas.take(BLOCK)  # (BLOCK, S)
        counts = torch.from_numpy(quota.ravel()).to(self.device)  # the one thing sent over
        stratum = torch.arange(len(self.sizes), device=self.device).repeat(BLOCK)
        stratum = stratum.repeat_interleave(counts, output_size=int(quota.sum()))
        order = torch.argsort(stratum, stable=True)
        if self._ruled:
            self._raise_new()
        taken = [
            self._take(index, int(count)) for index, count in enumerate(quota.sum(axis=0)) if count
        ]
        rows = torch.empty_like(stratum)
        rows[order] = torch.cat([drawn for drawn, _ in taken])
        self._rows_ahead, self._strata_ahead = rows.view(BLOCK, -1), stratum.view(BLOCK, -1)
        self._weights_ahead = None
        if any(weight is not None for _, weight in taken):
            weight = torch.empty(len(rows), device=self.device)
            weight[order] = torch.cat(
                [torch.ones(len(d), device=self.device) if w is None else w for d, w in taken]
            )
            self._weights_ahead = weight.view(BLOCK, -1)
        self._quota_ahead, self._next = quota, 0

    def _take(self, stratum: int, count: int) -> tuple[Tensor, Tensor | None]:
        """The next `count` rows of a stratum, and their weights where the rule has them."""
        first, size = int(self._first[stratum]), int(self.sizes[stratum])
        if (rule := self.rules[stratum]) is not None:
            return self._take_by_priority(rule, stratum, count)
        if stratum not in self._turns:
            at = (self._random(count) * size).long().clamp_max(size - 1)
            return self._members[first + at], None
        back = self._returned[stratum]
        parts, self._returned[stratum] = [back[:count]], back[count:]
        count -= len(parts[0])
        while count:
            begin = self._cursor[stratum]
            if begin == size:  # all have had their turn
                self._orders[stratum] = self._shuffled(stratum)
                begin = 0
            some = min(count, size - begin)
            parts.append(self._orders[stratum][begin : begin + some])
            self._cursor[stratum] = begin + some
            count -= some
        return torch.cat(parts), None

    def _take_by_priority(
        self, rule: Rule, stratum: int, count: int
    ) -> tuple[Tensor, Tensor | None]:
        """One draw from each of `count` equal parts of the stratum's range of sums, shuffled."""
        first, size = int(self._first[stratum]), int(self.sizes[stratum])
        priority = self._priority[first : first + size].double()
        scale = 2.0**_SUM_BITS / size / self._largest[stratum].double()
        share = (priority * scale).long().clamp_min(1)
        ends = share.cumsum(0)
        total = ends[-1].double()
        within = torch.arange(count, device=self.device) + self._random(count)
        at = torch.searchsorted(ends, (within * (total / count)).long(), right=True)
        turns = torch.randperm(count, generator=self.generator, device=self.device)
        at = at.clamp_max(size - 1)[turns]
        beta = rule.beta_after(self._batches)
        if beta == 0:
            return self._members[first + at], None
        mean = (priority ** (1.0 - beta)).sum()  # sums are of one order on one device
        weight = (priority.sum() / mean * priority[at] ** -beta).float()
        return self._members[first + at], weight

    def _raise_new(self) -> None:
        """Rows not drawn yet get the largest priority so far. Waits for the device, once a block.

        Raises:
            MixtureError: there were TD errors that are negative or not finite.
        """
        if not bool(self._finite):
            raise MixtureError(
                "TD errors are negative, or not finite",
                remedy="give their absolute values; where they are not finite, training has "
                "diverged: lower the learning rate, or slow the target down",
            )
        self._priority = torch.where(self._new, self._largest[self._stratum], self._priority)

    def _random(self, count: int) -> Tensor:
        # float64: the 24 bits of a float32 reach no further than 16 million rows.
        kind = torch.float64
        return torch.rand(count, generator=self.generator, device=self.device, dtype=kind)

    def _shuffled(self, stratum: int) -> Tensor:
        first, size = int(self._first[stratum]), int(self.sizes[stratum])
        turns = torch.randperm(size, generator=self.generator, device=self.device)
        return self._members[first + turns]

    def _hand_back(self) -> None:
        """Forget what is drawn ahead: quotas are owed again, rows that had their turn are next."""
        rows, strata = self._rows_ahead[self._next :], self._strata_ahead[self._next :]
        self.quotas.give_back(self._quota_ahead[self._next :])
        for stratum in self._turns:
            back = self._returned[stratum]
            self._returned[stratum] = torch.cat([rows[strata == stratum], back])
        self._rows_ahead, self._strata_ahead = rows[:0], strata[:0]
        self._quota_ahead, self._weights_ahead = self._quota_ahead[:0], None
        self._next = 0

    def mismatch(self, name: str, value: Any) -> MixtureError:
        """Of a state of a sampler over other strata."""
        return another_sampler()

    def restored(self) -> None:
        """Weights that were drawn ahead go to the device."""
        if self._weights_ahead is not None:
            self._weights_ahead = self._weights_ahead.to(self.device)
