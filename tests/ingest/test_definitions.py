"""Message definitions: as package files contain them, given by folder, and of steered robots."""

import math
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from support.bag_samples import write_channels
from support.ingested import proposed, steps_in
from support.paths import SHARED

from restock.cli import main
from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.definitions import choose_definitions, folder_types
from restock.ingest.profile.profile import load_profile

RULE = "=" * 80 + "\n"
STORE = get_typestore(Stores.EMPTY)
STORE.register(get_types_from_msg("float32 left\nfloat64 right", "a_msgs/msg/Header"))
STORE.register(get_types_from_msg("uint8 level\na_msgs/Header header", "a_msgs/msg/Twist"))
HEADER = STORE.types["a_msgs/msg/Header"](left=0.5, right=-2.0)
PAYLOAD = bytes(STORE.serialize_cdr(STORE.types["a_msgs/msg/Twist"](7, HEADER), "a_msgs/msg/Twist"))

INNER = "module a_msgs { module msg { struct Header { float left; double right; }; }; };\n"
TOP = """// generated from rosidl_adapter/resource/msg.idl.em
#include "a_msgs/msg/Header.idl"
# include <a_msgs/msg/Header.idl>  // twice

module a_msgs {
  module msg {
    /* it's "quoted":
    #include "nothing"
    **/
    @verbatim (language="comment", text=
      "ends \\\\" "\\n" "// no comment /* (sequence<<<<" "\\n")
    struct Twist {
      @default (value=1)
      uint8 level;  // of the "tank
      a_msgs::msg::Header header;
    };
  };
};
"""
IDL = f"{RULE}IDL: a_msgs/msg/Twist\n{TOP}\n{RULE}IDL: a_msgs/msg/Header\n{INNER}"
GUARDED = "#pragma once\n#ifndef A__TWIST_\n#define A__TWIST_\n" + TOP + "#endif  // A__TWIST_\n"
# Our own Header type, whose name means another message in ROS 1 and in ROS 2.
MSG = f"uint8 level 1  # of the tank\nHeader header\n# the end\n\n{RULE}MSG: a_msgs/Header\n"
MSG += "float32 left\nfloat64 right\n"


def write_recording(path: Path, form: str, text: str, name: str = "a_msgs/msg/Twist") -> Path:
    return write_channels(path, ("/twist", "cdr", name, form, text.encode(), [PAYLOAD]))


@pytest.mark.parametrize(
    ("form", "text"),
    [
        ("ros2idl", IDL),
        ("ros2idl", IDL.replace("\n", "\r\n")),
        ("ros2idl", "\n// a comment\n" + IDL.replace(RULE, f"\n{RULE[:-1]} \n\n")),
        ("ros2idl", IDL.replace(TOP, GUARDED)),
        ("ros2msg", MSG),
        ("ros2msg", MSG.replace("\n", "\r\n")),
        (
            "ros2msg",
            MSG.replace(RULE, f"\n{RULE[:-1]} \n\n").replace("MSG: a_msgs", "MSG: a_msgs/msg"),
        ),
        ("ros2msg", "\ufeff" + MSG),
    ],
    ids=["idl", "idl CRLF", "idl blank", "idl guard", "msg", "msg CRLF", "msg blank", "msg BOM"],
)
def test_recorded_definitions_are_parsed(tmp_path: Path, form: str, text: str) -> None:
    with open_recording(write_recording(tmp_path / "run.mcap", form, text)) as recording:
        assert recording.topics["/twist"].skipped is None
        leaves = ["level", "header.left", "header.right"]
        assert recording.leaves("/twist") == leaves
        columns = recording.read({"/twist": leaves})["/twist"]
        assert [columns.fields[leaf].tolist() for leaf in leaves] == [[7], [0.5], [-2.0]]


def test_definition_files_of_folder_are_parsed(tmp_path: Path) -> None:
    folder = tmp_path / "a_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Twist.idl").write_bytes(TOP.replace("\n", "\r\n").encode())
    assert "a_msgs/msg/Twist" in folder_types(str(tmp_path))
    (folder / "Bad.msg").write_text("float64 x\nfloat64 == 3\n")
    with pytest.raises(RecordingError, match="cannot be parsed at 'float64 == 3'"):
        folder_types(str(folder))  # another path, as folders are cached


@pytest.mark.parametrize("name", ["a_msgs/Twist", "a_msgs/msg/Twist"])
def test_type_name_is_the_same_with_or_without_msg(tmp_path: Path, name: str) -> None:
    with open_recording(write_recording(tmp_path / "run.mcap", "ros2msg", MSG, name)) as recording:
        assert recording.topics["/twist"].type == "a_msgs/msg/Twist"
        assert recording.read({"/twist": ["level"]})["/twist"].fields["level"].tolist() == [7]


NEATO = SHARED / "fleet-neato" / "2025-redhot" / "drive_square"
RACECAR = SHARED / "robots" / "racecar-ackermann" / "BIGPATH.bag"
BUMP = "\n".join(f"bool {side}" for side in ("left_front", "left_side", "right_front"))
LEVEL = "module a_msgs { module msg { struct Level { double value; }; }; };"


def write_package(folder: Path) -> Path:
    (folder / "src" / "neato2_interfaces" / "msg").mkdir(parents=True)
    (folder / "src" / "neato2_interfaces" / "msg" / "Bump.msg").write_text(BUMP)
    (folder / "a_msgs").mkdir()
    (folder / "a_msgs" / "Level.idl").write_text(LEVEL)
    return folder


@pytest.mark.parametrize(
    ("text", "message"), [(None, "no .msg and no .idl file"), ("float64 = = ;;", "cannot be read")]
)
def test_folder_without_valid_definitions_is_rejected(text, message, tmp_path):
    if text is not None:
        (tmp_path / "Bad.msg").write_text(text)
    with pytest.raises(RecordingError, match=message):
        folder_types(str(tmp_path))


def test_too_many_definition_files_are_rejected(tmp_path, monkeypatch):
    monkeypatch.setattr("restock.ingest.decoding.definitions.MAX_FILES", 1)
    with pytest.raises(RecordingError, match="it holds 2 definitions, more than 1"):
        folder_types(str(write_package(tmp_path)))


def test_definitions_can_be_distribution_folder_or_file(tmp_path):
    folder = write_package(tmp_path)
    assert choose_definitions(None) == "humble"
    assert choose_definitions("jazzy") == "jazzy"
    assert choose_definitions(str(folder)) == f"humble+{folder}"
    assert choose_definitions(f"jazzy+{folder}") == f"jazzy+{folder}"
    (file,) = folder.rglob("*.msg")
    assert choose_definitions(str(file)) == f"humble+{file}"
    assert folder_types(str(file)).keys() == {"neato2_interfaces/msg/Bump"}


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
def test_unknown_type_is_read_with_given_definition(tmp_path, capsys):
    with open_recording(NEATO) as recording:
        assert "--definitions" in str(recording.topics["/bump"].skipped)
    with open_recording(NEATO, definitions=str(write_package(tmp_path))) as recording:
        bump = recording.topics["/bump"]
        assert (bump.skipped, bump.expected) == (None, 142)
    assert main(["info", str(NEATO), "--definitions", str(tmp_path / "none")]) != 0
    assert "no ROS distribution, folder or file" in capsys.readouterr().err


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
def test_ackermann_command_gives_yaw_rate(tmp_path):
    file = tmp_path / "p.toml"
    profile = proposed(RACECAR, file)
    command = profile.inputs.command
    # the nearest to the motor of seven command topics
    assert command.topic == "/vesc/low_level/ackermann_cmd"
    assert command.wheelbase_m is not None
    # A topic with nonzero commands, with the rates computed one by one.
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
