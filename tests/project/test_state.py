"""State declared by name: what is saved is what is restored, through JSON and without sharing."""

import json
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from restock.errors import RunError
from restock.state import Stateful, restored, saved


class Point(msgspec.Struct, frozen=True):
    at: tuple[int, int]


@dataclass(frozen=True)
class Score:
    success: dict[str, float]
    best: bool = False


class Inner(Stateful):
    STATE = ("count",)

    def __init__(self) -> None:
        self.count = 0


class Outer(Stateful):
    STATE = ("_values", "inner", "rng", "points", "now", "score", "episodes", "network")
    STATE_TYPES = {  # noqa: RUF012
        "points": list[Point],
        "score": Score | None,
        "episodes": dict[int, tuple[str, str]],
    }

    def __init__(self) -> None:
        self._values: dict[str, Any] = {"a": np.zeros(2, np.float32)}
        self.inner, self.rng = Inner(), np.random.default_rng(0)
        self.points: list[Point] = []
        self.now = Score({"a": 0.0})
        self.score: Score | None = None
        self.episodes: dict[int, tuple[str, str]] = {}
        self.network = torch.nn.Linear(2, 1)
        self.total = 0

    def restored(self) -> None:
        self.total = self.inner.count + len(self.points)


def test_saved_state_is_restored() -> None:
    first, second = Outer(), Outer()
    first._values["a"][:] = 1.5, 2.5
    first.inner.count = 3
    first.rng.random(5)
    first.points = [Point((1, 2)), Point((3, 4))]
    first.now, first.score = Score({"a": 0.5}, best=True), Score({"b": 1.0})
    first.episodes[7] = ("worn", "{}")
    state = first.state_dict()
    network = state.pop("network")
    assert {"values", "inner", "rng", "points", "now", "score", "episodes"} == state.keys()
    first._values["a"][:] = 0  # what was saved is a copy
    kept = first.network.weight.detach().clone()
    torch.nn.init.zeros_(first.network.weight)
    arrays = state.pop("values")
    inner = second.inner
    objects = {"values": arrays, "network": network}
    second.load_state_dict({**json.loads(json.dumps(state)), **objects})
    np.testing.assert_array_equal(second._values["a"], np.float32([1.5, 2.5]))
    assert second._values["a"].dtype == np.float32
    assert second.inner is inner  # objects are changed in place
    assert second.points == first.points
    assert second.total == 5
    assert second.now == first.now
    assert second.score == first.score
    assert second.episodes == first.episodes
    assert torch.equal(second.network.weight, kept)
    assert second.rng.random() == first.rng.random()


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@given(json_values)
def test_plain_values_keep_value_and_type(value: Any) -> None:
    again = restored(value, json.loads(json.dumps(saved(value))))
    assert again == value
    assert type(again) is type(value)


@given(hnp.arrays(hnp.scalar_dtypes(), hnp.array_shapes(min_dims=0, min_side=0)))
def test_arrays_keep_dtype_and_shape(array: np.ndarray[Any, Any]) -> None:
    state = saved(array)
    assert not np.shares_memory(state, array)
    again = restored(np.empty(0, array.dtype), state)
    assert again.dtype == array.dtype
    np.testing.assert_array_equal(again, array)
    assert not np.shares_memory(again, state)


def test_state_of_another_network_names_difference() -> None:
    with pytest.raises(RunError, match=r"of another network: size mismatch for weight.*\n.*give"):
        restored(torch.nn.Linear(3, 1), saved(torch.nn.Linear(2, 1)))


def test_state_without_an_attribute_is_refused() -> None:
    state = Outer().state_dict()
    del state["inner"]
    with pytest.raises(RunError, match="of Outer has no inner: another version") as caught:
        Outer().load_state_dict(state)
    assert "start another run" in str(caught.value.remedy)


def test_nested_objects_are_restored_in_place() -> None:
    class Many(Stateful):
        STATE = ("by_name", "in_turn")

        def __init__(self) -> None:
            self.by_name = {"a": Inner()}
            self.in_turn = [Inner(), Inner()]

    first, second = Many(), Many()
    first.by_name["a"].count, first.in_turn[1].count = 3, 4
    kept = second.by_name["a"], *second.in_turn
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    assert [inner.count for inner in kept] == [3, 0, 4]
    assert (second.by_name["a"], *second.in_turn) == kept


def test_state_of_another_shape_is_refused() -> None:
    class Shaped(Stateful):
        SAME = ("shape", "sizes")
        STATE = ("values",)

        def __init__(self, *sizes: int) -> None:
            self.shape, self.sizes = len(sizes), np.array(sizes)
            self.values: np.ndarray[Any, Any] | None = np.zeros(3)

    one = Shaped(1, 2)
    one.values = None
    other = Shaped(1, 2)
    other.load_state_dict(one.state_dict())
    assert other.values is None
    other.load_state_dict(Shaped(1, 2).state_dict())
    np.testing.assert_array_equal(other.values, np.zeros(3))
    with pytest.raises(ValueError, match=r"another Shaped: sizes \[1 3\]"):
        other.load_state_dict(Shaped(1, 3).state_dict())
    with pytest.raises(ValueError, match=r"another Shaped: shape 3"):
        other.load_state_dict(Shaped(1, 2, 3).state_dict())
    with pytest.raises(ValueError, match=r"another Shaped: shape None"):
        other.load_state_dict({"values": None})


def test_tensors_and_generators_resume() -> None:
    tensor, generator = torch.arange(3), torch.Generator().manual_seed(1)
    state = saved(tensor), saved(generator)
    expected = torch.rand(2, generator=generator)
    tensor += 1
    other = torch.Generator().manual_seed(2)
    assert restored(other, state[1]) is other
    assert torch.equal(torch.rand(2, generator=other), expected)
    again = restored(torch.zeros(0, dtype=torch.int64), state[0])
    assert again.tolist() == [0, 1, 2]
    again += 1
    assert state[0].tolist() == [0, 1, 2]
