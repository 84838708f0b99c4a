"""A fleet's store: what it costs to open it, to ask it, to audit it and to mix from it.

    python benchmarks/store.py [--quick] [--json] [--check] [--size NAME] [--keep FOLDER]
                               [--compact]

Synthetic fleets are written by the project's own writer, some recordings a commit: few rows in
many files, and as many rows as a fleet has. Each question is asked in a process of its own; wall
and CPU seconds are of the question alone, what imports cost is paid before. `--keep` keeps the
stores, and takes those that are there; one that was cut off is written again. `--compact` then
joins the files and asks again (the store is kept under another name). The largest fleets are made
only where --size names them: 100 M rows take 80 GB, and as much again for the panel of `mix`.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any

import duckdb
from harness import finish, markdown, option_parser
from store_fleet import FIRST_DAY, disk_bytes, files_of_day, write_fleet

LIMIT_S = 300  # a question that takes longer, per ten million rows, is not waited for
BATCH = 100  # recordings a commit
DAY = 2  # of the fleet, the first being 0
ONE_DAY = (
    f"stamp_ns >= epoch_ns(TIMESTAMP '{FIRST_DAY + timedelta(DAY):%Y-%m-%d}')"
    f" AND stamp_ns < epoch_ns(TIMESTAMP '{FIRST_DAY + timedelta(DAY + 1):%Y-%m-%d}')"
)


@dataclass(frozen=True)
class Size:
    """A fleet, and the seconds and bytes that questions to it may take."""

    files: int
    rows: int  # of each
    targets_s: Mapping[str, float]
    most_bytes: Mapping[str, float] = field(default_factory=dict)
    only: tuple[str, ...] = ()  # questions; none named: all
    asked_for: bool = False  # made only where it is named
    sectors: int | None = None  # of the lidar that are observed; None: the shipped task's

    @property
    def limit_s(self) -> float:
        return LIMIT_S * max(self.files * self.rows / 1e7, 1)


_OPEN = {"count": 0.5, "coverage": 1.0, "coverage_by_condition": 1.0, "episodes": 1.0}
SIZES = {
    "quick": Size(60, 200, {}),
    "1,000 small files": Size(1_000, 20, _OPEN),
    "10,000 small files": Size(10_000, 20, _OPEN, only=("open", *_OPEN)),
    "1 M rows": Size(140, 7_200, _OPEN),
    # `mix` took 77 s and 8.8 GB once: twice as fast, with a third of the memory.
    "10 M rows": Size(
        *(1_400, 7_200, {**_OPEN, "audit": 30.0, "mix": 38.5}), {"audit": 2e9, "mix": 2.9e9}
    ),
    "20 M rows": Size(2_800, 7_200, {}, asked_for=True),
    "100 M rows": Size(14_000, 7_200, {}, asked_for=True, sectors=0),
}
QUESTIONS = {
    "open": "",
    "count": "SELECT count(*) FROM transitions",
    "coverage": "FROM coverage",
    "coverage_by_condition": "FROM coverage_by_condition",
    "episodes": "SELECT ended, count(*), avg(success::INTEGER) FROM episodes GROUP BY ALL",
    "one_column": "SELECT primary_condition, avg(reward) FROM transitions GROUP BY ALL",
    # Of one day, and of that day's files alone: what partitioning by day could save at most.
    "one_day": (
        f"SELECT primary_condition, avg(reward) FROM transitions WHERE {ONE_DAY} GROUP BY ALL"
    ),
    "one_day_alone": "",
    "audit": "",
    "mix": "",
}


def ask(store: Path, question: str) -> dict[str, float]:
    """Ask it here; wall and CPU seconds, and the peak of this process' memory in bytes."""
    import contextlib
    import importlib
    import resource

    from restock.cli import main as restock
    from restock.replay.store.store import Store

    # Only what the command itself imports: libraries count as its memory.
    if needs := {"audit": "replay.store.audit", "mix": "replay.panel.build"}.get(question):
        importlib.import_module(f"restock.{needs}")

    with tempfile.TemporaryDirectory(dir=store.parent) as folder:
        began, cpu = time.perf_counter(), time.process_time()
        with contextlib.redirect_stdout(sys.stderr):
            if question == "audit":
                code = restock(["audit", str(store)])
            elif question == "compact":
                code = restock(["store", "compact", str(store)])
            elif question == "mix":
                code = restock(["mix", str(store), "--out", f"{folder}/panel"])
            elif question == "one_day_alone":
                of_day = [str(file) for file in files_of_day(store, DAY)]
                text = "SELECT condition, avg(reward) FROM read_parquet(?) GROUP BY ALL"
                duckdb.execute(text, [of_day]).fetchall()
                code = 0
            else:
                with Store(store) as opened:
                    if text := QUESTIONS[question]:
                        opened.sql(text).fetchall()
                code = 0
        wall, cpu = time.perf_counter() - began, time.process_time() - cpu
    if code not in (0, 1):
        raise SystemExit(f"{question}: exit code {code}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {"wall_s": wall, "cpu_s": cpu, "peak_bytes": peak}


def requested(store: Path, question: str, limit_s: float) -> dict[str, float]:
    """Return the same in a process of its own; empty where it is not done after `limit_s`."""
    command = [sys.executable, __file__, "--ask", question, str(store)]
    print(f"  {question} …", file=sys.stderr)
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit_s, check=False)
    except subprocess.TimeoutExpired:
        return {}
    if done.returncode:
        raise SystemExit(done.stderr)
    answer: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return answer


def measure(name: str, folder: Path, *, rounds: int, compact: bool) -> dict[str, Any]:
    """Measure one fleet: writing it, then every query; the median of some rounds."""
    size, store = SIZES[name], folder / name.replace(" ", "_").replace(",", "")
    figures: dict[str, Any] = {"files": size.files, "rows": size.files * size.rows}
    print(f"{name}: {size.files:,} files of {size.rows:,} rows", file=sys.stderr)
    if not store.exists():
        partial = store.with_name(f"{store.name}.partial")  # a whole fleet only is given its name
        shutil.rmtree(partial, ignore_errors=True)
        began, cpu = time.perf_counter(), time.process_time()
        write_fleet(partial, size.files, size.rows, batch=BATCH, sectors=size.sectors)
        partial.rename(store)
        figures["write_wall_s"] = time.perf_counter() - began
        figures["write_cpu_s"] = time.process_time() - cpu
    figures["disk_bytes"] = disk_bytes(store)
    figures["as written"] = _answers(store, size, rounds)
    if compact:
        joined = store.rename(store.with_name(f"{store.name}_compacted"))
        figures["compact"] = requested(joined, "compact", size.limit_s)
        figures["compacted"] = _answers(joined, size, rounds)
    return figures


def _answers(store: Path, size: Size, rounds: int) -> dict[str, dict[str, float]]:
    answers = {}
    for question in size.only or QUESTIONS:
        if question == "one_day_alone" and not any(files_of_day(store, DAY)):
            continue  # joined, or of fewer days
        times = rounds if question not in ("audit", "mix") else 1
        several = [requested(store, question, size.limit_s) for _ in range(times)]
        done = sorted((one for one in several if one), key=lambda one: one["wall_s"])
        answers[question] = done[len(done) // 2] if done else {}
    return answers


def missed(figures: Mapping[str, Any]) -> list[str]:
    """Return the targets that these figures miss."""
    misses = []
    for name, one in figures.items():
        for question, most in SIZES[name].targets_s.items():
            answer = one["as written"].get(question, {})
            if answer.get("wall_s", float("inf")) > most:
                took = f"{answer['wall_s']:.2f} s" if answer else "not done in time"
                misses.append(f"{name}, {question}: {took}, at most {most:g} s")
        for question, most in SIZES[name].most_bytes.items():
            peak = one["as written"].get(question, {}).get("peak_bytes", 0)
            if peak > most:
                misses.append(f"{name}, {question}: {peak / 1e9:.1f} GB, at most {most / 1e9:g} GB")
    return misses


def lines(figures: Mapping[str, Any]) -> Iterator[str]:
    """Yield the figures as tables."""
    for name, one in figures.items():
        size = f"{one['files']:,} files, {one['rows']:,} rows, {one['disk_bytes'] / 1e6:,.0f} MB"
        yield f"{name}: {size}"
        if "write_cpu_s" in one:
            yield f"written in {one['write_wall_s']:.1f} s, {one['write_cpu_s']:.1f} s of CPU"
        for when in ("as written", "compacted"):
            if when in one:
                rows = [[question, *_cells(answer)] for question, answer in one[when].items()]
                if when == "compacted":
                    rows.insert(0, ["(joining the files)", *_cells(one["compact"])])
                yield markdown([f"{when}: question", "s", "CPU s", "peak MB"], rows)


def _cells(answer: Mapping[str, float]) -> list[str]:
    if not answer:
        return ["not done in time", "", ""]
    return [
        f"{answer['wall_s']:.2f}",
        f"{answer['cpu_s']:.2f}",
        f"{answer['peak_bytes'] / 1e6:,.0f}",
    ]


def main() -> int:
    parser = option_parser(__doc__, quick="one small fleet")
    parser.add_argument("--size", choices=SIZES, action="append", help="may be repeated")
    parser.add_argument("--keep", type=Path, help="folder of the stores, which stay there")
    parser.add_argument("--compact", action="store_true", help="then join the files, and ask again")
    parser.add_argument("--ask", nargs=2, metavar=("QUESTION", "STORE"), help="ask it here")
    options = parser.parse_args()
    if options.ask:
        print(json.dumps(ask(Path(options.ask[1]), options.ask[0])))
        return 0
    every = [name for name, size in SIZES.items() if name != "quick" and not size.asked_for]
    names = options.size or (["quick"] if options.quick else every)
    folder = options.keep or Path(tempfile.mkdtemp(prefix="restock-store-"))
    try:
        rounds = 1 if options.quick else 3
        figures = {
            name: measure(name, folder, rounds=rounds, compact=options.compact) for name in names
        }
    finally:
        if options.keep is None:
            shutil.rmtree(folder, ignore_errors=True)
    return finish(options, figures, missed(figures), lines(figures))


if __name__ == "__main__":
    sys.exit(main())
