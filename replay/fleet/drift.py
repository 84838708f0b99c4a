"""Drift of a store: statistical tests, their findings, and the data by period.

The statistics are in SQL (replay/store/drift.sql). This module runs them for a table or a report.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

from restock.errors import ConfigError, counted
from restock.process import interrupts_raised
from restock.replay.store.parquet_views import passed_in
from restock.replay.store.store import Store

PERIODS = ("day", "week", "month", "year", "decade")
OWN, OTHERS = "own reference", "other robots"
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Drift:
    """The result of `measure_drift`. docs/sql.md documents the columns of its tables."""

    store: str
    version: int
    every: str  # length of a period: day, week, …
    reference: int  # number of a robot's first periods that are its reference
    least_episodes: int  # episodes that each side of a comparison needs
    findings: Rows  # rows of the SQL view `drift_findings`: changes, largest first
    tests: Rows  # rows of the SQL view `drift`: all comparisons
    periods: Rows  # robot, site, period, part, signal, recordings, episodes, p25, median, p75
    conditions: Rows  # robot, period, condition, driven_h, events, events_per_h
    notes: list[str]  # what could not be compared, and why

    @property
    def own(self) -> Rows:
        """Return the comparisons of robots with their own reference; only these give findings."""
        return [row for row in self.tests if row["against"] == OWN]

    @property
    def tested(self) -> int:
        """Return how many comparisons of `own` had enough data for a test."""
        return sum(row["p"] is not None for row in self.own)

    def without_findings(self) -> str:
        """Explain why no change was found: how much was tested, or what a test would need."""
        short = len(self.own) - self.tested
        if self.tested:
            undecided = sum(row["verdict"] == "undecided" for row in self.own)
            aside = [f"{undecided:,} of them undecided"] if undecided else []
            aside += [f"{counted(short, 'more comparison')} had too little data"] if short else []
            return (
                "No change that matters was found in "
                f"{counted(self.tested, 'test')} against the robots' own references"
                + (f" ({'; '.join(aside)})" if aside else "")
            )
        periods = Counter(robot for robot, _ in {(r["robot"], r["period"]) for r in self.periods})
        if not periods:
            why = "no episode has a signal to compare"
        elif max(periods.values()) == 1:
            why = f"every robot drove in one {self.every} only, so none has a reference"
        else:
            why = f"none of {counted(short, 'comparison')} has enough episodes on both sides"
        return (
            f"Nothing could be tested: {why}. A test needs a robot's first {self.every} and a later"
            f" one, with at least {self.least_episodes} episodes in each"
        )

    def document(self) -> dict[str, Any]:
        """Return the plain values that `restock coverage drift --json` prints."""
        names = ("store", "version", "every", "reference", "tested", "findings", "notes", "tests")
        return {name: getattr(self, name) for name in names}


@interrupts_raised
def measure_drift(
    store: Store, *, every: str = "week", reference: int = 2, least_episodes: int = 5
) -> Drift:
    """Compare each robot's periods with its own first periods, and with other robots.

    Args:
        every: the length of a period: day, week, month, year or decade.
        reference: number of a robot's first periods with which its later periods are compared.
        least_episodes: with fewer episodes on a side, the verdict is "too few".

    Raises:
        ConfigError: an unknown period, or a number below its minimum.
    """
    if every not in PERIODS:
        raise ConfigError(
            f"no period {every!r}", where="drift", remedy=f"give one of {', '.join(PERIODS)}"
        )
    for name, value, least in (("reference", reference, 1), ("least_episodes", least_episodes, 2)):
        if value < least:
            raise ConfigError(f"{name} must be at least {least}, got {value}", where="drift")

    def rows(query: str) -> Rows:
        found: Rows = store.sql(query).to_arrow_table().to_pylist()
        return found

    period = f"CAST(date_trunc('{every}', start_time) AS DATE) AS period"
    tests = store.sql(f"FROM drift_by('{every}', {reference}, {least_episodes})").to_arrow_table()
    with passed_in(store.connection, drift_tests=tests):
        findings = rows(f"FROM drift_findings_of('drift_tests', '{every}')")
    periods = rows(
        f"SELECT robot, site, {period}, part, signal, count(DISTINCT recording_id) AS recordings,"
        " count(*) AS episodes, quantile_cont(value, 0.25) AS p25, median(value) AS median,"
        " quantile_cont(value, 0.75) AS p75 FROM episode_signals GROUP BY ALL ORDER BY ALL"
    )
    conditions = rows(
        f"SELECT robot, {period}, condition, sum(driven_h) AS driven_h,"
        " CAST(sum(events) AS BIGINT) AS events, sum(events) / sum(driven_h) AS events_per_h"
        " FROM episode_conditions WHERE zone IS NULL GROUP BY ALL ORDER BY ALL"
    )
    every_test: Rows = tests.to_pylist()
    return Drift(
        str(store.path),
        store.version,
        every,
        reference,
        least_episodes,
        findings,
        every_test,
        periods,
        conditions,
        _notes(every_test, periods, every),
    )


def _notes(tests: Rows, periods: Rows, every: str) -> list[str]:
    """Return notes for the reader on comparisons that lack data."""
    notes = []
    robots = sorted({row["robot"] for row in periods})
    if "untagged" in robots:
        notes.append(
            "Recordings without the tag `robot` count as one robot, untagged. Use `restock ingest "
            "--tag robot=NAME` to tell robots apart."
        )
    for robot in robots:
        seen = {row["period"] for row in periods if row["robot"] == robot}
        if len(seen) == 1:
            notes.append(f"{robot} drove in one {every} only, so it has no reference of its own.")
    own = [row for row in tests if row["against"] == OWN]
    if few := sum(row["verdict"] == "too few" for row in own):
        notes.append(
            f"{few:,} of {len(own):,} comparisons with a robot's own reference have too few"
            " episodes or events."
        )
    if single := sum(row["samples"] == "episodes" and row["p"] is not None for row in own):
        notes.append(
            f"{single:,} compare episode by episode, as there are too few recordings (fewer than "
            f"two per {every}): differences between drives may be mistaken for drift there."
        )
    return notes
