"""The evidence: does coverage-aware replay of rare logs pay off? One command, start to end.

    python benchmarks/evidence.py --out /tmp/evidence [--hours 4] [--workers 2]

Records hours of the stand-in fleet at natural rates (88 % of missions nominal, 4 % each of wheel
slip, blocked aisles and near collisions), ingests them, and runs the study of benchmarks/evidence/:
every arm with every seed at equal environment steps and updates. What is there is not done again.
The result is OUT/study/study.md; docs/evidence.md discusses it.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from restock.cli import main as restock

HERE = Path(__file__).parent / "evidence"
NATURAL = "nominal=.88,wheel_slip=.04,blocked_aisle=.04,near_collision=.04"
RATES = "odom=10,imu=10,scan=5,joint_states=5,amcl_pose=5,tf=5,bumper=5"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--hours", type=int, default=4, help="one recording each")
    parser.add_argument("--workers", type=int, default=1, help="runs at a time")
    options = parser.parse_args()
    logs = options.out / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    for hour in range(options.hours):
        recording = logs / f"hour{hour + 1}.mcap"
        if not recording.exists():
            words = ["--minutes", "60", "--seed", str(101 + hour), "--rates", RATES]
            _must(["record", "--out", str(recording), "--conditions", NATURAL, *words])
    if not (options.out / "store").exists():
        _must(["ingest", str(logs), "--store", str(options.out / "store")])
    for file in HERE.glob("*.toml"):
        shutil.copy(file, options.out / file.name)
    study = ["study", str(options.out / "study.toml"), "--out", str(options.out / "study")]
    return restock([*study, "--workers", str(options.workers)])


def _must(arguments: list[str]) -> None:
    if restock(arguments) not in (0, 3):
        raise SystemExit(f"restock {' '.join(arguments)} failed")


if __name__ == "__main__":
    raise SystemExit(main())
