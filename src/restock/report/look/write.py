"""Write a page from its template and style sheet, with interactive charts.

Figures are drawn in the colours of the light theme. On a screen that prefers dark, the style sheet
replaces the colours; prints stay light. The SVG of a chart is for prints and for browsers without
scripts. A script replaces it with Vega's drawing of the same specification. `live` makes this
drawing interactive: it shows the values of a mark, and one series alone. The page contains the
specifications and rows once, as JSON, and the compressed code of Vega. The code is unpacked when
the first chart comes into view.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
from collections.abc import Mapping
from copy import deepcopy
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import vl_convert
from markupsafe import Markup, escape

from restock import __version__
from restock.files import write_text
from restock.report.look.blocks import Table, dark_rules
from restock.report.look.charts import CONFIG


def write_page(content: dict[str, Any], out: Path | str, *, markdown: bool = False) -> Path:
    """Write a page and return its path.

    With `markdown`, its text and tables are also written beside it, as FILE.md.

    Args:
        content: the variables of the template: kicker, title, headline, lead and sections, of
            which some may be None; optionally a verdict, and the source that the footer names.
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
    sections = [section for section in content["sections"] if section is not None]
    has_charts = any(figure.drawing.spec for part in sections for figure in part.figures)
    own = {
        "style": Markup(style),
        "charts": Charts(CONFIG),
        "policy": policy(has_charts),
    }
    source = f" from {content['source']}" if "source" in content else ""
    own |= {
        "sections": sections,
        "footer": f"restock {__version__} · written {datetime.now(UTC):%Y-%m-%d %H:%M} UTC{source}",
    }
    write_text(out, template.render({"verdict": None, **content, **own}))
    if markdown:
        write_text(out.with_suffix(".md"), as_markdown(content))
    return out


def as_markdown(content: dict[str, Any]) -> str:
    """Return the text and tables of a page as Markdown, without its figures."""
    lines = [f"# {_plain(content['title'])}", "", f"{_plain(content['headline'])}."]
    lines += ["", content["lead"]] if content["lead"] else []
    for section in filter(None, content["sections"]):
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
    head, *body = [" | ".join(map(_plain, row)) for row in rows]
    lines = ["", f"**{table.title}**"] if table.title else []
    lines += ["", f"| {head} |", f"| {' | '.join('---' for _ in table.columns)} |"]
    return lines + [f"| {row} |" for row in body]


def _plain(value: Any) -> str:
    """Escape a value for a cell of a Markdown table: names in recordings may contain markup."""
    text = "" if value is None else str(value)
    return text.replace("&", "&amp;").replace("<", "&lt;").replace("|", "\\|").replace("\n", " ")


def _code(text: str) -> Markup:
    """Return a sentence as escaped HTML, with text in backticks set as code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


Spec = dict[str, Any]

HIDDEN_SHARE = 0.12  # factor on a series' opacity while another series is shown alone
_LICENCE = "/* Vega, Vega-Lite, Vega-Embed: (c) University of Washington, BSD-3-Clause */\n"


class Charts:
    """The numbered charts of one page. Rows that several charts share are stored once."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._config = config
        self._rows: dict[str, Any] = {}
        self._charts: list[Spec] = []

    def add(self, spec: Spec) -> int:
        """Add a chart, a Vega-Lite specification with its rows as `datasets`; return its number."""
        shown = live(spec)
        rows = shown.pop("datasets", {})
        self._rows |= rows
        self._charts.append({"rows": list(rows), "spec": shown})
        return len(self._charts) - 1

    def blocks(self) -> Markup:
        """Return the scripts at the end of the page; empty if it has no charts."""
        if not self._charts:
            return Markup("")
        document = {"config": self._config, "rows": self._rows, "charts": self._charts}
        text = json.dumps(document, separators=(",", ":"), allow_nan=False)
        # Escaped, so that no name in it can end the element or begin another.
        text = text.replace("&", r"\u0026").replace("<", r"\u003c").replace(">", r"\u003e")
        return Markup(
            f'<script type="application/json" id="charts">{text}</script>\n'
            f'<script type="text/plain" id="runtime">{_packed()}</script>\n'
            f"<script>{_script()}</script>"
        )


def policy(charts: bool) -> str:
    """Return the page's Content-Security-Policy: no fetches; no scripts, or only the page's two."""
    scripts = " ".join(_hash(text) for text in (_script(), _runtime())) if charts else "'none'"
    return (
        "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none';"
        f" form-action 'none'; script-src {scripts}"
    )


def live(spec: Spec) -> Spec:
    """Make the specification of a chart interactive.

    `charts.CONFIG` turns on tooltips. Lines get transparent points, because tooltips need points.
    A click on a name in the legend shows that series alone; a second click shows all series again.
    """
    found = deepcopy(spec)
    for name in ("config", "$schema"):
        found.pop(name, None)
    inner = found["spec"] if "facet" in found else found
    units = inner.get("layer", [inner])
    for unit in units:
        if _mark(unit)["type"] == "line" and not _mark(unit).get("point"):
            unit["mark"] = {**_mark(unit), "point": "transparent"}
    series = next(filter(None, map(_series, units)), None)
    of_series = [unit for unit in units if series is not None and _series(unit) == series]
    for unit in of_series:
        full = _mark(unit).get("opacity", 1)
        unit["encoding"]["opacity"] = {
            "condition": {"param": "alone", "value": full},
            "value": full * HIDDEN_SHARE,
        }
    if of_series:
        select = {"type": "point", "fields": [series]}
        of_series[0]["params"] = [{"name": "alone", "select": select, "bind": "legend"}]
    return found


def _mark(unit: Spec) -> Spec:
    mark = unit["mark"]
    return mark if isinstance(mark, dict) else {"type": mark}


def _series(unit: Spec) -> str | None:
    """Return the field that the legend is about; None unless the legend has several names."""
    colour = unit["encoding"].get("color", {})
    several = len(colour.get("scale", {}).get("domain", ())) > 1
    named = colour.get("type") == "nominal" and colour.get("legend", {}) is not None
    return colour["field"] if several and named else None


@cache
def _runtime() -> str:
    """Return Vega and its dependencies as one script."""
    return _LICENCE + vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;")


@cache
def _packed() -> str:
    return base64.b64encode(gzip.compress(_runtime().encode(), mtime=0)).decode()


@cache
def _script() -> str:
    return (files("restock.report.look") / "live.js").read_text(encoding="utf-8")


def _hash(script: str) -> str:
    digest = hashlib.sha256(script.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"
