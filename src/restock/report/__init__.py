"""One self-contained page about a run: what it was fed, what it learnt, where it fails.

`build_report(run)` writes `run/report.html`, which opens without a network.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import jinja2

from restock.report.facts import gather
from restock.report.page import page
from restock.train.run import write_text


def build_report(run: Path, out: Path | None = None) -> Path:
    """Write the report of a run directory; returns its path.

    Raises:
        RunError: no run there, or one with nothing to report on yet.
    """
    facts = gather(run)
    template = (files("restock.report") / "page.html.jinja").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    out = out if out is not None else run / "report.html"
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text(out, environment.from_string(template).render(page(facts)))
    return out


__all__ = ["build_report"]
