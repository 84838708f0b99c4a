"""Labels under review: their events, in several orders, and how good they are if that is known."""

from __future__ import annotations

import csv
import hashlib
import io
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from datetime import datetime
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from restock.arrays import F64, Bools
from restock.errors import StoreError, spreadsheet_safe
from restock.ingest.store.manifest import LabelScore, label_scores, pooled
from restock.replay.store.definitions import install_named
from restock.replay.store.novelty import at_hand
from restock.replay.store.parquet_views import passed_in
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


def doubtful_events(store: Store, most: int = 10**9) -> list[DoubtfulEvent]:
    """Return the events with the most doubtful labels, the most doubtful first.

    For a condition with a probability, these are events whose mean log odds support the label
    least, and steps without the label that are likely enough to be a missed event. For other
    conditions, they are the shortest events, and gaps of a step or two in one. Corrected events are
    left out.

    Raises:
        StoreError: the store holds no labels to review.
    """
    text = (files("restock.replay.review") / "doubtful.sql").read_text(encoding="utf-8")
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
    writer.writerows({name: spreadsheet_safe(cell) for name, cell in row.items()} for row in rows)
    return text.getvalue()


MAX_EVENTS = 5_000  # in a page
_MORE = """
SELECT event, any_value(r.robot) AS robot, max(novelty) AS novelty
FROM listed
LEFT JOIN (SELECT recording_id, tags['robot'] AS robot FROM recordings) AS r
    ON r.recording_id = listed.recording
{novelty}
GROUP BY event
"""
_NOVELTY = """
LEFT JOIN (
    SELECT episode_id, step_index, novelty FROM transitions JOIN novelty USING (transition_id)
) AS t ON t.episode_id = listed.episode_id AND t.step_index BETWEEN first_step AND last_step
"""


def page_events(store: Store) -> tuple[list[dict[str, Any]], int, bool]:
    """Return the events of a page, how many there are in all, and whether their novelty is known.

    Each has what `DoubtfulEvent` has, its robot, week and novelty, and its place in a random order
    of the labelled events (None: not labelled). That order is of the events' names alone, so the
    first of it are a random sample, whatever their labels are. Of more than MAX_EVENTS a page has
    those that come first in one of the orders.
    """
    events = doubtful_events(store)
    measured = at_hand(store)
    listed = pa.table(
        {
            name: [getattr(event, name) for event in events]
            for name in ("event", "recording", "episode_id", "first_step", "last_step")
        }
    )
    more: dict[str, tuple[Any, ...]] = {}
    if events:
        query = _MORE.format(novelty=_NOVELTY if measured else "")
        if not measured:
            query = query.replace("max(novelty)", "NULL::FLOAT")
        # Both have to be there before the table is passed in.
        store.sql("FROM recordings LIMIT 0")
        store.sql(f"FROM {'novelty' if measured else 'transitions'} LIMIT 0").fetchall()
        with passed_in(store.connection, listed=listed):
            found = store.connection.sql(query).fetchall()
        more = {event: tuple(rest) for event, *rest in found}
    shuffled = sorted(
        (event.event for event in events if event.labelled),
        key=lambda name: hashlib.blake2b(name.encode(), digest_size=16).digest(),
    )
    place = {name: number for number, name in enumerate(shuffled)}
    rows = []
    for doubt, event in enumerate(events):
        robot, novelty = more[event.event]
        year, week, _ = event.start_time.isocalendar()
        rows.append(
            {
                **asdict(event),
                "transition_id": str(event.transition_id),  # JavaScript's numbers are too short
                "start_time": event.start_time.isoformat(sep=" ", timespec="seconds"),
                "end_time": event.end_time.isoformat(sep=" ", timespec="seconds"),
                "doubt": doubt,
                "random": place.get(event.event),
                "novelty": novelty,
                "robot": robot or "",
                "week": f"{year}-W{week:02}",
            }
        )
    share = MAX_EVENTS // 3
    kept = {
        row["event"]
        for order in (
            rows,
            sorted((r for r in rows if r["random"] is not None), key=lambda r: r["random"]),
            sorted(rows, key=lambda row: -(row["novelty"] or 0.0)),
        )
        for row in (rows if len(rows) <= MAX_EVENTS else order[:share])
    }
    return [row for row in rows if row["event"] in kept], len(rows), measured


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
