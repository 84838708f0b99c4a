"""Values as TOML: what is written reads back equal; ranges hold, and errors name the key."""

from __future__ import annotations

import math
import tomllib
from typing import Annotated, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta

from restock.errors import ConfigError
from restock.toml import Checked, toml_value, typed
from restock.train.dqn.config import apply_overrides, as_overrides

plain = st.recursive(
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8")),
    lambda inner: (
        st.lists(inner) | st.dictionaries(st.text("abc_1", min_size=1), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(plain)
def test_a_value_reads_back_equal(value: Any) -> None:
    assert tomllib.loads(f"key = {toml_value(value)}")["key"] == value


def test_what_is_no_number_reads_back_so() -> None:
    assert math.isnan(tomllib.loads(f"key = {toml_value(math.nan)}")["key"])


def test_a_setting_keeps_letters_beyond_16_bits() -> None:
    settings = {"env": {"layouts": "halls/\U0001f4e6.toml"}}
    assert apply_overrides({}, as_overrides(settings)) == settings


Part = Annotated[float, Meta(ge=0, le=1)]


class Points(Checked, frozen=True):
    points: tuple[tuple[int, Part], ...]


class Whole(Checked, frozen=True):
    at: dict[str, Points | Part]


def test_the_range_of_a_part_of_a_tuple_holds_from_python_and_from_a_file() -> None:
    with pytest.raises(ValueError, match=r"^points\[1\]\[1\] must be in \[0, 1\], got 1\.5$"):
        Points(points=((0, 0.5), (1, 1.5)))
    document = {"at": {"a": {"points": [[0, 0.5], [1, 1.5]]}}}
    with pytest.raises(ConfigError, match=r"at\.a\.points\[1\]\[1\] must be in \[0, 1\], got 1\.5"):
        typed(document, Whole, where="test")
    assert typed({"at": {"b": 0.5}}, Whole, where="test").at == {"b": 0.5}
