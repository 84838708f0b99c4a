"""What the benchmarks share: options, rounds in which contenders take turns, and their targets.

A benchmark measures, and ends with `finish`: `--json` prints its figures instead of lines, what is
missed goes to stderr in either case, and `--check` exits 1 where a target is missed. It imports
nothing of training, which would count as the memory of what is measured.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from restock.cli import main as restock
from restock.files import write_text
from restock.stats import percentiles

T = TypeVar("T")


def option_parser(doc: str | None, quick: str = "") -> argparse.ArgumentParser:
    """Return the options that benchmarks share; `quick` describes a small run, if there is one."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if quick:
        parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--json", action="store_true", help="figures as JSON")
    parser.add_argument("--check", action="store_true", help="exit 1 where a target is missed")
    return parser


def in_turns(contenders: Mapping[str, Callable[[], T]], rounds: int) -> dict[str, list[T]]:
    """Return what each contender gives in each round.

    They take turns, so that a busy machine slows all of them.
    """
    measured: dict[str, list[T]] = {name: [] for name in contenders}
    for number in range(rounds):
        for name, measure in contenders.items():
            measured[name].append(measure())
        print(f"round {number + 1} of {rounds}", file=sys.stderr)
    return measured


def medians(measured: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Return the middle of each contender's rounds."""
    return {name: float(np.median(values)) for name, values in measured.items()}


def cpu_us(run: Callable[[], object], repeats: int) -> float:
    """CPU microseconds of one call, this process' threads together."""
    began = time.process_time()
    for _ in range(repeats):
        run()
    return (time.process_time() - began) / repeats * 1e6


def mean_interval(
    values: NDArray[np.float64], rng: np.random.Generator, resamples: int
) -> tuple[float, float]:
    """95 % of the mean of (runs, episodes), with both drawn again: all runs drove the same ones."""
    runs, episodes = values.shape
    means = [
        values[rng.integers(runs, size=runs)][:, rng.integers(episodes, size=episodes)].mean()
        for _ in range(resamples)
    ]
    return percentiles(np.array(means))


def run_restock(arguments: Sequence[str]) -> None:
    """Run a command of Restock in this process; what it prints goes to stderr."""
    with contextlib.redirect_stdout(sys.stderr):
        code = restock(arguments)
    if code not in (0, 3):
        raise SystemExit(f"restock {' '.join(arguments)} failed")


def once(mark: Path, requested: Sequence[str], do: Callable[[], object]) -> None:
    """Do what is asked, and keep in `mark` what that was: it is not done again.

    Raises:
        SystemExit: it was done as something else was asked.
    """
    text = json.dumps(requested, indent=1) + "\n"
    if not mark.exists():
        do()
        write_text(mark, text)
    elif mark.read_text(encoding="utf-8") != text:
        raise SystemExit(
            f"{mark}: holds other measurements than these ({', '.join(requested)}): remove it"
            " and its files, or name another --out"
        )


def markdown(header: Sequence[object], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as the docs have it."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def finish(
    options: argparse.Namespace,
    figures: Mapping[str, Any] | Sequence[Any],
    missed: Sequence[str],
    lines: Iterable[str],
) -> int:
    """Print the figures or these lines, and what is missed; the exit code."""
    if options.json:
        whole = {**figures, "missed": missed} if isinstance(figures, Mapping) else figures
        print(json.dumps(whole, indent=1))
    else:
        for line in lines:
            print(line)
    for miss in missed:
        print(f"missed: {miss}", file=sys.stderr)
    return 1 if options.check and missed else 0
