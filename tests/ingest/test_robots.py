"""A real robot's drives through `benchmarks/robots.py`: rows, the twin, contacts against labels."""

import json
import subprocess
import sys

import pytest
from support.paths import ROOT, SHARED


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
def test_a_robot_is_measured_from_its_recordings(tmp_path):
    message = tmp_path / "definitions" / "neato2_interfaces" / "msg" / "Bump.msg"
    message.parent.mkdir(parents=True)
    fields = ("left_front", "left_side", "right_front", "right_side")
    message.write_text("".join(f"uint8 {field}\n" for field in fields))
    command = [sys.executable, str(ROOT / "benchmarks" / "robots.py"), "--bags", str(SHARED)]
    command += ["--out", str(tmp_path / "out"), "--only", "2024-danpark/test-bag", "--json"]
    command += ["--minutes", "0.1", "--definitions", str(tmp_path / "definitions")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    (robot,) = json.loads(done.stdout)["robots"]
    assert robot["rows"] == sum(one["rows"] for one in robot["by_year"])
    assert [one["year"] for one in robot["by_year"]] == [2024]
    assert robot["rows"] == sum(robot["conditions"].values())
    assert robot["contacts"]["contacts"] >= 1
    assert "bumper: never pressed" in robot["stood_in"]  # the labels know nothing of it
    again = subprocess.run([*command, "--kept"], capture_output=True, text=True, check=True)
    assert json.loads(again.stdout)["robots"] == [robot]
