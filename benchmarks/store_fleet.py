"""Synthetic fleets for `benchmarks/store.py`: any number of recordings, by the store's own writer.

The rows of a few recordings are drawn at random by the tests' builder, which has every column of
the schema. Every further recording has those rows under other ids, stamps, poses and wheel speeds,
so that no two hold the same steps or drive; what is written, and how, is `StoreWriter.write_all`'s.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from support.stores import manifest, recording_transitions

from restock.ingest.profile.profile import load_profile
from restock.ingest.store.location import TRANSITIONS
from restock.ingest.store.transitions import replaced
from restock.ingest.store.writer import StoreWriter, fold_if_many
from restock.ingest.task.schema import STEP_BITS
from restock.ingest.task.task import Task

TEMPLATES = 3
ROBOTS = 12
EPISODE_ROWS = 34  # of the tests' builder, on average
FIRST_DAY = datetime(2026, 1, 5, tzinfo=UTC)


def write_fleet(
    path: Path, recordings: int, rows: int, *, batch: int, sectors: int | None = None
) -> None:
    """Write a store of so many recordings of about so many rows, `batch` of them a commit.

    `sectors` of the lidar are observed; by default the shipped task's. Manifests are folded at the
    end, as `restock ingest` ends.
    """
    task = load_profile("warehouse_amr").task
    if sectors is not None:
        task = msgspec.structs.replace(task, sectors=sectors)
    store, fleet = StoreWriter(path), drives(recordings, rows, task)
    while part := [one for _, one in zip(range(batch), fleet, strict=False)]:
        store.write_all(part)
    fold_if_many(store)


def files_of_day(store: Path, day: int) -> list[Path]:
    """Return the files of the recordings that began in a day of a fleet, counted from 0."""
    hours = range(max(24 * day, 1), 24 * (day + 1))  # recording N begins N hours after FIRST_DAY
    folders = [store / TRANSITIONS / f"{hour:016x}" for hour in hours]
    return [file for folder in folders for file in folder.glob("*.parquet")]


def drives(recordings: int, rows: int, task: Task) -> Iterator[tuple[pa.Table, pa.Table]]:
    """Manifest and transitions of each recording, numbered from 1."""
    episodes = max(rows // EPISODE_ROWS, 1)
    templates = [
        recording_transitions(
            number, episodes=episodes + 2 * (rows > EPISODE_ROWS), task=task
        ).slice(0, rows)
        for number in range(1, min(TEMPLATES, recordings) + 1)
    ]
    for number in range(1, recordings + 1):
        yield drive(templates[number % len(templates)], number, task)


def drive(template: pa.Table, number: int, task: Task) -> tuple[pa.Table, pa.Table]:
    """Drive the rows of a template as another recording's, and its manifest."""
    rng, count = np.random.default_rng(number), len(template)
    recording_id = f"{number:016x}"
    started = FIRST_DAY + timedelta(hours=number)
    episodes = template["episode_index"].combine_chunks().dictionary_encode()
    names = pa.array([f"{recording_id}/{index}" for index in episodes.dictionary.to_pylist()])
    stamps = template["stamp_ns"].to_numpy()
    speeds = template["wheel_speed_mps"].to_numpy()
    rows = replaced(
        template,
        {
            "recording_id": recording_id,
            "transition_id": (np.int64(number) << STEP_BITS) + np.arange(count),
            "episode_id": names.take(episodes.indices),
            "stamp_ns": stamps - stamps[0] + int(started.timestamp()) * 10**9,
            "pose_x_m": rng.uniform(0, 40, count).astype(np.float32),
            "pose_y_m": rng.uniform(0, 25, count).astype(np.float32),
            "wheel_speed_mps": (speeds + rng.normal(0, 0.01, count)).astype(np.float32),
            "ingest_id": f"{recording_id}-a",
            "source_file": f"logs/{number}.mcap",
        },
    )
    robot = f"amr_{number % ROBOTS:02d}"
    row = manifest(rows, task=task, tags={"robot": robot, "site": f"hall_{number % 2}"})
    place = row.schema.get_field_index("ingested_at")
    return row.set_column(
        place, row.schema[place], pa.array([started], row.schema[place].type)
    ), rows


def disk_bytes(folder: Path) -> int:
    """Return what the files of a folder hold."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
