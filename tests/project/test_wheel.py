"""The wheel holds every file of every room, takes no generic name in site-packages, and says which
packages it needs."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import packages_distributions

import pytest
from support.paths import ROOT

NOT_RUNTIME = {"test", "dev", "bench", "fuzz"}
OPTIONAL = {"h5py"}  # a file format that `restock export` asks for by name
SHIPPED = {".py", ".sql", ".toml", ".json", ".jinja", ".typed"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    # A copy, so that the build leaves nothing in the tree (and no stale build/ leaks in).
    tree = tmp_path_factory.mktemp("tree") / "restock"
    ignored = shutil.ignore_patterns(".venv", ".git", "build", "*.egg-info", "__pycache__", ".*")
    shutil.copytree(ROOT, tree, symlinks=True, ignore=ignored)
    out = tmp_path_factory.mktemp("dist")
    done = subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out)],
        cwd=tree,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    (built,) = out.glob("*.whl")
    return zipfile.ZipFile(built)


@pytest.mark.parametrize("room", ["ingest", "replay", "train"])
def test_every_file_of_a_room_is_in_the_wheel(wheel: zipfile.ZipFile, room: str) -> None:
    files = [p for p in (ROOT / room).rglob("*") if p.suffix in SHIPPED and p.is_file()]
    assert files
    missing = {f"restock/{p.relative_to(ROOT).as_posix()}" for p in files} - set(wheel.namelist())
    assert not missing


def test_every_file_of_the_front_door_is_in_the_wheel(wheel: zipfile.ZipFile) -> None:
    front = ROOT / "src"
    links = {front / "restock" / room for room in ("ingest", "replay", "train")}
    files = [
        p
        for p in front.rglob("*")
        if p.suffix in SHIPPED and p.is_file() and not links & set(p.parents)
    ]
    missing = {p.relative_to(front).as_posix() for p in files} - set(wheel.namelist())
    assert not missing


def test_the_wheel_takes_one_top_level_name(wheel: zipfile.ZipFile) -> None:
    top = {name.split("/")[0] for name in wheel.namelist()}
    assert {name for name in top if not name.endswith(".dist-info")} == {"restock"}


def test_every_package_that_is_imported_is_declared() -> None:
    """As a dependency, or in an extra that a user may add."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    lists = [project["dependencies"], *(extras[name] for name in extras if name not in NOT_RUNTIME)]
    names = [re.split(r"[\[<>=~!; ]", item)[0] for items in lists for item in items]
    declared = {name.lower().replace("_", "-") for name in names} | OPTIONAL
    distributions = packages_distributions()
    undeclared = {}
    rooms = [ROOT / room for room in ("ingest", "replay", "train", "src")]
    for path in (path for room in rooms for path in room.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            else:
                modules = [str(node.module)] if isinstance(node, ast.ImportFrom) else []
            for package in {module.split(".")[0] for module in modules}:
                owners = {d.lower().replace("_", "-") for d in distributions.get(package, ())}
                if owners and not owners & (declared | {"restock"}):
                    undeclared[package] = path.relative_to(ROOT).as_posix()
    assert not undeclared
