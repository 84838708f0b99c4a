"""`restock diagnose`: is it what the critic was fed, or the target it follows?"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    from restock.train.comparison.diagnose import Diagnosis


@dataclass
class DiagnoseCommand:
    """Tell a failure of the buffer from a failure of the target.

    Compares replay with the periodic evaluations' own steps, which no replay has, condition by
    condition: the critic's TD error, its frequency, its rows; and the online network with the
    target network; and what the policy wants with what the logs have of each action. The verdict is
    HEALTHY, BUFFER, ACTION_COVERAGE, TARGET, BOTH, DIVERGENCE or UNDETERMINED, with the evidence
    and the experiment that would confirm it. Figures are of the last three
    evaluations; most of the runs must agree.

    Example: `restock diagnose runs/a runs/a-seed1 runs/a-seed2`
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Runs of one method (seeds)."""
    confirm: Path | None = None
    """Run the experiment that would confirm it, into this new run directory."""
    json: bool = False
    """Print the verdict, the evidence and every window as JSON."""

    def run(self) -> int:
        from restock.cli.output import print_json
        from restock.errors import ConfigError
        from restock.train.comparison.confirm import confirm
        from restock.train.comparison.diagnose import diagnose
        from restock.train.run.run import Run

        if not self.runs:
            raise ConfigError("needs a run", where="restock diagnose")
        runs = [Run.open(path) for path in self.runs]
        diagnosis = diagnose(runs)
        if not self.json:
            _show(diagnosis, self.runs)
        confirmation = (
            confirm(runs[0], diagnosis, self.confirm) if self.confirm is not None else None
        )
        if self.json:
            print_json(_document(diagnosis, self.runs) | {"confirmation": confirmation})
        elif confirmation is not None:
            _show_confirmation(confirmation)
        return 0


def _show(diagnosis: Diagnosis, paths: tuple[Path, ...]) -> None:
    from restock.cli.output import print_table, stdout

    print_table(
        [
            {
                "run": str(path),
                "verdict": cause,
                "condition": symptom.condition,
                "share of replay": symptom.replay_share,
                "supply": symptom.supply,
                "agreement": symptom.agreement,
                "unexplained": symptom.unexplained,
                "G": symptom.gap,
                "G / median": figures.relative(symptom),
            }
            for path, cause, figures in zip(paths, diagnosis.runs, diagnosis.figures, strict=True)
            for symptom in figures.symptoms
        ],
        title="supply: share of replay / of what driving meets; agreement: logged rows that look"
        " like it; unexplained: of their next observations; G: |TD| held out / in replay",
    )
    out = stdout()
    out.print(f"{diagnosis.cause}")
    for line in diagnosis.evidence:
        out.print(f"  {line}")
    out.print(f"to confirm: {diagnosis.experiment}")


def _show_confirmation(confirmation: dict[str, Any]) -> None:
    from restock.cli.output import stdout

    answer = {True: "CONFIRMED", False: "REFUTED", None: "NOT DECIDED"}[confirmation["confirmed"]]
    changed = ", ".join(confirmation["changed"])
    stdout().print(
        f"{answer}: with {changed} it is {confirmation['cause']} ({confirmation['run']})"
    )


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
