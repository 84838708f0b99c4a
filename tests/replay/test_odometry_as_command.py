"""Odometry in place of commands is reported, audited, and left out of panels by default."""

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
    """Return the folder of the bags, a profile that reads commands, and one that reads odometry."""
    folder = tmp_path_factory.mktemp("odometry")
    write_bag(Drive(), folder / "commanded")
    write_bag(Drive(duration_s=9.0), folder / "measured")
    by_command, by_odometry = folder / "commands.toml", folder / "odometry.toml"
    assert main(["profile", "new", str(folder / "commanded"), "--out", str(by_command)]) == 0
    text = by_command.read_text()
    assert TWIST in text
    swapped = text.replace(TWIST, MEASURED).replace('name = "commands"', 'name = "odometry"')
    by_odometry.write_text(swapped.replace('steps = "command"', 'steps = "rate"'))
    return folder, by_command, by_odometry


def ingested(folder: Path, recording: str, profile: Path, store: Path, shell) -> dict:
    arguments = ["ingest", str(folder / recording), "--profile", str(profile), "--store"]
    (row,) = shell.json(*arguments, store)["recordings"]
    return row


def mixture(folder: Path, more: str = "") -> tuple[str, Path]:
    (folder / "mix.toml").write_text(MIXTURE.format(more=more))
    return "--mixture", folder / "mix.toml"


def test_panels_leave_out_and_count_odometry_actions(profiles, tmp_path, shell):
    folder, by_command, by_odometry = profiles
    store, panel = tmp_path / "store", tmp_path / "panel"
    first = ingested(folder, "commanded", by_command, store, shell)
    assert {"input": "command", "instead": INSTEAD} not in first["stand_ins"]
    second = ingested(folder, "measured", by_odometry, store, shell)
    assert {"input": "command", "instead": INSTEAD} in second["stand_ins"]
    words = ("mix", store, *mixture(tmp_path))
    left_out = {"odometry in place of a command": second["transitions"]}
    assert shell.json(*words, "--dry-run")["left_out"] == left_out
    assert f"{first['transitions']:,} rows of store" in shell.out(*words, "--out", panel)
    mixture(tmp_path, "odometry_as_command = true")
    assert shell.json(*words, "--dry-run")["left_out"] == {}
    audits = shell.json("audit", store, code=1)["audits"]
    (found,) = [each for each in audits if each["audit"] == "odometry_as_command"]
    assert [row["source_file"] for row in found["sample"]] == [str(folder / "measured")]


def test_store_of_odometry_actions_alone_is_refused(profiles, tmp_path, shell):
    folder, _, by_odometry = profiles
    store = tmp_path / "store"
    recording = ["ingest", str(folder / "measured"), "--profile", str(by_odometry)]
    assert f"no command: {INSTEAD}" in shell.out(*recording, "--store", store)
    err = shell.err("mix", store, *mixture(tmp_path), "--dry-run")
    assert "the action of every transition is odometry" in err
    assert "odometry_as_command = true" in err
