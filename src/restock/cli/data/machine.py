"""The checks of this machine, and of a store, that `restock info` prints for bug reports."""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any, NamedTuple

from restock import native
from restock.cli.failures import GL, NO_GL
from restock.files import cores
from restock.imports import install_command
from restock.words import counted, quoted

EXTRA = re.compile(r"extra == ['\"](\w+)['\"]")
FOR_DEVELOPERS = {"dev", "test", "site", "fuzz", "bench"}
# Drawn elsewhere: a driver that is broken ends its process.
DRAWS = """
import os
os.environ.setdefault("MUJOCO_GL", "egl")
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 48, 64) as renderer:
    renderer.update_scene(data)
    renderer.render()
"""
DRAWS_S = 60


class Finding(NamedTuple):
    """One line of the report: what was checked, its state, and what to do about it."""

    part: str
    name: str
    state: str  # ok | missing (an extra) | wrong
    what: str
    remedy: str = ""


def check_machine() -> list[Finding]:
    """Look at what is installed here and what works."""
    return [*_machine(), *_packages(), _torch(), _native(), _drawing(), _disk(Path.cwd())]


def _machine() -> list[Finding]:
    from restock import __version__

    return [
        Finding("restock", "version", "ok", __version__),
        Finding("machine", "python", "ok", platform.python_version()),
        Finding("machine", "system", "ok", f"{platform.platform()}, {cores()} cores"),
    ]


def _packages() -> list[Finding]:
    """Check what Restock and its extras need, and say how to install what is missing."""
    from packaging.requirements import Requirement

    found = []
    for requirement in map(Requirement, requires("restock") or []):
        extra = EXTRA.search(str(requirement.marker or ""))
        if requirement.name == "restock" or (extra and extra[1] in FOR_DEVELOPERS):
            continue
        if requirement.marker and not requirement.marker.evaluate(
            {"extra": extra[1] if extra else ""}
        ):
            continue  # of other machines
        name, wanted = requirement.name, requirement.specifier
        part = f"extra {extra[1]}" if extra else "needed"
        try:
            installed, state = version(name), "ok"
        except PackageNotFoundError:
            installed, state = "not installed", "missing" if extra else "wrong"
        if state == "ok" and not wanted.contains(installed, prereleases=True):
            installed, state = f"{installed}, and {wanted} is needed", "wrong"
        remedy = "" if state == "ok" else install_command(extra[1] if extra else "")
        found.append(Finding(part, name, state, installed, remedy))
    return found


def _torch() -> Finding:
    try:
        import torch
    except (ImportError, OSError) as error:
        return Finding("works", "torch", "wrong", f"cannot be imported: {error}", "reinstall it")
    threads = f"{torch.get_num_threads()} threads"
    if torch.cuda.is_available():
        return Finding("works", "torch", "ok", f"{torch.cuda.get_device_name()}, {threads}")
    return Finding("works", "torch", "ok", f"no CUDA device, {threads}")


def _native() -> Finding:
    """Check whether the update of a plain network is compiled; it is slower without."""
    state = native.state()
    if native.IS_THERE:
        return Finding("works", "native code", "ok", state)
    remedy = (
        "install a C compiler and reinstall restock from source; only training is slower without it"
    )
    return Finding("works", "native code", "missing", state, remedy)


def _drawing() -> Finding:
    """Check whether MuJoCo can draw off screen, which only its cameras need."""
    command = [sys.executable, "-c", DRAWS]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=DRAWS_S)
    except subprocess.TimeoutExpired:
        return Finding("works", "pictures", "missing", f"no image was rendered within {DRAWS_S} s")
    if ended.returncode == 0:
        backend = os.environ.get("MUJOCO_GL", "egl")
        return Finding("works", "pictures", "ok", f"MuJoCo renders off screen ({backend})")
    why = (ended.stderr.strip().splitlines() or [f"exit code {ended.returncode}"])[-1]
    remedy = "install libegl1; only the twin's cameras need it"
    if os.environ.get(GL):
        remedy = f"{GL} is {os.environ[GL]!r}: {NO_GL}"
    return Finding("works", "pictures", "missing", why, remedy)


def _disk(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free
    return Finding("machine", "disk here", "ok", f"{free / 1e9:.1f} GB free")


def check_store(path: str) -> list[Finding]:
    """Look at what a store holds, how long opening it takes, and whether it can be read.

    Raises:
        StoreError: there is no store, or it cannot be read.
    """
    from restock.replay.store.store import Store

    began = time.monotonic()
    with Store(path) as store:
        store.verify()
        opened = time.monotonic() - began
        counts: dict[str, Any] = dict(
            store.sql(
                "SELECT 'recordings' AS name, count(*) AS n FROM recordings"
                " UNION ALL SELECT 'transitions', count(*) FROM transitions"
            ).fetchall()
        )
        files = len(store.files["stored_transitions"])
        holds = f"{counts['transitions']:,} transitions of {counts['recordings']:,} recordings"
        files_are = f"{files:,} Parquet files"
        found = [
            Finding("store", "version", "ok", f"{store.version}, opened in {opened:.2f} s"),
            Finding("store", "rows", "ok", f"{holds} in {files_are}"),
        ]
        if changed := len(store.changed_by_others):
            what = f"not used: another tool may have changed {counted(changed, 'recording')}"
            remedy = f"rows are counted instead: `restock store compact {quoted(path)}` makes new"
            found.append(Finding("store", "summaries", "ok", what, remedy))
        return found
