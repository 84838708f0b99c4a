"""How good labels are, where a simulator says the truth: precision and recall per step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

GOOD = 0.8  # both, for a label to be trusted


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
    """Labels (N,) by name against the true condition of each transition (N).

    A truth may name several conditions, separated by commas. A label that no truth ever names
    and that was never given is left out; nothing is scored where no truth is known.
    """
    known = np.array([text is not None for text in truth], np.bool_)
    if not known.any():
        return []
    named = [
        set() if text is None else {part.strip() for part in text.split(",")} for text in truth
    ]
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
    """How well the one condition of each transition agrees with the true one, for these labels."""
    named = np.array(rows["condition"].to_pylist(), object)
    return score({name: named == name for name in names}, rows["true_condition"].to_pylist())
