"""The robot's part of the MuJoCo model.

Wheels collide as spheres, because a sphere's one contact point costs less than a cylinder's, and
are drawn as cylinders.
"""

from __future__ import annotations

from typing import Any

import mujoco

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

# Divergence is counted and reported. MuJoCo must not write MUJOCO_LOG.TXT into the user's folder.
_log = mujoco.MjLogConfig.get()
_log.logto_file = False
_log.set()

CASTER_LIFT_M = 0.001  # casters hang this high, so that driven wheels carry most of the load
STEERING_RADPS = 50.0  # the natural frequency of a steering motor with its wheel


def add_robot(spec: Any, robot: RobotModel) -> None:
    """Add the robot, its motors and its sensors to the twin's model."""
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
    for name, (x, y) in zip(wheel_names(robot), robot.wheels_m.tolist(), strict=True):
        wheel = chassis.add_body(name=f"{name}_wheel", pos=[x, y, 0])
        rolls_free = robot.steers and name.startswith("front")
        if rolls_free:
            _add_steering(wheel, name, robot)
        wheel.add_joint(
            name=f"{name}_wheel_joint",
            type=mujoco.mjtJoint.mjJNT_HINGE,
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
            group=DRAWN_GROUP + 1,  # hidden by default: the cylinder is drawn instead
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


def _caster_names(count: int) -> list[str]:
    return ["front", "back"] if count == 2 else [str(index) for index in range(count)]


def wheel_names(robot: RobotModel) -> list[str]:
    """Return the wheels' names: left before right, front before rear."""
    axles = ("front_", "rear_") if robot.wheelbase_m else ("",)
    return [axle + side for axle in axles for side in ("left", "right")]
