"""`restock coverage diff`: compare two stores, versions, panels or runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from restock.errors import ExitCode, RestockError

if TYPE_CHECKING:
    from restock.replay.store.store import Store


@dataclass
class DiffCommand:
    """Show the differences between two stores, two versions of a store, two panels or two runs.

        restock coverage diff monday/ tuesday/
        restock coverage diff store@11 store        # versions; store@2026-11-01 is as of that day
        restock coverage diff panels/a panels/b
        restock coverage diff runs/a runs/b

    Stores: recordings and episodes that were added or removed, rows whose labels changed, the
    shares of conditions, zones and policies, and signals that shifted, with 95 % intervals over
    episodes. Panels: mixture, rows, shares and weights. Runs: settings, what their critics were
    fed, and their evaluations side by side. Sources of different tasks are refused, as their rows
    have different meanings. The command only reads.
    """

    first: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """The first (earlier) store, store@VERSION, panel or run."""
    second: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="B")]
    """The second (later) one, of the same kind."""
    exit_code: bool = False
    """Exit 1 if they differ."""
    json: bool = False
    """Print one JSON document with everything."""

    def run(self) -> int:
        """Compare and print; with --exit-code, return whether they differ."""
        from restock.cli import output
        from restock.cli.fleet import diff_tables

        document = _difference(self.first, self.second)
        if self.json:
            output.print_json(document)
        else:
            diff_tables.show(document)
        return int(ExitCode.FAILED if self.exit_code and document["different"] else ExitCode.OK)


def _difference(first: str, second: str) -> dict[str, Any]:
    kinds = {place: _kind_of(place) for place in (first, second)}
    if len(set(kinds.values())) > 1:
        raise RestockError(
            f"{first} is a {kinds[first]}, {second} a {kinds[second]}",
            remedy="give two stores, two panels or two runs; the store of a run or panel is in "
            "its config.json or panel.json",
        )
    kind = kinds[first]
    if kind == "panel":
        from restock.replay.fleet.panel_difference import diff_panels
        from restock.replay.panel.panel import Panel

        return diff_panels(Panel.open(first), Panel.open(second))
    if kind == "run":
        from restock.train.judge.compare import diff_runs

        return diff_runs(Path(first), Path(second))
    from restock.cli import output
    from restock.replay.fleet.store_difference import diff_stores

    with _open(first) as one, _open(second) as other:
        output.say_unverified(one)
        output.say_unverified(other)
        return diff_stores(one, other).document()


def _kind_of(place: str) -> str:
    """Tell a panel or a run by its own file; everything else is taken for a store."""
    from restock.replay.panel.panel import HEADER
    from restock.replay.places import RUN_CONFIG

    if "://" in place:
        return "store"
    if (Path(place) / HEADER).is_file():
        return "panel"
    return "run" if (Path(place) / RUN_CONFIG).is_file() else "store"


def _open(place: str) -> Store:
    from restock.ingest.store.version import split_version
    from restock.replay.store.store import Store

    path, version = split_version(place)
    return Store(path, version=version)
