"""The house: which folder may import which, each with one purpose, none too full, no cycles.

Every import counts, those in functions and under TYPE_CHECKING too. All may import `restock`'s own
modules (errors, files, state, statistics, TOML), which import nothing but each other. The front
door is exempt: `restock/__init__.py`, `__main__.py`, the rooms' `__init__.py` and `twin.py` import
by name, and only when a name is asked for; no module of Restock imports from them.
"""

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from support.paths import ROOT

MAX_MODULES = 15
ROOMS = ["ingest", "replay", "train", "report", "cli"]
SHARED = {
    *("arrays", "errors", "files", "native", "process", "public"),
    *("renamed", "state", "stats", "toml"),
}
MAY_IMPORT = {
    "ingest": "containers profile steps store task",
    "ingest/decoding": "",
    "ingest/containers": "decoding",
    "ingest/task": "",
    "ingest/profile": "decoding task",
    "ingest/propose": "containers decoding live profile steps task",
    "ingest/live": "decoding profile steps task",
    "ingest/steps": "containers decoding profile task",
    "ingest/store": "containers decoding profile steps task",
    "replay": "fleet panel store ingest/containers ingest/decoding ingest/store",
    "replay/store": "ingest/steps ingest/store ingest/task",
    "replay/sampling": "",
    "replay/mixture": "sampling",
    "replay/plan": "mixture store ingest/task",
    "replay/panel": "mixture plan sampling store ingest/store ingest/task",
    "replay/fleet": "mixture panel plan store ingest/task",
    "replay/trace": (
        "replay panel store ingest/containers ingest/decoding ingest/profile ingest/steps"
        " ingest/store ingest/task"
    ),
    "replay/review": (
        "store trace ingest ingest/containers ingest/profile ingest/steps ingest/store ingest/task"
    ),
    "replay/export": "replay panel store ingest/steps ingest/profile ingest/task",
    "train": (
        "dqn evaluation feed run twin/missions twin/env twin/floors twin/physics"
        " replay/mixture replay/panel replay/sampling ingest/profile ingest/task"
    ),
    "train/dqn": "twin/missions twin/env twin/physics replay/fleet",
    "train/run": "replay replay/panel ingest/profile ingest/task",
    "train/feed": (
        "dqn run twin/env twin/floors replay/mixture replay/panel"
        " replay/plan replay/sampling ingest/task ingest/profile"
        " replay/fleet twin/physics"
    ),
    "train/evaluation": (
        "dqn feed run twin/missions twin/env twin/floors twin/physics"
        " replay/panel replay/store ingest/live ingest/store ingest/profile ingest/task"
        " replay/sampling"
    ),
    "train/judge": (
        "train dqn evaluation feed run twin/calibration"
        " twin/missions twin/env twin/floors twin/physics replay/fleet replay/panel replay/store"
        " ingest/profile ingest/store ingest/task"
    ),
    "train/libraries": (
        "dqn feed run replay/panel replay/sampling replay/store ingest/profile ingest/task"
    ),
    "train/study": "judge dqn evaluation run replay/panel twin/missions",
    "train/twin": "",
    "train/twin/floors": "",
    "train/twin/missions": "twin/floors",
    "train/twin/physics": "twin/floors twin/missions ingest/task",
    "train/twin/env": (
        "twin/floors twin/missions twin/physics replay/fleet ingest/profile ingest/task"
    ),
    "train/twin/recording": (
        "twin/missions twin/env twin/floors twin/physics replay/fleet ingest/profile ingest/task"
    ),
    "train/twin/survey": (
        "twin/floors replay/store ingest/containers ingest/decoding ingest/profile"
        " ingest/propose ingest/steps ingest/task"
    ),
    "train/twin/calibration": ("twin/floors twin/physics replay/store ingest/profile ingest/task"),
    "report": (
        "look run fleet ingest/store replay replay/store train/evaluation train/judge train/run"
    ),
    "report/look": "train/twin/missions",
    "report/run": (
        "look replay/panel replay/plan replay/sampling replay/store train/evaluation"
        " train/judge train/run train/twin/calibration train/twin/floors"
    ),
    "report/fleet": "look replay/fleet replay/review replay/store ingest/store",
    "cli": "ingest/live ingest/profile ingest/steps ingest/task replay replay/store",
    "cli/data": (
        "cli ingest ingest/containers ingest/decoding ingest/profile ingest/propose"
        " ingest/steps ingest/store ingest/task replay replay/export"
        " replay/fleet replay/mixture replay/panel replay/plan replay/store train/evaluation"
        " train/judge"
    ),
    "cli/fleet": (
        "cli report report/fleet ingest ingest/profile ingest/store ingest/task replay replay/fleet"
        " replay/review replay/mixture replay/panel replay/store train/twin/missions"
    ),
    "cli/learning": (
        "cli report ingest/profile replay replay/fleet replay/mixture replay/trace"
        " train train/judge train/dqn train/evaluation train/run"
        " train/study train/twin/floors train/twin/physics"
        " replay/panel train/feed"
    ),
    "cli/start": (
        "cli ingest/containers ingest/decoding ingest/profile ingest/propose ingest/task"
        " replay/mixture replay/trace train/dqn"
        " train/evaluation train/run train/twin/floors train/twin/missions"
    ),
    "cli/twin": (
        "cli report ingest/profile ingest/propose"
        " ingest/task replay/fleet replay/store train/evaluation"
        " train/twin/calibration train/twin/env train/twin/floors train/twin/missions"
        " train/twin/physics train/twin/recording train/twin/survey"
    ),
}


def folders() -> dict[str, list[Path]]:
    """Each folder of the three rooms, the command line and the report with its modules."""
    found: dict[str, list[Path]] = {}
    for room in ROOMS:
        for path in sorted((home(room) / room).rglob("*.py")):
            found.setdefault(path.parent.relative_to(home(room)).as_posix(), []).append(path)
    return found


def home(folder: str) -> Path:
    """Where a folder lies: the three rooms at the top, the front door's in `src/restock`."""
    front = folder.split("/")[0] in ("cli", "report")
    return ROOT / "src" / "restock" if front else ROOT


FOLDERS = folders()
FRONT_DOOR = {
    "__init__",
    "__main__",
    "ingest/__init__",
    "replay/__init__",
    "train/__init__",
    "twin",
}
MODULES = {
    path.relative_to(home(folder)).with_suffix("").as_posix()
    for folder, paths in FOLDERS.items()
    for path in paths
}


@cache
def imports(path: Path) -> set[str]:
    """Return what a file imports of Restock, as paths: `ingest/task/task`, `errors`."""
    found = set()
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
        found |= {name for name in names if name.startswith("restock.")}
    return {name.removeprefix("restock.").replace(".", "/") for name in found}


def edges(folder: str) -> dict[str, str]:
    """Other folders that a folder imports from, each with an example."""
    found = {}
    for path in FOLDERS[folder]:
        if path.relative_to(home(folder)).with_suffix("").as_posix() in FRONT_DOOR:
            continue
        for name in imports(path):
            other = name if name in FOLDERS else name.rpartition("/")[0] or name
            if other not in (folder, "__version__") and name not in SHARED:
                found[other] = f"{path.relative_to(ROOT)} imports {name}"
    return found


def allowed(folder: str) -> set[str]:
    """Return the table's short names, looked up in the folder's own room first."""
    room = folder.split("/")[0]
    return {
        name if name in FOLDERS and name.split("/")[0] in ROOMS else f"{room}/{name}"
        for name in MAY_IMPORT[folder].split()
    }


@pytest.mark.parametrize("folder", sorted(FOLDERS))
def test_imports_follow_the_layer_table(folder: str) -> None:
    found = edges(folder)
    assert not [found[other] for other in found.keys() - allowed(folder)]
    assert not allowed(folder) - found.keys(), "the table allows what is not used"


@pytest.mark.parametrize("folder", sorted(FOLDERS))
def test_folders_have_a_purpose_and_few_modules(folder: str) -> None:
    modules = [path for path in FOLDERS[folder] if path.name != "__init__.py"]
    assert len(modules) <= MAX_MODULES
    text = (home(folder) / folder / "__init__.py").read_text("utf-8")
    purpose = ast.get_docstring(ast.parse(text))
    assert purpose
    assert len(purpose.splitlines()[0]) > 20


@pytest.mark.parametrize("room", ["ingest", "replay", "train", "train/twin"])
def test_contributors_map_names_every_folder(room: str) -> None:
    reported = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    folders = [path.parent.name for path in (ROOT / room).glob("*/__init__.py")]
    assert [folder for folder in folders if f" {folder}/" not in reported] == []


def test_no_import_cycles() -> None:
    TopologicalSorter({folder: allowed(folder) for folder in MAY_IMPORT}).prepare()


def test_rooms_import_only_earlier_rooms() -> None:
    for folder in MAY_IMPORT:
        for other in allowed(folder):
            assert ROOMS.index(other.split("/")[0]) <= ROOMS.index(folder.split("/")[0])


def test_command_line_is_small_and_not_imported() -> None:
    front = {path.stem for path in (ROOT / "src" / "restock").glob("*.py")}
    assert front == SHARED | {name for name in FRONT_DOOR if "/" not in name}
    assert len(front) <= MAX_MODULES
    faces = {name.removesuffix("/__init__") for name in FRONT_DOOR}
    for paths in FOLDERS.values():
        for path in paths:
            assert not faces & imports(path) or path.name == "__init__.py", path


def test_twin_imports_no_learner() -> None:
    for folder in (f for f in MAY_IMPORT if f.startswith("train/twin")):
        assert all(o.startswith(("ingest", "replay", "train/twin")) for o in allowed(folder))


@pytest.mark.parametrize("name", sorted(SHARED))
def test_shared_modules_import_no_room(name: str) -> None:
    compiled = {"_native"} if name == "native" else set()
    assert imports(ROOT / "src" / "restock" / f"{name}.py") <= SHARED | compiled


@pytest.mark.parametrize("room", ["ingest", "replay", "train"])
def test_package_links_to_each_room(room: str) -> None:
    link = ROOT / "src" / "restock" / room
    assert link.is_symlink()
    assert link.resolve() == ROOT / room
