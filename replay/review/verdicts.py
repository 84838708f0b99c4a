"""Verdicts of people on labels, read from a file or a review page and checked against the store.

Each verdict is about one condition on some steps of one episode. All verdicts of a file are checked
against the rows of the store before any is accepted. If two are about the same steps, the later
counts.
"""

from __future__ import annotations

import csv
import datetime as dt
import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from restock.arrays import Ints
from restock.errors import LabelError
from restock.files import first_line
from restock.ingest.relabel import RecordingCorrections
from restock.ingest.store.manifest import Correction
from restock.replay.store.store import Store

_MOVED_S = 0.1  # if a step's time differs by more from that in the file, its rows were replaced
_MAX_PROBLEMS = 10  # largest number of problems that an error message lists
_ROWS = """
SELECT
    recording_id, ingest_id, episode_id, episode_index, step_index, logged_ns,
    epoch_ns(logged_start_time) AS recording_start_ns
FROM transitions
JOIN (SELECT ingest_id, logged_start_time FROM recordings) USING (ingest_id)
WHERE episode_id IN (SELECT unnest($wanted))
ORDER BY episode_id, step_index
"""
CONDITIONS = """
SELECT ingest_id, any_value(recording_id), list(spec.name) FROM (
    SELECT
        ingest_id,
        recording_id,
        unnest(from_json(conditions_json, '[{"name": "VARCHAR"}]')) AS spec
    FROM recordings
) GROUP BY ingest_id
"""
Step = Annotated[int, Meta(ge=0, le=999_999_999)]


class Line(msgspec.Struct, frozen=True, kw_only=True):
    """A verdict as a person gave it, not yet checked against the store."""

    episode_id: str
    condition: str
    first_step: Step
    last_step: Step
    # yes, no, or FIRST..LAST (the steps in which it truly holds); empty: no verdict
    verdict: Annotated[str, Meta(pattern=r"^(yes|no|[0-9]{1,9}\.\.[0-9]{1,9}|)$")] = ""
    start_s: float | None = None  # time of the first step, as it was shown to the person

    def ranges(self) -> list[tuple[int, int, bool]]:
        """Return ranges of steps: first, last, and whether the condition holds there."""
        own = (self.first_step, self.last_step)
        first, dots, last = self.verdict.partition("..")
        if not dots:
            return [(*own, self.verdict == "yes")]
        true = (int(first), int(last))
        rest = [(own[0], min(own[1], true[0] - 1)), (max(own[0], true[1] + 1), own[1])]
        return [(*true, True), *((low, high, False) for low, high in rest if low <= high)]


@dataclass(frozen=True)
class Verdicts:
    """Checked verdicts: the valid ones as corrections, and problems of the others."""

    given: dict[str, RecordingCorrections]  # recording id -> its corrections
    taken: int  # number of valid lines
    problems: dict[int, str]  # line number -> problem
    left_open: int = 0  # number of lines without a verdict


@dataclass(frozen=True)
class _Episode:
    """The rows of one episode to which verdicts were given."""

    recording_id: str
    ingest_id: str
    episode_index: int
    step: Ints  # (N,)
    logged_ns: Ints  # (N,)
    recording_start_ns: int

    def rows(self, first: int, last: int) -> Ints:
        """Return the indices of the steps from `first` to `last`, both included."""
        return np.flatnonzero((self.step >= first) & (self.step <= last))


def read_verdicts(path: Path | str, store: Store) -> Verdicts:
    """Read verdicts from a CSV file, and check every line.

    Raises:
        LabelError: the file cannot be read, or a line does not fit the store.
    """
    path, left_open = Path(path), 0
    lines: list[tuple[int, Line]] = []
    problems: dict[int, str] = {}
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise LabelError(f"cannot be read: {first_line(error)}", where=str(path)) from error
    for number, cells in _rows(text, path):
        if "verdict" not in cells:
            left_open += 1
            continue
        cells["verdict"] = cells["verdict"].lower()
        try:
            lines.append((number, msgspec.convert(cells, Line, strict=False)))
        except msgspec.ValidationError as error:
            problems[number] = str(error)
            if problems[number].endswith("`$.verdict`"):
                problems[number] = f"the verdict {cells['verdict']!r} is not yes, no or FIRST..LAST"
    found = check(lines, store)
    problems |= found.problems
    if problems:
        shown = [f"line {line}: {what}" for line, what in sorted(problems.items())[:_MAX_PROBLEMS]]
        if more := len(problems) - len(shown):
            shown.append(f"and {more} more")
        raise LabelError(
            "; ".join(shown) if len(shown) == 1 else "\n    ".join(["", *shown]),
            where=str(path),
            remedy="correct or remove these lines; `restock review STORE --out FILE.csv` lists "
            "events with their present steps",
        )
    return Verdicts(found.given, found.taken, {}, left_open)


def _rows(text: str, path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the number of each line of a CSV file, and its cells that are not empty."""
    reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
    try:
        columns = reader.fieldnames or ()
        needed = [name for name in Line.__struct_fields__ if name != "start_s"]
        if missing := [name for name in needed if name not in columns]:
            raise LabelError(
                f"it has no column {', no column '.join(missing)}",
                where=str(path),
                remedy="use a file from `restock review STORE --out FILE.csv`, or "
                f"write one with the columns {','.join(needed)}",
            )
        for row in reader:
            cells = {name: (row[name] or "").strip() for name in columns}
            yield reader.line_num, {name: cell for name, cell in cells.items() if cell}
    except csv.Error as error:
        raise LabelError(f"line {reader.line_num}: is not CSV: {error}", where=str(path)) from error


def check(lines: Iterable[tuple[int, Line]], store: Store) -> Verdicts:
    """Check numbered lines against the rows of a store."""
    lines = list(lines)
    episodes = _episodes(store, {line.episode_id for _, line in lines})
    known = {ingest: names for ingest, _, names in store.sql(CONDITIONS).fetchall()}
    now = dt.datetime.now(dt.UTC)
    given: dict[str, RecordingCorrections] = {}
    problems: dict[int, str] = {}
    for number, line in lines:
        episode = episodes.get(line.episode_id)
        if episode is None:
            problems[number] = f"no episode {line.episode_id!r} is in the store"
            continue
        if problem := _problem(line, episode, known[episode.ingest_id]):
            problems[number] = problem
            continue
        entry = given.setdefault(episode.recording_id, RecordingCorrections(episode.ingest_id, []))
        for first, last, value in line.ranges():
            rows = episode.rows(first, last)
            entry.corrections.append(
                Correction(
                    line.condition,
                    value,
                    episode.episode_index,
                    int(episode.logged_ns[rows[0]]),
                    int(episode.logged_ns[rows[-1]]),
                    now,
                )
            )
    return Verdicts(given, len(lines) - len(problems), problems)


def _problem(line: Line, episode: _Episode, conditions: list[str]) -> str:
    """Return how a line does not fit the rows of its episode, or ""."""
    if line.condition not in conditions:
        has = ", ".join(conditions)
        return f"no condition {line.condition!r} labelled that recording: it has {has}"
    stretches = [(line.first_step, line.last_step), *(cells[:2] for cells in line.ranges())]
    if any(first > last for first, last in stretches):
        return f"steps {line.first_step} to {line.last_step}, {line.verdict}: end before they begin"
    first, last = min(low for low, _ in stretches), max(high for _, high in stretches)
    if len(episode.rows(first, last)) != last - first + 1:
        return (
            f"steps {first} to {last} do not all exist: episode {line.episode_id} has "
            f"{episode.step[0]} to {episode.step[-1]}"
        )
    at = episode.rows(line.first_step, line.first_step)[0]
    now_s = (int(episode.logged_ns[at]) - episode.recording_start_ns) / 1e9
    if line.start_s is not None and abs(now_s - line.start_s) > _MOVED_S:
        return (
            f"step {line.first_step} of {line.episode_id} is now at {now_s:.3f} s, and was at"
            f" {line.start_s:.3f} s: the recording was ingested again in the meantime"
        )
    return ""


def _episodes(store: Store, wanted: Iterable[str]) -> dict[str, _Episode]:
    """Return the wanted episodes that are in the store, by id."""
    table = store.connection.sql(_ROWS, params={"wanted": sorted(wanted)}).to_arrow_table()
    names, begins = np.unique(table["episode_id"].to_numpy(), return_index=True)
    ends = [*begins[1:].tolist(), len(table)]
    found = {}
    for name, begin, end in zip(names.tolist(), begins.tolist(), ends, strict=False):
        part = table.slice(begin, end - begin)
        first = part.slice(0, 1).to_pylist()[0]
        found[name] = _Episode(
            first["recording_id"],
            first["ingest_id"],
            first["episode_index"],
            part["step_index"].to_numpy(),
            part["logged_ns"].to_numpy(),
            first["recording_start_ns"],
        )
    return found
