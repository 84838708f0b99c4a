"""The rules by which rows are drawn within a stratum: the table that everything else asks.

`within` of a mixture names a row. The check of a mixture, the samplers, the buffers of other
libraries, `restock mix` and the report ask this table; a rule of your own is one file with a
subclass of `StratumDraws`, and a row here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from restock.replay.sampling.draws import InTurns, StratumDraws, StratumRows, Uniform
from restock.replay.sampling.per import Per


@dataclass(frozen=True)
class Rule:
    """A rule of the table: what draws by it, and what others need to know of it."""

    draws: Callable[[StratumRows], StratumDraws]
    doc: str  # how rows are drawn, for reports
    follows_td: bool = False  # draws depend on the TD errors of what was learnt
    has_weights: bool = False  # rows come with importance weights


RULES: dict[str, Rule] = {
    "uniform": Rule(Uniform, "uniformly, with replacement"),
    "without_replacement": Rule(InTurns, "without replacement"),
    "per": Rule(Per, "by TD error (PER)", follows_td=True, has_weights=True),
}


def follow_td(names: Iterable[str]) -> bool:
    """Return whether draws by any of these rules follow TD errors."""
    return any(RULES[name].follows_td for name in names)


__all__ = ["RULES", "Rule", "follow_td"]
