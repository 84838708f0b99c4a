"""Parameters of which some run with every `make test`, and the others with `make test-long`."""

from collections.abc import Iterable
from typing import Any

import pytest


def one_in(every: int, values: Iterable[Any]) -> list[Any]:
    """Return the first of each `every` values as it is, and the others marked `long`."""
    return [
        value
        if number % every == 0
        else pytest.param(
            *(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.long
        )
        for number, value in enumerate(values)
    ]
