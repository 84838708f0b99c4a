"""Strata of fresh rows: where a mixture's quotas find the twin's rows.

The plan of a panel puts logged rows into strata in SQL. Here an episode of the twin that has ended
is put into the same strata from its labels, by the same rules: rows by priority, or whole episodes
to the stratum that has the fewest rows so far.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from restock.arrays import Bools, Ints
from restock.ingest.task.conditions import NOMINAL, Condition, of_kind
from restock.replay.mixture.mixture import Mixture
from restock.replay.panel.panel import Panel
from restock.replay.plan.strata import NOMINAL_PRIORITY, ResolvedStratum, assign, rules_of


class FreshStrata:
    """Puts episodes into the strata of a mixture.

    Args:
        names: of the strata (S,), without a store's name.
        conditions: those that can be told of fresh rows, of both kinds.

    `known` (S,) says which strata fresh rows can be in: not those of a predicate over the store's
    columns (`where`), nor of a condition that the twin's signals do not tell.
    """

    def __init__(
        self, mixture: Mixture, names: Sequence[str], conditions: Sequence[Condition]
    ) -> None:
        self.names = tuple(names)
        reported = {condition.name: condition for condition in conditions}
        rules = rules_of(mixture, names)
        self.known: Bools = np.array(
            [
                rule.where is None and (rule.name == NOMINAL or rule.name in reported)
                for rule in rules
            ]
        )
        self.exposures = [c for c in of_kind(conditions, "exposure") if c.name in self.names]
        self._by_rarity = mixture.prefer == "rarest"
        self._outcomes = [condition.name for condition in of_kind(conditions, "outcome")]
        self._strata = []
        for rule in rules:
            own = reported[rule.name].priority if rule.name in reported else NOMINAL_PRIORITY
            priority = own if rule.priority is None else rule.priority
            self._strata.append(ResolvedStratum(rule, "", None, priority, "pre", "none"))

    @classmethod
    def of(cls, panel: Panel, conditions: Sequence[Condition]) -> FreshStrata:
        """Make one for the mixture that a panel was made by."""
        header = panel.header
        first = header.strata[: len(header.strata) // (1 + len(header.others))]
        return cls(header.mixture, [stratum.name for stratum in first], conditions)

    def codes(self, labels: Mapping[str, Bools], steps: int, rows: Ints) -> NDArray[np.int16]:
        """Return the stratum of each step (T,) of an episode; -1 for a step in none.

        Args:
            labels: (T,) by condition, whether it holds.
            steps: T.
            rows: (S,) how many fresh rows each stratum has so far.
        """
        held = [labels[name] for name in self._outcomes if name in labels]
        nominal = ~np.any(held, axis=0) if held else np.ones(steps, np.bool_)
        member = np.zeros((steps, len(self.names)), np.bool_)
        for index, stratum in enumerate(self._strata):
            if not self.known[index]:
                continue
            holds = nominal if stratum.name == NOMINAL else labels[stratum.name]
            if stratum.left_over:
                holds = np.ones(steps, np.bool_)
            elif stratum.steps_of_episode:
                holds = np.full(steps, holds.sum() >= stratum.rule.min_steps)
            member[:, index] = holds
        code = assign(member, self._strata)
        if self._by_rarity:
            observed = [i for i, s in enumerate(self._strata) if s.dealt and steps and member[0, i]]
            if observed:
                fewest = min(observed, key=lambda i: (rows[i], self._strata[i].priority))
                code[np.isin(code, observed)] = fewest
        return code
