"""Recording: robot-minutes a second of work, what a minute weighs, and whether memory grows.

Work is CPU time, imports aside: a busy machine does not change it.

    python benchmarks/record.py [--quick] [--json] [--check]

`--check` exits 1 where a robot-minute costs more than two seconds of work, or where memory grows
with the recording's length by more than 64 MiB.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from harness import finish, option_parser

from restock.train.twin.recording.recorder import RecordingPlan, record

MAX_S_PER_MINUTE = 2.0
MAX_GROWTH_MIB = 64


def measure(file_format: str, minutes: float) -> dict[str, Any]:
    """Measure one recording at the default rates, in this process."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / ("log.mcap" if file_format == "mcap" else "log")
        plan = RecordingPlan(
            format="mcap" if file_format == "mcap" else "rosbag2", minutes=minutes, seed=1
        )
        begun = time.process_time()
        done = record(path, plan).describe()
        work_s = time.process_time() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {
        "format": file_format,
        "minutes": done["minutes"],
        "minutes_per_s": done["minutes"] / work_s,
        "s_per_minute": work_s / done["minutes"],
        "messages_per_s": done["messages"] / work_s,
        "mb_per_minute": done["size_bytes"] / 1e6 / done["minutes"],
        "peak_mib": peak,
    }


def in_own_process(file_format: str, minutes: float) -> dict[str, Any]:
    """Measure it in a fresh process, as peak memory is a process's."""
    command = [sys.executable, __file__, "--one", file_format, str(minutes)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def main() -> int:
    parser = option_parser(__doc__, quick="1 and 4 minutes, not 5 and 60")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(options.one[0], float(options.one[1]))))
        return 0
    short, long = (1.0, 4.0) if options.quick else (5.0, 60.0)
    rows = [
        in_own_process(file_format, minutes)
        for file_format, minutes in (("mcap", short), ("rosbag2", short), ("mcap", long))
    ]
    growth_mib = rows[2]["peak_mib"] - rows[0]["peak_mib"]
    lines = [
        f"{row['format']:8} {row['minutes']:5.1f} robot-minutes: "
        f"{row['minutes_per_s']:.2f} a second of work ({row['s_per_minute']:.2f} s each), "
        f"{row['messages_per_s']:,.0f} messages/s, {row['mb_per_minute']:.2f} MB/minute, "
        f"peak {row['peak_mib']:.0f} MiB"
        for row in rows
    ]
    missed = [
        f"{row['format']}: {row['s_per_minute']:.2f} s a robot-minute, at most {MAX_S_PER_MINUTE}"
        for row in rows
        if row["s_per_minute"] > MAX_S_PER_MINUTE
    ]
    if growth_mib > MAX_GROWTH_MIB:
        missed.append(f"memory grew by {growth_mib:.0f} MiB with the length")
    return finish(options, {"recordings": rows, "memory_growth_mib": growth_mib}, missed, lines)


if __name__ == "__main__":
    sys.exit(main())
