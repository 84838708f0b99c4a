"""Serialisation of columns of values to ROS 2 messages, a whole topic at a time.

rosbags serialises one exemplar of a message; every further message of the same shape differs
from it only in numbers at fixed places. `MessageLayout` finds those places by CDR's alignment
rules and writes columns straight into copies of the exemplar's bytes, tens of times faster
than building and serialising the messages one by one. Messages whose shape changes (a plan, a
text) go through rosbags one by one.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

ENCAPSULATION_BYTES = 4  # before the first byte that alignment counts from
_BASIC = {
    "bool": "u1", "byte": "u1", "octet": "u1", "char": "u1", "uint8": "u1", "int8": "i1",
    "uint16": "<u2", "int16": "<i2", "uint32": "<u4", "int32": "<i4", "uint64": "<u8",
    "int64": "<i8", "float32": "<f4", "float64": "<f8",
}  # fmt: skip
_TIME = "builtin_interfaces/msg/Time"


@functools.cache
def typestore() -> Typestore:
    """Return the message definitions of every recording Restock writes: ROS 2 Jazzy's."""
    return get_typestore(Stores.ROS2_JAZZY)


def build(type_name: str, /, **fields: Any) -> Any:
    """Build a message of `type_name`: every field zero, empty or identity, except `fields`.

    A dict for a field that is itself a message fills that message in the same way.
    """
    definition = typestore().fielddefs[type_name][1]
    unknown = fields.keys() - {name for name, _ in definition}
    if unknown:
        raise TypeError(f"{type_name} has no field {sorted(unknown)}")
    values = {name: _value(kind, details, fields.get(name)) for name, (kind, details) in definition}
    return typestore().types[type_name](**values)


def serialise(message: Any) -> bytes:
    """Serialise one message as little-endian CDR with its encapsulation header."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


@dataclass(frozen=True)
class Place:
    """The position of a number (or a run of them) in the serialised message."""

    offset: int
    dtype: np.dtype[Any]
    count: int


@dataclass(frozen=True)
class MessageLayout:
    """The layout of a message: an exemplar's bytes, and the place of every number in them.

    Places are named by path: `pose.pose.position.x`, `ranges` (the whole run),
    `transforms[0].header.stamp` (a time is one place: int64 nanoseconds). When packing, `[]`
    names that number of every item: `poses[].pose.position.x`.
    """

    type_name: str
    exemplar: bytes
    places: Mapping[str, Place]

    @classmethod
    def of(cls, exemplar: Any) -> MessageLayout:
        """Return the layout of all messages with the exemplar's strings and sequence lengths."""
        places: dict[str, Place] = {}
        data = serialise(exemplar)
        end = _walk(exemplar, "", ENCAPSULATION_BYTES, places)
        if end != len(data):  # rosbags and this file disagree about CDR: never write such bytes
            raise ValueError(f"{exemplar.__msgtype__}: walked {end} of {len(data)} bytes")
        return cls(exemplar.__msgtype__, data, places)

    def pack(self, columns: Mapping[str, NDArray[Any]], rows: int) -> list[bytes]:
        """Pack `rows` messages: the exemplar with the places in `columns` overwritten.

        Each column is (rows,), or (rows, count) for a run and for `[]`.

        Raises:
            KeyError: the message has no such place.
            ValueError: a column has the wrong shape.
        """
        table = np.tile(np.frombuffer(self.exemplar, np.uint8), (rows, 1))  # (rows, bytes)
        for path, column in columns.items():
            offsets, dtype = self._slots(path)
            values = np.asarray(column)
            wanted = (rows, len(offsets)) if len(offsets) > 1 or values.ndim > 1 else (rows,)
            if values.shape != wanted:
                raise ValueError(f"{self.type_name}.{path}: {values.shape}, not {wanted}")
            values = split_stamps(values) if dtype == _STAMP else values.astype(dtype)
            raw = np.ascontiguousarray(values).view(np.uint8)
            where = offsets[:, None] + np.arange(dtype.itemsize)
            table[:, where.ravel()] = raw.reshape(rows, where.size)
        size = table.shape[1]
        whole = table.tobytes()
        return [whole[start : start + size] for start in range(0, len(whole), size)]

    def _slots(self, path: str) -> tuple[NDArray[np.intp], np.dtype[Any]]:
        """Return the offset of every number at a path, and their type."""
        if "[]" not in path:
            place = self.places[path]
            step = place.dtype.itemsize
            return place.offset + step * np.arange(place.count), place.dtype
        before, _, after = path.partition("[]")
        places: list[Place] = []
        while (place_of_item := self.places.get(f"{before}[{len(places)}]{after}")) is not None:
            places.append(place_of_item)
        if not places:
            raise KeyError(path)
        return np.array([place.offset for place in places]), places[0].dtype


class Exemplar:
    """A message whose layout is computed on first use, since typestores are slow to build."""

    def __init__(self, type_name: str, /, **fields: Any) -> None:
        self._type_name, self._fields = type_name, fields

    @functools.cached_property
    def layout(self) -> MessageLayout:
        """Return the layout of messages like this one."""
        return MessageLayout.of(build(self._type_name, **self._fields))

    def pack(self, columns: Mapping[str, NDArray[Any]]) -> list[bytes]:
        """Pack one message per row of the columns, of which there is at least one."""
        return self.layout.pack(columns, len(next(iter(columns.values()))))


_STAMP = np.dtype([("sec", "<i4"), ("nanosec", "<u4")])


def split_stamps(stamp_ns: NDArray[Any]) -> NDArray[Any]:
    """Convert nanoseconds (…) int64 to `builtin_interfaces/Time` records of the same shape."""
    stamps = np.empty(stamp_ns.shape, _STAMP)
    stamps["sec"], stamps["nanosec"] = np.divmod(stamp_ns, 1_000_000_000)
    return stamps


def stamp(stamp_ns: int) -> Any:
    """Return one `builtin_interfaces/Time`."""
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return typestore().types[_TIME](sec=sec, nanosec=nanosec)


def _walk(message: Any, prefix: str, at: int, places: dict[str, Place]) -> int:
    """Note the places in a message that starts at or after byte `at`; return its end."""
    if message.__msgtype__ == _TIME:
        at = _align(at, 4)
        places[prefix.removesuffix(".")] = Place(at, _STAMP, 1)
        return at + 8
    for name, (kind, details) in typestore().fielddefs[message.__msgtype__][1]:
        at = _walk_field(getattr(message, name), f"{prefix}{name}", kind, details, at, places)
    return at


def _walk_field(
    value: Any, path: str, kind: Any, details: Any, at: int, places: dict[str, Place]
) -> int:
    match kind.name:
        case "BASE" if details[0] == "string":
            return _align(at, 4) + 4 + len(value.encode()) + 1
        case "BASE":
            dtype = np.dtype(_BASIC[details[0]])
            at = _align(at, dtype.itemsize)
            places[path] = Place(at, dtype, 1)
            return at + dtype.itemsize
        case "NAME":
            return _walk(value, f"{path}.", at, places)
    (item_kind, item_details), _ = details  # an array or a sequence
    if kind.name == "SEQUENCE":
        at = _align(at, 4) + 4
    if item_kind.name == "BASE" and item_details[0] != "string":
        dtype = np.dtype(_BASIC[item_details[0]])
        if len(value):  # an empty sequence takes no padding
            at = _align(at, dtype.itemsize)
            places[path] = Place(at, dtype, len(value))
        return at + dtype.itemsize * len(value)
    for index, item in enumerate(value):
        at = _walk_field(item, f"{path}[{index}]", item_kind, item_details, at, places)
    return at


def _align(at: int, size: int) -> int:
    return at + (-(at - ENCAPSULATION_BYTES)) % size


def _value(kind: Any, details: Any, given: Any) -> Any:
    """Return a field's given value in the type rosbags expects, or the field's empty value."""
    if kind.name == "NAME":
        if given is None or isinstance(given, Mapping):
            defaults = {"w": 1.0} if details.endswith("/Quaternion") else {}
            return build(details, **{**defaults, **(given or {})})
        return given
    if kind.name == "BASE":
        if details[0] == "string":
            return given or ""
        return given if given is not None else (False if details[0] == "bool" else 0)
    (item_kind, item_details), length = details
    if item_kind.name == "BASE" and item_details[0] != "string":
        dtype = np.bool_ if item_details[0] == "bool" else np.dtype(_BASIC[item_details[0]])
        size = length if kind.name == "ARRAY" else 0
        return np.zeros(size, dtype) if given is None else np.asarray(given, dtype)
    items: Sequence[Any] = given if given is not None else ()
    return [_value(item_kind, item_details, item) for item in items]
