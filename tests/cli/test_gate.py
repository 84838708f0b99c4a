"""`restock audit` as a gate: stores and runs that pass, and those that do not."""

import json
from pathlib import Path
from xml.etree import ElementTree

import pytest
from support.kept_run import kept_run
from support.shell import Shell
from support.stores import recording_transitions, write_store

from restock.train.run.run import Run, kept_policy


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return stores `both`, of two drives, and `one`, of the first alone."""
    folder, drives = tmp_path_factory.mktemp("check"), [recording_transitions(n) for n in (1, 2)]
    found = {"both": drives, "one": drives[:1]}
    return {name: write_store(folder / name, some) for name, some in found.items()}


def check(shell: Shell, *words: object) -> dict[str, str]:
    """Return the status of each check; at least one fails."""
    checks = shell.json("audit", *words, code=1)["audits"]
    return {f"{one['part']}.{one['audit']}": one["status"] for one in checks}


def test_lost_recordings_fail(stores, tmp_path, shell):
    junit = tmp_path / "check.xml"
    found = check(shell, stores["one"], "--against", stores["both"], "--junit", junit)
    assert found["diff.recordings_lost"] == "fail"
    assert found["diff.episodes_lost"] == "pass"
    root = ElementTree.parse(junit).getroot()
    suites = {suite.get("name", "").split()[0]: suite for suite in root}
    assert list(suites) == ["audit", "diff"]
    assert suites["diff"].get("failures") == "1"
    failed = [case.get("name") for case in suites["diff"] if case.find("failure") is not None]
    assert failed == ["recordings_lost"]

    found = check(shell, stores["both"], "--against", stores["one"])
    assert found["diff.recordings_new"] == "info"
    assert "fail" not in {status for name, status in found.items() if name.startswith("diff")}


def test_missing_baseline_fails_and_wrong_usage_is_refused(stores, tmp_path, shell):
    found = check(shell, stores["one"], "--against", tmp_path / "gone")
    assert found["diff.comparable"] == "fail"
    assert "no such store" in shell.err("audit", tmp_path / "gone")
    assert "give the run after the store" in shell.err(
        "audit", stores["one"], "--baseline", "released"
    )
    assert "is not a panel or a run" in shell.err("audit", stores["one"], tmp_path)


@pytest.mark.parametrize(
    ("verb", "option"), [("audit", "--junit"), *(("coverage", "--out"), ("report", "--out"))]
)
def test_folder_as_output_file_is_refused_early(verb, option, tmp_path, shell):
    """The check comes before the store is looked for."""
    error = shell.err(*verb.split(), tmp_path / "gone", option, tmp_path)
    assert error.startswith(f"restock: {option}: {tmp_path} is a folder")
    assert ".tmp" not in error


def gated(run: Path, verdict: str = "not worse", **changes: object) -> None:
    """Write a gate of one test, as `restock gate` leaves it."""
    origin = kept_policy(Run.open(run))
    cell = {"name": "nominal", "measure": "success", "perturbation": "none", "condition": "nominal"}
    document = {
        "baseline": "planner",
        "policy": None if origin is None else origin.document,
        "cells": [{**cell, "verdict": verdict}],
    }
    (run / "gate").mkdir(exist_ok=True)
    (run / "gate" / "gate.json").write_text(json.dumps(document | changes))


def test_run_must_have_passed_gate_against_baseline(stores, tmp_path, shell):
    run = kept_run(tmp_path / "run")

    def statuses() -> dict[str, str]:
        found = check(shell, stores["both"], run, "--baseline", "planner")
        return {name: status for name, status in found.items() if name.startswith("gate.")}

    refused = {"gate.comparable": "fail"}
    assert statuses() == refused  # never gated
    gated(run)
    assert statuses() == {"gate.success.none.nominal": "pass"}
    gated(run, verdict="not shown")
    assert statuses() == {"gate.success.none.nominal": "fail"}
    gated(run, baseline="operator")
    assert statuses() == refused
    gated(run, policy={"env_steps": 3})
    assert statuses() == refused
