"""`restock eval`: success per condition, clean and perturbed, beside the planner and chance."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass
class Eval:
    """Drive a run's kept policy through fixed episodes, beside the scripted planner and chance.

    Every policy meets the same seeded episodes of every condition, clean and under each
    perturbation. Prints success with 95 % Wilson intervals, contacts, time and return, blocked
    aisles apart by partly and wholly, and writes RUN/eval/episodes.parquet.

    Example: `restock eval runs/a --perturbations none,friction,latency`
    """

    run_path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run directory."""
    episodes: int = 20
    """Episodes per kind (nominal, wheel_slip, blocked_aisle, near_collision)."""
    perturbations: str = "none,friction,latency"
    """Comma-separated: none, friction, latency, payload, wheels, sensors."""
    policies: str = "agent,planner,random"
    """Comma-separated: agent (the run's best), planner, random, onnx:FILE, run:DIRECTORY."""
    seed: int = 10_000
    """Seed of the first episode; the same seeds for every policy."""
    dry_run: bool = False
    """Check everything and print what would be driven; write nothing."""
    json: bool = False
    """Print the table and the settings as JSON."""

    def run(self) -> int:
        from restock.cli.output import print_json, print_table, progress, say
        from restock.train.eval_run import evaluate, plan_evaluation, settings
        from restock.train.evaluate import summary_rows

        plan = plan_evaluation(
            self.run_path,
            policies=_names(self.policies),
            perturbations=_names(self.perturbations),
            episodes=self.episodes,
            first_seed=self.seed,
        )
        if self.dry_run:
            print_json({**settings(plan), "episodes": plan.total})
            return 0
        with progress("driving", plan.total) as advance:
            results = evaluate(plan, advance)
        rows = summary_rows(results)
        if self.json:
            print_json({**settings(plan), "results": rows})
            return 0
        shown = [
            {
                **{name: row[name] for name in ("perturbation", "condition", "policy", "episodes")},
                "success": f"{row['success']:.2f} [{row['success_low']:.2f}, "
                f"{row['success_high']:.2f}]",
                **{name: row[name] for name in ("bumps_per_episode", "time_s", "return")},
            }
            for row in _by_cell(rows)
        ]
        print_table(shown, title="success [95 % Wilson interval]; time of the successful ones")
        say(f"written to {plan.run.path / 'eval' / 'episodes.parquet'}")
        return 0


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _by_cell(rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """Policies next to each other within a perturbation and condition."""
    cells = list(dict.fromkeys((row["perturbation"], row["condition"]) for row in rows))
    place = {cell: index for index, cell in enumerate(cells)}
    return sorted(rows, key=lambda row: place[row["perturbation"], row["condition"]])
