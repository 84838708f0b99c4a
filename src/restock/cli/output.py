"""Print tables for people, the same rows as JSON or CSV for programs, and progress on stderr."""

from __future__ import annotations

import csv
import json
import math
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from decimal import Decimal
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, TextIO

from restock.errors import counted, quoted, spreadsheet_safe, visible

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID
    from rich.text import Text

    from restock.replay.store.store import Store

Row = Mapping[str, Any]
PIPE_WIDTH = 120  # characters a line of a table in a file or a pipe; longer cells are wrapped
GAP = 3  # spaces between the columns of a table
MAX_CELL = 40  # characters of a cell in a query's table on a terminal; longer cells are cut
SHORT = 24  # characters; cells up to this length are not wrapped in a file or a pipe (for grep)
# A cell that consists of one of these words -> its style on a terminal, unless NO_COLOR is set.
_STYLES = {
    **dict.fromkeys(("fail", "failed", "wrong", "worse", "untrusted", "reversed"), "bold red"),
    **dict.fromkeys(("not allowed", "different"), "bold red"),
    **dict.fromkeys(("warn", "missing", "inconclusive", "undetermined", "unknown"), "yellow"),
    **dict.fromkeys(
        ("pass", "ok", "trusted", "agrees", "better", "comparable", "HEALTHY"), "green"
    ),
    "skipped": "dim",
}


@cache
def _console_type() -> type[Console]:
    """Return a Console that raises BrokenPipeError for `cli.main`; rich's own would exit 1."""
    from rich.console import Console  # slow to import

    class PipedConsole(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    return PipedConsole


def stdout() -> Console:
    """Return the console for data. It wraps text only on a terminal."""
    console = _console_type()
    if sys.stdout.isatty():
        return console(file=sys.stdout, highlight=False)
    return console(
        file=sys.stdout, highlight=False, width=PIPE_WIDTH, soft_wrap=True, force_terminal=False
    )


def table_width() -> int:
    """Return the width of tables in characters: the terminal's, or PIPE_WIDTH elsewhere."""
    return stdout().width if sys.stdout.isatty() else PIPE_WIDTH


def stderr() -> Console:
    """Return the console for progress and messages."""
    return _console_type()(file=sys.stderr, highlight=False)


def say(message: str) -> None:
    """Print a line to stderr, without rich's markup: it may contain a path or a command."""
    stderr().print(visible(message, keep="\n"), markup=False, emoji=False, soft_wrap=True)


def print_text(text: str = "") -> None:
    """Print lines of data to stdout as they are: a terminal wraps them."""
    sys.stdout.write(visible(text, keep="\n") + "\n")


def names_in(text: str) -> list[str]:
    """Return the names of an option, which commas separate."""
    return [name.strip() for name in text.split(",") if name.strip()]


def say_unverified(store: Store) -> None:
    """Say how many files a store has whose checksums nobody has verified; nothing if none."""
    if files := store.unverified():
        sys.stderr.write(  # not printed with rich, which `sql` would have to import
            f"note: {counted(files, 'file')} of {visible(str(store.path))} not verified:"
            f" `restock store verify {visible(quoted(store.path))}` compares their checksums\n"
        )


def plain(value: Any) -> Any:
    """Convert a value for JSON: NaN becomes null, NumPy scalars become numbers."""
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
    if isinstance(value, Decimal):  # a number, because scripts would compare texts wrongly
        return int(value) if value == value.to_integral_value() else float(value)
    if isinstance(value, bytes):
        return value.hex()
    return str(value)


def print_json(value: Any, file: TextIO | None = None) -> None:
    """Print one JSON document to stdout, or to a file."""
    (file or sys.stdout).write(json.dumps(plain(value), indent=1, ensure_ascii=False) + "\n")


def print_csv(rows: Sequence[Row], columns: Sequence[str], file: TextIO | None = None) -> None:
    """Print a header and a line for each row to stdout, or to a file."""
    writer = csv.writer(file or sys.stdout, lineterminator="\n")
    writer.writerow(map(spreadsheet_safe, columns))
    writer.writerows(
        [
            row[name] if isinstance(row[name], Decimal) else spreadsheet_safe(plain(row[name]))
            for name in columns
        ]
        for row in rows
    )


def print_skipped(reasons: Mapping[str, str | None]) -> None:
    """Print a line for each reason why messages were skipped, with its topics."""
    topics: dict[str, list[str]] = {}
    for topic, reason in reasons.items():
        if reason:
            topics.setdefault(reason, []).append(topic)
    for reason, names in topics.items():
        sys.stdout.write(visible(f"skipped {', '.join(names)}: {reason}") + "\n")


def print_table(
    rows: Sequence[Row], columns: Sequence[str] | None = None, *, title: str | None = None
) -> None:
    """Print a table with a title; numbers are right-aligned.

    The table is as wide as the terminal, or PIPE_WIDTH; longer cells are wrapped. In a file or a
    pipe, words and cells of up to SHORT characters are never wrapped, so the table may be wider.
    On a terminal, words such as `fail` and `pass` are coloured.
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
    least = [_least_width(rows, name, short=SHORT if piped else 0) for name in names]
    apart, widths = (GAP, least) if piped else _fitted(least, console.width)
    padding = (0, 1, 0, 1) if apart == GAP else (0, apart - 1, 0, 0)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=padding)
    for name, width in zip(names, widths, strict=True):
        justify: Literal["left", "right"]
        justify = "right" if _numeric(rows, name) else "left"
        table.add_column(name, justify=justify, overflow="fold", min_width=width)
    for row in rows:
        table.add_row(*(_styled(cell(row[name])) for name in names))
    if title is not None:  # printed here, because rich would wrap it to the table's width
        style, lines = _STYLES.get(title.split(":")[0], "table.title"), [visible(title)]
        if not piped:
            lines = _wrapped(lines[0], console.width)
        console.print("\n".join(lines), style=style, markup=False, soft_wrap=True)
    with console.capture() as captured:
        console.print(table, soft_wrap=False, crop=not piped)
    # rich pads every line to the table's width; in a file or a pipe the padding is removed.
    lines = captured.get().splitlines()
    text = "\n".join(lines if sys.stdout.isatty() else [line.rstrip() for line in lines])
    sys.stdout.write(text.strip("\n") + "\n")


def print_parted(
    rows: Sequence[Row],
    columns: Sequence[str] | None = None,
    *,
    key: Sequence[str],
    title: str | None = None,
) -> None:
    """Print a table; if it is too wide, as several tables, each with the columns of `key`."""
    names = list(columns if columns is not None else rows[0] if rows else ())
    for place, group in enumerate(_grouped(rows, names, key, table_width())):
        if place:
            sys.stdout.write("\n")
        print_table(rows, group, title=None if place else title)


def print_sections(sections: Iterable[Any], *, folded: bool = False) -> None:
    """Print the tables of a page's sections; tables that the page folds only with `folded`."""
    for section in filter(None, sections):
        title: str | None = section.title
        for table in section.tables:
            if table.rows and (folded or not table.folded):
                print_table(table.rows, table.columns, title=table.title or title)
                title = None


def _grouped(
    rows: Sequence[Row], names: Sequence[str], key: Sequence[str], width: int
) -> list[list[str]]:
    """Split columns into groups that fit into a width; each group begins with the `key` columns."""
    least = {name: _least_width(rows, name) + GAP for name in names}
    groups: list[list[str]] = []
    for name in (name for name in names if name not in key):
        if not groups or sum(least[one] for one in [*groups[-1], name]) > width + GAP - 2:
            groups.append(list(key))
        groups[-1].append(name)
    return groups or [list(names)]


def _least_width(rows: Sequence[Row], name: str, *, short: int = SHORT) -> int:
    """Return the width a column needs to show words, numbers and cells of `short` letters uncut."""
    from rich.cells import cell_len

    texts = [cell(row[name]) for row in rows]
    full = max(cell_len(line) for text in [name, *texts] for line in text.split("\n"))
    uncut = texts if _numeric(rows, name) else " ".join(texts).split()
    return max([min(full, short), *map(cell_len, [*name.split(), *uncut])])


def _fitted(least: Sequence[int], width: int) -> tuple[int, Sequence[int | None]]:
    """Return the gap between columns of a table on a terminal, and the minimum widths of columns.

    If words do not fit even with a gap of one, there are no minimum widths, and rich cuts words.
    """
    for apart in range(GAP, 0, -1):
        if sum(least) + apart * (len(least) - 1) + 2 <= width:
            return apart, least
    return 1, [None] * len(least)


def _numeric(rows: Sequence[Row], name: str) -> bool:
    return any(is_number(row[name]) for row in rows)


def print_wrapped(text: str) -> None:
    """Print an empty line and a paragraph that is wrapped to the width of tables."""
    lines = _wrapped(text, table_width())
    stdout().print("\n".join(["", *lines]), markup=False, soft_wrap=True)


def _wrapped(text: str, columns: int) -> list[str]:
    return textwrap.wrap(text, columns, break_on_hyphens=False, subsequent_indent="  ")


def reported(rows: Sequence[Row], columns: Sequence[str] | None = None) -> list[str]:
    """Return the columns that have a value in at least one row."""
    names = list(columns if columns is not None else rows[0] if rows else ())
    return [name for name in names if any(row[name] not in (None, "") for row in rows)]


def _styled(text: str) -> Text:
    from rich.text import Text

    return Text.styled(text, _STYLES.get(text, ""))


def _fits(rows: Sequence[Row], names: Sequence[str]) -> bool:
    """Return whether the rows need no rich to print: ASCII, one line each, within PIPE_WIDTH."""
    if not rows or any("\n" in name for name in names):
        return False
    total = 1 - 3
    for name in names:
        texts = [cell(row[name]) for row in rows]
        if any(not text.isascii() or "\n" in text or "\t" in text for text in texts):
            return False
        total += max(len(name), *map(len, texts)) + 3
    return total <= PIPE_WIDTH


def print_plain(rows: Sequence[Row], columns: Sequence[str], *, values: bool = False) -> None:
    """Print a table with one line a row, however long, for files and pipes.

    With `values` (the rows of a query), NULL is printed, and columns are padded up to PIPE_WIDTH.
    """
    numeric = [_numeric(rows, name) for name in columns]
    text = value_text if values else cell
    texts = [[text(row[name]).replace("\n", r"\n") for name in columns] for row in rows]
    widths = [
        max([len(name), *(len(line[place]) for line in texts)])
        for place, name in enumerate(columns)
    ]
    if values:
        widths = [min(width, PIPE_WIDTH) for width in widths]

    def line(cells: Sequence[str]) -> str:
        parts = zip(cells, widths, numeric, strict=True)
        padded = (c.rjust(width) if right else c.ljust(width) for c, width, right in parts)
        return f" {'   '.join(padded)}".rstrip() + "\n"

    rule = " " + "─" * (sum(widths) + 3 * max(len(widths) - 1, 0)) + "\n"
    sys.stdout.writelines([line(list(columns)), rule, *(line(one) for one in texts)])


def print_elided(rows: Sequence[Row], columns: Sequence[str]) -> int:
    """Print the rows of a query on a terminal, one line each; return the number of hidden columns.

    Cells are cut at MAX_CELL. If the columns do not fit even then, those in the middle are hidden.
    """
    from rich.cells import cell_len, set_cell_size

    numeric = [_numeric(rows, name) for name in columns]
    lines = [list(map(visible, columns))]
    lines += [[value_text(row[name]).replace("\n", r"\n") for name in columns] for row in rows]
    widths = [min(max(map(cell_len, column)), MAX_CELL) for column in zip(*lines, strict=True)]
    room, first, last = table_width(), len(columns), len(columns)
    if sum(widths) + GAP * (len(widths) - 1) > room:
        room, first = room - 1, 0  # one character for "…" in place of the hidden columns
        while first < last:
            at_left = first <= len(columns) - last  # add columns from left and right in turn
            room -= widths[first if at_left else last - 1] + GAP
            if room < 0:
                break
            first, last = first + at_left, last - (not at_left)
    for number, line in enumerate(lines):
        padded = []
        for text, width, right in zip(line, widths, numeric, strict=True):
            short = text if cell_len(text) <= width else set_cell_size(text, width - 1) + "…"
            space = " " * (width - cell_len(short))
            padded.append(space + short if right else short + space)
        shown = [*padded[:first], *(["…"] if first < last else []), *padded[last:]]
        sys.stdout.write((" " * GAP).join(shown).rstrip() + "\n")
        if not number:
            sys.stdout.write((" " * GAP).join("─" * cell_len(text) for text in shown) + "\n")
    return last - first


def print_records(rows: Sequence[Row], columns: Sequence[str]) -> None:
    """Print the rows of a query as records: one line for each column of each row."""
    width = max([len(visible(name)) for name in columns], default=0)
    for number, row in enumerate(rows, start=1):
        sys.stdout.write(f"row {number}\n")
        for name in columns:
            text = value_text(row[name]).replace("\n", r"\n")
            sys.stdout.write(f"  {visible(name):<{width}}  {text}\n")


def value_text(value: Any) -> str:
    """Format a value of a query's row: NULL, lists in [], structs in {}."""
    if value is None:
        return "NULL"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(value_text, value))}]"
    if isinstance(value, Mapping):
        pairs = (f"{visible(str(name))}: {value_text(one)}" for name, one in value.items())
        return f"{{{', '.join(pairs)}}}"
    return cell(value)


def cell(value: Any) -> str:
    """Format a value for a table."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        # Large numbers (ids, sums) in full, not as 1.235e+06.
        return f"{value:,.0f}" if 1e4 <= abs(value) < 1e15 else f"{value:.4g}"
    if isinstance(value, int):
        return f"{value:,}" if abs(value) < 1_000_000_000 else str(value)
    if isinstance(value, list | tuple):
        return ", ".join(map(cell, value)) if any(item is not None for item in value) else ""
    return visible(str(value), keep="\n\t")


def is_number(value: Any) -> bool:
    return isinstance(value, int | float | Decimal) and not isinstance(value, bool)


CLOCK_COLUMNS = ["log - stamp s", "clock"]


def clock_cells(clock: Row | None) -> dict[str, str]:
    """Return the cells of CLOCK_COLUMNS: log time minus stamps of a topic, and its clock faults."""
    from restock.ingest.steps.clocks import odd

    offset = None if clock is None else clock["offset_ns"]
    cells = ["" if offset is None else f"{offset * 1e-9:,.3f}", "" if clock is None else odd(clock)]
    return dict(zip(CLOCK_COLUMNS, cells, strict=True))


class Advance:
    """A function that advances a progress bar and shows a note; it does nothing without a bar."""

    def __init__(self, bar: Progress | None = None, task: TaskID | None = None) -> None:
        self._bar, self._task = bar, task

    def __call__(self, amount: float = 1.0, note: str = "") -> None:
        """Advance the bar by `amount`, and show `note`."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, advance=amount, note=visible(note))

    def part(self, doing: str, done: float, whole: float) -> None:
        """Show the progress of the current part as a note, in percent."""
        self(0.0, f"{doing} {done / whole:.0%}" if whole else doing)


@contextmanager
def progress(description: str, total: float | None) -> Iterator[Advance]:
    """Show a progress bar on a terminal, and nothing elsewhere; yield the function to advance it.

    If `total` is None, the bar shows activity and the elapsed time.
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
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
        console=stderr(),
        transient=True,
        redirect_stdout=sys.stdout.isatty(),  # leave stdout alone if it is a file or a pipe
    )
    with bar:
        yield Advance(bar, bar.add_task(visible(description), total=total, note=""))
