"""`restock coverage drift`: find the robots whose wheels, lidar or floor have changed."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from restock.errors import ExitCode, visible

if TYPE_CHECKING:
    from restock.replay.fleet.drift import Drift


@dataclass
class DriftCommand:
    """Find out which robot's wheels, lidar or floor have changed.

    Compares each robot's weeks with its own first weeks and with the other robots of its site. Each
    signal (odometry scale, lidar noise, gyroscope bias, …) and the rate at which each condition
    begins gets a two-sample test over recordings or episodes, with an effect size and a p-value
    corrected over all tests. A change that all robots of a site share is reported for the site.
    Robots and sites are tags of recordings (`restock ingest --tag robot=amr-1`). See
    docs/coverage.md.

        restock coverage drift store/
        restock coverage drift store/ --out drift.html
        restock sql store/ "FROM drift WHERE robot = 'amr-2'"       # every comparison
    """

    store: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="STORE")]
    """The store."""
    every: str = "week"
    """The length of a period: day, week, month, year or decade."""
    reference: int = 2
    """How many first periods of a robot are the reference for its later ones."""
    least_episodes: int = 5
    """The least number of episodes on each side; with fewer there is no verdict."""
    version: Annotated[str | None, tyro.conf.arg(metavar="N|TIME")] = None
    """An earlier version of the store: its number, or a time (2026-11-01T08:00Z). Default: the
    newest."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write an HTML page that opens without a network. Replaces an existing file."""
    exit_code: bool = False
    """Exit 1 if a robot, a site or a condition has changed. Changes in how a robot was driven do
    not count."""
    json: bool = False
    """Print one JSON document: {"findings", "notes", "tests", …}."""

    def run(self) -> int:
        """Measure, print, and write the page."""
        from restock.cli import output
        from restock.files import expect_file_place
        from restock.ingest.store.version import given_version
        from restock.replay.fleet.drift import measure_drift
        from restock.replay.store.store import Store

        expect_file_place(self.out, "--out")
        with Store(self.store, version=given_version(self.version)) as store:
            output.say_unverified(store)
            drift = measure_drift(
                store,
                every=self.every,
                reference=self.reference,
                least_episodes=self.least_episodes,
            )
        if self.out is not None:
            from restock.report import write_drift_page

            output.say(f"wrote {write_drift_page(drift, self.out)}")
        if self.json:
            output.print_json(drift.document())
        else:
            _show(drift)
        changed = any(row["part"] != "driving" for row in drift.findings)
        return int(ExitCode.FAILED if self.exit_code and changed else ExitCode.OK)


def _show(drift: Drift) -> None:
    from restock.cli import output

    out = output.stdout()
    verdicts: dict[tuple[str, str], Counter[str]] = {}
    for row in drift.tests:
        verdicts.setdefault((row["robot"], row["against"]), Counter())[row["verdict"]] += 1
    names = sorted({name for counts in verdicts.values() for name in counts})
    output.print_table(
        [
            {"robot": robot, "against": against, **{name: counts[name] for name in names}}
            for (robot, against), counts in sorted(verdicts.items())
        ],
        ["robot", "against", *names],
        title=f"comparisons by {drift.every}",
    )
    for note in drift.notes:
        out.print(visible(f"- {note}"), markup=False, soft_wrap=True)
    out.print()
    for row in drift.findings:
        out.print(visible(row["finding"]), markup=False, soft_wrap=True)
    if not drift.findings:
        out.print(drift.without_findings(), markup=False, soft_wrap=True)
