"""`restock train STUDY.toml`: trains every arm of a study with every seed, and compares them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from restock.cli.output import plain, print_json, print_table, say
from restock.cli.words import Positional
from restock.errors import ConfigError, ExitCode, RestockError

if TYPE_CHECKING:
    from restock.train.study.study import StudyPlan


class StudyInterrupted(RestockError):
    """Raised after Ctrl-C; finished runs are kept."""

    exit_code = ExitCode.INTERRUPTED


@contextmanager
def _explain_interrupt(out: Path) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt as stop:
        raise StudyInterrupted(
            "interrupted; finished runs are kept, and those under way continue from their"
            " checkpoints",
            where=str(out),
            remedy="continue with the same command",
        ) from stop


@dataclass
class StudyCommand:
    """Train and evaluate every arm of a study with every seed, then compare them.

    The study is a TOML file with a store, arms (a mixture or a panel, and settings), seeds and the
    treatment. Each run is a directory under OUT/runs. Finished runs are kept, so the same command
    continues an interrupted study. Ends with OUT/study.md, study.json and a page, study.html. See
    docs/compare.md.

    Example: `restock train mixtures.toml --out studies/mixtures --workers 2`
    """

    study: Annotated[Path, Positional("STUDY.toml")]
    """The study."""
    out: Path
    """The folder for panels, runs and logs."""
    workers: int = 1
    """How many runs to train at the same time, each in its own process."""
    dry_run: bool = False
    """Check the study and print what would be run; write nothing."""
    json: bool = False
    """Print the result as JSON."""

    def run(self) -> int:
        from restock.files import expect_place, write_text
        from restock.report import study_page, write_page
        from restock.train.study.study import StudyPlan, load_study
        from restock.train.study.study_run import findings, run_study

        if self.workers < 1:
            raise ConfigError(f"must be at least 1, got {self.workers}", where="--workers")
        expect_place(self.out / "runs", ConfigError)
        plan = StudyPlan(load_study(self.study), self.study.parent, self.out)
        if self.dry_run:
            return self._show(plan)
        with _explain_interrupt(self.out):
            comparisons = run_study(plan, workers=self.workers, say=say)
        found = plain(findings(plan, comparisons))
        write_text(self.out / "study.json", dumps(found, indent=1) + "\n")
        content = study_page(found, self.study.stem)
        page = write_page(content, self.out / "study.html", markdown=True)
        say(f"wrote {page}")
        if self.json:
            print_json(found)
        else:
            sys.stdout.write(page.with_suffix(".md").read_text(encoding="utf-8"))
        refused = any(one["verdict"] != "comparable" for one in found["comparisons"])
        return int(ExitCode.FAILED if refused else ExitCode.OK)

    def _show(self, plan: StudyPlan) -> int:
        """Check the study, and print the runs that it would train."""
        from restock.train.study.study import check_jobs
        from restock.train.study.study_run import check_mixtures

        check_jobs(plan)
        check_mixtures(plan)
        against = {
            pair.arm.name: f"{pair.baseline.name} ({pair.treatment})" for pair in plan.study.pairs
        }
        rows = [
            {
                "run": str(job.path),
                "against": against.get(job.arm.name),
                "panel": str(plan.panel(job.arm) or "none"),
                "settings": " ".join(plan.settings(job.arm, job.seed)),
                "done": job.done.exists(),
            }
            for job in plan.jobs
        ]
        if self.json:
            print_json(rows)
        else:
            print_table(rows, title="what would be run")
        return 0
