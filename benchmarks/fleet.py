"""Ask drift who of three robots, one with a worn wheel from the third week, has changed.

    python benchmarks/fleet.py [--out FOLDER] [--quick] [--json] [--check]

Records the drives in the twin (each robot has hardware of its own, and payload and floor vary from
day to day), ingests them into FOLDER/store, writes FOLDER/coverage.html, and measures how often a
worn wheel would be found: drives of one robot, drawn again as four weeks of which the last two are
scaled. What is in FOLDER already is kept. `--check` exits 1 unless drift names the worn wheel, in
both weeks in which it was worn, and nothing else, and unless 3 % of wear is found in most fleets
with four drives a week, and false alarms are rare.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import duckdb
import msgspec
import numpy as np
import pyarrow as pa
from harness import finish, markdown, option_parser, run_restock

from restock.replay import Store, measure_drift
from restock.replay.store.definitions import definitions
from restock.train.twin.recording.recorder import FIRST_NS, HARDWARE
from restock.twin import Perturbation, RecordingPlan, record

HOUR_NS = 3_600_000_000_000
SITE = "hall-a"
WEEKS = 4
DAYS = 4  # of each week, from Monday
# What tells a robot from the next of its kind; the rest is the recorder's stand-in hardware.
ROBOTS: dict[str, dict[str, float]] = {
    "amr-1": {"wheel_radius_scale": 0.985, "gyro_bias_radps": 0.004},
    "amr-2": {"wheel_radius_scale": 0.990, "gyro_bias_radps": -0.002},
    "amr-3": {"wheel_radius_scale": 0.995, "gyro_bias_radps": 0.001, "lidar_noise_m": 0.012},
}
WORN, WORN_FROM, WORN_SCALE = "amr-2", 3, 0.94  # robot, week, times its wheel radius
TRIALS = 400
WEAR = (0.0, 0.01, 0.02, 0.03, 0.06)
DRIVES_A_WEEK = (1, 2, 4, 8)
# What p must be below so that one change is found beside 72 tests (3 robots, 12 signals, 2 weeks).
CORRECTED = 0.05 / 72
MAX_FALSE = 0.01
MIN_FOUND = 0.8


@dataclass(frozen=True)
class FleetDrive:
    """One recording of the fleet."""

    robot: str
    week: int  # from 1
    day: int
    seed: int

    @property
    def name(self) -> str:
        return f"{self.robot}-week{self.week}-day{self.day + 1}.mcap"

    def plan(self, minutes: float) -> RecordingPlan:
        hours = 24 * (7 * (self.week - 1) + self.day) + list(ROBOTS).index(self.robot)
        return RecordingPlan(
            minutes=minutes,
            seed=self.seed,
            hardware=self.hardware(),
            start_ns=FIRST_NS + hours * HOUR_NS,
            tags={"robot": self.robot, "site": SITE},
        )

    def hardware(self) -> Perturbation:
        """Return the robot's own hardware with the day's payload, floor and wheel wear."""
        rng = np.random.default_rng(self.seed)
        own = dict(ROBOTS[self.robot])
        if self.robot == WORN and self.week >= WORN_FROM:
            own["wheel_radius_scale"] *= WORN_SCALE
        day = {
            "payload_kg": float(rng.uniform(0, 40)),
            "friction_scale": float(rng.uniform(0.8, 0.95)),
        }
        return msgspec.structs.replace(HARDWARE, name=self.robot, **own, **day)


def drives() -> Iterator[FleetDrive]:
    """Every drive, in the order of time."""
    places = [(w, d, robot) for w in range(1, WEEKS + 1) for d in range(DAYS) for robot in ROBOTS]
    for seed, (week, day, robot) in enumerate(places, start=1):
        yield FleetDrive(robot, week, day, seed)


def power(store: Store, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Measure how often wear is found in week four, by wear and drives a week.

    The drives are those of robots without wear.
    """
    drawn = store.sql(
        "SELECT robot, recording_id, list(value) AS episodes FROM episode_signals"
        f" WHERE signal = 'odometry_scale' AND robot <> '{WORN}' GROUP BY ALL ORDER BY ALL"
    ).fetchall()
    pools = [[row[2] for row in drawn if row[0] == robot] for robot in ROBOTS if robot != WORN]
    signals = store.sql("FROM drift_signals").to_arrow_table()
    found = []
    for number in DRIVES_A_WEEK:
        for wear in WEAR:
            samples = _samples(pools, number, wear, rng)
            row = {"drives_a_week": number, "wear": wear, **_found(samples, signals)}
            found.append(row)
    return found


def _samples(
    pools: list[list[list[float]]], number: int, wear: float, rng: np.random.Generator
) -> pa.Table:
    """`episode_signals` of TRIALS robots, each with its site to itself."""
    lines = []
    for trial in range(TRIALS):
        pool = pools[trial % len(pools)]
        for week in range(WEEKS):
            for drive, place in enumerate(rng.integers(len(pool), size=number)):
                scale = 1 - wear * (week + 1 >= WORN_FROM)
                lines += [
                    (trial, week, drive, episode, value * scale)
                    for episode, value in enumerate(rng.choice(pool[place], len(pool[place])))
                ]
    trial, week, drive, episode, value = (np.array(column) for column in zip(*lines, strict=True))
    names = [f"robot {number}" for number in trial]
    recordings = [f"{t}-{w}-{d}" for t, w, d in zip(trial, week, drive, strict=True)]
    start = np.datetime64(FIRST_NS, "ns") + week * np.timedelta64(7, "D")
    return pa.table(
        {
            "robot": names,
            "site": names,
            "recording_id": recordings,
            "episode_id": [f"{r}/{e}" for r, e in zip(recordings, episode, strict=True)],
            "start_time": start.astype("datetime64[us]"),
            "part": ["wheels"] * len(lines),
            "signal": ["odometry_scale"] * len(lines),
            "value": value,
            "steps": np.full(len(lines), 20),
        }
    )


def _found(samples: pa.Table, signals: pa.Table) -> dict[str, float]:
    with duckdb.connect() as connection:
        connection.register("episode_signals", samples)
        connection.register("drift_signals", signals)
        connection.execute(
            "CREATE TABLE episode_conditions (robot TEXT, site TEXT, recording_id TEXT, zone TEXT,"
            " episode_id TEXT, start_time TIMESTAMP, condition TEXT, driven_h DOUBLE, events INT)"
        )
        connection.execute(definitions(names=["drift.sql"]))
        rows = connection.sql(
            f"SELECT avg((p < {CORRECTED} AND size >= 1)::INT), avg((p < .05)::INT), count(p)"
            " FROM drift_by() WHERE against = 'own reference' AND period = DATE '2026-03-23'"
        ).fetchall()
    return dict(zip(("found", "below_05", "tests"), rows[0], strict=True))


def main() -> int:
    parser = option_parser(__doc__, quick="1 minute a drive, not 3; into FOLDER/quick")
    parser.add_argument("--out", type=Path, default=Path("fleet"), help="default: ./fleet")
    options = parser.parse_args()
    out = options.out / "quick" if options.quick else options.out  # its drives are others
    logs = out / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    for drive in drives():
        if not (logs / drive.name).exists():
            record(logs / drive.name, drive.plan(1.0 if options.quick else 3.0))
            print(drive.name, file=sys.stderr)
    run_restock(["ingest", str(logs), "--store", str(out / "store")])
    with Store(out / "store") as store:
        drift = measure_drift(store)
        table = power(store, np.random.default_rng(0))
    run_restock(["coverage", str(out / "store"), "--out", str(out / "coverage.html")])
    hardware = [row for row in drift.findings if row["part"] not in ("driving", "conditions")]
    named = {(row["robot"], row["part"], row["scope"], row["periods"]) for row in hardware}
    missed = []
    if named != {(WORN, "wheels", "robot", WEEKS - WORN_FROM + 1)}:
        missed.append(f"drift names {sorted(named)}")
    missed += [
        f"{row['wear']:.0%} of wear, {row['drives_a_week']} drives a week: found {row['found']:.0%}"
        for row in table
        if (row["wear"] == 0 and row["found"] > MAX_FALSE)
        or (row["wear"] >= 0.03 and row["drives_a_week"] >= 4 and row["found"] < MIN_FOUND)
    ]
    cells = {(row["drives_a_week"], row["wear"]): row for row in table}
    lines = [
        *(row["finding"] for row in drift.findings),
        "",
        "found with p corrected for 72 tests, and size 1 or more:",
        markdown(
            ["drives a week", *(f"{wear:.0%} worn" for wear in WEAR), "p < .05 at 0 %"],
            [
                [
                    number,
                    *(f"{cells[number, wear]['found']:.1%}" for wear in WEAR),
                    f"{cells[number, 0.0]['below_05']:.1%}",
                ]
                for number in DRIVES_A_WEEK
            ],
        ),
    ]
    return finish(options, {"findings": drift.findings, "power": table}, missed, lines)


if __name__ == "__main__":
    sys.exit(main())
