"""`restock gate`: tests whether a policy is shown not to be worse than what drives today."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from restock.cli.output import names_in, print_json, print_sections, progress, say
from restock.cli.words import Option, Positional, Repeated
from restock.errors import ConfigError, ExitCode


@dataclass
class GateCommand:
    """Show that a run's policy is not worse than what drives today, in every condition.

    Both drive the same missions in the twin, until every condition is decided or the budget ends.
    The policy passes if it is shown in every condition to be worse by less than the margin. A
    policy that is worse by the margin in any of them passes with a probability of at most 5 %.

    Exits with 0 if it is shown not to be worse, with 1 if that is not shown or it is shown to be
    worse, and with 2 if a verdict would mean nothing. Writes RUN/gate: gate.json, gate.html and the
    episodes. `restock audit STORE RUN --baseline NAME --junit FILE` has its cells for pipelines.

    Example: `restock gate runs/a --baseline planner --margins success=0.05,bumps_per_km=1`
    """

    run_path: Annotated[Path, Positional("RUN")]
    """The run directory."""
    baseline: Annotated[str, Option("planner|RUN|FILE.onnx")]
    """What drives today: planner, operator, random, cloned, another run, or an exported policy."""
    margins: Annotated[str, Option("NAME=X,...")] = "success=0.05"
    """By how much the policy may be worse, for each measure to test: success (a share),
    bumps_per_km, closest_person_m, stopped_s (with --limiter) and time_lost_s."""
    conditions: str = ""
    """Comma-separated kinds of missions. Default: those that the run was trained on."""
    perturbations: str = "none"
    """Comma-separated: none, friction, latency, payload, wheels, sensors, or FILE.toml. Each is
    judged by itself."""
    layouts: Annotated[tuple[str, ...], Repeated()] = ()
    """Floors to drive on, e.g. generated:test. May be given several times: each is judged by
    itself. Default: the run's own floors."""
    limiter: Annotated[str | None, Option("profile|FILE.toml")] = None
    """Drive both with a limiter after them: the profile's, or that of a file (docs/deploy.md)."""
    budget: int = 1000
    """Pairs of episodes of each condition, at most."""
    seed: int = 1_000_000
    """Seed of the first mission."""
    json: bool = False
    """Print the document as JSON: claim, evidence and limits."""

    def run(self) -> int:
        from restock.report import gate_page, write_page
        from restock.train.judge.gate import FOLDER, drive_gate, plan_gate
        from restock.train.judge.sequential import NOT_WORSE

        plan = plan_gate(
            self.run_path,
            self.baseline,
            margins=_parse_margins(self.margins),
            conditions=names_in(self.conditions),
            perturbations=names_in(self.perturbations),
            layouts=self.layouts,
            limiter=self.limiter,
            budget=self.budget,
            first_seed=self.seed,
        )
        with progress("driving", None) as advance:
            document = drive_gate(plan, lambda text: advance(note=text))
        content = gate_page(document)
        page = write_page(content, self.run_path / FOLDER / "gate.html")
        if self.json:
            print_json(document)
        else:
            sys.stdout.write(f"{document['claim']}\n")
            print_sections(content["sections"])
            say(f"wrote {page}")
        passed = document["verdict"] == NOT_WORSE
        return int(ExitCode.OK if passed else ExitCode.FAILED)


def _parse_margins(text: str) -> dict[str, float]:
    """Parse margins such as `success=0.05,bumps_per_km=1`.

    Raises:
        ConfigError: a part is not NAME=NUMBER.
    """
    found = {}
    for part in names_in(text):
        name, _, value = part.partition("=")
        try:
            found[name.strip()] = float(value)
        except ValueError:
            raise ConfigError(
                f"{part!r} is not NAME=NUMBER", where="--margins", remedy="write success=0.05"
            ) from None
    return found
