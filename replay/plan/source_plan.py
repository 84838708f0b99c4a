"""One source of a panel worked out: shares, importance weights, and what is missing on a shelf."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import duckdb
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Codes, Ints
from restock.errors import MixtureError
from restock.replay.mixture.mixture import Mixture, StratumRule
from restock.replay.mixture.schedules import knots
from restock.replay.mixture.shares import (
    SharePlan,
    has_minimum,
    missing_rows,
    plan_shares,
    wanted_shares,
)
from restock.replay.plan.exclusions import scramble
from restock.replay.plan.forecast import Forecast, forecast
from restock.replay.plan.strata import ResolvedStratum, Stratum
from restock.replay.plan.unfilled import too_few
from restock.replay.plan.weights import (
    RatioFit,
    RatioRows,
    effective_count,
    effective_shares,
    estimate_outcomes,
    importance_weights,
    stands_for,
)

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
    hours: F64  # (E,) of each episode; NaN where it is none of this source's logging
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
    taken: Mapping[str, str] | None = None,
) -> SourcePlan:
    """Plan the shares, weights and report lines of one source.

    `natural` (S,) are the shares that its rows stand for, where that is not their own; `unknown`
    the conditions that none of them tells, and why; `taken` the strata that another one empties.

    Raises:
        MixtureError: too few rows, bounds of [adaptive] that no shares keep, or weights that take a
            stratum below its natural share, where the mixture refuses that.
    """
    size = len(strata)
    rows = np.bincount(source.code, minlength=size).astype(np.int64)
    of_each = (np.bincount(source.episode[source.code == i]) for i in range(size))
    per_episode = [counts[counts > 0] for counts in of_each]
    episodes = np.array([len(counts) for counts in per_episode], np.int64)
    draws = mixture.planned.updates * mixture.planned.batch_size * source.part
    rules = [stratum.rule for stratum in strata]
    untold = {
        rule.name: why
        for rule, count in zip(rules, rows, strict=True)
        if not count and rule.where is None and (why := (unknown or {}).get(rule.name))
    }
    lacking = {
        rule.name: too_few(rule, *has) for rule, *has in zip(rules, rows, episodes, strict=True)
    }
    lacking = {name: why for name, why in (lacking | dict(taken or {})).items() if why}
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
    _refuse_later_shares(rules, rows if natural is None else natural)
    # A share with a schedule may begin at 0; others that are 0 are never drawn.
    scheduled = np.array([not isinstance(rule.share, int | float | str) for rule in rules])
    drawn = (shares.got > 0) | (scheduled & has_minimum(rules, rows, episodes))
    kept = np.asarray(drawn[source.code], np.bool_)
    code, state = source.code[kept], source.state_code[kept]
    outcome, fit = _outcomes(connection, mixture, strata, source, kept, natural)
    weight = importance_weights(
        code, state, strata, shares.got, mixture.correction, outcome, natural
    )
    after = effective_shares(code, weight, shares.got)
    missing = missing_rows(mixture, rules, rows, episodes, shares.wanted, draws)
    missing[[rule.name in untold for rule in rules]] = 0  # no drive of such robots brings any
    occurs = rows / max(rows.sum(), 1) if natural is None else natural
    found: dict[str, F64] = {}
    driving: dict[str, Forecast] = {}
    for i in np.flatnonzero(missing).tolist():
        name, hours = rules[i].name, source.hours
        counts = np.bincount(source.episode[source.code == i], minlength=len(hours))
        found[name] = np.where(np.isnan(hours), np.nan, counts)
        driving[name] = forecast(found[name], hours, missing[i], rng=np.random.default_rng(0))
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
            **_hours(driving.get(stratum.name)),
        )
        for i, stratum in enumerate(strata)
    ]
    if mixture.correction.below_natural == "refuse":
        _refuse_below_natural(lines)
    return SourcePlan(shares, kept, weight, outcome, fit, lines, warnings, found)


def _hours(driving: Forecast | None) -> dict[str, float]:
    """Return the hours of driving that a stratum lacks; empty if none is known to help."""
    if driving is None or not driving.known:
        return {}
    ends = {"missing_hours": 0.5, "missing_hours_low": 0.025, "missing_hours_high": 0.975}
    return {name: driving.quantile(share) for name, share in ends.items()}


def _refuse_later_shares(rules: Sequence[StratumRule], natural: Ints | F64) -> None:
    """Raise MixtureError where schedules leave the other strata no way to share out the rest."""
    portions = [rule.share for rule in rules if not isinstance(rule.share, str)]
    bends = sorted({step for portion in portions for step in knots(portion)})
    # Between two bends a cosine can lie above the line that joins them.
    fine = [a + (b - a) * i / 16 for a, b in itertools.pairwise(bends) for i in range(16)]
    for step in [*fine, *bends[-1:]]:
        try:
            wanted_shares(rules, natural, step)
        except MixtureError as error:
            raise MixtureError(
                f"at environment step {step:,.0f}: {error.what}", remedy=error.remedy
            ) from error


def below_natural(line: Stratum) -> bool:
    """Return whether weights took a stratum's share of the gradient below its share of the rows.

    What its quota or the lack of its rows gives it below that already is not the weights' doing:
    then only a correction of its own counts, and what it takes of the share that is drawn. `line`
    has shares of its source's part.
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
    """P(k | s, a) of the strata that a density ratio corrects, (kept, S), or None for none."""
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
