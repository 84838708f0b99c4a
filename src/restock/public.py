"""Public names: each is imported from where it is defined when it is first used.

Each room's `__init__.py` (and `restock.twin`) names what users may rely on; everything deeper is
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
    """Return a face's `__getattr__`, `__dir__` and `__all__` (PEP 562).

    The names are those that its `if TYPE_CHECKING:` block imports as themselves.
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
    """Return the names that a face imports as themselves, by module; nothing is imported for it."""
    source = Path(str(sys.modules[face].__file__)).read_text(encoding="utf-8")
    names_by_module: dict[str, list[str]] = {}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("restock."):
            names = [alias.name for alias in node.names if alias.asname == alias.name]
            if names:
                names_by_module.setdefault(node.module or "", []).extend(names)
    return names_by_module
