"""What a short command costs as a whole process: CPU seconds, most of them imports.

    python benchmarks/startup.py [--quick] [--json] [--check]

A store of the sample logs is made; then `restock --help`, a count in SQL, an ingest of what is in
the store already, and all audits, in turns, each as a process of its own. Medians of nine rounds.
Modules are compiled to bytecode beforehand, as after any first call.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from harness import finish, in_turns, markdown, medians, option_parser

LOGS = Path(__file__).parent.parent / "sample_logs"
TARGETS = {"--help": 0.05, "sql": 0.3, "ingest": 0.4, "audit": 0.5}  # CPU seconds, at most


def cpu_seconds(arguments: Sequence[str]) -> float:
    """Return the CPU seconds of one process of Restock, over all its threads."""
    environment = {name: v for name, v in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-m", "restock", *arguments],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    if done.returncode not in (0, 1):  # 1: an audit failed
        raise SystemExit(done.stderr)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def main() -> int:
    parser = option_parser(__doc__, quick="three rounds")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        store = f"{folder}/store"
        commands = {
            "--help": ["--help"],
            "sql": ["sql", store, "SELECT count(*) FROM transitions"],
            "ingest": ["ingest", str(LOGS), "--store", store],
            "audit": ["audit", store],
        }
        cpu_seconds(commands["ingest"])
        for arguments in commands.values():
            cpu_seconds(arguments)
        contenders = {name: partial(cpu_seconds, each) for name, each in commands.items()}
        seconds = medians(in_turns(contenders, 3 if options.quick else 9))
    missed = [
        f"restock {name}: {seconds[name]:.2f} s of CPU, at most {most:g}"
        for name, most in TARGETS.items()
        if seconds[name] > most
    ]
    rows = [[f"`restock {name}`", f"{took:.2f}", TARGETS[name]] for name, took in seconds.items()]
    return finish(options, seconds, missed, [markdown(["command", "CPU s", "target"], rows)])


if __name__ == "__main__":
    sys.exit(main())
