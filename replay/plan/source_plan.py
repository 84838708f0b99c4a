"""The plan of one source of a panel: shares, importance weights, and missing rows.

Strata with a wanted share and no rows are reported, with what to change. Most often this is
nominal: with `unit = "episode"` it has only the episodes that met no condition.
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
    rows_represented,
)


def explain_no_rows(rule: StratumRule) -> str:
    """Return what is wrong with a stratum without rows, and what to change, for a message."""
    if rule.name == NOMINAL and rule.where is None and rule.unit == "episode":
        return (
            "has no episode: each met the condition of another stratum; give the most frequent one"
            ' unit = "step" or a larger min_steps, or raise its threshold in the profile and run'
            " `restock store label`"
        )
    other = "change its `where`" if rule.where is not None else "leave it out of the strata"
    return f"has no row that may be drawn: record some (`restock coverage gaps`), or {other}"


TOLERANCE = 0.01  # relative difference up to which shares of rows and of the gradient are equal


@dataclass(frozen=True)
class SourceRows:
    """The rows of one source that may be drawn; arrays are (n,) unless noted."""

    name: str
    part: float  # share of a batch that this source should fill
    candidates: pa.Table  # the rows of all sources, including those left out
    at: Ints  # positions of this source's rows in `candidates`
    code: NDArray[np.int16]  # index of the row's stratum
    state_code: NDArray[np.int16]  # index of the stratum by the row's state alone; -1: none
    episode: Codes
    logged: Bools  # (E,) episodes of this source in recordings with admitted rows
    admitted: Ints  # (S,) rows of each stratum, including those beyond a cap


@dataclass(frozen=True)
class SourcePlan:
    """The plan of one source. Shares in `lines` are shares of the source's rows in a batch."""

    shares: SharePlan
    kept: Bools  # (n,) rows of strata with a share above 0
    weight: F32  # importance weights of the kept rows
    outcome: F32 | None  # (kept, S) P(stratum | state, action); None if not estimated
    fit: RatioFit | None
    lines: list[Stratum]
    warnings: tuple[str, ...]  # warnings about strata with a wanted share but no rows
    found: dict[str, F64]  # stratum that lacks rows -> its rows by episode (E,); NaN: not `logged`

    @property
    def drawn(self) -> float:
        """Return the fraction that the source can fill of its part of a batch."""
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

    `natural` (S,) are the natural shares that its rows represent; None: their own. `unknown` maps
    conditions that are unknown in all its rows to the reason.

    Raises:
        MixtureError: too few rows, or weights that take a stratum below its natural share, if the
            mixture refuses that.
    """
    size = len(strata)
    rows = np.bincount(source.code, minlength=size).astype(np.int64)
    of_each = (np.bincount(source.episode[source.code == i]) for i in range(size))
    per_episode = [counts[counts > 0] for counts in of_each]
    episodes = np.array([len(counts) for counts in per_episode], np.int64)
    draws = mixture.planned_draws * source.part
    rules = [stratum.rule for stratum in strata]
    unknown_strata = {
        rule.name: why
        for rule, count in zip(rules, rows, strict=True)
        if not count and rule.where is None and (why := (unknown or {}).get(rule.name))
    }
    empty = [rule for rule, count in zip(rules, rows, strict=True) if not count]
    lacking = {rule.name: explain_no_rows(rule) for rule in empty}
    shares = plan_shares(
        mixture,
        rules,
        rows,
        episodes,
        draws=draws,
        natural=natural,
        unknown=unknown_strata,
        lacking=lacking,
    )
    wanted = (rule.name for rule, share in zip(rules, shares.wanted, strict=True) if share > 0)
    warnings = tuple(
        f"{name} {lacking[name]}"
        for name in wanted
        if name in lacking and name not in unknown_strata
    )
    kept = np.asarray((shares.got > 0)[source.code], np.bool_)
    code, state = source.code[kept], source.state_code[kept]
    outcome, fit = _outcomes(connection, mixture, strata, source, kept, natural)
    weight = importance_weights(
        code, state, strata, shares.got, mixture.correction, outcome, natural
    )
    after = effective_shares(code, weight, shares.got)
    missing = missing_rows(mixture, rows, shares.wanted, draws)
    missing[[rule.name in unknown_strata for rule in rules]] = 0  # more drives would not help
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
    """Return whether weights took a stratum's share of the gradient below its natural share.

    If the drawn share is already below the natural share, by quota or for lack of rows, the share
    of the gradient is compared with the drawn share, and only if the stratum has a correction.
    Shares in `line` are shares of its source's rows.
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
    """Estimate P(k | s, a) for strata k with the correction "density_ratio", (kept, S).

    Also returns the quality of the fit. Both are None if there are no such strata.
    """
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
        rows_represented(code, len(strata), natural),
    )
    names = tuple(strata[index].name for index in estimated.tolist())
    estimate, fit = estimate_outcomes(connection, rows, estimated, names, source.name)
    outcome = np.zeros((len(code), len(strata)), np.float32)
    outcome[:, estimated] = estimate
    return outcome, fit
