"""The compiled module of `restock/compiled/`: whether it is installed, and whether it is used.

It is built if there is a C compiler, and runs on x86-64 processors with AVX2. It has the update of
a plain network, the gather of a batch and the record of its rows, draws by priority, the twin's
lidar, what robots observe of their plans and of people nearby, and distances to racks and pallets.
Without it, PyTorch, NumPy and MuJoCo compute the same; updates and lidar ranges differ by the
rounding of sums. RESTOCK_NATIVE=0 (or no, false, off) turns it off.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING

SWITCH = "RESTOCK_NATIVE"
_why_not = ""

if TYPE_CHECKING:
    from restock import _native as compiled

    IS_THERE: bool
    IS_USED: bool
else:
    try:
        compiled = import_module("restock._native")
    except ModuleNotFoundError:
        compiled, _why_not = None, "it was not compiled here"
    except ImportError as error:  # it was compiled for another processor
        compiled, _why_not = None, str(error)
    IS_THERE = compiled is not None
    IS_USED = IS_THERE and os.environ.get(SWITCH, "").lower() not in ("0", "no", "false", "off")


def state() -> str:
    """Return whether the compiled module is in use, for people: `in use (AVX-512)`, or why not."""
    if not IS_THERE:
        return f"not in use: {_why_not}"
    if not IS_USED:
        return f"not in use: {SWITCH}={os.environ[SWITCH]}"
    return f"in use ({compiled.INSTRUCTIONS})"


__all__ = ["IS_THERE", "IS_USED", "SWITCH", "compiled", "state"]
