"""One step of the twin from each logged step: what it would have observed and earned.

The twin is put into the logged state (pose, motion, and what its base controller made of the
commands before), drives the logged action for one control period, and the task's own functions
turn what it then senses into observation and reward. Without sensor noise, and without what is not
on the map: pallets, people and patches of the log are unknown to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.ingest.task.signals import localised_velocity, wrap_angle
from restock.ingest.task.task import Task, clearance_ahead, observe, reward_parts
from restock.replay.store.store import Store
from restock.train.twin.calibration.logged_steps import (
    LoggedSteps,
    observations,
    previous_action,
    rows_of,
    sector_clearance,
)
from restock.train.twin.calibration.plan_memory import PlanMemory
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.physics.episode import Episode, EpisodeSpec
from restock.train.twin.physics.model import wheel_commands
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.physics.sensing import Sensing
from restock.train.twin.physics.simulation import BLOCK_S, Simulation

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

ROBOTS = 256  # simulated at a time
PAST = 5  # control periods of commands before the step: longer than any latency and ramp
EMPTY_M = 60.0  # the side of an empty floor
AGREES = 0.05  # of a clearance entry: about what noise and a pallet here and there make
SLIP_MPS = 0.2  # localised and wheel speed differ by more: ground speed is the localised one


@dataclass(frozen=True)
class Seen:
    """One side's observation and reward of n steps."""

    observation: F32  # (n, D) at t + 1
    reward: F64  # (n,)
    terms: dict[str, F64]  # reward by term, (n,) each


@dataclass(frozen=True)
class OneStep:
    """n steps of a log and of P twins."""

    rows: Ints  # (n,) of the logged steps
    now: F32  # (n, D) the logged observation at t
    logged: Seen
    twins: dict[str, Seen]
    valid: Bools  # (n,) no twin blew up
    lidar: bool  # the floor is the twin's: otherwise lidar entries are the log's own
    unexplained: int  # logged rewards that their terms do not add up to


def one_step(
    store: Store,
    steps: LoggedSteps,
    plans: PlanMemory,
    rows: Ints,
    twins: dict[str, Perturbation],
    *,
    warehouse: Warehouse | None,
    timestep_s: float,
    nthread: int,
) -> OneStep:
    """Compare `rows` (n,), which must be followed by a known step.

    `warehouse` is the floor of the log; without one the floor is empty, and what the lidar sees is
    not compared.

    Raises:
        ConfigError: a timestep or control period that the twin cannot keep.
    """
    task = steps.task
    now_seen, next_seen = observations(store, steps.transition_id[rows], task.observation_size)
    now, after = rows_of(steps.now, rows), rows_of(steps.after, rows)
    now["sector_clearance_m"] = sector_clearance(task, now_seen)
    after["sector_clearance_m"] = sector_clearance(task, next_seen)
    action, before = steps.action[rows], previous_action(task, now_seen)
    terms = reward_parts(task, now, after, steps.progress_m[rows], action, before)
    terms = {name: np.asarray(value, np.float64) for name, value in terms.items()}
    logged = Seen(next_seen, steps.reward[rows], terms)
    adds_up = np.abs(sum(terms.values()) - logged.reward) < 1e-3
    valid = np.ones(len(rows), np.bool_)
    found = {}
    for name, perturbation in twins.items():
        count = min(ROBOTS, max(len(rows), 1))
        simulation = Simulation(count, task, warehouse or empty_floor(), timestep_s, nthread)
        shift = np.zeros((len(rows), 2))
        if warehouse is None:  # away from the walls, wherever the log's map has its origin
            shift = EMPTY_M / 2 - np.stack([now["pose_x_m"], now["pose_y_m"]], axis=-1)
        seen = _drive(simulation, steps, rows, now, perturbation, shift)
        valid &= ~seen.pop("blown_up")
        twin = after | seen
        _place(task, steps, rows, now, after, twin)
        if warehouse is None:
            twin["sector_clearance_m"] = after["sector_clearance_m"]
        twin["clearance_m"] = np.asarray(twin["sector_clearance_m"]).min(axis=1)
        twin |= plans.seen_after(steps, rows, twin)
        moved = twin["route_remaining_m"] - after["route_remaining_m"]
        twin["goal_distance_m"] = np.maximum(after["goal_distance_m"] + moved, 0.0)
        twin["clearance_ahead_m"] = clearance_ahead(
            task, twin["sector_clearance_m"], twin["waypoint_near_x_m"], twin["waypoint_near_y_m"]
        )
        progress = plans.progress_m(steps, rows, twin)
        parts = reward_parts(task, now, twin, progress, action, before)
        parts = {term: np.asarray(value, np.float64) for term, value in parts.items()}
        found[name] = Seen(observe(task, twin, now, action), np.asarray(sum(parts.values())), parts)
    unexplained = int((~adds_up).sum())
    return OneStep(rows, now_seen, logged, found, valid, warehouse is not None, unexplained)


def _place(
    task: Task,
    steps: LoggedSteps,
    rows: Ints,
    now: dict[str, NDArray[Any]],
    after: dict[str, NDArray[Any]],
    twin: dict[str, NDArray[Any]],
) -> None:
    """The twin's pose as localisation would report it: as old as the log's, and speeds from it."""
    elapsed_s = (after["pose_stamp_ns"] - now["pose_stamp_ns"]) * 1e-9
    share = np.clip(elapsed_s / task.control_period_s, 0.0, 2.0)
    for name in ("pose_x_m", "pose_y_m"):
        twin[name] = now[name] + share * (twin[name] - now[name])
    turn = wrap_angle(twin["pose_yaw_rad"] - now["pose_yaw_rad"])
    twin["pose_yaw_rad"] = wrap_angle(now["pose_yaw_rad"] + share * turn)
    forward, lateral = localised_velocity(twin, now)
    twin["localised_speed_mps"], twin["localised_lateral_mps"] = forward, lateral


def _drive(
    simulation: Simulation,
    steps: LoggedSteps,
    rows: Ints,
    now: dict[str, NDArray[Any]],
    perturbation: Perturbation,
    shift: F64,
) -> dict[str, NDArray[Any]]:
    """What the twin senses one control period after each row, without noise; `blown_up` beside."""
    task, count = steps.task, simulation.num_envs
    now = now | {
        f"pose_{axis}_m": now[f"pose_{axis}_m"] + shift[:, i] for i, axis in enumerate("xy")
    }
    sensing = Sensing(simulation, task)  # its noise is zero until an episode is drawn
    episode = _nowhere()
    for env in range(count):
        simulation.reset(env, episode, perturbation)
    command = _commands(steps, rows)
    parts = []
    for begin in range(0, len(rows), count):
        chosen = np.arange(begin, min(begin + count, len(rows)))
        padded = np.append(chosen, np.full(count - len(chosen), begin))
        _set_state(simulation, rows_of(now, padded), command[padded], perturbation, episode)
        simulation.drive(command[padded, -1])
        ids = np.arange(len(chosen))
        seen = sensing.sense(ids, np.zeros(len(ids), np.int64))
        kept = {
            name: np.asarray(seen[name])
            for name in (
                *("pose_x_m", "pose_y_m", "pose_yaw_rad", "wheel_speed_mps"),
                *("wheel_yaw_rate_radps", "gyro_yaw_rate_radps", "accel_x_mps2"),
                *("sector_clearance_m", "bumped"),
            )
        }
        for i, axis in enumerate("xy"):
            kept[f"pose_{axis}_m"] = kept[f"pose_{axis}_m"] - shift[chosen, i]
        kept["gyro_yaw_rate_radps"] = kept["gyro_yaw_rate_radps"] + perturbation.gyro_bias_radps
        parts.append(kept | {"blown_up": simulation.blown_up[ids].copy()})
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _set_state(
    simulation: Simulation,
    now: dict[str, NDArray[Any]],
    command: F64,
    perturbation: Perturbation,
    episode: Episode,
) -> None:
    """Put every robot where its log was, moving as it did."""
    if simulation.blown_up.any():
        for env in np.flatnonzero(simulation.blown_up).tolist():
            simulation.reset(env, episode, perturbation)
    wheel = now["wheel_speed_mps"] * perturbation.wheel_radius_scale
    slips = np.abs(now["wheel_speed_mps"] - now["localised_speed_mps"]) > SLIP_MPS
    forward = np.where(slips, now["localised_speed_mps"], wheel)
    lateral = now["localised_lateral_mps"]
    lateral = np.where(np.abs(lateral) > SLIP_MPS, lateral, 0.0)
    yaw = now["pose_yaw_rad"]
    left, right = wheel_commands(now["wheel_speed_mps"], now["wheel_yaw_rate_radps"])
    for env in range(simulation.num_envs):
        simulation.place_robot(env, now["pose_x_m"][env], now["pose_y_m"][env], yaw[env])
        simulation.controller.reset(env)
    simulation.qvel[:, 0] = np.cos(yaw) * forward - np.sin(yaw) * lateral
    simulation.qvel[:, 1] = np.sin(yaw) * forward + np.cos(yaw) * lateral
    simulation.qvel[:, 5] = now["gyro_yaw_rate_radps"] - perturbation.gyro_bias_radps
    simulation.qvel[:, 6], simulation.qvel[:, 7] = left, right
    for step in range(PAST):  # its ramp and its late commands, as they would be now
        simulation.controller.command(command[:, step])
        for block in range(simulation.blocks):
            simulation.controller.wheel_speeds(block * BLOCK_S)


def _commands(steps: LoggedSteps, rows: Ints) -> F64:
    """The commands of the PAST periods before each row and of its own, (n, PAST + 1, 2)."""
    given = np.stack([steps.now["command_speed_mps"], steps.now["command_yaw_rate_radps"]], axis=-1)
    begin = np.maximum.accumulate(np.where(steps.begins, np.arange(len(steps)), 0))
    past = rows[:, None] + np.arange(-PAST, 1)
    there = past >= begin[rows][:, None]
    return np.where(there[..., None], given[np.maximum(past, 0)], 0.0)


def empty_floor() -> Warehouse:
    """A floor without racks."""
    middle = (EMPTY_M / 2, EMPTY_M / 2)
    return Warehouse(EMPTY_M, EMPTY_M, racks=(), segments=(), goals_m=(middle,), name="empty")


def agreement(steps: LoggedSteps, store: Store, rows: Ints, warehouse: Warehouse) -> float:
    """How far what the lidar logged at `rows` (n,) is from what it sees on this floor, in [0, 1].

    The median over the rows of the mean difference of the observation's clearance entries, which
    run from 0 (touching) to 1 (nothing within range). Below `AGREES` the floor is the log's.
    """
    task = steps.task
    seen, _ = observations(store, steps.transition_id[rows], task.observation_size)
    simulation = Simulation(max(len(rows), 1), task, warehouse, 0.01, 1)
    now = rows_of(steps.now, rows)
    for env in range(len(rows)):
        x, y, yaw = (float(now[name][env]) for name in ("pose_x_m", "pose_y_m", "pose_yaw_rad"))
        simulation.place_robot(env, x, y, yaw)
    ids = np.arange(len(rows))
    simulation.batch.forward(ids)
    sensed = Sensing(simulation, task).sense(ids, np.zeros(len(rows), np.int64))
    there = np.sqrt(np.clip(np.asarray(sensed["sector_clearance_m"]) / task.range_max_m, 0, 1))
    logged = np.sqrt(np.clip(sector_clearance(task, seen) / task.range_max_m, 0, 1))
    return float(np.median(np.abs(there - logged).mean(axis=1)))


def _nowhere() -> Episode:
    """An episode without patches, pallets or traffic; the robot is put in its place afterwards."""
    plan = np.zeros((2, 2))
    return Episode(EpisodeSpec("nominal", 0), (1.0, 1.0, 0.0), (1.0, 1.0), plan)
