"""A simulator's parameters in force: their name and values, as columns of the store.

A simulator says them once a mission, and they hold for all its steps: a store keeps them as a name
and a map, of which columnar files hold each value about once an episode.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite

import numpy as np
import pyarrow as pa

from restock.arrays import Ints

VALUES = pa.map_(pa.string(), pa.float64())


@dataclass(frozen=True)
class Perturbed:
    """Sets of parameters, and which was in force at each of T places; -1: not known."""

    sets: Sequence[tuple[str, Mapping[str, float]] | None]  # name, values; None: unreadable
    row: Ints  # (T,) of `sets`
    notes: list[str] = field(default_factory=list)

    @classmethod
    def unknown(cls, count: int) -> Perturbed:
        """Return unknown parameters, as hardware has: its friction is unknown."""
        return cls([], np.full(count, -1, np.int64))

    @classmethod
    def read(cls, texts: Sequence[str], row: Ints) -> Perturbed:
        """Parse messages `{"name", "values": {field: number}}`, and keep which holds where."""
        sets = [parse_perturbation(text) for text in texts]
        unread = sum(item is None for item in sets)
        many = "message is" if unread == 1 else "messages are"
        notes = [f'perturbation: {unread} {many} not JSON {{"name", "values": {{field: number}}}}']
        return cls(sets, row, notes if unread else [])

    def columns(self, places: Ints) -> tuple[pa.Array, pa.Array]:
        """`perturbation` and `perturbation_values` at some places (n,)."""
        named = [None if item is None else item[0] for item in self.sets]
        values = [None if item is None else list(item[1].items()) for item in self.sets]
        row = self.row[places]
        chosen = pa.array(row, pa.int64(), mask=row < 0)
        return (
            pa.array(named, pa.string()).take(chosen),
            pa.array(values, VALUES).take(chosen),
        )


def parse_perturbation(text: str) -> tuple[str, dict[str, float]] | None:
    """`{"name": …, "values": {field: number}}` to the two; None where it is something else."""
    try:
        message = json.loads(text)
        name, values = message["name"], message["values"]
        numbers = {field: float(value) for field, value in values.items()}
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return None
    if not isinstance(name, str) or not all(isfinite(value) for value in numbers.values()):
        return None
    return name, numbers
