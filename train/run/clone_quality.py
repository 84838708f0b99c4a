"""How good the clones of the logs' drivers are that evaluations drove: `eval/clones.parquet`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import pyarrow as pa

from restock.errors import RunError
from restock.files import read_table, write_table
from restock.train.run.run_tables import EVAL_CLONES
from restock.words import counted

FILE = Path("eval") / "clones.parquet"  # in a run


@dataclass(frozen=True)
class CloneQuality:
    """How good a clone is: a row of `RUN/eval/clones.parquet`, whose columns say what each is."""

    policy: str
    drivers: list[str]
    rows: int
    episodes: int
    updates: int
    training_log_likelihood: float
    held_out_rows: int
    log_likelihood: float | None
    frequencies_log_likelihood: float | None
    agreement: float | None
    repeating: float | None
    changed_agreement: float | None
    note: str | None

    @property
    def poor(self) -> str | None:
        """Why it is no good stand-in for the drivers; None where nothing says so."""
        if self.log_likelihood is None or self.agreement is None:
            return "the quality of the clone is not known: no row of its drivers is held out"
        if self.log_likelihood <= (self.frequencies_log_likelihood or 0.0):
            return (
                "a poor clone: held-out actions are not more likely under it than under the "
                "frequency of each action"
            )
        if self.agreement <= (self.repeating or 0.0):
            return "a poor clone: repeating the last action agrees as often with held-out rows"
        return None

    @property
    def text(self) -> str:
        """What a reader must know of it, in a sentence or two."""
        said = (
            f"{self.policy} is behaviour cloning of {', '.join(self.drivers) or 'unnamed drivers'}"
            f" ({counted(self.rows, 'row')} of"
            f" {counted(self.episodes, 'episode')})"
        )
        if self.agreement is not None:
            said += (
                f"; in {self.held_out_rows:,} held-out rows it finds the drivers' action likeliest"
                f" in {self.agreement:.0%} (repeating the last one: {self.repeating:.0%}"
            )
            if self.changed_agreement is not None:
                said += f"; where they changed it: {self.changed_agreement:.0%}"
            said += ")"
        return ". ".join(part for part in (said, self.poor, self.note) if part)


def read_clones(run: Path) -> list[CloneQuality]:
    """One a policy. Raises RunError where the file is damaged."""
    if not (run / FILE).is_file():
        return []
    table = read_table(run / FILE, EVAL_CLONES, error=RunError, remedy="remove it")
    return [CloneQuality(**row) for row in table.to_pylist()]


def keep_clone(run: Path, quality: CloneQuality) -> None:
    """Put one beside the others; one of its name is replaced."""
    others = [row for row in read_clones(run) if row.policy != quality.policy]
    rows = [asdict(row) for row in (*others, quality)]
    write_table(pa.Table.from_pylist(rows, schema=EVAL_CLONES), run / FILE)


__all__ = ["CloneQuality", "keep_clone", "read_clones"]
