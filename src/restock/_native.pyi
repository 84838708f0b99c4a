"""Of `compiled/module.c`, whose docstrings say which float32 arrays are read and written."""

from typing import Any

INSTRUCTIONS: str  # AVX-512 or AVX2

class Network:
    def __init__(
        self, widths: tuple[int, ...], eps: float, values: Any, gradient: Any, wide: bool = True
    ) -> None: ...
    def forward(self, inputs: tuple[Any, ...], out: Any, /) -> None: ...
    def backward(self, gradient: Any, /) -> None: ...

def adam(*arrays_and_settings: Any) -> None: ...
def gather(rows: Any, index: Any, out: Any, /) -> None: ...
def find_places(priority: Any, sums: Any, ends: Any, at: Any, out: Any, /) -> None: ...
def ranges(*arrays: Any) -> None: ...
def keep_rows(
    values: tuple[Any, Any, Any, Any],
    logged: tuple[Any, Any],
    logged_to: tuple[Any, ...],
    logged_at: int,
    ring: tuple[Any, ...],
    slots: Any,
    fresh_to: tuple[Any, ...],
    fresh_at: int,
    clocks: tuple[int, int],
    /,
) -> None: ...
def view_plans(
    plans: Any,
    x: Any,
    y: Any,
    cosine: Any,
    sine: Any,
    ahead: Any,
    look_ahead: Any,
    remaining: Any,
    offset: Any,
    /,
) -> None: ...
def find_returns(
    x: Any,
    y: Any,
    clearance: Any,
    plan: Any,
    way: Any,
    gap: Any,
    limits: tuple[float, float, float, float],
    /,
) -> None: ...
def find_came(
    clearance: Any,
    before: Any,
    motions: Any,
    walked: Any,
    cosine: Any,
    sine: Any,
    reach: Any,
    ends: Any,
    came: Any,
    limits: tuple[float, float, float],
    /,
) -> None: ...
