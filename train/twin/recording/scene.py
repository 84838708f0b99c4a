"""What only the simulator knows of a mission, as messages: the scene, and the parameters in force.

A robot's own topics cannot show why it stopped. These can: pallets, patches, people, forklifts and
the goal as `visualization_msgs/MarkerArray`, which Foxglove and RViz draw in the `map` frame, and
the perturbation in force as JSON. All are under `/ground_truth/`: nothing that a policy may see.

Every array begins with a marker that deletes all before it, so that each message is the whole
scene: a viewer that jumps to any time draws from the last message alone.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.train.twin.floors.layout import (
    FORKLIFT_HALF_M,
    NO_PATCH,
    PALLET_HALF_M,
    PARKED_M,
    PEOPLE,
    PERSON_RADIUS_M,
)
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.recording.bag_writer import Topic
from restock.train.twin.recording.messages import MessageLayout, build, serialise, stamp

MARKERS, TRAFFIC, PERTURBATION = (
    f"/ground_truth/{name}" for name in ("markers", "traffic", "perturbation")
)
SCENE_TOPICS: tuple[Topic, ...] = (
    Topic(PERTURBATION, "std_msgs/msg/String", latched=True),
    Topic(MARKERS, "visualization_msgs/msg/MarkerArray", latched=True),
    Topic(TRAFFIC, "visualization_msgs/msg/MarkerArray", latched=True),
)
# The colours of the drawn map, as shares of 1, and opacity.
GOAL, PALLET, PATCH, ROBOT = (
    (0.12, 0.60, 0.25, 0.45),
    (0.69, 0.51, 0.31, 1.0),
    (0.30, 0.62, 0.85, 0.45),
    (0.94, 0.51, 0.12, 1.0),
)
PERSON, FORKLIFT = (0.18, 0.43, 0.78, 1.0), (0.90, 0.72, 0.08, 1.0)
PERSON_HEIGHT_M = 1.7
THIN_M = 0.01
_CUBE, _CYLINDER, _DELETE_ALL = 1, 3, 3


@dataclass(frozen=True)
class Scene:
    """What stands, lies and walks in the way of one mission of T steps."""

    pallets: F64  # (P, 3) x_m, y_m, yaw_rad; parked off the floor where there is none
    patches: F64  # (K, 5) x_m, y_m, half sizes, friction; no size where there is none
    traffic: F64  # (T + 1, A, 3) x_m, y_m, yaw_rad, the people first; parked while out of sight
    perturbation: Perturbation
    goal_radius_m: float
    body_m: tuple[float, float, float]  # length, width, height of the robot


EMPTY = Scene(
    pallets=np.zeros((0, 3)),
    patches=np.zeros((0, 5)),
    traffic=np.zeros((1, 0, 3)),
    perturbation=Perturbation(),
    goal_radius_m=0.4,
    body_m=(0.7, 0.5, 0.3),
)


def perturbation_text(perturbation: Perturbation) -> str:
    """`{"name", "values"}`: the fields that differ from the nominal twin's."""
    return json.dumps({"name": perturbation.name, "values": perturbation.changed()})


def mission_markers(stamp_ns: int, scene: Scene, goal_m: tuple[float, float]) -> bytes:
    """What stays where it is for a mission: goal, pallets, patches; and the robot's own body."""
    length, width, height = scene.body_m
    radius = 2 * scene.goal_radius_m
    markers = [
        _delete_all(stamp_ns),
        _marker(stamp_ns, "goal", 0, _CYLINDER, (*goal_m, 0.0), (radius, radius, THIN_M), GOAL),
        _marker(
            stamp_ns,
            "robot",
            0,
            _CUBE,
            (0.0, 0.0, 0.0),
            (length, width, height),
            ROBOT,
            frame="base_link",
            frame_locked=True,
        ),
    ]
    for index, place in enumerate(scene.pallets[on_floor(scene.pallets)]):
        size = tuple(2 * half for half in PALLET_HALF_M)
        markers.append(_marker(stamp_ns, "pallet", index, _CUBE, tuple(place), size, PALLET))
    for index, (x, y, half_x, half_y, _) in enumerate(
        scene.patches[scene.patches[:, 2] > NO_PATCH[2]]
    ):
        size = (2 * half_x, 2 * half_y, THIN_M)
        markers.append(_marker(stamp_ns, "patch", index, _CUBE, (x, y, 0.0), size, PATCH))
    return serialise(build("visualization_msgs/msg/MarkerArray", markers=markers))


def traffic_markers(stamp_ns: Ints, places: F64) -> list[bytes]:
    """People and forklifts at (n, A, 3) places, one message a row."""
    messages: list[bytes] = [b""] * len(places)
    shown = on_floor(places)
    for seen in {tuple(row) for row in shown.tolist()}:
        rows = np.flatnonzero((shown == seen).all(axis=1))
        layout = _traffic_layout(seen)
        agents = places[rows][:, np.array(seen, np.bool_)]
        columns: dict[str, NDArray[Any]] = {"markers[0].header.stamp": stamp_ns[rows]}
        for slot in range(agents.shape[1]):
            at = f"markers[{slot + 1}]"
            yaw = agents[:, slot, 2]
            columns |= {
                f"{at}.header.stamp": stamp_ns[rows],
                f"{at}.pose.position.x": agents[:, slot, 0],
                f"{at}.pose.position.y": agents[:, slot, 1],
                f"{at}.pose.orientation.z": np.sin(yaw / 2),
                f"{at}.pose.orientation.w": np.cos(yaw / 2),
            }
        for row, data in zip(rows.tolist(), layout.pack(columns, len(rows)), strict=True):
            messages[row] = data
    return messages


def on_floor(places: F64) -> Bools:
    """Which places (…, 2 or more) are not where bodies are parked that no episode uses."""
    return np.asarray(places[..., 0] > PARKED_M[0] / 2, np.bool_)


@functools.lru_cache(maxsize=64)
def _traffic_layout(seen: tuple[bool, ...]) -> MessageLayout:
    tall = 2 * PERSON_RADIUS_M
    markers = [_delete_all(0)]
    for agent in np.flatnonzero(seen).tolist():
        kind, shape, size, color = (
            ("person", _CYLINDER, (tall, tall, PERSON_HEIGHT_M), PERSON)
            if agent < PEOPLE
            else ("forklift", _CUBE, tuple(2 * half for half in FORKLIFT_HALF_M), FORKLIFT)
        )
        markers.append(_marker(0, kind, agent, shape, (0.0, 0.0, 0.0), size, color))
    return MessageLayout.of(build("visualization_msgs/msg/MarkerArray", markers=markers))


def _delete_all(stamp_ns: int) -> dict[str, Any]:
    return {"header": {"frame_id": "map", "stamp": stamp(stamp_ns)}, "action": _DELETE_ALL}


def _marker(
    stamp_ns: int,
    kind: str,
    index: int,
    shape: int,
    place: tuple[float, ...],  # x, y, yaw
    size: tuple[float, ...],
    color: tuple[float, float, float, float],
    *,
    frame: str = "map",
    frame_locked: bool = False,
) -> dict[str, Any]:
    """A marker that stands on the floor."""
    x, y, yaw = place
    return {
        "header": {"frame_id": frame, "stamp": stamp(stamp_ns)},
        "ns": kind,
        "id": index,
        "type": shape,
        "pose": {
            "position": {"x": float(x), "y": float(y), "z": size[2] / 2},
            "orientation": {"z": float(np.sin(yaw / 2)), "w": float(np.cos(yaw / 2))},
        },
        "scale": dict(zip("xyz", map(float, size), strict=True)),
        "color": dict(zip("rgba", color, strict=True)),
        "frame_locked": frame_locked,
    }
