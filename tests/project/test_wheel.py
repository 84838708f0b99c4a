"""The wheel contains every file of every room and declares the packages that it needs."""

import ast
import platform
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import packages_distributions, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from support.paths import ROOT

NOT_RUNTIME = {"test", "dev", "bench", "fuzz"}
OPTIONAL = {"h5py"}  # a file format that `restock export` asks for by name
ROOMS = ("ingest", "replay", "train")
FRONT = ROOT / "src" / "restock"
SHIPPED = {".py", ".sql", ".toml", ".json", ".jinja", ".css", ".js", ".typed"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    # A copy, so that the build leaves nothing in the tree (and no stale build/ leaks in).
    tree = tmp_path_factory.mktemp("tree") / "restock"
    unwanted = (".venv", ".git", "build", "*.egg-info", "__pycache__", ".*", "*.so")
    ignored = shutil.ignore_patterns(*unwanted)
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


@pytest.mark.long
def test_wheel_has_every_file_once(wheel: zipfile.ZipFile) -> None:
    files = {
        f"restock/{path.relative_to(home).as_posix()}"
        for home, folder in [*((ROOT, ROOT / room) for room in ROOMS), (FRONT, FRONT)]
        for path in folder.rglob("*")
        if path.suffix in SHIPPED and path.is_file()
    }
    assert {name.split("/")[1] for name in files} > {*ROOMS, "cli", "report"}
    there = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert not files - there
    assert {name.split("/")[0] for name in there} == {"restock"}


@pytest.mark.long
@pytest.mark.skipif(
    platform.machine() != "x86_64" or not shutil.which("cc"), reason="nothing to compile it with"
)
def test_wheel_has_compiled_module_for_every_python(wheel: zipfile.ZipFile) -> None:
    assert "restock/_native.abi3.so" in wheel.namelist()
    (reported,) = (name for name in wheel.namelist() if name.endswith(".dist-info/WHEEL"))
    assert b"Tag: cp311-abi3-" in wheel.read(reported)


def test_compiled_sources_are_declared() -> None:
    """What is not is missing from the source distribution."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (built,) = project["tool"]["setuptools"]["ext-modules"]
    found = {path.relative_to(ROOT).as_posix() for path in (FRONT / "compiled").iterdir()}
    assert found == {*built["sources"], *built["depends"]}
    assert built["optional"]


def test_imported_packages_are_declared() -> None:
    """As a dependency, or in an extra that a user may add."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    lists = [project["dependencies"], *(extras[name] for name in extras if name not in NOT_RUNTIME)]
    names = [re.split(r"[\[<>=~!; ]", item)[0] for items in lists for item in items]
    declared = {name.lower().replace("_", "-") for name in names} | OPTIONAL
    distributions = packages_distributions()
    undeclared = {}
    rooms = [ROOT / room for room in (*ROOMS, "src")]
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


def installed_with(name: str) -> set[str]:
    """Return a distribution, all that it needs, and what these need in turn."""
    found: set[tuple[str, frozenset[str]]] = set()
    waiting = [Requirement(name)]
    while waiting:
        requested = waiting.pop()
        key = canonicalize_name(requested.name), frozenset(requested.extras)
        if key in found:
            continue
        found.add(key)
        for needed in map(Requirement, requires(requested.name) or ()):
            markers = [{"extra": extra} for extra in ("", *requested.extras)]
            if needed.marker is None or any(map(needed.marker.evaluate, markers)):
                waiting.append(needed)
    return {name for name, _ in found}


WITHOUT = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in absent:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

absent = set(sys.argv[2].split(","))
sys.meta_path.insert(0, Absent())
from restock import open
from restock.cli import main

with open(sys.argv[1]) as store:
    assert store.sql("SELECT ingested_at FROM recordings").fetchall()
    ((row,),) = store.sql("SELECT min(transition_id) FROM transitions").fetchall()
for words in (["sql", sys.argv[1], "FROM recordings"], ["trace", sys.argv[1], str(row)]):
    assert main(words) == 0, words
"""


def test_wheel_reads_a_store_without_extras(store_path: Path) -> None:
    """Block the packages that only the tests' environment has: some imports are optional."""
    there = installed_with("restock")
    absent = [
        package
        for package, owners in packages_distributions().items()
        if not there & set(map(canonicalize_name, owners))
    ]
    assert "pytest" in absent
    command = [sys.executable, "-c", WITHOUT, str(store_path), ",".join(absent)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
