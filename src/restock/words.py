"""Text that is made: numbers and nouns in sentences, and what is written into pages."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from pathlib import PurePath

_POLICIES = ("agent", "planner", "operator", "random", "cloned")  # a run's folder is none of them


def plural(number: int, noun: str) -> str:
    """`gap` of 1, else `gaps`."""
    return noun if number == 1 else f"{noun}s"


def counted(number: int, noun: str) -> str:
    """`1 gap`, `1,200 gaps`."""
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
