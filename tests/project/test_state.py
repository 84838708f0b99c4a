"""State declared by name: what is saved is what is restored, through JSON and without sharing."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import numpy as np

from restock.state import Stateful


class Point(msgspec.Struct, frozen=True):
    at: tuple[int, int]


class Inner(Stateful):
    STATE = ("count",)

    def __init__(self) -> None:
        self.count = 0


class Outer(Stateful):
    STATE = ("_values", "inner", "rng", "points")
    STATE_TYPES = {"points": list[Point]}  # noqa: RUF012

    def __init__(self) -> None:
        self._values: dict[str, Any] = {"a": np.zeros(2, np.float32)}
        self.inner, self.rng = Inner(), np.random.default_rng(0)
        self.points: list[Point] = []
        self.total = 0

    def restored(self) -> None:
        self.total = self.inner.count + len(self.points)


def test_what_is_saved_is_what_is_restored() -> None:
    first, second = Outer(), Outer()
    first._values["a"][:] = 1.5, 2.5
    first.inner.count = 3
    first.rng.random(5)
    first.points = [Point((1, 2)), Point((3, 4))]
    state = first.state_dict()
    assert state.keys() == {"values", "inner", "rng", "points"}
    first._values["a"][:] = 0  # what was saved is a copy
    arrays = state.pop("values")
    inner = second.inner
    second.load_state_dict({**json.loads(json.dumps(state)), "values": arrays})
    np.testing.assert_array_equal(second._values["a"], np.float32([1.5, 2.5]))
    assert second._values["a"].dtype == np.float32
    assert second.inner is inner  # objects are changed in place
    assert second.points == first.points
    assert second.total == 5
    assert second.rng.random() == first.rng.random()
