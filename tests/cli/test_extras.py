"""A lean installation: which verbs work without extras, and errors about missing ones."""

import json
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from support.finished_runs import document, make_run
from support.paths import ROOT

from restock.process import EXTRAS, install_command

# Runs restock command lines in a process that lacks the optional packages.
LEAN = """
import io, json, shlex, sys
from contextlib import redirect_stderr, redirect_stdout

absent, lines = json.loads(sys.argv[1])

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in absent:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
import importlib.util
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in absent else find(name)
from restock.cli import main

ended = []
for line in lines:
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()) as errors:
        code = main(shlex.split(line))
    ended.append((code, errors.getvalue()))
print(json.dumps(ended))
"""
WORKS = (
    "info STORE",
    "sql STORE 'FROM coverage'",
    "coverage STORE",
    "coverage drift STORE",
    "coverage diff STORE STORE",
    "audit STORE",
    "audit STORE --against STORE",
    "mix STORE --mixture uniform --out panel",
    "export panel --to parquet --out a.parquet",
    "export panel --to lerobot --out set",
    "trace STORE",
    "store verify STORE",
    "profile schema",
)
NEEDS = {  # command line -> the extra that it names
    "coverage gaps STORE": "pages",
    "coverage STORE --out page.html": "pages",
    "export panel --to minari --out minari": "libraries",
    "export RUN --to onnx --out policy.onnx": "train",
    "train --panel panel --out new": "train",
    "eval RUN": "train",
    "gate RUN --baseline planner": "train",
    "compare RUN RUN": "train",
    "diagnose RUN": "train",
    "report RUN": "train",
    "twin record --out drive.mcap": "train",
    "twin layout": "train",
    "twin robot robot.xml": "train",
    "twin fit STORE": "train",
    "twin gap STORE": "train",
    "start sample_logs --out mine": "train",
    "demo --out shown": "train",
}


@pytest.fixture(scope="module")
def ended(store_path: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str]]:
    folder = tmp_path_factory.mktemp("lean")
    (folder / "sample_logs").symlink_to(ROOT / "sample_logs")
    run = make_run(folder / "run", document())
    lines = [*WORKS, *NEEDS]
    given = [line.replace("STORE", str(store_path)).replace("RUN", str(run)) for line in lines]
    command = [sys.executable, "-c", LEAN, json.dumps([list(EXTRAS), given])]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr[-2000:]
    made = {"sample_logs", "run", "panel", "a.parquet", "set"}
    assert {path.name for path in folder.iterdir()} == made  # written by the verbs that work
    last = done.stdout.splitlines()[-1]  # with -c, DuckDB prints the progress of slow queries first
    return dict(zip(lines, map(tuple, json.loads(last)), strict=True))


@pytest.mark.parametrize("line", WORKS)
def test_verb_works_without_extras(line, ended) -> None:
    code, errors = ended[line]
    assert code in (0, 1), errors


@pytest.mark.parametrize(("line", "extra"), NEEDS.items())
def test_missing_extra_names_install_command(line, extra, ended) -> None:
    code, errors = ended[line]
    assert code == 2
    problem, remedy = (text.strip() for text in errors.strip().splitlines()[-2:])
    assert problem.endswith(", which is not installed")
    assert remedy == install_command(extra)
    assert "bug" not in errors


def test_optional_packages_are_in_their_extra() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    there = packages_distributions()
    for package, extra in EXTRAS.items():
        has = {Requirement(one).name.replace("_", "-") for one in extras[extra]}
        has |= {"h5py"} if "minari" in has else set()  # minari brings it
        own = {name.replace("_", "-") for name in there.get(package, [package])}
        assert own & has or package == "mlflow", package  # mlflow-skinny has it
    needed = {Requirement(one).name for one in project["dependencies"]}
    assert not needed & {name for package in EXTRAS for name in there.get(package, ())}
