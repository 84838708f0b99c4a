"""A driven mission, and the topics that the recorded robot publishes about it.

They are the topics that the `warehouse_amr` profile reads, with the names and frames of a Nav2
robot (REP 105: map > odom > base_link), so that Foxglove and RViz show a recording without
configuration. Every function that packs messages takes columns of (n,) values and timestamps of
(n,) int64 nanoseconds.

A robot's own topics cannot show why it stopped. Those under `/ground_truth/` can, and no policy may
see them: pallets, patches, people, forklifts and the goal as `visualization_msgs/MarkerArray`,
which Foxglove and RViz draw in the `map` frame, and the perturbation as JSON. Every array begins
with a marker that deletes all earlier ones, so each message is the whole scene: a viewer that jumps
to any time needs only the last message.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.ingest.task.task import Signals
from restock.train.twin.floors.layout import (
    FORKLIFT_HALF_M,
    NO_PATCH,
    PALLET_HALF_M,
    PARKED_M,
    PEOPLE,
    PERSON_RADIUS_M,
)
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.recording.bag_writer import (
    Exemplar,
    Topic,
    build,
    serialise,
    stamp,
)

ENCODER_LSB_RAD = 2 * np.pi / 4096


@dataclass(frozen=True)
class Lidar:
    """The geometry of a planar lidar's scan, in its own frame."""

    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    x_m: float = 0.0  # ahead of the robot's middle


@dataclass(frozen=True)
class Motion:
    """The true motion, sampled at M times of the mission, the start included."""

    time_s: F64  # (M,) from the start of the mission
    pose: F64  # (M, 3) x_m, y_m, yaw_rad (not wrapped) in the map
    wheel_angle_rad: F64  # (M, 2) left, right
    wheel_rate_radps: F64  # (M, 2)
    yaw_rate_radps: F64  # (M,)
    accel_mps2: F64  # (M, 2) of the body, forward and left
    bumped: Bools  # (M,) the bumper touched something since the previous sample

    def at(self, values: F64, time_s: F64) -> F64:
        """Return a column, (M,) or (M, 2), interpolated at times (n,)."""
        if values.ndim == 1:
            return np.interp(time_s, self.time_s, values)
        columns = [np.interp(time_s, self.time_s, column) for column in values.T]
        return np.stack(columns, axis=-1)


@dataclass(frozen=True)
class Drive:
    """A mission: true motion between the control ticks, and signals and actions at them.

    There are T commands and T + 1 ticks: the last tick is where the mission ended.
    """

    goal_m: tuple[float, float]
    motion: Motion
    tick_s: F64  # (T + 1,) from the start of the mission
    signals: Signals  # each (T + 1, …): what the policy saw
    scan_s: F64  # (K,) when the lidar scanned; the first tick is among them
    ranges_m: F64  # (K, B) as measured; inf if nothing came back
    command: F64  # (T, 2) speed_mps, yaw_rate_radps
    true_condition: list[str]  # T
    true_exposure: list[str]  # T
    policy: list[tuple[str, str, float]]  # T of (name, version, probability of the action)
    plans: list[tuple[int, F64]]  # (tick from which the plan holds, (P, 2) points)
    pallets: F64  # (P, 3) x_m, y_m, yaw_rad; unused pallets are parked off the floor
    patches: F64  # (K, 5) x_m, y_m, half sizes, friction; the size of unused patches is 0
    traffic: F64  # (T + 1, A, 3) x_m, y_m, yaw_rad, the people first; parked while out of sight
    perturbation: Perturbation
    goal_radius_m: float
    body_m: tuple[float, float, float]  # length, width, height of the robot


@dataclass
class Odometer:
    """Wheel odometry: the pose in `odom`, from the encoders alone."""

    wheel_radius_m: float  # radius that the odometry assumes
    track_m: float
    pose: F64 = field(default_factory=lambda: np.zeros(3))  # x, y, yaw as the mission starts
    wheel_angle_rad: F64 = field(default_factory=lambda: np.zeros(2))

    def dead_reckoning(self, motion: Motion) -> F64:
        """Return the pose at every time of the motion, (M, 3)."""
        ticks = np.floor((self.wheel_angle_rad + motion.wheel_angle_rad) / ENCODER_LSB_RAD)
        rolled = np.diff(ticks, axis=0) * (ENCODER_LSB_RAD * self.wheel_radius_m)  # (M - 1, 2)
        turn = (rolled[:, 1] - rolled[:, 0]) / self.track_m
        x, y, yaw = self.pose
        heading = yaw + np.concatenate([[0.0], np.cumsum(turn)])
        ahead = rolled.mean(axis=1)
        middle = heading[:-1] + turn / 2
        return np.stack(
            [
                x + np.concatenate([[0.0], np.cumsum(ahead * np.cos(middle))]),
                y + np.concatenate([[0.0], np.cumsum(ahead * np.sin(middle))]),
                heading,
            ],
            axis=-1,
        )

    def speeds(self, rate_radps: F64) -> tuple[F64, F64]:
        """Return speeds in m/s and yaw rates in rad/s (n,) of wheels turning at rates (n, 2)."""
        speed = rate_radps.mean(axis=1) * self.wheel_radius_m
        turn = (rate_radps[:, 1] - rate_radps[:, 0]) * (self.wheel_radius_m / self.track_m)
        return speed, turn

    def wheel_angles(self, motion: Motion, time_s: F64) -> F64:
        """Return the encoders' readings at these times, (n, 2)."""
        angle = self.wheel_angle_rad + motion.at(motion.wheel_angle_rad, time_s)
        return np.floor(angle / ENCODER_LSB_RAD) * ENCODER_LSB_RAD

    def carry_on(self, motion: Motion, reckoned: F64) -> None:
        """Begin the next mission where this motion ended."""
        turned = motion.wheel_angle_rad[-1] - motion.wheel_angle_rad[0]
        self.wheel_angle_rad = self.wheel_angle_rad + turned
        self.pose = reckoned[-1]


MARKERS, TRAFFIC, PERTURBATION = (
    f"/ground_truth/{name}" for name in ("markers", "traffic", "perturbation")
)
TOPICS: tuple[Topic, ...] = (
    Topic("/tf_static", "tf2_msgs/msg/TFMessage", latched=True),
    Topic("/map", "nav_msgs/msg/OccupancyGrid", latched=True),
    Topic("/behaviour_policy", "std_msgs/msg/String", latched=True),
    Topic("/goal_pose", "geometry_msgs/msg/PoseStamped"),
    Topic("/plan", "nav_msgs/msg/Path"),
    Topic("/odom", "nav_msgs/msg/Odometry"),
    Topic("/imu", "sensor_msgs/msg/Imu", reliable=False),
    Topic("/joint_states", "sensor_msgs/msg/JointState"),
    Topic("/scan", "sensor_msgs/msg/LaserScan", reliable=False),
    Topic("/bumper", "std_msgs/msg/Bool"),
    Topic("/amcl_pose", "geometry_msgs/msg/PoseWithCovarianceStamped", latched=True),
    Topic("/tf", "tf2_msgs/msg/TFMessage"),
    Topic("/ground_truth/condition", "std_msgs/msg/String"),
    Topic("/ground_truth/exposure", "std_msgs/msg/String"),
    Topic("/cmd_vel_nav", "geometry_msgs/msg/Twist"),
    Topic("/cmd_vel", "geometry_msgs/msg/Twist"),
    Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
    Topic(PERTURBATION, "std_msgs/msg/String", latched=True),
    Topic(MARKERS, "visualization_msgs/msg/MarkerArray", latched=True),
    Topic(TRAFFIC, "visualization_msgs/msg/MarkerArray", latched=True),
)
LASER_FRAME, IMU_FRAME = "laser_link", "imu_link"
WHEEL_JOINTS = ("left_wheel_joint", "right_wheel_joint")


def _diagonal(size: int, entries: Mapping[int, float]) -> F64:
    values = np.zeros((size, size))
    for index, value in entries.items():
        values[index, index] = value
    return values.ravel()


_ODOMETRY = Exemplar(
    "nav_msgs/msg/Odometry",
    header={"frame_id": "odom"},
    child_frame_id="base_link",
    pose={"covariance": _diagonal(6, {0: 1e-3, 1: 1e-3, 5: 1e-2})},
    twist={"covariance": _diagonal(6, {0: 1e-4, 1: 1e-6, 5: 1e-3})},
)
_IMU = Exemplar(
    "sensor_msgs/msg/Imu",
    header={"frame_id": IMU_FRAME},
    orientation_covariance=[-1.0] + [0.0] * 8,
    angular_velocity_covariance=_diagonal(3, {0: 4e-4, 1: 4e-4, 2: 4e-4}),
    linear_acceleration={"z": 9.80665},
    linear_acceleration_covariance=_diagonal(3, {0: 1e-2, 1: 1e-2, 2: 1e-2}),
)
_JOINTS = Exemplar(
    "sensor_msgs/msg/JointState",
    name=WHEEL_JOINTS,
    position=np.zeros(2),
    velocity=np.zeros(2),
)
_POSE = Exemplar(
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    header={"frame_id": "map"},
    pose={"covariance": _diagonal(6, {0: 4e-4, 1: 4e-4, 5: 1e-4})},
)
_TRANSFORMS = Exemplar(
    "tf2_msgs/msg/TFMessage",
    transforms=[
        {"header": {"frame_id": "map"}, "child_frame_id": "odom"},
        {"header": {"frame_id": "odom"}, "child_frame_id": "base_link"},
    ],
)
_TWIST, _BOOL = Exemplar("geometry_msgs/msg/Twist"), Exemplar("std_msgs/msg/Bool")


def odometry(
    stamp_ns: Ints, x_m: F64, y_m: F64, yaw_rad: F64, speed_mps: F64, yaw_rate_radps: F64
) -> list[bytes]:
    """Return odometry messages: the pose in `odom`, the twist in `base_link`."""
    return _ODOMETRY.pack(
        {
            "header.stamp": stamp_ns,
            "pose.pose.position.x": x_m,
            "pose.pose.position.y": y_m,
            **_orientation("pose.pose.orientation", yaw_rad),
            "twist.twist.linear.x": speed_mps,
            "twist.twist.angular.z": yaw_rate_radps,
        }
    )


def imu(stamp_ns: Ints, yaw_rate_radps: F64, accel_x_mps2: F64, accel_y_mps2: F64) -> list[bytes]:
    """Return IMU messages without orientation (covariance[0] = -1, as in sensor_msgs/Imu)."""
    return _IMU.pack(
        {
            "header.stamp": stamp_ns,
            "angular_velocity.z": yaw_rate_radps,
            "linear_acceleration.x": accel_x_mps2,
            "linear_acceleration.y": accel_y_mps2,
        }
    )


def joint_states(stamp_ns: Ints, angle_rad: F64, rate_radps: F64) -> list[bytes]:
    """Return joint states with wheel angles and rates, each (n, 2): left, right."""
    return _JOINTS.pack({"header.stamp": stamp_ns, "position": angle_rad, "velocity": rate_radps})


def scans(stamp_ns: Ints, ranges_m: F64, lidar: Lidar, scan_time_s: float) -> list[bytes]:
    """Return lidar scans: ranges (n, B), inf if nothing came back."""
    beams = ranges_m.shape[1]
    scan = Exemplar(
        "sensor_msgs/msg/LaserScan",
        header={"frame_id": LASER_FRAME},
        angle_min=lidar.angle_min_rad,
        angle_max=lidar.angle_min_rad + lidar.angle_increment_rad * (beams - 1),
        angle_increment=lidar.angle_increment_rad,
        scan_time=scan_time_s,
        range_min=lidar.range_min_m,
        range_max=lidar.range_max_m,
        ranges=np.zeros(beams, np.float32),
    )
    return scan.pack({"header.stamp": stamp_ns, "ranges": ranges_m})


def commands(speed_mps: F64, yaw_rate_radps: F64) -> list[bytes]:
    """Return velocity commands."""
    return _TWIST.pack({"linear.x": speed_mps, "angular.z": yaw_rate_radps})


def localised_poses(stamp_ns: Ints, x_m: F64, y_m: F64, yaw_rad: F64) -> list[bytes]:
    """Return poses in `map`, as a localiser publishes them."""
    return _POSE.pack(
        {
            "header.stamp": stamp_ns,
            "pose.pose.position.x": x_m,
            "pose.pose.position.y": y_m,
            **_orientation("pose.pose.orientation", yaw_rad),
        }
    )


def transforms(
    stamp_ns: Ints, map_to_odom: tuple[F64, F64, F64], odom_to_base: tuple[F64, F64, F64]
) -> list[bytes]:
    """Return transforms map > odom > base_link; each is (x, y, yaw) of (n,) values."""
    columns: dict[str, NDArray[Any]] = {}
    for index, (x_m, y_m, yaw_rad) in enumerate((map_to_odom, odom_to_base)):
        at = f"transforms[{index}]"
        columns |= {
            f"{at}.header.stamp": stamp_ns,
            f"{at}.transform.translation.x": x_m,
            f"{at}.transform.translation.y": y_m,
            **_orientation(f"{at}.transform.rotation", yaw_rad),
        }
    return _TRANSFORMS.pack(columns)


def static_transforms(stamp_ns: int, lidar_x_m: float) -> bytes:
    """Return the transforms of the lidar and the IMU on the robot."""
    return serialise(
        build(
            "tf2_msgs/msg/TFMessage",
            transforms=[
                {
                    "header": {"frame_id": "base_link", "stamp": stamp(stamp_ns)},
                    "child_frame_id": frame,
                    "transform": {"translation": {"x": x, "z": z}},
                }
                for frame, x, z in ((LASER_FRAME, lidar_x_m, 0.2), (IMU_FRAME, 0.0, 0.1))
            ],
        )
    )


def bumpers(pressed: Bools) -> list[bytes]:
    """Return bumper states."""
    return _BOOL.pack({"data": pressed})


@functools.lru_cache(maxsize=256)
def text(content: str) -> bytes:
    """Return a text as a serialised string message."""
    return serialise(build("std_msgs/msg/String", data=content))


def behaviour_policy(name: str, version: str, probability: float) -> bytes:
    """Return the policy that drives from here on, and the probability of each of its commands."""
    content = {"policy": name, "version": version, "probability": round(probability, 4)}
    return text(json.dumps(content))


def goal(stamp_ns: int, x_m: float, y_m: float) -> bytes:
    """Return a navigation goal in `map`."""
    return serialise(
        build(
            "geometry_msgs/msg/PoseStamped",
            header={"frame_id": "map", "stamp": stamp(stamp_ns)},
            pose={"position": {"x": float(x_m), "y": float(y_m)}},
        )
    )


def plan(stamp_ns: int, points_m: F64) -> bytes:
    """Return a plan in `map`: (P, 2) points, each facing the next."""
    step = np.diff(points_m, axis=0, append=points_m[-1:])
    if len(step) > 1:
        step[-1] = step[-2]
    yaw = np.arctan2(step[:, 1], step[:, 0])
    columns = {
        "header.stamp": np.array([stamp_ns]),
        "poses[].header.stamp": np.full((1, len(points_m)), stamp_ns),
        "poses[].pose.position.x": points_m[None, :, 0],
        "poses[].pose.position.y": points_m[None, :, 1],
        **_orientation("poses[].pose.orientation", yaw[None]),
    }
    return _path(len(points_m)).pack(columns)[0]


@functools.lru_cache(maxsize=512)
def _path(points: int) -> Exemplar:
    header = {"frame_id": "map"}
    return Exemplar("nav_msgs/msg/Path", header=header, poses=[{"header": header}] * points)


def occupancy_map(
    stamp_ns: int,
    occupied: Bools,
    resolution_m: float,
    origin_m: tuple[float, float] = (0.0, 0.0),
) -> bytes:
    """Return the known map; cells are rows to the north and columns to the east of `origin_m`."""
    return serialise(
        build(
            "nav_msgs/msg/OccupancyGrid",
            header={"frame_id": "map", "stamp": stamp(stamp_ns)},
            info={
                "map_load_time": stamp(stamp_ns),
                "resolution": resolution_m,
                "width": occupied.shape[1],
                "height": occupied.shape[0],
                "origin": {"position": {"x": origin_m[0], "y": origin_m[1]}},
            },
            data=np.where(occupied, 100, 0).astype(np.int8).ravel(),
        )
    )


def diagnostics(
    stamp_ns: int, statuses: Sequence[tuple[str, int, str, Mapping[str, str]]]
) -> bytes:
    """Return statuses from (name, level, message, values): level 0 OK, 1 warning, 2 error."""
    return serialise(
        build(
            "diagnostic_msgs/msg/DiagnosticArray",
            header={"stamp": stamp(stamp_ns)},
            status=[
                {
                    "name": name,
                    "level": level,
                    "message": message,
                    "hardware_id": "simulated stand-in",
                    "values": [{"key": key, "value": value} for key, value in values.items()],
                }
                for name, level, message, values in statuses
            ],
        )
    )


def _orientation(path: str, yaw_rad: F64) -> dict[str, F64]:
    return {f"{path}.z": np.sin(yaw_rad / 2), f"{path}.w": np.cos(yaw_rad / 2)}


# Red, green, blue and opacity, each 0 to 1: the colours of `restock.train.twin.env.render`.
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


def perturbation_text(perturbation: Perturbation) -> str:
    """Return `{"name", "values"}` with the fields that differ from the nominal twin's."""
    return json.dumps({"name": perturbation.name, "values": perturbation.changed()})


def mission_markers(stamp_ns: int, drive: Drive) -> bytes:
    """Return a mission's fixed markers: goal, pallets, patches, and the robot's own body."""
    wide = 2 * drive.goal_radius_m
    place, disc = (*drive.goal_m, 0.0), (wide, wide, THIN_M)
    body: dict[str, Any] = {"frame": "base_link", "frame_locked": True}
    markers = [
        _delete_all(stamp_ns),
        _marker(stamp_ns, "goal", 0, _CYLINDER, place, disc, GOAL),
        _marker(stamp_ns, "robot", 0, _CUBE, (0.0, 0.0, 0.0), drive.body_m, ROBOT, **body),
    ]
    for index, place in enumerate(drive.pallets[on_floor(drive.pallets)]):
        size = tuple(2 * half for half in PALLET_HALF_M)
        markers.append(_marker(stamp_ns, "pallet", index, _CUBE, tuple(place), size, PALLET))
    for index, (x, y, half_x, half_y, _) in enumerate(
        drive.patches[drive.patches[:, 2] > NO_PATCH[2]]
    ):
        size = (2 * half_x, 2 * half_y, THIN_M)
        markers.append(_marker(stamp_ns, "patch", index, _CUBE, (x, y, 0.0), size, PATCH))
    return serialise(build("visualization_msgs/msg/MarkerArray", markers=markers))


def traffic_markers(stamp_ns: Ints, places: F64) -> list[bytes]:
    """Return markers of people and forklifts at places (n, A, 3), one message per row."""
    messages: list[bytes] = [b""] * len(places)
    shown = on_floor(places)
    for seen in {tuple(row) for row in shown.tolist()}:
        rows = np.flatnonzero((shown == seen).all(axis=1))
        exemplar = _traffic(seen)
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
        for row, data in zip(rows.tolist(), exemplar.pack(columns), strict=True):
            messages[row] = data
    return messages


def on_floor(places: F64) -> Bools:
    """Return which places (…, 2 or more) are on the floor, not among parked bodies."""
    return np.asarray(places[..., 0] > PARKED_M[0] / 2, np.bool_)


@functools.lru_cache(maxsize=64)
def _traffic(seen: tuple[bool, ...]) -> Exemplar:
    wide = 2 * PERSON_RADIUS_M
    markers = [_delete_all(0)]
    for agent in np.flatnonzero(seen).tolist():
        kind, shape, size, color = (
            ("person", _CYLINDER, (wide, wide, PERSON_HEIGHT_M), PERSON)
            if agent < PEOPLE
            else ("forklift", _CUBE, tuple(2 * half for half in FORKLIFT_HALF_M), FORKLIFT)
        )
        markers.append(_marker(0, kind, agent, shape, (0.0, 0.0, 0.0), size, color))
    return Exemplar("visualization_msgs/msg/MarkerArray", markers=markers)


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
    """Return a marker that stands on the floor."""
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
