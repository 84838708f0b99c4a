"""The shares of a run: which part of a batch each stratum gets now, and what was drawn of each.

A panel's shares are a plan for the mixture's `[planned]` draws. A run knows how much it will draw,
at which environment step, and where its TD errors are: the controller plans the mixture for that
run, follows its schedules and its [adaptive] rule, and counts what is drawn, so that no stratum
gives more than its rows may give under `max_replays_per_row`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Ints
from restock.errors import MixtureError
from restock.replay.mixture.mixture import Adaptive, Mixture, Shortfall, SourceShares, StratumRule
from restock.replay.mixture.schedules import knots, mean_over, value_at
from restock.replay.mixture.shares import (
    adaptive_bounds,
    scaled_within,
    wanted_shares,
    within_limits,
)
from restock.replay.sampling.sampler import checked_errors
from restock.state import Stateful

REFRESH_BATCHES = 64  # shares with a schedule are worked out again after so many


@dataclass(frozen=True)
class PlannedDraws:
    """How many rows a run will draw: offline, and online over a span of environment steps."""

    offline: float = 0.0  # all from logs
    online: float = 0.0  # from logs and fresh rows
    begin_env_steps: int = 0
    end_env_steps: int = 0


@dataclass(frozen=True)
class SampledStratum:
    """A stratum of a panel, as the controller needs it."""

    name: str
    source: str
    rule: StratumRule
    rows: int  # in the panel; 0 where it is never drawn
    episodes: int
    occurs: float | None = None  # how often, where its rows were chosen (an archive, a cap)


class GroupDro(Stateful):
    """The shares (S,) of the strata of one source, and what their rows erred since the last step.

    Group distributionally robust optimisation (Sagawa, Koh, Hashimoto and Liang, ICLR 2020,
    arXiv:1911.08731), algorithm 1: q_g <- q_g exp(eta loss_g), normalised. There the gradient step
    is weighted by q; here q is the share of the draws, which is the same in expectation and wastes
    no rows. The loss of a group is its mean |TD error|, in units of the groups' mean, so that eta
    means the same whatever the scale of rewards. Floor and ceiling keep every group sampled, and
    none from taking all.

    `shares` begin as planned; a stratum of share 0 stays at 0.

    Raises:
        MixtureError: floors that sum to more than 1, or ceilings to less.
    """

    STATE: ClassVar[tuple[str, ...]] = ("shares", "td_abs", "_sum", "_rows")

    def __init__(self, rule: Adaptive, shares: F64, floor: F64, cap: F64) -> None:
        self.rule = rule
        self.low, self.high = adaptive_bounds(rule, shares, floor, cap)
        self.shares: F64 = scaled_within(shares, self.low, self.high)
        self.td_abs: F64 = np.full(len(shares), np.nan)  # what the last step saw, (S,)
        self._sum: F64 = np.zeros(len(shares))
        self._rows: Ints = np.zeros(len(shares), np.int64)

    def observe(self, stratum: NDArray[Any], td_abs: NDArray[Any]) -> None:
        """|TD error| (n,) of rows of these strata (n,)."""
        self._sum += np.bincount(stratum, td_abs, minlength=len(self._sum))
        self._rows += np.bincount(stratum, minlength=len(self._rows))

    def step(self) -> F64:
        """Take one step; returns the new shares (S,). A stratum that was not drawn errs as all."""
        seen = self._rows > 0
        if seen.any():
            error = np.divide(self._sum, self._rows, out=np.zeros(len(seen)), where=seen)
            unit = max(float(error[seen].mean()), 1e-12)
            factor = np.exp(self.rule.step_size * np.where(seen, error / unit, 1.0))
            self.shares = scaled_within(self.shares * factor, self.low, self.high)
            self.td_abs = np.where(seen, error, np.nan)
        self._sum[:] = 0.0
        self._rows[:] = 0
        return self.shares


@dataclass
class _SourceDraws(Stateful):
    """The strata of one source, and what it is planned to give."""

    STATE: ClassVar[tuple[str, ...]] = ("dro",)

    name: str
    strata: slice
    rules: list[StratumRule]
    rows: Ints
    caps: F64
    offline: float  # planned draws
    online: float
    got: F64  # shares of its strata now
    natural: Ints | F64  # what divides "natural" shares: rows, or how often strata occur
    dro: GroupDro | None = None


class ShareController(Stateful):
    """Shares in force and draws so far, over the strata of a panel, (S,).

    Args:
        mixture: of the panel.
        strata: of the panel, source by source.
        planned: what the run will draw.
        logs_share: a share of an online batch, in place of the mixture's.

    `shares` (S,) are of the logged part of a batch and sum to 1, `logs_share` is that part of an
    online batch, `drawn` (S,) what was drawn of each stratum.

    Raises:
        MixtureError: too few rows for the offline phase, or a shortfall the mixture refuses.
    """

    SAME: ClassVar[tuple[str, ...]] = ("names",)
    STATE: ClassVar[tuple[str, ...]] = (
        *("drawn", "batches", "learnt", "env_steps", "sources", "shares", "logs_share"),
    )

    def __init__(
        self,
        mixture: Mixture,
        strata: Sequence[SampledStratum],
        planned: PlannedDraws,
        *,
        logs_share: float | None = None,
    ) -> None:
        self.mixture, self.strata, self.planned = mixture, list(strata), planned
        self._share_given = logs_share
        self.drawn: Ints = np.zeros(len(strata), np.int64)
        self.batches = self.learnt = 0  # drawn, and learnt from
        self.env_steps = 0.0
        self.shares: F64 = np.zeros(len(strata))
        self.logs_share = 0.0
        self.sources = [self._source(name) for name in mixture.sources.parts]
        shares = [stratum.rule.share for stratum in strata]
        portions = [p for p in shares if not isinstance(p, str)]
        portions += mixture.sources.parts.values()
        self._moves = any(knots(portion) for portion in portions)
        self._work_out(mixture.shortfall)
        self.planned_shares = self.shares.copy()
        if mixture.adaptive is not None:
            for source in self.sources:
                floors = np.array([rule.floor for rule in source.rules])
                if source.got.sum() > 0:
                    source.dro = GroupDro(mixture.adaptive, source.got, floors, source.caps)
            self._work_out("redistribute")

    @classmethod
    def fixed(
        cls, names: Sequence[str], rows: Sequence[int], shares: F64, logs_share: float
    ) -> ShareController:
        """Shares that are simply given, and stay."""
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
        sources, planned = self.mixture.sources, self.planned
        parts = self.parts_at(0)
        span = (planned.begin_env_steps, planned.end_env_steps)
        mean = self._scaled({n: mean_over(part, *span) for n, part in sources.parts.items()})
        return _SourceDraws(
            name,
            of_source,
            [stratum.rule for stratum in strata],
            np.array([stratum.rows for stratum in strata], np.int64),
            np.array([self._cap_of(stratum.rule) for stratum in strata]),
            planned.offline * parts[name] / max(sum(parts.values()), 1e-12),
            planned.online * mean[name],
            np.zeros(len(strata)),
            np.array([s.rows if s.occurs is None else s.occurs for s in strata]),
        )

    def _cap_of(self, rule: StratumRule) -> float:
        adaptive = self.mixture.adaptive
        return rule.cap if adaptive is None else min(rule.cap, adaptive.ceiling)

    def parts_at(self, env_steps: float) -> dict[str, float]:
        """The share of an online batch each source is to have, before its rows are looked at."""
        sources = self.mixture.sources
        return self._scaled({n: value_at(part, env_steps) for n, part in sources.parts.items()})

    def _scaled(self, parts: dict[str, float]) -> dict[str, float]:
        if self._share_given is None:
            return parts
        total = max(sum(parts.values()), 1e-12)
        return {name: part * self._share_given / total for name, part in parts.items()}

    @property
    def strata_move(self) -> bool:
        """Whether `shares` follow the environment steps."""
        portions = [s.rule.share for s in self.strata if not isinstance(s.rule.share, str)]
        parts = list(self.mixture.sources.parts.values())
        return any(map(knots, portions + (parts if len(parts) > 1 else [])))

    @property
    def max_replays(self) -> int | None:
        """The most draws of a row."""
        return self.mixture.most_draws

    def at(self, env_steps: float) -> bool:
        """Before a batch is drawn: move to its moment. True where the shares changed."""
        self.env_steps = env_steps
        if not self._moves or self.batches % REFRESH_BATCHES:
            return False
        return self._work_out("redistribute")

    def count(self, stratum: NDArray[Any]) -> None:
        """A batch was drawn, its logged rows from these strata (n,)."""
        self.batches += 1
        self.drawn += np.bincount(stratum, minlength=len(self.drawn))

    def give_up(self) -> bool:
        """A stratum's rows were drawn as often as they may be. True where the shares changed."""
        return self._work_out("redistribute")

    def observe(self, stratum: NDArray[Any], td_abs: NDArray[Any]) -> bool:
        """A batch was learnt from: |TD error| (n,) of its rows of these strata (n,).

        True where the shares changed.

        Raises:
            MixtureError: where shares follow them, an error that is negative or not finite, or not
                one a row.
        """
        rule = self.mixture.adaptive
        if rule is None:
            return False
        td_abs = checked_errors(td_abs, stratum)
        self.learnt += 1
        stepping = self.learnt > rule.after_updates and self.learnt % rule.every_updates == 0
        for source in self.sources:
            if source.dro is not None:
                of_source = (stratum >= source.strata.start) & (stratum < source.strata.stop)
                source.dro.observe(stratum[of_source] - source.strata.start, td_abs[of_source])
                if stepping:
                    source.dro.step()
        return self._work_out("redistribute") if stepping else False

    def _work_out(self, shortfall: Shortfall) -> bool:
        """Shares for this moment, within what the rows still allow."""
        if self.mixture.shortfall == "shrink":
            shortfall = "shrink"
        parts, shares, logs_share = self.parts_at(self.env_steps), np.zeros(len(self.strata)), 0.0
        for source in self.sources:
            source.got, filled, online_filled = self._plan(source, shortfall)
            part = value_at(self.mixture.sources.parts[source.name], self.env_steps)
            shares[source.strata] = source.got * part * filled
            logs_share += parts[source.name] * online_filled
        total = shares.sum()
        shares = shares / total if total > 0 else self.shares
        changed = logs_share != self.logs_share or not np.array_equal(shares, self.shares)
        self.shares, self.logs_share = shares, logs_share
        return changed

    def _plan(self, source: _SourceDraws, shortfall: Shortfall) -> tuple[F64, float, float]:
        """A source's shares, and how much it can fill of its draws to come, and of online ones."""
        wanted = (
            wanted_shares(source.rules, source.natural, self.env_steps)
            if source.dro is None
            else source.dro.shares
        )
        drawn = self.drawn[source.strata]
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
                f" {np.floor(1000 * fill / offline) / 10:g}% of what it is, raise"
                " max_replays_per_row, or ingest more",
            )
        online = ahead - offline
        filled = plan.scale if online <= 0 else min(max(fill - offline, 0.0) / online, 1.0)
        return plan.got, plan.scale, filled

    def _ahead(self, source: _SourceDraws, drawn: float) -> float:
        """The draws that batches to come ask of a source: not what those before did not get."""
        by_draws = source.offline + source.online - drawn
        begin, end = self.planned.begin_env_steps, self.planned.end_env_steps
        if drawn < source.offline or self.env_steps <= begin or end <= begin:
            return by_draws
        part = self.mixture.sources.parts[source.name]
        now = min(self.env_steps, end)
        whole = mean_over(part, begin, end) * (end - begin)
        left = mean_over(part, now, end) * (end - now) / max(whole, 1e-12)
        return min(by_draws, source.online * left)

    def describe(self) -> list[dict[str, Any]]:
        """A row a stratum, for people and for a run's table `shares`."""
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
        """Of the strata, (S,)."""
        return [stratum.name for stratum in self.strata]

    def state_dict(self) -> dict[str, Any]:
        """Arrays and JSON values, for a checkpoint."""
        return super().state_dict() | {"planned": asdict(self.planned)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on where `state_dict` was taken; a budget that was extended is planned again.

        Raises:
            MixtureError: the state is of other strata.
        """
        super().load_state_dict(state)
        if state["planned"] != asdict(self.planned):
            self._work_out("redistribute")

    def mismatch(self, name: str, value: Any) -> MixtureError:
        """Of a state of other strata."""
        return MixtureError(
            "the saved shares are of other strata",
            remedy="resume with the panel and the settings the run began with",
        )
