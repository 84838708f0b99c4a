"""Values as TOML: what is written reads back equal."""

from __future__ import annotations

import math
import tomllib
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from restock.toml import toml_value
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
