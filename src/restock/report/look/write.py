"""Writing a page: the template and style filled in, and each of its figures as files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import vl_convert
from markupsafe import Markup, escape

from restock.files import write_bytes, write_text
from restock.report.look import live
from restock.report.look.blocks import Figure, Section, Table
from restock.report.look.charts import CONFIG
from restock.report.look.theme import dark_rules

PNG_SCALE = 2.0  # pixels a CSS pixel


def write_page(content: dict[str, Any], out: Path | str, figures: Path | str | None = None) -> Path:
    """Write a page, and its figures into the folder `figures`; returns the page's path.

    Args:
        content: what the template asks for: kicker, title, headline, lead, cards, sections,
            footer, and a verdict if there is one.
    """
    out, folder = Path(out), files("restock.report.look")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["code"] = _code
    template = environment.from_string((folder / "page.html.jinja").read_text(encoding="utf-8"))
    style = (folder / "style.css").read_text(encoding="utf-8")
    style = style.replace("/* dark figures */", dark_rules())
    out.parent.mkdir(parents=True, exist_ok=True)
    has_charts = any(figure.drawing.spec for part in content["sections"] for figure in part.figures)
    own = {
        "style": Markup(style),
        "charts": live.Charts(CONFIG),
        "policy": live.policy(has_charts),
    }
    write_text(out, template.render({"verdict": None, **content, **own}))
    if figures is not None:
        write_figures(content["sections"], Path(figures))
    return out


def as_markdown(content: dict[str, Any]) -> str:
    """Return a page's words and tables as Markdown, without its figures."""
    lines = [f"# {content['title']}", "", f"{content['headline']}.", "", content["lead"]]
    for section in content["sections"]:
        lines += ["", f"## {section.title}"]
        for text in filter(None, (section.intro, section.callout)):
            lines += ["", text]
        for table in section.tables:
            lines += _table_lines(table)
    return "\n".join(lines) + "\n"


def _table_lines(table: Table) -> list[str]:
    if not table.rows:
        return []
    rows = [table.columns, *([row[name] for name in table.columns] for row in table.rows)]
    head, *body = [" | ".join(str(cell).replace("|", "\\|") for cell in row) for row in rows]
    lines = ["", f"**{table.title}**"] if table.title else []
    lines += ["", f"| {head} |", f"| {' | '.join('---' for _ in table.columns)} |"]
    return lines + [f"| {row} |" for row in body]


def write_figures(sections: Sequence[Section], folder: Path) -> list[Path]:
    """Write each figure as SVG and PNG, on white, named after its section and title."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, figure in _named(sections):
        svg = _on_white(figure.widest)
        written += [folder / f"{name}.svg", folder / f"{name}.png"]
        write_text(written[-2], svg)
        write_bytes(written[-1], vl_convert.svg_to_png(svg, scale=PNG_SCALE))
    return written


def _named(sections: Sequence[Section]) -> Iterator[tuple[str, Figure]]:
    taken: set[str] = set()
    for section in sections:
        for number, figure in enumerate(section.figures, start=1):
            text = figure.name or figure.title.lower() or str(number)
            short = "-".join(re.findall(r"[a-z0-9]+", text.lower())[:6])
            name = section.id if short in ("", "1") else f"{section.id}-{short}"
            name = name if name not in taken else f"{name}-{number}"
            taken.add(name)
            yield name, figure


def _on_white(svg: str) -> str:
    """Return a drawing that stands alone: on white, as complete XML."""
    box = re.search(r'viewBox="([-\d.]+) ([-\d.]+) ([-\d.]+) ([-\d.]+)"', svg)
    if box is None:
        return svg
    x, y, width, height = box.groups()
    ground = f'<rect x="{x}" y="{y}" width="{width}" height="{height}" fill="#ffffff"/>'
    end = svg.index(">") + 1
    return svg[:end] + ground + svg[end:]


def _code(text: str) -> Markup:
    """Return a sentence as escaped HTML, with text in backticks set as code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


__all__ = ["as_markdown", "write_figures", "write_page"]
