"""`restock report`: one HTML page about a run."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from restock.cli.output import print_json, progress


@dataclass
class ReportCommand:
    """Write one self-contained HTML page about a run; it opens without a network.

    What the critic was fed (intended, drawn and available share per stratum, ages, behaviour
    policies), learning curves, TD error by condition, target lag, success per condition with
    intervals against planner and random (run `restock eval RUN` first), a map of the logs'
    positions and of the agent's failures, and the provenance of all of it.

    A gap between twin and logs that `restock twin gap` measured into RUN/gap, or into the gap
    folder of the panel's store, is a section of it. Of a STORE the page is about its gap alone,
    and is STORE/gap/index.html.

    With --card instead the replay card: what the critic was fed on one page of Markdown, on
    stdout, and as RUN/replay_card.md and RUN/replay_card.json.

    Example: `restock report runs/a`
    """

    run_directory: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The directory that `restock train --out` wrote; or a store, for its gap alone."""
    out: Path | None = None
    """Where to write the page; default RUN/report.html. Replaces what is there."""
    figures: Path | None = None
    """A folder for each figure of the page, as SVG and PNG. Replaces those of the same names."""
    card: bool = False
    """The replay card instead of the page."""
    json: bool = False
    """Print {"report": PATH, "bytes": N} instead of the path; with --card, the card as JSON."""

    def run(self) -> int | None:
        from restock.errors import ConfigError
        from restock.ingest.store.location import Location
        from restock.replay.store.store import is_store
        from restock.report import build_report, write_card, write_gap_page
        from restock.train.twin.calibration.twin_gap import FOLDER

        if self.card:
            for flag, path in (("--out", self.out), ("--figures", self.figures)):
                if path is not None:
                    raise ConfigError(
                        "is of the page: a card is written beside the run's metrics", where=flag
                    )
            card, markdown = write_card(self.run_directory)
            if self.json:
                print_json(card)
            else:
                sys.stdout.write(markdown)
            return None
        with progress("report", None):
            if is_store(Location.of(self.run_directory)):
                path = write_gap_page(self.run_directory / FOLDER, self.out, self.figures)
            else:
                path = build_report(self.run_directory, self.out, self.figures)
        if self.json:
            print_json({"report": str(path), "bytes": path.stat().st_size})
        else:
            sys.stdout.write(f"{path}\n")
        return None
