"""`restock train`: methods x seeds, ending in one comparison."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from restock.errors import ExitCode, RestockError


class StudyInterrupted(RestockError):
    """Ctrl-C; what has finished is kept."""

    exit_code = ExitCode.INTERRUPTED


@contextmanager
def _continued_by_the_same_command(out: Path) -> Iterator[None]:
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
    continues an interrupted study. Ends with OUT/study.md, study.json and a page, study.html.
    --power prints beforehand which effects this number of seeds can detect. See docs/compare.md.

    A file with [space] instead of arms is a search for settings with Optuna (`restock[tune]`). The
    best trial is the one with the highest success in its worst condition. It also writes
    OUT/best.toml.

    Example: `restock train mixtures.toml --out studies/mixtures --workers 2`
    """

    study: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="STUDY.toml")]
    """The study."""
    out: Path | None = None
    """The folder for panels, runs and logs. Required, except with --power."""
    workers: int = 1
    """How many runs to train at the same time, each in its own process."""
    engine: Literal["processes", "ray"] = "processes"
    """Where the runs are trained. `ray`: on the Ray cluster at RAY_ADDRESS, or on a local one;
    needs `restock[ray]`."""
    power: bool = False
    """Print the power for the primary contrast and the least detectable effect, and run nothing.
    The spread is taken from finished runs in --out, else from the study's `power`."""
    dry_run: bool = False
    """Check the study and print what would be run; write nothing."""
    json: bool = False
    """Print the result as JSON."""

    def run(self) -> int:
        from json import dumps

        from restock.cli.output import plain, print_json, print_table, say
        from restock.errors import ConfigError
        from restock.files import expect_place, write_text
        from restock.report import write_study_page
        from restock.toml import read_toml
        from restock.train.study.findings import findings, power_of, too_small
        from restock.train.study.page import as_markdown, power_sentence
        from restock.train.study.study import StudyPlan, check_jobs, load_study
        from restock.train.study.study_run import check_mixtures, run_study

        if self.workers < 1:
            raise ConfigError(f"must be at least 1, got {self.workers}", where="--workers")
        if self.out is None and not self.power:
            raise ConfigError(
                "is required: the study's panels, runs and page are written there",
                where="--out",
                remedy="give a directory, or --power",
            )
        if self.out is not None:
            expect_place(self.out / "runs", ConfigError)
        if "space" in read_toml(self.study):
            return self._search()
        out = self.out if self.out is not None else self.study.parent
        plan = StudyPlan(load_study(self.study), self.study.parent, out)
        power = power_of(plan)
        if self.power:
            if power is None:
                raise ConfigError(
                    "names no primary contrast"
                    if plan.study.primary is None
                    else "does not give the spread between seeds, and no seeds are finished",
                    where=str(self.study),
                    remedy="give `primary` and `power = { sd = …, effect = … }`: docs/compare.md",
                )
            document = power.as_json()
            print_json(document) if self.json else sys.stdout.write(power_sentence(document) + "\n")
            return 0
        if small := too_small(plan, power):
            say(small)
        if self.dry_run:
            check_jobs(plan)
            to_pack = [
                str(job.arm.mixture)
                for job in plan.jobs
                if job.arm.mixture is not None
                and not job.done.exists()
                and (packed := plan.panel(job.arm)) is not None
                and not packed.exists()
            ]
            check_mixtures(plan.study.store, to_pack, plan.folder)
            against = {
                pair.arm.name: f"{pair.baseline.name} ({pair.treatment})"
                for pair in plan.study.pairs
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
        with _continued_by_the_same_command(out):
            comparisons = run_study(plan, workers=self.workers, engine=self.engine, say=say)
        document = findings(plan, comparisons)
        page = as_markdown(document)
        write_text(out / "study.md", page)
        write_text(out / "study.json", dumps(plain(document), indent=1) + "\n")
        say(f"wrote {write_study_page(plain(document), out / 'study.html', self.study.stem)}")
        if self.json:
            print_json(document)
        else:
            sys.stdout.write(page)
        refused = any(one["verdict"] != "comparable" for one in document["comparisons"])
        return int(ExitCode.FAILED if refused else ExitCode.OK)

    def _search(self) -> int:
        from json import dumps

        from msgspec import to_builtins

        from restock.cli.output import plain, print_json, print_table, say
        from restock.errors import ConfigError
        from restock.files import write_text
        from restock.train.study.space import MIXTURE, load_search, settings_of
        from restock.train.study.study_run import check_mixtures
        from restock.train.study.tuning import SearchPlan, require_optuna, run_search, search_page

        search = load_search(self.study)
        if self.out is None or self.power or self.workers != 1 or self.engine != "processes":
            raise ConfigError(
                "a search needs --out and cannot be combined with --power, --workers or --engine: "
                "its trials run one after another",
                where=str(self.study),
                remedy="`restock train SEARCH.toml --out DIR`",
            )
        if self.dry_run:
            chosen = search.parameters.get(MIXTURE)
            mixtures = (search.mixture,) if chosen is None else chosen.choices
            named = [str(one) for one in mixtures if one is not None]
            check_mixtures(search.store, named, self.study.parent)
            fixed = " ".join(settings_of(search, {}))
            rows = [{"key": name, **to_builtins(one)} for name, one in search.parameters.items()]
            if self.json:
                print_json({"trials": search.trials, "settings": fixed, "space": rows})
            else:
                print_table(
                    rows,
                    title=f"{search.trials} trials of this space; settings of all trials: {fixed}",
                )
            return 0
        require_optuna()
        with _continued_by_the_same_command(self.out):
            found = run_search(SearchPlan(search, self.study.parent, self.out), say=say)
        page = search_page(found)
        write_text(self.out / "study.md", page)
        write_text(self.out / "study.json", dumps(plain(found), indent=1) + "\n")
        if self.json:
            print_json(found)
        else:
            sys.stdout.write(page)
        return 0
