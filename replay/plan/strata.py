"""Assign each row to at most one stratum: by priority, or with its episode to the rarest one."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.arrays import Bools, Codes, Ints
from restock.errors import ConfigError
from restock.ingest.task.conditions import NOMINAL, Condition, of_kind
from restock.replay.mixture.mixture import (
    Correction,
    EachCondition,
    Mixture,
    StratumRule,
    Within,
)

NO_STRATUM = -1
NOMINAL_PRIORITY = 1000
NOVEL = "novel"  # stratum of rows that the view `novelty` calls `novel`; it needs no `where`
NOVEL_PRIORITY = 999  # comes after all conditions, and before nominal
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
    natural_share: float  # share of its source's rows
    wanted_share: float  # share of a batch's logged rows, like `share` and `effective_share`
    share: float  # actual share; a panel's shares sum to 1
    replays_per_row: float  # expected draws of each row, over the mixture's planned draws
    effective_episodes: float  # (sum n)^2 / sum n^2 over the numbers n of rows per episode
    effective_rows: float  # effective sample size of its rows under their weights
    largest_weight: float
    effective_share: float  # share of the gradient, after weights
    note: str
    missing_rows: int = 0  # number of rows that the wanted share needs in addition


@dataclass(frozen=True)
class ResolvedStratum:
    """A stratum with its predicate and defaults resolved against a store's conditions."""

    rule: StratumRule
    predicate: str  # SQL over `transitions`: whether a row may be in the stratum
    # SQL of the state alone: whether it may be in the stratum. None: the same as `predicate`.
    state_predicate: str | None
    priority: int
    timing: Literal["pre", "post"]
    correction: Correction
    within: Within = "without_replacement"

    @property
    def name(self) -> str:
        return self.rule.name

    @property
    def left_over(self) -> bool:
        """Return whether this stratum takes all episodes that no other stratum takes."""
        return self.rule.unit == "episode" and self.name == NOMINAL and self.rule.where is None

    @property
    def steps_of_episode(self) -> bool:
        """Return whether it takes whole episodes in which `min_steps` rows fulfil the predicate."""
        return self.rule.unit == "episode" and not self.left_over

    @property
    def dealt(self) -> bool:
        """Return whether `deal_episodes` assigns its episodes, as its rule sets no `priority`."""
        return self.steps_of_episode and self.rule.priority is None


def resolve_strata(mixture: Mixture, conditions: Sequence[Condition]) -> list[ResolvedStratum]:
    """Resolve the mixture's listed strata in order, then those of `each_condition` by priority.

    `conditions` are the store's conditions and exposures.

    Raises:
        ConfigError: a stratum is no condition or exposure of the store, and has no `where`; or
            each_condition is for exposures, and the store has none.
    """
    known = {condition.name: condition for condition in conditions}
    rules = list(mixture.strata)
    if mixture.each_condition is not None:
        listed = {rule.name for rule in rules}
        requested = of_kind(conditions, mixture.each_condition.kind)
        if not requested and mixture.each_condition.kind == "exposure":
            raise ConfigError(
                "each_condition asks for exposures, but the store has none",
                where="mixture",
                remedy="name some in the profile (`exposures`) and ingest the recordings again",
            )
        names = [NOMINAL, *(c.name for c in sorted(requested, key=lambda c: (c.priority, c.name)))]
        rules += [_rule_for(name, mixture.each_condition) for name in names if name not in listed]
    return [_resolve(rule, known, mixture) for rule in rules]


def rules_of(mixture: Mixture, names: Sequence[str]) -> list[StratumRule]:
    """Return the rule of each named stratum: from [[strata]], or else from [each_condition]."""
    listed = {rule.name: rule for rule in mixture.strata}
    each = mixture.each_condition or EachCondition()
    return [listed.get(name) or _rule_for(name, each) for name in names]


def _rule_for(name: str, each: EachCondition) -> StratumRule:
    given = msgspec.structs.asdict(each)
    return StratumRule(name=name, **{key: given[key] for key in given if key != "kind"})


def _resolve(rule: StratumRule, known: dict[str, Condition], mixture: Mixture) -> ResolvedStratum:
    timing: Literal["pre", "post"]
    state_predicate = None
    if rule.where is not None:
        predicate, priority, timing = rule.where, WHERE_PRIORITY, "post"
    elif rule.name == NOMINAL:
        predicate, priority, timing = "len(conditions) = 0", NOMINAL_PRIORITY, "pre"
        # If an outcome such as a slip has no condition with timing "pre", its state was nominal.
        states = (c for c in of_kind(known.values(), "outcome") if c.timing == "pre")
        before = ", ".join(f"'{c.name}'" for c in states)
        state_predicate = f"NOT list_has_any(conditions, [{before}]::VARCHAR[])"
    elif rule.name == NOVEL and NOVEL not in known:
        predicate, priority, timing = NOVEL, NOVEL_PRIORITY, "pre"
    elif rule.name in known:
        condition = known[rule.name]
        column = "conditions" if condition.kind == "outcome" else "exposures"
        predicate = f"list_contains({column}, '{rule.name}')"
        priority, timing = condition.priority, condition.timing
    else:
        raise ConfigError(
            f"stratum {rule.name!r} is not a condition or exposure of these rows, and has no "
            "`where`",
            where="mixture",
            remedy=f"name one of {', '.join([NOMINAL, NOVEL, *sorted(known)])}; or give it a"
            " `where`; or add it to the profile and run `restock store label`",
        )
    if rule.unit == "episode":
        # The whole episode selects a row, not the outcome of its step: no bias as for "post".
        state_predicate, timing = None, "pre"
        rest = rule.name == NOMINAL and rule.where is None
        predicate = "true" if rest else predicate
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


def required_steps(rule: StratumRule, steps: Ints) -> int:
    """Return the number of rows in which an episode must meet the condition.

    `steps` (E,) is the number of rows in which each episode met it. The result is `min_steps`, or
    the largest number in `steps` if that is less, so that a condition that occurs gets rows.
    """
    return max(min(rule.min_steps, int(steps.max(initial=0))), 1)


def assign(
    member: Bools, strata: Sequence[ResolvedStratum], *, only_pre: bool = False
) -> NDArray[np.int16]:
    """Return the index of each row's stratum (N,); -1 for rows that may be in no stratum.

    `member` (N, S) tells which strata a row may be in. `only_pre` ignores strata selected by
    outcome: if `member` is by state alone, the result is the stratum by the row's state alone.
    """
    order = sorted(range(len(strata)), key=lambda index: (strata[index].priority, index))
    if only_pre:
        order = [index for index in order if strata[index].timing == "pre"]
    code = np.full(len(member), NO_STRATUM, np.int16)
    for index in reversed(order):  # the lowest priority number comes last and overwrites others
        code[member[:, index]] = index
    return code


def deal_episodes(
    code: NDArray[np.int16],
    member: Bools,
    episode: Codes,
    strata: Sequence[ResolvedStratum],
    counted: Bools,
) -> NDArray[np.int16]:
    """Deal episodes to strata; return the stratum of each (E,), -1 if no stratum gets it.

    In turn, the stratum with the fewest rows so far takes one of its episodes, beginning with those
    that fit the fewest strata. So a condition that few episodes met gets all of them, and a
    condition that always accompanies another (a recovery follows each near collision) gets some.

    Args:
        code: (N,) each row's stratum by `assign`; only rows with a dealt stratum take part.
        member: (N, S) strata that a row may be in; the same for all rows of an episode.
        episode: (N,) code of the row's episode in 0..E - 1, in order of appearance.
        counted: (N,) rows that may be drawn; other rows do not count for a stratum's size.
    """
    given = np.full(int(episode.max(initial=-1)) + 1, NO_STRATUM, np.int16)
    dealt = np.array([index for index, stratum in enumerate(strata) if stratum.dealt], np.int64)
    rows = np.flatnonzero(np.isin(code, dealt))
    if not len(rows):
        return given
    episode_of_row = episode[rows]
    first_of = np.full(len(given), -1, np.int64)
    first_of[episode_of_row[::-1]] = np.arange(len(rows) - 1, -1, -1)
    names = np.flatnonzero(first_of >= 0)
    first, place = first_of[names], (np.cumsum(first_of >= 0) - 1)[episode_of_row]
    allowed = member[rows[first]][:, dealt]  # (n episodes, K)
    size = np.bincount(place, weights=counted[rows]).astype(np.int64)
    # If strata have equally many rows, the one that could get the fewest is next, then by priority.
    available = (allowed * size[:, None]).sum(axis=0)
    filled = [(0, int(available[k]), strata[dealt[k]].priority, k) for k in range(len(dealt))]
    heapq.heapify(filled)
    choices = allowed.sum(axis=1)
    waiting = [
        iter(sorted(np.flatnonzero(of_k).tolist(), key=choices.__getitem__)) for of_k in allowed.T
    ]
    rows_of, taken = size.tolist(), [NO_STRATUM] * len(names)
    while filled:
        so_far, *between, k = filled[0]
        next_episode = next((e for e in waiting[k] if taken[e] == NO_STRATUM), None)
        if next_episode is None:
            heapq.heappop(filled)
        else:
            taken[next_episode] = int(dealt[k])
            heapq.heapreplace(filled, (so_far + rows_of[next_episode], *between, k))
    given[names] = taken
    return given


def replace_dealt(
    code: NDArray[np.int16],
    given: NDArray[np.int16],
    episode: Codes,
    strata: Sequence[ResolvedStratum],
) -> NDArray[np.int16]:
    """Return `code` (N,) with dealt strata replaced by `given`, the result of `deal_episodes`."""
    dealt = [index for index, stratum in enumerate(strata) if stratum.dealt]
    of_episode = given[episode]
    return np.where(np.isin(code, dealt) & (of_episode != NO_STRATUM), of_episode, code)
