"""Counts the files and functions that three journeys through the code cross.

    python benchmarks/journeys.py                 # all three
    python benchmarks/journeys.py "mcap to rows"

A **switch** is a call from one file of Restock into another. A pair of files is **called back and
forth** if each calls the other; calls once per row show as counts in the thousands. Everything runs
once before it is measured, so that imports do not count.
"""

from __future__ import annotations

import argparse
import io
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
# Links within `src` lead to the rooms beside it.
PLACES = tuple(f"{ROOT / name}/" for name in ("src", "ingest", "replay", "train"))
PAIRS_SHOWN = 5


class Journey:
    """Calls between functions of Restock, in all threads, while it is entered."""

    def __init__(self) -> None:
        self.functions: set[CodeType] = set()
        self.calls = Counter[tuple[str, str]]()  # of (calling file, called file)
        self._names: dict[str, str | None] = {}

    def __enter__(self) -> Journey:
        threading.setprofile(self._event)
        sys.setprofile(self._event)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        threading.setprofile(None)

    def _event(self, frame: FrameType, event: str, _: Any) -> None:
        if event != "call" or (called := self._file(frame.f_code)) is None:
            return
        self.functions.add(frame.f_code)
        caller = frame.f_back
        while caller is not None and (calling := self._file(caller.f_code)) is None:
            caller = caller.f_back
        if caller is not None and calling is not None and calling != called:
            self.calls[calling, called] += 1

    def _file(self, code: CodeType) -> str | None:
        """Return the path of a function's file in the repository; None if it is elsewhere."""
        if code.co_filename not in self._names:
            path = str(Path(code.co_filename).resolve())
            inside = path.startswith(PLACES)
            self._names[code.co_filename] = str(Path(path).relative_to(ROOT)) if inside else None
        return self._names[code.co_filename]

    def print(self, name: str) -> None:
        """Print what was crossed, and the pairs of files with the most calls both ways."""
        files = {self._file(code) for code in self.functions}
        print(
            f"{name}: {len(files)} files, {len(self.functions):,} functions,"
            f" {self.calls.total():,} switches"
        )
        both = {
            pair: min(count, self.calls[pair[::-1]])
            for pair, count in self.calls.items()
            if pair < pair[::-1] and self.calls[pair[::-1]]
        }
        for pair, _ in Counter(both).most_common(PAIRS_SHOWN):
            there, back = self.calls[pair], self.calls[pair[::-1]]
            print(f"  {pair[0]} -> {pair[1]} {there:,}, back {back:,}")


def mcap_to_rows(folder: Path) -> Callable[[], object]:
    """Return what ingests one sample log, each time into a new store."""
    from restock.cli import main

    log = ROOT / "sample_logs/amr_monday.mcap"
    made = 0

    def ingest() -> None:
        nonlocal made
        made += 1
        store = folder / f"store-{made}"
        arguments = ["ingest", str(log), "--store", str(store)]
        with redirect_stdout(io.StringIO()):
            if main(arguments):
                raise SystemExit(f"`restock {' '.join(arguments)}` failed")

    return ingest


def row_to_gradient(folder: Path, *, plain: bool) -> Callable[[], object]:
    """Return what makes one update, online, after a short run.

    It learns by the default recipe on a panel of a sample log, or as plain DQN without logs.
    """
    from restock.cli import main
    from restock.train import loop
    from restock.train.prepare import prepare_new

    panel = None
    if not plain:
        mcap_to_rows(folder)()
        panel = folder / "panel"
        with redirect_stdout(io.StringIO()):
            main(["mix", str(folder / "store-1"), "--mixture", "coverage", "--out", str(panel)])
    session = prepare_new(folder / "run", panel, None, PLAIN if plain else SHORT).open()
    loop.train(session)
    return partial(loop._run_updates, session, 1, "online", lambda event, values: None)


SHORT = [
    "seed=0",
    "device=cpu",
    "schedule.offline_updates=64",
    "schedule.warmup_env_steps=400",
    "schedule.env_steps=800",
    "evaluation.every_env_steps=100000",
]
PLAIN = [
    *SHORT[:2],
    *SHORT[3:],
    "network.layer_norm=false",
    "loss.n_step=1",
    "loss.double=false",
    "teacher.source=none",
]
JOURNEYS: dict[str, Callable[[Path], Callable[[], object]]] = {
    "mcap to rows": mcap_to_rows,
    "row to gradient": partial(row_to_gradient, plain=False),
    "plain DQN": partial(row_to_gradient, plain=True),
}


def main() -> None:
    """Measure the journeys that are named, or all of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("journey", nargs="*", metavar="JOURNEY", help=", ".join(JOURNEYS))
    names = parser.parse_args().journey or list(JOURNEYS)
    if unknown := [name for name in names if name not in JOURNEYS]:
        parser.error(f"no journey {unknown[0]!r}: there are {', '.join(JOURNEYS)}")
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            travel = JOURNEYS[name](Path(folder))
            travel()  # imports what it needs, and fills caches
            with Journey() as journey:
                travel()
        journey.print(name)


if __name__ == "__main__":
    main()
