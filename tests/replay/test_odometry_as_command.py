"""Recordings whose action is the measured motion: said at ingest, audited, in no panel unasked."""

import json
from pathlib import Path

import pytest
from support.driven_robot import Drive, write_bag

from restock.cli import main

INSTEAD = "the measured motion of /odom in place of commands"
MIXTURE = """{more}
[evaluation_split]
by = "none"
[each_condition]
"""
TWIST = """topic = "/cmd_vel"
type = "geometry_msgs/msg/Twist"
fields = { speed_mps = "linear.x", yaw_rate_radps = "angular.z" }"""
MEASURED = """topic = "/odom"
type = "nav_msgs/msg/Odometry"
fields = { speed_mps = "twist.twist.linear.x", yaw_rate_radps = "twist.twist.angular.z" }"""


@pytest.fixture(scope="module")
def profiles(tmp_path_factory) -> tuple[Path, Path, Path]:
    """Return the bags' folder, a profile by commands, and the same task by odometry."""
    folder = tmp_path_factory.mktemp("odometry")
    write_bag(Drive(), folder / "commanded")
    write_bag(Drive(duration_s=9.0), folder / "measured")
    reported, seen = folder / "told.toml", folder / "seen.toml"
    assert main(["profile", "new", str(folder / "commanded"), "--out", str(reported)]) == 0
    text = reported.read_text()
    assert TWIST in text
    swapped = text.replace(TWIST, MEASURED).replace('name = "told"', 'name = "seen"')
    seen.write_text(swapped.replace('steps = "command"', 'steps = "rate"'))
    return folder, reported, seen


def ingested(folder: Path, recording: str, profile: Path, store: Path, capsys) -> dict:
    arguments = ["ingest", str(folder / recording), "--profile", str(profile), "--store"]
    assert main([*arguments, str(store), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["recordings"]
    return row


def mixed(folder: Path, store: Path, capsys, more: str = "") -> tuple[int, str, str]:
    mixture = folder / "mix.toml"
    mixture.write_text(MIXTURE.format(more=more))
    code = main(["mix", str(store), "--mixture", str(mixture), "--dry-run", "--json"])
    return code, *capsys.readouterr()


def test_panels_leave_measured_actions_out_and_count_them(profiles, tmp_path, capsys):
    folder, reported, seen = profiles
    store = tmp_path / "store"
    capsys.readouterr()
    first = ingested(folder, "commanded", reported, store, capsys)
    assert {"input": "command", "instead": INSTEAD} not in first["stand_ins"]
    second = ingested(folder, "measured", seen, store, capsys)
    assert {"input": "command", "instead": INSTEAD} in second["stand_ins"]
    code, out, _ = mixed(tmp_path, store, capsys)
    assert code == 0
    assert f'"odometry in place of a command": {second["transitions"]}' in out
    mixture, panel = str(tmp_path / "mix.toml"), tmp_path / "panel"
    assert main(["mix", str(store), "--mixture", mixture, "--out", str(panel)]) == 0
    assert f"{first['transitions']:,} rows of store" in capsys.readouterr().out
    code, out, _ = mixed(tmp_path, store, capsys, "odometry_as_command = true")
    assert code == 0
    assert "odometry in place" not in out
    main(["audit", str(store), "--json"])
    audits = json.loads(capsys.readouterr().out)["audits"]
    (found,) = [each for each in audits if each["audit"] == "odometry_as_command"]
    assert [row["source_file"] for row in found["sample"]] == [str(folder / "measured")]


def test_a_store_of_measured_actions_alone_makes_no_panel(profiles, tmp_path, capsys):
    folder, _, seen = profiles
    store = tmp_path / "store"
    capsys.readouterr()
    recording = ["ingest", str(folder / "measured"), "--profile", str(seen)]
    assert main([*recording, "--store", str(store)]) == 0
    assert f"no command: {INSTEAD}" in capsys.readouterr().out
    code, _, err = mixed(tmp_path, store, capsys)
    assert code == 2
    assert "the action of every transition is odometry" in err
    assert "odometry_as_command = true" in err
