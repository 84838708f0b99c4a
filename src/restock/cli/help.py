"""`restock VERB --help`, as tyro prints it, fitted to the window: prose as wide as the boxes."""

from __future__ import annotations

import io
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout

import tyro

LEAST = 80  # columns that prose may take above narrower boxes, where the window has them
NARROWEST = 30  # columns: in a few, tyro lays its boxes out without end
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


class _Held(io.TextIOWrapper):
    """What is printed, kept; tyro asks it whether it is a terminal, and for its encoding."""

    def __init__(self, instead_of: io.TextIOBase) -> None:
        encoding = (instead_of.encoding or "utf-8").lower()  # as tyro compares it
        super().__init__(io.BytesIO(), encoding=encoding, newline="")
        self._is_terminal = instead_of.isatty()

    def isatty(self) -> bool:
        return self._is_terminal

    def text(self) -> str:
        self.seek(0)
        return self.read()


@contextmanager
def printed(*, help_asked: bool) -> Iterator[None]:
    """While tyro parses a command line: how it prints its help, or its complaint."""
    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)
    if os.environ.get("NO_COLOR") or not (help_asked or sys.stderr.isatty()):
        tyro._experimental_options["ansi_codes"] = False
    if not help_asked:
        yield
        return
    held = _Held(sys.stdout)  # type: ignore[arg-type]
    try:
        with redirect_stdout(held):
            yield
    finally:
        sys.stdout.write(fitted(held.text(), shutil.get_terminal_size().columns))


def fitted(text: str, columns: int) -> str:
    """A help with its prose wrapped to the width of its boxes, and parted by single empty lines.

    Empty lines in boxes are left out: tyro adds one where an option's text fills its last line.
    Of a job's description, the list of jobs shows the first paragraph; its own help shows all.
    """
    given = [(line, _COLOUR.sub("", line)) for line in text.splitlines()]
    boxes = [len(bare) for _, bare in given if bare[:1] in "╭│╰"]
    width = max(min(LEAST, columns), *boxes, 0)
    lines: list[str] = []
    jobs, skipping = False, False
    for line, bare in given:
        if bare.startswith("╭"):
            jobs = bare.startswith("╭─ subcommands")
        if bare.startswith("│") and not bare.strip("│ "):
            skipping = jobs
            continue
        skipping = skipping and bare.startswith("│") and "•" not in bare
        if skipping or (not bare and lines and not lines[-1]):
            continue
        if line == bare and len(line) > width and not line.startswith(" "):  # not an example
            hanging = "  " if line.startswith("usage:") else ""
            lines += textwrap.wrap(
                line,
                width,
                subsequent_indent=hanging,
                break_on_hyphens=False,
                break_long_words=False,
            )
        else:
            lines.append(line)
    return "\n".join([*lines, ""])
