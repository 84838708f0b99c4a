"""`restock coverage`: what a store holds, what is missing, and which robots changed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from restock.cli import output
from restock.cli.fleet.diff import section
from restock.cli.words import Option, Positional, refuse
from restock.errors import (
    ConfigError,
    ExitCode,
    RestockError,
    by_priority,
    figure,
    quoted,
    uncertain_labels,
)

if TYPE_CHECKING:
    from restock.replay.fleet.drift import Drift
    from restock.replay.fleet.shopping_list import ShoppingList
    from restock.replay.mixture.mixture import Mixture
    from restock.replay.store.audit import Thresholds
    from restock.replay.store.store import Store


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

    store: Annotated[str, Positional("STORE")]
    """The store."""
    out: Annotated[Path | None, Option("FILE")] = None
    """Write an HTML page that opens without a network. Replaces an existing file."""
    mixture: Annotated[str, Option("NAME|FILE")] = "coverage"
    """The mixture whose planned draws say how much is needed of each stratum. See
    docs/mixture.md."""
    json: bool = False
    """Print the table as JSON, one object per condition."""

    def run(self) -> None:
        """Measure the coverage, print it, and write the page."""
        from restock.files import expect_file_place
        from restock.replay.store.novelty import explain_novel_rows, is_quick, novel_rows
        from restock.replay.store.store import Store

        if self.out is None:
            why = "applies only to the page"
            refuse(self, ("mixture",), why, remedy="give --out FILE, too")
        expect_file_place(self.out, "--out")
        with Store(self.store) as store:
            output.say_unverified(store)
            rows = store.sql("FROM coverage_by_condition").to_arrow_table().to_pylist()
            order = store.priority()
            novel = novel_rows(store) if self.out or is_quick(store) else None
            if self.out is not None:
                with output.progress("page", 3) as advance:
                    page = self._write(store, self.out, advance)
                output.say(f"wrote {page}")
        known = [] if novel is None else [novel]
        if self.json:
            output.print_json(rows + known)
        else:
            lines = [_line(row) for row in rows + known]
            output.print_table(lines, title="rows that hold each condition")
            output.print_text(by_priority(order))
            text = "Novelty was not measured yet." if novel is None else explain_novel_rows(novel)
            text += f" `restock trace {quoted(self.store)}` lists the strangest rows."
            output.print_text(text)
            if guessed := {r["condition"]: n for r in rows if (n := r["uncertain_recordings"])}:
                text = uncertain_labels(guessed, max(guessed.values()))
                output.print_text(text)

    def _write(self, store: Any, out: Path, advance: Callable[[int, str], None]) -> Path:
        from restock.replay.fleet.drift import measure_drift
        from restock.replay.mixture.mixture import load_mixture
        from restock.replay.store.audit import load_thresholds
        from restock.report import coverage_page, write_page

        advance(0, "what is missing")
        mixture, thresholds = load_mixture(self.mixture), load_thresholds(None)
        _, missing = _find_gaps(store, mixture, self.mixture, thresholds)
        advance(1, "drift")
        drift: Drift | str
        try:
            drift = measure_drift(store)
        except RestockError as error:  # the logs cannot show drift
            drift = str(error)
        advance(1, "charts")
        return write_page(coverage_page(store, missing, drift), out)


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
        "by priority": row.get("primary_rows", ""),
    }


_MEANING = {
    "hours": "hours: of driving as logged so far, until one gap is closed: median (95 %)",
    "missions": "missions: of the best kind, until one gap is closed: median (95 %)."
    " --unit hours counts hours of driving as logged, without choosing missions",
}


@dataclass
class GapsCommand:
    """Find what is missing from a store, and how many missions of which kind would fill the gaps.

        restock coverage gaps store/
        restock coverage gaps store/ --mixture my.toml --missions-out next.toml
        restock coverage gaps store/ --min-rows 20

    A gap is something that a mixture or an audit of coverage requires and that the store lacks:
    rows of a stratum, rows or episodes of a condition, cells of condition x action; with --min-rows
    also cells of condition x zone x action (x robot). Each gap is printed with the rate seen so
    far, and the number of missions (or hours of driving) needed at that rate, with its 95 %
    interval. The plan is the least number of missions that fills all gaps. It can be written as a
    file for `restock twin record --missions`, and for training (env.missions).
    """

    store: Annotated[str, Positional("STORE")]
    """The store."""
    mixture: Annotated[str, Option("NAME|FILE")] = "coverage"
    """The mixture whose planned draws say how much is needed of each stratum. See
    docs/mixture.md."""
    thresholds: Annotated[Path | None, Option("FILE|none")] = None
    """A TOML file with thresholds of audits that replace the shipped ones, as for `restock
    audit`; `none`: use only the needs of the mixture, not those of the audits."""
    min_rows: Annotated[int, Option("N")] = 0
    """Also require at least this many rows of every cell."""
    unit: Literal["missions", "hours"] | None = None
    """Count in missions or in hours of driving. Default: missions if a simulator made the
    recordings, hours if robots did."""
    missions_out: Annotated[Path | None, Option("FILE")] = None
    """Write the plan as a missions file, which must not exist yet."""
    json: bool = False
    """Print one JSON document."""

    def run(self) -> None:
        """Find the gaps, plan what fills them, and print both."""
        from restock.files import expect_file_place
        from restock.replay.fleet.missions_file import (
            from_shopping_list,
            refuse_existing,
            write_missions,
        )
        from restock.replay.mixture.mixture import load_mixture
        from restock.replay.store.audit import load_thresholds
        from restock.replay.store.store import Store

        if self.min_rows < 0:
            raise ConfigError(f"must be 0 or more, got {self.min_rows}", where="--min-rows")
        mixture = load_mixture(self.mixture)
        thresholds = None
        if str(self.thresholds) != "none":
            thresholds = load_thresholds(self.thresholds)
        if self.missions_out is not None:
            refuse_existing(self.missions_out)
        expect_file_place(self.missions_out, "--missions-out")
        with Store(self.store) as store:
            found, answer = _find_gaps(
                store, mixture, self.mixture, thresholds, min_rows=self.min_rows, unit=self.unit
            )
            place = f"{store.path}@{store.version}"
        if self.missions_out is not None:
            plan = from_shopping_list(found, store=place, mixture=self.mixture)
            write_missions(self.missions_out, plan)
            answer["missions_file"] = str(self.missions_out)
        if self.json:
            output.print_json(answer)
        else:
            _print_gaps(answer)


def _find_gaps(
    store: Store,
    mixture: Mixture,
    name: str,
    thresholds: Thresholds | None,
    *,
    min_rows: int = 0,
    unit: Literal["missions", "hours"] | None = None,
) -> tuple[ShoppingList, dict[str, Any]]:
    """Return what fills a store's gaps, and the document that `restock coverage gaps` prints."""
    from restock.replay.fleet.gaps import find_gaps
    from restock.replay.fleet.shopping_list import document, shopping_list
    from restock.train.twin.missions import KINDS

    yields, gaps = find_gaps(
        store,
        mixture,
        name=name,
        folder=Path(name).parent,
        kinds=KINDS,
        thresholds=thresholds,
        min_rows=min_rows,
    )
    found = shopping_list(yields, gaps, unit=unit)
    place = {"store": str(store.path), "store_version": store.version, "mixture": name}
    return found, {**place, "episodes": len(yields), **document(found)}


def _print_gaps(answer: dict[str, Any]) -> None:
    from restock.replay.fleet.shopping_list import readable

    unit = answer["unit"]
    name = f"{answer['store']} version {answer['store_version']}"
    if answer["closed"]:
        output.print_text(f"{name}: no gaps; it has all that {answer['mixture']} requires")
        return
    known, unknown, orders = readable(answer)
    if known:
        title = f"{name}: what is missing, at the rates of its {answer['episodes']:,} episodes"
        _table(title, known, note=_MEANING[unit])
    if unknown:
        _table("never seen: no rate is known", unknown)
    plan = answer["plan"]
    if orders:
        _table("what to log next", orders)
        output.print_text(
            f"{figure(plan['total'])} {unit} in all (95 %: {figure(plan['total_low'])} to"
            f" {figure(plan['total_high'])})"
            + (f", {figure(plan['hours'])} hours" if unit == "missions" else "")
            + f": each gap is then closed with a probability of {answer['confidence']:.0%} or more,"
            " not 50% as in the table above"
        )
    if "missions_file" in answer:
        output.print_text(f"-> {answer['missions_file']}")


def _table(title: str, rows: list[dict[str, Any]], note: str = "") -> None:
    section(title, rows)
    if note:
        output.print_text(note)


@dataclass
class DriftCommand:
    """Find out which robot's wheels, lidar or floor have changed.

    Compares each robot's weeks with its own first two and with the other robots of its site. Each
    signal (odometry scale, lidar noise, gyroscope bias, …) and the rate at which each condition
    begins gets a two-sample test over recordings or episodes, with an effect size and a p-value
    corrected over all tests. A change that all robots of a site share is reported for the site.
    Robots and sites are tags of recordings (`restock ingest --tag robot=amr-1`). See
    docs/coverage.md.

        restock coverage drift store/
        restock coverage store/ --out coverage.html                 # a page with the weeks
        restock sql store/ "FROM drift WHERE robot = 'amr-2'"       # every comparison
    """

    store: Annotated[str, Positional("STORE")]
    """The store."""
    every: str = "week"
    """The length of a period: day, week, month, year or decade."""
    exit_code: bool = False
    """Exit 1 if a robot, a site or a condition has changed; how a robot was driven does not
    count."""
    json: bool = False
    """Print one JSON document: {"findings", "notes", "tests", …}."""

    def run(self) -> int:
        """Measure the drift and print it."""
        from restock.replay.fleet.drift import measure_drift
        from restock.replay.store.store import Store

        with Store(self.store) as store:
            output.say_unverified(store)
            drift = measure_drift(store, every=self.every)
        if self.json:
            output.print_json(drift.document())
        else:
            _print_drift(drift)
        changed = any(row["part"] != "driving" for row in drift.findings)
        return int(ExitCode.FAILED if self.exit_code and changed else ExitCode.OK)


def _print_drift(drift: Drift) -> None:
    verdicts: dict[tuple[str, str], Counter[str]] = {}
    for row in drift.tests:
        verdicts.setdefault((row["robot"], row["against"]), Counter())[row["verdict"]] += 1
    names = sorted({name for counts in verdicts.values() for name in counts})
    output.print_table(
        [
            {"robot": robot, "against": against, **{name: counts[name] for name in names}}
            for (robot, against), counts in sorted(verdicts.items())
        ],
        ["robot", "against", *names],
        title=f"comparisons by {drift.every}",
    )
    for note in drift.notes:
        output.print_text(f"- {note}")
    output.print_text()
    for row in drift.findings:
        output.print_text(row["finding"])
    if not drift.findings:
        output.print_text(drift.without_findings())
