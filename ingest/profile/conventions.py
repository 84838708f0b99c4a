"""What messages of each type say in place of a value that was not measured.

A driver that measures no yaw rate still publishes one, and says in a field beside it that it means
nothing. `CONVENTIONS` is the one place that knows these fields: inputs, custom signals and proposed
profiles ask it. A value that a message gives up is NaN, which rows have as null.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import numpy as np

from restock.arrays import F64, Bools
from restock.ingest.decoding.columns import FieldColumn, Ragged
from restock.ingest.profile.inputs import last_part
from restock.ingest.profile.signal_paths import element_of


@dataclass(frozen=True)
class Convention:
    """A way in which messages of one type mark values that were not measured.

    `read` takes values (V,) and, for each of them, what the fields `said_by` say of its message; it
    returns the values with NaN for what was not measured.
    """

    type: str  # its last part, as JSON and protobuf have types of other packages' names
    values: tuple[str, ...]  # fields; with each, all below it
    said_by: tuple[str, ...]
    read: Callable[..., F64]
    words: str

    @property
    def fields(self) -> list[str]:
        """Return the field paths to read for it."""
        return [element_of(path)[0] for path in self.said_by]

    @property
    def of_messages(self) -> bool:
        """Return whether a message marks all these values at once, whatever they are."""
        return self.read is _unless_minus_one or self.read is _unless_negative

    def flags(self, columns: Mapping[str, FieldColumn]) -> Bools:
        """Return which messages (N,) give up these values."""
        said = [said_in(columns, path) for path in self.said_by]
        return np.asarray(np.isnan(self.read(np.zeros(len(said[0])), *said)), np.bool_)


def _unless_minus_one(values: F64, variance: F64) -> F64:
    return np.where(variance == -1, np.nan, values)


def _unless_negative(values: F64, status: F64) -> F64:
    return np.where(status < 0, np.nan, values)


def _unless_nan(values: F64) -> F64:
    return values


def _within(values: F64, low: F64, high: F64) -> F64:
    """Return the values with NaN outside the limits; -inf is too close to be measured (REP 117)."""
    near = np.where(np.isneginf(values), low, values)
    given = (high > 0) & (low <= high)  # else the driver gives no limits
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
    # Drivers of wheels alone, or of poses alone, do the same with the other half.
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
        _unless_nan,
        "NaN",
    ),
    # sensor_msgs/Range and LaserScan: "values < range_min or > range_max should be discarded". Of
    # the scans that fill an input, `restock.ingest.task.scan` makes clearance.
    Convention(
        "Range",
        ("range",),
        ("min_range", "max_range"),
        _within,
        "outside min_range to max_range",
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
    """Return what messages of this type say of the value at a path, by the `fields` they have."""
    bare = re.sub(r"\[[^\]]*\]", "", path)
    return [
        one
        for one in CONVENTIONS
        if one.type == last_part(kind)
        and any(bare == value or bare.startswith(f"{value}.") for value in one.values)
        and (fields is None or set(one.fields) <= set(fields))
    ]


def said_in(columns: Mapping[str, FieldColumn], path: str) -> F64:
    """Return a field of each message (N,), or one element of its list; NaN if that is shorter."""
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
