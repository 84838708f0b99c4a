"""The true conditions of a step as text, and labels scored against them: by step and by event.

An **event** is a maximal run of an episode's consecutive steps that hold a condition. A true event
is found where a step within `TOLERANCE_S` of it has the label; an event of the label is right where
a step within `TOLERANCE_S` of it is true. Steps whose truth is unknown count for neither.

Scores are counts, so that those of several recordings add up: `pooled`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass

import numpy as np
import pyarrow as pa

from restock.arrays import Bools, Ints
from restock.ingest.task.conditions import NOMINAL, held

GOOD = 0.8  # precision and recall, for a label to be trusted
TOLERANCE_S = 0.4  # between an event and what finds it
# Where a reader needs one true condition: the first of these, then any other by its name.
PRIMARY = ("recovery", "near_collision", "wheel_slip", "blocked_aisle")


def truth_text(names: Iterable[str]) -> str:
    """Join a step's true conditions to one text: sorted, commas between; "nominal" for none."""
    return ",".join(sorted(set(names))) or NOMINAL


def true_names(text: str) -> frozenset[str]:
    """Return the true conditions that a text names: none for "nominal"."""
    named = frozenset(part.strip() for part in text.split(","))
    return named - {NOMINAL, ""}


def primary_of(text: str) -> str:
    """Return the one condition of a text that names all, for readers that need one."""
    named = true_names(text)
    for name in (*PRIMARY, *sorted(named)):
        if name in named:
            return name
    return NOMINAL


@dataclass(frozen=True)
class LabelScore:
    """Counts of one label against the truth, over the transitions whose truth is known."""

    condition: str
    known: int  # transitions whose truth is known
    labelled: int  # transitions that got the label
    support: int  # transitions where it is true
    agreed: int  # transitions where it is true and that got the label
    event_labelled: int  # events of the label
    event_right: int  # those of them that are near a true step
    event_support: int  # true events
    event_found: int  # those of them that are near a labelled step

    @property
    def precision(self) -> float | None:
        """Return the share of labelled transitions that truly were; None without a label."""
        return _share(self.agreed, self.labelled)

    @property
    def recall(self) -> float | None:
        """Return the share of true transitions that were labelled; None if it was never true."""
        return _share(self.agreed, self.support)

    @property
    def event_precision(self) -> float | None:
        """Return the share of the label's events that are right; None if there is none."""
        return _share(self.event_right, self.event_labelled)

    @property
    def event_recall(self) -> float | None:
        """Return the share of true events that are found; None if there is none."""
        return _share(self.event_found, self.event_support)

    @property
    def shortfall(self) -> str:
        """Say by how much it falls short of .8, and from how many rows; "" if it does not."""
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

    A text may name several conditions, separated by commas; None is unknown. Transitions are in
    order of their episode (N,) and step (N,), `period_s` apart. A label that no truth ever names
    and that was never given is left out; nothing is scored where no truth is known.
    """
    known = np.array([text is not None for text in truth], np.bool_)
    if not known.any():
        return []
    whole = np.array(["" if text is None else text for text in truth])
    texts, which = np.unique(whole, return_inverse=True)
    named = [true_names(text) for text in texts.tolist()]
    joined = np.zeros(len(known), np.bool_)  # to the step before
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
    """Find maximal runs of consecutive steps that hold, (E, 2): first step and one after last.

    `joined` (N,) says which steps follow the one before in the same episode.
    """
    begins = holds & ~np.concatenate([[False], holds[:-1] & joined[1:]])
    goes_on = np.concatenate([holds[1:] & joined[1:], [False]])
    return np.stack([np.flatnonzero(begins), np.flatnonzero(holds & ~goes_on) + 1], axis=1)


def widened(holds: Bools, joined: Bools, reach: int) -> Bools:
    """Return whether it holds within `reach` steps of each step, in the same stretch, (N,)."""
    wide = holds.copy()
    for _ in range(reach):
        ahead, behind = np.zeros_like(wide), np.zeros_like(wide)
        ahead[1:] = wide[:-1] & joined[1:]
        behind[:-1] = wide[1:] & joined[1:]
        wide = wide | ahead | behind
    return wide


def touched(runs: Ints, holds: Bools) -> Bools:
    """Return which runs (E, 2) have a step that holds, (E,)."""
    total = np.concatenate([[0], np.cumsum(holds)])
    return np.asarray(total[runs[:, 1]] > total[runs[:, 0]], np.bool_)


def label_scores(rows: pa.Table, names: Iterable[str], period_s: float) -> list[LabelScore]:
    """Score how well each transition's conditions agree with the true ones, for these labels.

    `names` are of outcomes; the exposures that a row or the truth names are scored too.
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
    """Return the exposures that labels or truth of rows name, sorted."""
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
