"""Self-contained pages: about a run, what it was fed and what it learnt; about a store, and others.

`build_report(run)` writes `run/report.html`, which opens without a network. The verbs write the
other pages: `write_page` takes what `coverage_page`, `study_page` and the others return.
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
    """Write the report of a run directory; returns its path.

    Raises:
        RunError: no run there, or one with nothing to report on yet.
    """
    from restock.report.look.write import write_page
    from restock.report.run.facts import gather
    from restock.report.run.page import page

    content = page(gather(Path(run)))
    return write_page(content, out if out is not None else Path(run) / "report.html")


__all__ = ["build_report"]  # the others serve the verbs
