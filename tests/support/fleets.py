"""Synthetic fleets over weeks; consecutive steps are correlated (AR(1)), as a robot's are."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
from deltalake import write_deltalake

from restock.ingest.store.transitions import replaced
from restock.ingest.store.version import FORMAT
from support.stores import TASK, manifest, recording_transitions, views_over

MONDAY_NS = 1_772_409_600 * 10**9  # 2026-03-02
WEEK_NS = 7 * 86_400 * 10**9
STEP_NS = 200_000_000


@dataclass(frozen=True)
class SyntheticRobot:
    """A robot, and what about it changes from the third week on."""

    name: str | None
    site: str | None = "hall"
    lidar_noise_m: float = 0.01
    # Factors of odometry_scale (metres driven a metre that the wheels report), slips_per_step and
    # lidar_noise_m; silent_sectors: how many.
    changes: Mapping[str, float] = field(default_factory=dict)
    localiser: bool = True
    gyro: bool = True


def fleet(robots: list[SyntheticRobot], **size: int) -> duckdb.DuckDBPyConnection:
    """Return a connection with a fleet's rows as of a store; `install_named` adds views."""
    made = drives(robots, **size)
    connection = duckdb.connect()
    transitions = pa.concat_tables(rows for rows, _ in made)
    views_over(connection, transitions, pa.concat_tables(row for _, row in made))
    return connection


def fleet_store(path: Path, robots: list[SyntheticRobot], **size: int) -> Path:
    """Return the same as a store on disk."""
    made = drives(robots, **size)
    for name, tables in (
        ("recordings", [row for _, row in made]),
        ("transitions", [rows for rows, _ in made]),
    ):
        write_deltalake(str(path / name), pa.concat_tables(tables), description=FORMAT)
    return path


def drives(
    robots: list[SyntheticRobot],
    *,
    weeks: int = 4,
    recordings: int = 2,
    episodes: int = 8,
    seed: int = 0,
) -> list[tuple[pa.Table, pa.Table]]:
    """Transitions and manifest of every recording; so many `recordings` a robot and week."""
    made, number = [], 0
    for robot in robots:
        for week in range(1, weeks + 1):
            for _ in range(recordings):
                number += 1
                drive = _drive(robot, number, week, episodes, seed)
                tags = {"robot": robot.name, "site": robot.site}
                known = {name: value for name, value in tags.items() if value}
                made.append((drive, manifest(drive, tags=known)))
    return made


def wander(
    rng: np.random.Generator, rows: int, deviation: float, memory: float = 0.9
) -> np.ndarray:
    """Return an AR(1) process (rows,) of that standard deviation."""
    from scipy.signal import lfilter  # which takes long to import, for all who collect tests

    drawn = rng.normal(0, deviation * np.sqrt(1 - memory**2), rows)
    return np.asarray(lfilter([1.0], [1.0, -memory], drawn))


def _drive(robot: SyntheticRobot, number: int, week: int, episodes: int, seed: int) -> pa.Table:
    table = recording_transitions(number, episodes=episodes, seed=seed)
    rows, rng = len(table), np.random.default_rng([seed, number, 7])
    factor = robot.changes if week >= 3 else {}
    wheel = 0.7 + wander(rng, rows, 0.08)
    yaw_rate = np.where(np.arange(rows) // 8 % 3 == 2, 0.9, 0.02) * rng.choice([-1, 1])
    true_speed = wheel * factor.get("odometry_scale", 1.0)
    localised = true_speed + wander(rng, rows, 0.03, 0.5)
    gyro = yaw_rate + rng.normal(0, 0.01, rows) + wander(rng, rows, 0.005)
    slips = rng.random(rows) < 0.01 * factor.get("slips_per_step", 1.0)
    noise = robot.lidar_noise_m * factor.get("lidar_noise_m", 1.0)
    clearance = (
        1.5 + wander(rng, rows, 0.2, 0.999)[:, None] + rng.normal(0, noise, (rows, TASK.sectors))
    )
    clearance[:, : int(factor.get("silent_sectors", 0))] = TASK.range_max_m
    nearness = np.sqrt(np.clip(clearance / TASK.range_max_m, 0, 1))
    observation = np.stack(table["observation"].to_pylist()).astype(np.float32)
    first = next(i for i, n in enumerate(TASK.observation_names) if n.startswith("clearance_"))
    observation[:, first : first + TASK.sectors] = nearness
    stamp = MONDAY_NS + (week - 1) * WEEK_NS + number * 600 * 10**9 + np.arange(rows) * STEP_NS
    values = {
        "observation": list(observation),
        "stamp_ns": stamp,
        "pose_stamp_ns": stamp - 10_000_000,
        "wheel_speed_mps": wheel,
        "wheel_yaw_rate_radps": yaw_rate,
        "gyro_yaw_rate_radps": gyro if robot.gyro else yaw_rate,
        "localised_speed_mps": localised if robot.localiser else wheel,
        "localised_lateral_mps": wander(rng, rows, 0.03, 0.2) * robot.localiser,
        "pose_yaw_rad": np.cumsum(yaw_rate) * 0.2,
        "command_speed_mps": np.full(rows, 0.8),
        "conditions": [["wheel_slip"] if slip else [] for slip in slips],
        "clearance_m": clearance.min(1),
    }
    return replaced(table, values)
