"""Strata: each row of the store to at most one, by priority; and weights against their boost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.ingest.conditions import NOMINAL, Condition
from restock.replay.density_ratio import density_ratio
from restock.replay.layout import F32, F64, Bools
from restock.replay.mixture import (
    Correction,
    CorrectionRule,
    EachCondition,
    Mixture,
    StratumRule,
    Within,
)

NO_STRATUM = -1
NOMINAL_PRIORITY = 1000
WHERE_PRIORITY = 50


@dataclass(frozen=True)
class Stratum:
    """A stratum as resolved against a store's conditions."""

    rule: StratumRule
    predicate: str  # SQL over `transitions`
    priority: int
    timing: Literal["pre", "post"]
    correction: Correction
    within: Within = "without_replacement"

    @property
    def name(self) -> str:
        return self.rule.name


def resolve_strata(mixture: Mixture, conditions: Sequence[Condition]) -> list[Stratum]:
    """The mixture's strata, and those of `each_condition`, in the order of the table they make.

    Raises:
        ConfigError: a stratum that is neither a condition of the store nor has a `where`.
    """
    known = {condition.name: condition for condition in conditions}
    rules = list(mixture.strata)
    if mixture.each_condition is not None:
        listed = {rule.name for rule in rules}
        names = [NOMINAL, *(c.name for c in sorted(conditions, key=lambda c: (c.priority, c.name)))]
        rules += [_rule_for(name, mixture.each_condition) for name in names if name not in listed]
    return [_resolve(rule, known, mixture) for rule in rules]


def rules_of(mixture: Mixture, names: Sequence[str]) -> list[StratumRule]:
    """The rules of strata by their names, listed ones and those of `each_condition`."""
    listed = {rule.name: rule for rule in mixture.strata}
    each = mixture.each_condition or EachCondition()
    return [listed.get(name) or _rule_for(name, each) for name in names]


def _rule_for(name: str, each: EachCondition) -> StratumRule:
    return StratumRule(
        name=name,
        share=each.share,
        floor=each.floor,
        cap=each.cap,
        correction=each.correction,
        within=each.within,
        min_rows=each.min_rows,
        min_episodes=each.min_episodes,
        max_rows_per_episode=each.max_rows_per_episode,
        max_rows_per_recording=each.max_rows_per_recording,
    )


def _resolve(rule: StratumRule, known: dict[str, Condition], mixture: Mixture) -> Stratum:
    timing: Literal["pre", "post"]
    if rule.where is not None:
        predicate, priority, timing = rule.where, WHERE_PRIORITY, "post"
    elif rule.name == NOMINAL:
        predicate, priority, timing = "len(conditions) = 0", NOMINAL_PRIORITY, "pre"
    elif rule.name in known:
        condition = known[rule.name]
        predicate = f"list_contains(conditions, '{rule.name}')"
        priority, timing = condition.priority, condition.timing
    else:
        raise ConfigError(
            f"stratum {rule.name!r} is no condition of this store and has no `where`",
            where="mixture",
            remedy=f"the store knows {', '.join([NOMINAL, *sorted(known)])}",
        )
    timing = rule.timing or timing
    default = mixture.correction.pre if timing == "pre" else mixture.correction.post
    return Stratum(
        rule,
        predicate,
        priority if rule.priority is None else rule.priority,
        timing,
        rule.correction or default,
        rule.within or mixture.within,
    )


def assign(
    member: Bools, strata: Sequence[Stratum], *, only_pre: bool = False
) -> NDArray[np.int16]:
    """The stratum of each row (N,), from membership (N, S); -1 where it belongs to none.

    `only_pre` leaves out strata chosen on the outcome: where the row's state alone would put it.
    """
    order = sorted(range(len(strata)), key=lambda index: (strata[index].priority, index))
    if only_pre:
        order = [index for index in order if strata[index].timing == "pre"]
    code = np.full(len(member), NO_STRATUM, np.int16)
    for index in reversed(order):  # the first in priority is written last
        code[member[:, index]] = index
    return code


def importance_weights(
    code: NDArray[np.int16],
    state_code: NDArray[np.int16],
    strata: Sequence[Stratum],
    shares: F64,
    rule: CorrectionRule,
    outcome: F32 | None = None,
) -> F32:
    """Weights (N,) of the rows of one source, of mean 1 over what the quotas draw.

    `code` (N,) is each row's stratum (never -1), `state_code` (N,) the one its state alone gives,
    `outcome` (N, S) the probability of each "density_ratio" stratum given a row's state and action
    (0 for the other strata), see `replay.density_ratio`.

    A stratum is drawn f = share * N / rows times as often as it occurs. A row chosen on its
    outcome is weighted back to the density of the rows of the same state whose outcome was
    another, which keeps P(s'|s, a) what it was; a row chosen on its state, where that is asked
    for, to its natural density. With `outcome`, all rows of a state and action are then weighted by
    how much oftener the quotas draw that state and action than they occur, whatever came of it.
    """
    rows = np.bincount(code, minlength=len(strata))
    boost = np.divide(shares * len(code), rows, out=np.ones(len(strata)), where=rows > 0)
    corrected = np.array([stratum.correction != "none" for stratum in strata])
    post = np.array([stratum.timing == "post" for stratum in strata])
    # The density at which rows of a state are to be drawn: boosted, or as they occur.
    aim = np.where(corrected | (boost == 0), 1.0, boost)
    state_aim = np.where(state_code >= 0, aim[np.maximum(state_code, 0)], 1.0)
    aim_of_row = np.where(post[code], state_aim, 1.0)
    weight = np.ones(len(code))
    change = corrected[code] & (boost[code] > 0)
    weight[change] = aim_of_row[change] / boost[code[change]]
    for index, stratum in enumerate(strata):
        mine = code == index
        by_ratio = stratum.correction == "density_ratio" and stratum.timing == "pre"
        if stratum.correction == "beta":
            weight[mine] **= rule.beta
        elif stratum.correction == "clipped" or by_ratio:
            weight[mine] = np.clip(weight[mine], 1 / rule.clip, rule.clip)
    if outcome is not None:
        weight *= density_ratio(outcome, boost, state_aim, rule.clip)
    drawn = boost[code] / len(code)
    return np.asarray(weight / (drawn * weight).sum(), np.float32)


def effective_shares(code: NDArray[np.int16], weights: F32, shares: F64) -> F64:
    """Shares of the gradient after weights, (S,)."""
    rows = np.maximum(np.bincount(code, minlength=len(shares)), 1)
    total = shares * np.bincount(code, weights=weights, minlength=len(shares)) / rows
    return np.asarray(total / max(total.sum(), 1e-12), np.float64)


def effective_count(sizes: NDArray[Any]) -> float:
    """(sum n)^2 / sum n^2: how many equal groups these would be worth."""
    total = float((np.asarray(sizes, np.float64) ** 2).sum())
    return float(np.asarray(sizes).sum()) ** 2 / total if total > 0 else 0.0
