"""The building blocks of a page: sections, tables, figures, formats of numbers, and colours."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import duckdb

from restock.errors import figure
from restock.stats import interval_text
from restock.train.twin.missions import MISSIONS

Rows = list[dict[str, Any]]
BROAD = 4  # on a phone, a table with more columns than this is shown as one list per row


@dataclass(frozen=True)
class Drawing:
    """A chart drawn at several widths, in CSS pixels.

    The page shows the widest that fits.
    """

    svg: dict[int, str]  # width -> SVG text
    spec: dict[int, dict[str, Any]] = field(default_factory=dict)  # width -> Vega-Lite; maps: {}


@dataclass(frozen=True)
class Figure:
    """A drawing or an animation, with its title and caption."""

    drawing: Drawing = Drawing({})
    title: str = ""
    caption: str = ""
    moving: str = ""  # a data URI of the animation

    @property
    def kind(self) -> str:
        """Return the CSS class: the figure takes half of a line, or a full line."""
        return "half" if max(self.drawing.svg, default=0) < 500 else "full"

    @property
    def shown(self) -> list[tuple[str, str, dict[str, Any] | None]]:
        """Return the CSS class (such as `w470`), SVG and specification for each width."""
        drawn = sorted(self.drawing.svg.items())
        return [
            ("any" if len(drawn) == 1 else f"w{width}", svg, self.drawing.spec.get(width))
            for width, svg in drawn
        ]


@dataclass(frozen=True)
class Table:
    """Rows with the same keys. The keys are the columns; a column without values is not shown."""

    rows: Rows
    title: str = ""
    caption: str = ""
    folded: bool = False  # hidden until its title is clicked

    @property
    def columns(self) -> list[str]:
        names = list(self.rows[0]) if self.rows else []
        return [name for name in names if any(row[name] not in ("", None) for row in self.rows)]

    @property
    def numbers(self) -> set[str]:
        """Return the columns of numbers, which are right-aligned."""
        return {name for name in self.columns if all(_is_number(row[name]) for row in self.rows)}

    @property
    def broad(self) -> bool:
        """Return whether a phone shows each row as a list of column and value."""
        return len(self.columns) > BROAD


@dataclass(frozen=True)
class Section:
    """A section of the page. With `two`, its figures are side by side."""

    id: str
    title: str
    intro: str = ""
    callout: str = ""
    figures: Sequence[Figure] = ()
    two: bool = False
    tables: Sequence[Table] = field(default_factory=list)
    details: str = ""
    details_title: str = ""


def words(name: str) -> str:
    """Turn `blocked_aisle` into `blocked aisle`."""
    return name.replace("_", " ")


_BESIDE_NUMBERS = {*("to", "of", "and", "or", "more", "e", "s", "min", "h", "m", "points")}


def _is_number(cell: Any) -> bool:
    """Return whether a cell shows a number, perhaps with its unit and interval, or nothing."""
    text = "" if cell is None else str(cell)
    begins = re.match(r"[<×+−-]?\s?\.?\d", text)
    return not text or (bool(begins) and set(re.findall("[A-Za-z]+", text)) <= _BESIDE_NUMBERS)


_NAMES = ("condition", "stratum", "arm")  # columns whose values are shown without underscores
_SHARES = ("agreement", "changed", "chosen_agreement")


def shown(rows: Rows, columns: dict[str, str]) -> Rows:
    """Select columns, rename them to their titles, and format values by the column's name."""
    return [{title: cell(name, row[name]) for name, title in columns.items()} for row in rows]


def cell(name: str, value: Any) -> str:
    """Format a value by the name of its column: shares in percent, names with spaces."""
    if value is None or isinstance(value, str):
        return words(value or "") if name in _NAMES else value or ""
    if name.endswith("share") or name in _SHARES:
        return percent(value)
    return count(value) if isinstance(value, int) else figure(value)


def listed(names: Sequence[str]) -> str:
    """Join names: `a, b and c`."""
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def points(value: float) -> str:
    """Format a difference of shares in points, with a true minus sign."""
    return f"{100 * value:+.0f}".replace("-", "−")


def points_text(row: dict[str, Any]) -> str:
    """Format a row's `difference` in points, with its interval."""
    low, high = points(row["difference_low"]), points(row["difference_high"])
    return f"{points(row['difference'])} points [{low}, {high}]"


MAX_NAMED = 3  # conditions in a headline


def named(rows: Rows) -> str:
    """Name the conditions that differ most, with their differences."""
    ordered = sorted(rows, key=lambda row: -abs(row["difference"]))
    texts = [f"{words(row['condition'])} ({points_text(row)})" for row in ordered[:MAX_NAMED]]
    return listed(texts + [f"{len(rows) - MAX_NAMED} more"] * (len(rows) > MAX_NAMED))


def better_and_worse(rows: Rows, than: str = "") -> tuple[list[str], int]:
    """Return sentences that name the conditions whose interval excludes zero, and their number."""
    better = [row for row in rows if row["difference_low"] > 0]
    worse = [row for row in rows if row["difference_high"] < 0]
    both = ("better", better), ("worse", worse)
    parts = [f"{word}{than} in {named(of)}" for word, of in both if of]
    return parts, len(better) + len(worse)


def estimate(row: dict[str, Any]) -> str:
    """Format a value with its interval, or the reason why it was refused."""
    if row["value"] is None:
        return f"refused: {row['refused']}"
    return interval_text(row["value"], row["low"], row["high"])


def percent(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.1%}" if value < 0.1 else f"{value:.0%}"


def count(value: int | None) -> str:
    return "" if value is None else f"{int(value):,}"


def span(seconds: float) -> str:
    """Format a duration for people."""
    if not math.isfinite(seconds):
        return "?"
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def pretty(document: Any) -> str:
    return json.dumps(document, indent=2, default=str)


def statements(package: str, name: str) -> dict[str, str]:
    """Read the statements of an SQL file, keyed by the `-- name:` line before each."""
    text = (files(package) / name).read_text(encoding="utf-8")
    parts = text.split("-- name: ")[1:]
    return {part.split("\n", 1)[0].strip(): part.split("\n", 1)[1] for part in parts}


def fetch_rows(connection: duckdb.DuckDBPyConnection, sql: str, **parameters: Any) -> Rows:
    """Return the rows of a query with `$name` parameters."""
    found = connection.execute(sql, parameters or None)
    names = [column[0] for column in found.description or ()]
    return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


# Okabe-Ito: colour-blind readers can distinguish them too.
CONDITION_COLOURS = {
    **{name: one.colour for name, one in MISSIONS.items()},
    **{
        f"{name} ({block})": colour
        for name, one in MISSIONS.items()
        for block, colour in one.blocks.items()
    },
    "recovery": "#cc79a7",
}
WORDS_COLOURS = {words(name): colour for name, colour in CONDITION_COLOURS.items()}
SPARE_COLOURS = ("#56b4e9", "#009e73", "#8b5cf6", "#84643a", "#111827")


def palette(
    names: Collection[str],
    colours: Mapping[str, str] = CONDITION_COLOURS,
    spare: Sequence[str] = SPARE_COLOURS,
) -> dict[str, str]:
    """Return a colour for each name, independent of their order.

    A name without a colour of its own gets the first spare colour that is free. The search begins
    at a place that depends on the name, so that it mostly gets the same colour in every chart.
    """
    found = {name: colours[name] for name in names if name in colours}
    free: list[str] = []
    for name in sorted(set(names) - set(found)):
        free = free or list(spare)
        first = sum(map(ord, words(name))) % len(spare)
        likes = (*spare[first:], *spare[:first])
        found[name] = next(colour for colour in likes if colour in free)
        free.remove(found[name])
    return found


DARK = {  # colour in the light theme -> in the dark theme
    # text, lines and backgrounds
    "#0f172a": "#e8edf4",
    "#334155": "#cbd5e1",
    "#475569": "#a3b1c6",
    "#64748b": "#94a3b8",
    "#94a3b8": "#7b8aa3",
    "#cbd5e1": "#475569",
    "#e2e8f0": "#2b3a52",
    "#f8fafc": "#101a2d",
    "#ffffff": "#16213a",
    # data series
    "#111827": "#e5e7eb",
    "#6b7280": "#a1a8b5",
    "#9ca3af": "#7f8795",
    "#0f766e": "#2dd4bf",
    "#14b8a6": "#2ac7b4",
    "#0072b2": "#4aa8e8",
    "#8a5a00": "#c08a2d",
    "#d55e00": "#f3843a",
    "#b45309": "#f59a4a",
    "#7c3aed": "#c79bff",
    "#8b5cf6": "#a88bfa",
    "#84643a": "#c2a06b",
    "#009e73": "#2fc79a",
    "#b91c1c": "#f87171",
    "#2563eb": "#6ea0ff",
    "#be185d": "#f472b6",
    "#b58900": "#e8d44d",
    "#7f1d1d": "#e06a6a",
    "#0c98dd": "#7dd3fc",
}


def dark_rules() -> str:
    """Return the CSS rules that replace a figure's colours in the dark theme."""
    return "\n".join(_rules())


def _rules() -> Iterator[str]:
    for light, dark in DARK.items():
        for part in ("fill", "stroke"):
            yield f'  svg [{part}="{light}"] {{ {part}: {dark}; }}'
        yield f'  .swatch[style*="{light}"] {{ background: {dark} !important; }}'
