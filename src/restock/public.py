"""Public names: imported from where they are defined when asked for, and listed in docs/api.md.

Each room's `__init__.py` (and `restock.twin`) names what users may rely on; everything deeper is
private. `python -m restock.public docs/api.md` writes the page's list again.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from restock.words import between

FACES = (
    "restock",
    "restock.ingest",
    "restock.replay",
    "restock.train",
    "restock.twin",
    "restock.report",
)
BEGIN = "<!-- names: written by `python -m restock.public docs/api.md` -->"
END = "<!-- end of names -->"


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


def markdown() -> str:
    """The list of docs/api.md: each name with its signature and what its docstring says first."""
    parts = []
    for face in FACES:
        tree = _tree(face)
        parts.append(f"## {face}\n\n{_first_paragraph(tree)}\n")
        homes = {name: module for module, names in imported(face).items() for name in names}
        homes |= {
            node.name: face
            for node in tree.body
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
        }
        if face == "restock":
            homes["RestockError"] = "restock.errors"
        for name in sorted(homes, key=str.lower):
            node = next(n for n in _tree(homes[name]).body if getattr(n, "name", "") == name)
            parts.append(_entry(node, homes[name]))
    return "\n".join(parts)


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


def _lineage(node: ast.ClassDef, module: str) -> Iterator[ast.ClassDef]:
    """A class and those of Restock that it inherits from; `Stateful` is told by what it gives."""
    yield node
    came_from = {
        alias.asname or alias.name: imports.module
        for imports in ast.walk(_tree(module))
        if isinstance(imports, ast.ImportFrom) and imports.module
        for alias in imports.names
    }
    for base in map(ast.unparse, node.bases):
        home = came_from.get(base, module)
        if base in ("Stateful", "Checked") or not home.startswith("restock."):
            continue
        found = [one for one in _tree(home).body if isinstance(one, ast.ClassDef)]
        for one in found:
            if one.name == base:
                yield from _lineage(one, home)


def _entry(node: ast.AST, module: str) -> str:
    text = _first_paragraph(node)
    if isinstance(node, ast.FunctionDef):
        return f"### {node.name}\n\n```py\n{_signature(node)}\n```\n\n{text}\n"
    assert isinstance(node, ast.ClassDef)
    lineage = list(_lineage(node, module))
    made = next(filter(None, (_constructor(one, node.name) for one in lineage)), "")
    signature = f"```py\n{made}\n```\n\n" if made else ""
    members: dict[str, ast.FunctionDef] = {}
    for one in lineage:
        for member in one.body:
            if isinstance(member, ast.FunctionDef):
                members.setdefault(member.name, member)
    methods = "".join(
        f"- `{_signature(member, short=True)}`: {_first_paragraph(member)}\n"
        for member in members.values()
        if _is_public(member)
    )
    inherits = any(ast.unparse(base) == "Stateful" for base in node.bases)
    if inherits and "`state_dict()`" not in methods:
        methods += (
            "- `state_dict()`, `load_state_dict(state)`: The state that a checkpoint keeps, as"
            " arrays and JSON values.\n"
        )
    return f"### {node.name}\n\n{signature}{text}\n" + (methods and f"\n{methods}")


def _constructor(node: ast.ClassDef, name: str) -> str:
    """How `name` is made: by the `__init__` of this class, or of its fields; "" without both."""
    for member in node.body:
        if isinstance(member, ast.FunctionDef) and member.name == "__init__":
            return _signature(member, name=name)
    fields = [
        ast.unparse(member)
        for member in node.body
        if isinstance(member, ast.AnnAssign) and "ClassVar" not in ast.unparse(member.annotation)
    ]
    return _wrapped(name, fields, "") if fields else ""


def _is_public(member: ast.FunctionDef) -> bool:
    # A struct's is called where one is made, a `Stateful`'s where one is restored.
    called = member.name in ("check", "restored", "mismatch")
    return not member.name.startswith("_") and not called and bool(ast.get_docstring(member))


def _signature(node: ast.FunctionDef, *, name: str | None = None, short: bool = False) -> str:
    """`name(argument: type = default) -> type`; `short` leaves the types out."""
    decorated = {ast.unparse(decorator) for decorator in node.decorator_list}
    if decorated & {"property", "cached_property", "functools.cached_property"}:
        return node.name
    given = node.args
    defaults = [None] * (len(given.args) - len(given.defaults)) + list(given.defaults)
    words = [_argument(a, d, short) for a, d in zip(given.args, defaults, strict=True)]
    if given.args and given.args[0].arg in ("self", "cls"):
        words = words[1:]
    if given.vararg is not None:
        words.append(f"*{_argument(given.vararg, None, short)}")
    elif given.kwonlyargs:
        words.append("*")
    words += [
        _argument(a, d, short) for a, d in zip(given.kwonlyargs, given.kw_defaults, strict=True)
    ]
    if given.kwarg is not None:
        words.append(f"**{_argument(given.kwarg, None, short)}")
    if short:
        return f"{node.name}({', '.join(words)})"
    returns = "" if name or node.returns is None else f" -> {ast.unparse(node.returns)}"
    return _wrapped(name or node.name, words, returns)


def _argument(argument: ast.arg, default: ast.expr | None, short: bool) -> str:
    kind = "" if short or argument.annotation is None else f": {ast.unparse(argument.annotation)}"
    equals = " = " if kind else "="
    return argument.arg + kind + ("" if default is None else f"{equals}{ast.unparse(default)}")


def _wrapped(name: str, words: Sequence[str], returns: str) -> str:
    line = f"{name}({', '.join(words)}){returns}"
    if len(line) <= 100:
        return line
    return "\n".join([f"{name}(", *(f"    {word}," for word in words), f"){returns}"])


def _first_paragraph(node: ast.AST) -> str:
    text = ast.get_docstring(node) or ""  # type: ignore[arg-type]
    return " ".join(text.split("\n\n")[0].split())


def rewrite(text: str) -> str:
    """A page with the list between its two markers written again."""
    return between(text, BEGIN, END, markdown())


__all__ = ["FACES", "imported", "lazy", "markdown", "rewrite"]


if __name__ == "__main__":
    page = Path(sys.argv[1])
    page.write_text(rewrite(page.read_text(encoding="utf-8")), encoding="utf-8")
