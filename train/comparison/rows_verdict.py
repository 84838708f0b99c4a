"""A run's diagnosis together with that of the rows that it was fed.

What is wrong with all of a run's rows alike shows in none of its figures, and the rows themselves,
held against the twin (`restock.train.diagnosis`), do not show what is wrong with its target. So a
verdict on a run takes both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from restock.errors import RestockError
from restock.train.comparison.diagnose import Diagnosis
from restock.train.comparison.windows import Cause
from restock.train.diagnosis.before_training import RowDiagnosis, diagnose_before_training
from restock.train.run.run import Run
from restock.train.run.run_profile import profile_of_run, run_panel
from restock.train.twin.physics.perturbation import Schedule, find_perturbation

_TOGETHER: dict[Cause, Cause] = {  # of a run, where its rows are at fault too
    "HEALTHY": "BUFFER",
    "ACTION_COVERAGE": "BUFFER",
    "UNDETERMINED": "BUFFER",
    "TARGET": "BOTH",
}


def rows_of(runs: Sequence[Run]) -> tuple[RowDiagnosis | None, str]:
    """The diagnosis of the panel that the runs were fed, or None and why there is none."""
    fed = {run.document["panel"]["path"]: run for run in runs if run.document.get("panel")}
    if len(fed) != 1:
        return None, "the runs were fed several panels" if fed else "there is no panel"
    ((path, run),) = fed.items()
    env = run.document["config"].get("env", {})
    try:
        run_panel(run.document)
        given = find_perturbation(env.get("perturbation", "nominal"), where="env.perturbation")
        twin = given.base if isinstance(given, Schedule) else given
        profile = profile_of_run(run)
        found = diagnose_before_training(
            Path(path), profile=profile, perturbation=twin, run=run.path
        )
        return found, ""
    except RestockError as error:  # a run may be read where its panel is not
        return None, f"{path}: {error.what}"


def with_rows(diagnosis: Diagnosis, rows: RowDiagnosis) -> Diagnosis:
    """The verdict on a run and on its rows together; rows that are not at fault change nothing."""
    if not rows.findings:
        return diagnosis
    cause = _TOGETHER.get(diagnosis.cause, diagnosis.cause)
    experiment = diagnosis.experiment
    if cause in ("BUFFER", "BOTH"):
        experiment = f"first correct the rows ({rows.findings[0].remedy}), mix and train again"
    said = []
    if cause != diagnosis.cause:
        whose = "the run's own figures" if len(diagnosis.runs) == 1 else "the runs' own figures"
        said = [f"{diagnosis.cause} by {whose}, {cause} with the rows that were fed:"]
    said += [f"rows: {one.cause}: {one.text}" for one in rows.findings]
    if rows.untrusted:
        said.append(f"rows: the twin is far from these logs in {', '.join(rows.untrusted)}")
    return replace(
        diagnosis, cause=cause, evidence=[*diagnosis.evidence, *said], experiment=experiment
    )


__all__ = ["rows_of", "with_rows"]
