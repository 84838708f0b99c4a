"""Self-contained HTML pages about runs, stores, studies, gates and the twin.

`build_report(run)` writes `run/report.html`, which opens without a network. The verbs write the
other pages, by passing `write_page` the content that `coverage_page` and others return.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from restock.public import lazy

if TYPE_CHECKING:
    from restock.report.fleet.coverage import coverage_page as coverage_page
    from restock.report.history import history_page as history_page
    from restock.report.look.write import write_page as write_page
    from restock.report.run.card import write_card as write_card
    from restock.report.run.comparison import gate_page as gate_page
    from restock.report.run.comparison import gate_section as gate_section
    from restock.report.run.comparison import outcome_section as outcome_section
    from restock.report.run.comparison import study_page as study_page
    from restock.report.run.twin_gap import gap_page as gap_page
else:
    __getattr__, __dir__, _ = lazy(__name__)


def build_report(run: Path | str, out: Path | str | None = None) -> Path:
    """Write the report of a run directory and return its path.

    Raises:
        RunError: there is no run in the directory, or it has logged no update yet.
    """
    from restock.report.look.write import write_page
    from restock.report.run.facts import gather
    from restock.report.run.page import page

    content = page(gather(Path(run)))
    return write_page(content, out if out is not None else Path(run) / "report.html")


__all__ = ["build_report"]  # the other names are for the verbs
