"""Sample a panel's rows by the mixture's shares, rules and limits, for any learner.

    sampler = sampler_for(panel, 256, seed=0)
    batch = sampler.draw()                           # row numbers, strata, weights
    sampler.gather(batch.rows, out)                  # (B, W) float32
    sampler.update(batch.rows, td_abs)               # after the gradient step

A stratum's rows are drawn by its rule `within`. Importance weights follow the current shares. No
row is drawn more often than `max_replays_per_row`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.replay.mixture.mixture import Mixture
from restock.replay.mixture.share_controller import (
    PlannedDraws,
    SampledStratum,
    ShareController,
)
from restock.replay.mixture.shares import stands_for_others
from restock.replay.plan.plan import outcome_column
from restock.replay.plan.strata import rules_of
from restock.replay.plan.weights import WeightsInForce
from restock.replay.sampling.sampler import QuotaSampler
from restock.state import Stateful

if TYPE_CHECKING:
    from restock.replay.panel.panel import Panel


@dataclass(frozen=True)
class BatchDraw:
    """The logged rows of one batch."""

    rows: Ints  # (L,) row numbers in the panel
    strata: Ints  # (L,) stratum of each row
    weight: F32 | None  # (L,) importance weights; None: all 1
    quota: F64  # (S,) shares of the strata in this draw


class LoggedSampler(Stateful):
    """Samples logged rows for one learner. `sampler_for` builds a sampler for a panel.

    `controller` sets the shares, and `sampler` draws rows by them. If a drawn row has already been
    drawn `max_replays_per_row` times, a row of the same stratum that may still be drawn replaces
    it, or else (offline only) a row of another stratum. Otherwise the batch has one row less.

    Args:
        rows: (n, W) the packed rows.
        weights: importance weights: (n,), or weights that change with the shares; None: all 1.
        rng: the random generator that chooses replacements.
    """

    STATE: ClassVar[tuple[str, ...]] = ("sampler", "controller", "replays", "replaced", "_rng")

    def __init__(
        self,
        controller: ShareController,
        sampler: QuotaSampler,
        rows: F32,
        stratum_rows: Sequence[Ints],
        *,
        weights: WeightsInForce | F32 | None,
        rng: np.random.Generator,
    ) -> None:
        self.controller, self.sampler = controller, sampler
        self._rows, self._stratum_rows, self._weights = rows, list(stratum_rows), weights
        self.batch_size = sampler.batch_size  # used if `draw` gets no count
        if isinstance(weights, WeightsInForce):
            weights.set_shares(controller.shares)
        # Number of times that each row was drawn, counted only if there is a limit.
        limit = controller.max_replays
        self.replays: NDArray[np.int32] | None = None
        if limit is not None:
            self.replays = np.zeros(len(rows), np.int32)
        self._budget: Ints = (limit or 0) * np.array([len(members) for members in stratum_rows])
        # Number of rows of each stratum that were replaced because of the limit.
        self.replaced: Ints = np.zeros(len(controller.shares), np.int64)
        self._rng = rng

    def move_to(self, env_steps: int, stock: F64 | None = None) -> bool:
        """Advance the shares to the next online batch; return whether they changed.

        `stock` (S,): see `ShareController.at`.
        """
        if changed := self.controller.at(env_steps, stock):
            self._apply_shares()
        return changed

    def replan(self, planned: PlannedDraws) -> None:
        """Replace the planned draws from the next batch on."""
        if self.controller.replan(planned):
            self._apply_shares()

    def draw(self, count: int | None = None) -> BatchDraw:
        """Draw `count` rows for a batch, or fewer if too few rows may still be drawn."""
        self.sampler.set_batch_size(self.batch_size if count is None else count)
        quota = self.controller.shares
        rows, strata = self.sampler.draw()
        of_rule = self.sampler.drawn_weights
        if self.replays is not None and self.controller.max_replays is not None:
            rows, strata, of_rule = self._enforce_limit(
                rows, strata, of_rule, self.controller.max_replays
            )
        self.controller.count(strata)
        weight = of_rule
        if (corrected := self.weights_of(rows)) is not None:
            weight = corrected if of_rule is None else corrected * of_rule
        if self.replays is not None and self._is_used_up() and self.controller.give_up():
            self._apply_shares()
        return BatchDraw(rows, strata, weight, quota)

    def weights_of(self, rows: Ints) -> F32 | None:
        """Return the importance weights (n,) of rows (n,) under the current shares.

        None means that all weights are 1.
        """
        if isinstance(self._weights, WeightsInForce):
            return self._weights.of(rows)
        return None if self._weights is None else self._weights[rows]

    def gather(self, rows: Ints, out: F32) -> None:
        """Copy packed rows (L,) into `out` (L, W)."""
        np.take(self._rows, rows, axis=0, out=out, mode="clip")

    @property
    def needs_td(self) -> bool:
        """Return whether draws depend on the TD errors given to `update`."""
        return self.sampler.follows_td

    def update(self, rows: Ints, td_abs: NDArray[Any]) -> None:
        """Take |TD error| (n,) of rows (n,) that were just used in an update."""
        self.sampler.update(rows, td_abs)

    def _apply_shares(self) -> None:
        """Apply the controller's shares to the sampler and the weights."""
        self.sampler.set_shares(self.controller.shares)
        if isinstance(self._weights, WeightsInForce):
            self._weights.set_shares(self.controller.shares)

    restored = _apply_shares

    def _enforce_limit(
        self, rows: Ints, strata: Ints, weight: F32 | None, limit: int
    ) -> tuple[Ints, Ints, F32 | None]:
        """Count the drawn rows (L,), and replace rows that were drawn more often than `limit`."""
        replays = self.replays
        if replays is None:
            raise RuntimeError("draws are not counted")
        np.add.at(replays, rows, 1)
        beyond = np.flatnonzero(replays[rows] > limit)
        if not len(beyond):
            return rows, strata, weight
        rows, strata = rows.copy(), strata.copy()
        kept = np.ones(len(rows), np.bool_)
        if weight is not None:
            weight = weight.copy()
        for place in beyond.tolist():
            row, stratum = int(rows[place]), int(strata[place])
            if replays[row] <= limit:  # replacing another draw of this row was enough
                continue
            replays[row] -= 1
            self.replaced[stratum] += 1
            replacement = self._replacement(stratum, limit)
            if replacement is None:
                kept[place] = False
                continue
            rows[place], strata[place] = replacement
            replays[replacement[0]] += 1
            if weight is not None:
                weight[place] = 1.0
        return rows[kept], strata[kept], None if weight is None else weight[kept]

    def _replacement(self, stratum: int, limit: int) -> tuple[int, int] | None:
        """Return a row that may still be drawn, and its stratum; None if there is none.

        The given stratum is tried first, then (offline only) the others in a random order that
        favours large shares.
        """
        replays, shares = self.replays, self.controller.shares
        if replays is None:
            return None
        others = self._rng.permutation(len(shares))
        by_share = sorted(others.tolist(), key=lambda s: -shares[s] * self._rng.random())
        if self.controller.online:  # fresh rows will fill the batch
            by_share = []
        for code in [stratum, *by_share]:
            members = self._stratum_rows[code]
            free = members[replays[members] < limit]
            if len(free):
                return int(free[self._rng.integers(len(free))]), code
        return None

    def _is_used_up(self) -> bool:
        """Return whether a stratum with a share has used up all its draws."""
        controller, full = self.controller, self.controller.drawn >= self._budget
        return bool(controller.shares[full].any()) and controller.logs_share > 0

    def describe(self) -> list[dict[str, Any]]:
        """Return one dict per stratum, for the run's table `shares`."""
        replays = self.replays
        rows = self.controller.describe()
        for index, (row, members) in enumerate(zip(rows, self._stratum_rows, strict=True)):
            most = None if replays is None else int(replays[members].max(initial=0))
            row |= {"replays_max": most, "replaced_rows": int(self.replaced[index])}
        return rows


def sampler_for(
    panel: Panel,
    batch_size: int,
    *,
    seed: int | Sequence[int],
    planned: PlannedDraws | None = None,
    logs_share: float | None = None,
    fresh: Bools | None = None,
) -> LoggedSampler:
    """Build a sampler that draws from a panel by its mixture.

    Args:
        batch_size: logged rows of a batch.
        seed: one or several integers of at least 0 that seed the draws.
        planned: number of draws, over which `max_replays_per_row` is spread; default: the
            mixture's `planned_draws`.
        logs_share: share of logged rows in an online batch; default: the mixture's.
        fresh: (S,) strata that rows of a fresh ring can be in; None: there is no ring.

    Raises:
        MixtureError: too few rows for the planned draws, if the mixture refuses that.
    """
    header = panel.header
    mixture, members = header.mixture, panel.stratum_rows()
    controller = controller_for(panel, planned or planned_by(mixture), logs_share, fresh)
    seeds = [seed] if isinstance(seed, int | np.integer) else seed
    rng = np.random.default_rng([*seeds, 2])
    sampler = QuotaSampler(
        members,
        controller.shares,
        batch_size,
        rng,
        within=[stratum.within for stratum in panel.strata],
        prioritised=mixture.prioritised,
        column=panel.meta_column,
    )
    return LoggedSampler(
        controller,
        sampler,
        panel.rows,
        members,
        weights=_weights(panel),
        rng=np.random.default_rng([*seeds, 3]),
    )


def sampler_by_shares(
    rows: F32,
    names: Sequence[str],
    stratum_rows: Sequence[Ints],
    shares: F64,
    batch_size: int,
    *,
    seed: int,
    logs_share: float,
    weights: F32 | None = None,
) -> LoggedSampler:
    """Build a sampler over rows (n, W) that are not from a panel, with fixed shares (S,).

    Each stratum is drawn without replacement.
    """
    controller = ShareController.fixed(
        names, [len(members) for members in stratum_rows], shares, logs_share
    )
    return LoggedSampler(
        controller,
        QuotaSampler(
            stratum_rows,
            controller.shares,
            batch_size,
            np.random.default_rng([seed, 2]),
            within="without_replacement",
        ),
        rows,
        stratum_rows,
        weights=weights,
        rng=np.random.default_rng([seed, 3]),
    )


def planned_by(mixture: Mixture) -> PlannedDraws:
    """Return a plan with a mixture's `planned_draws`, all of them online."""
    return PlannedDraws(online=float(mixture.planned_draws))


def controller_for(
    panel: Panel,
    planned: PlannedDraws,
    logs_share: float | None = None,
    fresh: Bools | None = None,
) -> ShareController:
    """Build the controller of shares for the `planned` draws from a panel.

    Raises:
        MixtureError: see `ShareController`.
    """
    mixture, sizes = panel.header.mixture, [len(rows) for rows in panel.stratum_rows()]
    names = [stratum.name.removeprefix(f"{stratum.source}/") for stratum in panel.strata]
    strata = [
        SampledStratum(
            stratum.name,
            stratum.source,
            rule,
            size,
            stratum.episodes,
            stratum.natural_share if stands_for_others(mixture, stratum.source) else None,
            stratum.correction != "none",
        )
        for stratum, rule, size in zip(panel.strata, rules_of(mixture, names), sizes, strict=True)
    ]
    return ShareController(mixture, strata, planned, logs_share=logs_share, fresh=fresh)


def _weights(panel: Panel) -> WeightsInForce | F32 | None:
    """Return the weights of a panel's rows; None if all are 1."""
    strata = panel.strata
    if all(stratum.correction == "none" for stratum in strata):
        weights = panel.weights
        return None if np.all(weights == 1) else weights
    meta, size = panel.meta, len(strata) // (1 + len(panel.header.others))
    outcome = None
    for index, stratum in enumerate(strata[:size]):
        if (name := outcome_column(stratum.name)) in meta.column_names:
            outcome = np.zeros((len(panel), size), np.float32) if outcome is None else outcome
            outcome[:, index] = meta[name].to_numpy()
    return WeightsInForce(
        panel.stratum_code,
        np.asarray(meta["state_code"].to_numpy(), np.int16),
        strata,
        1 + len(panel.header.others),
        panel.header.mixture.correction,
        outcome,
        [
            np.array([stratum.natural_share for stratum in strata[place : place + size]])
            if stands_for_others(panel.header.mixture, strata[place].source)
            else None
            for place in range(0, len(strata), size)
        ],
    )
