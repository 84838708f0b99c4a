"""The code blocks of the documentation's pages, and what a page says about running them.

A block is fenced and names its language. A comment on the line before it may say:

    <!-- not run: WHY -->      it needs what a test has not: a robot, a cluster, hours
    <!-- slow -->              runs with the slow tests only
    <!-- exit codes: 1 3 -->   besides 0, how its commands may end
    <!-- file: wet.toml -->    the block is that file, which later blocks of the page read
    <!-- before: COMMANDS -->  what a reader did before, in the shell

`<!-- new folder -->` on a line of its own: the blocks after it run in a folder of their own.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path

from support.paths import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SHELL = ("sh", "bash", "console")
RUN = (*SHELL, "python", "sql")  # what is executed; TOML is checked, text is shown
_MARK = re.compile(r"<!-- (not run|slow|exit codes|file|before)(?:: (.*))? -->")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str  # from the project's root
    line: int  # of its first line of code
    language: str  # "" where it names none
    text: str
    marks: dict[str, str] = field(default_factory=dict)
    folder: int = 0  # number of the page's folder in which it runs

    @property
    def place(self) -> str:
        return f"{self.page}:{self.line}"

    @property
    def is_run(self) -> bool:
        return self.language in RUN and "not run" not in self.marks and "file" not in self.marks

    @property
    def exit_codes(self) -> list[int]:
        """That a command of a shell block may end with."""
        return [0, *map(int, self.marks.get("exit codes", "").split())]

    @property
    def before(self) -> str:
        """Commands that a reader gave before it."""
        return self.marks.get("before", "")

    @property
    def shell(self) -> str:
        """A shell block's commands: of a console block the lines after a prompt."""
        if self.language != "console":
            return self.text
        return "".join(line[2:] + "\n" for line in self.text.splitlines() if line[:2] == "$ ")


def blocks(path: Path) -> list[Block]:
    """Every fenced block of a page, in order."""
    page = str(path.relative_to(ROOT))
    lines = path.read_text(encoding="utf-8").splitlines()
    found = []
    number = folder = 0
    while number < len(lines):
        folder += lines[number] == "<!-- new folder -->"
        if lines[number].startswith("```"):
            first, number = number, number + 1
            while lines[number] != "```":
                number += 1
            marks = {}
            above = first - 1
            while above >= 0 and (mark := _MARK.fullmatch(lines[above])):
                marks[mark[1]] = mark[2] or ""
                above -= 1
            text = "".join(line + "\n" for line in lines[first + 1 : number])
            found.append(Block(page, first + 2, lines[first][3:], text, marks, folder))
        number += 1
    return found


def indented(path: Path) -> list[int]:
    """Return the lines on which a page has a code block that is indented instead of fenced."""
    lines = path.read_text(encoding="utf-8").splitlines()
    found, fenced, listed = [], False, False
    for number, line in enumerate(lines, start=1):
        if line.startswith("```"):
            fenced = not fenced
        if line.strip() and not line.startswith(" "):
            listed = bool(re.match(r"[-*]|\d+\.", line))
        if not (fenced or listed) and line.startswith("    ") and not lines[number - 2].strip():
            found.append(number)
    return found
