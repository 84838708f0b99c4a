"""`restock coverage`: what a store holds of each condition, and what is missing, on one page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro


@dataclass
class CoverageCommand:
    """Show how much of each condition a store holds, where, when and by which driver.

    Prints the rows in which each condition holds, their episodes and success. A row can hold
    several conditions and counts for each of them; `by priority` counts it once. With --out, it
    writes one page: the conditions, what to log next (as `gaps`), weeks, robots, the map, and which
    robots have changed (as `drift`).

        restock coverage store/
        restock coverage store/ --out coverage.html

    `restock coverage gaps`, `drift` and `diff` have their own options and --help.
    """

    store: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="STORE")]
    """The store."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write an HTML page that opens without a network. Replaces an existing file."""
    figures: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """With --out: also write each figure of the page as SVG and PNG into this folder."""
    mixture: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "coverage"
    """The mixture whose planned draws say how much is needed of each stratum. See
    docs/mixture.md."""
    every: str = "week"
    """The length of a period for drift: day, week, month, year or decade."""
    version: Annotated[str | None, tyro.conf.arg(metavar="N|TIME")] = None
    """An earlier version of the store: its number, or a time (2026-11-01T08:00Z). Default: the
    newest."""
    json: bool = False
    """Print the table as JSON, one object per condition."""

    def run(self) -> None:
        """Ask, print, and write the page."""
        from restock.cli import output
        from restock.cli.command_line import refuse
        from restock.files import expect_file_place
        from restock.ingest.store.version import given_version
        from restock.replay.store.store import Store
        from restock.words import by_priority, uncertain_labels

        if self.out is None:
            options, why = ("figures", "mixture", "every"), "applies only to the page"
            refuse(self, options, why, remedy="give --out FILE, too")
        expect_file_place(self.out, "--out")
        if self.figures is not None:
            expect_file_place(self.figures / "figure.svg", "--figures")
        with Store(self.store, version=given_version(self.version)) as store:
            output.say_unverified(store)
            rows = store.sql("FROM coverage_by_condition").to_arrow_table().to_pylist()
            order = store.priority()
            if self.out is not None:
                with output.progress("page", 3) as advance:
                    page = self._write(store, self.out, advance)
                output.say(f"wrote {page}")
        if self.json:
            output.print_json(rows)
        else:
            output.print_table([_line(row) for row in rows], title="rows that hold each condition")
            output.stdout().print(by_priority(order), markup=False, soft_wrap=True)
            if guessed := {r["condition"]: n for r in rows if (n := r["uncertain_recordings"])}:
                said = uncertain_labels(guessed, max(guessed.values()))
                output.stdout().print(said, markup=False, soft_wrap=True)

    def _write(self, store: Any, out: Path, advance: Callable[[int, str], None]) -> Path:
        from restock.errors import ConfigError, RestockError
        from restock.replay.fleet.drift import Drift, measure_drift
        from restock.replay.fleet.gaps import find_gaps
        from restock.replay.fleet.shopping_list import document, shopping_list
        from restock.replay.mixture.mixture import load_mixture
        from restock.replay.store.audit import load_thresholds
        from restock.report import write_coverage_page
        from restock.train.twin.missions import KINDS

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
        except ConfigError:  # an option is wrong
            raise
        except RestockError as error:  # the logs do not show it
            drift = str(error)
        advance(1, "charts")
        return write_coverage_page(store, missing, drift, out, self.figures)


def _line(row: dict[str, Any]) -> dict[str, Any]:
    share, success = row["held_share"], row["success_share"]
    return {
        "condition": row["condition"],
        "rows": "unknown" if row["rows_held"] is None else row["rows_held"],
        "share": "" if share is None else f"{share:.1%}",
        "episodes": row["episodes_held"],
        "success": "" if success is None else f"{success:.0%}",
        "zones": row["zones"],
        "recordings": row["recordings"],
        "who drove": ", ".join(str(name) for name in row["behaviour_policies"] or () if name),
        "by priority": row["primary_rows"],
    }
