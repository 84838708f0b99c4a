"""The robot's part of the MuJoCo model: built from parts, or a profile's own model.

Wheels collide as spheres, because a sphere's one contact point costs less than a cylinder's, and
are drawn as cylinders. A mecanum wheel is a sphere that is driven about one diagonal and rolls
freely about the other, as its rollers do. A model of its own (`own_model`) gets the outline, the
sensors and the grip that every robot has.

A robot's own model is a base with a free joint, wheels on it, actuators by their names (`ROLES`),
and a site named `lidar`. All else stays as the file has it, but for what the twin needs alike of
every robot: its geoms touch the floor alone, the outline of `[task.body]` touches everything else,
wheels have the floor's friction under them, and the physics steps as the twin does.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from typing import Any, NamedTuple

import mujoco
import numpy as np

from restock.errors import ConfigError
from restock.ingest.task.robot import Drive, Robot
from restock.ingest.task.task import Body
from restock.train.twin.physics.robot_model import (
    CHASSIS_MASK,
    DRAWN_GROUP,
    FLOOR,
    NO_MASK,
    ROBOT_GROUP,
    ROLLING_MASK,
    SOFT,
    RobotModel,
)

# Divergence is counted and reported: MuJoCo shall not write MUJOCO_LOG.TXT where the user stands.
_log = mujoco.MjLogConfig.get()
_log.logto_file = False
_log.set()

PREFIX = "robot/"
# The actuators of each drive, in the order of its wheels; what steers last.
ROLES: dict[str, tuple[str, ...]] = {
    "differential": ("left", "right"),
    "skid_steer": ("front_left", "front_right", "rear_left", "rear_right"),
    "ackermann": ("left", "right", "steer_left", "steer_right"),
}
REMEDY = "docs/robot.md says what the model must contain, and has an example"
ROUND = (int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
WORLD = ("option", "size", "statistic", "visual", "keyframe")  # the twin has its own
PLACE_M = 0.02  # how far parts may be from where the profile says


def own_model(robot: Robot, body: Body, built: RobotModel) -> RobotModel:
    """Build the robot of a profile's MJCF: measures from the file, limits and the rest of `built`.

    Raises:
        ConfigError: the model lacks something; the message names all problems at once.
    """
    if robot.drive not in ROLES:
        raise _refused(f"it cannot be of {robot.drive} drive: {', '.join(ROLES)} can")
    try:
        spec = mujoco.MjSpec.from_string(robot.mjcf or "")
        model = spec.compile()
        plain = _robot_alone(spec.to_xml())  # angles in radians, defaults written out
    except (ValueError, mujoco.FatalError) as error:
        raise _refused(f"MuJoCo says: {' '.join(str(error).split())}") from error
    problems, wheels = _problems(model, robot, body, built)
    if problems:
        raise _refused("; ".join(problems))
    base = model.body_rootid[model.site_bodyid[model.site("lidar").id]]
    total = float(model.body_subtreemass[base])
    chassis = float(model.body_mass[base])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    places = data.xpos[wheels] - data.xpos[base]
    radius = robot.wheel_radius_m or _radius(model, wheels[-1])
    two_axles = len(wheels) == 4
    track = float(abs(places[0, 1] - places[1, 1]))
    return replace(
        built,
        mjcf=plain,
        wheel_radius_m=radius,
        contact_radius_m=_radius(model, wheels[-1]),
        track_m=track,
        turn_track_m=track * (robot.track_ratio or 1.0),
        wheelbase_m=float(places[0, 0] - places[2, 0]) if two_axles else 0.0,
        wheel_kg=(total - chassis) / len(wheels),
        chassis_kg=chassis,
        casters_m=(),
        lidar_z_m=float(data.site("lidar").xpos[2]),
        rest_z_m=float(model.body_pos[base][2]),
    )


def _robot_alone(mjcf: str) -> str:
    """Remove the world's settings from MJCF: MuJoCo warns of them if the robot is attached."""
    root = ET.fromstring(mjcf)
    for part in [part for part in root if part.tag in WORLD]:
        root.remove(part)
    return ET.tostring(root, encoding="unicode")


def attach_own(spec: Any, robot: RobotModel) -> Any:
    """Attach a profile's own model to the twin's; return its base."""
    child = mujoco.MjSpec.from_string(robot.mjcf)
    for part in (*child.worldbody.geoms, *child.worldbody.sites, *child.lights, *child.cameras):
        child.delete(part)
    for geom in child.geoms:
        touches = geom.contype or geom.conaffinity
        geom.contype, geom.conaffinity = 0, 1 if touches else 0
        geom.group = 1
    spec.attach(child, frame=spec.worldbody.add_frame(), prefix=PREFIX)
    return next(body for body in spec.worldbody.bodies if body.name.startswith(PREFIX))


def wheel_joints(model: mujoco.MjModel, drive: Drive, prefix: str = PREFIX) -> list[int]:
    """Return the wheels' joints, left before right and front before rear."""
    rolling = [
        int(model.actuator_trnid[model.actuator(prefix + name).id, 0])
        for name in ROLES[drive]
        if not name.startswith("steer")
    ]
    if drive == "ackermann":
        return [*(_rolling_of(model, joint) for joint in steering_joints(model, prefix)), *rolling]
    return rolling


def steering_joints(model: mujoco.MjModel, prefix: str = PREFIX) -> list[int]:
    """Return the joints that the front wheels steer about, left and right."""
    return [
        int(model.actuator_trnid[model.actuator(f"{prefix}steer_{side}").id, 0])
        for side in ("left", "right")
    ]


def actuators(model: mujoco.MjModel, robot: RobotModel) -> list[int]:
    """Return the indices in `ctrl` of the actuators that `ROLES` names."""
    return [model.actuator(PREFIX + name).id for name in ROLES[robot.drive]]


def wheel_geom(model: mujoco.MjModel, body: int) -> int | None:
    """Return the only colliding geom of a wheel; None if there is not exactly one."""
    geoms = [
        int(geom)
        for geom in np.flatnonzero(model.geom_bodyid == body)
        if model.geom_contype[geom] or model.geom_conaffinity[geom]
    ]
    return geoms[0] if len(geoms) == 1 else None


def _problems(
    model: mujoco.MjModel, robot: Robot, body: Body, built: RobotModel
) -> tuple[list[str], list[int]]:
    """Return what is wrong with a profile's model, by name, and the wheels' bodies."""
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    bases = [i for i in range(1, model.nbody) if model.body_parentid[i] == 0]
    if len(bases) != 1 or len(free) != 1 or model.jnt_bodyid[free[0]] != bases[0]:
        return [
            f"it has {len(bases)} bodies in <worldbody> and {len(free)} free joints, but must "
            "have one body, the base, with a <freejoint/>"
        ], []
    base, problems = bases[0], []
    if abs(model.body_pos[base][:2]).max() > 1e-6 or abs(model.body_quat[base][0] - 1) > 1e-6:
        problems.append("its base must be at x = 0, y = 0, and face along x")
    if not model.body(base).name:
        problems.append("its base has no name")
    problems += _lidar_problems(model, body, built)
    names = {model.actuator(i).name for i in range(model.nu)}
    missing = [name for name in ROLES[robot.drive] if name not in names]
    if missing:
        problems.append(f"no actuator named {', '.join(missing)}, which {robot.drive} drive needs")
        return problems, []
    for name in ROLES[robot.drive]:
        at = model.actuator(name).id
        joint = int(model.actuator_trnid[at, 0])
        on_hinge = model.actuator_trntype[at] == mujoco.mjtTrn.mjTRN_JOINT and (
            model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        )
        if not on_hinge or abs(model.actuator_gear[at, 0] - 1) > 1e-6:
            problems.append(f"actuator {name} must drive a hinge, with gear 1")
    if problems:
        return problems, []
    joints = wheel_joints(model, robot.drive, "")
    wheels = [int(model.jnt_bodyid[joint]) if joint >= 0 else -1 for joint in joints]
    if -1 in wheels:
        return ["a steered wheel has no hinge to roll, after the hinge that steers it"], []
    for wheel in wheels:
        name = model.body(wheel).name or f"number {wheel}"
        if model.body_parentid[wheel] != base:
            problems.append(f"wheel {name} is not attached to the base")
        geom = wheel_geom(model, wheel)
        round_ = geom is not None and int(model.geom_type[geom]) in ROUND
        if not round_:
            problems.append(f"wheel {name} needs one geom with contacts: a sphere or a cylinder")
    if not problems:
        problems += _place_problems(model, wheels, built.steers)
    return problems, wheels


def _lidar_problems(model: mujoco.MjModel, body: Body, built: RobotModel) -> list[str]:
    if "lidar" not in {model.site(i).name for i in range(model.nsite)}:
        return ["no site named lidar"]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    x, y, _ = data.site("lidar").xpos
    said = body.lidar_x_m - built.axle_x_m
    if abs(x - said) < PLACE_M and abs(y) < PLACE_M:
        return []
    return [
        f"site lidar is {x:.2f} m ahead and {y:.2f} m left of the base, and by task.body.lidar_x_m"
        f" (less robot.axle_x_m) {said:.2f} m ahead"
    ]


def _place_problems(model: mujoco.MjModel, wheels: list[int], steers: bool) -> list[str]:
    places = model.body_pos[wheels]
    axle = places[2:] if steers else places
    problems = []
    if abs(float(axle[:, 0].mean())) > PLACE_M:
        problems.append(
            f"its {'rear ' if steers else ''}wheels are {axle[:, 0].mean():.2f} m ahead of the"
            " base: poses are the axle's, so the base must be there"
        )
    if not (places[0::2, 1] > 0).all() or not (places[1::2, 1] < 0).all():
        problems.append("its left wheels must be at y > 0, its right ones at y < 0")
    return problems


def _rolling_of(model: mujoco.MjModel, steering: int) -> int:
    """Return the hinge after a steering hinge on the same body, or -1."""
    after = steering + 1
    same = after < model.njnt and model.jnt_bodyid[after] == model.jnt_bodyid[steering]
    return after if same else -1


def _radius(model: mujoco.MjModel, wheel: int) -> float:
    return float(model.geom_size[wheel_geom(model, wheel), 0])


def _refused(what: str) -> ConfigError:
    return ConfigError(f"`robot.mjcf`: {what}", where="the twin", remedy=REMEDY)


CASTER_LIFT_M = 0.001  # so that the driven wheels carry most of the load
STEERING_RADPS = 50.0  # the natural frequency of a steering motor with its wheel


def add_robot(spec: Any, robot: RobotModel) -> None:
    """Add the robot to the twin's model: a built one, or a profile's own in its place."""
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
        **CHASSIS_MASK,
    )
    if robot.ballast:
        chassis.add_geom(
            name="ballast",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[-robot.axle_x_m, 0, robot.chassis_z_m - robot.chassis_height_m / 4 - axle_z],
            size=[robot.length_m / 2, robot.width_m / 2, robot.chassis_height_m / 4],
            mass=robot.chassis_kg,
            group=DRAWN_GROUP + 1,
            **NO_MASK,
        )
    chassis.add_site(name="imu", pos=[0, 0, 0])
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
            **SOFT,
            **ROLLING_MASK,
        )
    places = zip(_wheel_names(robot), robot.wheels_m.tolist(), strict=True)
    for number, (name, (x, y)) in enumerate(places):
        wheel = chassis.add_body(name=f"{name}_wheel", pos=[x, y, 0])
        rolls_free = robot.steers and name.startswith("front")
        if rolls_free:
            _add_steering(wheel, name, robot)
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
            **SOFT,
            **ROLLING_MASK,
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


def _add_steering(wheel: Any, name: str, robot: RobotModel) -> None:
    wheel.add_joint(
        name=f"{name}_steering",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0, 0, 1],
        armature=robot.armature,
    )


def _add_steering_motors(spec: Any, robot: RobotModel) -> None:
    """Add steering motors, critically damped and much faster than wheels are steered."""
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


def _add_own(spec: Any, robot: RobotModel) -> None:
    """Add a profile's own model, with the outline, sensors and grip that every robot has."""
    base = attach_own(spec, robot)
    base.add_geom(
        name="chassis",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[-robot.axle_x_m, 0, robot.chassis_z_m - base.pos[2]],
        size=[robot.length_m / 2, robot.width_m / 2, robot.chassis_height_m / 2],
        mass=0,
        group=DRAWN_GROUP + 1,
        **CHASSIS_MASK,
    )
    base.add_site(name="imu", pos=[0, 0, 0])
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


def grip(model: mujoco.MjModel, robot: RobotModel) -> None:
    """Give the wheels of a profile's own model the floor's friction, as built wheels have it."""
    if robot.mjcf is None:
        return
    for geom in _own_wheels(model, robot).geoms:
        model.geom_priority[geom] = 3
        model.geom_friction[geom] = FLOOR


class Wheels(NamedTuple):
    """The wheels of a model: left before right, front before rear."""

    bodies: list[int]
    geoms: list[int]  # that touch the floor
    joints: list[int]
    steering: list[int]  # joints of the front wheels that steer, left and right


def wheels_of(model: mujoco.MjModel, robot: RobotModel) -> Wheels:
    """Return the wheels of a compiled model."""
    if robot.mjcf is not None:
        return _own_wheels(model, robot)
    names = [f"{name}_wheel" for name in _wheel_names(robot)]
    sides = ("left", "right") if robot.steers else ()
    return Wheels(
        [model.body(name).id for name in names],
        [model.geom(name).id for name in names],
        [model.joint(f"{name}_joint").id for name in names],
        [model.joint(f"front_{side}_steering").id for side in sides],
    )


def _own_wheels(model: mujoco.MjModel, robot: RobotModel) -> Wheels:
    joints = wheel_joints(model, robot.drive)
    bodies = [int(model.jnt_bodyid[joint]) for joint in joints]
    geoms = [geom for body in bodies if (geom := wheel_geom(model, body)) is not None]
    return Wheels(bodies, geoms, joints, steering_joints(model) if robot.steers else [])


def actuator_places(model: mujoco.MjModel, robot: RobotModel) -> tuple[int, ...]:
    """Return the indices in `ctrl` of the driving and steering actuators."""
    return tuple(range(model.nu)) if robot.mjcf is None else tuple(actuators(model, robot))


def _caster_names(count: int) -> list[str]:
    return ["front", "back"] if count == 2 else [str(index) for index in range(count)]


def _wheel_names(robot: RobotModel) -> list[str]:
    axles = ("front_", "rear_") if robot.wheelbase_m else ("",)
    return [axle + side for axle in axles for side in ("left", "right")]
