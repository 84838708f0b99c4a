"""Peak memory of `restock ingest`, each recording in a process of its own, under a hard limit."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from pathlib import Path

import robot_log
import zstandard

PLAIN, LONG, LONGER = "MCAP, no images", "MCAP, no images, 4x as long", 4
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
    found: dict[str, float] = json.loads(done.stdout)
    files = path.rglob("*") if path.is_dir() else [path]
    found["size_mb"] = sum(file.stat().st_size for file in files if file.is_file()) / 1e6
    return found


def compressed(bag: Path) -> Path:
    """The bag's storage file compressed as a whole, as rosbag2's file mode does."""
    for file in list(bag.glob("*.mcap")):
        with file.open("rb") as source, file.with_name(file.name + ".zstd").open("wb") as sink:
            zstandard.ZstdCompressor(level=1).copy_stream(source, sink)
        file.unlink()
    return bag


def memory(folder: Path, seconds: float, image_mb: float) -> dict[str, dict[str, float]]:
    """Recordings of `seconds` with and without images, in each container, and a longer one."""
    images = int(image_mb * 1e6 / robot_log.IMAGE_BYTES)
    zstd_bag = folder / "zstd_bag"
    found = {}
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
        found[name] = measured(path, folder / f"store {name}")
        found[name]["images"] = 0 if name in (PLAIN, LONG) else images
        if name in ("MCAP, images, no chunks", LONG):
            path.unlink()
    return found
