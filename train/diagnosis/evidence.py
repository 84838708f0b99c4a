"""One comparison of logs with the twin, or with what must hold by definition: a row of evidence."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from restock.stats import ConfidenceInterval, wilson

Status = Literal["ok", "off", "undecided", "not run"]


@dataclass(frozen=True)
class Comparison:
    """What was compared. `effect` is a ratio or a difference, as `measure` says; `status` is by
    whether its 95 % interval lies within the allowed range, across its end, or beyond it."""

    check: str  # a name that causes and docs know it by
    what: str  # for people
    measure: str  # of `effect`: "ratio", "difference", "share", …
    status: Status
    logs: float | None = None
    twin: float | None = None
    effect: float | None = None
    low: float | None = None
    high: float | None = None
    least: float | None = None  # allowed
    most: float | None = None
    logs_rows: int = 0
    twin_rows: int = 0
    note: str = ""

    @property
    def off(self) -> bool:
        return self.status == "off"

    @property
    def suspicious(self) -> bool:
        """Undecided, and not for lack of rows: the interval has no effect at all outside of it."""
        neutral = 1.0 if self.measure == "ratio" else 0.0
        if self.status != "undecided" or self.low is None or self.high is None:
            return False
        return self.low > neutral or self.high < neutral


def judged(
    check: str, what: str, measure: str, interval: ConfidenceInterval, *,
    logs: float | None, twin: float | None, least: float = -math.inf, most: float = math.inf,
    logs_rows: int, twin_rows: int = 0, note: str = "",
) -> Comparison:  # fmt: skip
    """A comparison by its interval: off where all of it is beyond the allowed, undecided where the
    value alone is."""
    if not math.isfinite(interval.value):
        return not_run(check, what, note or "too few rows")
    within = least <= interval.value <= most
    beyond = interval.low > most or interval.high < least
    status: Status = "ok" if within else "off" if beyond else "undecided"
    return Comparison(
        check, what, measure, status, logs, twin,
        interval.value, interval.low, interval.high,
        None if math.isinf(least) else least, None if math.isinf(most) else most,
        logs_rows, twin_rows, note,
    )  # fmt: skip


def not_run(check: str, what: str, reason: str) -> Comparison:
    """A check that could not be made, and why."""
    return Comparison(check, what, "", "not run", note=reason)


def share_judged(
    check: str, what: str, found: int, of: int, most: float, *, least: float = 0.0, note: str = ""
) -> Comparison:
    """A share of the logs' rows that is known by definition."""
    if not of:
        return not_run(check, what, note or "no such rows")
    interval = ConfidenceInterval(found / of, *wilson(found, of))
    return judged(
        check, what, "share", interval, logs=found / of, twin=None, least=least, most=most,
        logs_rows=of,
        note=note,
    )  # fmt: skip


def shares_compared(
    check: str, what: str, logs: tuple[int, int], twin: tuple[int, int], least: float, most: float
) -> Comparison:
    """The difference of two shares, each (found, of), with Newcombe's interval for it."""
    if not logs[1] or not twin[1]:
        return not_run(check, what, "no such rows in the logs" if twin[1] else "nor in the twin")
    (p, q), ((a, b), (c, d)) = (
        (logs[0] / logs[1], twin[0] / twin[1]),
        (wilson(*logs), wilson(*twin)),
    )
    interval = ConfidenceInterval(
        p - q, p - q - math.hypot(p - a, d - q), p - q + math.hypot(b - p, q - c)
    )
    return judged(
        check, what, "difference", interval, logs=p, twin=q, least=least, most=most,
        logs_rows=logs[1], twin_rows=twin[1],
    )  # fmt: skip


__all__ = ["Comparison", "judged", "not_run", "share_judged", "shares_compared"]
