"""Synthetic fleets for `benchmarks/store.py`: any number of recordings, by the store's own writer.

    python benchmarks/store_fleet.py [RECORDINGS …] [--against SOURCE/src] [--rounds N]

measures what grows with the number of recordings: one more is ingested into stores of so many
(500 and 10,000), and where manifests are due to be joined; coverage is asked. `--against` takes
turns with another source tree. These stores hold one sample recording under many ids: manifests
and log are as of a fleet, the rows are links.

The rows of a few recordings are drawn at random by the tests' builder, which has every column of
the schema. Every further recording has those rows under other ids, stamps, poses and wheel speeds,
so that no two hold the same steps or drive; what is written, and how, is `StoreWriter.write_all`'s.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from harness import in_turns, markdown, run_restock
from support.stores import manifest, recording_transitions

from restock.ingest.profile.profile import load_profile
from restock.ingest.store.commits import AddedFile, delta_columns, merge, recording_columns
from restock.ingest.store.lineage import StoreReader, own_path
from restock.ingest.store.location import RECORDINGS, TRANSITIONS
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


JOINED = 1_000  # manifests of a file
SAMPLES = Path(__file__).parents[1] / "sample_logs"


def write_copies(source: Path, path: Path, recordings: int, *, own: int = 0) -> None:
    """Write a store of the least recording of another one, under so many ids.

    The manifests of the last `own` are in files of their own, as of ingests that came one by one.
    """
    reader, rng, store = StoreReader(source), np.random.default_rng(5), StoreWriter(path)
    one = min(reader.shown(), key=lambda ingest: ingest.rows)
    row, schema = reader.manifests([one], recording_columns()), delta_columns(recording_columns())
    rows = source / TRANSITIONS / own_path(*one[:2])
    store.create(RECORDINGS, recording_columns())
    store.create(TRANSITIONS, pa.schema(pa.parquet.read_schema(rows)).remove_metadata())
    added, manifests = [], []
    for first in range(0, recordings - own, JOINED):
        part = range(first, min(first + JOINED, recordings - own))
        several = [_copy(row, number, rng) for number in part]
        manifests.append(merge(store.path, RECORDINGS, [], [], schema, extra=several))
    for number in range(recordings):
        file = AddedFile(
            *(name := _ids(number))[:1], own_path(*name), one.rows, rows.stat().st_size
        )
        (path / TRANSITIONS / file.path).parent.mkdir(parents=True)
        os.link(rows, path / TRANSITIONS / file.path)
        added.append(file)
        if number >= recordings - own:
            size = store.path.write(_copy(row, number, rng), f"{RECORDINGS}/{file.path}")
            manifests.append(AddedFile(file.recording_id, file.path, 1, size))
    for table, files in ((RECORDINGS, manifests), (TRANSITIONS, added)):
        store.commit(table, files, {})
        store.path.open_table(table).create_checkpoint()


def _ids(number: int) -> tuple[str, str]:
    return f"{number * 0x9E3779B97F4A7C15 % 2**64:016x}", f"{number:016x}"


def _copy(row: pa.Table, number: int, rng: np.random.Generator) -> pa.Table:
    hashes = np.sort(rng.integers(2**63, size=256, dtype=np.uint64)).tobytes().hex()
    recording_id, ingest_id = _ids(number)
    new = {"recording_id": recording_id, "ingest_id": ingest_id, "sketch": hashes}
    return replaced(row, new)


_MEASURE = """
import sys, time
from restock.cli import main
main(sys.argv[1:])
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(time.process_time(), int(peak.split()[1]) / 1000)
"""


def measured(source: str, arguments: Sequence[str | Path]) -> tuple[float, float]:
    """Return the CPU seconds and the peak MB of one command of a source tree."""
    command = [sys.executable, "-c", _MEASURE, *map(str, arguments)]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": source}, stdout=subprocess.PIPE, check=True
    )
    cpu_s, peak_mb = done.stdout.split()[-2:]
    return float(cpu_s), float(peak_mb)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="*", type=int, default=[500, 10_000])
    parser.add_argument("--against", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    trees = {"now": str(SAMPLES.parent / "src")}
    trees |= {"before": str(options.against.resolve())} if options.against else {}
    with tempfile.TemporaryDirectory() as folder:
        sample, rows = Path(folder, "sample"), []
        run_restock(["ingest", str(SAMPLES), "--store", str(sample)])
        for count in options.recordings:
            for what, own in (("coverage", 0), ("one more", 0), ("… and a join is due", 49)):
                contenders = {}
                for name, tree in trees.items():
                    store = Path(folder, f"{name}-{count}-{own}")
                    if not store.exists():
                        write_copies(sample, store, count, own=own)
                    more = ["ingest", SAMPLES / "amr_tuesday", "--store", store, "--force"]
                    command = ["coverage", store] if what == "coverage" else more
                    contenders[name] = partial(measured, tree, command)
                taken = in_turns(contenders, 1 if own else options.rounds)  # joined, it is not due
                for name, each in taken.items():
                    cpu_s, peak_mb = np.median(np.array(each), axis=0)
                    rows.append([count, what, name, f"{cpu_s:.1f}", f"{peak_mb:.0f}"])
    print(markdown(["recordings", "what", "", "CPU s", "peak MB"], rows))


if __name__ == "__main__":
    main()
