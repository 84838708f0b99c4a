"""Compare labels with a bumper's contacts that they were made without.

A contact is a run of messages in which any of a bumper's fields is pressed; two within a second are
one. The labels come from lidar and odometry: the store must not have the bumper among its inputs,
else a label would be scored by what it is made of.

`near_collision` says that something is within .15 m, of which a touch is one case: that a near
collision ends without a touch is no mistake, and its share with a touch is not a precision.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from restock.errors import StoreError
from restock.ingest.containers.recording import Recording
from restock.ingest.propose.roles import KINDS, usable_topics
from restock.replay import Store
from restock.stats import interval_text, wilson

NS = 1_000_000_000
WITHIN_NS = NS  # a label and a contact so near to each other are of one event
AFTER_NS = 2 * NS  # a recovery lasts at most so long
PARTED_NS = NS  # contacts, or rows with a label, further apart are two events
Spans = list[tuple[int, int]]  # begin and end of each event, log time


@dataclass(frozen=True)
class ContactScore:
    """Counts, each with the Wilson interval of its share; few events say little."""

    contacts: int
    in_rows: int  # with a row within a second: others are beyond what the labels see
    found_by_near_collision: str
    chance: float  # the share of all rows within a second of a near collision
    followed_by_recovery: str
    near_collisions: int  # events
    with_a_contact: str
    least_clearance_m: list[float]  # that the lidar saw, of each contact in rows

    def document(self) -> dict[str, Any]:
        return asdict(self)


def contacts_of(recording: Recording) -> Spans | None:
    """Return the contacts of a recording; None where no bumper can be read."""
    words = KINDS["bumper"][0].words
    pressed: list[int] = []
    read = False
    for name in usable_topics(recording):
        if not any(word in name.lower() for word in words):
            continue
        paths = [
            one.path
            for one in recording.fields(name)
            if one.kind in ("bool", "uint8", "int8") and not one.dims
        ]
        if not paths:
            continue
        columns = recording.read({name: paths})[name]
        down = np.any([np.asarray(columns.fields[path]) > 0 for path in paths], axis=0)
        pressed += columns.log_time_ns[down].tolist()
        read = True
    return events(sorted(pressed)) if read else None


def events(times_ns: Sequence[int]) -> Spans:
    """Return sorted times as runs without a pause longer than PARTED_NS."""
    spans: Spans = []
    for time in times_ns:
        if spans and time - spans[-1][1] <= PARTED_NS:
            spans[-1] = spans[-1][0], time
        else:
            spans.append((time, time))
    return spans


def score_contacts(store: Store, contacts: Mapping[str, Spans]) -> ContactScore:
    """Score the labels of a store's rows against the contacts of each recording (by path).

    Raises:
        StoreError: a label may have been made from the bumper.
    """
    rows = store.sql(
        "SELECT source_file, logged_ns, list_contains(conditions, 'near_collision') AS near,"
        " list_contains(conditions, 'recovery') AS recovery, bumped, clearance_m"
        " FROM transitions ORDER BY source_file, logged_ns"
    ).fetchnumpy()
    if np.asarray(rows["bumped"], np.bool_).any():
        raise StoreError(
            "rows know the bumper: its contacts cannot score their labels",
            where=str(store.path),
            remedy="ingest with a profile without [inputs.bumper]",
        )
    counts = dict.fromkeys(("contacts", "in_rows", "found", "recovered", "near", "touched"), 0)
    close, total = 0, 0
    clearance = []
    for path, touches in contacts.items():
        mine = np.asarray(rows["source_file"], object) == path
        time = np.asarray(rows["logged_ns"])[mine]
        near, recovery = (np.asarray(rows[name], np.bool_)[mine] for name in ("near", "recovery"))
        counts["contacts"] += len(touches)
        for begin, end in touches:
            around = _between(time, begin - WITHIN_NS, end + WITHIN_NS)
            if not around.any():
                continue
            counts["in_rows"] += 1
            counts["found"] += bool(near[around].any())
            counts["recovered"] += bool(recovery[_between(time, begin, end + AFTER_NS)].any())
            seen = np.asarray(rows["clearance_m"], np.float64)[mine][around]
            clearance.append(round(float(seen.min()), 3))
        spans = events(time[near].tolist())
        counts["near"] += len(spans)
        counts["touched"] += sum(
            any(b <= end + WITHIN_NS and e >= begin - WITHIN_NS for b, e in touches)
            for begin, end in spans
        )
        spread = np.zeros(len(time), np.bool_)
        for begin, end in spans:
            spread |= _between(time, begin - WITHIN_NS, end + WITHIN_NS)
        close, total = close + int(spread.sum()), total + len(time)
    return ContactScore(
        counts["contacts"],
        counts["in_rows"],
        share(counts["found"], counts["in_rows"]),
        round(close / total, 4) if total else 0.0,
        share(counts["recovered"], counts["in_rows"]),
        counts["near"],
        share(counts["touched"], counts["near"]),
        clearance,
    )


def share(successes: int, trials: int) -> str:
    """`3 of 5, .60 [.23, .88]`."""
    if not trials:
        return "0 of 0"
    return (
        f"{successes} of {trials}, {interval_text(successes / trials, *wilson(successes, trials))}"
    )


def _between(time: Any, begin: int, end: int) -> Any:
    return (time >= begin) & (time <= end)


__all__ = ["ContactScore", "Spans", "contacts_of", "events", "score_contacts"]
