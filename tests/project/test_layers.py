"""The house: which folder may import which, each with one purpose, none too full, no cycles.

Every import counts, those in functions and under TYPE_CHECKING too. All may import `restock`'s own
modules (errors, files, state, statistics, TOML), which import nothing but each other.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from support.paths import ROOT

MOST_MODULES = 15
SHARED = {"errors", "files", "state", "stats", "toml"}
MAY_IMPORT = {
    "ingest": "containers profile steps store task",
    "ingest/decoding": "",
    "ingest/containers": "decoding",
    "ingest/task": "",
    "ingest/profile": "decoding task",
    "ingest/propose": "containers decoding profile steps",
    "ingest/steps": "containers decoding profile task",
    "ingest/store": "containers decoding profile steps task",
    "replay": "panel store ingest/store",
    "replay/store": "ingest/store ingest/task",
    "replay/mixture": "",
    "replay/sampling": "mixture",
    "replay/ring": "mixture sampling",
    "replay/panel": "mixture sampling store ingest/store ingest/task",
    "replay/trace": "replay panel store ingest/profile ingest/steps ingest/task",
    "replay/export": "replay mixture panel store ingest/profile ingest/task",
    "train": (
        "dqn evaluation feed run twin/env twin/floors twin/physics replay/panel replay/ring"
        " replay/sampling ingest/profile ingest/store ingest/task"
    ),
    "train/dqn": "twin/env twin/physics",
    "train/run": "replay/panel ingest/task",
    "train/feed": (
        "dqn run twin/env twin/floors replay/mixture replay/panel replay/ring replay/sampling"
        " ingest/task"
    ),
    "train/evaluation": (
        "dqn feed run twin/env twin/floors twin/physics replay/panel replay/ring replay/store"
        " ingest/profile ingest/store ingest/task"
    ),
    "train/comparison": "train dqn run",
    "train/libraries": (
        "train dqn evaluation feed run twin/floors twin/physics replay/mixture replay/panel"
        " replay/ring replay/store ingest/profile ingest/task"
    ),
    "train/study": "comparison dqn libraries ingest",
    "train/twin": "",
    "train/twin/floors": "",
    "train/twin/physics": "twin/floors ingest/task",
    "train/twin/env": "twin/floors twin/physics ingest/profile ingest/task",
    "train/twin/recording": "twin/env twin/floors twin/physics ingest/profile ingest/task",
    "train/twin/calibration": (
        "twin/floors twin/physics replay/store ingest/profile ingest/steps ingest/store ingest/task"
    ),
}


def folders() -> dict[str, list[Path]]:
    """Each folder of the three rooms with its modules."""
    found: dict[str, list[Path]] = {}
    for room in ("ingest", "replay", "train"):
        for path in sorted((ROOT / room).rglob("*.py")):
            found.setdefault(path.parent.relative_to(ROOT).as_posix(), []).append(path)
    return found


FOLDERS = folders()
MODULES = {
    path.relative_to(ROOT).with_suffix("").as_posix() for f in FOLDERS.values() for path in f
}


def imports(path: Path) -> Iterator[str]:
    """What a file imports of Restock, as paths: `ingest/task/scan`, `errors`."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the layer they cross"
            for alias in node.names:
                inside = f"{node.module}.{alias.name}"
                is_module = inside.replace(".", "/").removeprefix("restock/") in MODULES
                shared = node.module == "restock"
                names.append(inside if is_module or shared else node.module or "")
        for name in names:
            if name.startswith("restock."):
                yield name.removeprefix("restock.").replace(".", "/")


def edges(folder: str) -> dict[str, str]:
    """Other folders that a folder imports from, each with an example."""
    found = {}
    for path in FOLDERS[folder]:
        for name in imports(path):
            other = name if name in FOLDERS else name.rpartition("/")[0] or name
            if other not in (folder, "__version__") and name not in SHARED:
                found[other] = f"{path.relative_to(ROOT)} imports {name}"
    return found


def allowed(folder: str) -> set[str]:
    """The table's short names, looked up in the folder's own room first."""
    room = folder.split("/")[0]
    return {
        name
        if name in FOLDERS and name.split("/")[0] in ("ingest", "replay", "train")
        else f"{room}/{name}"
        for name in MAY_IMPORT[folder].split()
    }


@pytest.mark.parametrize("folder", sorted(FOLDERS))
def test_a_folder_imports_only_what_the_table_allows(folder: str) -> None:
    found = edges(folder)
    assert not [found[other] for other in found.keys() - allowed(folder)]
    assert not allowed(folder) - found.keys(), "the table allows what is not used"


@pytest.mark.parametrize("folder", sorted(FOLDERS))
def test_a_folder_has_one_purpose_and_room_for_it(folder: str) -> None:
    modules = [path for path in FOLDERS[folder] if path.name != "__init__.py"]
    assert len(modules) <= MOST_MODULES
    purpose = ast.get_docstring(ast.parse((ROOT / folder / "__init__.py").read_text("utf-8")))
    assert purpose
    assert len(purpose.splitlines()[0]) > 20


def test_there_are_no_cycles() -> None:
    TopologicalSorter({folder: allowed(folder) for folder in MAY_IMPORT}).prepare()


def test_imports_run_from_train_to_replay_to_ingest() -> None:
    order = ["ingest", "replay", "train"]
    for folder in MAY_IMPORT:
        for other in allowed(folder):
            assert order.index(other.split("/")[0]) <= order.index(folder.split("/")[0])


def test_the_twin_knows_no_learner() -> None:
    for folder in (f for f in MAY_IMPORT if f.startswith("train/twin")):
        assert all(o.startswith(("ingest", "replay", "train/twin")) for o in allowed(folder))


@pytest.mark.parametrize("name", sorted(SHARED))
def test_what_all_share_imports_no_room(name: str) -> None:
    assert set(imports(ROOT / "src" / "restock" / f"{name}.py")) <= SHARED


@pytest.mark.parametrize("room", ["ingest", "replay", "train"])
def test_the_front_door_reaches_each_room_by_a_committed_symlink(room: str) -> None:
    link = ROOT / "src" / "restock" / room
    assert link.is_symlink()
    assert link.resolve() == ROOT / room
