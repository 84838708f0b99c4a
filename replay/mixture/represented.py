"""What a source's rows stand for: how often each stratum occurs where nobody chose what to keep.

An archive of incident bags is no natural sample: a near collision in every other mission says what
was kept, not how the floor is. `represents` in the mixture's sources says what the rows stand for.
Natural shares (of rows, by stratum) are then the represented ones, `share = "natural"` means those,
and corrections weigh the rows back to them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Ints
from restock.errors import MixtureError
from restock.replay.mixture.mixture import Mixture, StratumRule

# How many times the others' rate of a condition, by episode, speaks of an archive; and how many
# episodes of it there must be.
ARCHIVE_RATIO, ARCHIVE_EPISODES = 5.0, 5


class Source(Protocol):
    """What must be known of a source's rows, (n,) each."""

    @property
    def name(self) -> str: ...
    @property
    def code(self) -> NDArray[np.int16]: ...
    @property
    def episode(self) -> Ints: ...


class Resolved(Protocol):
    """What must be known of a stratum."""

    @property
    def rule(self) -> StratumRule: ...
    @property
    def correction(self) -> str: ...


def represented_shares(
    mixture: Mixture, strata: Sequence[Resolved], sources: Sequence[Source], nominal: str
) -> list[F64 | None]:
    """The natural share of each stratum (S,) that each source stands for; None: of its own rows.

    `nominal` is the stratum of what met no condition, which is no rare one.

    Raises:
        MixtureError: a source that looks like an archive and does not say what it represents, or
            rates that are of no stratum or leave no room for the others.
    """
    refuse_archives(mixture, strata, sources, nominal)
    names = [stratum.rule.name for stratum in strata]
    rows = [np.bincount(source.code, minlength=len(names)) for source in sources]
    first = mixture.sources.represents
    main: F64 = rows[0] / max(int(rows[0].sum()), 1)
    if isinstance(first, Mapping):
        main = _told(first, names, rows[0], sources[0].name)
    shares: list[F64 | None] = [main if isinstance(first, Mapping) else None]
    for source, counts, store in zip(sources[1:], rows[1:], mixture.sources.stores, strict=True):
        if isinstance(store.represents, Mapping):
            shares.append(_told(store.represents, names, counts, source.name))
        else:
            shares.append(main if store.represents == "archive" else None)
    for source, share, counts in zip(sources, shares, rows, strict=True):
        if share is not None:
            _refuse_unknown(strata, share, counts, source.name)
    return shares


def _told(rates: Mapping[str, float], names: Sequence[str], rows: Ints, source: str) -> F64:
    """The rates as given; what is left to the other strata by their rows."""
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
    """Rows of a stratum whose natural rate nothing tells cannot be weighed back to it."""
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


def refuse_archives(
    mixture: Mixture, strata: Sequence[Resolved], sources: Sequence[Source], nominal: str
) -> None:
    """That no source that does not say what it represents looks like an archive.

    Raises:
        MixtureError: a condition is far more frequent among the episodes of one than of the others.
    """
    said = list(mixture.sources.said.values())
    if len(sources) < 2:
        return
    met, of_all = zip(*(_episodes(source, len(strata)) for source in sources), strict=True)
    for number, source in enumerate(sources):
        others = [k for k, what in enumerate(said) if k != number and what in (None, "natural")]
        if said[number] is not None or not others:
            continue
        for place, stratum in enumerate(strata):
            if stratum.rule.where is not None or stratum.rule.name == nominal:
                continue
            mine, all_mine = met[number][place], of_all[number]
            theirs = sum(met[k][place] for k in others), sum(of_all[k] for k in others)
            usual = (theirs[0] + 1) / (theirs[1] + 1)  # one more, as it may be chance
            if mine < ARCHIVE_EPISODES or mine / all_mine < ARCHIVE_RATIO * usual:
                continue
            place_of = "[sources]" if number == 0 else f"the store {source.name!r}"
            name = stratum.rule.name
            natural = f"{name} = {max(theirs[0], 1) / max(theirs[1], 1):.2g}"
            raise MixtureError(
                f"the source {source.name!r} looks like an archive: {mine} of its {all_mine}"
                f" episodes are of {name}, {theirs[0]} of {theirs[1]} of the other sources",
                remedy=f"set in {place_of} what its rows represent: "
                + ('represents = "archive" (the rates of the main store), ' if number else "")
                + f'represents = {{ {natural} }} (rates), or "natural" (it is as it occurs)',
            )


def _episodes(source: Source, size: int) -> tuple[Ints, int]:
    """Episodes with a row in each stratum (S,), and in all."""
    pairs = np.unique(np.stack([source.code.astype(np.int64), source.episode]), axis=1)
    return np.bincount(pairs[0], minlength=size), len(np.unique(source.episode))
