"""Paths of custom signals: their syntax, and the values that they select in a topic's columns.

A signal path selects one value of a message, or a list of values:

    battery.voltage                                  a field
    covariance[0]   status[-1].level                 one element of an array or a sequence
    velocity[left_wheel]                             the element with that entry in `name[]`
    status[name=battery].values[key=voltage].value   the element with that value in a field
    ranges[::4]   cells[2:10]   poses[].position.x   several elements: a list

A path with a slice or `[]` gives one list per message. Any other path gives one value, or none if
the message lacks the element.

`CONVENTIONS` defines how messages mark a value that was not measured: a driver that measures no
yaw rate still publishes one, and marks it as invalid in another field. Inputs, custom signals and
proposed profiles use it. An invalid value becomes NaN, which is null in rows. The fields that name
frames, and those of transforms, are here too.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Container, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools
from restock.ingest.decoding.columns import FieldColumn, Ragged, suggest_fields, take

if TYPE_CHECKING:
    from restock.ingest.decoding.columns import Leaf
    from restock.ingest.profile.tables import Input


Rows = NDArray[np.intp]
NAMES = "name"  # field that holds the elements' names, as in sensor_msgs/JointState
_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[[^\]]*\])?)(?:\.|$)")
_ELEMENT = re.compile(r"(.+)\[(\d{1,6})\]")
IN = " in "  # separates a path and a unit: "twist.linear.x in km/h"
UNITS = {  # unit that a field is stored in -> other allowed units -> factor to convert from these
    "mps": {"mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6},
    "radps": {"deg/s": math.pi / 180, "rpm": math.pi / 30},
}


class PathProblem(Exception):
    """A path is invalid, or a message type lacks it; users read the path and then this text."""


def element_of(path: str) -> tuple[str, int | None]:
    """Split a path such as `covariance[0]` into field and index; None for a whole field."""
    field = path.partition(IN)[0]
    match = _ELEMENT.fullmatch(field)
    return (match[1], int(match[2])) if match else (field, None)


def factor_of(key: str, path: str) -> float | None:
    """Return the factor that converts values at a path to the unit of `key`; None: unknown unit."""
    unit = path.partition(IN)[2]
    return UNITS.get(key.rpartition("_")[2], {}).get(unit) if unit else 1.0


@dataclass(frozen=True)
class Choice:
    """The elements of a repeated field that a path selects; if `which` is None, all."""

    which: int | slice | str | None
    key: str | None = None  # the element's field that must have the value `which`

    @property
    def many(self) -> bool:
        return self.which is None or isinstance(self.which, slice)


@dataclass(frozen=True)
class Step:
    """One field of a path, and the choice of its elements."""

    name: str
    choice: Choice | None = None


@dataclass(frozen=True)
class PathValues:
    """The values (V,) that a path found in N messages, in the messages' order."""

    message: Rows  # (V,) index of each value's message
    values: NDArray[Any]  # (V,)


@dataclass(frozen=True)
class SignalPath:
    """A parsed path; `text` is the path as written."""

    text: str
    steps: tuple[Step, ...]

    @classmethod
    def read(cls, text: str) -> SignalPath:
        """Parse a path.

        Raises:
            PathProblem: the path's syntax is invalid.
        """
        steps, at = [], 0
        while at < len(text):
            match = _STEP.match(text, at)
            if match is None:
                raise PathProblem(f"cannot be read at {text[at:]!r}: write fields as a.b[0].c")
            steps.append(Step(match[1], _choice(match[2][1:-1]) if match[2] else None))
            at = match.end()
        if not steps or text.endswith("."):
            raise PathProblem("ends without a field")
        return cls(text, tuple(steps))

    @property
    def lists(self) -> int:
        """Count the steps that select several elements; if there are any, the path gives a list."""
        return sum(step.choice is not None and step.choice.many for step in self.steps)

    def leaf(self, upto: int | None = None, *more: str) -> str:
        """Return the field path to decode, or that of the first `upto` steps and then `more`."""
        steps = self.steps[:upto]
        last = upto is None and not more
        names = [
            step.name + ("[]" if step.choice and not (last and step is steps[-1]) else "")
            for step in steps
        ]
        return ".".join([*names, *more])

    def beside(self) -> dict[int, str]:
        """Return, for steps that select an element by text: step index -> field to compare."""
        names = {}
        for place, step in enumerate(self.steps):
            if step.choice is not None and isinstance(step.choice.which, str):
                if step.choice.key is None:
                    names[place] = self.leaf(place, NAMES)
                else:
                    names[place] = self.leaf(place + 1, step.choice.key)
        return names

    def wanted(self, *ends: str) -> list[str]:
        """Return all field paths to decode; `ends` are fields of the message at the path's end."""
        values = [f"{self.leaf(len(self.steps))}.{end}" for end in ends] or [self.leaf()]
        return [*values, *self.beside().values()]

    def check(self, leaves: Sequence[Leaf], *ends: str) -> list[str]:
        """Return the types (`float64`, `string`, …) of the path's values; `leaves` are all fields.

        Raises:
            PathProblem: a field of the path is missing, or repeats but has no brackets in the path,
                or has brackets but does not repeat.
        """
        kinds = {leaf.path: leaf.kind for leaf in leaves}
        repeats = {
            ".".join(part.removesuffix("[]") for part in leaf.path.split(".")[: place + 1])
            for leaf in leaves
            for place, field in enumerate(leaf.steps)
            if field.many
        }
        for place in range(len(self.steps)):
            step, field_path = self.steps[place], ".".join(s.name for s in self.steps[: place + 1])
            if step.choice is not None and field_path not in repeats:
                if any((_unbracketed(path) + ".").startswith(field_path + ".") for path in kinds):
                    raise PathProblem(f"{step.name} does not repeat: write it without brackets")
            elif step.choice is None and field_path in repeats:
                raise PathProblem(
                    f"{step.name} repeats: write {step.name}[0] for one element, or {step.name}[] "
                    "for the list of all"
                )
        for path in self.wanted(*ends):
            if path not in kinds:
                raise PathProblem(suggest_fields(path, list(kinds)))
        for place, path in self.beside().items():
            choice = self.steps[place].choice
            if choice and (_unbracketed(path) in repeats) == (choice.key is not None):
                raise PathProblem(
                    f"{path!r} cannot select an element: it does not have one value per element"
                )
        return [kinds[path] for path in self.wanted(*ends)[: max(len(ends), 1)]]

    def find(self, columns: Mapping[str, FieldColumn], end: str | None = None) -> PathValues:
        """Return the values that the path selects; `columns` holds the fields of `wanted`."""
        names = self.beside()
        path = self.leaf() if end is None else f"{self.leaf(len(self.steps))}.{end}"
        column, beside = columns[path], {place: columns[name] for place, name in names.items()}
        count = len(column)
        message: Rows = np.arange(count)
        for place, step in enumerate(self.steps):
            if step.choice is None:
                continue
            parent, position, column = _open(column)
            # Fields to compare that lie inside the element are flattened like it; `name[]` is not.
            inside = {p for p in beside if p > place or (p == place and step.choice.key)}
            for other in inside:
                beside[other] = _open(beside[other])[2]
            keep = _chosen(step.choice, parent, position, beside.get(place), len(message))
            column = take(column, keep)
            beside = {p: take(c, keep) for p, c in beside.items() if p > place}
            message = message[parent[keep]]
        if isinstance(column, Ragged) or column.ndim > 1:
            raise PathProblem("gives an array where it should give a number")
        return PathValues(message, np.asarray(column))


ANY = " or "  # separates the paths of `pressed`


def pressed_paths(text: str) -> list[SignalPath]:
    """Parse the paths of a field `pressed`, which is true if any value at any path is above 0.

    Raises:
        PathProblem: the syntax of a path is invalid.
    """
    return [SignalPath.read(part.strip()) for part in text.split(ANY)]


def pressed_in(columns: Mapping[str, FieldColumn], text: str, count: int) -> NDArray[np.bool_]:
    """Return in which of `count` messages a value at the paths of `pressed` is above 0.

    Raises:
        PathProblem: a value is not a number.
    """
    found = np.zeros(count, np.bool_)
    for path in pressed_paths(text):
        read = path.find(columns)
        if read.values.dtype.kind not in "biuf":
            raise PathProblem("is not a number")
        found[read.message[read.values > 0]] = True
    return found


def _choice(text: str) -> Choice:
    """Parse the text between the brackets of a path."""
    text = text.strip()
    if not text:
        return Choice(None)
    if re.fullmatch(r"[-:\d]*\d{10}[-:\d]*", text):
        raise PathProblem(f"[{text[:24]}]: an index has at most 9 digits")
    if re.fullmatch(r"-?\d+", text):
        return Choice(int(text))
    if re.fullmatch(r"(-?\d+)?:(-?\d+)?(:\d+)?", text):
        parts = [int(part) if part else None for part in text.split(":")]
        if parts[2:] == [0]:
            raise PathProblem(f"[{text}]: a step of 0")
        return Choice(slice(*parts))
    key, equals, value = text.partition("=")
    return Choice(value.strip(), key.strip()) if equals else Choice(text)


def _open(column: FieldColumn) -> tuple[Rows, Rows, FieldColumn]:
    """Flatten a column of lists: return each element's row, index in its list, and value."""
    if isinstance(column, Ragged):
        parent = np.repeat(np.arange(len(column)), column.lengths)
        return parent, np.arange(len(parent)) - column.offsets[:-1][parent], column.values
    count, length = column.shape[:2]
    parent, position = np.divmod(np.arange(count * length), max(length, 1))
    return parent, position, column.reshape(count * length, *column.shape[2:])


def _chosen(
    choice: Choice, parent: Rows, position: Rows, beside: FieldColumn | None, parents: int
) -> Rows:
    """Return the positions of the chosen elements in the flattened column, in order."""
    which = choice.which
    if which is None:
        return np.arange(len(parent))
    lengths = np.bincount(parent, minlength=parents)[parent]
    if isinstance(which, int):
        return np.flatnonzero(position == (which if which >= 0 else lengths + which))
    if isinstance(which, slice):
        step = which.step or 1
        start = _bound(which.start, lengths, 0)
        stop = _bound(which.stop, lengths, lengths)
        inside = (position >= start) & (position < stop) & ((position - start) % step == 0)
        return np.flatnonzero(inside)
    assert beside is not None
    if choice.key is not None:
        return _first(np.flatnonzero(_equals(np.asarray(beside), which)), parent)
    owner, place, names = _open(beside)
    named = _first(np.flatnonzero(_equals(np.asarray(names), which)), owner)
    wanted = np.full(parents, -1)
    wanted[owner[named]] = place[named]
    return np.flatnonzero(position == wanted[parent])


def _bound(bound: int | None, lengths: Rows, otherwise: Any) -> Any:
    if bound is None:
        return otherwise
    return bound if bound >= 0 else np.maximum(lengths + bound, 0)


def _equals(values: NDArray[Any], text: str) -> NDArray[np.bool_]:
    if values.dtype.kind in "OU":
        return np.asarray(values == text, np.bool_)
    try:
        return np.asarray(values == float(text), np.bool_)
    except ValueError:
        return np.zeros(len(values), np.bool_)


def _first(rows: Rows, parent: Rows) -> Rows:
    """Keep the first of the elements `rows` of each parent; `parent` has all elements' parents."""
    return rows[np.unique(parent[rows], return_index=True)[1]]


def _unbracketed(path: str) -> str:
    return path.replace("[]", "")


@dataclass(frozen=True)
class Convention:
    """A way in which messages of one type mark values that were not measured.

    `read` takes values (V,) and, for each of the fields `marked_by`, its values (V,) in the same
    messages. It returns the values with NaN for those that were not measured.
    """

    type: str  # message type without its package, which differs in JSON and protobuf
    values: tuple[str, ...]  # fields that can be marked, including all fields below them
    marked_by: tuple[str, ...]  # fields that mark a value as not measured
    read: Callable[..., F64]
    words: str  # how a value is marked, for messages to the user

    @property
    def fields(self) -> list[str]:
        """Return the field paths to decode for `marked_by`."""
        return [element_of(path)[0] for path in self.marked_by]

    @property
    def of_messages(self) -> bool:
        """Return whether messages mark all of `values` together, regardless of their numbers."""
        return self.read is _unless_minus_one or self.read is _unless_negative

    def flags(self, columns: Mapping[str, FieldColumn]) -> Bools:
        """Return which messages (N,) mark their `values` as not measured."""
        markings = [read_element(columns, path) for path in self.marked_by]
        return np.asarray(np.isnan(self.read(np.zeros(len(markings[0])), *markings)), np.bool_)


def _unless_minus_one(values: F64, variance: F64) -> F64:
    return np.where(variance == -1, np.nan, values)


def _unless_negative(values: F64, status: F64) -> F64:
    return np.where(status < 0, np.nan, values)


def _within(values: F64, low: F64, high: F64) -> F64:
    """Return the values, NaN outside the limits; -inf (too close, REP 117) becomes `low`."""
    near = np.where(np.isneginf(values), low, values)
    given = (high > 0) & (low <= high)  # where False, the driver does not fill its limits in
    return np.where(given & ~((near >= low) & (near <= high)), np.nan, near)


def _unknown(kind: str, value: str, covariance: str) -> Convention:
    return Convention(
        kind, (value,), (f"{covariance}[0]",), _unless_minus_one, f"{covariance}[0] is -1"
    )


CONVENTIONS = (
    # sensor_msgs/Imu: "if you have no estimate for one of the data elements, set element 0 of the
    # associated covariance matrix to -1".
    _unknown("Imu", "angular_velocity", "angular_velocity_covariance"),
    _unknown("Imu", "linear_acceleration", "linear_acceleration_covariance"),
    _unknown("Imu", "orientation", "orientation_covariance"),
    # Drivers that measure only speeds, or only poses, mark the unmeasured half in the same way.
    _unknown("Odometry", "twist.twist", "twist.covariance"),
    _unknown("Odometry", "pose.pose", "pose.covariance"),
    Convention(  # sensor_msgs/NavSatStatus: STATUS_NO_FIX
        "NavSatFix",
        ("latitude", "longitude", "altitude"),
        ("status.status",),
        _unless_negative,
        "status.status is below 0, no fix",
    ),
    Convention(  # sensor_msgs/BatteryState: "if unmeasured NaN"
        "BatteryState",
        (
            *("voltage", "temperature", "current", "charge", "capacity", "design_capacity"),
            *("percentage", "cell_voltage", "cell_temperature"),
        ),
        (),
        lambda values: values,
        "NaN",
    ),
    # sensor_msgs/Range and LaserScan: "values < range_min or > range_max should be discarded". Not
    # for scans in [inputs], to which `restock.ingest.task.surroundings` applies the task's limits.
    Convention(
        "Range", ("range",), ("min_range", "max_range"), _within, "outside min_range to max_range"
    ),
    Convention(
        "LaserScan",
        ("ranges",),
        ("range_min", "range_max"),
        _within,
        "outside range_min to range_max",
    ),
)


def conventions_of(kind: str, path: str, fields: Collection[str] | None = None) -> list[Convention]:
    """Return the conventions for the value at a path in messages of this type.

    With `fields`, only those whose marking fields are among the messages' `fields`.
    """
    field_path = re.sub(r"\[[^\]]*\]", "", path.partition(IN)[0])
    return [
        one
        for one in CONVENTIONS
        if one.type == last_part(kind)
        and any(field_path == value or field_path.startswith(f"{value}.") for value in one.values)
        and (fields is None or set(one.fields) <= set(fields))
    ]


def read_element(columns: Mapping[str, FieldColumn], path: str) -> F64:
    """Return one number per message, (N,): a field, or an element of a list (NaN if missing)."""
    path, place = element_of(path)
    column = columns[path]
    if place is None:
        return np.asarray(column, np.float64)
    if not isinstance(column, Ragged):
        return np.asarray(column[:, place], np.float64)
    values = np.full(len(column), np.nan)
    has = column.lengths > place
    values[has] = np.asarray(column.values)[column.offsets[:-1][has] + place]
    return values


_SEPARATORS = re.compile(r"[/.:]")


def last_part(kind: str) -> str:
    """Return a message type without its package: "Twist" for `ros.geometry_msgs.Twist`."""
    return _SEPARATORS.split(kind)[-1]


AXES = ("translation.x", "translation.y", "translation.z")
TURN = ("rotation.x", "rotation.y", "rotation.z", "rotation.w")
FIELDS = (
    "transforms[].header.stamp",
    "transforms[].header.frame_id",
    "transforms[].child_frame_id",
    *(f"transforms[].transform.{part}" for part in (*AXES, *TURN)),
)
_FOXGLOVES = ("timestamp", "parent_frame_id", "child_frame_id", *AXES, *TURN)
_LAYOUTS = (  # FIELDS in ROS's type, in foxglove.FrameTransforms and in foxglove.FrameTransform
    FIELDS,
    tuple(f"transforms[].{path}" for path in _FOXGLOVES),
    _FOXGLOVES,
)
FRAME_ID = "header.frame_id"
FRAME_IDS = (FRAME_ID, "frame_id")  # field that names the frame, in ROS and Foxglove messages


def frame_path(source: Input, fields: Container[str]) -> str | None:
    """Return the field that names the frame of an input's position, in the innermost header."""
    around = source.fields["x_m"].split(".")[:-1] if "x_m" in source.fields else []
    for count in range(len(around), -1, -1):
        path = ".".join([*around[:count], FRAME_ID])
        if path in fields and "[" not in path:
            return path
    return frame_id_path(fields)


def frame_id_path(fields: Container[str]) -> str | None:
    """Return the field that names a message's frame, or None."""
    return next((path for path in FRAME_IDS if path in fields), None)


def transform_fields(fields: Collection[str]) -> tuple[str, ...] | None:
    """Return the fields of transforms, in the order of `FIELDS`, or None if any is missing."""
    return next((layout for layout in _LAYOUTS if set(layout) <= set(fields)), None)


def plain(frame: str) -> str:
    """Return a frame's name as ROS 2 writes it, without the leading slash of ROS 1."""
    return frame.strip("/")
