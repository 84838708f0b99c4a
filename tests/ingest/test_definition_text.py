"""Definitions as the files of packages have them: includes, comments, CRLF, blank lines."""

from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from support.bag_samples import write_channels

from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.definitions import folder_types

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
# An own Header, of which ROS 1 and ROS 2 mean other messages.
MSG = f"uint8 level 1  # of the tank\nHeader header\n# the end\n\n{RULE}MSG: a_msgs/Header\n"
MSG += "float32 left\nfloat64 right\n"


def recorded(path: Path, form: str, text: str, name: str = "a_msgs/msg/Twist") -> Path:
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
def test_definitions_are_read_as_their_files_are(tmp_path: Path, form: str, text: str) -> None:
    with open_recording(recorded(tmp_path / "run.mcap", form, text)) as recording:
        assert recording.topics["/twist"].skipped is None
        leaves = ["level", "header.left", "header.right"]
        assert recording.leaves("/twist") == leaves
        columns = recording.read({"/twist": leaves})["/twist"]
        assert [columns.fields[leaf].tolist() for leaf in leaves] == [[7], [0.5], [-2.0]]


def test_files_of_a_folder_are_read_alike(tmp_path: Path) -> None:
    folder = tmp_path / "a_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Twist.idl").write_bytes(TOP.replace("\n", "\r\n").encode())
    assert "a_msgs/msg/Twist" in folder_types(str(tmp_path))
    (folder / "Bad.msg").write_text("float64 x\nfloat64 == 3\n")
    with pytest.raises(RecordingError, match="cannot be parsed at 'float64 == 3'"):
        folder_types(str(folder))  # another name, as they are read once


@pytest.mark.parametrize("name", ["a_msgs/Twist", "a_msgs/msg/Twist"])
def test_a_type_has_one_name_with_or_without_msg(tmp_path: Path, name: str) -> None:
    with open_recording(recorded(tmp_path / "run.mcap", "ros2msg", MSG, name)) as recording:
        assert recording.topics["/twist"].type == "a_msgs/msg/Twist"
        assert recording.read({"/twist": ["level"]})["/twist"].fields["level"].tolist() == [7]
