"""The MuJoCo model of the twin: warehouse, robot, pallets and traffic, built with MjSpec.

The contact parameters are measured, not guessed: stiff wheel contacts chatter when they slide and
then do not converge with the timestep; these soft ones do (see docs/twin.md). Wheels collide as
spheres, because a sphere's one contact point costs less than a cylinder's, and are drawn as
cylinders. A mecanum wheel is a sphere that is driven about one diagonal and rolls freely about the
other, as its rollers do. Pallets and traffic are mocap bodies, so that a layout is only a set of
positions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from restock.arrays import F64
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.physics.own_model import (
    actuators,
    attach_own,
    steering_joints,
    wheel_geom,
    wheel_joints,
)
from restock.train.twin.physics.robot_model import RobotModel

FLOOR_FRICTION = 0.8
FLOOR = [FLOOR_FRICTION, 0.005, 0.0001]  # sliding, torsion (m), rolling (m)
PATCHES = 4  # at most, an episode: parts of the floor with a friction of their own
SLIPPERY_BELOW = 0.3  # friction under which a wheel counts as on a patch
CASTER_LIFT_M = 0.001  # so that the driven wheels carry most of the load
STEERING_RADPS = 50.0  # the natural frequency of a steering motor with its wheel
NO_PATCH = (1e6, 1e6, 0.0, 0.0, 1.0)  # x, y, half x, half y, friction

PALLETS = 2
PALLET_HALF_M = (0.60, 0.40, 0.30)  # long side along the aisle
PEOPLE = 2
PERSON_RADIUS_M = 0.25
FORKLIFTS = 1
FORKLIFT_HALF_M = (0.60, 0.40, 0.60)
PARKED_M = (-50.0, -50.0, 1.0)  # where bodies wait that no episode uses
PARKED_RACK_M = (-60.0, -60.0, 1.0)
RACK_HALF_HEIGHT_M = 0.75
WALL_HALF_HEIGHT_M = 0.5

OBSTACLE_GROUP, ROBOT_GROUP, FLOOR_GROUP, DRAWN_GROUP = 0, 1, 2, 3
_FLOOR, _ROLLING, _OBSTACLE, _CHASSIS = (1, 0), (0, 1), (2, 0), (0, 2)


@dataclass(frozen=True)
class Handles:
    """Where things are in the model's arrays."""

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
    """The compiled model. State: free joint of the chassis, left and right wheel hinge(s).

    With `rack_slots` there are boxes for so many racks: those that the floor has none for lie
    `PARKED_RACK_M` away, to be placed by `building_boxes`.
    """
    spec = _spec(timestep_s)
    _add_building(spec, warehouse, len(warehouse.racks) if rack_slots is None else rack_slots)
    _add_robot(spec, robot)
    _add_mocap(spec)
    model = spec.compile()
    if robot.mjcf is not None:
        _grip(model, robot)
    return model, _handles(model, robot)


def build_robot_alone(robot: RobotModel, timestep_s: float = 0.01) -> mujoco.MjModel:
    """The robot on a floor without an end."""
    spec = _spec(timestep_s)
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], friction=FLOOR, **_mask(_FLOOR)
    )
    _add_robot(spec, robot)
    model = spec.compile()
    if robot.mjcf is not None:
        _grip(model, robot)
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


def building_boxes(warehouse: Warehouse, rack_slots: int) -> tuple[F64, F64]:
    """Middles and half sizes (rack_slots + 4, 3) of racks and walls, in the model's order."""
    thick, width, depth = warehouse.wall_m, warehouse.width_m, warehouse.depth_m
    middle = np.full((rack_slots + 4, 3), PARKED_RACK_M)
    half = np.full((rack_slots + 4, 3), 0.1)
    for index, rack in enumerate(warehouse.racks[:rack_slots]):
        middle[index] = (*rack.center, RACK_HALF_HEIGHT_M)
        half[index] = (*rack.half_size, RACK_HALF_HEIGHT_M)
    for index, (center, size) in enumerate(
        (
            ((-thick, depth / 2), (thick, depth / 2 + 2 * thick)),
            ((width + thick, depth / 2), (thick, depth / 2 + 2 * thick)),
            ((width / 2, -thick), (width / 2, thick)),
            ((width / 2, depth + thick), (width / 2, thick)),
        )
    ):
        middle[rack_slots + index] = (*center, WALL_HALF_HEIGHT_M)
        half[rack_slots + index] = (*size, WALL_HALF_HEIGHT_M)
    return middle, half


def _add_building(spec: Any, warehouse: Warehouse, rack_slots: int) -> None:
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
        **_mask(_FLOOR),
    )
    names = [f"rack_{index}" for index in range(rack_slots)]
    names += [f"wall_{side}" for side in ("west", "east", "south", "north")]
    for name, middle, half in zip(names, *building_boxes(warehouse, rack_slots), strict=True):
        world.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=middle,
            size=half,
            rgba=[0.36, 0.43, 0.53, 1] if name.startswith("rack") else [0.62, 0.64, 0.66, 1],
            group=OBSTACLE_GROUP,
            **_mask(_OBSTACLE),
        )


def _add_own(spec: Any, robot: RobotModel) -> None:
    """A model of its own, with the outline, the sensors and the grip that every robot has."""
    base = attach_own(spec, robot)
    base.add_geom(
        name="chassis",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[-robot.axle_x_m, 0, robot.chassis_z_m - base.pos[2]],
        size=[robot.length_m / 2, robot.width_m / 2, robot.chassis_height_m / 2],
        mass=0,
        group=DRAWN_GROUP + 1,
        **_mask(_CHASSIS),
    )
    base.add_site(name="imu", pos=[0, 0, 0])
    _add_sensors(spec)


def _grip(model: mujoco.MjModel, robot: RobotModel) -> None:
    """The floor's friction under the wheels, which is theirs to say, as of built ones."""
    for geom in _own_wheels(model, robot)[1]:
        model.geom_priority[geom] = 3
        model.geom_friction[geom] = FLOOR


def _own_wheels(model: mujoco.MjModel, robot: RobotModel) -> tuple[list[int], list[int], list[int]]:
    """Bodies, geoms and joints of the wheels of a model of its own."""
    joints = wheel_joints(model, robot.drive)
    bodies = [int(model.jnt_bodyid[joint]) for joint in joints]
    geoms = [geom for body in bodies if (geom := wheel_geom(model, body)) is not None]
    return bodies, geoms, joints


def wheel_geoms(model: mujoco.MjModel, robot: RobotModel) -> list[int]:
    """The geoms of the wheels that touch the floor."""
    if robot.mjcf is not None:
        return _own_wheels(model, robot)[1]
    return [model.geom(f"{name}_wheel").id for name in _wheel_names(robot)]


def actuator_places(model: mujoco.MjModel, robot: RobotModel) -> tuple[int, ...]:
    """Where in ctrl what drives and steers is."""
    return tuple(range(model.nu)) if robot.mjcf is None else tuple(actuators(model, robot))


def _add_robot(spec: Any, robot: RobotModel) -> None:
    if robot.mjcf is not None:
        _add_own(spec, robot)
        return
    axle_z = robot.contact_radius_m
    chassis = spec.worldbody.add_body(name="chassis", pos=[1, 1, axle_z])
    chassis.add_freejoint()
    chassis.add_geom(
        name="chassis",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0.0 - robot.axle_x_m, 0, robot.chassis_z_m - axle_z],
        size=[robot.length_m / 2, robot.width_m / 2, robot.chassis_height_m / 2],
        mass=0 if robot.ballast else robot.chassis_kg,
        rgba=[0.95, 0.55, 0.15, 1],
        group=ROBOT_GROUP,
        **_mask(_CHASSIS),
    )
    if robot.ballast:
        chassis.add_geom(
            name="ballast",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[-robot.axle_x_m, 0, robot.chassis_z_m - robot.chassis_height_m / 4 - axle_z],
            size=[robot.length_m / 2, robot.width_m / 2, robot.chassis_height_m / 4],
            mass=robot.chassis_kg,
            group=DRAWN_GROUP + 1,
            **_mask((0, 0)),
        )
    chassis.add_site(name="imu", pos=[0, 0, 0])
    soft = {"solref": [0.02, 1], "solimp": [0, 0.95, 0.004, 0.5, 2]}
    for name, (x, y) in zip(_caster_names(len(robot.casters_m)), robot.casters_m, strict=True):
        chassis.add_geom(
            name=f"caster_{name}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=[x, y, robot.caster_radius_m - axle_z + CASTER_LIFT_M],
            size=[robot.caster_radius_m, 0, 0],
            mass=robot.caster_kg,
            condim=1,
            priority=3,
            group=ROBOT_GROUP,
            **soft,
            **_mask(_ROLLING),
        )
    places = zip(_wheel_names(robot), robot.wheels_m.tolist(), strict=True)
    for number, (name, (x, y)) in enumerate(places):
        wheel = chassis.add_body(name=f"{name}_wheel", pos=[x, y, 0])
        rolls_free = robot.steers and name.startswith("front")
        if rolls_free:
            _add_steering(spec, wheel, name, robot)
        rollers = robot.roller_axes
        wheel.add_joint(
            name=f"{name}_wheel_joint",
            type=mujoco.mjtJoint.mjJNT_HINGE if rollers is None else mujoco.mjtJoint.mjJNT_BALL,
            axis=[0, 1, 0],
            armature=robot.armature,
            damping=[robot.damping, 0, 0],
        )
        wheel.add_geom(
            name=f"{name}_wheel",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[axle_z, 0, 0],
            mass=robot.wheel_kg,
            condim=3,
            priority=3,
            friction=FLOOR,
            group=DRAWN_GROUP + 1,  # hidden by default: the cylinder is what is drawn
            **soft,
            **_mask(_ROLLING),
        )
        wheel.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[axle_z, 0.25 * axle_z, 0],
            quat=[0.7071068, 0.7071068, 0, 0],
            mass=0,
            contype=0,
            conaffinity=0,
            rgba=[0.1, 0.1, 0.1, 1],
            group=ROBOT_GROUP,
        )
        if rolls_free:
            continue
        motor = spec.add_actuator(
            name=f"{name}_motor",
            target=f"{name}_wheel_joint",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            forcerange=[-robot.motor_limit_nm, robot.motor_limit_nm],
            forcelimited=True,
        )
        if rollers is not None:
            motor.trntype = mujoco.mjtTrn.mjTRN_JOINTINPARENT
            motor.gear = [*rollers[number], 0, 0, 0]
        motor.set_to_velocity(kv=robot.motor_kv)
    if robot.steers:
        _add_steering_motors(spec, robot)
    _add_sensors(spec)


def _add_sensors(spec: Any) -> None:
    spec.add_sensor(
        name="accelerometer",
        type=mujoco.mjtSensor.mjSENS_ACCELEROMETER,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname="imu",
    )
    spec.add_sensor(
        name="bumper",
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_GEOM,
        objname="chassis",
        intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1],
    )


def _add_steering(spec: Any, wheel: Any, name: str, robot: RobotModel) -> None:
    wheel.add_joint(
        name=f"{name}_steering",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0, 0, 1],
        armature=robot.armature,
    )


def _add_steering_motors(spec: Any, robot: RobotModel) -> None:
    """Critically damped, and much faster than wheels are steered."""
    inertia = robot.armature + 0.4 * robot.wheel_kg * robot.contact_radius_m**2
    for side in ("left", "right"):
        motor = spec.add_actuator(
            name=f"{side}_steering_motor",
            target=f"front_{side}_steering",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            forcerange=[-2 * robot.motor_limit_nm, 2 * robot.motor_limit_nm],
            forcelimited=True,
        )
        motor.set_to_position(kp=inertia * STEERING_RADPS**2, kv=2 * inertia * STEERING_RADPS)


def _caster_names(count: int) -> list[str]:
    return ["front", "back"] if count == 2 else [str(index) for index in range(count)]


def _wheel_names(robot: RobotModel) -> list[str]:
    axles = ("front_", "rear_") if robot.wheelbase_m else ("",)
    return [axle + side for axle in axles for side in ("left", "right")]


def _add_mocap(spec: Any) -> None:
    box, cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    person = (PERSON_RADIUS_M, 0.85, 0.0)
    for kind, count, shape, size, rgba in (
        ("pallet", PALLETS, box, PALLET_HALF_M, [0.70, 0.52, 0.32, 1]),
        ("person", PEOPLE, cylinder, person, [0.20, 0.45, 0.80, 1]),
        ("forklift", FORKLIFTS, box, FORKLIFT_HALF_M, [0.90, 0.75, 0.10, 1]),
    ):
        for index in range(count):
            body = spec.worldbody.add_body(name=f"{kind}_{index}", mocap=True, pos=list(PARKED_M))
            body.add_geom(
                type=shape, size=list(size), rgba=rgba, group=OBSTACLE_GROUP, **_mask(_OBSTACLE)
            )


def _mask(bits: tuple[int, int]) -> dict[str, int]:
    return {"contype": bits[0], "conaffinity": bits[1]}


def _handles(model: mujoco.MjModel, robot: RobotModel) -> Handles:
    def mocap(kind: str, count: int) -> slice:
        first = int(model.body(f"{kind}_0").mocapid[0])
        return slice(first, first + count)

    if robot.mjcf is None:
        wheels = [f"{name}_wheel" for name in _wheel_names(robot)]
        bodies = [model.body(name).id for name in wheels]
        geoms = wheel_geoms(model, robot)
        joints = [model.joint(f"{name}_joint").id for name in wheels]
        sides = ("left", "right") if robot.steers else ()
        steering = [model.joint(f"front_{side}_steering").id for side in sides]
    else:
        bodies, geoms, joints = _own_wheels(model, robot)
        steering = steering_joints(model) if robot.steers else []
    accelerometer = int(model.sensor("accelerometer").adr[0])
    return Handles(
        chassis_body=int(model.geom_bodyid[model.geom("chassis").id]),
        wheel_bodies=tuple(bodies),
        wheel_geoms=tuple(geoms),
        wheel_qpos=tuple(int(model.jnt_qposadr[joint]) for joint in joints),
        wheel_qvel=tuple(int(model.jnt_dofadr[joint]) for joint in joints),
        steering_qpos=tuple(int(model.jnt_qposadr[joint]) for joint in steering),
        actuators=actuator_places(model, robot),
        building=slice(model.geom("floor").id + 1, model.geom("wall_north").id + 1),
        pallets=mocap("pallet", PALLETS),
        people=mocap("person", PEOPLE),
        forklifts=mocap("forklift", FORKLIFTS),
        accelerometer=slice(accelerometer, accelerometer + 3),
        bumper=int(model.sensor("bumper").adr[0]),
    )


def friction_at(points_m: F64, patches: F64, base: F64) -> F64:
    """Friction (N, K) under points (N, K, 2), from patches (N, P, 5) and base (N,).

    A patch row is x, y, half x, half y (metres) and its friction coefficient. Where patches overlap
    the slipperiest counts.
    """
    gap = np.abs(points_m[:, :, None, :] - patches[:, None, :, 0:2])  # (N, K, P, 2)
    inside = (gap <= patches[:, None, :, 2:4]).all(axis=-1)
    slippery = np.where(inside, patches[:, None, :, 4], np.inf).min(axis=-1)
    friction: F64 = np.minimum(slippery, base[:, None])
    return friction


def pallet_half_m(yaw_rad: F64) -> F64:
    """Half sizes (..., 2) along x and y of pallets by heading (...): across, they are exchanged."""
    across = np.abs(np.sin(yaw_rad))[..., None] > 0.7
    return np.where(across, PALLET_HALF_M[1::-1], PALLET_HALF_M[:2])


def yaw_of(quat: F64) -> F64:
    """Heading (N,) from unit quaternions (N, 4), w first."""
    w, x, y, z = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    heading: F64 = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return heading
