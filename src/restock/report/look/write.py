"""Write a page: the template and style filled in, live charts, and each figure as files.

Figures are drawn in the colours of the light page. The style sheet exchanges them on a screen that
prefers dark; what is printed, and figures written as files, stay light. A chart's SVG is what is
printed and what is shown without scripts. A script replaces it by Vega's drawing of the same
specification, to which `live` adds interaction: the values of a mark, and one series of a legend
alone. Specifications and rows are in the page once, as JSON. The runtime is in it, too, compressed,
and is unpacked when the first chart is in view.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
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
from restock.files import write_bytes, write_text
from restock.report.look.blocks import Figure, Section, Table, dark_rules, words
from restock.report.look.charts import CONFIG

PNG_SCALE = 2.0  # pixels a CSS pixel


def write_page(
    content: dict[str, Any],
    out: Path | str,
    figures: Path | str | None = None,
    *,
    markdown: bool = False,
) -> Path:
    """Write a page, and its figures into the folder `figures`; returns the page's path.

    With `markdown` the same words and tables are written beside it, as FILE.md.

    Args:
        content: what the template asks for: kicker, title, headline, lead, cards, sections,
            a verdict if there is one, and the source that the footer names. Sections may be None.
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
    if figures is not None:
        write_figures(sections, Path(figures))
    if markdown:
        write_text(out.with_suffix(".md"), as_markdown(content))
    return out


def as_markdown(content: dict[str, Any]) -> str:
    """Return a page's words and tables as Markdown, without its figures."""
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
    """Return text that cannot leave its cell or be markup: names come from recordings."""
    text = "" if value is None else str(value)
    return text.replace("&", "&amp;").replace("<", "&lt;").replace("|", "\\|").replace("\n", " ")


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


Spec = dict[str, Any]

HIDDEN_SHARE = 0.12  # share of a series' opacity while another is isolated
HALO_PX2, HALO_OPACITY = 280, 0.35  # halo of a line's point below the pointer
_POSITIONS = ("x", "x2", "y", "y2")
_ENDS = ("", "low", "high")  # endings of the names of an interval's columns
_LICENCE = "/* Vega, Vega-Lite, Vega-Embed: (c) University of Washington, BSD-3-Clause */\n"


class Charts:
    """The charts of one page, numbered as they are added; rows that several share stand once."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._config = config
        self._rows: dict[str, Any] = {}
        self._charts: list[Spec] = []

    def add(self, spec: Spec) -> int:
        """Add a chart and return its number; `spec` is Vega-Lite with its rows by name."""
        shown = live(spec)
        rows = shown.pop("datasets", {})
        self._rows |= rows
        self._charts.append({"rows": list(rows), "spec": shown})
        return len(self._charts) - 1

    def blocks(self) -> Markup:
        """Return the elements at the end of the page; nothing if it has no charts."""
        if not self._charts:
            return Markup("")
        document = {"config": self._config, "rows": self._rows, "charts": self._charts}
        text = json.dumps(document, separators=(",", ":"), allow_nan=False)
        # No name in it ends the element, or begins another.
        text = text.replace("&", r"\u0026").replace("<", r"\u003c").replace(">", r"\u003e")
        return Markup(
            f'<script type="application/json" id="charts">{text}</script>\n'
            f'<script type="text/plain" id="runtime">{_packed()}</script>\n'
            f"<script>{_script()}</script>"
        )


def policy(charts: bool) -> str:
    """Return the page's Content-Security-Policy: no fetches, no scripts but these two."""
    scripts = " ".join(_hash(text) for text in (_script(), _runtime())) if charts else "'none'"
    return (
        "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none';"
        f" form-action 'none'; script-src {scripts}"
    )


def live(spec: Spec) -> Spec:
    """Turn the specification of a still chart into one that answers the pointer."""
    found = deepcopy(spec)
    rows = found.get("datasets", {})
    for name in ("config", "$schema"):
        found.pop(name, None)
    inner = found["spec"] if "facet" in found else found
    inner.setdefault("layer", None)
    if inner["layer"] is None:  # one mark alone: a layer of one
        del inner["layer"]
        inner["layer"] = [{name: inner.pop(name) for name in ("mark", "encoding")}]
    units = inner["layer"]
    reported = _told([unit for unit in units if _is_of_rows(unit)], found.get("facet", {}), rows)
    series = next(filter(None, map(_series, units)), None)
    if series is not None:
        for number, unit in enumerate(of for of in units if _series(of) == series):
            _isolate(unit, series, first=number == 0)
    for unit in list(units):
        if not _is_of_rows(unit):
            continue
        unit["encoding"].setdefault("tooltip", reported)
        if _mark(unit)["type"] == "line":
            units.append(_points(unit))
    return found


def _mark(unit: Spec) -> Spec:
    mark = unit["mark"]
    return mark if isinstance(mark, dict) else {"type": mark}


def _is_of_rows(unit: Spec) -> bool:
    """Return whether a mark stands for rows, with a field on each axis."""
    encoding = unit["encoding"]
    return _mark(unit)["type"] != "text" and all(
        "field" in encoding.get(axis, {}) for axis in ("x", "y")
    )


def _series(unit: Spec) -> str | None:
    """Return the field whose values the legend names, if it names several."""
    colour = unit["encoding"].get("color", {})
    several = len(colour.get("scale", {}).get("domain", ())) > 1
    named = colour.get("type") == "nominal" and colour.get("legend", {}) is not None
    return colour["field"] if several and named else None


def _isolate(unit: Spec, series: str, *, first: bool) -> None:
    """Let a click on a name of the legend show it alone, and a second one all again."""
    full = _mark(unit).get("opacity", 1)
    unit["encoding"]["opacity"] = {
        "condition": {"param": "alone", "value": full},
        "value": full * HIDDEN_SHARE,
    }
    if first:
        select = {"type": "point", "fields": [series]}
        unit.setdefault("params", []).append({"name": "alone", "select": select, "bind": "legend"})


def _points(line: Spec) -> Spec:
    """Add a line's points, wider than they are drawn and visible under the pointer."""
    mark = {"type": "point", "filled": True, "size": HALO_PX2, "clip": True}
    pointed = {"param": "pointed", "empty": False, "value": HALO_OPACITY}
    select = {"type": "point", "on": "pointerover", "clear": "pointerout"}
    return {
        **{name: line[name] for name in ("data", "transform") if name in line},
        "mark": mark | {name: _mark(line)[name] for name in ("color",) if name in _mark(line)},
        "encoding": {**line["encoding"], "opacity": {"condition": pointed, "value": 0}},
        "params": [{"name": "pointed", "select": select}],
    }


def _told(units: list[Spec], facet: Spec, rows: Mapping[str, Any]) -> list[Spec]:
    """Return what the tooltip of a row says: names, numbers and ends of intervals."""
    facets = [facet] if "field" in facet else list(facet.values())
    found: dict[str, Spec] = {}
    for channel in (*facets, *_channels(units)):
        if "field" in channel and (channel.get("title") or channel["field"] not in found):
            found.setdefault(channel["field"], channel)
    reported = [_field(name, channel, units, rows) for name, channel in found.items()]
    several = [one for one in reported if one is not None]
    return sorted(several, key=lambda one: ("format" in one, _ENDS.index(_end(one["field"]))))


def _channels(units: list[Spec]) -> Iterator[Spec]:
    for name in ("color", *_POSITIONS):
        for unit in units:
            if name in unit["encoding"]:
                yield unit["encoding"][name]


def _field(name: str, channel: Spec, units: list[Spec], rows: Mapping[str, Any]) -> Spec | None:
    """Return a field of the tooltip; None for a name that is the same everywhere."""
    end = _end(name)
    title = f"95 %, {end}" if end else channel.get("title") or words(name)
    values = [row[name] for of in rows.values() for row in of if row.get(name) is not None]
    numbers = [value for value in values if isinstance(value, int | float)]
    if len(numbers) < len(values) or not numbers:
        reported = {"field": name, "type": "nominal", "title": title}
        return reported if len(set(map(str, values))) > 1 else None
    whole = all(float(value).is_integer() for value in numbers)
    form = ".1~%" if _is_share(name, units) else "," if whole and not end else ",.4~r"
    return {"field": name, "type": "quantitative", "title": title, "format": form}


def _end(name: str) -> str:
    """Return `low` or `high` for the end of an interval."""
    return next((end for end in _ENDS[1:] if f"_{name}".endswith(f"_{end}")), "")


def _is_share(name: str, units: list[Spec]) -> bool:
    """Return whether an axis that the mark is drawn along is in percent."""
    encodings = [unit["encoding"] for unit in units]
    along = {
        channel[0]
        for channel in _POSITIONS
        if any(encoding.get(channel, {}).get("field") == name for encoding in encodings)
    }
    axes = [encoding.get(axis, {}).get("axis") or {} for encoding in encodings for axis in along]
    return name == "share" or any("%" in axis.get("format", "") for axis in axes)


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
