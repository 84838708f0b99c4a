"""Strata with a wanted share and nearly no rows: why, and what to change.

Most often that is nominal: with `unit = "episode"` it has the episodes that met nothing, and a
condition that nearly every episode meets leaves none.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import Bools, Codes
from restock.ingest.task.conditions import NOMINAL
from restock.replay.mixture.mixture import StratumRule
from restock.replay.plan.candidates import bools, codes
from restock.replay.plan.strata import ResolvedStratum
from restock.words import counted

_NEARLY_NONE = 0.1  # of what a stratum could have: it has less than that …
_TAKEN = 0.5  # … because a condition holds in at least this much


def too_few(rule: StratumRule, rows: int, episodes: int) -> str:
    """Return why a stratum gets nothing, and what to change; "" if it has what it needs."""
    if not rows:
        other = "change its `where`" if rule.where is not None else "leave it out of the strata"
        return f"has no row that may be drawn: record some (`restock coverage gaps`), or {other}"
    needs = {"min_rows": (rule.min_rows, rows), "min_episodes": (rule.min_episodes, episodes)}
    short = [f"{name} = {least:,}" for name, (least, has) in needs.items() if has < least]
    if not short:
        return ""
    has = f"{counted(rows, 'row')} in {counted(episodes, 'episode')}"
    return f"has {has}, too few for its {' and '.join(short)}: lower that, or record more"


def taken_by_others(
    table: pa.Table,
    strata: Sequence[ResolvedStratum],
    member: Bools,
    stratum: NDArray[np.int16],
    admitted: Bools,
) -> dict[str, str]:
    """Return, of each stratum to which one other condition leaves nearly nothing, which one it is.

    Args:
        table: what `read_candidates` returns.
        member: (N, S) which strata a row may be in.
        stratum: (N,) the one that it is in.
        admitted: (N,) rows that the mixture admits.
    """
    episode = codes(table, "episode_id")
    found = {}
    for index, named in enumerate(strata):
        rule = named.rule
        rest = named.name == NOMINAL and rule.where is None
        could = admitted if rest else admitted & member[:, index]
        total = _count(could, rule, episode)
        kept = _count(could & (stratum == index), rule, episode)
        others = [j for j, other in enumerate(strata) if j != index and other.name != NOMINAL]
        if rule.share in ("natural", 0) or kept >= _NEARLY_NONE * total or not others:
            continue
        held = {j: _count(could & member[:, j], rule, episode) for j in others}
        taker = max(others, key=held.__getitem__)
        if held[taker] < _TAKEN * total:
            continue
        other = strata[taker]
        remedy = (
            _less_often(other, _usual_steps(table, taker, admitted))
            if rest
            else f"give {named.name} priority = {other.priority - 1}, which is before {other.name}"
        )
        unit = "episode" if rule.unit == "episode" else "row"
        found[named.name] = (
            f"has {kept:,} of {counted(total, unit)}, since {other.name} is met in"
            f" {held[taker]:,} of them: {remedy}"
        )
    return found


def _count(rows: Bools, rule: StratumRule, episode: Codes) -> int:
    """Return the size of some rows (N,) in the unit of a stratum."""
    return int((np.bincount(episode[rows]) > 0).sum() if rule.unit == "episode" else rows.sum())


def _usual_steps(table: pa.Table, index: int, admitted: Bools) -> int:
    """Return the median number of steps of a condition, over the episodes that have it."""
    steps = np.bincount(codes(table, "episode_id")[bools(table, f"stratum_{index}") & admitted])
    return int(np.median(steps[steps > 0]))


def _less_often(taker: ResolvedStratum, steps: int) -> str:
    """Return what leaves nominal more than a condition that holds nearly everywhere does."""
    name = taker.name
    in_mixture = (
        f'under [[strata]] give {name} unit = "step", or min_steps = {steps + 1} (half of its'
        f" episodes have {counted(steps, 'such step')} or fewer); "
        if taker.rule.unit == "episode"
        else ""
    )
    at_source = (
        "make its `where` stricter"
        if taker.rule.where is not None
        else "raise its threshold in the profile and run `restock store label`"
    )
    return (
        f"{in_mixture}{at_source}; or list the other conditions under [[strata]] in place of"
        " [each_condition]"
    )
