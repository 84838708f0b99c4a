"""The one tree of errors: each says what is wrong, where, and what to do about it.

The command line turns any of them into one message on stderr and the error's exit code; from
Python they are ordinary exceptions, all below `RestockError`. Below them are the phrases that
messages and pages share: counts, figures, quoted paths.
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
    """Mask key and secret of an address such as `s3://KEY:SECRET@…`, and escape as `visible`."""
    return visible(_SECRET.sub(r"\1***:***@", text), keep)


def visible(text: str, keep: str = "") -> str:
    """Write out control characters of a text (but those in `keep`), as in `\\x1b[2J`.

    A terminal obeys them: a topic's name could clear the screen, or pass for another line.
    Characters that reorder text are written out, too.
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
    """Print an error's traceback on stderr if the environment asks for it."""
    if os.environ.get(TRACEBACK):
        import traceback  # slow to import

        traceback.print_exception(error)


class ExitCode(IntEnum):
    """Exit codes of every verb."""

    OK = 0
    FAILED = 1  # an audit failed, or a comparison was refused
    USAGE = 2  # wrong usage or bad input: nothing was written
    LOSSY = 3  # written, but data was lost or skipped (and the output says what)
    INTERRUPTED = 130  # Ctrl-C


_SECRET = re.compile(r"\b([A-Za-z][A-Za-z0-9+.-]+:/{1,2})[^/@\s]*:\S*@")


class RestockError(Exception):
    """An error that the user can fix: `what` is wrong, `where`, and the `remedy`."""

    exit_code = ExitCode.USAGE

    def __init__(self, what: str, *, where: str | None = None, remedy: str | None = None) -> None:
        # They quote what files and people say, and end up on a terminal.
        what, remedy = reported(what, keep="\n"), remedy and reported(remedy, keep="\n")
        where = where and reported(where)
        self.what, self.where, self.remedy = what, where, remedy
        parts = [f"{where}: {what}" if where else what]
        if remedy:
            parts.append(remedy)
        super().__init__("\n  ".join(parts))


def expect(name: str, given: object, kind: type | tuple[type, ...], remedy: str) -> None:
    """Refuse an argument of another kind, such as a path in place of the opened object.

    Raises:
        ArgumentError: it is not of `kind`.
    """
    if not isinstance(given, kind):
        kinds = " or ".join(one.__name__ for one in (kind if isinstance(kind, tuple) else (kind,)))
        article = "an" if kinds[0].lower() in "aeiou" else "a"
        what = f"{name} must be {article} {kinds}, got {repr(given)[:80]}"
        raise ArgumentError(what, remedy=remedy)


class ConfigError(RestockError):
    """A profile, mixture or other TOML file that says something Restock cannot use."""


class ArgumentError(ConfigError, TypeError):
    """An argument of a Python function that is of another kind than it takes."""


class RecordingError(RestockError):
    """A file that is no recording, is empty, is damaged, or lacks what a profile needs."""


class StoreError(RestockError):
    """A store that is missing, is not one, or changed under a writer."""


class LabelError(RestockError):
    """Verdicts on labels that cannot be taken: rows that are not there, or contradictions."""


class QueryError(RestockError):
    """SQL that DuckDB refused."""


class MixtureError(RestockError):
    """A mixture that the store cannot fill, if the mixture asks to be refused then."""


class PanelError(RestockError):
    """A panel that is missing, damaged, or made for another task."""


class RunError(RestockError):
    """A run directory that is missing, incomplete, or already there."""


_POLICIES = ("agent", "planner", "operator", "random", "cloned")  # a run's folder is none of them


def plural(number: int, noun: str) -> str:
    """Return the singular `gap` for 1, else `gaps`."""
    return noun if number == 1 else f"{noun}s"


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: `1 gap`, `1,200 gaps`."""
    return f"{number:,} {plural(number, noun)}"


def uncertain_labels(conditions: Iterable[str], recordings: int) -> str:
    """Say which labels rest on an outline that nobody measured, and how to settle it."""
    return (
        f"uncertain: {', '.join(conditions)}, as the robot's outline is a guess in"
        f" {counted(recordings, 'recording')}: measure it, give --footprint LENGTHxWIDTH to"
        " `restock profile new`, and ingest again"
    )


def by_priority(conditions: Iterable[str]) -> str:
    """Say how rows that hold several conditions are counted once, in the given order."""
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


def verdict_said(verdict: str, *, decides: bool) -> str:
    """Say what a check of two runs' feeds means: differences may be allowed."""
    allowed = {"incomparable": "differs: allowed", "inconclusive": "may differ: allowed"}
    return verdict if decides else allowed.get(verdict, verdict)


def policy_words(policies: Iterable[str]) -> dict[str, str]:
    """Return policies as people read them, by the names that `--policies` takes.

    `run:demo/logs-alone` is `logs alone`. Folders and files of one name are told apart by those
    that they are in.
    """
    names = list(dict.fromkeys(policies))
    most = max((len(PurePath(name).parts) for name in names), default=0)
    for parts in range(1, most + 1):
        shown = {name: _policy_in_words(name, parts) for name in names}
        if len(set(shown.values())) == len(names):
            return shown
    return {name: name for name in names}


def _policy_in_words(name: str, parts: int) -> str:
    """Shorten a policy's name to so many parts of its path."""
    kind, _, path = name.partition(":")
    if kind == "limited":
        return f"{_policy_in_words(path, parts)}, limited"
    if kind not in ("run", "onnx") or not PurePath(path).name:
        return name
    text = "/".join(PurePath(path).parts[-parts:]).replace("-", " ").replace("_", " ")
    return f"{kind}:{text}" if text in _POLICIES else text
