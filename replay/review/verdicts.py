"""Verdicts of people on labels, read from a file or a review page and checked against the store.

Each verdict speaks of one condition on some steps of one episode. Everything is checked against the
rows of the store before anything is accepted.
"""

from __future__ import annotations

import csv
import datetime as dt
import io
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from restock.arrays import Ints
from restock.errors import LabelError
from restock.files import first_line
from restock.ingest.relabel import RecordingCorrections
from restock.ingest.store.manifest import Correction
from restock.replay.review.events import VERDICT
from restock.replay.store.store import Store

_YES, _NO = ("yes", "true", "1"), ("no", "false", "0")
_STEP = re.compile(r"[0-9]{1,9}")
_EXTENT = re.compile(r"([0-9]{1,9})\s*(?:\.\.|-)\s*([0-9]{1,9})")
_MOVED_S = 0.1  # by which a step's time may differ from the file's
_MAX_SAID = 10  # problems of a file that are named
_ROWS = """
SELECT
    recording_id, ingest_id, source_file, episode_id, episode_index, step_index, logged_ns,
    epoch_ns(logged_start_time) AS recording_start_ns
FROM transitions
JOIN (SELECT ingest_id, logged_start_time FROM recordings) USING (ingest_id)
WHERE {wanted}
ORDER BY episode_id, step_index
"""
_ANYWHERE = (
    "list_contains($wanted, episode_id) OR list_contains($wanted, recording_id)"
    " OR list_contains($wanted, source_file)"
)
CONDITIONS = """
SELECT ingest_id, any_value(recording_id), list(spec.name) FROM (
    SELECT
        ingest_id,
        recording_id,
        unnest(from_json(conditions_json, '[{"name": "VARCHAR"}]')) AS spec
    FROM recordings
) GROUP BY ingest_id
"""


@dataclass(frozen=True)
class Verdict:
    """One line of the file: as it is written, before it is looked up."""

    line: int
    condition: str
    place: str  # an episode's id, or a recording's id or file
    first_step: int
    last_step: int
    value: bool
    extent: tuple[int, int] | None  # where the event truly is, if that was said
    start_s: float | None  # of its first step, as the file says


@dataclass(frozen=True)
class Verdicts:
    """What a file says, by recording, and how many of its lines are without a verdict."""

    given: dict[str, RecordingCorrections]
    taken: int  # lines
    left_open: int  # lines


@dataclass(frozen=True)
class _Episode:
    """The rows of one episode that is spoken of."""

    recording_id: str
    ingest_id: str
    episode_id: str
    episode_index: int
    step: Ints  # (N,)
    logged_ns: Ints  # (N,)
    recording_start_ns: int


def read_verdicts(path: Path | str, store: Store) -> Verdicts:
    """Read the corrections that a CSV file gives, every line of it checked.

    Raises:
        LabelError: the file cannot be read, a line names rows or a condition that are not there,
            or two lines contradict each other; names the lines.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise LabelError(f"cannot be read: {first_line(error)}", where=str(path)) from error
    reading = Reading(store)
    verdicts = reading.read(_lines(text, path))
    refuse(reading.problems, str(path))
    return verdicts


def refuse(problems: Mapping[int, str], where: str) -> None:
    """Raise LabelError where problems were found, by line."""
    if not problems:
        return
    shown = [f"line {line}: {what}" for line, what in sorted(problems.items())[:_MAX_SAID]]
    if more := len(problems) - len(shown):
        shown.append(f"and {more} more")
    raise LabelError(
        "; ".join(shown) if len(shown) == 1 else "\n    ".join(["", *shown]),
        where=where,
        remedy="correct or remove these lines; `restock review STORE --out FILE.csv` lists "
        "events with their present steps",
    )


def _lines(text: str, path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the lines of a CSV file, by their numbers."""
    reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
    try:
        columns = set(reader.fieldnames or ())
        _check_columns(columns, path)
        for row in reader:
            yield reader.line_num, {name: (row.get(name) or "").strip() for name in columns}
    except csv.Error as error:
        raise LabelError(f"line {reader.line_num}: is not CSV: {error}", where=str(path)) from error


def _check_columns(columns: set[str], path: Path) -> None:
    """Raise LabelError where a column is missing."""
    needed = (("condition",), ("episode_id", "recording"), ("first_step",), ("last_step",))
    missing = [
        " or ".join(names) for names in (*needed, (VERDICT, "value")) if not columns & set(names)
    ]
    if missing:
        raise LabelError(
            f"it has no column {', no column '.join(missing)}",
            where=str(path),
            remedy="use a file from `restock review STORE --out FILE.csv`, or "
            "write one with the columns episode_id,condition,first_step,last_step,value",
        )


class Reading:
    """Lines of verdicts, checked against a store; `problems` are those found, by line."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.problems: dict[int, str] = {}
        self.left_open = 0

    def read(self, lines: Iterable[tuple[int, Mapping[str, str]]]) -> Verdicts:
        """Return what the lines without a problem say."""
        verdicts = [found for line, said in lines if (found := self._line(line, said))]
        episodes = self._episodes(verdicts)
        known = {ingest: names for ingest, _, names in self.store.sql(CONDITIONS).fetchall()}
        now = dt.datetime.now(dt.UTC)
        given: dict[str, RecordingCorrections] = {}
        said: dict[tuple[str, str], Ints] = {}  # episode, condition -> line that spoke of each row
        for verdict in verdicts:
            episode = self._episode_of(verdict, episodes)
            if episode is None:
                continue
            if verdict.condition not in (names := known[episode.ingest_id]):
                self._problem(
                    verdict.line,
                    f"no condition {verdict.condition!r} labelled that recording: it has"
                    f" {', '.join(names)}",
                )
                continue
            for value, rows in self._stretches(verdict, episode):
                key = (episode.episode_id, verdict.condition)
                lines_of = said.setdefault(key, np.zeros((2, len(episode.step)), np.int64))
                self._contradicted(verdict, episode, lines_of[int(not value)][rows], rows)
                lines_of[int(value)][rows] = verdict.line
                entry = given.setdefault(
                    episode.recording_id, RecordingCorrections(episode.ingest_id, [])
                )
                entry.corrections.append(
                    Correction(
                        verdict.condition,
                        value,
                        episode.episode_index,
                        int(episode.logged_ns[rows[0]]),
                        int(episode.logged_ns[rows[-1]]),
                        now,
                    )
                )
        return Verdicts(given, len(verdicts), self.left_open)

    def _problem(self, line: int, what: str) -> None:
        self.problems.setdefault(line, what)

    def _line(self, line: int, said: Mapping[str, str]) -> Verdict | None:
        """Return a line; None where it has no verdict, or a problem."""
        words = {said[name].lower() for name in (VERDICT, "value") if said.get(name)}
        if not words:
            self.left_open += 1
            return None
        word, steps = next(iter(words)), (said["first_step"], said["last_step"])
        extent = _EXTENT.fullmatch(word)
        if len(words) > 1:
            self._problem(line, "verdict and value contradict each other")
        elif word not in (*_YES, *_NO) and not extent:
            self._problem(line, f"the verdict is {word!r}, not yes, no or FIRST..LAST (steps)")
        elif not all(_STEP.fullmatch(step) for step in steps):
            self._problem(line, f"first_step and last_step must be step numbers, got {steps}")
        elif int(steps[0]) > int(steps[1]):
            self._problem(line, f"first_step {steps[0]} is after last_step {steps[1]}")
        elif extent and int(extent[1]) > int(extent[2]):
            self._problem(line, f"the verdict {word} ends before it begins")
        elif not (place := said.get("episode_id") or said.get("recording")):
            self._problem(line, "names neither episode_id nor recording")
        else:
            return Verdict(
                line,
                said["condition"],
                place,
                int(steps[0]),
                int(steps[1]),
                word not in _NO,
                (int(extent[1]), int(extent[2])) if extent else None,
                _number(said.get("start_s", "")),
            )
        return None

    def _episodes(self, verdicts: list[Verdict]) -> dict[str, list[_Episode]]:
        """Return the episodes of each place named in a verdict: an episode id or a recording."""
        wanted = sorted({verdict.place for verdict in verdicts})
        if all("/" in place for place in wanted):  # DuckDB skips the files of other recordings
            rows = _ROWS.format(wanted="episode_id IN (SELECT unnest($wanted))")
        else:
            rows = _ROWS.format(wanted=_ANYWHERE)
        table = self.store.connection.sql(rows, params={"wanted": wanted}).to_arrow_table()
        found: dict[str, list[_Episode]] = {}
        ids = table["episode_id"].to_pylist()
        begins = [row for row in range(len(ids)) if row == 0 or ids[row] != ids[row - 1]]
        ends = [*begins[1:], len(ids)] if ids else []  # none where no verdict is filled in
        for begin, end in zip(begins, ends, strict=True):
            part = table.slice(begin, end - begin)
            first = part.slice(0, 1).to_pylist()[0]
            episode = _Episode(
                first["recording_id"],
                first["ingest_id"],
                first["episode_id"],
                first["episode_index"],
                part["step_index"].to_numpy(),
                part["logged_ns"].to_numpy(),
                first["recording_start_ns"],
            )
            for name in ("episode_id", "recording_id", "source_file"):
                found.setdefault(first[name], []).append(episode)
        return found

    def _episode_of(
        self, verdict: Verdict, episodes: Mapping[str, list[_Episode]]
    ) -> _Episode | None:
        found = episodes.get(verdict.place, [])
        if len(found) != 1:
            self._problem(
                verdict.line,
                f"no episode or recording {verdict.place!r} is in the store"
                if not found
                else f"{verdict.place} has {len(found)} episodes: name the episode_id, one of"
                f" {found[0].episode_id} to {found[-1].episode_id}",
            )
            return None
        episode = found[0]
        first, last = verdict.extent or (verdict.first_step, verdict.last_step)
        first, last = min(first, verdict.first_step), max(last, verdict.last_step)
        if len(_between(episode.step, first, last)) != last - first + 1:
            self._problem(
                verdict.line,
                f"steps {first} to {last} do not all exist: episode {episode.episode_id} has "
                f"{episode.step[0]} to {episode.step[-1]}",
            )
            return None
        if verdict.start_s is not None:
            at = int(np.searchsorted(episode.step, verdict.first_step))
            now_s = (int(episode.logged_ns[at]) - episode.recording_start_ns) / 1e9
            if abs(now_s - verdict.start_s) > _MOVED_S:
                self._problem(
                    verdict.line,
                    f"step {verdict.first_step} of {episode.episode_id} is now at {now_s:.3f} s, "
                    f"and was at {verdict.start_s:.3f} s: the recording was ingested again in the "
                    "meantime",
                )
                return None
        return episode

    def _stretches(self, verdict: Verdict, episode: _Episode) -> Iterator[tuple[bool, Ints]]:
        """Yield what is said of which rows: of the event's own steps, and of those it truly has."""
        own = _between(episode.step, verdict.first_step, verdict.last_step)
        if verdict.extent is None:
            yield verdict.value, own
            return
        true = _between(episode.step, *verdict.extent)
        yield True, true
        rest = np.setdiff1d(own, true)
        for part in np.split(rest, np.flatnonzero(np.diff(rest) > 1) + 1):
            if len(part):
                yield False, part

    def _contradicted(self, verdict: Verdict, episode: _Episode, opposed: Ints, rows: Ints) -> None:
        """Note where another line says the opposite of these rows."""
        if not opposed.any():
            return
        place = int(np.flatnonzero(opposed)[0])
        self._problem(
            verdict.line,
            f"contradicts line {opposed[place]} about {verdict.condition} at step"
            f" {episode.step[rows[place]]} of {episode.episode_id}",
        )


def _between(step: Ints, first: int, last: int) -> Ints:
    return np.flatnonzero((step >= first) & (step <= last))


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
