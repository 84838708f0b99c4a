"""Compare the twin's physics with hand calculations within 15 %, and with a finer timestep."""

from functools import cache

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from restock.ingest.profile.profile import load_profile
from restock.train.twin.floors.layout import NO_PATCH, PATCHES, default_warehouse, no_pallets
from restock.train.twin.physics.episode import Episode, EpisodeSpec
from restock.train.twin.physics.model import build_model
from restock.train.twin.physics.perturbation import RANGES, Perturbation
from restock.train.twin.physics.robot_model import (
    ACCEL_LIMIT,
    CASTER_RADIUS_M,
    MOTOR_KV,
    MOTOR_LIMIT_NM,
    TRACK_M,
    WHEEL_RADIUS_M,
    friction_at,
    stand_in,
)
from restock.train.twin.physics.simulation import BLOCK_S, Simulation, base_controller

TASK = load_profile("warehouse_amr").task
GRAVITY = 9.81
QUIET = {"latency_s": 0.0}


@cache
def simulation(timestep_s: float, num_envs: int = 1) -> Simulation:
    return Simulation(num_envs, TASK, default_warehouse(), timestep_s, nthread=1)


def start(
    sim: Simulation,
    pose: tuple[float, float, float],
    perturbation: Perturbation,
    *,
    patches: NDArray[np.float64] | None = None,
    pallets: NDArray[np.float64] | None = None,
) -> None:
    episode = Episode(
        spec=EpisodeSpec("nominal", 0),
        start=pose,
        goal=(1.0, 1.0),
        plan_m=np.zeros((2, 2)),
        patches=np.tile(NO_PATCH, (PATCHES, 1)) if patches is None else patches,
        pallets=no_pallets() if pallets is None else pallets,
    )
    sim.reset(0, episode, perturbation)


def drive(sim: Simulation, speed: float, yaw_rate: float, seconds: float) -> None:
    for _ in range(round(seconds / TASK.control_period_s)):
        sim.drive(np.array([[speed, yaw_rate]]))


def wheel_share() -> float:
    """Return the share of a standing robot's weight that is on the driven wheels."""
    model, _ = build_model(default_warehouse(), stand_in(TASK.body))
    data = mujoco.MjData(model)
    data.qpos[:3] = 6.0, 5.0, 0.1
    mujoco.mj_step(model, data, 100)
    force, wheels, total = np.zeros(6), 0.0, 0.0
    for index in range(data.ncon):
        mujoco.mj_contactForce(model, data, index, force)
        total += force[0]
        if model.geom_size[data.contact[index].geom2, 0] > CASTER_RADIUS_M:
            wheels += force[0]
    return wheels / total


def mass(sim: Simulation) -> float:
    """Return the robot's mass without payload, in kg."""
    return float(sim.model.body_subtreemass[sim.handles.chassis_body])


@pytest.mark.parametrize(
    ("friction", "rise", "seconds"),
    [(0.1, 0.0, 3.0), (0.2, 0.0, 3.0), (0.3, 0.0, 3.0), (0.2, 0.05, 0.4), (0.2, -0.05, 0.4)],
)
def test_braking_distance_matches_coulomb_friction(
    friction: float, rise: float, seconds: float
) -> None:
    # Wheels locked from 1 m/s: v^2 / (2 g (mu share cos + sin)), with the share of the weight that
    # brakes; uphill with a positive sine.
    sim = simulation(0.01)
    start(sim, (6.0, 1.0, np.pi / 2), Perturbation(**QUIET))
    drive(sim, 1.0, 0.0, 2.0)
    sim.apply(0, Perturbation(slope_y=rise, **QUIET))
    sim.friction.set_floor(0, friction)
    before, speed = sim.pose()[0, 1], sim.qvel[0, 1]
    sim.controller.set_point[0] = 0.0  # a brake, not the base controller's ramp
    drive(sim, 0.0, 0.0, seconds)
    angle = np.arctan(rise)
    decelerates = GRAVITY * (friction * wheel_share() * np.cos(angle) + np.sin(angle))
    braked_s = min(speed / decelerates, seconds)
    expected = speed * braked_s - decelerates * braked_s**2 / 2
    assert sim.pose()[0, 1] - before == pytest.approx(expected, rel=0.15)
    assert rise or abs(sim.qvel[0, 1]) < 0.01
    sim.apply(0, Perturbation())


@pytest.mark.parametrize("friction", [0.03, 0.06, 0.1])
def test_acceleration_matches_friction(friction: float) -> None:
    sim = simulation(0.01)
    scale = friction / 0.8
    floor = Perturbation(friction_scale=max(scale, 0.05), **QUIET)
    start(sim, (6.0, 1.0, np.pi / 2), floor)
    sim.friction.set_floor(0, friction)
    drive(sim, 1.0, 0.0, 0.4)  # wheels spin from here on
    before = sim.qvel[0, 1]
    drive(sim, 1.0, 0.0, 0.4)
    gained = (sim.qvel[0, 1] - before) / 0.4
    assert gained == pytest.approx(friction * GRAVITY * wheel_share(), rel=0.15)


@pytest.mark.parametrize("friction", [0.05, 0.1, 0.2])
def test_starting_slip_matches_coulomb_friction(friction: float) -> None:
    # The wheels follow the ramp of 4 m/s2 to 1 m/s: 1 - 1 / 8 m in a second. Friction gives
    # a = mu g share: the robot moves a / 2 m, or 1 - 1 / (2 a) m if it reaches 1 m/s.
    sim = simulation(0.01)
    start(sim, (6.0, 1.0, np.pi / 2), Perturbation(**QUIET))
    sim.friction.set_floor(0, friction)
    drive(sim, 1.0, 0.0, 1.0)
    rolled = sim.qpos[0, 7:9].mean() * WHEEL_RADIUS_M
    given = friction * GRAVITY * wheel_share()
    distance = given / 2 if given < 1 else 1 - 1 / (2 * given)
    expected = 1 - distance / (1 - 1 / (2 * ACCEL_LIMIT[0]))
    assert 1 - (sim.pose()[0, 1] - 1.0) / rolled == pytest.approx(expected, rel=0.15)


def test_yaw_acceleration_matches_split_friction() -> None:
    # Both wheels spin: forces mu N / 2, on arms of half a track, turn the robot about its centre.
    floor, left = 0.1, 0.5
    sim = simulation(0.01)
    start(sim, (6.0, 1.0, np.pi / 2), Perturbation(left_friction_scale=left, **QUIET))
    sim.friction.set_floor(0, floor)
    drive(sim, 1.0, 0.0, 0.2)
    before = sim.qvel[0, 5]
    drive(sim, 1.0, 0.0, 0.2)
    data = mujoco.MjData(sim.model)
    mujoco.mj_forward(sim.model, data)
    inertia = np.zeros((sim.model.nv, sim.model.nv))
    mujoco.mj_fullM(sim.model, data, inertia)
    load = mass(sim) * GRAVITY * wheel_share()
    torque = (floor - left * floor) * load / 2 * TRACK_M / 2
    assert (sim.qvel[0, 5] - before) / 0.2 == pytest.approx(torque / inertia[5, 5], rel=0.15)


def test_robot_stops_at_pallet_face() -> None:
    pallets = no_pallets()
    pallets[0] = (4.0, 3.2, 0.0)
    pallets[1] = (4.0, 4.05, 0.0)
    sim = simulation(0.01)
    start(sim, (1.5, 3.63, 0.0), Perturbation(**QUIET), pallets=pallets)
    drive(sim, 0.4, 0.0, 6.0)
    face = 4.0 - 0.6 - TASK.body.length_m / 2
    assert sim.pose()[0, 0] == pytest.approx(face, abs=0.02)
    assert sim.bumped[0]


@pytest.mark.parametrize("payload", [0.0, 60.0, 120.0])
def test_starting_speed_matches_motors_and_mass(payload: float) -> None:
    # Two motors of torque kv (commanded - actual), 18 Nm at most, move the mass and the wheels' own
    # inertia: integrated by hand at .1 ms, on a floor that grips.
    sim = simulation(0.005)
    start(sim, (6.0, 1.0, np.pi / 2), Perturbation(payload_kg=payload, timestep_s=0.005, **QUIET))
    drive(sim, 1.0, 0.0, 0.2)
    wheel = sim.model.body_inertia[sim.handles.wheel_bodies[0], 1] + sim.model.dof_armature[6]
    heavy = mass(sim) + payload + 2 * wheel / WHEEL_RADIUS_M**2
    speed = 0.0
    for instant in range(2000):
        commanded = min(ACCEL_LIMIT[0] * instant * 1e-4, 1.0) / WHEEL_RADIUS_M
        torque = min(MOTOR_KV * (commanded - speed / WHEEL_RADIUS_M), MOTOR_LIMIT_NM)
        speed += 1e-4 * 2 * torque / WHEEL_RADIUS_M / heavy
    assert sim.qvel[0, 1] == pytest.approx(speed, rel=0.15)


def test_distance_scales_with_wheel_radius() -> None:
    distances = []
    for scale in (1.0, 0.95):
        sim = simulation(0.01)
        start(sim, (6.0, 1.0, np.pi / 2), Perturbation(wheel_radius_scale=scale, **QUIET))
        drive(sim, 0.4, 0.0, 4.0)
        distances.append(sim.pose()[0, 1] - 1.0)
    assert distances[1] / distances[0] == pytest.approx(0.95, abs=0.01)


def test_turn_rate_scales_with_track() -> None:
    turned = []
    for scale in (1.0, 1.08):
        sim = simulation(0.01)
        start(sim, (6.0, 5.0, 0.0), Perturbation(track_scale=scale, **QUIET))
        drive(sim, 0.0, 0.6, 1.0)
        begin = sim.pose()[0, 2]
        drive(sim, 0.0, 0.6, 2.0)
        turned.append(sim.pose()[0, 2] - begin)
    assert turned[0] / turned[1] == pytest.approx(1.08, abs=0.02)


def test_latency_delays_wheel_commands() -> None:
    sim = simulation(0.01)
    for latency, still in ((0.0, 0), (0.13, 13), (0.3, 30)):
        start(sim, (6.0, 1.0, np.pi / 2), Perturbation(latency_s=latency))
        rows = []
        for _ in range(3):
            sim.controller.command(np.array([[1.0, 0.0]]))
            rows += [sim.controller.controls(block * BLOCK_S)[0] for block in range(2)]
        assert int((np.concatenate(rows)[:, 0] == 0).sum()) == still


@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.2])
def test_max_latency_holds_at_every_control_period(period_s: float) -> None:
    robot, longest = stand_in(load_profile("warehouse_amr").task.body), RANGES["latency_s"][1]
    substeps = round(min(period_s, BLOCK_S) / 0.01)
    controller = base_controller(1, robot, period_s, 0.01, substeps)
    controller.latency_s[:] = longest
    moved = []
    for tick in range(round(0.8 / period_s)):
        controller.command(np.array([[1.0, 0.0]]))
        for block in range(round(period_s / 0.01 / substeps)):
            wheels = controller.controls(block * BLOCK_S)[0, :, 0]
            moved += [tick * period_s + block * BLOCK_S + 0.01 * n for n in np.flatnonzero(wheels)]
    assert moved[0] == pytest.approx(longest)


@pytest.mark.parametrize("friction", [0.8, 0.1, 0.03])
def test_slalom_converges_with_timestep(friction: float) -> None:
    ends = {}
    for timestep in (0.01, 0.005, 0.001):
        sim = simulation(timestep)
        start(sim, (6.0, 1.0, np.pi / 2), Perturbation(timestep_s=timestep))
        sim.friction.set_floor(0, friction)
        for turn in (0.7, -0.7, 0.7, -0.7):
            drive(sim, 0.8, turn, 1.0)
        ends[timestep] = sim.pose()[0, :2]
    gap = {timestep: np.hypot(*(end - ends[0.001])) for timestep, end in ends.items()}
    assert gap[0.005] < 0.008
    assert gap[0.01] < 0.015
    assert gap[0.005] < gap[0.01]


def test_overlapping_patches_use_lowest_friction() -> None:
    patches = np.array([[[1.0, 1.0, 0.5, 0.5, 0.1], [1.2, 1.0, 0.5, 0.5, 0.05]]])
    points = np.array([[[0.6, 1.0], [1.0, 1.0], [3.0, 3.0]]])
    np.testing.assert_allclose(friction_at(points, patches, np.array([0.8])), [[0.1, 0.05, 0.8]])
