"""One stage of the way: a command that a user could type, what it reads, and what it leaves."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Document = Mapping[str, Any]  # what a verb prints with --json; empty where it has not run


def nothing(document: Document) -> list[str]:
    """Of a stage that has nothing to say beside its output."""
    return []


@dataclass(frozen=True)
class Stage:
    """What is run, and when it need not be run again."""

    name: str
    title: str
    why: str  # for `restock demo`, which explains
    command: list[str]
    reads: tuple[Path, ...] = ()  # files of the user's: where one changes, it is run again
    writes: tuple[Path, ...] = ()
    expected: tuple[int, ...] = (0,)  # exit codes after which the way goes on
    remark: str = ""  # of `restock demo`, where the exit code is not 0
    outcome: Callable[[Document], list[str]] = nothing  # in a line or two
    shows_progress: bool = False  # it takes minutes
    resume: tuple[str, ...] = ()  # the command that goes on where it was interrupted
    beside: tuple[str, ...] = ()  # of `restock demo`: a command that runs at the same time
    # Of `restock demo`: the command, where that depends on what came before; None: not needed.
    decided: Callable[[], list[str] | None] | None = None

    def line(self) -> str:
        """The command, to be copied; beside another, where two run at the same time."""
        beside = f"restock {shlex.join(self.beside)} &\n" if self.beside else ""
        return f"{beside}restock {shlex.join(self.command)}"


@dataclass(frozen=True)
class Stop:
    """Where a person must decide."""

    why: str
    remedies: tuple[str, ...]  # each something to type or to edit


__all__ = ["Document", "Stage", "Stop"]
