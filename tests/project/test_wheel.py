"""The wheel holds every file of every room, and takes no generic name in site-packages."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile

import pytest
from support.paths import ROOT

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
