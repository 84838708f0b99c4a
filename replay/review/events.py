"""The events of labels to review, in order of doubt or at random."""

from __future__ import annotations

import csv
import hashlib
import io
import shlex
from dataclasses import asdict, dataclass, fields
from datetime import datetime
from importlib.resources import files
from pathlib import Path
from typing import Any

from restock.errors import StoreError, spreadsheet_safe
from restock.replay.store.definitions import install_named
from restock.replay.store.store import Store

LIKELY = 0.2  # steps without a label and at least this probability may be a missed event
EDGE_STEPS = 2  # unlabelled steps this close to a labelled event are no missed event


@dataclass(frozen=True)
class DoubtfulEvent:
    """Successive steps with a label, or steps that may be a missed event. Times: log time, UTC."""

    event: str  # EPISODE/FIRST-LAST/CONDITION
    condition: str
    labelled: bool  # False: a possible missed event
    probability: float | None  # mean over its steps; None: the condition has no probability
    margin: float  # log odds that the label is right, or log2 of the event's steps; small: doubtful
    why: str  # what the margin is computed from: probability, or length in steps
    recording: str
    source_file: str
    start_time: datetime
    end_time: datetime
    start_s: float  # seconds after the recording's first step
    end_s: float
    episode_id: str
    first_step: int
    last_step: int
    transition_id: int  # id of the event's first step


_COLUMNS = [field.name for field in fields(DoubtfulEvent) if field.name != "transition_id"]
_COLUMNS += ["open", "verdict"]  # columns of a review file


def doubtful_events(store: Store, most: int = 10**9) -> list[DoubtfulEvent]:
    """Return up to `most` events, the most doubtful label first.

    Labels of a condition with a probability are the more doubtful the less the mean log odds of
    their steps support them; steps without the label may be missed events. Labels of other
    conditions are the more doubtful the shorter their events. Corrected events are left out.

    Raises:
        StoreError: the store has no recordings.
    """
    text = (files("restock.replay.review") / "doubtful.sql").read_text(encoding="utf-8")
    given = {"likely": LIKELY, "edge": EDGE_STEPS, "most": most}
    install_named(store.connection, text)
    relation = store.connection.sql(text, params=given)
    events = [DoubtfulEvent(*row) for row in relation.fetchall()]
    if not events and not store.connection.sql("FROM recordings LIMIT 1").fetchall():
        raise StoreError("it holds no recording", where=str(store.path), remedy="ingest some")
    return events


def trace_command(event: DoubtfulEvent, store: str) -> str:
    """Return the command that shows an event's first step.

    It also shows the messages of that step if the recording still exists.
    """
    words = ["restock", "trace", store, str(event.transition_id)]
    if Path(event.source_file).exists():
        words += ["--recording", event.source_file]
    return shlex.join(words)


def review_rows(events: list[DoubtfulEvent], store: str) -> list[dict[str, Any]]:
    """Return the rows of a review file, with an empty verdict."""
    rows = []
    for event in events:
        row = asdict(event)
        del row["transition_id"]
        row["labelled"] = "yes" if event.labelled else "no"
        for name, digits in (("probability", 3), ("margin", 2), ("start_s", 3), ("end_s", 3)):
            row[name] = None if row[name] is None else round(row[name], digits)
        for name in ("start_time", "end_time"):
            row[name] = row[name].isoformat(sep=" ", timespec="milliseconds")
        rows.append({**row, "open": trace_command(event, store), "verdict": ""})
    return rows


def review_csv(rows: list[dict[str, Any]]) -> str:
    """Return the text of a review file."""
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: spreadsheet_safe(cell) for name, cell in row.items()} for row in rows)
    return text.getvalue()


MAX_EVENTS = 5_000  # largest number of events on a page
_HALF = MAX_EVENTS // 2


def page_events(store: Store) -> tuple[list[dict[str, Any]], int]:
    """Return the events of a page, and how many events the store has in all.

    Each has the fields of `DoubtfulEvent`, its robot and week, its place in the order of doubt, and
    its place in a random order of the labelled events (None: not labelled), which depends only on
    the events' names. If there are more than MAX_EVENTS, the page has the events that come first in
    one of the two orders.
    """
    events = doubtful_events(store)
    robots = dict(store.sql("SELECT recording_id, tags['robot'] FROM recordings").fetchall())
    shuffled = sorted(
        (event.event for event in events if event.labelled),
        key=lambda name: hashlib.blake2b(name.encode(), digest_size=16).digest(),
    )
    place = {name: number for number, name in enumerate(shuffled)}
    rows = []
    for doubt, event in enumerate(events):
        at = place.get(event.event)
        if len(events) > MAX_EVENTS and min(doubt, len(events) if at is None else at) >= _HALF:
            continue
        year, week, _ = event.start_time.isocalendar()
        rows.append(
            {
                **asdict(event),
                "transition_id": str(event.transition_id),  # too long for a JavaScript number
                "start_time": event.start_time.isoformat(sep=" ", timespec="seconds"),
                "end_time": event.end_time.isoformat(sep=" ", timespec="seconds"),
                "doubt": doubt,
                "random": at,
                "robot": robots.get(event.recording) or "",
                "week": f"{year}-W{week:02}",
            }
        )
    return rows, len(events)
