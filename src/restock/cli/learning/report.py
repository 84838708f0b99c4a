"""`restock report`: writes one HTML page about a run or a folder of runs."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from restock.cli.output import print_json, progress
from restock.cli.words import Positional, refuse


@dataclass
class ReportCommand:
    """Write one HTML page about a run, or about a folder of runs; it opens without a network.

    The page shows what the critic was fed (natural, wanted and drawn share per stratum, ages,
    behaviour policies), learning curves, TD error by condition, target lag, success per condition
    with intervals beside the planner and a random policy (run `restock eval RUN` first), a map of
    the logs' positions and the agent's failures, and the provenance of the data.

    A gap between twin and logs that `restock twin gap` wrote to RUN/gap, or to the folder `gap` of
    the panel's store, is shown in a section. For a FOLDER, the page shows its runs in order of
    their start, what changed from each run to the next, and its stores week by week.

    With --card, it writes the replay card instead: what the critic was fed, on one page of
    Markdown, to stdout, RUN/replay_card.md and RUN/replay_card.json.

    Example: `restock report runs/a`
    """

    run_directory: Annotated[Path, Positional("RUN")]
    """The directory that `restock train --out` wrote; or a folder of runs and stores, for a page
    about all of them."""
    out: Path | None = None
    """Where to write the page. Default: RUN/report.html. Replaces an existing file."""
    card: bool = False
    """Write the replay card instead of the page."""
    json: bool = False
    """Print {"report": PATH, "bytes": N} instead of the path, or the card as JSON."""

    def run(self) -> int | None:
        from restock.files import expect_file_place
        from restock.replay.places import kind_beside
        from restock.report import build_report, history_page, write_card, write_page

        if self.card:
            why = "applies only to the page: the card is written to the run's directory"
            refuse(self, ("out",), why, remedy="leave it out")
            card, markdown = write_card(self.run_directory)
            if self.json:
                print_json(card)
            else:
                sys.stdout.write(markdown)
            return None
        expect_file_place(self.out, "--out")
        with progress("report", None):
            if self.run_directory.is_dir() and kind_beside(self.run_directory) is None:
                page = self.out or self.run_directory / "report.html"
                path = write_page(history_page(self.run_directory), page)
            else:
                path = build_report(self.run_directory, self.out)
        if self.json:
            print_json({"report": str(path), "bytes": path.stat().st_size})
        else:
            sys.stdout.write(f"{path}\n")
        return None
