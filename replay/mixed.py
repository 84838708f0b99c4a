"""Batches by quota between strata where not all strata are drawn from by the same rule."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.errors import MixtureError
from restock.replay.layout import F32, F64, Ints
from restock.replay.mixture import Prioritised, Within
from restock.replay.per import PrioritySampler
from restock.replay.priorities import Lap, Per
from restock.replay.quotas import Quotas
from restock.replay.sampler import QuotaSampler, Sampler


def panel_sampler(
    within: Sequence[Within],
    stratum_rows: Sequence[NDArray[Any]],
    shares: F64,
    batch_size: int,
    rng: np.random.Generator,
    numbers: Prioritised,
    *,
    lap_floor: float = 1.0,
) -> Sampler:
    """The sampler for strata that are each drawn from by a rule (S,): one for all, or mixed."""
    rules = {rule for rule, rows in zip(within, stratum_rows, strict=True) if len(rows)}
    if len(rules) > 1:
        return MixedSampler(
            within, stratum_rows, shares, batch_size, rng, numbers, lap_floor=lap_floor
        )
    return _sampler(rules.pop(), stratum_rows, shares, batch_size, rng, numbers, lap_floor)


def _sampler(
    within: Within,
    stratum_rows: Sequence[NDArray[Any]],
    shares: Sequence[float] | F64,
    batch_size: int,
    rng: np.random.Generator,
    numbers: Prioritised,
    lap_floor: float,
) -> Sampler:
    if within in ("uniform", "without_replacement"):
        replacement = within == "uniform"
        return QuotaSampler(stratum_rows, shares, batch_size, rng, replacement=replacement)
    rule = (
        Per(numbers.per_alpha, numbers.per_beta, numbers.per_beta_batches, numbers.per_epsilon)
        if within == "per"
        else Lap(numbers.lap_alpha, lap_floor)
    )
    return PrioritySampler(stratum_rows, shares, batch_size, rng, rule=rule)


class MixedSampler:
    """Exact quotas per batch over strata, each stratum drawn from by its own rule.

    Every stratum has a sampler of its own, which is drawn from in parts of about its quota; what is
    left of a part goes into the next batch.
    """

    def __init__(
        self,
        within: Sequence[Within],
        stratum_rows: Sequence[NDArray[Any]],
        shares: F64,
        batch_size: int,
        rng: np.random.Generator,
        numbers: Prioritised,
        *,
        lap_floor: float = 1.0,
    ) -> None:
        self.quotas = Quotas(shares, batch_size)
        self.sizes: Ints = np.array([len(rows) for rows in stratum_rows], np.int64)
        self._check_shares(self.quotas.shares)
        self.parts: list[Sampler | None] = [
            _sampler(
                rule, [rows], [1.0], max(round(batch_size * share), 1), rng, numbers, lap_floor
            )
            if len(rows)
            else None
            for rule, rows, share in zip(within, stratum_rows, self.quotas.shares, strict=True)
        ]
        last = max((int(rows.max(initial=-1)) for rows in stratum_rows), default=-1)
        self._code = np.full(last + 1, -1, np.int16)
        for stratum, rows in enumerate(stratum_rows):
            self._code[rows] = stratum
        # Drawn and not handed out: (row, weight) of each stratum.
        self._rows: list[Ints] = [np.empty(0, np.int64) for _ in self.parts]
        self._weights: list[F32] = [np.empty(0, np.float32) for _ in self.parts]
        self._drawn_weights: F32 | None = None

    @property
    def batch_size(self) -> int:
        return self.quotas.batch_size

    @property
    def shares(self) -> F64:
        return self.quotas.shares

    @property
    def drawn_weights(self) -> F32 | None:
        """Importance weights (B,) that the batch last drawn needs; None for ones."""
        return self._drawn_weights

    def draw(self) -> tuple[Ints, Ints]:
        """Row numbers (B,) and the stratum of each (B,), strata in order."""
        quota = self.quotas.next()
        rows, weights = [], []
        for stratum in np.flatnonzero(quota).tolist():
            count = int(quota[stratum])
            while len(self._rows[stratum]) < count:
                self._draw_part(stratum)
            rows.append(self._rows[stratum][:count])
            weights.append(self._weights[stratum][:count])
            self._rows[stratum] = self._rows[stratum][count:]
            self._weights[stratum] = self._weights[stratum][count:]
        weight = np.concatenate(weights)
        self._drawn_weights = None if (weight == 1).all() else weight
        return np.concatenate(rows), np.repeat(np.arange(len(quota)), quota)

    def _draw_part(self, stratum: int) -> None:
        part = self.parts[stratum]
        if part is None:  # _check_shares lets no share through
            raise MixtureError(f"stratum {stratum} has no rows")
        rows, _ = part.draw()
        weights = part.drawn_weights
        if weights is None:
            weights = np.ones(len(rows), np.float32)
        self._rows[stratum] = np.concatenate([self._rows[stratum], rows])
        self._weights[stratum] = np.concatenate([self._weights[stratum], weights])

    def update(self, rows: Ints, td_abs: NDArray[Any]) -> None:
        """|TD error| (n,) of rows (n,) that were just learnt from."""
        code = self._code[rows]
        for stratum in np.unique(code).tolist():
            part, mine = self.parts[stratum], code == stratum
            if part is not None:
                part.update(rows[mine], td_abs[mine])

    def set_shares(self, shares: Sequence[float] | F64) -> None:
        """Other shares from the next batch on.

        Raises:
            MixtureError: shares that are no distribution, or a share on an empty stratum.
        """
        self._check_shares(Quotas(shares, self.batch_size).shares)
        self.quotas.set_shares(shares)

    def set_batch_size(self, batch_size: int) -> None:
        """Batches of another size from the next one on."""
        self.quotas.set_batch_size(batch_size)

    def _check_shares(self, shares: F64) -> None:
        for stratum in np.flatnonzero((shares > 0) & (self.sizes == 0)).tolist():
            raise MixtureError(f"stratum {stratum} has a share and no rows")

    def state_dict(self) -> dict[str, Any]:
        """All that decides the draws to come: arrays and JSON values."""
        return {
            "carry": self.quotas.carry,
            "shares": self.shares.copy(),
            "batch_size": self.batch_size,
            "sizes": self.sizes.copy(),
            "parts": {
                str(stratum): {
                    "sampler": part.state_dict(),
                    "rows": self._rows[stratum].copy(),
                    "weights": self._weights[stratum].copy(),
                }
                for stratum, part in enumerate(self.parts)
                if part is not None
            },
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Raises MixtureError when the state is of a sampler over other strata."""
        if "parts" not in state or not np.array_equal(state["sizes"], self.sizes):
            raise MixtureError(
                "the saved sampler drew from other strata, or by other rules",
                remedy="resume with the panel and the settings the run began with",
            )
        self.quotas.set_batch_size(int(state["batch_size"]))
        self.quotas.set_shares(np.asarray(state["shares"]))
        self.quotas.carry = np.array(state["carry"], np.float64)
        for stratum, part in enumerate(self.parts):
            if part is not None:
                saved = state["parts"][str(stratum)]
                part.load_state_dict(saved["sampler"])
                self._rows[stratum] = np.array(saved["rows"], np.int64)
                self._weights[stratum] = np.array(saved["weights"], np.float32)
