"""Printing: tables on a terminal, the same rows as JSON or CSV for programs, progress on stderr."""

from __future__ import annotations

import csv
import json
import math
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from restock.errors import visible

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

Row = Mapping[str, Any]


PIPE_WIDTH = 120  # of a table in a file or a pipe: what does not fit is wrapped, never cut
FAR = 3  # columns between two columns of a table, where there is room
NARROW = 8  # columns that a cell of long words is left with at least, on a narrow terminal
SHORT = 24  # columns of a cell that a file or a pipe gets in one piece, for who searches it
# A cell that is one of these words alone, on a terminal -> how it is shown. NO_COLOR takes it off.
_STYLES = {
    **dict.fromkeys(("fail", "failed", "wrong", "worse", "untrusted", "reversed"), "bold red"),
    **dict.fromkeys(("not allowed", "different"), "bold red"),
    **dict.fromkeys(("warn", "missing", "inconclusive", "undetermined", "unknown"), "yellow"),
    **dict.fromkeys(
        ("pass", "ok", "trusted", "agrees", "better", "comparable", "HEALTHY"), "green"
    ),
    "skipped": "dim",
}


def stdout() -> Console:
    """The console for data. Prose is not wrapped when it is not a terminal."""
    from rich.console import Console  # slow to import, and a count needs none

    if sys.stdout.isatty():
        return Console(file=sys.stdout, highlight=False)
    return Console(
        file=sys.stdout, highlight=False, width=PIPE_WIDTH, soft_wrap=True, force_terminal=False
    )


def table_width() -> int:
    """Columns of a table: the terminal's, or those of a file or a pipe."""
    return stdout().width if sys.stdout.isatty() else PIPE_WIDTH


def stderr() -> Console:
    """The console for progress and messages."""
    from rich.console import Console

    return Console(file=sys.stderr, highlight=False)


def say(message: str) -> None:
    """One line of progress, to stderr: as it is, for it may hold a path or a command."""
    stderr().print(message, markup=False, emoji=False, soft_wrap=True)


def plain(value: Any) -> Any:
    """A value that JSON can hold: NaN and infinities become null, numpy scalars numbers."""
    if hasattr(value, "item") and not hasattr(value, "__len__"):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(item) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, bytes):
        return value.hex()
    return str(value)


def print_json(value: Any) -> None:
    """One JSON document, to stdout."""
    sys.stdout.write(json.dumps(plain(value), indent=1, ensure_ascii=False) + "\n")


def print_csv(rows: Sequence[Row], columns: Sequence[str] | None = None) -> None:
    """A header and a line a row, to stdout."""
    names = list(columns if columns is not None else rows[0] if rows else ())
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([plain(row[name]) for name in names] for row in rows)


def print_skipped(reasons: Mapping[str, str | None]) -> None:
    """Why topics' messages were skipped: sentences, which no column is wide enough for."""
    topics: dict[str, list[str]] = {}
    for topic, reason in reasons.items():
        if reason:
            topics.setdefault(reason, []).append(topic)
    for reason, names in topics.items():
        sys.stdout.write(visible(f"skipped {', '.join(names)}: {reason}") + "\n")


def print_table(
    rows: Sequence[Row], columns: Sequence[str] | None = None, *, title: str | None = None
) -> None:
    """A table on stdout, its title on a line of its own; numbers to the right.

    As wide as the terminal, or PIPE_WIDTH: longer cells are wrapped. In a file or a pipe names of
    one word and cells up to SHORT are not: where columns leave too little, the table is wider. On a
    narrow terminal columns stand closer, headers are wrapped at `_` and spaces, and words are cut
    only where nothing else is left. Words that say how something is (fail, pass) are coloured on a
    terminal.
    """
    names = list(columns if columns is not None else rows[0] if rows else ())
    if not sys.stdout.isatty() and _fits(rows, names):
        if title is not None:
            sys.stdout.write(visible(title).rstrip() + "\n")
        print_plain(rows, names)
        return
    from rich import box
    from rich.table import Table

    console, piped = stdout(), not sys.stdout.isatty()
    layout = _Layout.piped(rows, names) if piped else _Layout.of(rows, names, console.width)
    if piped:
        console.width = max(PIPE_WIDTH, layout.width())
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, layout.apart - 1, 0, 0))
    if layout.apart == FAR:
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name, header, width in zip(names, layout.headers, layout.widths, strict=True):
        numeric = any(_is_number(row[name]) for row in rows)
        table.add_column(
            header,
            justify="right" if numeric else "left",
            overflow="fold",
            no_wrap=numeric and width is None,
            width=width,
        )
    for row in rows:
        table.add_row(*(_styled(cell(row[name])) for name in names))
    if title is not None:  # rich's own would be wrapped to the table's width
        style = _STYLES.get(title.split(":")[0], "table.title")
        console.print(visible(title), style=style, markup=False, soft_wrap=True)
    with console.capture() as captured:
        console.print(table, soft_wrap=False)
    # rich pads every line to the table's width; a pipe has no use for that.
    lines = captured.get().splitlines()
    text = "\n".join(lines if sys.stdout.isatty() else [line.rstrip() for line in lines])
    sys.stdout.write(text.strip("\n") + "\n")


def print_wrapped(text: str) -> None:
    """A paragraph after an empty line, wrapped as tables are: to the terminal, or PIPE_WIDTH."""
    lines = textwrap.wrap(text, table_width(), break_on_hyphens=False, subsequent_indent="  ")
    stdout().print("\n".join(["", *lines]), markup=False, soft_wrap=True)


@dataclass(frozen=True)
class _Layout:
    """How a table is fitted into what is too narrow for it."""

    apart: int  # columns between two columns
    headers: Sequence[str]
    widths: Sequence[int | None]

    def width(self) -> int:
        """Columns that it takes where every column's width is known, with its edges."""
        return sum(width or 0 for width in self.widths) + self.apart * (len(self.widths) - 1) + 2

    @classmethod
    def piped(cls, rows: Sequence[Row], names: Sequence[str]) -> _Layout:
        """For a file or a pipe: no word and no cell up to SHORT is cut, however wide that is."""
        least, full = [], []
        for name in names:
            numeric = any(_is_number(row[name]) for row in rows)
            texts = [name, *(cell(row[name]) for row in rows)]
            full.append(_longest([line for text in texts for line in text.split("\n")]))
            whole = _longest([text for text in texts if len(text.split()) == 1])
            least.append(full[-1] if numeric else max(whole, min(full[-1], SHORT)))
        room = PIPE_WIDTH - 2 - FAR * (len(names) - 1)
        return cls(FAR, list(names), list(_filled(least, full, room)))

    @classmethod
    def of(cls, rows: Sequence[Row], names: Sequence[str], width: int) -> _Layout:
        """As it is where it fits; closer, and with wrapped headers, where not."""
        texts = [[cell(row[name]) for row in rows] for name in names]
        lines = [[line for text in some for line in text.split("\n")] for some in texts]
        full = [_longest([name, *some]) for name, some in zip(names, lines, strict=True)]
        width -= 2  # its edges
        if sum(full) + FAR * (len(names) - 1) <= width:
            return cls(FAR, list(names), [None] * len(names))
        least = []
        for name, some in zip(names, lines, strict=True):
            numeric = any(_is_number(row[name]) for row in rows)
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
    parts = re.findall(r"[^_ ]+[_ ]*|[_ ]+", name)
    width = max([width, *(len(part.rstrip()) for part in parts)])
    lines = [""]
    for part in parts:
        if lines[-1] and len(lines[-1] + part.rstrip()) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(line.rstrip(" ") for line in lines)


def too_wide(rows: Sequence[Row], columns: Sequence[str] | None = None) -> bool:
    """Whether a table of these rows would have to be fitted into the terminal, or a pipe."""
    names = list(columns if columns is not None else rows[0] if rows else ())
    widths = (max([len(name), *(len(cell(row[name])) for row in rows)]) + FAR for name in names)
    return sum(widths) > table_width()


def told(rows: Sequence[Row], columns: Sequence[str] | None = None) -> list[str]:
    """The columns that any row has a value in, for tables whose columns often have none."""
    names = list(columns if columns is not None else rows[0] if rows else ())
    return [name for name in names if any(row[name] not in (None, "") for row in rows)]


def _longest(parts: Sequence[str]) -> int:
    """Columns of the longest of some lines or words, as `cell` writes them."""
    from rich.cells import cell_len

    return max((cell_len(part.replace(r"\[", "[")) for part in parts), default=0)


def _styled(text: str) -> str:
    style = _STYLES.get(text)
    return f"[{style}]{text}[/]" if style else text


def _fits(rows: Sequence[Row], names: Sequence[str]) -> bool:
    """Whether every row is one line of PIPE_WIDTH; else a table is laid out by rich."""
    if not rows or any("\n" in name for name in names):
        return False
    total = 1 - 3
    for name in names:
        texts = [cell(row[name]) for row in rows]
        if any(not text.isascii() or "\n" in text or "\t" in text for text in texts):
            return False
        total += max(len(name), *map(len, texts)) + 3
    return total <= PIPE_WIDTH


def print_plain(rows: Sequence[Row], columns: Sequence[str]) -> None:
    """A table for files and pipes, as `print_table` lays it out: a line a row, however wide."""
    numeric = [any(_is_number(row[name]) for row in rows) for name in columns]
    texts = [
        [cell(row[name]).replace(r"\[", "[").replace("\n", r"\n") for name in columns]
        for row in rows
    ]
    widths = [
        max([len(name), *(len(line[place]) for line in texts)])
        for place, name in enumerate(columns)
    ]

    def line(cells: Sequence[str]) -> str:
        parts = zip(cells, widths, numeric, strict=True)
        padded = (c.rjust(width) if right else c.ljust(width) for c, width, right in parts)
        return f" {'   '.join(padded)}".rstrip() + "\n"

    rule = " " + "─" * (sum(widths) + 3 * max(len(widths) - 1, 0)) + "\n"
    sys.stdout.writelines([line(list(columns)), rule, *(line(one) for one in texts)])


CLOCK_COLUMNS = ["log - stamp s", "clock"]


def clock_cells(clock: Row | None) -> dict[str, str]:
    """A topic's clocks for a table: how far log time is ahead of its stamps, and what is odd."""
    from restock.ingest.steps.clocks import odd

    offset = None if clock is None else clock["offset_ns"]
    cells = ["" if offset is None else f"{offset * 1e-9:,.3f}", "" if clock is None else odd(clock)]
    return dict(zip(CLOCK_COLUMNS, cells, strict=True))


def cell(value: Any) -> str:
    """A value as a table shows it."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, int):
        return f"{value:,}" if abs(value) < 1_000_000_000 else str(value)
    if isinstance(value, list | tuple):
        return ", ".join(cell(item) for item in value)
    return visible(str(value), keep="\n\t").replace("[", r"\[")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


class Advance:
    """Moves a progress bar, and one below it of the part at hand; or nothing, without a bar."""

    def __init__(self, bar: Progress | None = None, task: TaskID | None = None) -> None:
        self._bar, self._task = bar, task
        self._part: tuple[str, TaskID] | None = None

    def __call__(self, amount: float = 1.0, note: str = "") -> None:
        """So much more of the whole is done; the part at hand is over."""
        if self._bar is None or self._task is None:
            return
        self._bar.update(self._task, advance=amount, note=note)
        self._end_part()

    def part(self, doing: str, done: float, whole: float) -> None:
        """How far the part at hand is."""
        if self._bar is None:
            return
        if self._part is None or self._part[0] != doing:
            self._end_part()
            self._part = doing, self._bar.add_task(doing, total=whole, note="")
        self._bar.update(self._part[1], completed=done)

    def _end_part(self) -> None:
        if self._bar is not None and self._part is not None:
            self._bar.remove_task(self._part[1])
        self._part = None


@contextmanager
def progress(description: str, total: float | None) -> Iterator[Advance]:
    """A progress bar on a terminal, silence elsewhere. Yields what moves it.

    Without a total it shows that something moves, and for how long.
    """
    if not sys.stderr.isatty():
        yield Advance()
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=stderr(),
        transient=True,
        redirect_stdout=sys.stdout.isatty(),  # in a file it is data, whatever stderr shows
    )
    with bar:
        yield Advance(bar, bar.add_task(description, total=total, note=""))
