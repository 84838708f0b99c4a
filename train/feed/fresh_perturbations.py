"""Which perturbation was in force in each episode whose rows a ring still holds."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Entries = list[tuple[str, float]]


class FreshPerturbations:
    """Names and values by the ring's key of an episode, for the audit of sampled rows."""

    def __init__(self) -> None:
        self._of: dict[int, tuple[str, str]] = {}  # name, values as JSON

    def note(self, keys: NDArray[np.int64], names: Sequence[str], values: Sequence[str]) -> None:
        """What is in force in the running episodes `keys` (N,)."""
        for place, key in enumerate(keys.tolist()):
            if key not in self._of:
                self._of[key] = str(names[place]), str(values[place])

    def forget(self, kept: NDArray[np.int64]) -> None:
        """Forget episodes without a row: `kept` (n,) are the keys of the ring's rows."""
        if len(self._of) > len(kept) + 1:  # never more than one a row
            alive = set(np.unique(kept).tolist())
            self._of = {key: told for key, told in self._of.items() if key in alive}

    def names(self, keys: NDArray[np.int64]) -> list[str | None]:
        """The name in force in each of these episodes; None where it is not known."""
        return [told[0] if (told := self._of.get(key)) else None for key in keys.tolist()]

    def values(self, keys: NDArray[np.int64]) -> list[Entries | None]:
        """The values that are not nominal, as entries of a map."""
        return [
            values_entries(told[1]) if (told := self._of.get(key)) else None
            for key in keys.tolist()
        ]

    def state_dict(self) -> dict[str, list[str]]:
        """JSON values."""
        return {str(key): list(told) for key, told in self._of.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts it where `state_dict` found it."""
        self._of = {int(key): (name, values) for key, (name, values) in state.items()}


def values_entries(values: str) -> Entries:
    """A JSON object of numbers as the entries of a map column."""
    return [(field, float(value)) for field, value in json.loads(values).items()]
