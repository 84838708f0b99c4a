"""The kinds of missions that the twin stages and scores, one module each.

Every module in this folder that defines `MISSION` is a kind; no other list of kinds exists.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping

from restock.train.twin.missions.mission import NOMINAL, Mission


def _find() -> dict[str, Mission]:
    modules = [
        importlib.import_module(f"{__name__}.{found.name}")
        for found in pkgutil.iter_modules(__path__)
    ]
    kinds = [NOMINAL, *(module.MISSION for module in modules if hasattr(module, "MISSION"))]
    return {kind.name: kind for kind in sorted(kinds, key=lambda kind: (kind.place, kind.name))}


MISSIONS: Mapping[str, Mission] = _find()
KINDS = tuple(MISSIONS)
# Shares by kind of mission: the default in training, and NATURAL, at a site that runs well.
DEFAULT_CONDITIONS: Mapping[str, float] = {name: kind.share for name, kind in MISSIONS.items()}
NATURAL: Mapping[str, float] = {name: kind.natural for name, kind in MISSIONS.items()}
