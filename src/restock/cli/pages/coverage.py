"""`restock coverage`: what a store holds of each condition, and what is missing, on one page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro


@dataclass
class CoverageCommand:
    """What does a store hold of each condition, where, when and by whom, and what is missing?

    Prints the shelves: rows, episodes and success of each condition. With --out it writes one page:
    shelves, what to log next (as `restock gaps`), weeks, robots, the map, and what has changed
    about which robot (as `restock drift`).

        restock coverage store/
        restock coverage store/ --out coverage.html
    """

    store: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="STORE")]
    """The store."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write a page (HTML) that opens without a network. Replaces what is there."""
    figures: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """With --out: a folder for each figure of the page, as SVG and PNG."""
    mixture: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "coverage"
    """What should be there: a mixture's shares of its planned draws. See docs/mixture.md."""
    every: str = "week"
    """Of drift: the length of a period: day, week, month, year or decade."""
    version: Annotated[str | None, tyro.conf.arg(metavar="N|TIME")] = None
    """The store as it was: a version's number, or a time (2026-11-01T08:00Z); the newest."""
    json: bool = False
    """Print the shelves as JSON, one object a condition."""

    def run(self) -> None:
        """Ask, print, and write the page."""
        from restock.cli import output
        from restock.errors import ConfigError
        from restock.ingest.store.version import given_version
        from restock.replay.store.store import Store

        if self.figures is not None and self.out is None:
            raise ConfigError(
                "are of the page", where="--figures", remedy="name the page with --out FILE"
            )
        with Store(self.store, version=given_version(self.version)) as store:
            rows = store.sql("FROM coverage_by_condition").to_arrow_table().to_pylist()
            if self.out is not None:
                with output.progress("page", 3) as advance:
                    page = self._write(store, self.out, advance)
                output.say(f"wrote {page}")
        if self.json:
            output.print_json(rows)
        else:
            output.print_table([_line(row) for row in rows], title="the shelves")

    def _write(self, store: Any, out: Path, advance: Callable[[int, str], None]) -> Path:
        from restock.errors import ConfigError, RestockError
        from restock.replay.fleet.drift import Drift, measure_drift
        from restock.replay.fleet.gaps import find_gaps
        from restock.replay.fleet.shopping_list import document, shopping_list
        from restock.replay.mixture.mixture import load_mixture
        from restock.replay.store.audit import load_thresholds
        from restock.report import write_coverage_page
        from restock.train.twin.physics.episode import KINDS

        advance(0, "what is missing")
        yields, gaps = find_gaps(
            store,
            load_mixture(self.mixture),
            name=self.mixture,
            folder=Path(self.mixture).parent,
            kinds=KINDS,
            thresholds=load_thresholds(None),
        )
        missing = {
            "store": str(store.path),
            "store_version": store.version,
            "mixture": self.mixture,
            **document(shopping_list(yields, gaps)),
        }
        advance(1, "drift")
        drift: Drift | str
        try:
            drift = measure_drift(store, every=self.every)
        except ConfigError:  # what was asked for is wrong
            raise
        except RestockError as error:  # what is logged tells nothing of it
            drift = str(error)
        advance(1, "charts")
        return write_coverage_page(store, missing, drift, out, self.figures)


def _line(row: dict[str, Any]) -> dict[str, Any]:
    share, success = row["share"], row["success_share"]
    return {
        "condition": row["condition"],
        "rows": "unknown" if row["rows"] is None else row["rows"],
        "share": "" if share is None else f"{share:.1%}",
        "episodes": row["episodes"],
        "success": "" if success is None else f"{success:.0%}",
        "zones": row["zones"],
        "recordings": row["recordings"],
        "who drove": ", ".join(str(name) for name in row["behaviour_policies"] or () if name),
    }
