"""Strata: each row of the store to at most one, by priority."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.arrays import Bools
from restock.errors import ConfigError
from restock.ingest.task.conditions import NOMINAL, Condition
from restock.replay.mixture.mixture import (
    Correction,
    EachCondition,
    Mixture,
    StratumRule,
    Within,
)

NO_STRATUM = -1
NOMINAL_PRIORITY = 1000
WHERE_PRIORITY = 50


class Stratum(msgspec.Struct, frozen=True):
    """A stratum of a panel: its wanted and actual share, and how often its rows are drawn."""

    name: str
    source: str  # logs, or the name of another store
    timing: str
    correction: str
    within: Within
    rows: int
    episodes: int
    natural_share: float  # of its source's rows
    wanted_share: float  # of the logs' part of a batch, as the other shares
    share: float  # those of a panel sum to 1
    replays_per_row: float  # expected over the mixture's planned updates
    effective_episodes: float  # (sum n)^2 / sum n^2 over the rows per episode
    effective_rows: float  # rows drawn equally often that its weighted draw is worth
    largest_weight: float
    effective_share: float  # after weights
    note: str


@dataclass(frozen=True)
class ResolvedStratum:
    """A stratum as resolved against a store's conditions."""

    rule: StratumRule
    predicate: str  # SQL over `transitions`
    # The same of the state alone; None where that is the predicate, or the outcome decides.
    state_predicate: str | None
    priority: int
    timing: Literal["pre", "post"]
    correction: Correction
    within: Within = "without_replacement"

    @property
    def name(self) -> str:
        return self.rule.name


def resolve_strata(mixture: Mixture, conditions: Sequence[Condition]) -> list[ResolvedStratum]:
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
    return StratumRule(name=name, **msgspec.structs.asdict(each))


def _resolve(rule: StratumRule, known: dict[str, Condition], mixture: Mixture) -> ResolvedStratum:
    timing: Literal["pre", "post"]
    state_predicate = None
    if rule.where is not None:
        predicate, priority, timing = rule.where, WHERE_PRIORITY, "post"
    elif rule.name == NOMINAL:
        predicate, priority, timing = "len(conditions) = 0", NOMINAL_PRIORITY, "pre"
        # A slip that nothing announced happened in a nominal state.
        before = ", ".join(f"'{c.name}'" for c in known.values() if c.timing == "pre")
        state_predicate = f"NOT list_has_any(conditions, [{before}]::VARCHAR[])"
    elif rule.name in known:
        condition = known[rule.name]
        predicate = f"list_contains(conditions, '{rule.name}')"
        priority, timing = condition.priority, condition.timing
    else:
        raise ConfigError(
            f"stratum {rule.name!r} is not a condition of this store and has no `where`",
            where="mixture",
            remedy=f"the store knows {', '.join([NOMINAL, *sorted(known)])}",
        )
    if rule.unit == "episode":
        # Chosen by what the whole episode met, not by what came of this step.
        state_predicate, timing = None, "pre"
        left_over = rule.name == NOMINAL and rule.where is None
        predicate = "true" if left_over else _of_episodes(predicate, rule.min_steps)
    timing = rule.timing or timing
    default = mixture.correction.pre if timing == "pre" else mixture.correction.post
    return ResolvedStratum(
        rule,
        predicate,
        state_predicate,
        priority if rule.priority is None else rule.priority,
        timing,
        rule.correction or default,
        rule.within or mixture.within,
    )


def _of_episodes(predicate: str, min_steps: int) -> str:
    """Whether a row's episode has so many rows for which the predicate holds."""
    holds = f"count(*) FILTER (WHERE ({predicate}\n)::BOOLEAN)"
    return f"{holds} OVER (PARTITION BY episode_id) >= {min_steps}"


def assign(
    member: Bools, strata: Sequence[ResolvedStratum], *, only_pre: bool = False
) -> NDArray[np.int16]:
    """The stratum of each row (N,), from membership (N, S); -1 where it belongs to none.

    `only_pre` leaves out strata chosen on the outcome: where the row's state alone would put it,
    if `member` is of the state alone.
    """
    order = sorted(range(len(strata)), key=lambda index: (strata[index].priority, index))
    if only_pre:
        order = [index for index in order if strata[index].timing == "pre"]
    code = np.full(len(member), NO_STRATUM, np.int16)
    for index in reversed(order):  # the first in priority is written last
        code[member[:, index]] = index
    return code
