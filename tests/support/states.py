"""Saved states as a checkpoint keeps them."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np


def through_json(state: Any) -> Any:
    """Arrays and tensors as they are, copied; everything else as JSON."""
    if isinstance(state, np.ndarray):
        return state.copy()
    if hasattr(state, "detach"):
        return state.clone()
    if isinstance(state, dict):
        assert all(isinstance(name, str) for name in state)
        return {name: through_json(value) for name, value in state.items()}
    if isinstance(state, list):
        return [through_json(value) for value in state]
    return json.loads(json.dumps(state))


def leaves(state: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Everything in a state, each with where it is."""
    if isinstance(state, dict):
        for name, value in state.items():
            yield from leaves(value, f"{path}/{name}")
    elif isinstance(state, list):
        for index, value in enumerate(state):
            yield from leaves(value, f"{path}/{index}")
    else:
        yield path, state
