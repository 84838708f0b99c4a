"""The true conditions of a step as text, and labels scored against them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from restock.ingest.task.conditions import NOMINAL

GOOD = 0.8  # precision and recall, for a label to be trusted
# Where a reader needs one true condition: the first of these, then any other by its name.
PRIMARY = ("recovery", "near_collision", "wheel_slip", "blocked_aisle")


def truth_text(names: Iterable[str]) -> str:
    """The true conditions of a step as one text: sorted, commas between; "nominal" for none."""
    return ",".join(sorted(set(names))) or NOMINAL


def true_names(text: str) -> frozenset[str]:
    """The true conditions that a text names: none for "nominal"."""
    named = frozenset(part.strip() for part in text.split(","))
    return named - {NOMINAL, ""}


def primary_of(text: str) -> str:
    """The one condition of a text that names all, for a reader that needs one; or "nominal"."""
    named = true_names(text)
    for name in (*PRIMARY, *sorted(named)):
        if name in named:
            return name
    return NOMINAL


@dataclass(frozen=True)
class LabelScore:
    """One label against the truth, over the transitions whose truth is known."""

    condition: str
    precision: float | None  # None: the label was never given
    recall: float | None  # None: it was never true
    labelled: int  # transitions that got the label
    support: int  # transitions where it is true
    known: int  # transitions whose truth is known

    @property
    def shortfall(self) -> str:
        """By how much it falls short of .8, and from how many rows; "" where it does not."""
        short = [
            f"{name} {GOOD - value:.2f} short of {GOOD}"
            for name, value in (("precision", self.precision), ("recall", self.recall))
            if value is not None and value < GOOD
        ]
        if not short:
            return ""
        rate = self.support / max(self.known, 1)
        return f"{', '.join(short)}; true in {rate:.1%} of steps"


def score(labels: Mapping[str, NDArray[Any]], truth: Sequence[str | None]) -> list[LabelScore]:
    """Labels (N,) by name against the true conditions of each transition (N).

    A text may name several conditions, separated by commas. A label that no truth ever names
    and that was never given is left out; nothing is scored where no truth is known.
    """
    known = np.array([text is not None for text in truth], np.bool_)
    if not known.any():
        return []
    named = [frozenset[str]() if text is None else true_names(text) for text in truth]
    scores = []
    for name, given in labels.items():
        true = np.array([name in names for names in named], np.bool_)
        labelled, support = int((given & known).sum()), int(true.sum())
        both = int((given & true & known).sum())
        if labelled or support:
            scores.append(
                LabelScore(
                    name,
                    both / labelled if labelled else None,
                    both / support if support else None,
                    labelled,
                    support,
                    int(known.sum()),
                )
            )
    return scores


def label_scores(rows: pa.Table, names: Iterable[str]) -> list[LabelScore]:
    """How well every condition of each transition agrees with the true ones, for these labels."""
    given = rows["conditions"].combine_chunks()
    held = np.asarray(pc.list_value_length(given).fill_null(0))
    row, named = np.repeat(np.arange(len(rows)), held), np.asarray(given.flatten(), object)
    labels = {name: np.isin(np.arange(len(rows)), row[named == name]) for name in names}
    return score(labels, rows["true_condition"].to_pylist())
