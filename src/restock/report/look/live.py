"""Charts that answer the pointer: Vega in the page, without a network, over the drawings as SVG.

The SVG is in the page and is what is printed and what stands without script. A script shows each
chart drawn by Vega in its place, from the same specification, to which `live` adds what only a
pointer can ask: the values of a mark, and one series of a legend alone. Specifications and rows
travel once, as JSON; the runtime too, packed, and it is unpacked when the first chart is in view.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
from collections.abc import Iterator, Mapping
from copy import deepcopy
from functools import cache
from importlib.resources import files
from typing import Any

import vl_convert
from markupsafe import Markup

from restock.report.look.blocks import words

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
    """`low` or `high` of the end of an interval."""
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
    """Vega with all that it needs, as one script."""
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


__all__ = ["Charts", "live", "policy"]
