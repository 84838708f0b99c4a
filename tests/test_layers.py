"""Imports run train -> replay -> ingest; nothing below imports the front door's verbs."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAY_IMPORT = {
    "ingest": {"restock.ingest", "restock.errors"},
    "replay": {"restock.ingest", "restock.replay", "restock.errors"},
    "train": {"restock.ingest", "restock.replay", "restock.train", "restock.errors"},
}


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the layer they cross"
            found.add(node.module or "")
            if node.module == "restock":
                found |= {f"restock.{alias.name}" for alias in node.names}
    return {name for name in found if name.split(".")[0] == "restock"}


@pytest.mark.parametrize("room", sorted(MAY_IMPORT))
def test_a_room_imports_only_itself_and_the_rooms_before_it(room: str) -> None:
    files = sorted((ROOT / room).rglob("*.py"))
    assert files
    for path in files:
        for name in imports(path) - {"restock", "restock.__version__"}:
            allowed = any(name == a or name.startswith(a + ".") for a in MAY_IMPORT[room])
            assert allowed, f"{path.relative_to(ROOT)} imports {name}"


@pytest.mark.parametrize("room", sorted(MAY_IMPORT))
def test_the_front_door_reaches_each_room_by_a_committed_symlink(room: str) -> None:
    link = ROOT / "src" / "restock" / room
    assert link.is_symlink()
    assert link.resolve() == ROOT / room
