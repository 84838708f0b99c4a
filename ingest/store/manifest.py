"""The manifest row of an ingest: what was read, with which definitions, and what came out.

The manifest also has the corrections: labels by people, which override those by rules. A correction
states that one condition holds, or does not hold, on a stretch of an episode. The stretch is stored
as an interval of log time, so that it still fits after the recording was ingested again or labelled
by other rules. Corrections and labels change in one commit. The labels' version then names both:
`RULES+CORRECTIONS`.

If a simulator recorded the true conditions, labels are scored against them, by step and by event.
An **event** is a maximal run of an episode's consecutive steps at which a condition holds. A true
event is found if a step within `TOLERANCE_S` of it has the label. An event of the label is right if
a step within `TOLERANCE_S` of it is true. Steps with unknown truth do not count. Scores are kept as
counts, so that `pooled` can add up several recordings.
"""

from __future__ import annotations

import datetime as dt
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa

from restock.arrays import Bools, Ints
from restock.ingest.containers.recording import Recording
from restock.ingest.profile.profile import Profile, profile_toml
from restock.ingest.steps.episodes import Split, Steps
from restock.ingest.store.transitions import EpisodeRows, Provenance, names_of, replaced
from restock.ingest.task.conditions import (
    NOMINAL,
    Condition,
    held,
    primary,
    signals_named,
    unknown_rows,
)
from restock.ingest.task.schema import true_names
from restock.ingest.task.task import OUTLINE_SIGNALS

UNUSED = "not used by the profile"


@cache
def software_version() -> str:
    """Return Restock's version."""
    try:
        return version("restock")
    except PackageNotFoundError:  # running from a source tree that was never installed
        return "0.0.0+unknown"


def definitions(profile: Profile) -> dict[str, str]:
    """Return hashes and versions of the definitions that rows depend on."""
    return {
        "profile_hash": profile.hash,
        "task_hash": profile.task.hash,
        "labels_version": profile.labels_version,
        "restock_version": software_version(),
    }


def manifest_row(
    profile: Profile,
    provenance: Provenance,
    table: pa.Table,
    scores: Sequence[LabelScore],
    dropped: Mapping[str, int],
    **recorded: Any,
) -> dict[str, Any]:
    """Build the row of `recordings` for these transitions, with the columns of `recording_schema`.

    `dropped` are the numbers of ticks outside episodes, by reason. `recorded` are columns that only
    the source of the steps can fill, such as format, clock, counts and tags.
    """
    drops = sorted(dropped.items(), key=lambda item: (-item[1], item[0]))
    return {
        "recording_id": provenance.recording_id,
        "ingest_id": provenance.ingest_id,
        "ingested_at": dt.datetime.now(dt.UTC),
        "source_file": provenance.source_file,
        "profile": profile.name,
        **definitions(profile),
        "tags": {},
        "transitions": len(table),
        "drops": [{"reason": reason, "count": count} for reason, count in drops],
        "topics": [],
        "stand_ins": [],
        **score_columns(scores),
        "clocks": [],
        "findings": [],
        "signals": [],
        "cameras": [],
        "unknown_conditions": unknown_rows(
            profile.definitions, lidar=profile.task.lidar, driven_plan=driven_plan(table)
        ),
        "uncertain_conditions": uncertain_conditions(profile),
        "corrections": [],
        "task_json": msgspec.json.encode(profile.task).decode(),
        "conditions_json": conditions_json(profile.conditions),
        "exposures_json": conditions_json(profile.exposures),
        "profile_toml": profile_toml(profile),
        **recorded,
    }


def uncertain_conditions(profile: Profile) -> list[str]:
    """Return the conditions and exposures whose labels depend on a guessed robot outline."""
    if profile.robot is None or not profile.robot.outline_guessed:
        return []
    return sorted(signals_named(profile.shown_by_logs(profile.definitions), OUTLINE_SIGNALS))


def driven_plan(rows: pa.Table) -> bool:
    """Return whether a recording's goals were set in hindsight, with the driven path as plan."""
    return (
        "goal_source" in rows.column_names
        and "hindsight" in rows["goal_source"].unique().to_pylist()
    )


def recorded_facts(
    recording: Recording,
    steps: Steps,
    episodes: Split,
    rows: EpisodeRows,
) -> dict[str, Any]:
    """Return the columns that `manifest_row` cannot fill without the recording."""
    stamps, span = steps.signals["stamp_ns"], recording.span_ns or (0, 0)
    return {
        "format": recording.format,
        "integrity": recording.integrity,
        "duration_s": (span[1] - span[0]) * 1e-9,
        "start_stamp_ns": int(stamps.min()),
        "end_stamp_ns": int(stamps.max()),
        "clock": steps.clock.alignment,
        "clock_offset_ns": steps.clock.offset_ns,
        "clock_jumps": steps.clock.jumps,
        "ticks": len(steps),
        "steps": len(np.unique(rows.tick)),
        "episodes": len(episodes.episodes),
        "episode_ends": episodes.ends,
        "topics": topic_rows(recording),
        "stand_ins": [{"input": name, "instead": how} for name, how in steps.stand_ins.items()],
        "clocks": clock_rows(recording, steps),
        "findings": [one.as_row() for one in steps.findings],
        "signals": steps.custom.rows(),
    }


def topic_rows(recording: Recording) -> list[dict[str, Any]]:
    """Return, per topic, the messages in the container, those decoded, and why some were not."""
    rows = []
    for name, info in recording.topics.items():
        account = recording.accounts.get(name)
        reason = info.skipped or UNUSED
        if account is not None:
            reason = "; ".join(f"{why}: {count}" for why, count in account.reasons.items() if count)
        decoded = account.decoded if account is not None else 0
        rows.append(
            {
                "topic": name,
                "type": info.type,
                "expected": info.expected,
                "decoded": decoded,
                "skipped": max(info.expected - decoded, 0),
                "reason": reason,
            }
        )
    return rows


def clock_rows(recording: Recording, steps: Steps) -> list[dict[str, Any]]:
    """Return, per topic, its clocks and how the alignment treated its messages."""
    report = steps.clock
    return [
        {
            **one.as_row(),
            "log_backsteps": recording.accounts[one.topic].log_backsteps,
            "off_clock": report.off_clock.get(one.topic, 0),
            "restamped": report.restamped.get(one.topic, 0),
        }
        for one in steps.clocks
    ]


def score_rows(scores: Sequence[LabelScore]) -> list[dict[str, Any]]:
    """Return precision and recall by step, in the manifest's form."""
    names = ("condition", "precision", "recall", "labelled", "support")
    return [{name: getattr(score, name) for name in names} for score in scores]


def score_columns(scores: Sequence[LabelScore]) -> dict[str, Any]:
    """Return the manifest's label scores, and the counts behind them, which can be summed."""
    return {"label_scores": score_rows(scores), "label_counts": [asdict(one) for one in scores]}


def conditions_json(conditions: Sequence[Condition]) -> str:
    """Return conditions of one kind as the manifest's JSON, without kind and doc."""
    names = ("name", "timing", "priority", "sql", "let", "probability", "uncertain", "constants")
    return msgspec.json.encode(
        [{name: getattr(condition, name) for name in names} for condition in conditions]
    ).decode()


COLUMN = "corrections"  # in `recordings`


@dataclass(frozen=True)
class Correction:
    """A person's verdict that a condition holds, or not, on a stretch of an episode."""

    condition: str
    value: bool  # whether the condition holds there
    episode_index: int  # at `given_at`; needed as log times repeat if a clock was set back
    first_ns: int  # log time of the stretch's first step
    last_ns: int  # log time of the stretch's last step
    given_at: dt.datetime
    rows: int = 0  # number of the recording's rows that the correction covers now


@dataclass(frozen=True)
class Moments:
    """The episode and log time of each row (N,) of a recording."""

    episode_index: Ints
    logged_ns: Ints

    @classmethod
    def of(cls, rows: pa.Table, clock_offset_ns: int | None) -> Moments:
        """Read moments from rows; the manifest's `clock_offset_ns` is log time minus `stamp_ns`."""
        logged = rows["stamp_ns"].to_numpy() + (clock_offset_ns or 0)
        if not rows["logged_ns"].null_count:
            logged = rows["logged_ns"].to_numpy()
        return cls(rows["episode_index"].to_numpy(), logged)

    def covered(self, correction: Correction) -> Bools:
        """Mark rows (N,) in a correction's episode and interval or, if none, in its interval."""
        inside = (self.logged_ns >= correction.first_ns) & (self.logged_ns <= correction.last_ns)
        same = inside & (self.episode_index == correction.episode_index)
        return np.asarray(same if same.any() else inside, np.bool_)

    def stretch(self, rows: Ints) -> tuple[int, int, int]:
        """Return the episode, first and last log time of consecutive rows of one episode."""
        first, last = int(rows[0]), int(rows[-1])
        stamps = self.logged_ns
        return int(self.episode_index[first]), int(stamps[first]), int(stamps[last])


def corrections_in(manifest: Mapping[str, Any]) -> list[Correction]:
    """Read the corrections of a manifest row."""
    return [Correction(**row) for row in manifest[COLUMN]]


def corrected_version(rules: str, corrections: Sequence[Correction]) -> str:
    """Return the version of labels made by rules (of version `rules`) and these corrections."""
    if not corrections:
        return rules
    content = sorted(
        (c.condition, c.value, c.episode_index, c.first_ns, c.last_ns) for c in corrections
    )
    digest = hashlib.blake2b(msgspec.json.encode(content), digest_size=4).hexdigest()
    return f"{rules}+{digest}"


def rules_of(version: str) -> str:
    """Return the part of a labels' version that names the rules."""
    return version.partition("+")[0]


def merged(
    before: Sequence[Correction], given: Sequence[Correction], moments: Moments
) -> list[Correction]:
    """Merge earlier corrections with new ones, which win on rows that both cover."""
    kept: list[Correction] = []
    for old in before:
        covered = moments.covered(old)
        rest = covered.copy()
        for new in given:
            if new.condition == old.condition:
                rest &= ~moments.covered(new)
        if (rest == covered).all():
            kept.append(old)
            continue
        rows = np.flatnonzero(rest)
        for part in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
            if len(part):
                episode, first_ns, last_ns = moments.stretch(part)
                kept.append(replace(old, episode_index=episode, first_ns=first_ns, last_ns=last_ns))
    return [*kept, *given]


def correct_labels(
    rows: pa.Table,
    corrections: Sequence[Correction],
    conditions: Sequence[Condition],
    clock_offset_ns: int | None,
) -> tuple[pa.Table, list[Correction]]:
    """Apply corrections to the labels of a recording's rows.

    Return the rows, and the corrections with the number of rows that each covers now.

    A correction covers no rows if its condition is not among `conditions`, or if its stretch has no
    rows any more. Such a correction is kept, but changes nothing.
    """
    moments, known = Moments.of(rows, clock_offset_ns), [c.name for c in conditions]
    verdicts: dict[str, Ints] = {}  # condition -> (N,) 1: it holds, 0: it does not, -1: no verdict
    counted = []
    for correction in corrections:
        covered = np.zeros(len(rows), np.bool_)
        if correction.condition in known:
            covered = moments.covered(correction)
            values = verdicts.setdefault(correction.condition, np.full(len(rows), -1, np.int64))
            values[covered] = int(correction.value)
        counted.append(replace(correction, rows=int(covered.sum())))
    if verdicts and len(rows):
        rows = _with_labels(rows, verdicts, conditions)
    version = corrected_version(rules_of(rows["labels_version"][0].as_py()), corrections)
    return replaced(rows, {"labels_version": version}), counted


def _with_labels(
    rows: pa.Table, verdicts: Mapping[str, Ints], conditions: Sequence[Condition]
) -> pa.Table:
    labels = held(rows["conditions"], [condition.name for condition in conditions])
    for name, values in verdicts.items():
        labels[name] = np.where(values < 0, labels[name], values > 0)
    every = np.arange(len(rows))
    new: dict[str, Any] = {
        "condition": primary(labels, conditions) or [NOMINAL] * len(rows),
        "conditions": names_of(labels, every),
    }
    open_to_doubt = held(rows["uncertain"], [condition.name for condition in conditions])
    for name, values in verdicts.items():
        open_to_doubt[name] &= values < 0
    new["uncertain"] = names_of(open_to_doubt, every)
    new["probabilities"] = _set_certain(rows["probabilities"].combine_chunks(), verdicts)
    return replaced(rows, new)


def _set_certain(probabilities: pa.MapArray, verdicts: Mapping[str, Ints]) -> pa.MapArray:
    """Set probabilities of corrected conditions to 1 or 0, in rows that have a probability."""
    ends = np.asarray(probabilities.offsets)
    first, count = int(ends[0]), int(ends[-1] - ends[0])
    row = np.repeat(np.arange(len(probabilities)), np.diff(ends))
    keys = probabilities.keys.slice(first, count)
    items = np.array(probabilities.items.slice(first, count), np.float32)
    named = np.asarray(keys, object)
    for name, values in verdicts.items():
        entry = np.flatnonzero(named == name)
        value = values[row[entry]]
        items[entry[value >= 0]] = value[value >= 0]
    made = pa.MapArray.from_arrays(pa.array(ends - first), keys, pa.array(items))
    return made.cast(probabilities.type)


GOOD = 0.8  # least precision and recall of a label that can be trusted
TOLERANCE_S = 0.4  # distance in time up to which an event and a step match


@dataclass(frozen=True)
class LabelScore:
    """Counts of one label against the truth, over the transitions whose truth is known."""

    condition: str
    known: int  # transitions whose truth is known
    labelled: int  # transitions with the label
    support: int  # transitions where the condition is true
    agreed: int  # transitions with the label where the condition is true
    event_labelled: int  # events (runs of steps) with the label
    event_right: int  # events with the label that are near a true step
    event_support: int  # events of the true condition
    event_found: int  # events of the true condition that are near a labelled step

    @property
    def precision(self) -> float | None:
        """Return the share of labels that are true; None if no transition is labelled."""
        return _share(self.agreed, self.labelled)

    @property
    def recall(self) -> float | None:
        """Return the share of `support` that is labelled; None if the condition is never true."""
        return _share(self.agreed, self.support)

    @property
    def event_precision(self) -> float | None:
        """Return the share of the label's events that are right; None without such events."""
        return _share(self.event_right, self.event_labelled)

    @property
    def event_recall(self) -> float | None:
        """Return the share of true events that are found; None without true events."""
        return _share(self.event_found, self.event_support)

    @property
    def shortfall(self) -> str:
        """Describe precision or recall below GOOD, and how often the condition is true, or ""."""
        short = [
            f"{name} {GOOD - value:.2f} short of {GOOD}"
            for name, value in (("precision", self.precision), ("recall", self.recall))
            if value is not None and value < GOOD
        ]
        if not short:
            return ""
        rate = self.support / max(self.known, 1)
        return f"{', '.join(short)}; true in {rate:.1%} of steps"


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def score(
    labels: Mapping[str, Bools],
    truth: Sequence[str | None],
    episode: Ints,
    step: Ints,
    period_s: float,
) -> list[LabelScore]:
    """Score labels (N,) by name against the true conditions of each transition (N,).

    An entry of `truth` names conditions, separated by commas, or is None if unknown. Transitions
    are in order of their episode (N,) and step (N,), `period_s` apart. A label that is never given
    and never true is left out. If no truth is known, there are no scores.
    """
    known = np.array([text is not None for text in truth], np.bool_)
    if not known.any():
        return []
    whole = np.array(["" if text is None else text for text in truth])
    texts, which = np.unique(whole, return_inverse=True)
    named = [true_names(text) for text in texts.tolist()]
    joined = np.zeros(len(known), np.bool_)  # whether a step follows the one before it
    joined[1:] = (episode[1:] == episode[:-1]) & (step[1:] == step[:-1] + 1)
    reach = int(TOLERANCE_S / period_s + 1e-6)  # steps
    scores = []
    for name, given in labels.items():
        true = np.array([name in names for names in named], np.bool_)[which] & known
        labelled = given & known
        if not (labelled.any() or true.any()):
            continue
        given_events, true_events = events(labelled, joined), events(true, joined)
        scores.append(
            LabelScore(
                name,
                int(known.sum()),
                int(labelled.sum()),
                int(true.sum()),
                int((labelled & true).sum()),
                len(given_events),
                int(touched(given_events, widened(true, joined, reach)).sum()),
                len(true_events),
                int(touched(true_events, widened(labelled, joined, reach)).sum()),
            )
        )
    return scores


def events(holds: Bools, joined: Bools) -> Ints:
    """Find maximal runs of consecutive steps that hold, (E, 2): first step and one past the last.

    `joined` (N,) marks the steps that follow the one before in the same episode.
    """
    begins = holds & ~np.concatenate([[False], holds[:-1] & joined[1:]])
    continues = np.concatenate([holds[1:] & joined[1:], [False]])
    return np.stack([np.flatnonzero(begins), np.flatnonzero(holds & ~continues) + 1], axis=1)


def widened(holds: Bools, joined: Bools, reach: int) -> Bools:
    """Return whether `holds` is true within `reach` consecutive steps of each step, (N,)."""
    wide = holds.copy()
    for _ in range(reach):
        ahead, behind = np.zeros_like(wide), np.zeros_like(wide)
        ahead[1:] = wide[:-1] & joined[1:]
        behind[:-1] = wide[1:] & joined[1:]
        wide = wide | ahead | behind
    return wide


def touched(runs: Ints, holds: Bools) -> Bools:
    """Return which runs (E, 2) have a step at which `holds` is true, (E,)."""
    total = np.concatenate([[0], np.cumsum(holds)])
    return np.asarray(total[runs[:, 1]] > total[runs[:, 0]], np.bool_)


def label_scores(rows: pa.Table, names: Iterable[str], period_s: float) -> list[LabelScore]:
    """Score the labels of transitions against the truth.

    `names` are the outcomes to score. Exposures are scored if any row has them as label or truth.
    """
    episode, step = rows["episode_index"].to_numpy(), rows["step_index"].to_numpy()
    scores = []
    for column, truth, requested in (
        ("conditions", "true_condition", list(names)),
        ("exposures", "true_exposure", exposures_named(rows)),
    ):
        if requested:
            labels = held(rows[column], requested)
            scores += score(labels, rows[truth].to_pylist(), episode, step, period_s)
    return scores


def exposures_named(rows: pa.Table) -> list[str]:
    """Return the exposures that any row has as label or truth, sorted."""
    labelled = set(rows["exposures"].combine_chunks().flatten().unique().to_pylist())
    true = rows["true_exposure"].unique().to_pylist()
    return sorted(labelled.union(*(true_names(text) for text in true if text is not None)))


def pooled(scores: Iterable[LabelScore]) -> list[LabelScore]:
    """Add up the scores of several recordings, by condition."""
    sums: dict[str, list[int]] = {}
    for one in scores:
        name, *counts = astuple(one)
        before = sums.get(name, [0] * len(counts))
        sums[name] = [a + b for a, b in zip(before, counts, strict=True)]
    return [LabelScore(name, *counts) for name, counts in sorted(sums.items())]
