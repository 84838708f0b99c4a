"""Public names: each is imported from where it is defined when it is first used.

Each room's `__init__.py` (and `restock.twin`) names what users may rely on; everything deeper is
private.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import sys
from collections.abc import Callable, Mapping, Sequence
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


def lazy(
    face: str, names: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """A face's `__getattr__`, `__dir__` and `__all__` (PEP 562).

    Args:
        face: the module's name.
        names: module -> the names that it defines.
    """
    homes = {name: module for module, defined in names.items() for name in defined}

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {face!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(homes[name]), name)
        setattr(sys.modules[face], name, value)
        return value

    return find, lambda: sorted({*vars(sys.modules[face]), *homes}), sorted(homes)


def imported(face: str) -> dict[str, list[str]]:
    """What type checkers see of a face: module -> names. It must be what `lazy` is given."""
    names_by_module: dict[str, list[str]] = {}
    for node in ast.walk(_tree(face)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("restock."):
            names = [alias.name for alias in node.names if alias.asname == alias.name]
            if names:
                names_by_module.setdefault(node.module or "", []).extend(names)
    return names_by_module


@functools.cache
def _tree(module: str) -> ast.Module:
    """A module's source: nothing is imported, for what a face names may need extras."""
    spec = importlib.util.find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    return ast.parse(Path(spec.origin).read_text(encoding="utf-8"))


__all__ = ["FACES", "imported", "lazy"]
