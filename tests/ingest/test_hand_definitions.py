"""Definitions by hand, and robots that are steered."""

import math
from pathlib import Path

import numpy as np
import pytest
from support.ingested import proposed, steps_in
from support.paths import SHARED

from restock.cli import main
from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.definitions import choose_definitions, folder_types
from restock.ingest.profile.profile import load_profile

NEATO = SHARED / "fleet-neato" / "2025-redhot" / "drive_square"
RACECAR = SHARED / "robots" / "racecar-ackermann" / "BIGPATH.bag"
BUMP = "\n".join(f"bool {side}" for side in ("left_front", "left_side", "right_front"))
IDL = "module a_msgs { module msg { struct Level { double value; }; }; };"


def package(folder: Path) -> Path:
    (folder / "src" / "neato2_interfaces" / "msg").mkdir(parents=True)
    (folder / "src" / "neato2_interfaces" / "msg" / "Bump.msg").write_text(BUMP)
    (folder / "a_msgs").mkdir()
    (folder / "a_msgs" / "Level.idl").write_text(IDL)
    return folder


@pytest.mark.parametrize(
    ("text", "what"), [(None, "no .msg and no .idl file"), ("float64 = = ;;", "cannot be read")]
)
def test_a_folder_of_no_use_is_refused(text, what, tmp_path):
    if text is not None:
        (tmp_path / "Bad.msg").write_text(text)
    with pytest.raises(RecordingError, match=what):
        folder_types(str(tmp_path))


def test_more_definitions_than_are_read_are_refused_and_not_cut(tmp_path, monkeypatch):
    monkeypatch.setattr("restock.ingest.decoding.definitions.MAX_FILES", 1)
    with pytest.raises(RecordingError, match="it holds 2 definitions, more than 1"):
        folder_types(str(package(tmp_path)))


def test_definitions_are_a_distribution_a_folder_or_a_file(tmp_path):
    folder = package(tmp_path)
    assert choose_definitions(None) == "humble"
    assert choose_definitions("jazzy") == "jazzy"
    assert choose_definitions(str(folder)) == f"humble+{folder}"
    assert choose_definitions(f"jazzy+{folder}") == f"jazzy+{folder}"
    (file,) = folder.rglob("*.msg")
    assert choose_definitions(str(file)) == f"humble+{file}"
    assert folder_types(str(file)).keys() == {"neato2_interfaces/msg/Bump"}


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
def test_a_type_that_nobody_knows_is_read_by_its_definition(tmp_path, capsys):
    with open_recording(NEATO) as recording:
        assert "--definitions" in str(recording.topics["/bump"].skipped)
    with open_recording(NEATO, definitions=str(package(tmp_path))) as recording:
        bump = recording.topics["/bump"]
        assert (bump.skipped, bump.expected) == (None, 142)
    assert main(["info", str(NEATO), "--definitions", str(tmp_path / "none")]) != 0
    assert "no ROS distribution, folder or file" in capsys.readouterr().err


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
def test_a_car_is_read_by_its_steering_angle(tmp_path):
    file = tmp_path / "p.toml"
    profile = proposed(RACECAR, file)
    command = profile.inputs.command
    assert command.topic == "/vesc/low_level/ackermann_cmd"  # of seven, nearest to the motor
    assert command.wheelbase_m is not None
    # One with more than zeros in it, tick by tick as one would write it down.
    text = file.read_text().replace(command.topic + '"', '/vesc/high_level/ackermann_cmd"')
    file.write_text(text)
    profile = load_profile(file)
    with open_recording(RACECAR) as recording:
        raw = recording.read(
            {"/vesc/high_level/ackermann_cmd": ["drive.speed", "drive.steering_angle"]}
        )["/vesc/high_level/ackermann_cmd"]
    steps = steps_in(RACECAR, profile)
    reported = zip(raw.fields["drive.speed"], raw.fields["drive.steering_angle"], strict=True)
    rates = {round(float(v) * math.tan(d) / command.wheelbase_m, 4) for v, d in reported}
    found = set(np.round(steps.signals["command_yaw_rate_radps"], 4).tolist())
    assert found <= rates | {0.0}
    assert len(found) > 2
    assert "command.yaw_rate_radps" in profile.fallbacks
