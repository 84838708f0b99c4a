"""The house does not grow: the counts of CONTRIBUTING.md's table are not exceeded."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterable
from pathlib import Path

import pytest
from support.paths import ROOT

from restock.cli import VERBS
from restock.public import FACES

PRODUCT = [
    path
    for room in ("ingest", "replay", "train", "src")
    for path in sorted((ROOT / room).rglob("*"))
    if path.suffix in {".py", ".sql", ".c", ".h", ".pyi"} and "egg-info" not in str(path)
]
TABLE = re.findall(r"^\| ([\w ]+) \| ([\d,]+) \|$", (ROOT / "CONTRIBUTING.md").read_text(), re.M)
LIMITS = {name: int(limit.replace(",", "")) for name, limit in TABLE}


def count_lines(paths: Iterable[Path]) -> int:
    return sum(path.read_text(encoding="utf-8").count("\n") for path in paths)


def count_all() -> dict[str, int]:
    pages = [path for kind in ("*.md", "*.ipynb") for path in (ROOT / "docs").glob(kind)]
    names = [importlib.import_module(face).__all__ for face in FACES if face != "restock"]
    return {
        "product lines": count_lines(PRODUCT),
        "product modules": sum(path.suffix == ".py" for path in PRODUCT),
        "test lines": count_lines((ROOT / "tests").rglob("*.py")),
        "documentation pages": len(pages),
        "verbs": len(VERBS),
        "public names": sum(map(len, names)),
        "README lines": count_lines([ROOT / "README.md"]),
        "changelog lines": count_lines([ROOT / "CHANGELOG.md"]),
    }


@pytest.mark.parametrize("name", LIMITS)
def test_a_count_is_within_its_limit(name: str) -> None:
    assert count_all()[name] <= LIMITS[name]


def test_every_count_has_a_limit() -> None:
    assert count_all().keys() == LIMITS.keys()
