"""The MuJoCo model of the twin: warehouse, robot, pallets and traffic, built with MjSpec.

Pallets and traffic are mocap bodies, so that a layout is only a set of positions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from restock.arrays import F64
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
from restock.train.twin.physics.contact import (
    FLOOR,
    FLOOR_GROUP,
    FLOOR_MASK,
    OBSTACLE_GROUP,
    OBSTACLE_MASK,
)
from restock.train.twin.physics.robot_model import RobotModel
from restock.train.twin.physics.robot_parts import actuator_places, add_robot, grip, wheels_of

# Of the mocap bodies (M, 3), in their order; a person is a cylinder.
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
    wheel_bodies: tuple[int, ...]  # left, right; of a front axle before those of a rear one
    wheel_geoms: tuple[int, ...]
    wheel_qpos: tuple[int, ...]  # the angle of each in qpos, and its speed in qvel
    wheel_qvel: tuple[int, ...]
    steering_qpos: tuple[int, ...]  # of the front wheels that steer, left and right
    actuators: tuple[int, ...]  # in ctrl, of the wheels that are driven, and what steers
    building: slice  # the geoms of racks and walls
    pallets: slice  # of the mocap bodies
    people: slice
    forklifts: slice
    accelerometer: slice  # of sensordata
    bumper: int


def build_model(
    warehouse: Warehouse, robot: RobotModel, timestep_s: float = 0.01, rack_slots: int | None = None
) -> tuple[mujoco.MjModel, Handles]:
    """Build the compiled model. State: free joint of the chassis, left and right wheel hinge(s).

    With `rack_slots` there are boxes for so many racks: those that the floor has none for lie
    `PARKED_RACK_M` away, to be placed by `building_boxes`.
    """
    spec = _spec(timestep_s)
    slots = len(warehouse.racks) if rack_slots is None else rack_slots
    _add_building(spec, warehouse, slots, robot.lidar_z_m)
    add_robot(spec, robot)
    _add_mocap(spec)
    model = spec.compile()
    grip(model, robot)
    return model, _handles(model, robot)


def build_robot_alone(robot: RobotModel, timestep_s: float = 0.01) -> mujoco.MjModel:
    """Build the robot on an endless floor."""
    spec = _spec(timestep_s)
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], friction=FLOOR, **FLOOR_MASK
    )
    add_robot(spec, robot)
    model = spec.compile()
    grip(model, robot)
    return model


def _spec(timestep_s: float) -> Any:
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep = timestep_s
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.noslip_iterations = 0
    # One robot among a handful of boxes: both only cost time here (8 % and 3 % of a step).
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    return spec


def building_boxes(
    warehouse: Warehouse, rack_slots: int, lidar_z_m: float = 0.0
) -> tuple[F64, F64]:
    """Return centres and half sizes (rack_slots + 4, 3) of racks and walls, in model order.

    They are no lower than a lidar needs to see them.
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

    wheels = wheels_of(model, robot)
    accelerometer = int(model.sensor("accelerometer").adr[0])
    return Handles(
        chassis_body=int(model.geom_bodyid[model.geom("chassis").id]),
        wheel_bodies=tuple(wheels.bodies),
        wheel_geoms=tuple(wheels.geoms),
        wheel_qpos=tuple(int(model.jnt_qposadr[joint]) for joint in wheels.joints),
        wheel_qvel=tuple(int(model.jnt_dofadr[joint]) for joint in wheels.joints),
        steering_qpos=tuple(int(model.jnt_qposadr[joint]) for joint in wheels.steering),
        actuators=actuator_places(model, robot),
        building=slice(model.geom("floor").id + 1, model.geom("wall_north").id + 1),
        pallets=mocap("pallet", PALLETS),
        people=mocap("person", PEOPLE),
        forklifts=mocap("forklift", FORKLIFTS),
        accelerometer=slice(accelerometer, accelerometer + 3),
        bumper=int(model.sensor("bumper").adr[0]),
    )


def passed_over(lidar_z_m: float) -> list[str]:
    """Return the kinds of obstacles that a lidar at this height passes over, with their heights."""
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
