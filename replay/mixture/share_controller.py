"""The shares of a run: the share of a batch that each stratum gets now, and its draws so far.

A panel's shares are planned for the mixture's `planned_draws`. The controller plans them again for
the draws and environment steps of the actual run. It counts draws, so that no row is drawn more
than `max_replays_per_row` times on average over its stratum.

A quota is a stratum's share of the batch, whether its rows are logged or fresh. Logged rows fill
the share that the mixture wants from the logs, as far as `max_replays_per_row` allows, spread
evenly over the run. Fresh rows of the same stratum fill the rest. If the ring has too few of them,
logged rows that may still be drawn fill in. If there are still too few, the stratum is short, and
fresh rows of any stratum take its places. A learner without a ring has only logged rows: for it,
the mixture's `shortfall` decides what happens.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.errors import MixtureError
from restock.replay.mixture.mixture import (
    Mixture,
    Shortfall,
    SourceShares,
    StratumRule,
)
from restock.replay.mixture.shares import wanted_shares, within_limits
from restock.state import Stateful

REFRESH_BATCHES = 64  # online batches between two updates of the shares
_MIN_CHANGE = 0.01  # shares are kept if none changes by more than this, relatively
_MIN_SHORTFALL = 1e-3  # a smaller shortfall (share of all rows fed) is ignored as rounding


@dataclass(frozen=True)
class PlannedDraws:
    """Number of rows that a run will draw: offline, and online over a span of environment steps."""

    offline: float = 0.0  # rows drawn offline, all logged
    online: float = 0.0  # rows drawn online, logged and fresh
    begin_env_steps: int = 0
    end_env_steps: int = 0


@dataclass(frozen=True)
class SampledStratum:
    """A stratum of a panel, as the controller needs it."""

    name: str
    source: str
    rule: StratumRule
    rows: int  # number of its rows in the panel; 0 if the stratum is never drawn
    episodes: int
    occurs: float | None = None  # natural share, if its rows are a selection (an archive, a cap)
    corrected: bool = False  # whether importance weights offset the stratum's boost


@dataclass
class _SourceDraws:
    """The strata of one source, its planned draws, and its shares."""

    name: str
    strata: slice
    rules: list[StratumRule]
    rows: Ints
    caps: F64
    offline: float  # planned draws
    online: float
    got: F64  # current shares of the strata
    natural: Ints | F64  # rows or natural shares of the strata, up to a constant factor
    wanted: F64  # shares of the strata that the mixture wants


class ShareController(Stateful):
    """Controls the shares of a panel's strata in a batch, from the draws so far and the plan.

    Args:
        mixture: the panel's mixture.
        strata: the panel's strata, source by source.
        planned: number of rows that the run will draw.
        logs_share: share of logged rows in an online batch; None: the mixture's.
        fresh: (S,) whether labels can put fresh rows into each stratum; None: there is no ring.

    With K sources of S strata, `shares` (K * S,) are shares of a batch's logged rows and sum to 1.
    `logs_share` is the share of logged rows in an online batch, and `drawn` (K * S,) the number of
    rows drawn from each stratum. `wanted` (S,) is each stratum's quota in the whole batch.
    `fresh_shares` (S + 1,) are the shares of the whole batch that the ring gives by stratum; the
    last entry is for fresh rows of any stratum.

    Raises:
        MixtureError: too few rows for the offline phase, or a shortfall the mixture refuses.
    """

    SAME: ClassVar[tuple[str, ...]] = ("names",)
    STATE: ClassVar[tuple[str, ...]] = (
        *("drawn", "batches", "env_steps", "shares", "logs_share"),
        *("online", "wanted", "fresh_shares", "stock"),
    )

    def __init__(
        self,
        mixture: Mixture,
        strata: Sequence[SampledStratum],
        planned: PlannedDraws,
        *,
        logs_share: float | None = None,
        fresh: Bools | None = None,
    ) -> None:
        self.mixture, self.strata, self.planned = mixture, list(strata), planned
        self.max_replays = mixture.most_draws  # largest number of draws of one row; None: no limit
        self.fresh, self.online = fresh, False
        size = len(strata) // len(mixture.sources.parts)
        self._index: Ints = np.arange(len(strata)) % size  # (K * S,) index of the stratum, 0..S - 1
        self.wanted: F64 = np.zeros(size)
        self.fresh_shares: F64 = np.append(np.zeros(size), 1.0)
        self.stock: F64 = np.zeros(size)  # fresh rows that may be drawn, in units of a batch
        self.drawn: Ints = np.zeros(len(strata), np.int64)
        self.batches = 0  # number of batches drawn
        self.env_steps = 0.0
        self.shares: F64 = np.zeros(len(strata))
        self.logs_share = 0.0
        self.parts = dict(mixture.sources.parts)  # wanted shares of an online batch, by source
        if logs_share is not None:
            total = max(sum(self.parts.values()), 1e-12)
            self.parts = {name: part * logs_share / total for name, part in self.parts.items()}
        self.sources = [self._source(name) for name in self.parts]
        shares = [stratum.rule.share for stratum in strata]
        # If no stratum has a quota, the ring is sampled uniformly.
        self._has_quotas = any(share != "natural" for share in shares)
        self._compute_shares(mixture.shortfall)
        self.planned_shares, self._wanted_offline = self.shares.copy(), self.wanted
        if fresh is not None and mixture.shortfall == "refuse":
            self._refuse_short()

    @classmethod
    def fixed(
        cls, names: Sequence[str], rows: Sequence[int], shares: F64, logs_share: float
    ) -> ShareController:
        """Build a controller with fixed shares."""
        rules = tuple(
            StratumRule(name=name, share=float(share))
            for name, share in zip(names, shares, strict=True)
        )
        mixture = Mixture(strata=rules, sources=SourceShares(logs=1.0))
        strata = [SampledStratum(r.name, "logs", r, n, 1) for r, n in zip(rules, rows, strict=True)]
        return cls(mixture, strata, PlannedDraws(), logs_share=logs_share)

    def _source(self, name: str) -> _SourceDraws:
        places = [i for i, stratum in enumerate(self.strata) if stratum.source == name]
        of_source = slice(places[0], places[-1] + 1)
        strata = self.strata[of_source]
        rules = [stratum.rule for stratum in strata]
        natural = np.array([s.rows if s.occurs is None else s.occurs for s in strata])
        return _SourceDraws(
            name,
            of_source,
            rules,
            np.array([stratum.rows for stratum in strata], np.int64),
            np.array([stratum.rule.cap for stratum in strata]),
            *self._draws_of(name),
            np.zeros(len(strata)),
            natural,
            wanted_shares(rules, natural),
        )

    def _draws_of(self, name: str) -> tuple[float, float]:
        """Return the planned draws from a source: offline, and online."""
        part = self.parts[name]
        offline = self.planned.offline * part / max(sum(self.parts.values()), 1e-12)
        return offline, self.planned.online * part

    def at(self, env_steps: float, stock: F64 | None = None) -> bool:
        """Advance to the next online batch; return whether the shares changed.

        `stock` (S,) is how many fresh rows of each stratum may be drawn, in units of a batch.
        """
        self.env_steps = env_steps
        if self.fresh is None:
            return False
        if self.batches % REFRESH_BATCHES and self.online:
            return False
        self.online = True
        if stock is not None:
            self.stock = stock
        return self._compute_shares("redistribute")

    def replan(self, planned: PlannedDraws) -> bool:
        """Replace the planned draws from the next batch on; return whether the shares changed."""
        self._plan_for(planned)
        return self._compute_shares("redistribute")

    def _plan_for(self, planned: PlannedDraws) -> None:
        self.planned = planned
        for source in self.sources:
            source.offline, source.online = self._draws_of(source.name)

    def count(self, stratum: NDArray[Any]) -> None:
        """Count a drawn batch, given the strata (n,) of its logged rows."""
        self.batches += 1
        self.drawn += np.bincount(stratum, minlength=len(self.drawn))

    def give_up(self) -> bool:
        """Redistribute shares once a stratum has no draws left; return whether shares changed."""
        return self._compute_shares("redistribute")

    def _compute_shares(self, shortfall: Shortfall) -> bool:
        """Compute the shares that the remaining draws allow; return whether they changed."""
        if self.online:
            return self._compute_online_shares()
        if self.mixture.shortfall == "shrink" and self.fresh is None:
            shortfall = "shrink"
        shares, logs_share = np.zeros(len(self.strata)), 0.0
        for source in self.sources:
            source.got, filled, online_filled = self._plan(source, shortfall)
            part = self.mixture.sources.parts[source.name]
            shares[source.strata] = source.got * part * filled
            logs_share += self.parts[source.name] * online_filled
        total = shares.sum()
        shares = shares / total if total > 0 else self.shares
        self.wanted = np.bincount(self._index, self._requested) / max(
            sum(self.parts.values()), 1e-12
        )
        changed = logs_share != self.logs_share or not np.array_equal(shares, self.shares)
        self.shares, self.logs_share = shares, logs_share
        return changed

    @property
    def _requested(self) -> F64:
        """Return the shares of an online batch that the mixture wants from the logs, (K * S,)."""
        return np.concatenate([self.parts[source.name] * source.wanted for source in self.sources])

    def _compute_online_shares(self) -> bool:
        """Compute the shares of an online batch, logged and fresh; return whether they changed."""
        logs, fresh, wanted = self._split(self.stock, self._limits())
        self.wanted = wanted
        fresh_shares = np.append(fresh, max(1.0 - logs.sum() - fresh.sum(), 0.0))
        logs_share = float(logs.sum())
        before = self.shares * self.logs_share
        # Ignore small changes: after each change, batches drawn ahead must be drawn again.
        same = np.abs(np.append(logs, fresh_shares) - np.append(before, self.fresh_shares))
        if (same < _MIN_CHANGE * np.append(logs, fresh_shares) + 1e-9).all():
            return False
        self.shares = logs / logs_share if logs_share > 0 else self.shares
        self.logs_share, self.fresh_shares = logs_share, fresh_shares
        return True

    def _split(self, stock: F64, limit: F64) -> tuple[F64, F64, F64]:
        """Return shares of a batch: from the logs (K * S,), from the ring (S,), and wanted (S,).

        `stock` (S,) limits the shares from the ring, `limit` (K * S,) those from the logs.
        """
        requested, logged = self._requested, sum(self.parts.values())
        wanted = np.bincount(self._index, requested) + max(1.0 - logged, 0.0) * self._wanted_fresh(
            stock
        )
        logs = np.minimum(requested, limit)
        if not self._has_quotas:
            return logs, np.zeros(len(wanted)), wanted
        rest = np.maximum(wanted - np.bincount(self._index, logs), 0.0)
        fresh = np.minimum(rest * self.boosted, stock)
        # If fresh rows are missing, draw more logged rows of the stratum, within the limit.
        room = limit - logs
        of_stratum = np.bincount(self._index, room)
        lack = np.minimum(rest - fresh, of_stratum)
        part = np.divide(lack, of_stratum, out=np.zeros(len(lack)), where=of_stratum > 0)
        return logs + room * part[self._index], fresh, wanted

    @property
    def natural(self) -> F64:
        """Return the natural share of each stratum in the logs, (S,)."""
        rows = np.sum([source.natural for source in self.sources], axis=0, dtype=np.float64)
        return np.asarray(rows / max(rows.sum(), 1e-12))

    @property
    def boosted(self) -> Bools:
        """Return which strata (S,) draw fresh rows by quota.

        Strata with importance weights do not: fresh rows have no weights that would offset a boost.
        """
        corrected = np.array([stratum.corrected for stratum in self.strata[: len(self.wanted)]])
        known = np.zeros(len(corrected), np.bool_) if self.fresh is None else self.fresh
        return np.asarray(known & ~corrected, np.bool_)

    def _wanted_fresh(self, stock: F64) -> F64:
        """Return wanted shares of fresh rows, (S,).

        "natural" shares are in proportion to the ring's rows, or to the logs' if it has none.
        """
        source = self.sources[0]
        if all(rule.share != "natural" for rule in source.rules):
            return source.wanted  # independent of the rows
        have = stock if np.isfinite(stock).all() and stock.sum() > 0 else source.natural
        return wanted_shares(source.rules, have)

    def _limits(self, *, from_start: bool = False) -> F64:
        """Return the largest share of an online batch that each stratum's rows allow, (K * S,)."""
        rows = np.array([stratum.rows for stratum in self.strata], np.float64)
        if self.max_replays is None:
            return np.where(rows > 0, 1.0, 0.0)
        planned = self.planned
        begin, end = planned.begin_env_steps, planned.end_env_steps
        now = begin if from_start else min(max(self.env_steps, begin), end)
        drawn: F64 = self.drawn.astype(np.float64)
        if from_start:  # assume that the offline phase draws as planned
            offline = [source.offline * source.got for source in self.sources]
            drawn = np.maximum(drawn, np.concatenate(offline))
        left = np.maximum(self.max_replays * rows - drawn, 0.0)
        ahead = planned.online * (end - now) / max(end - begin, 1)
        return np.minimum(left / max(ahead, 1.0), 1.0)

    def forecast(self) -> list[dict[str, Any]]:
        """Forecast what a run will be fed, one dict per stratum.

        The shares are of all rows that the run draws: natural, wanted, from the logs, from the
        ring, and short, with the reason. The forecast assumes that the ring has enough rows of
        every stratum that fresh rows can be in.
        """
        planned, size = self.planned, len(self.wanted)
        online = planned.online if self.fresh is not None else 0.0
        total = max(planned.offline + online, 1e-12)
        logs = planned.offline / total * np.bincount(self._index, self.planned_shares)
        wanted, fresh = planned.offline / total * self._wanted_offline, np.zeros(size)
        if online:
            limits = self._limits(from_start=True)
            of_logs, of_ring, requested = self._split(np.full(size, np.inf), limits)
            by_stratum = np.bincount(self._index, of_logs)
            if not self._has_quotas:  # the ring, sampled uniformly, gives the rest of the batch
                of_ring = np.maximum(requested - by_stratum, 0.0)
            part = online / total
            logs, fresh, wanted = (
                logs + part * by_stratum,
                part * of_ring,
                wanted + part * requested,
            )
        natural = self.natural
        short = np.maximum(wanted - logs - fresh, 0.0)
        short[short < 1e-6] = 0.0
        return [
            {
                "stratum": self.names[i],
                "natural_share": float(natural[i]),
                "wanted_share": float(wanted[i]),
                "logs_share": float(logs[i]),
                "fresh_share": float(fresh[i]),
                "short_share": float(short[i]),
                "reason": self.why_short(i) if short[i] else None,
            }
            for i in range(size)
        ]

    def why_short(self, stratum: int) -> str:
        """Explain why a stratum gets less of a batch than its quota."""
        rows = sum(of.rows for of, i in zip(self.strata, self._index, strict=True) if i == stratum)
        limit = self.max_replays
        reason = "the logs have no rows of it"
        if rows:
            reason = f"its {rows:,} logged rows"
            reason += " are all there is" if limit is None else f" give {limit:,} draws each"
        if self.fresh is None:
            return reason
        if not self.fresh[stratum]:
            return f"{reason}, and the twin has no fresh rows of it"
        if not self.boosted[stratum]:
            return f"{reason}, and fresh rows are not boosted if importance weights correct it"
        if not self.online:
            return f"{reason}, and the offline phase has no fresh rows"
        return f"{reason}, and the ring has too few fresh rows of it"

    def _refuse_short(self) -> None:
        """Raise MixtureError if a quota cannot be met."""
        short = [row for row in self.forecast() if row["short_share"] > _MIN_SHORTFALL]
        if short:
            raise MixtureError(
                "; ".join(
                    f"{row['stratum']} wants {row['wanted_share']:.1%} of the rows fed and gets"
                    f" {row['wanted_share'] - row['short_share']:.1%}: {row['reason']}"
                    for row in short
                ),
                remedy="lower the shares, raise max_replays_per_row, or set shortfall ="
                ' "redistribute"',
            )

    def _plan(self, source: _SourceDraws, shortfall: Shortfall) -> tuple[F64, float, float]:
        """Plan a source; return its shares, and how much of its remaining draws its rows can fill.

        The latter are two fractions: of all remaining draws, and of the remaining online draws.
        """
        wanted, drawn = source.wanted, self.drawn[source.strata]
        ahead = max(self._ahead(source, float(drawn.sum())), 1.0)
        limit = np.where(source.rows > 0, 1.0, 0.0)
        if self.max_replays is not None:
            left = np.maximum(self.max_replays * source.rows - drawn, 0)
            limit = np.minimum(limit, left / ahead)
        if np.minimum(wanted, limit).sum() <= 0:
            return np.zeros(len(wanted)), 0.0, 0.0

        def complaints() -> str:
            return "; ".join(
                f"{rule.name} wants {wanted[i]:.1%} of {ahead:,.0f} draws, its"
                f" {source.rows[i]:,} rows allow {limit[i]:.1%}"
                for i, rule in enumerate(source.rules)
                if wanted[i] > limit[i] + 1e-12
            )

        plan = within_limits(wanted, limit, source.caps, shortfall, complaints)
        offline = max(source.offline - float(drawn.sum()), 0.0)
        fill = plan.scale * ahead
        if fill < offline - 1e-6 and not drawn.any():
            raise MixtureError(
                f"the offline phase draws {offline:,.0f} rows of {source.name}, which its"
                f" {source.rows.sum():,} rows do not allow at {self.max_replays} draws each",
                remedy="lower schedule.offline_updates to"
                f" {np.floor(1000 * fill / offline) / 10:g}% of its value, raise "
                "max_replays_per_row, or ingest more",
            )
        online = ahead - offline
        filled = plan.scale if online <= 0 else min(max(fill - offline, 0.0) / online, 1.0)
        return plan.got, plan.scale, filled

    def _ahead(self, source: _SourceDraws, drawn: float) -> float:
        """Return how many draws of a source remain.

        Draws that earlier batches could not make are not made up later, and do not count.
        """
        if self.fresh is not None:  # `_limits` plans online draws if there is a ring
            return source.offline - drawn
        by_draws = source.offline + source.online - drawn
        begin, end = self.planned.begin_env_steps, self.planned.end_env_steps
        if drawn < source.offline or self.env_steps <= begin or end <= begin:
            return by_draws
        left = (end - min(self.env_steps, end)) / (end - begin)
        return min(by_draws, source.online * left)

    def describe(self) -> list[dict[str, Any]]:
        """Return one dict per stratum, for the terminal and for a run's table `shares`."""
        limit = self.max_replays
        rows = []
        for i, (stratum, share) in enumerate(zip(self.strata, self.shares.tolist(), strict=True)):
            rows.append(
                {
                    "source": stratum.source,
                    "stratum": stratum.name,
                    "share": share,
                    "planned_share": float(self.planned_shares[i]),
                    "logs_share": self.logs_share,
                    "rows": stratum.rows,
                    "drawn_rows": int(self.drawn[i]),
                    "replays_per_row": float(self.drawn[i] / max(stratum.rows, 1)),
                    "max_replays_per_row": limit,
                    "exhausted": limit is not None
                    and stratum.rows > 0
                    and int(self.drawn[i]) >= limit * stratum.rows,
                }
            )
        return rows

    @property
    def names(self) -> list[str]:
        """Return the strata's names, source by source."""
        return [stratum.name for stratum in self.strata]

    def state_dict(self) -> dict[str, Any]:
        """Return the state as arrays and JSON values, with the current plan."""
        return super().state_dict() | {"planned": asdict(self.planned)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the state, with the plan that was in force when it was saved.

        Raises:
            MixtureError: the state is of other strata.
        """
        super().load_state_dict(state)
        self._plan_for(PlannedDraws(**state["planned"]))

    def mismatch(self, name: str, value: Any) -> MixtureError:
        """Return the error for a saved state with other strata."""
        return MixtureError(
            "the saved shares are of other strata",
            remedy="resume with the panel and the settings the run began with",
        )
