"""A robot's own MuJoCo model in the place of the built one: what it must hold, and how it goes in.

It is a base with a free joint, wheels on it, actuators by their names (`ROLES`), and a site named
`lidar`. All else stays as the file has it, but for what the twin needs alike of every robot: its
geoms touch the floor alone, the outline of `[task.body]` touches everything else, wheels have the
floor's friction under them, and the physics steps as the twin does.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from restock.errors import ConfigError
from restock.ingest.task.robot import Drive, Robot
from restock.ingest.task.scan import Body
from restock.train.twin.physics.robot_model import RobotModel

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
    """The robot of a profile's MJCF: measures are the file's, limits and the rest as `built`.

    Raises:
        ConfigError: it lacks something, which is named: all that is wrong at once.
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
    """Without what is the world's to say, of which MuJoCo warns wherever the robot is attached."""
    root = ET.fromstring(mjcf)
    for part in [part for part in root if part.tag in WORLD]:
        root.remove(part)
    return ET.tostring(root, encoding="unicode")


def attach_own(spec: Any, robot: RobotModel) -> Any:
    """Put the robot's own model into the twin's; returns its base."""
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
    """The joints of the wheels, left before right and front before rear, as everywhere."""
    rolling = [
        int(model.actuator_trnid[model.actuator(prefix + name).id, 0])
        for name in ROLES[drive]
        if not name.startswith("steer")
    ]
    if drive == "ackermann":
        return [*(_rolling_of(model, joint) for joint in steering_joints(model, prefix)), *rolling]
    return rolling


def steering_joints(model: mujoco.MjModel, prefix: str = PREFIX) -> list[int]:
    """The joints that the front wheels steer about, left and right."""
    return [
        int(model.actuator_trnid[model.actuator(f"{prefix}steer_{side}").id, 0])
        for side in ("left", "right")
    ]


def actuators(model: mujoco.MjModel, robot: RobotModel) -> list[int]:
    """Where in `ctrl` what `ROLES` names is."""
    return [model.actuator(PREFIX + name).id for name in ROLES[robot.drive]]


def wheel_geom(model: mujoco.MjModel, body: int) -> int | None:
    """The one geom of a wheel that touches; None: there is not one."""
    geoms = [
        int(geom)
        for geom in np.flatnonzero(model.geom_bodyid == body)
        if model.geom_contype[geom] or model.geom_conaffinity[geom]
    ]
    return geoms[0] if len(geoms) == 1 else None


def _problems(
    model: mujoco.MjModel, robot: Robot, body: Body, built: RobotModel
) -> tuple[list[str], list[int]]:
    """What is wrong, by name, and the wheels' bodies."""
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
            " base: poses are the axle's, so the base must stand there"
        )
    if not (places[0::2, 1] > 0).all() or not (places[1::2, 1] < 0).all():
        problems.append("its left wheels must be at y > 0, its right ones at y < 0")
    return problems


def _rolling_of(model: mujoco.MjModel, steering: int) -> int:
    """The hinge that comes after a steering one on the same body; -1: none."""
    after = steering + 1
    same = after < model.njnt and model.jnt_bodyid[after] == model.jnt_bodyid[steering]
    return after if same else -1


def _radius(model: mujoco.MjModel, wheel: int) -> float:
    return float(model.geom_size[wheel_geom(model, wheel), 0])


def _refused(what: str) -> ConfigError:
    return ConfigError(f"`robot.mjcf`: {what}", where="the twin", remedy=REMEDY)
