"""The signals of drift in words: the name and unit of each, what it tells of, how it changed.

A row compares one signal of a robot in a period, as `restock.replay.fleet.drift` gives it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from restock.replay.store.definitions import UNITS
from restock.replay.store.definitions import unit as unit_of
from restock.report.look.blocks import Rows, words

_MEANINGS = {  # what a signal measures; docs/coverage.md says how
    "odometry_scale": "localised metres per metre that the wheels report, driving straight",
    "wheel_yaw_scale": "yaw rate of the gyroscope divided by that of the wheels, when turning",
    "wheel_pull_radpm": "turn that the wheels did not report, per metre of straight driving",
    "command_gain": "wheel speed divided by the command, when the command is held",
    "command_response": "share of a changed command that is reached within one step",
    "gyro_bias_radps": "gyroscope minus the turn of the pose, driving straight",
    "accel_bias_mps2": "acceleration at a steady speed: bias, or a slope of the floor",
    "vibration_mps2": "spread of the acceleration at a steady speed",
    "localiser_jitter_mps": "sideways speed of the poses, driving straight",
    "localiser_age_s": "age of the pose at a step",
    "lidar_noise_m": "noise of a sector's range over three steps, driving straight",
    "silent_sectors": "lidar sectors with no return, or a constant one, for a whole episode",
}


def signal_name(row: dict[str, Any]) -> str:
    """`wheel pull (rad/m)`; of a condition its events, and the zone where there is one."""
    name, unit = row["signal"], unit_of(row["signal"])
    ending = next((ending for ending, _ in UNITS if unit and name.endswith(ending)), "")
    name = words(name.removesuffix(ending)) + (f" ({unit})" if unit else "")
    if row["part"] == "conditions":
        name += " events"
    zone = row.get("zone")
    return f"{name} in {zone}" if zone else name


def by_part(row: dict[str, Any]) -> tuple[str, str]:
    """Return the key that sorts signals on a page."""
    return str(row["part"]), str(row["signal"])


def meanings(rows: Iterable[dict[str, Any]]) -> Rows:
    """Return what the signals of these rows mean, in the order of their parts."""
    signals = {row["signal"]: row for row in sorted(rows, key=by_part)}
    return [
        {"signal": signal_name(row), "part": row["part"], "what it is": _MEANINGS[name]}
        for name, row in signals.items()
        if name in _MEANINGS
    ]


def change_text(row: dict[str, Any]) -> str:
    """`× 0.942 [0.935, 0.950]`, or a difference with its sign."""
    if row["change"] is None:
        return ""
    ratio = row["compared"] == "ratio"
    values = [row["change"], row["change_low"], row["change_high"]]
    least = 0.0 if ratio else 1e-3 * max(abs(row["change_low"]), abs(row["change_high"]))
    value, low, high = (  # values far below the interval's width are zero
        f"{v:.3f}" if ratio else f"{v if abs(v) >= least else 0.0:+.3g}" for v in values
    )
    unit = " sd" if row["compared"] == "spread" else ""
    return f"{'× ' if ratio else ''}{value}{unit} [{low}, {high}]"


def signed_size(row: dict[str, Any]) -> float:
    """Return the size of a change in least changes that matter, negative for a fall."""
    neutral = 1.0 if row["compared"] == "ratio" else 0.0
    return float(row["size"]) * (1 if row["change"] >= neutral else -1)


def value_text(value: float | None) -> str:
    """Format three digits; nothing if there is no value."""
    return "" if value is None else f"{value:.3g}"
