"""Recordings to columns and to a store: Restock beside its peers, as CPU time over decompression.

    python benchmarks/ingest.py [--quick] [--json] [--check] [--rounds N]

All contestants read the same generated log (20 minutes of it, 2 with `--quick`) in one process,
one after the other in every round; their values are compared along the way. Then the whole of
`restock ingest`, one worker against two, SHORT recordings of two minutes in one process against
one alone, and peak memory on recordings of 2 GB (256 MB with `--quick`). `--check` exits 1 where a
target of the design is missed. A peer that is not installed is left out, and what is asked of
Restock beside it is not measured.
"""

from __future__ import annotations

import json
import math
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import recording_readers as readers
import robot_log
import zstandard
from harness import finish, in_turns, markdown, medians, option_parser

from restock.ingest.batch import IngestJob, ingest_all
from restock.ingest.pipeline import IngestResult, ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.writer import StoreWriter

FLOOR = "decompress and check only"
OURS = "restock, all topics"
OURS_PROFILE = "restock, a profile's fields"
OURS_WALKED = "restock, no message index"
OURS_BARE = "restock, no index, no summary"
DIAGNOSTICS = "restock, nested diagnostics"
INGEST = "restock ingest, the work"
INGEST_BAG = "restock ingest, the work, sqlite3"
COMMAND = "restock ingest, a new process"
RERUN = "rerun-sdk, all topics"
RERUN_DIAGNOSTICS = "rerun-sdk, nested diagnostics"
MCAP_ALONE = "mcap, not decoded"
ROSBAGS = "rosbags, decoded"
ROSBAGS_COLUMNS = "rosbags, to columns"
MCAP_ROS2 = "mcap + mcap-ros2-support, decoded"
BAG_FLOOR = "sqlite3, rows fetched only"
OURS_BAG = "restock, sqlite3 bag, all topics"
ROSBAGS_BAG = "rosbags, sqlite3 bag, decoded"
PEERS = {"rerun-sdk": {RERUN, RERUN_DIAGNOSTICS}, "mcap-ros2-support": {MCAP_ROS2}}

ROBOT = "turtlebot3"  # the shipped profile that fits the generated log
MEMORY_MB = 400  # what "a few hundred MB" is taken for
IMAGES_MB = 50  # by how much images may raise it
PLAIN, LONG, LONGER = "MCAP, no images", "MCAP, no images, 4x as long", 4
SHORT = 32
LIMIT_MB = 768  # of private memory set aside, used or not: beyond it is a MemoryError

# One process' peak: code and pages of mapped files included.
MEASURE = """
import json, re, sys, time
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.writer import StoreWriter
outcome = ingest(sys.argv[1], load_profile("turtlebot3"), store=StoreWriter(sys.argv[2]))
with open("/proc/self/status") as file:  # the system's ru_maxrss would count the parent's, too
    peak = int(re.search(r"VmHWM:\\s+(\\d+) kB", file.read())[1])
answer = {"transitions": outcome.manifest["transitions"], "lost_messages": outcome.lost_messages}
print(json.dumps(answer | {"peak_mb": peak / 1024, "cpu_s": time.process_time()}))
"""


def cpu_s(work: Callable[[], Any]) -> float:
    """CPU time of this process and of those it starts, system time included."""
    before = _used_s()
    work()
    return _used_s() - before


def _used_s() -> float:
    kinds = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(used.ru_utime + used.ru_stime for used in kinds)


class Stores:
    """A new store for every ingest."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.count = folder, 0

    def new(self) -> Path:
        self.count += 1
        return self.folder / str(self.count)


def command(paths: list[Path], store: Path, workers: int = 1) -> None:
    """`restock ingest` as a process of its own, start-up included."""
    options = ["--store", str(store), "--profile", ROBOT, "--workers", str(workers)]
    done = subprocess.run(
        [sys.executable, "-m", "restock", "ingest", *map(str, paths), *options],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    if done.returncode not in (0, 3):  # 3: the generated odometry contradicts its own poses
        raise SystemExit(done.stderr)


def contestants(
    folder: Path, seconds: float, stores: Stores
) -> tuple[dict[str, Callable[[], Any]], dict[str, Callable[[], Any]], dict[str, int]]:
    """Quick ones, slow ones (fewer rounds), and how many columns were found equal."""
    path = robot_log.write_mcap(folder / "log.mcap", seconds)
    walked = robot_log.write_mcap(folder / "no_index.mcap", seconds, index=False)
    bare = robot_log.write_mcap(folder / "bare.mcap", seconds, index=False, summary=False)
    bag = robot_log.write_bag(folder / "bag", seconds)
    profile = load_profile(ROBOT)
    quick: dict[str, Callable[[], Any]] = {
        FLOOR: readers.decompress_only(path),
        OURS: lambda: readers.restock_columns(path),
        RERUN: lambda: readers.rerun_columns(path),
        OURS_PROFILE: lambda: readers.restock_columns(path, readers.PROFILE),
        DIAGNOSTICS: lambda: readers.restock_diagnostics(path),
        RERUN_DIAGNOSTICS: lambda: readers.rerun_columns(path, "/diagnostics"),
        OURS_WALKED: lambda: readers.restock_columns(walked),
        OURS_BARE: lambda: readers.restock_columns(bare),
        INGEST: lambda: ingest(path, profile, store=StoreWriter(stores.new())),
        COMMAND: lambda: command([path], stores.new()),
        BAG_FLOOR: lambda: readers.fetch_only(bag),
        OURS_BAG: lambda: readers.restock_columns(bag),
        INGEST_BAG: lambda: ingest(bag, profile, store=StoreWriter(stores.new())),
    }
    slow: dict[str, Callable[[], Any]] = {
        MCAP_ALONE: lambda: readers.mcap_alone(path),
        ROSBAGS: lambda: readers.rosbags_decode(path),
        ROSBAGS_COLUMNS: lambda: readers.rosbags_columns(path),
        MCAP_ROS2: lambda: readers.mcap_ros2(path),
        ROSBAGS_BAG: lambda: readers.rosbags_decode(bag),
    }
    for name in (name for package in readers.NOT_INSTALLED for name in PEERS[package]):
        del (quick if name in quick else slow)[name]
    return quick, slow, readers.check_values(path, bag)


def measure(
    quick: dict[str, Callable[[], Any]],
    slow: dict[str, Callable[[], Any]],
    rounds: int,
    slow_rounds: int,
) -> dict[str, list[float]]:
    """CPU times of each, interleaved; a first round of the quick ones is not counted."""
    timed = {name: partial(cpu_s, work) for name, work in quick.items()}
    timed_slow = {name: partial(cpu_s, work) for name, work in slow.items()}
    in_turns(timed, 1)
    times = in_turns(timed | timed_slow, slow_rounds)
    for name, more in in_turns(timed, rounds - slow_rounds).items():
        times[name] += more
    return times


def two_workers(folder: Path, seconds: float, stores: Stores, rounds: int) -> dict[str, float]:
    """Wall time of six recordings by one worker and by two, start-up included."""
    log = robot_log.write_mcap(folder / "several.mcap", seconds).read_bytes()
    paths = [folder / f"several_{number}.mcap" for number in range(6)]
    for number, path in enumerate(paths):  # of the same length; each with an id of its own
        path.write_bytes(log.replace(robot_log.LIBRARY, robot_log.LIBRARY[:-1] + b"%d" % number))
    took: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(rounds):
        for workers, walls in took.items():
            start = time.perf_counter()
            command(paths, stores.new(), workers)
            walls.append(time.perf_counter() - start)
    one, two = statistics.median(took[1]), statistics.median(took[2])
    return {"one_s": one, "two_s": two, "faster": one / two, "load": os.getloadavg()[0]}


def short_recordings(folder: Path, stores: Stores, rounds: int) -> dict[str, float]:
    """CPU time of one recording of two minutes alone, and of each of SHORT different ones."""
    paths = [
        robot_log.write_mcap(folder / f"short_{number}.mcap", 120.0, seed=number + 1)
        for number in range(SHORT)
    ]
    profile = load_profile(ROBOT)

    def ingested(some: list[Path]) -> None:
        outcomes = dict(ingest_all(some, IngestJob(profile, stores.new())))
        assert all(isinstance(one, IngestResult) for one in outcomes.values())

    ingested(paths[:1])
    work = {"alone_s": paths[:1], "each_s": paths}
    used = medians(
        in_turns({n: partial(cpu_s, partial(ingested, some)) for n, some in work.items()}, rounds)
    )
    return used | {"each_s": used["each_s"] / SHORT}


def limit() -> None:
    resource.setrlimit(resource.RLIMIT_DATA, (LIMIT_MB << 20, LIMIT_MB << 20))


def measured(path: Path, store: Path) -> dict[str, float]:
    """Peak and CPU time of a process that ingests one recording."""
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, str(path), str(store)],
        stdout=subprocess.PIPE,
        check=True,
        preexec_fn=limit,
    )
    used: dict[str, float] = json.loads(done.stdout)
    files = path.rglob("*") if path.is_dir() else [path]
    used["size_mb"] = sum(file.stat().st_size for file in files if file.is_file()) / 1e6
    return used


def compressed(bag: Path) -> Path:
    """Return the bag's storage file compressed as a whole, as rosbag2's file mode does."""
    for file in list(bag.glob("*.mcap")):
        with file.open("rb") as source, file.with_name(file.name + ".zstd").open("wb") as sink:
            zstandard.ZstdCompressor(level=1).copy_stream(source, sink)
        file.unlink()
    return bag


def memory(folder: Path, seconds: float, image_mb: float) -> dict[str, dict[str, float]]:
    """Measure recordings with and without images in each container, and a longer one."""
    images = int(image_mb * 1e6 / robot_log.IMAGE_BYTES)
    zstd_bag = folder / "zstd_bag"
    used = {}
    for name, path in (
        (PLAIN, robot_log.write_mcap(folder / "plain.mcap", seconds)),
        (LONG, robot_log.write_mcap(folder / "long.mcap", seconds * LONGER)),
        ("MCAP, images", robot_log.write_mcap(folder / "big.mcap", seconds, images=images)),
        (
            "MCAP, images, no chunks",
            robot_log.write_mcap(folder / "loose.mcap", seconds, images=images, chunked=False),
        ),
        ("sqlite3 bag, images", robot_log.write_bag(folder / "big_bag", seconds, images=images)),
        ("zstd file of an MCAP bag, images", zstd_bag),
    ):
        if path == zstd_bag:
            zstd_bag.mkdir()
            (folder / "big.mcap").rename(zstd_bag / "zstd_bag_0.mcap")
            compressed(zstd_bag)
        used[name] = measured(path, folder / f"store {name}")
        used[name]["images"] = 0 if name in (PLAIN, LONG) else images
        if name in ("MCAP, images, no chunks", LONG):
            path.unlink()
    return used


def targets(
    ratio: dict[str, float], workers: dict[str, float], used: dict[str, dict[str, float]]
) -> dict[str, tuple[float, bool | None]]:
    """Return each target, what was measured, and whether that meets it.

    None stands for a peer that is not installed.
    """
    peak = max(one["peak_mb"] for one in used.values())
    images = max(one["peak_mb"] for one in used.values() if one["images"]) - used[PLAIN]["peak_mb"]
    ratio = dict.fromkeys(PEERS["rerun-sdk"], math.nan) | ratio
    ours, diagnostics = ratio[OURS], ratio[DIAGNOSTICS] / ratio[RERUN_DIAGNOSTICS]
    rerun, columns, walked = (ratio[name] / ours for name in (RERUN, ROSBAGS_COLUMNS, OURS_WALKED))
    found = {
        "all topics to columns at most 2.9x the floor": (ours, ours <= 2.9),
        "a profile's own fields faster still": (ratio[OURS_PROFILE], ratio[OURS_PROFILE] < ours),
        "at least 1.9x faster than rerun-sdk": (rerun, rerun >= 1.9),
        "nested diagnostics no slower than rerun-sdk": (diagnostics, diagnostics <= 1),
        "at least 20x rosbags to columns": (columns, columns >= 20),
        "no index at most 1.3x indexed": (walked, walked <= 1.3),
        "a whole ingest at most 6x the floor": (ratio[INGEST], ratio[INGEST] <= 6),
        "two workers at least 1.7x one": (workers["faster"], workers["faster"] >= 1.7),
        f"peak memory at most {MEMORY_MB} MB": (peak, peak <= MEMORY_MB),
        f"images raise peak memory by at most {IMAGES_MB} MB": (images, images <= IMAGES_MB),
    }
    return {
        n: (value, None if math.isnan(value) else observed)
        for n, (value, observed) in found.items()
    }


def lines(answer: dict[str, Any]) -> Iterator[str]:
    """Yield the figures as tables."""
    yield f"{answer['messages']:,} messages, {answer['log_s']:.0f} s, {answer['mcap_mb']:.0f} MB"
    equal = ", ".join(f"{who} {count}" for who, count in answer["equal_columns"].items())
    yield f"columns equal: {equal}\n"
    yield markdown(
        ["reader", "CPU s", "over decompression"],
        [
            [name, f"{answer['cpu_s'][name]:.3f}", f"{value:.2f}"]
            for name, value in sorted(answer["over_floor"].items(), key=lambda item: item[1])
        ],
    )
    yield from (f"{name}: not installed, left out" for name in answer["left_out"])
    yield ""
    yield markdown(
        [f"recording ({LIMIT_MB} MB of private memory at most)", "MB", "peak MB", "CPU s"],
        [
            [name, f"{one['size_mb']:.0f}", f"{one['peak_mb']:.0f}", f"{one['cpu_s']:.2f}"]
            for name, one in answer["memory"].items()
        ],
    )
    yield f"\nan hour more of log: {answer['mb_an_hour']:.0f} MB more at the peak"
    workers = answer["workers"]
    yield (
        f"\nsix recordings: {workers['one_s']:.2f} s by one worker, {workers['two_s']:.2f} s by"
        f" two: {workers['faster']:.2f}x (load average {workers['load']:.1f})\n"
    )
    alone, each = answer["short"]["alone_s"], answer["short"]["each_s"]
    yield f"a recording of two minutes: {alone:.3f} CPU s alone, {each:.3f} as one of {SHORT}\n"
    verdicts = {True: "met", False: "MISSED", None: "not measured"}
    yield from (f"{verdicts[observed]:12} {name}" for name, observed in answer["targets"].items())


def main() -> int:
    parser = option_parser(__doc__, quick="two minutes of log, not twenty")
    parser.add_argument("--rounds", type=int, default=5, help="one in three with the slow readers")
    options = parser.parse_args()
    seconds = 120.0 if options.quick else 1200.0
    rounds, slow_rounds = options.rounds, -(-options.rounds // 3)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stores = Stores(folder / "stores")
        stores.folder.mkdir()
        quick, slow, equal = contestants(folder, seconds, stores)
        cpu = medians(measure(quick, slow, rounds, slow_rounds))
        workers = two_workers(folder, seconds * 2, stores, 3)
        short = short_recordings(folder, stores, rounds)
        used = memory(folder, seconds, 256 if options.quick else 2200)
        columns = readers.restock_columns(folder / "log.mcap")
        size_mb = (folder / "log.mcap").stat().st_size / 1e6
    ratio = {name: value / cpu[FLOOR] for name, value in cpu.items()}
    goals = targets(ratio, workers, used)
    answer = {
        "messages": sum(len(topic) for topic in columns.values()),
        "log_s": seconds,
        "mcap_mb": size_mb,
        "equal_columns": equal,
        "cpu_s": cpu,
        "over_floor": ratio,
        "left_out": sorted(readers.NOT_INSTALLED),
        "workers": workers,
        "short": short,
        "memory": used,
        "mb_an_hour": (used[LONG]["peak_mb"] - used[PLAIN]["peak_mb"])
        / ((LONGER - 1) * seconds / 3600),
        "targets": {name: observed for name, (_, observed) in goals.items()},
    }
    missed = [
        f"{name}: {value:.2f}" for name, (value, observed) in goals.items() if observed is False
    ]
    return finish(options, answer, missed, lines(answer))


if __name__ == "__main__":
    np.seterr(all="raise")
    sys.exit(main())
