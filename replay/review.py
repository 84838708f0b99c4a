"""Labels in doubt, listed for review, and the verdicts that people give on them, read back.

A review file is CSV, an event a line, with a verdict to fill in; lines can be written by hand too.
Each line speaks of one condition on some steps of one episode. Everything is checked against the
rows of the store before anything is accepted.
"""

from __future__ import annotations

import csv
import datetime as dt
import io
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import datetime
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from restock.arrays import F64, Bools, Ints
from restock.errors import LabelError, StoreError
from restock.files import first_line
from restock.ingest.relabel import RecordingCorrections
from restock.ingest.store.manifest import Correction, LabelScore, label_scores, pooled
from restock.replay.store.definitions import install_named
from restock.replay.store.store import Store
from restock.stats import NOT_KNOWN, ConfidenceInterval, cluster_counts, percentiles, wilson

LIKELY = 0.2  # from this probability on, steps without a label may be a missed event
EDGE_STEPS = 2  # what is so near to an event is its edge
VERDICT = "verdict"


@dataclass(frozen=True)
class DoubtfulEvent:
    """One event of a label, or steps that may be a missed one. Times are log time, UTC."""

    event: str  # EPISODE/FIRST-LAST/CONDITION
    condition: str
    labelled: bool  # False: it may be missed
    probability: float | None  # mean over its steps; None: the condition has no rule for it
    margin: float  # log odds that the label is right, or what stands for them: doubtful near 0
    why: str  # what the margin is made of: probability, length, gap in an event
    recording: str
    source_file: str
    start_time: datetime
    end_time: datetime
    start_s: float  # seconds after the recording's first step
    end_s: float
    episode_id: str
    first_step: int
    last_step: int
    transition_id: int  # of its first step


_COLUMNS = [field.name for field in fields(DoubtfulEvent) if field.name != "transition_id"]
_COLUMNS += ["open", VERDICT]  # of a review file


def doubtful_events(store: Store, most: int) -> list[DoubtfulEvent]:
    """Return the events with the most doubtful labels, the most doubtful first.

    For a condition with a probability, these are events whose mean log odds support the label
    least, and steps without the label that are likely enough to be a missed event. For other
    conditions, they are the shortest events, and gaps of a step or two in one. Corrected events are
    left out.

    Raises:
        StoreError: the store holds no labels to review.
    """
    text = (files("restock.replay") / "doubtful.sql").read_text(encoding="utf-8")
    given = {"likely": LIKELY, "edge": EDGE_STEPS, "most": most}
    install_named(store.connection, text)
    relation = store.connection.sql(text, params=given)
    events = [DoubtfulEvent(*row) for row in relation.fetchall()]
    if not events and not store.connection.sql("FROM recordings LIMIT 1").fetchall():
        raise StoreError("it holds no recording", where=str(store.path), remedy="ingest some")
    return events


def opened_by(event: DoubtfulEvent, store: str) -> str:
    """Return the command that shows an event's first step.

    It also shows the messages behind that step if the recording is there.
    """
    words = ["restock", "trace", store, str(event.transition_id)]
    if Path(event.source_file).exists():
        words += ["--recording", event.source_file]
    return shlex.join(words)


def review_rows(events: list[DoubtfulEvent], store: str) -> list[dict[str, Any]]:
    """Return the lines of a review file, with a verdict to fill in."""
    rows = []
    for event in events:
        row = asdict(event)
        del row["transition_id"]
        row["labelled"] = "yes" if event.labelled else "no"
        for name, digits in (("probability", 3), ("margin", 2), ("start_s", 3), ("end_s", 3)):
            row[name] = None if row[name] is None else round(row[name], digits)
        for name in ("start_time", "end_time"):
            row[name] = row[name].isoformat(sep=" ", timespec="milliseconds")
        rows.append({**row, "open": opened_by(event, store), VERDICT: ""})
    return rows


def review_csv(rows: list[dict[str, Any]]) -> str:
    """Return a review file."""
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


_YES, _NO = ("yes", "true", "1"), ("no", "false", "0")
_STEP = re.compile(r"[0-9]{1,9}")
_EXTENT = re.compile(r"([0-9]{1,9})\s*(?:\.\.|-)\s*([0-9]{1,9})")
_MOVED_S = 0.1  # by which a step's time may differ from the file's
_MAX_SAID = 10  # problems of a file that are named
_ROWS = """
SELECT
    recording_id, ingest_id, source_file, format, episode_id, episode_index, step_index, logged_ns,
    epoch_ns(logged_start_time) AS recording_start_ns
FROM transitions
JOIN (SELECT ingest_id, format, logged_start_time FROM recordings) USING (ingest_id)
WHERE list_contains($wanted, episode_id) OR list_contains($wanted, recording_id)
    OR list_contains($wanted, source_file)
ORDER BY episode_id, step_index
"""
_CONDITIONS = """
SELECT ingest_id, list(spec.name) FROM (
    SELECT ingest_id, unnest(from_json(conditions_json, '[{"name": "VARCHAR"}]')) AS spec
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
    format: str
    step: Ints  # (N,)
    logged_ns: Ints  # (N,)
    recording_start_ns: int


def read_verdicts(path: Path | str, store: Store) -> Verdicts:
    """Read the corrections that a file gives, every line of it checked.

    Raises:
        LabelError: the file cannot be read, a line names rows or a condition that are not there,
            or two lines contradict each other; names the lines.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise LabelError(f"cannot be read: {first_line(error)}", where=str(path)) from error
    return _Reading(path, store).read(text)


class _Reading:
    """One file, with the problems found so far."""

    def __init__(self, path: Path, store: Store) -> None:
        self.path, self.store = path, store
        self.problems: list[str] = []
        self.left_open = 0

    def read(self, text: str) -> Verdicts:
        verdicts = list(self._lines(text))
        self._refuse()
        episodes = self._episodes(verdicts)
        known = dict(self.store.connection.sql(_CONDITIONS).fetchall())
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
                lines = said.setdefault(key, np.zeros((2, len(episode.step)), np.int64))
                self._contradicted(verdict, episode, lines[int(not value)][rows], rows)
                lines[int(value)][rows] = verdict.line
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
        self._refuse()
        return Verdicts(given, len(verdicts), self.left_open)

    def _problem(self, line: int, what: str) -> None:
        self.problems.append(f"line {line}: {what}")

    def _refuse(self) -> None:
        """Raise LabelError where problems were found."""
        if not self.problems:
            return
        shown = self.problems[:_MAX_SAID]
        if more := len(self.problems) - len(shown):
            shown.append(f"and {more} more")
        raise LabelError(
            "; ".join(shown) if len(shown) == 1 else "\n    ".join(["", *shown]),
            where=str(self.path),
            remedy="correct or remove these lines; `restock store label STORE --review N` lists "
            "events with their present steps",
        )

    def _lines(self, text: str) -> Iterator[Verdict]:
        reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
        try:
            columns = set(reader.fieldnames or ())
            self._check_columns(columns)
            for row in reader:
                said = {name: (row.get(name) or "").strip() for name in columns}
                if verdict := self._line(reader.line_num, said):
                    yield verdict
        except csv.Error as error:
            raise LabelError(
                f"line {reader.line_num}: is not CSV: {error}", where=str(self.path)
            ) from error

    def _check_columns(self, columns: set[str]) -> None:
        """Raise LabelError where a column is missing."""
        needed = (("condition",), ("episode_id", "recording"), ("first_step",), ("last_step",))
        missing = [
            " or ".join(names)
            for names in (*needed, (VERDICT, "value"))
            if not columns & set(names)
        ]
        if missing:
            raise LabelError(
                f"it has no column {', no column '.join(missing)}",
                where=str(self.path),
                remedy="use a file from `restock store label STORE --review N --out FILE`, or "
                "write one with the columns episode_id,condition,first_step,last_step,value",
            )

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
        table = self.store.connection.sql(_ROWS, params={"wanted": wanted}).to_arrow_table()
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
                first["format"],
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
        if episode.format == "twin":
            self._problem(
                verdict.line, "is an episode of the twin, whose true conditions are known"
            )
            return None
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


RESAMPLES = 1000
LABELS, TRUTHS = ("conditions", "exposures"), ("true_condition", "true_exposure")


@dataclass(frozen=True)
class LabelQuality:
    """One condition's labels over some recordings, with 95 % intervals.

    Steps of an episode are not independent: their intervals draw whole episodes. Those of events
    are Wilson's.
    """

    score: LabelScore
    uncertain: float | None  # share of uncertain steps
    precision: ConfidenceInterval  # of steps
    recall: ConfidenceInterval
    event_precision: ConfidenceInterval
    event_recall: ConfidenceInterval


def label_quality(store: Store) -> list[LabelQuality]:
    """Return every condition that was labelled or true, over recordings whose truth is known."""
    recordings = store.sql("SELECT ingest_id, task_hash FROM recordings ORDER BY 1").fetchall()
    names = [name for (name,) in store.sql("SELECT condition FROM conditions").fetchall()]
    periods = {task: store.task(task).control_period_s for task in {task for _, task in recordings}}
    read = [_read(store, ingest_id, names, periods[task]) for ingest_id, task in recordings]
    known = [one for one in read if one is not None]
    rng = np.random.Generator(np.random.PCG64(0))
    scores = pooled(score for one in known for score in one.scores)
    return [_quality(score, known, rng) for score in scores]


@dataclass(frozen=True)
class _Recording:
    """What a recording's rows say of its labels."""

    scores: list[LabelScore]
    # condition -> per episode (E, 4): labelled, support and agreed steps, uncertain ones
    episodes: dict[str, F64]
    reported: bool  # whether its rows say what is uncertain


def _read(store: Store, ingest_id: str, names: Sequence[str], period_s: float) -> _Recording | None:
    """Read the label scores of a recording; None if no true condition is known."""
    rows = store.connection.sql(
        "SELECT episode_index, step_index, conditions, true_condition, uncertain, exposures,"
        " true_exposure FROM transitions WHERE ingest_id = ?"
        " AND coalesce(true_condition, true_exposure) IS NOT NULL"
        " ORDER BY episode_index, step_index",
        params=[ingest_id],
    ).to_arrow_table()
    if not len(rows):
        return None
    scores = label_scores(rows, names, period_s)
    episode = np.unique(rows["episode_index"].to_numpy(), return_inverse=True)[1]
    # Names of the two kinds differ: a set of both says of each what its own column does.
    truth = [
        frozenset(f"{one or ''},{other or ''}".split(","))
        for one, other in zip(*(rows[name].to_pylist() for name in TRUTHS), strict=True)
    ]
    held = [
        frozenset([*(one or ()), *(other or ())])
        for one, other in zip(*(rows[name].to_pylist() for name in LABELS), strict=True)
    ]
    unsure = [frozenset(names or ()) for names in rows["uncertain"].to_pylist()]
    episodes: dict[str, F64] = {}
    for score in scores:
        has, true, doubt = (_has(score.condition, sets) for sets in (held, truth, unsure))
        counted = (has, true, has & true, doubt)
        episodes[score.condition] = np.stack(
            [
                np.bincount(episode, column, episode.max() + 1).astype(np.float64)
                for column in counted
            ],
            axis=1,
        )
    return _Recording(scores, episodes, rows["uncertain"].null_count < len(rows))


def _has(name: str, sets: Sequence[frozenset[str]]) -> Bools:
    return np.array([name in one for one in sets], np.bool_)


def _quality(
    score: LabelScore, recordings: Sequence[_Recording], rng: np.random.Generator
) -> LabelQuality:
    counted = [
        one.episodes[score.condition] for one in recordings if score.condition in one.episodes
    ]
    episodes = np.concatenate(counted).astype(np.float64)  # (E, 4)
    reported = any(one.reported for one in recordings)
    draws = cluster_counts(len(episodes), RESAMPLES, rng) @ episodes  # (R, 4)
    return LabelQuality(
        score,
        float(episodes[:, 3].sum() / score.known) if reported else None,
        _of_steps(score.precision, draws[:, 2], draws[:, 0]),
        _of_steps(score.recall, draws[:, 2], draws[:, 1]),
        _of_events(score.event_right, score.event_labelled),
        _of_events(score.event_found, score.event_support),
    )


def _of_steps(share: float | None, part: F64, whole: F64) -> ConfidenceInterval:
    drawn = part[whole > 0] / whole[whole > 0]
    if share is None or not len(drawn):
        return NOT_KNOWN
    return ConfidenceInterval(share, *percentiles(drawn))


def _of_events(part: int, whole: int) -> ConfidenceInterval:
    return ConfidenceInterval(part / whole, *wilson(part, whole)) if whole else NOT_KNOWN


def reliability(store: Store) -> pa.Table:
    """Return the view `label_reliability`: how often labels of each probability are true."""
    return store.sql("FROM label_reliability").to_arrow_table()


def reliability_rows(bins: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each condition: the true share of steps by tenths of probability."""
    rows: dict[str, dict[str, Any]] = {}
    for one in bins:
        row = rows.setdefault(one["condition"], {"condition": one["condition"]})
        row |= {f"{tenth / 10:g}+": row.get(f"{tenth / 10:g}+", "") for tenth in range(10)}
        row[f"{one['from_probability']:g}+"] = f"{one['true_share']:.2f} of {one['known']:,}"
    return list(rows.values())
