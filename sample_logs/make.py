"""Records sample_logs/ again: the same bytes from the same seeds.

    make sample-logs                            # or: python sample_logs/make.py
    python sample_logs/make.py --out elsewhere --check   # exit 1 where they differ from these

Two things beside the seeds decide the bytes. The libraries that compute and compress: their
versions are in manifest.json. And the vector instructions of the processor, whose sines differ in
the last bit, which a robot that bumps into things soon shows: so numpy is kept to the
instructions that every x86-64 processor has. (The C library's own sines still use FMA, which
every one since 2013 has.)
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import shutil
import sqlite3
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

HERE = Path(__file__).parent
NAMES = ("amr_monday.mcap", "amr_tuesday")
LIBRARIES = ("mujoco", "numpy", "scipy", "mcap", "zstandard", "rosbags")
DAY_NS = 86_400_000_000_000


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--out", type=Path, default=HERE, help="where to (default: here)")
    parser.add_argument("--quick", action="store_true", help="two missions each, to try it")
    parser.add_argument("--check", action="store_true", help="exit 1 where the bytes differ")
    args = parser.parse_args()
    if "NPY_DISABLE_CPU_FEATURES" not in os.environ:
        return run_on_baseline()
    # Read before anything is replaced: --out may be this very folder.
    wanted = json.loads((HERE / "manifest.json").read_text())["files"] if args.check else None
    args.out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".making-", dir=args.out) as scratch:
        made = record_all(Path(scratch), quick=args.quick)
        for name in NAMES:
            target = args.out / name
            if target.is_dir():
                shutil.rmtree(target)
            (Path(scratch) / name).replace(target)
    manifest = {"files": digests(args.out), "libraries": libraries(), "recorded": made}
    (args.out / "manifest.json").write_text(json.dumps(manifest, indent=1) + "\n")
    for name, entry in manifest["files"].items():
        sys.stdout.write(f"{entry['sha256']}  {entry['bytes']:>9,}  {name}\n")
    if wanted is not None and manifest["files"] != wanted:
        sys.stderr.write("the bytes differ from those in sample_logs/manifest.json\n")
        return 1
    return 0


def run_on_baseline() -> int:
    """Run again with numpy's optional vector instructions off; they cannot be turned off later."""
    from numpy._core import _multiarray_umath as umath

    optional = [name for name in umath.__cpu_dispatch__ if umath.__cpu_features__.get(name)]
    env = {**os.environ, "NPY_DISABLE_CPU_FEATURES": " ".join(optional)}
    return subprocess.run([sys.executable, *sys.argv], env=env, check=False).returncode


def record_all(folder: Path, *, quick: bool) -> dict[str, object]:
    """Both recordings; returns what was recorded in each."""
    from restock.train.twin.recording.publish import Rates
    from restock.train.twin.recording.recorder import FIRST_NS, RecordingPlan, record

    # Rates as a fleet thins its logs out to: the control clock's 5 Hz for most topics.
    monday = Rates(odom=10, imu=10, joint_states=5, scan=5, amcl_pose=5, tf=5, bumper=5, plan=0.5)
    tuesday = Rates(
        odom=5,
        imu=5,
        joint_states=0.5,
        scan=5,
        amcl_pose=5,
        tf=2,
        bumper=5,
        plan=0.2,
        diagnostics=0.2,
    )
    # Somewhat more trouble than the recorder's own shares: enough of each for the shipped mixture.
    missions = {"nominal": 0.74, "wheel_slip": 0.08, "blocked_aisle": 0.08, "near_collision": 0.1}
    plans = {
        "amr_monday.mcap": RecordingPlan(
            format="mcap",
            minutes=36.0,
            seed=20260302,
            conditions=missions,
            rates=monday,
            tags={"robot": "amr-07", "site": "oslo"},
        ),
        "amr_tuesday": RecordingPlan(
            format="rosbag2",
            minutes=2.4,
            seed=20260397,
            conditions=missions,
            rates=tuesday,
            start_ns=FIRST_NS + DAY_NS,
            tags={"robot": "amr-12", "site": "oslo"},
        ),
    }
    made: dict[str, object] = {}
    for name, plan in plans.items():
        if quick:
            plan = replace(plan, minutes=None, missions=2)
        done = record(folder / name, plan).describe()
        made[name] = {
            key: done[key]
            for key in (
                "seed",
                "minutes",
                "missions",
                "succeeded",
                "steps",
                "policy_steps",
                "handovers",
            )
        }
    return made


def digests(folder: Path) -> dict[str, dict[str, object]]:
    """Every file of the recordings: its size and SHA-256."""
    files = [file for name in NAMES for file in sorted([folder / name, *(folder / name).glob("*")])]
    return {
        file.relative_to(folder).as_posix(): {
            "bytes": file.stat().st_size,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        }
        for file in files
        if file.is_file()
    }


def libraries() -> dict[str, str]:
    """The versions that decide the bytes."""
    versions = {name: version(name) for name in LIBRARIES}
    libc = "-".join(platform.libc_ver())
    system = {"sqlite": sqlite3.sqlite_version, "libc": libc, "machine": platform.machine()}
    return {**versions, **system}


if __name__ == "__main__":
    sys.exit(main())
