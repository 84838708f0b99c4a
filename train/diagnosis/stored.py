"""Do stored labels and ends follow from the stored signals, by the very rules that made them?

A store keeps the signals that conditions were computed from, so conditions can be computed again,
and so can terminations. A panel is held against the store that it was made from.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa

from restock.arrays import Bools
from restock.errors import ConfigError
from restock.ingest.profile.profile import Profile
from restock.ingest.store.episode_rows import label_table
from restock.ingest.task.conditions import Condition, label
from restock.ingest.task.task import terminated
from restock.replay.store.parquet_views import passed_in
from restock.replay.store.store import Store
from restock.train.diagnosis.evidence import Comparison, not_run, share_judged
from restock.train.diagnosis.fed_rows import MAX_ROWS, FedRows
from restock.train.twin.calibration.logged_steps import LoggedSteps, logged_steps, rows_of

FAR = 0.25  # from a command to its action, in units of the fastest action
COARSE = 0.1  # of the commands, those so far
DIFFERENT = 0.02  # of the rows that have a label, or should
_LABELS = "row's label differs from what its conditions give on the stored signals"
_FED = "row's label in the panel differs from that in its store"
_ENDS = "termination of the row does not agree with its signals"


def stored(
    store: Store, rows: FedRows, profile: Profile, conditions: Sequence[Condition]
) -> Iterator[Comparison]:
    """Commands and actions, labels, and terminations; of whole recordings of some 40,000 rows.

    `conditions` are those of the profile that the stored signals can say; `rows` are of the store.
    """
    yield _far_commands(store, rows.task.hash)
    recordings, left_out = _recordings(store, rows.task.hash, profile.labels_version)
    if not recordings:
        for check, what in (("labels", _LABELS), ("terminations", _ENDS)):
            yield not_run(check, what, left_out)
        return
    steps = logged_steps(store, rows.task.hash, recordings)
    whole = _whole(steps)
    yield from _labels(steps, whole, conditions, left_out)
    yield _terminations(steps, rows)


def fed_labels(store: Store, rows: FedRows) -> Iterator[Comparison]:
    """Of each condition the rows of a panel whose label is not the one in its store."""
    fed = pa.table({"transition_id": rows.transition_id, "fed": rows.condition})
    with passed_in(store.connection, fed=fed):
        found = store.connection.sql(
            "WITH labels AS (SELECT fed, coalesce(primary_condition, '') AS stored"
            " FROM fed JOIN transitions USING (transition_id) WHERE task_hash = ?)"
            " SELECT name, count(*) FILTER (fed <> stored), count(*)"
            " FROM (SELECT fed AS name, fed, stored FROM labels UNION ALL"
            " SELECT stored, fed, stored FROM labels WHERE fed <> stored)"
            " GROUP BY ALL ORDER BY ALL",
            params=[rows.task.hash],
        ).fetchall()
    for name, differ, either in found:
        yield share_judged(f"fed labels: {name}", _FED, differ, either, DIFFERENT)


def _far_commands(store: Store, task_hash: str) -> Comparison:
    ((far, count),) = store.connection.sql(
        "SELECT count(*) FILTER (action_residual > ?), count(action_residual) FROM transitions"
        " WHERE task_hash = ?",
        params=[FAR, task_hash],
    ).fetchall()
    what = "command is far from the action that represents it"
    return share_judged("far commands", what, far, count, COARSE)


def _recordings(store: Store, task_hash: str, version: str) -> tuple[list[str], str]:
    """Recordings that these rules labelled and nobody corrected, and what is said of the others."""
    found = store.connection.sql(
        "SELECT recording_id, labels_version, count(*) FROM transitions WHERE task_hash = ?"
        " GROUP BY ALL ORDER BY ALL",
        params=[task_hash],
    ).fetchall()
    same = [(name, count) for name, labels, count in found if labels == version]
    total = np.cumsum([count for _, count in same])
    chosen = [name for (name, _), sum_ in zip(same, total, strict=True) if sum_ <= MAX_ROWS]
    chosen = chosen or [name for name, _ in same[:1]]
    others = len(found) - len(same)
    note = (
        f"{others} of {len(found)} recordings were labelled with other rules than the profile's, "
        "or corrected by people: `restock store label STORE` updates them"
        if others
        else ""
    )
    return chosen, note


def _whole(steps: LoggedSteps) -> Bools:
    """The rows (N,) of episodes that are stored whole, their end too."""
    ended = np.isin(steps.episode_id, steps.episode_id[steps.ending])
    broken = steps.episode_id[steps.begins & (steps.step_index > 0)]
    return np.asarray(ended & ~np.isin(steps.episode_id, broken), np.bool_)


def _labels(
    steps: LoggedSteps, whole: Bools, conditions: Sequence[Condition], note: str
) -> Iterator[Comparison]:
    if not whole.any():
        yield not_run("labels", _LABELS, "no episode is stored whole")
        return
    kept = np.flatnonzero(whole)
    ends = np.flatnonzero(whole[steps.ending])
    rows = np.concatenate([kept, steps.ending[ends]])
    step = np.concatenate([steps.step_index[kept], steps.step_index[steps.ending[ends]] + 1])
    episode = np.unique(steps.episode_id[rows], return_inverse=True)[1].reshape(-1)
    order = np.lexsort((step, episode))
    of_ends = rows_of(steps.ends, ends)
    signals = {
        name: np.concatenate([column[kept], of_ends[name]])[order]
        for name, column in steps.now.items()
    }
    custom = pa.table({"_": pa.nulls(len(order))}).select([])
    table = label_table(signals, episode[order].astype(np.int64), step[order], custom)
    try:
        again = label(table, list(conditions))
    except ConfigError as error:
        yield not_run("labels", _LABELS, str(error))
        return
    is_row = order < len(kept)
    back = np.argsort(order[is_row])
    for name, holds in again.items():
        now = holds[is_row][back]
        before = steps.conditions.get(name, np.zeros(len(steps), np.bool_))[kept]
        either = int((now | before).sum())
        yield share_judged(
            f"labels: {name}", _LABELS, int((now != before).sum()), either, DIFFERENT, note=note
        )


def _terminations(steps: LoggedSteps, rows: FedRows) -> Comparison:
    place = {number: index for index, number in enumerate(rows.transition_id.tolist())}
    at = np.array([place.get(number, -1) for number in steps.transition_id.tolist()], np.int64)
    known = steps.followed & (at >= 0)
    again = terminated(steps.task, rows_of(steps.after, np.flatnonzero(known)))
    stored_ends = rows.terminated[at[known]]
    either = int((again | stored_ends).sum())
    return share_judged("terminations", _ENDS, int((again != stored_ends).sum()), either, DIFFERENT)


__all__ = ["fed_labels", "stored"]
