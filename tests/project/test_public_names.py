"""Public names: cheap to import, never shadowed, and all that docs teach."""

import ast
import importlib
import inspect
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.paths import ROOT

from restock.public import FACES, imported

PAGES = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md"]
EXAMPLES = sorted((ROOT / "docs" / "examples").glob("*.py"))
ROOMS = [face for face in FACES if face not in ("restock", "restock.report")]
# Made by an `open` of their own.
HOLD_PATHS = {"Panel", "Run"}
# What a path may begin with, and the names that may follow.
KNOWN = {face: set(importlib.import_module(face).__all__) for face in FACES}
KNOWN["restock"] |= {"ingest", "replay", "report", "train", "twin", "errors", "public"}


def python(code: str) -> str:
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_importing_rooms_loads_no_heavy_library() -> None:
    heavy = "{'torch', 'mujoco', 'duckdb', 'pyarrow', 'altair', 'msgspec', 'gymnasium'}"
    names = ", ".join(["restock", *ROOMS])
    assert python(f"import sys, {names}; print({heavy} & set(sys.modules))") == "set()"


@pytest.mark.parametrize("face", [*ROOMS, "restock.report"])
def test_functions_take_paths_as_text(face: str) -> None:
    """A notebook has its paths as text: one function that takes no text is one to remember."""
    module, only_paths = importlib.import_module(face), []
    for name in module.__all__:
        value = getattr(module, name)
        asks = [] if name in HOLD_PATHS else [value]
        asks += [getattr(value, way) for way in ("open", "create") if hasattr(value, way)]
        for ask in filter(callable, asks):
            for argument in inspect.signature(ask).parameters.values():
                words = set(re.findall(r"\w+", str(argument.annotation)))
                if "Path" in words and "str" not in words:
                    only_paths.append(f"{name}({argument})")
    assert not only_paths


@pytest.mark.parametrize("face", ROOMS)
def test_lazy_names_equal_what_type_checkers_see(face: str) -> None:
    if face == "restock.train":  # which has names for its learners
        pytest.importorskip("stable_baselines3")
    module = importlib.import_module(face)
    seen = imported(face)
    assert sorted(name for names in seen.values() for name in names) == module.__all__
    for home, names in seen.items():
        for name in names:
            value = getattr(module, name)
            assert value is getattr(importlib.import_module(home), name)
            assert getattr(value, "__module__", home) == home, f"{name} is not defined there"
            assert value.__doc__
            assert name in dir(module)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        module.nothing  # noqa: B018


@pytest.mark.parametrize("path", [*PAGES, *EXAMPLES], ids=lambda path: path.name)
def test_docs_teach_public_names_only(path: Path) -> None:
    text = re.sub(r"<!--.*?-->", "", path.read_text(encoding="utf-8"))
    for found in re.finditer(r"\brestock((?:\.[A-Za-z_]\w*)+)", text):
        assert public(found[1][1:].split(".")), found[0]
    for block in blocks(path, text):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("restock"):
                assert {alias.name for alias in node.names} <= KNOWN[node.module or ""]


def public(parts: list[str]) -> bool:
    """`ingest`, `ingest.load_profile`, `replay.Panel.open`; `restock.json` is a file."""
    if parts[0] not in KNOWN["restock"]:
        return parts[-1] in ("bash", "html", "json", "toml")
    return len(parts) == 1 or parts[0] == "errors" or parts[1] in KNOWN[f"restock.{parts[0]}"]


def blocks(path: Path, text: str) -> Iterator[str]:
    """Yield the Python of a file, or of a page's blocks (those of shells do not import)."""
    if path.suffix == ".py":
        yield text
        return
    yield from re.findall(r"```python\n(.*?)```", text, re.S)
    for block in re.findall(r"(?:^(?:    .*)?\n)+", text, re.M):
        if re.match(r"\s*(import|from) ", block):
            yield textwrap.dedent(block)


@pytest.mark.parametrize("path", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=lambda path: path.name)
def test_files_named_in_docs_exist(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    folders = "benchmarks|docs|fuzz|ingest|replay|sample_logs|src|tests|train"
    for name in re.findall(
        rf"(?<![\w/.])((?:{folders})/[\w/.-]*\.(?:py|sql|toml|md|json))\b", text
    ):
        assert (ROOT / name).is_file(), name
    for name in re.findall(r"\]\(([\w/.-]+\.\w+)(?:#[\w-]+)?\)", text):
        assert (path.parent / name).is_file(), name


def test_every_page_is_linked() -> None:
    linked = {
        name.rsplit("/", 1)[-1]
        for path in PAGES
        for name in re.findall(r"\]\(([\w/.-]+\.md)", path.read_text(encoding="utf-8"))
        if name.rsplit("/", 1)[-1] != path.name
    }
    assert {path.name for path in PAGES if path.name != "README.md"} <= linked
