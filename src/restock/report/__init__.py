"""Self-contained pages: about a run, what it was fed and what it learnt; about a store, and others.

`build_report(run)` writes `run/report.html`, which opens without a network; `write_card(run)` the
replay card, its one-page answer to what the critic was fed.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from restock.files import write_text
from restock.replay.fleet.drift import Drift
from restock.replay.store.store import Store
from restock.report.fleet.coverage import coverage_facts, coverage_page
from restock.report.look.write import as_markdown as markdown
from restock.report.look.write import write_page
from restock.report.run.card import as_markdown, replay_card
from restock.report.run.comparison import comparison_page, study_page
from restock.report.run.facts import gather
from restock.report.run.gate import gate_page
from restock.report.run.page import page
from restock.report.run.twin_gap import gap_page
from restock.train.twin.calibration.twin_gap import read_gap


def build_report(
    run: Path | str, out: Path | str | None = None, figures: Path | str | None = None
) -> Path:
    """Write the report of a run directory; returns its path.

    If a folder `figures` is named, each figure is also written there, as SVG and PNG.

    Raises:
        RunError: no run there, or one with nothing to report on yet.
    """
    content = page(gather(Path(run)))
    return write_page(content, out if out is not None else Path(run) / "report.html", figures)


def write_gap_page(
    folder: Path | str, out: Path | str | None = None, figures: Path | str | None = None
) -> Path:
    """Write the page of a measured gap (`restock twin gap --out FOLDER`); returns its path.

    If a folder `figures` is named, each figure is also written there.

    Raises:
        RunError: there is none in `folder`.
    """
    content = gap_page(read_gap(Path(folder)))
    return write_page(content, out if out is not None else Path(folder) / "index.html", figures)


def write_coverage_page(
    store: Store,
    gaps: dict[str, Any],
    drift: Drift | str,
    out: Path | str,
) -> Path:
    """Write the page of a store's coverage; returns its path.

    Args:
        gaps: as `restock coverage gaps --json` prints them.
        drift: what `measure_drift` found, or why it could not be measured.
    """
    return write_page(coverage_page(coverage_facts(store), gaps, drift), out)


def write_study_page(
    study: dict[str, Any], out: Path | str, name: str = "", figures: Path | str | None = None
) -> Path:
    """Write the page of a study from its findings (`study.json`); returns its path.

    The same words and tables are written beside it as Markdown.
    """
    content = study_page(study, name)
    write_text(Path(out).with_suffix(".md"), markdown(content))
    return write_page(content, out, figures)


def write_comparison_page(
    found: dict[str, Any], out: Path | str, figures: Path | str | None = None
) -> Path:
    """Write the page of a comparison (`restock compare --json`); returns its path."""
    return write_page(comparison_page(found), out, figures)


def write_gate_page(document: dict[str, Any], out: Path | str) -> Path:
    """Write the page of a gate (`restock gate --json`); returns its path."""
    return write_page(gate_page(document), out)


def write_card(run: Path | str) -> tuple[dict[str, Any], str]:
    """Write the replay card into a run directory; returns it as JSON values and as Markdown.

    Raises:
        RunError: as `build_report`.
    """
    run = Path(run)
    card = replay_card(gather(run))
    markdown = as_markdown(card)
    write_text(run / "replay_card.json", json.dumps(card, indent=1, default=str) + "\n")
    write_text(run / "replay_card.md", markdown)
    return card, markdown


__all__ = ["build_report"]  # the others serve the verbs
