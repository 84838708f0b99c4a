"""Message definitions that no recording and no distribution holds: a folder's, and Ackermann's.

Bags of sqlite3 before 2023 carry no definitions. `--definitions DIR` reads those of a robot's own
packages from their sources: `DIR/**/PACKAGE/msg/NAME.msg` (or `PACKAGE/NAME.msg`) and `.idl`.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import get_types_from_msg

from restock.errors import RecordingError
from restock.ingest.decoding.definition_text import types_in
from restock.ingest.decoding.field_paths import CannotDecode

LARGEST = 512 << 10  # bytes of one file
MAX_FILES = 5000
# Part of no distribution's core, and what every robot that steers is driven by (ackermann_msgs).
ACKERMANN = {
    "ackermann_msgs/msg/AckermannDrive": (
        "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\n"
        "float32 acceleration\nfloat32 jerk\n"
    ),
    "ackermann_msgs/msg/AckermannDriveStamped": (
        "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n"
    ),
}


@cache
def ackermann_types() -> Typesdict:
    """The types of ackermann_msgs."""
    types: Typesdict = {}
    for name, text in ACKERMANN.items():
        types.update(get_types_from_msg(text, name))
    return types


@cache
def folder_types(folder: str) -> Typesdict:
    """Every type that the `.msg` and `.idl` files of a folder define.

    Raises:
        RecordingError: no such folder, no definition in it or too many, or one that cannot be read;
            names it.
    """
    root = Path(folder)
    if not root.is_dir():
        raise _refused(folder, "no such folder of definitions")
    files = sorted([*root.rglob("*.msg"), *root.rglob("*.idl")])
    if len(files) > MAX_FILES:
        raise _refused(folder, f"it holds {len(files):,} definitions, more than {MAX_FILES:,}")
    types: Typesdict = {}
    for file in files:
        parts = [part for part in file.relative_to(root).parts[:-1] if part != "msg"]
        package = parts[-1] if parts else root.name if root.name != "msg" else root.parent.name
        try:
            if file.stat().st_size > LARGEST:
                raise ValueError("too long for a definition")
            form = "ros2idl" if file.suffix == ".idl" else "ros2msg"
            types.update(types_in(file.read_bytes(), f"{package}/msg/{file.stem}", form))
        except (CannotDecode, ValueError, OSError) as error:
            raise RecordingError(
                f"a definition that cannot be read: {error}",
                where=str(file),
                remedy="correct the file, or remove it from the folder",
            ) from error
    if not types:
        raise _refused(folder, "it contains no .msg and no .idl file")
    return types


def _refused(folder: str, why: str) -> RecordingError:
    remedy = "--definitions needs a folder that contains PACKAGE/msg/NAME.msg (or .idl)"
    return RecordingError(why, where=folder, remedy=remedy)
