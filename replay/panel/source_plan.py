"""One source of a panel, a store's rows, worked out by itself: shares, weights, and what to say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import duckdb
import numpy as np
from numpy.typing import NDArray

from restock.replay.mixture.mixture import Mixture, Within
from restock.replay.mixture.packed_row import F32, Bools, Ints
from restock.replay.mixture.shares import SharePlan, plan_shares
from restock.replay.panel.exclusions import scramble
from restock.replay.panel.strata import ResolvedStratum
from restock.replay.panel.weights import (
    RatioFit,
    RatioRows,
    effective_count,
    effective_shares,
    estimate_outcomes,
    importance_weights,
)


@dataclass(frozen=True)
class StratumPlan:
    """One line of the plan's table."""

    stratum: str
    source: str  # logs, or the name of another store
    timing: str
    correction: str
    within: Within
    rows: int
    episodes: int
    natural_share: float  # of its source's rows
    wanted_share: float  # of the logs' part of a batch, as the other shares
    share: float
    replays_per_row: float  # expected over the planned updates
    effective_episodes: float  # (sum n)^2 / sum n^2 over the rows per episode
    effective_rows: float  # rows drawn equally often that its weighted draw is worth
    largest_weight: float
    effective_share: float  # after weights
    note: str


@dataclass(frozen=True)
class SourceRows:
    """The rows of one source that may be drawn, (n,) each."""

    name: str
    part: float  # of a batch that this source is to fill
    at: Ints  # their places in the table of candidates
    code: NDArray[np.int16]  # stratum
    state_code: NDArray[np.int16]  # the one their state alone would put them in
    transition_id: Ints
    action: Ints
    episode: Ints


@dataclass(frozen=True)
class SourcePlan:
    """A source worked out. Shares in `lines` are of the source's own part of a batch."""

    shares: SharePlan
    kept: Bools  # (n,) rows of strata that are drawn at all
    weight: F32  # of the kept rows
    outcome: F32 | None  # (kept, S) P(stratum | state, action), where one is estimated
    fit: RatioFit | None
    lines: list[StratumPlan]

    @property
    def drawn(self) -> float:
        """How much of its part the source can fill."""
        return self.shares.scale


def plan_source(
    connection: duckdb.DuckDBPyConnection,
    mixture: Mixture,
    strata: Sequence[ResolvedStratum],
    source: SourceRows,
) -> SourcePlan:
    """Shares, weights and lines of one source.

    Raises:
        MixtureError: too few rows where the mixture refuses that.
    """
    size = len(strata)
    rows = np.bincount(source.code, minlength=size).astype(np.int64)
    per_episode = [
        np.unique(source.episode[source.code == i], return_counts=True)[1] for i in range(size)
    ]
    episodes = np.array([len(counts) for counts in per_episode], np.int64)
    draws = mixture.planned.updates * mixture.planned.batch_size * source.part
    rules = [stratum.rule for stratum in strata]
    shares = plan_shares(mixture, rules, rows, episodes, draws=draws)
    # A share with a schedule may begin at 0; others that are 0 are never drawn.
    drawn = (shares.got > 0) | [not isinstance(rule.share, int | float | str) for rule in rules]
    kept = np.asarray(drawn[source.code], np.bool_)
    code, state = source.code[kept], source.state_code[kept]
    outcome, fit = _outcomes(connection, mixture, strata, source, kept)
    weight = importance_weights(code, state, strata, shares.got, mixture.correction, outcome)
    after = effective_shares(code, weight, shares.got)
    lines = [
        StratumPlan(
            stratum=stratum.name,
            source=source.name,
            timing=stratum.timing,
            correction=stratum.correction,
            within=stratum.within,
            rows=int(rows[i]),
            episodes=int(episodes[i]),
            natural_share=float(rows[i] / max(rows.sum(), 1)),
            wanted_share=float(shares.wanted[i]),
            share=float(shares.got[i]),
            replays_per_row=float(draws * shares.scale * shares.got[i] / max(rows[i], 1)),
            effective_episodes=effective_count(per_episode[i]),
            effective_rows=effective_count(weight[code == i]),
            largest_weight=float(weight[code == i].max(initial=0.0)),
            effective_share=float(after[i]),
            note=shares.notes[i],
        )
        for i, stratum in enumerate(strata)
    ]
    return SourcePlan(shares, kept, weight, outcome, fit, lines)


def _outcomes(
    connection: duckdb.DuckDBPyConnection,
    mixture: Mixture,
    strata: Sequence[ResolvedStratum],
    source: SourceRows,
    kept: Bools,
) -> tuple[F32 | None, RatioFit | None]:
    """P(k | s, a) of the strata that a density ratio corrects, (kept, S), or None for none."""
    code = source.code[kept]
    by_ratio = [s.correction == "density_ratio" and s.timing == "post" for s in strata]
    estimated = np.flatnonzero(by_ratio & (np.bincount(code, minlength=len(strata)) > 0))
    if not len(estimated):
        return None, None
    ids = source.transition_id[kept]
    rows = RatioRows(
        ids, source.action[kept], source.state_code[kept], code, scramble(ids, mixture.seed)
    )
    names = tuple(strata[index].name for index in estimated.tolist())
    estimate, fit = estimate_outcomes(connection, rows, estimated, names, source.name)
    outcome = np.zeros((len(code), len(strata)), np.float32)
    outcome[:, estimated] = estimate
    return outcome, fit
