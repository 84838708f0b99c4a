"""Lazy public names: each is imported from its module when it is first used.

The `__init__.py` of each room (and `restock.twin`) lists the public names. All other modules are
private.
"""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

FACES = (
    "restock",
    "restock.ingest",
    "restock.replay",
    "restock.train",
    "restock.twin",
    "restock.report",
)


def lazy(face: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` (PEP 562) for a module with public names.

    The names are the `X as X` imports in the module's `if TYPE_CHECKING:` block.
    """
    homes = {name: module for module, names in imported(face).items() for name in names}

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {face!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(homes[name]), name)
        setattr(sys.modules[face], name, value)
        return value

    return find, lambda: sorted({*vars(sys.modules[face]), *homes}), sorted(homes)


def imported(face: str) -> dict[str, list[str]]:
    """Return module -> names that `face` imports from it as `X as X`; read from its source."""
    source = Path(str(sys.modules[face].__file__)).read_text(encoding="utf-8")
    names_by_module: dict[str, list[str]] = {}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("restock."):
            names = [alias.name for alias in node.names if alias.asname == alias.name]
            if names:
                names_by_module.setdefault(node.module or "", []).extend(names)
    return names_by_module
