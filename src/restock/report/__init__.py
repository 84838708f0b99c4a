"""One self-contained page about a run: what it was fed, what it learnt, where it fails.

`build_report(run)` writes `run/report.html`, which opens without a network; `write_card(run)` the
replay card, its one-page answer to what the critic was fed.
"""

from __future__ import annotations

import json
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from restock.files import write_text
from restock.replay.fleet.drift import Drift
from restock.report.card import as_markdown, replay_card
from restock.report.drift import drift_page
from restock.report.facts import gather
from restock.report.page import page
from restock.report.twin_gap import gap_page
from restock.train.twin.calibration.twin_gap import read_gap


def build_report(run: Path, out: Path | None = None) -> Path:
    """Write the report of a run directory; returns its path.

    Raises:
        RunError: no run there, or one with nothing to report on yet.
    """
    return _write_page(page(gather(run)), out if out is not None else run / "report.html")


def write_gap_page(folder: Path, out: Path | None = None) -> Path:
    """Write the page of a measured gap (`restock twin gap --out FOLDER`); returns its path.

    Raises:
        RunError: there is none in `folder`.
    """
    return _write_page(
        gap_page(read_gap(folder)), out if out is not None else folder / "index.html"
    )


def write_drift_page(drift: Drift, out: Path) -> Path:
    """Write the page of what `measure_drift` found; returns its path."""
    return _write_page(drift_page(drift), out)


def _write_page(content: dict[str, Any], out: Path) -> Path:
    template = (files("restock.report") / "page.html.jinja").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["code"] = _code
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text(out, environment.from_string(template).render(content))
    return out


def _code(text: str) -> Markup:
    """A sentence as HTML: escaped, and what stands in backticks set as code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def write_card(run: Path) -> tuple[dict[str, Any], str]:
    """Write the replay card into a run directory; returns it as JSON values and as Markdown.

    Raises:
        RunError: as `build_report`.
    """
    card = replay_card(gather(run))
    markdown = as_markdown(card)
    write_text(run / "replay_card.json", json.dumps(card, indent=1, default=str) + "\n")
    write_text(run / "replay_card.md", markdown)
    return card, markdown


__all__ = ["build_report", "write_card", "write_drift_page", "write_gap_page"]
