"""Batches by quota between strata, and by priority within each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.errors import MixtureError
from restock.replay.mixture.mixture import Prioritised, Within
from restock.replay.mixture.packed_row import F32, F64, Bools, Ints
from restock.replay.sampling.priorities import Lap, Per, Priorities, Rule
from restock.replay.sampling.sampler import QuotaSampler, Sampler

# Of batches drawn from one state of the priorities. A block draws at most a sixteenth of the rows,
# so that few come again before what was learnt of them counts; many rows cost more to sum.
FEWEST, MOST = 8, 128


class PrioritySampler(QuotaSampler):
    """Exact quotas per batch over strata, each stratum's rows in proportion to their priority.

    Args:
        rule: `Per()` or `Lap()`, of all strata or of each, (S,). A stratum that has None is drawn
            from as `replacement` says.
        refresh_every: batches drawn from one state of the priorities; None: as many as a sixteenth
            of the rows make, within 8 and 128. 1 draws every batch from the priorities as they are.

    After each draw, `drawn_weights` (B,) are the importance weights of the distribution that the
    batch was really drawn from, and `update` takes the |TD errors| of what was learnt.

    Raises:
        MixtureError: as `QuotaSampler`, or a row in two strata.
    """

    def __init__(
        self,
        stratum_rows: Sequence[NDArray[Any]],
        shares: Sequence[float] | F64,
        batch_size: int,
        rng: np.random.Generator,
        *,
        rule: Rule | Sequence[Rule | None],
        refresh_every: int | None = None,
        weights: F32 | None = None,
        replacement: bool | Sequence[bool] = True,
    ) -> None:
        rules = [rule] * len(stratum_rows) if isinstance(rule, Per | Lap) else list(rule)
        if len(rules) != len(stratum_rows):
            raise MixtureError(f"{len(rules)} rules for {len(stratum_rows)} strata")
        given = [replacement] * len(rules) if isinstance(replacement, bool) else list(replacement)
        # By priority is with replacement.
        again = [own or rule is not None for own, rule in zip(given, rules, strict=True)]
        super().__init__(stratum_rows, shares, batch_size, rng, weights=weights, replacement=again)
        if refresh_every is None:
            some = int(self.sizes.sum()) // (16 * batch_size)
            refresh_every = min(max(some, FEWEST), MOST)
        if refresh_every < 1:
            raise MixtureError(f"refresh_every must be at least 1, got {refresh_every}")
        self.block = refresh_every
        self.priorities = Priorities(stratum_rows, rules)
        self._ruled: Bools = np.array([rule is not None for rule in rules], np.bool_)
        self._batches = 0  # handed out
        self._ahead_weights: F32 | None = None

    @property
    def drawn_weights(self) -> F32 | None:
        """Importance weights (B,) that the batch last drawn needs; None where the rule has none."""
        return None if self._ahead_weights is None else self._ahead_weights[self._next - 1]

    def draw(self) -> tuple[Ints, Ints]:
        """Row numbers (B,) and the stratum of each (B,), strata in order."""
        rows, strata = super().draw()
        self._batches += 1
        return rows, strata

    def update(self, rows: Ints, td_abs: NDArray[Any]) -> None:
        """|TD error| (n,) of rows (n,) just learnt from: their priorities from the next block on.

        Raises:
            MixtureError: a TD error that is not finite.
        """
        self.priorities.update(rows, td_abs)

    def _take_all(self, counts: Ints, order: Ints) -> None:
        ruled = self._ruled
        rows, weights = self.priorities.draw(np.where(ruled, counts, 0), self._batches, self.rng)
        if not ruled.all():
            rows, weights = self._with_others(rows, weights, counts)
        drawn = np.empty(len(order), np.int64)
        drawn[order] = rows
        self._ahead_rows = drawn.reshape(self.block, -1)
        self._ahead_weights = None
        if weights is not None:
            dealt = np.empty(len(order), np.float32)
            dealt[order] = weights
            self._ahead_weights = dealt.reshape(self.block, -1)

    def _with_others(
        self, rows: Ints, weights: F32 | None, counts: Ints
    ) -> tuple[Ints, F32 | None]:
        """Rows by priority and those of strata without a rule, stratum by stratum."""
        by_priority = np.repeat(self._ruled, counts)
        every = np.empty(len(by_priority), np.int64)
        every[by_priority] = rows
        others = [
            self._take(stratum, int(counts[stratum]))
            for stratum in np.flatnonzero(~self._ruled).tolist()
        ]
        every[~by_priority] = np.concatenate(others)
        if weights is None:
            return every, None
        all_weights = np.ones(len(every), np.float32)
        all_weights[by_priority] = weights
        return every, all_weights

    def _hand_back(self) -> None:
        super()._hand_back()
        self._ahead_weights = None

    def state_dict(self) -> dict[str, Any]:
        """All that decides the draws to come: arrays and JSON values."""
        state = super().state_dict() | {
            "batches": self._batches,
            "priorities": self.priorities.state_dict(),
        }
        if self._ahead_weights is not None:
            state["ahead_weights"] = self._ahead_weights[self._next :].copy()
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Raises MixtureError when the state is of a sampler over other strata."""
        if "priorities" not in state:
            raise MixtureError(
                "the saved sampler did not draw by priority",
                remedy="resume with the panel and the settings the run began with",
            )
        super().load_state_dict(state)
        self._batches = int(state["batches"])
        self.priorities.load_state_dict(state["priorities"])
        weights = state.get("ahead_weights")
        self._ahead_weights = None if weights is None else np.array(weights, np.float32)


def sampler_by_rules(
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
