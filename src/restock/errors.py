"""All errors of Restock, in one tree, and the phrases that messages and pages share.

Each error says what is wrong, where, and what to do about it. The command line prints it as one
message on stderr and exits with the error's code. In Python they are ordinary exceptions, all
subclasses of `RestockError`.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterable
from enum import IntEnum
from pathlib import PurePath

TRACEBACK = "RESTOCK_TRACEBACK"  # environment variable that prints tracebacks


def reported(text: str, keep: str = "") -> str:
    """Mask credentials in addresses such as `s3://KEY:SECRET@…`, and escape as `visible` does."""
    return visible(_SECRET.sub(r"\1***:***@", text), keep)


def visible(text: str, keep: str = "") -> str:
    """Escape the control characters in a text, except those in `keep`.

    A terminal obeys them: the name of a topic could clear the screen (`\\x1b[2J`), or imitate
    another line. Characters that change the direction of text are escaped, too.
    """
    if text.isprintable():
        return text
    return "".join(
        letter
        if letter.isprintable() or letter in keep
        else letter.encode("unicode_escape").decode("ascii")
        for letter in text
    )


def spreadsheet_safe(value: object) -> object:
    """Return a CSV cell, with a `'` before text that a spreadsheet would run as a formula.

    Names of files and topics may begin with `=`. Text that is a number stays as it is.
    """
    if not isinstance(value, str) or not value.startswith(("=", "+", "-", "@", "\t", "\r")):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value


def print_traceback(error: Exception) -> None:
    """Print an error's traceback on stderr if RESTOCK_TRACEBACK is set."""
    if os.environ.get(TRACEBACK):
        import traceback  # slow to import

        traceback.print_exception(error)


class ExitCode(IntEnum):
    """Exit codes of every verb."""

    OK = 0
    FAILED = 1  # an audit failed, or a comparison was refused
    USAGE = 2  # wrong usage or bad input; nothing was written
    LOSSY = 3  # written, but data was lost or skipped; the output lists it
    INTERRUPTED = 130  # Ctrl-C


_SECRET = re.compile(r"\b([A-Za-z][A-Za-z0-9+.-]+:/{1,2})[^/@\s]*:\S*@")


class RestockError(Exception):
    """An error that the user can fix: `what` is wrong, `where`, and the `remedy`."""

    exit_code = ExitCode.USAGE

    def __init__(self, what: str, *, where: str | None = None, remedy: str | None = None) -> None:
        # Messages may quote text of files and users, and are printed on a terminal.
        what, remedy = reported(what, keep="\n"), remedy and reported(remedy, keep="\n")
        where = where and reported(where)
        self.what, self.where, self.remedy = what, where, remedy
        parts = [f"{where}: {what}" if where else what]
        if remedy:
            parts.append(remedy)
        super().__init__("\n  ".join(parts))


class ConfigError(RestockError):
    """A profile, mixture or other TOML file with a setting that Restock cannot use."""


class RecordingError(RestockError):
    """A file that is not a recording, is empty or damaged, or lacks what a profile needs."""


class StoreError(RestockError):
    """A store that is missing, is something else, or changed while it was written to."""


class LabelError(RestockError):
    """Verdicts on labels that contradict each other, or are about rows that do not exist."""


class QueryError(RestockError):
    """SQL that DuckDB refused."""


class MixtureError(RestockError):
    """A mixture that the store cannot fill, and that is set to fail in this case."""


class PanelError(RestockError):
    """A panel that is missing, damaged, or made for another task."""


class RunError(RestockError):
    """A run directory that is missing, incomplete, or already there."""


# Names of policies. A run in a folder with one of these names is shown with the prefix `run:`.
_POLICIES = ("agent", "planner", "operator", "random", "cloned")


def plural(number: int, noun: str) -> str:
    """Return the singular `gap` for 1, else `gaps`."""
    return noun if number == 1 else f"{noun}s"


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: `1 gap`, `1,200 gaps`."""
    return f"{number:,} {plural(number, noun)}"


def uncertain_labels(conditions: Iterable[str], recordings: int) -> str:
    """Return a note on labels that depend on a guessed outline of the robot, and what to do."""
    return (
        f"uncertain: {', '.join(conditions)}, as the robot's outline is a guess in"
        f" {counted(recordings, 'recording')}: measure it, give --footprint LENGTHxWIDTH to"
        " `restock profile new`, and ingest again"
    )


def by_priority(conditions: Iterable[str]) -> str:
    """Return a note: a row with several conditions counts once, for the first in this order."""
    return (
        "By priority, a row that holds several conditions counts once, for the first of "
        + ", ".join(conditions)
        + "."
    )


def figure(value: float) -> str:
    """Format a measured number in three figures: `1,204`, `12.2`, `0.741`."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def quoted(path: object) -> str:
    """Quote a path for a command that a message suggests."""
    return shlex.quote(str(path))


def policy_words(policies: Iterable[str]) -> dict[str, str]:
    """Return display names of policies, keyed by the names that `--policies` takes.

    `run:demo/logs-alone` is shown as `logs alone`. Names stay as they are if two folders or files
    have the same name.
    """
    shown = {name: _policy_in_words(name) for name in policies}
    return shown if len({*shown.values()}) == len(shown) else {name: name for name in shown}


def _policy_in_words(name: str) -> str:
    """Shorten a policy's name to the name of its folder or file."""
    kind, _, path = name.partition(":")
    if kind == "limited":
        return f"{_policy_in_words(path)}, limited"
    if kind not in ("run", "onnx") or not PurePath(path).name:
        return name
    text = PurePath(path).name.replace("-", " ").replace("_", " ")
    return f"{kind}:{text}" if text in _POLICIES else text
