"""Libraries that are optional or slow to import, and what to do once one is imported."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from restock.errors import ConfigError


def import_extra(
    name: str, extra: str, use: str, *, where: str | None = None, instead: str | None = None
) -> Any:
    """Import the module `name` of one of Restock's optional extras.

    `use` is a sentence ("a policy is exported with onnx"); `instead` is what does without it.

    Raises:
        ConfigError: it cannot be imported; says which extra has it.
    """
    try:
        return import_module(name)
    except ImportError as error:
        remedy = install_command(extra) + (f", or {instead}" if instead else "")
        raise ConfigError(
            f"{use}, which is not installed ({error})", where=where, remedy=remedy
        ) from error


def install_command(extra: str = "") -> str:
    """Return the pip command that adds an extra, or a missing requirement, to this Restock."""
    import json
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        origin = json.loads(distribution("restock").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:  # imported from a path
        origin = {}
    extras = f"[{extra}]" if extra else ""
    if origin.get("dir_info", {}).get("editable"):
        return f"pip install -e '.{extras}' in the source tree"
    return f"pip install 'restock{extras}'"


def installed(name: str) -> bool:
    """Return whether the module `name` can be imported, without importing it."""
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # the entry in its place has no spec: it was blocked
        return False


def when_imported(name: str, action: Callable[[], None]) -> None:
    """Call `action` once the module `name` is imported: now, or right after its import."""
    if name in sys.modules:
        action()
    else:
        sys.meta_path.insert(0, _After(name, action))


class _After:
    """A finder that finds one module as the others do, and has its loader do something more."""

    def __init__(self, name: str, action: Callable[[], None]) -> None:
        self.name, self.action = name, action

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != self.name:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is None or spec.loader is None:
            return None
        execute = spec.loader.exec_module

        def exec_module(module: ModuleType) -> None:
            execute(module)
            self.action()

        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


@contextmanager
def hidden(name: str) -> Iterator[None]:
    """Hide the module `name` from imports in this block, unless it is imported already."""
    finder = _Hides(name)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


class _Hides:
    def __init__(self, name: str) -> None:
        self.name = name

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name == self.name:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None


__all__ = ["hidden", "import_extra", "install_command", "installed", "when_imported"]
