"""The registry of mission kinds, found as the modules beside this one."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Mapping

from restock.train.twin.missions.mission import Mission


def _find() -> dict[str, Mission]:
    package = sys.modules[__name__.rpartition(".")[0]]
    names = [found.name for found in pkgutil.iter_modules(package.__path__)]
    modules = [
        importlib.import_module(f"{package.__name__}.{name}")
        for name in names
        if name != "registry"
    ]
    found = [module.MISSION for module in modules if hasattr(module, "MISSION")]
    return {one.name: one for one in sorted(found, key=lambda one: (one.place, one.name))}


MISSIONS: Mapping[str, Mission] = _find()
KINDS = tuple(MISSIONS)
# Shares of episodes in training, and of a site that runs well, if nothing else is requested.
DEFAULT_CONDITIONS: Mapping[str, float] = {name: one.share for name, one in MISSIONS.items()}
NATURAL: Mapping[str, float] = {name: one.natural for name, one in MISSIONS.items()}
