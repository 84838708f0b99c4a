"""`restock audit`: a store and a run that may go on, and those that may not."""

import json
from pathlib import Path
from xml.etree import ElementTree

import pytest
from support.driven_robot import Drive, write_bag
from support.kept_run import kept_run

from restock.cli import main
from restock.cli.data.audit import of_gate
from restock.train.judge.gate import passed_gate
from restock.train.run.run import Run, kept_policy


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """`both` has two drives, `one` the first of them alone."""
    folder = tmp_path_factory.mktemp("check")
    bags = [
        write_bag(Drive(duration_s=seconds), folder / f"bag_{seconds:.0f}")
        for seconds in (6.0, 9.0)
    ]
    made = {name: folder / name for name in ("both", "one")}
    for name, some in (("both", bags), ("one", bags[:1])):
        command = ["ingest", *map(str, some), "--store", str(made[name]), "--json"]
        assert main(command) == 0
    return made


def check(capsys: pytest.CaptureFixture[str], *args: object) -> tuple[int, dict[str, str]]:
    """Return the exit code, and each check's status."""
    code = main(["audit", *map(str, args), "--json"])
    checks = json.loads(capsys.readouterr().out)["audits"]
    return code, {f"{one['part']}.{one['audit']}": one["status"] for one in checks}


def test_what_was_lost_since_the_last_store_fails(stores, tmp_path, capsys):
    capsys.readouterr()
    junit = tmp_path / "check.xml"
    code, found = check(capsys, stores["one"], "--against", stores["both"], "--junit", junit)
    assert code == 1
    assert found["diff.recordings_lost"] == "fail"
    assert found["diff.episodes_lost"] == "pass"
    root = ElementTree.parse(junit).getroot()
    suites = {suite.get("name", "").split()[0]: suite for suite in root}
    assert list(suites) == ["audit", "diff"]
    assert suites["diff"].get("failures") == "1"
    failed = [case.get("name") for case in suites["diff"] if case.find("failure") is not None]
    assert failed == ["recordings_lost"]

    code, found = check(capsys, stores["both"], "--against", stores["one"])
    assert found["diff.recordings_new"] == "info"
    assert "fail" not in {status for name, status in found.items() if name.startswith("diff")}


def test_what_cannot_be_compared_fails_and_wrong_usage_is_said(stores, tmp_path, capsys):
    capsys.readouterr()
    code, found = check(capsys, stores["one"], "--against", tmp_path / "gone")
    assert code == 1
    assert found["diff.comparable"] == "fail"
    assert main(["audit", str(tmp_path / "gone")]) == 2
    assert "no such store" in capsys.readouterr().err
    assert main(["audit", str(stores["one"]), "--baseline", "released"]) == 2
    assert "give the run after the store" in capsys.readouterr().err
    assert main(["audit", str(stores["one"]), str(tmp_path)]) == 2
    assert "is not a panel or a run" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("verb", "option"), [("audit", "--junit"), *(("coverage", "--out"), ("report", "--out"))]
)
def test_a_folder_as_output_file_is_refused_early(verb, option, tmp_path, capsys):
    """Before it is even looked whether there is a store."""
    capsys.readouterr()
    assert main([*verb.split(), str(tmp_path / "gone"), option, str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"restock: {option}: {tmp_path} is a folder")
    assert ".tmp" not in error


def gated(run: Path, **changes: object) -> None:
    """Write a gate of one test, as `restock gate` leaves it."""
    origin = kept_policy(Run.open(run))
    cell = {"name": "nominal", "measure": "success", "perturbation": "none", "condition": "nominal"}
    document = {
        "baseline": "planner",
        "policy": None if origin is None else origin.document,
        "cells": [{**cell, "verdict": "not worse"}],
    }
    (run / "gate").mkdir(exist_ok=True)
    (run / "gate" / "gate.json").write_text(json.dumps(document | changes))


@pytest.mark.parametrize(("verdict", "status"), [("not worse", "pass"), ("not shown", "fail")])
def test_a_run_must_have_passed_its_gate(tmp_path: Path, verdict: str, status: str) -> None:
    run = kept_run(tmp_path / "run")
    cell = {"name": "nominal", "measure": "success", "perturbation": "none", "condition": "nominal"}
    gated(run, cells=[{**cell, "verdict": verdict}])
    (finding,) = of_gate(passed_gate(run, "planner"))
    assert finding.status == status


def test_a_gate_of_something_else_fails_the_check(stores, tmp_path, capsys):
    run = kept_run(tmp_path / "run")
    capsys.readouterr()

    def status() -> str | None:
        options = (run, "--baseline", "planner")
        return check(capsys, stores["both"], *options)[1].get("gate.comparable")

    assert status() == "fail"  # never gated
    gated(run)
    assert status() is None
    gated(run, baseline="operator")
    assert status() == "fail"
    gated(run, policy={"env_steps": 3})
    assert status() == "fail"
