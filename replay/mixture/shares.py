"""Shares of strata: those the mixture wants, limited by floors, caps and the number of rows.

Also the natural rates that a source's rows represent. An archive of incident bags is not a natural
sample: a near collision in every other mission shows which bags were kept, not how often they
happen on the floor. `represents` in the mixture's sources states the natural rates.
`share = "natural"` then means these rates, and corrections weight the rows back to them. A cap on
an episode's or a recording's rows is a selection, too: the remaining rows represent all rows that
the mixture admits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.errors import MixtureError
from restock.replay.mixture.mixture import (
    Mixture,
    Represents,
    Share,
    Shortfall,
    StratumRule,
)

# Odds ratio of a condition in the episodes of one source to that in the others: from WARNING_ODDS,
# warn of a possible archive; from ARCHIVE_ODDS, and ARCHIVE_EPISODES episodes with it, refuse the
# source. Not a ratio of frequencies: a frequency above a fifth cannot become five times as large.
WARNING_ODDS, ARCHIVE_ODDS, ARCHIVE_EPISODES = 2.0, 5.0, 5
Z_99 = 2.576  # half width of a normal distribution's 99 % interval, in standard errors


class Source(Protocol):
    """The rows of a source; arrays are (n,) unless noted."""

    @property
    def name(self) -> str: ...
    @property
    def code(self) -> NDArray[np.int16]: ...
    @property
    def admitted(self) -> Ints: ...  # (S,) rows of each stratum, including those beyond a cap


class Resolved(Protocol):
    """A stratum's rule, and the correction that applies to it."""

    @property
    def rule(self) -> StratumRule: ...
    @property
    def correction(self) -> str: ...


def represented_shares(
    mixture: Mixture, strata: Sequence[Resolved], sources: Sequence[Source]
) -> list[F64 | None]:
    """Return for each source the natural shares of strata (S,) that its rows represent.

    The entry is None for a source whose rows represent their own shares.

    Raises:
        MixtureError: a rate for an unknown stratum, rates below 1 with no other stratum to take
            the rest, or weighted rows of a stratum with rate 0.
    """
    names = [stratum.rule.name for stratum in strata]
    rows = [np.bincount(source.code, minlength=len(names)) for source in sources]
    own: list[F64] = [source.admitted / max(int(source.admitted.sum()), 1) for source in sources]
    shares: list[F64 | None] = []
    for number, (source, stated) in enumerate(
        zip(sources, mixture.sources.represented.values(), strict=True)
    ):
        if isinstance(stated, Mapping):
            own[number] = _given_rates(stated, names, source.admitted, source.name)
        elif stated == "archive":
            own[number] = own[0]
        capped = bool((source.admitted > rows[number]).any())
        shares.append(own[number] if capped or mixture.sources.chosen(source.name) else None)
    for source, share, counts in zip(sources, shares, rows, strict=True):
        if share is not None:
            _refuse_unknown(strata, share, counts, source.name)
    return shares


def stands_for_others(mixture: Mixture, source: str) -> bool:
    """Return whether packed rows of a source may represent other natural shares than their own."""
    capped = mixture.max_rows_per_episode or mixture.max_rows_per_recording
    return mixture.sources.chosen(source) or capped is not None


def _given_rates(rates: Mapping[str, float], names: Sequence[str], rows: Ints, source: str) -> F64:
    """Return natural shares (S,): the given rates; other strata divide the rest by their rows."""
    if unknown := sorted(set(rates) - set(names)):
        raise MixtureError(
            f"source {source!r}: `represents` gives a rate for {', '.join(unknown)}, which is not "
            "a stratum",
            remedy=f"the strata are {', '.join(names)}",
        )
    share = np.array([rates.get(name, 0.0) for name in names])
    other = np.where([name in rates for name in names], 0, rows)
    rest = 1.0 - float(share.sum())
    if rest > 1e-9 and not other.any():
        raise MixtureError(
            f"source {source!r}: the rates of `represents` sum to {share.sum():g}, and no other"
            " stratum has rows for the rest",
            remedy="give rates that sum to 1",
        )
    return np.asarray(share + rest * other / max(int(other.sum()), 1), np.float64)


def _refuse_unknown(strata: Sequence[Resolved], share: F64, rows: Ints, source: str) -> None:
    """Raise MixtureError if a stratum has rows and natural rate 0, which no weights can restore."""
    if all(stratum.correction == "none" for stratum in strata):
        return
    unrated = [
        s.rule.name for s, part, n in zip(strata, share, rows, strict=True) if n and part <= 0
    ]
    if unrated:
        raise MixtureError(
            f"source {source!r} has rows of {', '.join(unrated)}, but by its `represents`"
            " they never occur",
            remedy=f"give their rates: represents = {{ {unrated[0]} = 0.001 }}; or do not weight"
            ' strata: [correction] pre and post = "none"',
        )


def look_for_archives(
    stated: Mapping[str, Represents | None],
    observed: Mapping[str, Sequence[tuple[int, int]]],
    strata: Collection[str],
) -> tuple[str, ...]:
    """Return a warning if a condition is far more frequent in one source than in the others.

    If there are several such conditions, only the clearest is reported. Each source without
    `represents` is compared with the other sources that represent their own rates.

    Args:
        stated: `represents` of each source.
        observed: condition or exposure -> for each source, episodes that met it, and all episodes.
        strata: names of the strata; only their rates affect a panel.

    Raises:
        MixtureError: the condition is a stratum and its odds ratio is ARCHIVE_ODDS or more.
    """
    found = []
    for number, (source, represents) in enumerate(stated.items()):
        others = [
            k for k, what in enumerate(stated.values()) if k != number and what in (None, "natural")
        ]
        if represents is not None or not others:
            continue
        for name, of_sources in observed.items():
            mine = of_sources[number]
            theirs = (sum(of_sources[k][0] for k in others), sum(of_sources[k][1] for k in others))
            odds, low, high = odds_ratio(mine, theirs)
            if mine[1] and theirs[1] and odds >= WARNING_ODDS and low > 1:
                refused = odds >= ARCHIVE_ODDS and mine[0] >= ARCHIVE_EPISODES and name in strata
                found.append((refused, low, high, odds, number, source, name, mine, theirs))
    if not found:
        return ()
    refused, low, high, odds, number, source, name, mine, theirs = max(found)
    what = (
        f"{mine[0]} of its {mine[1]} episodes are of {name}, {theirs[0]} of {theirs[1]} of the"
        f" other sources (odds {odds:.2g} times theirs, {low:.2g} to {high:.2g})"
    )
    place = f"the store {source!r}" if number else "[sources]"
    choices = [
        *(['"archive" (the rates of the main store)'] if number else []),
        *(
            [f"{{ {name} = {max(theirs[0], 1) / theirs[1]:.2g} }} (rates)"]
            if name in strata
            else []
        ),
        '"natural" (its own rates)',
    ]
    remedy = f"set in {place} which rates its rows represent: represents = {' or '.join(choices)}"
    if refused:
        raise MixtureError(f"the source {source!r} looks like an archive: {what}", remedy=remedy)
    return (f"the source {source!r} may be an archive: {what}; {remedy}",)


def odds_ratio(mine: tuple[int, int], theirs: tuple[int, int]) -> tuple[float, float, float]:
    """Return the odds ratio of a condition in `mine` to `theirs`, with its 99 % interval.

    `mine` and `theirs` are (episodes that met the condition, all episodes). Half an episode is
    added to each count (Haldane 1956, Anscombe 1956), so that no count is 0. The confidence level
    is high because several conditions are compared.
    """
    counts = np.array([mine[0], mine[1] - mine[0], theirs[0], theirs[1] - theirs[0]]) + 0.5
    log_odds = float(np.log(counts) @ [1, -1, -1, 1])
    margin = Z_99 * float(np.sqrt((1 / counts).sum()))
    return math.exp(log_odds), math.exp(log_odds - margin), math.exp(log_odds + margin)


@dataclass(frozen=True)
class SharePlan:
    """Shares of a batch's logged rows, (S,) each."""

    wanted: F64  # shares that the mixture wants, within floors and caps
    got: F64  # shares that the rows allow; they sum to 1
    scale: float  # fraction of a batch's logged rows that the rows suffice for
    notes: tuple[str, ...]  # why each stratum got less or more than it wants; "": it did not


def plan_shares(
    mixture: Mixture,
    rules: Sequence[StratumRule],
    rows: Ints,
    episodes: Ints,
    *,
    draws: float,
    natural: F64 | None = None,
    unknown: Mapping[str, str] | None = None,
    lacking: Mapping[str, str] | None = None,
) -> SharePlan:
    """Plan shares from the mixture's rules and the number of rows (S,) and episodes (S,).

    `draws` is the number of rows that will be drawn in all. `natural` (S,) are the shares that the
    rows represent; None: their own. `unknown` maps strata that no recording can label to the
    reason, `lacking` maps strata with too few rows to what is wrong and what to change.

    Raises:
        MixtureError: shares that cannot sum to 1, or a shortfall that the mixture refuses.
    """
    wanted = wanted_shares(rules, rows if natural is None else natural)
    limit = row_limits(mixture, rows, draws)
    unknown, lacking = unknown or {}, lacking or {}
    caps = np.array([rule.cap for rule in rules])

    def complaints() -> str:
        lines = []
        for i, rule in enumerate(rules):
            why = f"its {rows[i]:,} rows in {episodes[i]:,} episodes allow {limit[i]:.2%}"
            if rule.name in unknown:
                why = f"and is unknown in every row: {unknown[rule.name]}"
            elif rule.name in lacking:
                why = f"and {lacking[rule.name]}"
            if wanted[i] > limit[i] + 1e-12:
                lines.append(f"{rule.name} wants {wanted[i]:.1%}, {why}")
        return "\n  ".join(lines)

    shares = within_limits(wanted, limit, caps, mixture.shortfall, complaints)
    notes = [
        f"unknown: {unknown[rule.name]}" if rule.name in unknown else note
        for rule, note in zip(rules, shares.notes, strict=True)
    ]
    return replace(shares, notes=tuple(notes))


def within_limits(
    wanted: F64, limit: F64, caps: F64, shortfall: Shortfall, complaints: Callable[[], str]
) -> SharePlan:
    """Limit wanted shares (S,) to those that the rows allow, `limit` (S,).

    `caps` (S,) are the largest shares that a stratum may reach by taking what others cannot fill.
    `complaints` returns the text of an error: which strata are short.

    Raises:
        MixtureError: a shortfall that the mixture refuses, or no rows at all.
    """
    granted = np.minimum(wanted, limit)
    missing = 1.0 - granted.sum()
    short = wanted > limit + 1e-12
    if missing <= 1e-9:
        return SharePlan(wanted, wanted, 1.0, ("",) * len(wanted))
    if shortfall == "refuse":
        raise MixtureError(
            f"not enough rows:\n  {complaints()}",
            remedy='lower the shares, raise max_replays_per_row, or set shortfall = "redistribute"',
        )
    if granted.sum() <= 0:
        raise MixtureError(
            f"no stratum has rows that can be drawn:\n  {complaints()}",
            remedy="`restock sql STORE 'FROM coverage_by_condition'` shows what the store holds",
        )
    notes = np.where(short, "short of rows", "")
    if shortfall == "shrink":
        return SharePlan(
            wanted, granted / granted.sum(), float(granted.sum()), tuple(notes.tolist())
        )
    roof = np.maximum(granted, np.minimum(limit, caps))
    scale = min(float(roof.sum()), 1.0)
    if scale < 1.0 - 1e-9:  # every stratum is at its limit: the logs cannot fill their share
        notes = np.where(short, "short of rows", np.where(roof > 0, "gives all it can", ""))
        return SharePlan(wanted, roof / scale, scale, tuple(notes.tolist()))
    got = scaled_within(granted, granted, roof)
    more = (got > granted + 1e-9) & ~short
    return SharePlan(wanted, got, 1.0, tuple(np.where(more, "took the surplus", notes).tolist()))


def wanted_shares(rules: Sequence[StratumRule], rows: Ints | F64) -> F64:
    """Return shares (S,): given ones are kept, "equal" and "natural" strata divide the rest.

    Floors and caps limit the divided shares. "natural" shares are in proportion to `rows` (S,),
    which may also be natural shares.

    Raises:
        MixtureError: shares that cannot sum to 1 within their floors and caps.
    """
    given = np.array([0.0 if isinstance(rule.share, str) else rule.share for rule in rules])
    flexible = np.array([isinstance(rule.share, str) for rule in rules], np.bool_)
    rest = 1.0 - float(given.sum())
    if rest < -1e-6 or (rest > 1e-6 and not flexible.any()):
        raise MixtureError(
            f"the shares of the strata sum to {given.sum():g}, not 1",
            remedy='give one stratum share = "natural" to take what is left',
        )
    if not flexible.any():
        return np.asarray(given / given.sum(), np.float64)
    base = _flexible_parts([rule.share for rule in rules], flexible, rows)
    low = np.array([rule.floor for rule in rules]) * flexible
    high = np.where(flexible, [rule.cap for rule in rules], 0.0)
    if low.sum() > rest + 1e-9 or high.sum() < rest - 1e-9:
        names = ", ".join(rules[i].name for i in np.flatnonzero(flexible).tolist())
        raise MixtureError(
            f"the floors of {names} sum to {low.sum():g} and their caps to {high.sum():g}, which "
            f"leave no way to divide {rest:g}",
            remedy="lower a floor or a given share, or raise a cap",
        )
    return given + rest_within(base, low, high, max(rest, 0.0))


def _flexible_parts(shares: Sequence[Share], flexible: Bools, rows: Ints | F64) -> F64:
    """Return the relative sizes (S,) of "equal" and "natural" strata; 0 for given shares.

    Each stratum adds 1; "natural" strata pool their sizes and divide them by rows.
    """
    natural = np.array([share == "natural" for share in shares], np.bool_)
    parts = flexible.astype(np.float64)
    if natural.any():
        pool = natural.sum() if (flexible & ~natural).any() else 1.0
        natural_rows = np.where(natural, rows, 0)
        total = float(natural_rows.sum())
        parts[natural] = pool * natural_rows[natural] / (total if total > 0 else 1.0)
    return parts


def rest_within(base: F64, low: F64, high: F64, total: float) -> F64:
    """Return shares proportional to `base`, each within [low, high], that sum to `total`."""
    if total <= 0:
        return np.zeros(len(base))
    return total * scaled_within(base / max(base.sum(), 1e-12), low / total, high / total)


def scaled_within(base: F64, low: F64, high: F64) -> F64:
    """Return clip(factor * base, low, high), with the factor for which it sums to 1.

    If entries with a positive base sum to less than 1 even at `high`, the others take the rest.
    """
    usable = np.where(base > 0, high, low)
    if usable.sum() < 1.0:
        short, room = 1.0 - usable.sum(), high - usable
        return usable + (room * (short / room.sum()) if room.sum() > 0 else 0.0)
    below, above = 0.0, 1.0
    while np.clip(above * base, low, high).sum() < 1.0 and above < 1e15:
        above *= 2.0
    for _ in range(200):
        middle = (below + above) / 2
        if np.clip(middle * base, low, high).sum() < 1.0:
            below = middle
        else:
            above = middle
    shares = np.clip(above * base, low, high)
    return np.asarray(shares / shares.sum(), np.float64)


def row_limits(mixture: Mixture, rows: Ints, draws: float) -> F64:
    """Return the largest share of `draws` that each stratum's rows allow, (S,)."""
    limit = np.where(rows > 0, 1.0, 0.0)
    if mixture.most_draws is not None and draws > 0:
        limit = np.minimum(limit, mixture.most_draws * rows / draws)
    return np.asarray(limit, np.float64)


def missing_rows(mixture: Mixture, rows: Ints, wanted: F64, draws: float) -> Ints:
    """Return how many more rows each stratum needs to fill its wanted share of `draws`, (S,)."""
    needed = np.ones(len(rows))
    if mixture.most_draws is not None:
        needed = np.maximum(needed, wanted * draws / mixture.most_draws)
    # Subtract a margin: otherwise rounding errors add a row to strata whose rows just suffice.
    missing = np.ceil(np.where(wanted > 0, needed - rows, 0.0) - 1e-6)
    return np.asarray(np.maximum(missing, 0), np.int64)
