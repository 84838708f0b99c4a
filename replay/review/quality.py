"""How good labels are, where the truth is known: by step and by event, with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from restock.arrays import F64, Bools
from restock.ingest.store.manifest import LabelScore, label_scores, pooled
from restock.replay.store.store import Store
from restock.stats import NOT_KNOWN, ConfidenceInterval, cluster_counts, percentiles, wilson

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
