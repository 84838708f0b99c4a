"""Which version of a store: a number, or the moment whose newest version it was.

Every commit to a store makes a version of its transitions table; older ones stay readable for as
long as the files they need are kept (`RETENTION_HOURS` after they were replaced).
"""

from __future__ import annotations

import json
import re
from datetime import UTC, datetime
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from deltalake import DeltaTable

from restock.errors import StoreError
from restock.files import first_line

Version = int | datetime
_TIME = r"\d{4}-\d{2}-\d{2}(?:[T ][\d:.,]+(?:Z|[+-]\d{2}:?\d{2})?)?"
LOG = "_delta_log"  # of a table, its folder
_LOGGED = re.compile(r"(\d{20})\.(json|checkpoint\.parquet)")
_SHORT = 1024  # bytes: what a commit of rows says of itself, without a file, is a third of it
_AFTER_AT = re.compile(rf"(?P<path>.+)@(?P<version>\d+|{_TIME})")


def parse_version(text: str) -> Version:
    """`12`, or an ISO 8601 time such as `2026-11-01T08:00Z`; UTC where it names no zone.

    Raises:
        StoreError: it is neither.
    """
    if text.isascii() and text.isdigit():
        return int(text)
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise StoreError(
            f"{text!r} is neither the number of a version nor a time",
            where="--version",
            remedy="give a number such as 12, or a time such as 2026-11-01T08:00Z",
        ) from None
    return moment


def given_version(text: str | None) -> Version | None:
    """What `--version` was given. Raises StoreError as `parse_version` does."""
    return None if text is None else parse_version(text)


def split_version(place: str) -> tuple[str, Version | None]:
    """`store@12` or `store@2026-11-01` as path and version; None where it names none.

    A folder that exists is taken as it is called.
    """
    match = _AFTER_AT.fullmatch(place)
    if match is None or Path(place).exists():
        return place, None
    return match["path"], parse_version(match["version"])


def version_at(table: DeltaTable, moment: datetime, *, where: str) -> int:
    """The newest version of a table that was there at a moment; of UTC where it names no zone.

    Raises:
        StoreError: it was made later.
    """
    moment = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
    # The time that a commit says, not that of its file, which a copy of the store changes.
    made = {
        int(commit["version"]): datetime.fromtimestamp(commit["timestamp"] / 1000, UTC)
        for commit in table.history()
    }
    before = [version for version, at in made.items() if at <= moment]
    if not before:
        first = min(made.values()).isoformat(timespec="milliseconds")
        raise StoreError(
            f"there was no version at {moment.isoformat()}: the first is from {first}", where=where
        )
    return max(before)


def expect_whole(log: Path, version: int, *, where: str) -> None:
    """See that the commits that a version is read from say what they changed.

    Of one that is empty, or cut after what it says of itself, Delta's library says nothing: rows
    would be missing.

    Raises:
        StoreError: one of them does not.
    """
    for number in range(version, -1, -1):
        file = log / f"{number:020}.json"
        try:
            if (log / f"{number:020}.checkpoint.parquet").exists():
                return
            short = file.stat().st_size < _SHORT
            problem = _problem_of_commit(file) if short else None
        except FileNotFoundError:  # of an older version: it is in a checkpoint of another kind
            return
        if problem:
            raise _damaged(file, problem, where, newest=version)


def log_damage(log: Path, *, where: str) -> StoreError | None:
    """The newest file of a log that is missing or cannot be read, as an error that says what to do;
    None where there is none."""
    try:
        found = [match for one in log.iterdir() if (match := _LOGGED.fullmatch(one.name))]
        hinted = _hinted_checkpoint(log)
    except OSError:
        return None
    there = {match[0] for match in found}
    numbers = sorted({int(match[1]) for match in found}, reverse=True)
    for place, number in enumerate(numbers):
        commit, checkpoint = (f"{number:020}.{kind}" for kind in ("json", "checkpoint.parquet"))
        if commit in there and (problem := _problem_of_commit(log / commit)):
            return _damaged(log / commit, problem, where, newest=numbers[0])
        if checkpoint in there or number == hinted:
            if problem := _problem_of_checkpoint(log / checkpoint):
                needless = all(f"{one:020}.json" in there for one in range(number + 1))
                return _damaged(log / checkpoint, problem, where, needless=needless)
        elif (numbers[place + 1] if place + 1 < len(numbers) else -1) != number - 1:
            return _damaged(log / f"{number - 1:020}.json", "is missing", where)
    return None


def _hinted_checkpoint(log: Path) -> int | None:
    """The version of the checkpoint that a reader looks for first."""
    try:
        return int(json.loads((log / "_last_checkpoint").read_bytes())["version"])
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        return None


def _problem_of_commit(file: Path) -> str | None:
    try:
        actions = [json.loads(line) for line in file.read_bytes().splitlines() if line.strip()]
    except (ValueError, RecursionError):
        return "is damaged: it is not lines of JSON"
    if not all(isinstance(action, dict) for action in actions):
        return "is damaged: it is no commit of Delta"
    if not actions:
        return "is empty"
    said = actions[0].get("commitInfo")
    if len(actions) == 1 and isinstance(said, dict):
        ours = str(said.get("operation_name", "")).startswith("restock")
        # Others write commits that change nothing.
        if ours or said.get("operation") in ("ADD COLUMN", "CREATE TABLE"):
            return "is cut: it does not say what it changed"
    return None


def _problem_of_checkpoint(file: Path) -> str | None:
    try:
        for _ in pq.ParquetFile(file).iter_batches():
            pass
    except FileNotFoundError:
        return "is missing"
    except (OSError, pa.ArrowException) as error:
        return f"cannot be read: {first_line(error)}"
    return None


def _damaged(
    file: Path, problem: str, where: str, *, newest: int | None = None, needless: bool = False
) -> StoreError:
    """`newest` is the number of the last commit; a checkpoint is `needless` where all commits
    before it are there."""
    remedy = "where there is none, ingest the recordings into a new store"
    if newest is not None and file.stem == f"{newest:020}":
        remedy = (
            "or delete it: the store is then as it was before this commit, which is the last; then"
            " run again the command that made it"
        )
    elif needless:
        remedy = "or delete it and _last_checkpoint beside it: the commits say the same"
    table = file.parent.parent.name
    return StoreError(
        f"its file {table}/{LOG}/{file.name} {problem}",
        where=where,
        remedy=f"restore it from a copy{'; ' if remedy.startswith('where') else ', '}{remedy}",
    )
