"""How tables are fitted into a terminal, or into the width of files and pipes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from restock.errors import visible

Row = Mapping[str, Any]
PIPE_WIDTH = 120  # of a table in a file or a pipe: what does not fit is wrapped, never cut
FAR = 3  # columns between two columns of a table, where there is room
NARROW = 8  # columns that a cell of long words is left with at least, on a narrow terminal
SHORT = 24  # columns of a cell that a file or a pipe gets in one piece, for who searches it


@dataclass(frozen=True)
class Layout:
    """How a table is fitted into what is too narrow for it."""

    apart: int  # columns between two columns
    headers: Sequence[str]
    widths: Sequence[int | None]

    def width(self) -> int:
        """Columns that it takes where every column's width is known, with its edges."""
        return sum(width or 0 for width in self.widths) + self.apart * (len(self.widths) - 1) + 2

    @classmethod
    def piped(cls, rows: Sequence[Row], names: Sequence[str]) -> Layout:
        """For a file or a pipe: no word and no cell up to SHORT is cut, however wide that is."""
        widths = [_piped_widths(rows, name) for name in names]
        least, full = [least for least, _ in widths], [full for _, full in widths]
        room = PIPE_WIDTH - 2 - FAR * (len(names) - 1)
        return cls(FAR, list(names), list(_filled(least, full, room)))

    @classmethod
    def of(cls, rows: Sequence[Row], names: Sequence[str], width: int) -> Layout:
        """As it is where it fits; closer, and with wrapped headers, where not."""
        texts = [[cell(row[name]) for row in rows] for name in names]
        lines = [[line for text in some for line in text.split("\n")] for some in texts]
        full = [_longest([*n.split("\n"), *some]) for n, some in zip(names, lines, strict=True)]
        width -= 2  # its edges
        if sum(full) + FAR * (len(names) - 1) <= width:
            return cls(FAR, list(names), [None] * len(names))
        least = []
        for name, some in zip(names, lines, strict=True):
            numeric = any(is_number(row[name]) for row in rows)
            cells = _longest(some if numeric else [word for line in some for word in line.split()])
            least.append(max(cells, _longest(_parted(name, cells).split("\n"))))
        for apart in (FAR, 2, 1):
            if (room := width - apart * (len(names) - 1)) >= sum(least):
                break
        # Too narrow even so: the columns with the longest words give way.
        for place in sorted(range(len(names)), key=lambda place: -least[place]):
            least[place] -= max(min(sum(least) - room, least[place] - NARROW), 0)
        widths = list(_filled(least, full, room))
        headers = [_parted(name, width) for name, width in zip(names, widths, strict=True)]
        return cls(apart, headers, widths)


def grouped(
    rows: Sequence[Row], names: Sequence[str], key: Sequence[str], width: int
) -> list[list[str]]:
    """The columns as tables that fit into a width: each has those of `key`, and some of the others,
    in their order."""
    least = {name: _piped_widths(rows, name)[0] + FAR for name in names}
    groups: list[list[str]] = []
    for name in (name for name in names if name not in key):
        if not groups or sum(least[one] for one in [*groups[-1], name]) > width + FAR - 2:
            groups.append(list(key))
        groups[-1].append(name)
    return groups or [list(names)]


def _piped_widths(rows: Sequence[Row], name: str) -> tuple[int, int]:
    """What a column takes at least in a file or a pipe, and what it takes without any wrapping."""
    texts = [name, *(cell(row[name]) for row in rows)]
    full = _longest([line for text in texts for line in text.split("\n")])
    whole = _longest([text for text in texts if len(text.split()) == 1])
    numeric = any(is_number(row[name]) for row in rows)
    return full if numeric else max(whole, min(full, SHORT)), full


def _filled(least: Sequence[int], full: Sequence[int], room: int) -> list[int]:
    """Widths between the least and what is wanted: the columns share the room that is left."""
    widths = list(least)
    while (left := room - sum(widths)) > 0:
        short = [place for place, width in enumerate(widths) if width < full[place]]
        if not short:
            break
        for place in short[:left]:
            widths[place] += max(min(left // len(short), full[place] - widths[place]), 1)
    return widths


def _parted(name: str, width: int) -> str:
    """A header as lines, parted at underscores and spaces; no narrower than its longest part."""
    if "\n" in name:
        return "\n".join(_parted(line, width) for line in name.split("\n"))
    parts = re.findall(r"[^_ ]+[_ ]*|[_ ]+", name)
    width = max([width, *(len(part.rstrip()) for part in parts)])
    lines = [""]
    for part in parts:
        if lines[-1] and len(lines[-1] + part.rstrip()) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(line.rstrip(" ") for line in lines)


def _longest(parts: Sequence[str]) -> int:
    """Columns of the longest of some lines or words, as `cell` writes them."""
    from rich.cells import cell_len

    return max((cell_len(part.replace(r"\[", "[")) for part in parts), default=0)


def cell(value: Any) -> str:
    """A value as a table shows it."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        # Large ones in full, as ids and sums are read: not 1.235e+06.
        return f"{value:,.0f}" if 1e4 <= abs(value) < 1e15 else f"{value:.4g}"
    if isinstance(value, int):
        return f"{value:,}" if abs(value) < 1_000_000_000 else str(value)
    if isinstance(value, list | tuple):
        return ", ".join(map(cell, value)) if any(item is not None for item in value) else ""
    return visible(str(value), keep="\n\t").replace("[", r"\[")


def is_number(value: Any) -> bool:
    return isinstance(value, int | float | Decimal) and not isinstance(value, bool)
