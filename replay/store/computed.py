"""Tables of a store that Python computes, as table macros beside the views.

Their folders import this one, so it cannot import them: the room's front door says here who
installs them, and a store asks once a query names one.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import partial

# names of macros -> "module:function", which takes the open Store
INSTALLERS: dict[tuple[str, ...], str] = {}


def computed(store: object) -> dict[tuple[str, ...], Callable[[], None]]:
    """What installs the macros of all that registered, on one store."""
    return {names: partial(_install, store, name) for names, name in INSTALLERS.items()}


def _install(store: object, name: str) -> None:
    module, _, function = name.partition(":")
    getattr(importlib.import_module(module), function)(store)
