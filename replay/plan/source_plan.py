"""The plan of one source of a panel: shares, importance weights, and missing rows.

Strata with a wanted share and no rows are named, with what to change. Most often that is nominal:
with `unit = "episode"` it has the episodes that met nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import duckdb
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Codes, Ints
from restock.errors import MixtureError
from restock.ingest.task.conditions import NOMINAL
from restock.replay.mixture.mixture import Mixture, StratumRule
from restock.replay.mixture.shares import (
    SharePlan,
    missing_rows,
    plan_shares,
)
from restock.replay.plan.exclusions import scramble
from restock.replay.plan.strata import ResolvedStratum, Stratum
from restock.replay.plan.weights import (
    RatioFit,
    RatioRows,
    effective_count,
    effective_shares,
    estimate_outcomes,
    importance_weights,
    stands_for,
)


def no_rows(rule: StratumRule) -> str:
    """Return what to change where a stratum has no row."""
    if rule.name == NOMINAL and rule.where is None and rule.unit == "episode":
        return (
            "has no episode: each met the condition of another stratum; give the most frequent one"
            ' unit = "step" or a larger min_steps, or raise its threshold in the profile and run'
            " `restock store label`"
        )
    other = "change its `where`" if rule.where is not None else "leave it out of the strata"
    return f"has no row that may be drawn: record some (`restock coverage gaps`), or {other}"


# A share of the gradient this much below the natural one is no rounding.
TOLERANCE = 0.01


@dataclass(frozen=True)
class SourceRows:
    """The rows of one source that may be drawn, (n,) each."""

    name: str
    part: float  # of a batch that this source is to fill
    candidates: pa.Table  # all of them
    at: Ints  # the places of these rows
    code: NDArray[np.int16]  # stratum
    state_code: NDArray[np.int16]  # the one their state alone would put them in
    episode: Codes
    logged: Bools  # (E,) whether each episode is of this source's logging
    admitted: Ints  # (S,) rows of each stratum, those beyond a cap too


@dataclass(frozen=True)
class SourcePlan:
    """A source worked out. Shares in `lines` are of the source's own part of a batch."""

    shares: SharePlan
    kept: Bools  # (n,) rows of strata that are drawn at all
    weight: F32  # of the kept rows
    outcome: F32 | None  # (kept, S) P(stratum | state, action), where one is estimated
    fit: RatioFit | None
    lines: list[Stratum]
    warnings: tuple[str, ...]  # of strata without the rows for any of their share
    found: dict[str, F64]  # of strata that lack rows: their rows in each episode (E,), or NaN

    @property
    def drawn(self) -> float:
        """Return how much of its part the source can fill."""
        return self.shares.scale


def plan_source(
    connection: duckdb.DuckDBPyConnection,
    mixture: Mixture,
    strata: Sequence[ResolvedStratum],
    source: SourceRows,
    natural: F64 | None = None,
    unknown: Mapping[str, str] | None = None,
) -> SourcePlan:
    """Plan the shares, weights and report lines of one source.

    `natural` (S,) are the shares that its rows stand for, where that is not their own; `unknown`
    the conditions that none of them tells, and why.

    Raises:
        MixtureError: too few rows, or weights that take a
            stratum below its natural share, where the mixture refuses that.
    """
    size = len(strata)
    rows = np.bincount(source.code, minlength=size).astype(np.int64)
    of_each = (np.bincount(source.episode[source.code == i]) for i in range(size))
    per_episode = [counts[counts > 0] for counts in of_each]
    episodes = np.array([len(counts) for counts in per_episode], np.int64)
    draws = mixture.planned_draws * source.part
    rules = [stratum.rule for stratum in strata]
    untold = {
        rule.name: why
        for rule, count in zip(rules, rows, strict=True)
        if not count and rule.where is None and (why := (unknown or {}).get(rule.name))
    }
    empty = [rule for rule, count in zip(rules, rows, strict=True) if not count]
    lacking = {rule.name: no_rows(rule) for rule in empty}
    shares = plan_shares(
        mixture,
        rules,
        rows,
        episodes,
        draws=draws,
        natural=natural,
        unknown=untold,
        lacking=lacking,
    )
    wanted = (rule.name for rule, share in zip(rules, shares.wanted, strict=True) if share > 0)
    warnings = tuple(
        f"{name} {lacking[name]}" for name in wanted if name in lacking and name not in untold
    )
    kept = np.asarray((shares.got > 0)[source.code], np.bool_)
    code, state = source.code[kept], source.state_code[kept]
    outcome, fit = _outcomes(connection, mixture, strata, source, kept, natural)
    weight = importance_weights(
        code, state, strata, shares.got, mixture.correction, outcome, natural
    )
    after = effective_shares(code, weight, shares.got)
    missing = missing_rows(mixture, rows, shares.wanted, draws)
    missing[[rule.name in untold for rule in rules]] = 0  # no drive of such robots brings any
    occurs = rows / max(rows.sum(), 1) if natural is None else natural
    found: dict[str, F64] = {}
    for i in np.flatnonzero(missing).tolist():
        counts = np.bincount(source.episode[source.code == i], minlength=len(source.logged))
        found[rules[i].name] = np.where(source.logged, counts, np.nan)
    lines = [
        Stratum(
            name=stratum.name,
            source=source.name,
            timing=stratum.timing,
            correction=stratum.correction,
            within=stratum.within,
            rows=int(rows[i]),
            episodes=int(episodes[i]),
            natural_share=float(occurs[i]),
            wanted_share=float(shares.wanted[i]),
            share=float(shares.got[i]),
            replays_per_row=float(draws * shares.scale * shares.got[i] / max(rows[i], 1)),
            effective_episodes=effective_count(per_episode[i]),
            effective_rows=effective_count(weight[code == i]),
            largest_weight=float(weight[code == i].max(initial=0.0)),
            effective_share=float(after[i]),
            note=shares.notes[i],
            missing_rows=int(missing[i]),
        )
        for i, stratum in enumerate(strata)
    ]
    if mixture.correction.below_natural == "refuse":
        _refuse_below_natural(lines)
    return SourcePlan(shares, kept, weight, outcome, fit, lines, warnings, found)


def below_natural(line: Stratum) -> bool:
    """Return whether weights took a stratum's share of the gradient below its share of the rows.

    If its quota or a lack of rows already puts it below that, only what its own correction takes
    from the drawn share counts. `line` has shares of its source's part.
    """
    least = (1.0 - TOLERANCE) * min(line.natural_share, line.share)
    weighted = line.correction != "none" or line.share >= (1.0 - TOLERANCE) * line.natural_share
    return weighted and line.effective_share < least


def _refuse_below_natural(lines: Sequence[Stratum]) -> None:
    below = [line for line in lines if below_natural(line)]
    if not below:
        return
    of_them = "; ".join(
        f"{line.name} ({line.correction}) is {line.natural_share:.2%} of the rows,"
        f" {line.wanted_share:.2%} wanted, {line.share:.2%} drawn and {line.effective_share:.2%}"
        " of the gradient after weights"
        for line in below
    )
    raise MixtureError(
        f"its correction gives a stratum a smaller share than it has in the logs: {of_them}",
        remedy='set unit = "episode" (whole episodes need no correction), or '
        + (
            "a larger [correction] clip (keeps more of the boost), or post ="
            if all(line.correction == "density_ratio" for line in below)
            else '[correction] post = "density_ratio" (keeps the boost; a larger clip keeps'
            " more) or"
        )
        + ' "none" (keeps all of it, and its bias); below_natural = "allow" mixes it as it is',
    )


def _outcomes(
    connection: duckdb.DuckDBPyConnection,
    mixture: Mixture,
    strata: Sequence[ResolvedStratum],
    source: SourceRows,
    kept: Bools,
    natural: F64 | None,
) -> tuple[F32 | None, RatioFit | None]:
    """Return P(k | s, a) of the strata that a density ratio corrects, (kept, S), or None."""
    code = source.code[kept]
    by_ratio = [s.correction == "density_ratio" and s.timing == "post" for s in strata]
    estimated = np.flatnonzero(by_ratio & (np.bincount(code, minlength=len(strata)) > 0))
    if not len(estimated):
        return None, None
    at = source.at[kept]
    ids = source.candidates["transition_id"].to_numpy()[at]
    rows = RatioRows(
        ids,
        source.candidates["action"].to_numpy()[at].astype(np.int64),
        source.state_code[kept],
        code,
        scramble(ids, mixture.seed),
        stands_for(code, len(strata), natural),
    )
    names = tuple(strata[index].name for index in estimated.tolist())
    estimate, fit = estimate_outcomes(connection, rows, estimated, names, source.name)
    outcome = np.zeros((len(code), len(strata)), np.float32)
    outcome[:, estimated] = estimate
    return outcome, fit
