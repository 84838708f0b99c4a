"""`restock eval`: evaluates a run's policy in the twin, or off-policy on logs."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from restock.cli.output import (
    names_in,
    print_json,
    print_parted,
    print_table,
    progress,
    reported,
    say,
)
from restock.cli.words import Option, Positional, refuse
from restock.errors import ExitCode, counted, policy_words

if TYPE_CHECKING:
    from restock.train.evaluation.ope import OpePlan

# Options that apply only if episodes are driven.
_DRIVES = ("episodes", "perturbations", "policies", "seed", "layouts", "limiter", "video")


@dataclass
class EvalCommand:
    """Evaluate a run's policy on fixed episodes, beside scripted policies and a random one.

    The policy is the best one in the evaluations during training, or the latest one if the run was
    interrupted before it evaluated what it learned in the twin. The output names its step.

    Every policy drives the same seeded episodes of every condition for which the floors have room,
    without a perturbation and under each one. Prints success, return, bumps per kilometre, the
    closest approach to people and the time lost against the planner, with 95 % intervals; partly
    and wholly blocked aisles are listed separately. Adds the episodes to RUN/eval/episodes.parquet.

    With --on-logs nothing is driven: off-policy evaluation on logged episodes that the policy did
    not learn from (docs/eval.md), written to RUN/eval/off_policy.parquet. `restock gate` decides
    whether the policy may take the place of another.

    Example: `restock eval runs/a --perturbations none,friction,latency`
    """

    run_path: Annotated[Path, Positional("RUN")]
    """The run directory."""
    episodes: Annotated[str, Option("N|KIND=N,...")] = "20"
    """Episodes per kind (nominal, wheel_slip, blocked_aisle, near_collision). Or a number for each
    kind, as nominal=1000,wheel_slip=300: other kinds are not driven. 0: drive nothing, and show the
    newest evaluation in RUN/eval/episodes.parquet."""
    perturbations: str = "none,friction,latency"
    """Comma-separated: none, friction, latency, payload, wheels, sensors, or FILE.toml (for example
    from `restock twin fit`)."""
    policies: str = "agent,planner,random"
    """Comma-separated: agent (the run's own), planner, operator, random, cloned (behaviour cloning
    of the logs' drivers), cloned:DRIVER, onnx:FILE, run:DIRECTORY."""
    seed: int = 10_000
    """Seed of the first episode. All policies drive the same seeds."""
    video: bool = False
    """For each condition, film the agent's worst failure and an episode in which it succeeded and
    another policy failed, from above, into RUN/eval/films. The episodes are driven again. `restock
    report` shows the films."""
    on_logs: str | None = None
    """Off-policy evaluation on the episodes of this store, or on the held-out episodes of this
    panel. "own": the run's own panel."""
    layouts: str | None = None
    """Floors to drive on, e.g. generated:test. Default: the run's own floors; for a run trained on
    generated:train, the test floors."""
    limiter: Annotated[str | None, Option("profile|FILE.toml")] = None
    """Also drive each policy with a limiter after it, as limited:NAME. The limiter is the profile's
    [limiter], or that of a file (docs/deploy.md)."""
    dry_run: bool = False
    """Check everything and print what would be driven; write nothing."""
    json: bool = False
    """Print the table and the settings as JSON."""

    def run(self) -> int:
        if self.on_logs is not None:
            why = "cannot be combined with --on-logs, which drives nothing"
            refuse(self, _DRIVES, why, remedy="leave out one of them")
            return self._evaluate_off_policy(self.on_logs)
        return self._drive()

    def _drive(self) -> int:
        from restock.train.evaluation.eval_run import (
            clones_driven,
            drive_evaluation,
            plan_evaluation,
            read_recorded,
            settings,
        )
        from restock.train.run.kept_evaluations import summary_rows

        drive = self.episodes != "0"
        plan = plan_evaluation(
            self.run_path,
            policies=names_in(self.policies),
            perturbations=names_in(self.perturbations),
            episodes=self.episodes if drive else "20",
            first_seed=self.seed,
            layouts=self.layouts,
            limiter=self.limiter,
        )
        if self.dry_run:
            print_json({**settings(plan), "episodes": plan.total})
            return 0
        document: dict[str, Any] = {}
        if drive:
            for line in plan.warnings:
                say(line)
            for kind, floors in plan.left_out.items():
                some = [f"'{floor}'" for floor in floors]
                if len(some) > 3:
                    some[2:] = [f"{len(some) - 2} others"]
                which = f"floor{'s' if len(some) > 1 else ''} {', '.join(some)}"
                say(f"left out: {kind}, as there is no room for it on the {which}")
            with progress("driving", plan.total) as advance:
                rows = summary_rows(drive_evaluation(plan, advance))
            clones = [{**asdict(one), "text": one.text} for one in clones_driven(plan)]
            document = {**settings(plan), "results": rows, "clones": clones}
        elif not self.video:
            shown, text = read_recorded(self.run_path)
            document = {"results": summary_rows(shown), "recorded": text}
        if self.video:
            from restock.train.evaluation.film import film_evaluation

            with progress("filming", None) as advance:
                films, missing = film_evaluation(plan, advance)
            document |= {"films": [str(path) for path in films], "not_filmed": missing}
        if self.json:
            print_json(document)
        else:
            self._show(document)
        return int(ExitCode.OK)

    def _show(self, document: dict[str, Any]) -> None:
        if (rows := document.get("results")) is not None:
            show_measures(rows)
            trained = document.get("trained", {})
            for name, shown in policy_words(trained).items():
                say(f"{shown}: {trained[name]['text']}")
            for clone in document.get("clones", ()):
                say(clone["text"])
            say(document.get("recorded", f"added to {self.run_path / 'eval' / 'episodes.parquet'}"))
        for path in document.get("films", ()):
            say(f"filmed {path}")
        for why in document.get("not_filmed", ()):
            say(f"not filmed: {why}")

    def _evaluate_off_policy(self, logs: str) -> int:
        from restock.train.evaluation.ope import OpeConfig, evaluate_planned, plan_off_policy

        plan = plan_off_policy(self.run_path, None if logs == "own" else logs, OpeConfig())
        document = plan.document()
        if self.dry_run:
            print_json(document)
            return 0
        say(
            f"off-policy evaluation on {counted(document['episodes'], 'episode')}"
            f" ({document['rows']:,} rows): {plan.updates:,} updates of models fitted on"
            f" {document['fitted_rows']:,} other rows"
        )
        with progress("off-policy evaluation", plan.updates) as advance:
            rows = evaluate_planned(plan, advance)
        if self.json:
            names = ("run", "policy", "trained", "notes")
            print_json({**{name: document[name] for name in names}, "results": rows})
        else:
            show_off_policy(plan, rows)
        return 0


def show_measures(rows: list[dict[str, Any]]) -> None:
    """Print a table for each perturbation: success, return and safety of each policy.

    A table that is too wide is split, so that no measure is left out.
    """
    from restock.train.run.kept_evaluations import measured_row

    names = policy_words(row["policy"] for row in rows)
    for perturbation in dict.fromkeys(row["perturbation"] for row in rows):
        own = [row for row in rows if row["perturbation"] == perturbation]
        cells = list(dict.fromkeys(row["condition"] for row in own))
        own.sort(key=lambda row: cells.index(row["condition"]))
        shown = [
            {"condition": row["condition"], "policy": names[row["policy"]], **measured_row(row)}
            for row in own
        ]
        print_parted(
            shown,
            [name for name in shown[0] if name != "held back" or reported(shown, [name])],
            key=("condition", "policy"),
            title=f"perturbation {perturbation} [95 % over episodes]; time of the successful ones",
        )
    if not any(row["policy"] == "planner" for row in rows) and not any(
        row["time_lost_episodes"] for row in rows
    ):
        say("time lost is not known: add the planner to --policies once")


def show_off_policy(plan: OpePlan, rows: list[dict[str, Any]]) -> None:
    """Print a row per measure and condition, and why an importance-weighted estimate is refused."""
    cells: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        key = row["measure"], row["condition"]
        shown = cells.setdefault(
            key, {"measure": key[0], "condition": key[1], "episodes": row["episodes"]}
        )
        shown[row["estimator"]] = _value(row)
        shown["weights worth"] = f"{row['ess']:.1f} episodes"
    origin = plan.policy.origin
    step = "" if origin is None else f" ({origin.text})"
    print_table(
        list(cells.values()),
        title=f"{plan.policy.version}{step}, greedy with {plan.config.epsilon:.0%} random actions, "
        "off-policy on logs it did not learn from [95 % over episodes]",
    )
    for row in rows:
        if row["condition"] == "all" and row["estimator"] == "pdwis" and row["refused"]:
            longest = f"; {row['ess_steps']} steps would be few enough" if row["ess_steps"] else ""
            say(f"{row['measure']}: pdwis is refused: {row['refused']}{longest}")
    estimated = rows[0]["estimated_share"] if rows else 0.0
    if estimated:
        say(
            f"the behaviour policy's probabilities are estimated (cloned) for {estimated:.0%} of "
            "the rows: the logs do not contain them"
        )
    for note in plan.notes:
        say(note)


def _value(row: dict[str, Any]) -> str:
    from restock.stats import interval_text

    if row["value"] is None:
        return "refused"
    return interval_text(row["value"], row["low"], row["high"])
