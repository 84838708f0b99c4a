"""The MuJoCo model of the twin, built with MjSpec, and measurements of its robot.

Pallets and traffic are mocap bodies, so that a layout is only a set of positions.

Wheels sink a little into the floor through their soft contacts, which makes small wheels roll more
slowly. A robot whose wheels scrub turns more slowly than its wheel speeds suggest. Both effects are
measured here once, so that every robot drives at the commanded speed, and its odometry is right.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import mujoco
import numpy as np

from restock.arrays import F64
from restock.errors import ConfigError
from restock.ingest.task.robot import Lidar, Robot
from restock.ingest.task.task import Body
from restock.train.twin.floors.layout import (
    FORKLIFT_HALF_M,
    FORKLIFTS,
    PALLET_HALF_M,
    PALLETS,
    PARKED_M,
    PEOPLE,
    PERSON_HALF_HEIGHT_M,
    PERSON_RADIUS_M,
    Warehouse,
)
from restock.train.twin.physics.robot_model import (
    FLOOR,
    FLOOR_FRICTION,
    FLOOR_GROUP,
    FLOOR_MASK,
    OBSTACLE_GROUP,
    OBSTACLE_MASK,
    RobotModel,
    design,
    stand_in,
)
from restock.train.twin.physics.robot_parts import add_robot, wheel_names

# Half sizes of the mocap bodies (M, 3), in the model's order; a person is a cylinder.
MOVING_HALF_M = np.repeat(
    [PALLET_HALF_M, (PERSON_RADIUS_M, PERSON_RADIUS_M, PERSON_HALF_HEIGHT_M), FORKLIFT_HALF_M],
    [PALLETS, PEOPLE, FORKLIFTS],
    axis=0,
)
PARKED_RACK_M = (-60.0, -60.0, 1.0)
RACK_HALF_HEIGHT_M = 0.75
WALL_HALF_HEIGHT_M = 0.5


@dataclass(frozen=True)
class Handles:
    """The indices of the twin's parts in the model's arrays."""

    chassis_body: int
    wheel_bodies: tuple[int, ...]  # left before right, front axle before rear axle
    wheel_geoms: tuple[int, ...]
    wheel_qpos: tuple[int, ...]  # the wheels' angles
    wheel_qvel: tuple[int, ...]  # the wheels' speeds
    steering_qpos: tuple[int, ...]  # the angles of steered front wheels, left and right
    building: slice  # the geoms of racks and walls
    pallets: slice  # the mocap bodies of pallets
    people: slice
    forklifts: slice
    accelerometer: slice  # the accelerometer's values in sensordata
    bumper: int


def build_model(
    warehouse: Warehouse, robot: RobotModel, timestep_s: float = 0.01, rack_slots: int | None = None
) -> tuple[mujoco.MjModel, Handles]:
    """Build the compiled model, whose state is the chassis' free joint and the wheels' joints.

    It has `rack_slots` boxes for racks (None: one per rack of the floor). Boxes without a rack are
    parked at `PARKED_RACK_M`.
    """
    spec = _spec(timestep_s)
    slots = len(warehouse.racks) if rack_slots is None else rack_slots
    _add_building(spec, warehouse, slots, robot.lidar_z_m)
    add_robot(spec, robot)
    _add_mocap(spec)
    model = spec.compile()
    return model, _handles(model, robot)


def build_robot_alone(robot: RobotModel, timestep_s: float = 0.01) -> mujoco.MjModel:
    """Build the robot on an endless floor."""
    spec = _spec(timestep_s)
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], friction=FLOOR, **FLOOR_MASK
    )
    add_robot(spec, robot)
    return spec.compile()


def _spec(timestep_s: float) -> Any:
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep = timestep_s
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.noslip_iterations = 0
    # With one robot and few boxes, both features only cost time (8 % and 3 % of a step).
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    return spec


def building_boxes(
    warehouse: Warehouse, rack_slots: int, lidar_z_m: float = 0.0
) -> tuple[F64, F64]:
    """Return centres and half sizes (rack_slots + 4, 3) of racks and walls, in model order.

    The boxes are high enough for the lidar to see them.
    """
    thick, width, depth = warehouse.wall_m, warehouse.width_m, warehouse.depth_m
    rack_z_m, wall_z_m = (
        max(half, lidar_z_m / 2 + 0.05) for half in (RACK_HALF_HEIGHT_M, WALL_HALF_HEIGHT_M)
    )
    middle = np.full((rack_slots + 4, 3), PARKED_RACK_M)
    half = np.full((rack_slots + 4, 3), 0.1)
    for index, rack in enumerate(warehouse.racks[:rack_slots]):
        middle[index] = (*rack.center, rack_z_m)
        half[index] = (*rack.half_size, rack_z_m)
    for index, (center, size) in enumerate(
        (
            ((-thick, depth / 2), (thick, depth / 2 + 2 * thick)),
            ((width + thick, depth / 2), (thick, depth / 2 + 2 * thick)),
            ((width / 2, -thick), (width / 2, thick)),
            ((width / 2, depth + thick), (width / 2, thick)),
        )
    ):
        middle[rack_slots + index] = (*center, wall_z_m)
        half[rack_slots + index] = (*size, wall_z_m)
    return middle, half


def _add_building(spec: Any, warehouse: Warehouse, rack_slots: int, lidar_z_m: float) -> None:
    world = spec.worldbody
    world.add_light(pos=[warehouse.width_m / 2, warehouse.depth_m / 2, 8], dir=[0, 0, -1])
    world.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[warehouse.width_m / 2, warehouse.depth_m / 2, 0],
        size=[warehouse.width_m, warehouse.depth_m, 0.1],
        friction=FLOOR,
        rgba=[0.82, 0.83, 0.84, 1],
        group=FLOOR_GROUP,
        **FLOOR_MASK,
    )
    names = [f"rack_{index}" for index in range(rack_slots)]
    names += [f"wall_{side}" for side in ("west", "east", "south", "north")]
    for name, middle, half in zip(
        names, *building_boxes(warehouse, rack_slots, lidar_z_m), strict=True
    ):
        world.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=middle,
            size=half,
            rgba=[0.36, 0.43, 0.53, 1] if name.startswith("rack") else [0.62, 0.64, 0.66, 1],
            group=OBSTACLE_GROUP,
            **OBSTACLE_MASK,
        )


def _add_mocap(spec: Any) -> None:
    box, cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    person = (PERSON_RADIUS_M, PERSON_HALF_HEIGHT_M, 0.0)
    for kind, count, shape, size, rgba in (
        ("pallet", PALLETS, box, PALLET_HALF_M, [0.70, 0.52, 0.32, 1]),
        ("person", PEOPLE, cylinder, person, [0.20, 0.45, 0.80, 1]),
        ("forklift", FORKLIFTS, box, FORKLIFT_HALF_M, [0.90, 0.75, 0.10, 1]),
    ):
        for index in range(count):
            body = spec.worldbody.add_body(name=f"{kind}_{index}", mocap=True, pos=list(PARKED_M))
            body.add_geom(
                type=shape, size=list(size), rgba=rgba, group=OBSTACLE_GROUP, **OBSTACLE_MASK
            )


def _handles(model: mujoco.MjModel, robot: RobotModel) -> Handles:
    def mocap(kind: str, count: int) -> slice:
        first = int(model.body(f"{kind}_0").mocapid[0])
        return slice(first, first + count)

    wheels = [f"{name}_wheel" for name in wheel_names(robot)]
    joints = [model.joint(f"{name}_joint") for name in wheels]
    sides = ("left", "right") if robot.steers else ()
    steering = [model.joint(f"front_{side}_steering") for side in sides]
    accelerometer = int(model.sensor("accelerometer").adr[0])
    return Handles(
        chassis_body=int(model.geom_bodyid[model.geom("chassis").id]),
        wheel_bodies=tuple(model.body(name).id for name in wheels),
        wheel_geoms=tuple(model.geom(name).id for name in wheels),
        wheel_qpos=tuple(int(joint.qposadr[0]) for joint in joints),
        wheel_qvel=tuple(int(joint.dofadr[0]) for joint in joints),
        steering_qpos=tuple(int(joint.qposadr[0]) for joint in steering),
        building=slice(model.geom("floor").id + 1, model.geom("wall_north").id + 1),
        pallets=mocap("pallet", PALLETS),
        people=mocap("person", PEOPLE),
        forklifts=mocap("forklift", FORKLIFTS),
        accelerometer=slice(accelerometer, accelerometer + 3),
        bumper=int(model.sensor("bumper").adr[0]),
    )


def passed_over(lidar_z_m: float) -> list[str]:
    """Return the kinds of obstacles, with heights, that a lidar at this height passes over."""
    heights = {
        "pallets": PALLET_HALF_M[2],
        "forklifts": FORKLIFT_HALF_M[2],
        "people": PERSON_HALF_HEIGHT_M,
    }
    return [f"{name} ({2 * half:g} m)" for name, half in heights.items() if lidar_z_m > 2 * half]


def yaw_of(quat: F64) -> F64:
    """Return headings (N,) of unit quaternions (N, 4), w first."""
    w, x, y, z = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    heading: F64 = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return heading


TIMESTEP_S = 0.01
SETTLE_S, DRIVE_S = 1.0, 1.5
MAX_TILT_RAD = 0.05
MIN_OUTSIDE_M = 0.01  # smaller overhangs are not reported
TRY_SPEED, TRY_TURN = 0.5, 1.0  # m/s and rad/s of test drives; at most half the robot's limits


def robot_model(robot: Robot | None, body: Body) -> RobotModel:
    """Return the model of a profile's `[robot]`, or the stand-in if it has none.

    Raises:
        ConfigError: the robot's parts do not fit together, or it does not stand, drive or turn.
    """
    return stand_in(body) if robot is None else _try_out(msgspec.json.encode((robot, body)))


@functools.lru_cache(maxsize=32)
def _try_out(described: bytes) -> RobotModel:
    """Measure a robot in the physics; it and its outline are JSON, as a `Robot` has no hash."""
    given, body = msgspec.json.decode(described, type=tuple[Robot, Body])
    robot = _settle(design(given, body))
    speed = min(TRY_SPEED, robot.speed_limit[0] / 2)
    ahead, _ = _drive(robot, speed, 0.0)
    # Scale the contact spheres, which sink in, so that the robot rolls on its wheels' radius.
    radius = robot.contact_radius_m * robot.wheel_radius_m / _rolling_radius_m(robot, ahead, speed)
    robot = _settle(replace(robot, contact_radius_m=radius))
    if robot.drive == "skid_steer" and given.track_ratio is None:
        turn = min(TRY_TURN, robot.speed_limit[1] / 2)
        for _ in range(3):
            _, turned = _drive(robot, 0.0, turn)
            if not turned > 0.02 * turn:
                raise _unfit_error("its wheels do not turn it on the spot")
            robot = replace(robot, turn_track_m=robot.turn_track_m * turn / turned)
    return robot


def _rolling_radius_m(robot: RobotModel, ahead_mps: float, speed_mps: float) -> float:
    """Return the wheels' rolling radius, from the driven and the commanded speed."""
    if not 0.5 * speed_mps < ahead_mps < 2 * speed_mps:
        raise _unfit_error(f"it drives {ahead_mps:.2f} m/s when {speed_mps:.2f} m/s is commanded")
    return robot.wheel_radius_m * ahead_mps / speed_mps


def _settle(robot: RobotModel) -> RobotModel:
    """Return the robot with its measured height at rest, `rest_z_m`."""
    model = build_robot_alone(replace(robot, rest_z_m=robot.contact_radius_m), TIMESTEP_S)
    data = mujoco.MjData(model)
    _run(model, data, SETTLE_S)
    _, x, y, _ = data.qpos[3:7]
    tilt = float(np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1)))
    if not np.isfinite(data.qpos).all() or tilt > MAX_TILT_RAD:
        raise _unfit_error(f"standing still it tips over, by {np.degrees(tilt):.0f} degrees")
    return replace(robot, rest_z_m=float(data.qpos[2]))


def drive_actions(
    robot: RobotModel, actions: Sequence[tuple[float, float]], friction: float
) -> list[dict[str, float]]:
    """Return the steady speeds (m/s, rad/s) of each action on a floor of this friction."""
    rows = []
    for speed, turn in actions:
        ahead, turned = _drive(robot, speed, turn, friction)
        rows.append(
            {
                "speed_mps": speed,
                "yaw_rate_radps": turn,
                "driven_mps": round(ahead, 3) + 0.0,
                "driven_radps": round(turned, 3) + 0.0,
            }
        )
    return rows


def describe_model(model: RobotModel, robot: Robot | None) -> list[tuple[str, Any, str]]:
    """Return a robot's values in the twin as rows of name, value and source."""
    lidar = Lidar() if robot is None else robot.lidar
    values: dict[str, Any] = {
        "drive": model.drive,
        "wheel_radius_m": model.wheel_radius_m,
        "track_m": model.track_m,
        "wheelbase_m": model.wheelbase_m or None,
        "mass_kg": model.mass_kg,
        "min_turning_radius_m": model.min_turning_radius_m or None,
        "max_steering_rad": model.max_steering_rad or None,
        "track_ratio": model.turn_track_m / model.track_m,
        "lidar.z_m": model.lidar_z_m,
        "lidar.beams": len(model.bearings_rad),
        "lidar.angle_min_rad": lidar.angle_min_rad,
        "lidar.angle_max_rad": lidar.angle_max_rad,
        "max_speed_mps": _finite_or_none(model.speed_limit[0]),
        "max_yaw_rate_radps": _finite_or_none(model.speed_limit[1]),
        "max_accel_mps2": model.accel_limit[0],
        "max_yaw_accel_radps2": None if model.steers else model.accel_limit[1],
        "max_steering_rate_radps": model.steering_rate_radps if model.steers else None,
    }
    rows = []
    for name, value in values.items():
        if value is None:
            continue
        if robot is None:
            origin = "the twin's own"
        elif name == "min_turning_radius_m":
            origin = "wheelbase_m, max_steering_rad"
        elif name.startswith("lidar.angle") and lidar == Lidar(beams=lidar.beams, z_m=lidar.z_m):
            origin = "default"
        elif name == "track_ratio" and not robot.track_ratio:
            origin = "measured"
        else:
            origin = robot.origin_of(name)
        rows.append((name, round(value, 4) if isinstance(value, float) else value, origin))
    return rows


def describe_outline(body: Body) -> list[tuple[str, Any, str]]:
    """Return a robot's outline and lidar place as rows of name, value and source."""
    return [
        (f"body.{name}", round(getattr(body, name), 4), "task.body")
        for name in body.__struct_fields__
    ]


def find_overhangs(model: RobotModel, body: Body) -> list[str]:
    """Return the parts of a robot that are outside its outline, and by how much."""
    places = {"the lidar": (body.lidar_x_m, 0.0)}
    for number, (x, y) in enumerate(model.casters_m):
        places[f"caster {number + 1}"] = (x + model.axle_x_m, y)
    found = []
    for name, (x, y) in places.items():
        over_m = max(abs(x) - body.length_m / 2, abs(y) - body.width_m / 2)
        if over_m > MIN_OUTSIDE_M:
            found.append(f"{name} is {over_m:.2f} m outside the outline of [task.body]")
    return found


def _finite_or_none(limit: float) -> float | None:
    return limit if np.isfinite(limit) else None


def _drive(
    robot: RobotModel, speed_mps: float, yaw_rate_radps: float, friction: float = FLOOR_FRICTION
) -> tuple[float, float]:
    """Return the steady speed (m/s) and yaw rate (rad/s) under a command."""
    model = build_robot_alone(robot, TIMESTEP_S)
    for name in wheel_names(robot):
        model.geom(f"{name}_wheel").friction[0] = friction
    data = mujoco.MjData(model)
    data.qpos[2] = robot.rest_z_m
    steps = round(1.0 / TIMESTEP_S)
    for step in range(steps):  # ramp up over 1 s, since no robot starts at its full speed
        share = np.array((step + 1) / steps)
        _set_controls(robot, model, data, speed_mps * share, yaw_rate_radps * share)
        mujoco.mj_step(model, data)
    _run(model, data, 0.5)
    rows = np.array([_step(model, data) for _ in range(round(DRIVE_S / TIMESTEP_S))])
    ahead, turned = rows.mean(axis=0)
    return float(ahead), float(turned)


def _set_controls(
    robot: RobotModel, model: mujoco.MjModel, data: mujoco.MjData, speed: F64, turn: F64
) -> None:
    motion = np.array([[[speed, turn]]])  # (1, 1, 2)
    sides = np.stack(robot.wheel_commands(motion[..., 0], motion[..., 1]), axis=-1)
    if robot.steers:
        steering = robot.steering_for(motion, np.zeros((1, 1)))
        values = [*sides[0, 0], *robot.front_angles(steering)[0, 0]]
    else:
        values = [*np.tile(sides[0, 0], len(robot.wheels_m) // 2)]
    data.ctrl[:] = values


def _step(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[float, float]:
    """Step the physics once; return forward speed (m/s) and yaw rate (rad/s)."""
    mujoco.mj_step(model, data)
    w, x, y, z = data.qpos[3:7]
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return float(np.cos(yaw) * data.qvel[0] + np.sin(yaw) * data.qvel[1]), float(data.qvel[5])


def _run(model: mujoco.MjModel, data: mujoco.MjData, seconds: float) -> None:
    for _ in range(round(seconds / TIMESTEP_S)):
        mujoco.mj_step(model, data)


def _unfit_error(problem: str) -> ConfigError:
    return ConfigError(
        f"`robot`: {problem}",
        where="the twin",
        remedy="check its wheels, casters_m and mass_kg, and the outline in [task.body]",
    )
