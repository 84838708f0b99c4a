"""The sampler that a mixture's rules within strata ask for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.replay.mixture.mixture import Prioritised, Within
from restock.replay.mixture.packed_row import F64
from restock.replay.sampling.per import PrioritySampler
from restock.replay.sampling.priorities import Lap, Per, Rule
from restock.replay.sampling.sampler import QuotaSampler, Sampler


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
    """The sampler for strata that are each drawn from by a rule (S,), the same one or not."""
    again = [rule != "without_replacement" for rule in within]
    if not any(rule in ("per", "lap") for rule in within):
        return QuotaSampler(stratum_rows, shares, batch_size, rng, replacement=again)
    per = Per(numbers.per_alpha, numbers.per_beta, numbers.per_beta_batches, numbers.per_epsilon)
    named: dict[Within, Rule] = {"per": per, "lap": Lap(numbers.lap_alpha, lap_floor)}
    rules = [named.get(rule) for rule in within]
    return PrioritySampler(stratum_rows, shares, batch_size, rng, rule=rules, replacement=again)
