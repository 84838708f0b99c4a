"""`restock diagnose`: tell failures of the feed from failures of the target."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from restock.cli.output import print_json, print_parted, print_text, say
from restock.cli.words import Positional, refuse
from restock.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from restock.train.judge.before_training import RowDiagnosis
    from restock.train.judge.diagnose import Diagnosis


@dataclass
class DiagnoseCommand:
    """Find out why a critic fails: because of the buffer, or because of the target.

    For each condition, it compares replay with the steps of the periodic evaluations, which are
    never replayed: TD error, frequency and rows. It also compares the online network with the
    target network. The verdict is HEALTHY, BUFFER, TARGET, BOTH, DIVERGENCE or UNDETERMINED, with
    the evidence and an experiment that would confirm it. The figures are from the last three
    evaluations; most of the runs must agree. Faulty rows in the panel change HEALTHY to BUFFER.

    For a panel or a store, before training, it compares the rows of each robot and recording with
    fresh rows from the twin and with the task's definitions. Do the actions explain the motion? Do
    rewards and episode ends follow the task? Do the rows follow from one another? Do goals come
    nearer, and are the racks where the twin has them? This finds systematic errors that no figure
    of a run shows, and prints the rows that are the evidence.

    Example: `restock diagnose runs/a runs/a-seed1 runs/a-seed2`
    """

    places: Annotated[tuple[Path, ...], Positional("RUN|PANEL|STORE")]
    """Runs of one method (seeds); or one panel or store, whose rows are diagnosed, and the floors
    that the twin drives on, as for env.layouts (FLOOR.toml, map.yaml, generated:train)."""
    profile: str | None = None
    """For a panel or store: the profile with which the rows were ingested. Default: the one stored
    with them."""
    perturbation: Path | None = None
    """For a panel or store: a perturbation that calibrates the twin, e.g. written by `restock twin
    fit`."""
    twin: bool = True
    """Do not compare rows with the twin, which takes some seconds. The rows of a run's panel are
    then not diagnosed; rows of a panel or store are checked only against the task's definitions."""
    check: bool = False
    """Exit 1 unless the verdict is HEALTHY."""
    confirm: Path | None = None
    """Run the experiment that would confirm the verdict, in this new run directory."""
    json: bool = False
    """Print the verdict, the evidence and every window as JSON."""

    def run(self) -> int:
        from restock.replay.places import kind_beside
        from restock.train.judge.diagnose import check_place, confirm, diagnose, rows_of, with_rows
        from restock.train.run.run import Run

        if not self.places:
            raise ConfigError("needs a run, a panel or a store", where="restock diagnose")
        first, *others = self.places
        if not any(kind_beside(one) == "run" for one in self.places):
            return self._before_training(first, ",".join(map(str, others)))
        refuse(
            self,
            ("profile", "perturbation"),
            "applies only to a panel or a store",
            remedy="leave it out",
        )
        runs = [Run.open(path) for path in self.places]
        if self.confirm is not None:
            check_place(self.confirm)
        own = diagnosis = diagnose(runs)
        found, reason = rows_of(runs) if self.twin else (None, "")
        if found is not None:
            diagnosis = with_rows(own, found)
        if not self.json:
            _show(diagnosis, self.places)
            if found is None and self.twin:
                say(f"the rows of its panel were not compared with the twin: {reason}")
        confirmation = None
        # `own` is the verdict without the checks of rows, which a further run cannot confirm.
        if self.confirm is not None:
            confirmation = confirm(
                runs[0],
                own,
                self.confirm,
                rows_at_fault=found is not None and bool(found.findings),
            )
        if self.json:
            of_rows = None if found is None else asdict(found)
            document = _document(diagnosis, self.places)
            print_json(document | {"rows": of_rows, "confirmation": confirmation})
        elif confirmation is not None:
            _show_confirmation(confirmation)
        failed = self.check and diagnosis.cause != "HEALTHY"
        return int(ExitCode.FAILED if failed else ExitCode.OK)

    def _before_training(self, path: Path, layouts: str) -> int:
        from restock.ingest.profile.profile import load_profile
        from restock.train.judge.before_training import diagnose_before_training
        from restock.train.twin.floors.layout import DEFAULT
        from restock.train.twin.physics.perturbation import load_perturbation

        refuse(self, ("confirm",), "applies only to a run", remedy="leave it out")
        diagnosis = diagnose_before_training(
            path,
            profile=None if self.profile is None else load_profile(self.profile),
            twin=self.twin,
            layouts=layouts or DEFAULT,
            perturbation=None
            if self.perturbation is None
            else load_perturbation(self.perturbation),
        )
        if self.json:
            print_json(asdict(diagnosis))
        else:
            _show_rows(diagnosis)
        failed = self.check and diagnosis.verdict != "HEALTHY"
        return int(ExitCode.FAILED if failed else ExitCode.OK)


def _show(diagnosis: Diagnosis, paths: tuple[Path, ...]) -> None:
    several = len(paths) > 1  # a single run's verdict is printed below, not in the table
    print_parted(
        [
            {
                **({"run": str(path)} if several else {}),
                "condition": symptom.condition,
                **({"verdict": cause} if several else {}),
                "share of\nreplay": symptom.replay_share,
                "supply": symptom.supply,
                "agreement": symptom.agreement,
                "unexplained": symptom.unexplained,
                "G": symptom.gap,
                "G /\nmedian": figures.relative(symptom),
            }
            for path, cause, figures in zip(paths, diagnosis.runs, diagnosis.figures, strict=True)
            for symptom in figures.symptoms
        ],
        key=("run", "condition") if several else ("condition",),
        title="supply: share in replay / share met while driving; agreement: share of logged rows "
        "that look like it; unexplained: variance of their next observations; "
        "G: |TD| held out / in replay",
    )
    print_text(f"{diagnosis.cause}")
    for line in diagnosis.evidence:
        print_text(f"  {line}")
    to = "to decide" if diagnosis.cause == "UNDETERMINED" else "to confirm"
    print_text(f"{to}: {diagnosis.experiment}")


def _show_rows(diagnosis: RowDiagnosis) -> None:
    named = {check for one in diagnosis.findings for check in one.evidence}
    chosen = [
        row
        for row in diagnosis.comparisons
        if row.check in named or row.status in ("off", "undecided")
    ]
    if chosen:
        print_parted(
            [
                {
                    "check": row.check,
                    "status": row.status,
                    "logs": row.logs,
                    "twin": row.twin,
                    "effect": row.effect,
                    "low": row.low,
                    "high": row.high,
                    "allowed": _range(row.least, row.most),
                    "rows": row.logs_rows,
                    "of": row.measure,
                }
                for row in chosen
            ],
            key=("check",),
            title="findings beyond their limit, with 95 % intervals over episodes",
        )
    about = diagnosis.about
    compared = f"{about['rows']:,} rows of {about['episodes']:,} episodes"
    against = (
        f" against {about['twin_rows']:,} fresh rows of the twin" if about["twin_rows"] else ""
    )
    made = sum(row.status != "not run" for row in diagnosis.comparisons)
    print_text(f"{diagnosis.verdict}: {compared}{against}, {made} comparisons")
    for one in diagnosis.findings:
        print_text(f"  {one.cause}: {one.text}")
        print_text(f"    {one.remedy}")
    by_reason: dict[str, list[str]] = {}
    for row in diagnosis.not_run:
        by_reason.setdefault(row.note, []).append(row.check)
    for reason, checks in by_reason.items():
        print_text(f"  not run: {', '.join(checks)}: {reason}")


def _range(least: float | None, most: float | None) -> str:
    if least is None:
        return "" if most is None else f"at most {most:.3g}"
    return f"at least {least:.3g}" if most is None else f"{least:.3g} to {most:.3g}"


def _show_confirmation(confirmation: dict[str, Any]) -> None:
    answer = {True: "CONFIRMED", False: "REFUTED", None: "NOT DECIDED"}[confirmation["confirmed"]]
    changed = ", ".join(confirmation["changed"])
    print_text(f"{answer}: with {changed} it is {confirmation['cause']} ({confirmation['run']})")


def _document(diagnosis: Diagnosis, paths: tuple[Path, ...]) -> dict[str, Any]:
    return {
        "cause": diagnosis.cause,
        "evidence": diagnosis.evidence,
        "experiment": diagnosis.experiment,
        "runs": [
            {
                "run": str(path),
                "cause": cause,
                "figures": asdict(figures),
                "windows": [asdict(window) for window in windows],
            }
            for path, cause, figures, windows in zip(
                paths, diagnosis.runs, diagnosis.figures, diagnosis.windows, strict=True
            )
        ],
    }
