"""Actions that the policy wants and the logs lack: by condition, from the run's table `actions`.

A condition can be in every batch, and an action in none of its logged rows: then nothing that was
logged says what the action leads to there, and the critic's value of it is a guess until the policy
has tried it itself. Where fresh rows have it, driving supplies it; a policy from the logs alone has
no such help, so which logs should be recorded is said all the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files

from restock.stats import wilson
from restock.train.run.run import Run


@dataclass(frozen=True)
class ActionSymptom:
    """One action in one condition, over the last windows."""

    condition: str
    action: str  # its name
    wanted_share: float  # of the condition's fresh rows looked at, where the policy would take it
    wanted_low: float  # lower end of its 95 % interval
    audited_rows: int  # that were looked at
    logs_share: float  # of the condition's logged rows drawn
    logged_rows: int  # different ones with the action
    condition_rows: int  # different ones of the condition
    fresh_share: float | None  # of the condition's fresh rows drawn

    @property
    def reason(self) -> str:
        """For people."""
        supplied = "" if self.fresh_share is None else f", fresh rows in {self.fresh_share:.0%}"
        return (
            f"the policy takes {self.action!r} in {self.wanted_share:.0%} of the rows looked at (at"
            f" least {self.wanted_low:.0%}), logged batches have it in {self.logs_share:.1%}:"
            f" {self.logged_rows} of {self.condition_rows} different rows{supplied}"
        )


def action_symptoms(run: Run, since: int) -> list[ActionSymptom]:
    """Every action in every condition of the logs, in batches after gradient step `since`.

    Empty for a run without logs, of another library, or of a Restock that kept no such table.
    """
    import duckdb

    query = files("restock.train.comparison").joinpath("action_coverage.sql").read_text("utf-8")
    with duckdb.connect() as connection:
        connection.register("run_actions", run.table("actions"))
        rows = connection.sql(query, params={"since": since}).to_arrow_table().to_pylist()
    symptoms = []
    for row in rows:
        wanted, audited = row.pop("wanted"), row.pop("audited")
        if not audited:
            continue
        low, _ = wilson(wanted, audited)
        symptoms.append(
            ActionSymptom(
                wanted_share=wanted / audited, wanted_low=low, audited_rows=audited, **row
            )
        )
    return symptoms


__all__ = ["ActionSymptom", "action_symptoms"]
