"""Tables of a store that Python computes, as table macros beside the views.

Their folders import this one, so it cannot import them: the room's front door says here who
installs them, and a store asks when it opens.
"""

from __future__ import annotations

import importlib

INSTALLERS: list[str] = []  # "module:function" each; the function takes the open Store


def install_computed(store: object) -> None:
    """Install the macros of all that registered."""
    for name in INSTALLERS:
        module, _, function = name.partition(":")
        getattr(importlib.import_module(module), function)(store)
