"""What a source's rows stand for: how often each stratum occurs where nobody chose what to keep.

An archive of incident bags is no natural sample: a near collision in every other mission says what
was kept, not how the floor is. `represents` in the mixture's sources says what the rows stand for.
Natural shares (of rows, by stratum) are then the represented ones, `share = "natural"` means those,
and corrections weigh the rows back to them. A cap on an episode's or a recording's rows chooses
what is packed, too: what is left stands for all the rows that the mixture admits.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Ints
from restock.errors import MixtureError
from restock.replay.mixture.mixture import (
    Mixture,
    Represents,
    StratumLimits,
    StratumRule,
)

# How many times the others' odds of a condition, by episode, are reason to warn, and to refuse an
# archive that does not say that it is one; and of how many such episodes. Odds, because what a
# fifth of all episodes meet can never be five times as frequent.
WARNING_ODDS, ARCHIVE_ODDS, ARCHIVE_EPISODES = 2.0, 5.0, 5
Z_99 = 2.576  # standard errors of a normal distribution's two-sided 99 % interval


class Source(Protocol):
    """What must be known of a source's rows, (n,) each."""

    @property
    def name(self) -> str: ...
    @property
    def code(self) -> NDArray[np.int16]: ...
    @property
    def admitted(self) -> Ints: ...  # (S,) rows of each stratum, those beyond a cap too


class Resolved(Protocol):
    """What must be known of a stratum."""

    @property
    def rule(self) -> StratumRule: ...
    @property
    def correction(self) -> str: ...


def represented_shares(
    mixture: Mixture, strata: Sequence[Resolved], sources: Sequence[Source]
) -> list[F64 | None]:
    """Return the natural share of each stratum (S,) that each source represents.

    It is None if a source represents just its own rows.

    Raises:
        MixtureError: rates that are of no stratum or leave no room for the others.
    """
    names = [stratum.rule.name for stratum in strata]
    rows = [np.bincount(source.code, minlength=len(names)) for source in sources]
    own: list[F64] = [source.admitted / max(int(source.admitted.sum()), 1) for source in sources]
    shares: list[F64 | None] = []
    for number, (source, said) in enumerate(
        zip(sources, mixture.sources.said.values(), strict=True)
    ):
        if isinstance(said, Mapping):
            own[number] = _told(said, names, source.admitted, source.name)
        elif said == "archive":
            own[number] = own[0]
        capped = bool((source.admitted > rows[number]).any())
        shares.append(own[number] if capped or mixture.sources.chosen(source.name) else None)
    for source, share, counts in zip(sources, shares, rows, strict=True):
        if share is not None:
            _refuse_unknown(strata, share, counts, source.name)
    return shares


def stands_for_others(mixture: Mixture, source: str) -> bool:
    """Return whether a source's rows in a panel may stand for other rates than their own."""
    rules: list[Mixture | StratumLimits] = [mixture, *mixture.strata]
    if mixture.each_condition is not None:
        rules.append(mixture.each_condition)
    return mixture.sources.chosen(source) or any(
        rule.max_rows_per_episode or rule.max_rows_per_recording for rule in rules
    )


def _told(rates: Mapping[str, float], names: Sequence[str], rows: Ints, source: str) -> F64:
    """Return the rates as given; what is left to the other strata by their rows."""
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
    """Raise if a stratum has rows but no known natural rate: they cannot be weighted back to it."""
    if all(stratum.correction == "none" for stratum in strata):
        return
    untold = [
        s.rule.name for s, part, n in zip(strata, share, rows, strict=True) if n and part <= 0
    ]
    if untold:
        raise MixtureError(
            f"source {source!r} has rows of {', '.join(untold)}, but by its `represents`"
            " they never occur",
            remedy=f"give their rates: represents = {{ {untold[0]} = 0.001 }}; or do not weight"
            ' strata: [correction] pre and post = "none"',
        )


def look_for_archives(
    said: Mapping[str, Represents | None],
    observed: Mapping[str, Sequence[tuple[int, int]]],
    strata: Collection[str],
) -> tuple[str, ...]:
    """Return warnings for a source where a condition is far more frequent than in the others.

    Of several such conditions, the clearest. Only a source that does not say what it represents is
    looked at, and compared with those that do not stand for other rates than their own.

    Args:
        said: what each source says of itself.
        observed: condition or exposure -> per source, episodes that met it, and all episodes.
        strata: names of strata: the rates of others change nothing.

    Raises:
        MixtureError: the same, of a stratum, by ARCHIVE_ODDS.
    """
    found = []
    for number, (source, represents) in enumerate(said.items()):
        others = [
            k for k, what in enumerate(said.values()) if k != number and what in (None, "natural")
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
        '"natural" (it is as it occurs)',
    ]
    remedy = f"set in {place} what its rows represent: represents = {' or '.join(choices)}"
    if refused:
        raise MixtureError(f"the source {source!r} looks like an archive: {what}", remedy=remedy)
    return (f"the source {source!r} may be an archive: {what}; {remedy}",)


def odds_ratio(mine: tuple[int, int], theirs: tuple[int, int]) -> tuple[float, float, float]:
    """Return the odds as a multiple of the others' odds, with a 99 % interval.

    The interval is wide because several conditions are compared.

    `mine` and `theirs` are (episodes that met it, episodes). Half an episode is added to each count
    (Haldane 1956, Anscombe 1956), so that none is 0.
    """
    counts = np.array([mine[0], mine[1] - mine[0], theirs[0], theirs[1] - theirs[0]]) + 0.5
    log_odds = float(np.log(counts) @ [1, -1, -1, 1])
    margin = Z_99 * float(np.sqrt((1 / counts).sum()))
    return math.exp(log_odds), math.exp(log_odds - margin), math.exp(log_odds + margin)
