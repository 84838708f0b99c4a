"""May two arms be compared, and how do they compare: the gate, then the outcomes.

A comparison of methods that were fed differently measures the feed. It is refused, with what
differs, unless the feed is what is compared (`treatment="mixture"`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from restock.train.comparison.arms import ALLOWED, Arm, Difference, Treatment, differences, feeds
from restock.train.comparison.comparability import (
    Check,
    ComparabilityLimits,
    Verdict,
    check_feeds,
    worst,
)
from restock.train.comparison.outcomes import outcomes

_SAME_TOTAL = 1.02  # ratio of environment steps, and of updates


@dataclass(frozen=True)
class Comparison:
    """The gate's answer, and the outcomes where it let the arms through."""

    treatment: Treatment
    verdict: Verdict
    differences: list[Difference]  # of settings
    refused: list[Difference]  # those that the treatment does not allow
    totals: list[Check]  # environment steps and updates
    checks: list[Check]  # of the feed
    source: str | None  # of the outcomes: restock eval, or the training's own evaluations
    rows: list[dict[str, Any]]

    @property
    def gate(self) -> list[Check]:
        """The checks that the verdict is made of: of the feed too, unless it is the treatment."""
        return _asked(self.treatment, self.totals, self.checks)

    def as_json(self) -> dict[str, Any]:
        """All of it."""
        return {
            "treatment": self.treatment,
            "verdict": self.verdict,
            "refused": [difference.setting for difference in self.refused],
            "differences": [asdict(difference) for difference in self.differences],
            "checks": [
                {**asdict(check), "verdict": check.verdict} for check in self.totals + self.checks
            ],
            "outcomes_from": self.source,
            "outcomes": self.rows,
        }


def compare(
    first: Sequence[Path],
    second: Sequence[Path],
    *,
    treatment: Treatment = "algorithm",
    limits: ComparabilityLimits = ComparabilityLimits(),  # noqa: B008  (frozen)
    seed: int = 0,
) -> Comparison:
    """Compare the runs of two arms.

    Raises:
        RunError: a run is missing, has no updates, or does not belong to its arm.
    """
    arms = Arm("first", first), Arm("second", second)
    rng = np.random.default_rng(seed)
    found = [d for d in differences(arms[0].runs[0], arms[1].runs[0]) if d.kind != "free"]
    allowed = ALLOWED[treatment] | {"software"}
    refused = [difference for difference in found if difference.kind not in allowed]
    totals = [_total(name, *(arm.totals[name] for arm in arms)) for name in arms[0].totals]
    checks = check_feeds(*feeds(*arms), limits, rng)
    asked = _asked(treatment, totals, checks)
    verdict = "incomparable" if refused else worst([check.verdict for check in asked])
    source, rows = outcomes(*arms, rng) if verdict == "comparable" else (None, [])
    return Comparison(treatment, verdict, found, refused, totals, checks, source, rows)


def _asked(treatment: Treatment, totals: list[Check], checks: list[Check]) -> list[Check]:
    if treatment == "method":  # an update of one method is not one of another
        return [check for check in totals if check.name == "env steps"]
    return totals + ([] if treatment == "mixture" else checks)


def _total(name: str, first: float, second: float) -> Check:
    ratio = max(first, second) / max(min(first, second), 1.0)
    shown = name.replace("_", " ").replace("gradient steps", "updates")
    return Check(shown, "whole run", first, second, ratio, ratio, ratio, _SAME_TOTAL)


__all__ = ["Comparison", "compare"]
