"""`restock check`: may this store, and this run, go on? One gate for a pipeline."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from restock.errors import ConfigError, ExitCode, RestockError, RunError

if TYPE_CHECKING:
    from restock.cli.pipeline.findings import Part


@dataclass
class CheckCommand:
    """Audit a store, and compare it and a run with earlier ones: exit 1 if a check fails.

    It is `restock audit`, `coverage diff` and `restock eval --baseline` in one, for a team's
    continuous integration: as JUnit XML for its test view, as Markdown for its page. What fails: an
    audit of severity error, recordings or episodes that were lost, a condition in which the run is
    worse than the baseline, and a comparison that is not possible. The command only reads.
    docs/audit.md has a workflow to copy.

    Example: `restock check store/ --against store@41 --run runs/a --baseline nightly`
    """

    store: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="STORE")]
    """The store."""
    against: Annotated[str | None, tyro.conf.arg(metavar="OLD")] = None
    """The earlier store, or an earlier version (store@41): everything it held must still be
    there."""
    run_dir: Annotated[Path | None, tyro.conf.arg(name="run", metavar="RUN")] = None
    """A run that was evaluated (`restock eval`): it is audited, too, and compared with
    --baseline."""
    baseline: Annotated[str | None, tyro.conf.arg(metavar="RUN|NAME")] = None
    """The run must not be worse than this: another run, or a saved baseline's name or file."""
    margin: float = 0.05
    """The run is worse where its success is lower by more than this, with the interval below 0."""
    audits: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """A folder of your own audits (*.sql), as for `restock audit`."""
    thresholds: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A TOML file with thresholds of audits that replace the shipped ones."""
    strict: bool = False
    """Warnings fail, too."""
    junit: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write JUnit XML: one suite each for audits, difference and regression."""
    summary: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Append a Markdown summary to this file, for example $GITHUB_STEP_SUMMARY."""
    json: bool = False
    """Print {"store", "failed", "checks": [{"part", "check", "status", "rows", …}]}."""

    def run(self) -> int:
        """Look at all of it, say what was found, and exit 1 where something fails."""
        from restock.cli import output
        from restock.cli.command_line import refuse
        from restock.cli.pipeline.findings import markdown
        from restock.files import expect_file_place, write_text
        from restock.replay.store.audit import junit_suites

        if self.baseline is not None and self.run_dir is None:
            raise ConfigError(
                "applies only to a run", where="--baseline", remedy="also give --run RUN"
            )
        if self.baseline is None:
            why = "has no effect without --baseline"
            refuse(self, ("margin",), why, remedy="name the run or the saved baseline")
        else:
            from restock.train.evaluation.regression import check_margin

            check_margin(self.margin)
        expect_file_place(self.junit, "--junit", run=self.run_dir)
        expect_file_place(self.summary, "--summary", run=self.run_dir)
        parts = self._parts()
        failing = {"fail", "warn"} if self.strict else {"fail"}
        failed = sum(one.status in failing for part in parts for one in part.findings)
        page = markdown(f"restock check {self.store}", parts, failing=failing)
        if self.junit is not None:
            suites = {f"{part.name} {self.store}": part.findings for part in parts}
            write_text(self.junit, junit_suites(suites, failing))
        if self.summary is not None:
            self.summary.parent.mkdir(parents=True, exist_ok=True)
            with self.summary.open("a", encoding="utf-8") as file:
                file.write(page)
        if self.json:
            output.print_json({"store": self.store, "failed": failed, "checks": _rows(parts)})
        else:
            self._show(parts)
        return int(ExitCode.FAILED if failed else ExitCode.OK)

    def _parts(self) -> list[Part]:
        from restock.cli.pipeline.findings import Part, of_difference, of_regression, refused
        from restock.replay.places import RUN_CONFIG, open_place
        from restock.replay.store.audit import load_audits, load_thresholds, run_audits
        from restock.replay.store.store import Store

        if self.run_dir is not None and not (self.run_dir / RUN_CONFIG).is_file():
            raise RunError("is not a run directory", where=str(self.run_dir))
        audits, thresholds = load_audits(self.audits), load_thresholds(self.thresholds)
        beside = {} if self.run_dir is None else {"run": self.run_dir}
        place = open_place(self.store, beside=beside, only_store=True, opened=Store.verify)
        with place as connection:
            parts = [Part("audit", run_audits(connection, audits, thresholds, beside=beside))]
        if self.against is not None:
            parts.append(Part("diff", self._difference(self.against, of_difference, refused)))
        if self.run_dir is not None and self.baseline is not None:
            from restock.train.evaluation.regression import compare_with_baseline

            try:
                rows = compare_with_baseline(self.run_dir, self.baseline, margin=self.margin)
                found = of_regression(rows, baseline=self.baseline)
            except RestockError as error:
                found = refused("comparable", error, option=f"--baseline {self.baseline}")
            parts.append(Part("regression", found))
        return parts

    def _difference(self, old: str, of_difference: Any, refused: Any) -> Any:
        from restock.ingest.store.version import split_version
        from restock.replay.fleet.store_difference import diff_stores
        from restock.replay.store.store import Store

        path, version = split_version(old)
        try:
            with Store(path, version=version) as first, Store(self.store) as second:
                first.verify()
                return of_difference(diff_stores(first, second).document(), old=old)
        except RestockError as error:
            return refused("comparable", error, option=f"--against {old}")

    def _show(self, parts: list[Part]) -> None:
        from restock.cli import output
        from restock.replay.store.audit import WORST_FIRST

        rows = sorted(_rows(parts), key=lambda row: WORST_FIRST.index(row["status"]))
        shown = [row for row in rows if row["status"] not in ("pass", "skipped")]
        columns = ["part", "check", "status", "rows", "what", "advice"]
        if shown:
            output.print_table(shown, columns)
        counts = {name: sum(row["status"] == name for row in rows) for name in WORST_FIRST}
        reported = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        output.stdout().print(f"{len(rows)} checks: {reported}")


def _rows(parts: list[Part]) -> list[dict[str, Any]]:
    return [
        {
            "part": part.name,
            "check": one.audit.name,
            "status": one.status,
            "rows": one.rows,
            "what": one.audit.doc,
            "advice": one.audit.advice if one.rows else "",
            "sample": one.sample,
        }
        for part in parts
        for one in part.findings
    ]
