"""`restock eval`: a run's policy in the twin, against a baseline, or off-policy on logs alone."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

# Options that say what is driven, and what becomes of it.
_DRIVES = (
    *("episodes", "perturbations", "policies", "seed", "layouts", "limiter", "missions"),
    *("baseline", "margin", "check", "save_as_baseline", "drive", "video"),
)


@dataclass
class EvalCommand:
    """Evaluate a run's policy on fixed episodes, beside scripted policies and a random one.

    It is the best by the evaluations in training. If a run was interrupted before it evaluated what
    it learned in the twin, it is the latest. The output names its step.

    Every policy drives the same seeded episodes of every condition for which the floors have room,
    without a perturbation and under each one. Prints success, return, bumps per kilometre, the
    closest approach to people and the time lost against the planner, with 95 % intervals; partly
    and wholly blocked aisles are listed separately. Adds the episodes to RUN/eval/episodes.parquet.

    With --baseline, the policy is compared with another run or a saved baseline on the same
    episodes. With --on-logs nothing is driven: off-policy evaluation on logged episodes that the
    policy did not learn from (docs/eval.md), written to RUN/eval/off_policy.parquet.

    Example: `restock eval runs/a --perturbations none,friction,latency`
    """

    run_path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run directory."""
    episodes: Annotated[str, tyro.conf.arg(metavar="N|KIND=N,...")] = "20"
    """Episodes per kind (nominal, wheel_slip, blocked_aisle, near_collision). Or a number for each
    kind, as nominal=1000,wheel_slip=300: other kinds are not driven."""
    perturbations: str = "none,friction,latency"
    """Comma-separated: none, friction, latency, payload, wheels, sensors, or FILE.toml (for example
    from `restock twin fit`)."""
    policies: str = "agent,planner,random"
    """Comma-separated: agent (the run's own), planner, operator, random, cloned (behaviour cloning
    of the logs' drivers), cloned:DRIVER, onnx:FILE, run:DIRECTORY."""
    seed: int = 10_000
    """Seed of the first episode. All policies drive the same seeds."""
    baseline: str | None = None
    """Compare with this run, a saved baseline, or another one of the --policies (cloned, planner),
    per condition, on the same episodes."""
    margin: float = 0.05
    """With --baseline: the policy is worse where its success is lower by more than this, with the
    interval below 0."""
    check: bool = False
    """With --baseline: exit 1 if a condition is worse or cannot be compared."""
    save_as_baseline: str | None = None
    """Save the evaluation as baselines/NAME.parquet (or as the .parquet file given)."""
    drive: bool = True
    """Drive nothing: use (or just show) the episodes in RUN/eval/episodes.parquet."""
    video: bool = False
    """For each condition, film the agent's worst failure and an episode in which it succeeded and
    another policy failed, from above, into RUN/eval/films. The episodes are driven again. `restock
    report` shows the films."""
    on_logs: str | None = None
    """Off-policy evaluation on the episodes of this store, or on the held-out episodes of this
    panel. "own": the run's own panel."""
    epsilon: float = 0.1
    """With --on-logs: the probability that the evaluated policy takes a random action; otherwise it
    is greedy."""
    horizon: int | None = None
    """With --on-logs: the number of steps over which importance weights are multiplied. Default:
    all."""
    layouts: str | None = None
    """Floors to drive on, e.g. generated:test. Default: the run's own floors; for a run trained on
    generated:train, the test floors."""
    limiter: Annotated[str | None, tyro.conf.arg(metavar="profile|FILE.toml")] = None
    """Also drive each policy with a limiter after it, as limited:NAME. The limiter is the profile's
    [limiter], or that of a file (docs/deploy.md)."""
    missions: str = "drawn"
    """drawn: missions drawn from the seeds. logged: start and goal of the logged episodes that the
    run's panel holds out, on the floor of the logs. logged:all: of all logged episodes."""
    dry_run: bool = False
    """Check everything and print what would be driven; write nothing."""
    json: bool = False
    """Print the table and the settings as JSON."""

    def run(self) -> int:
        from restock.cli.command_line import refuse

        if self.on_logs is not None:
            why = "cannot be combined with --on-logs, which drives nothing"
            refuse(self, _DRIVES, why, remedy="leave out one of them")
            return self._evaluate_off_policy(self.on_logs)
        refuse(
            self, ("epsilon", "horizon"), "applies only to --on-logs", remedy="give --on-logs, too"
        )
        return self._drive()

    def _drive(self) -> int:
        from restock.cli.command_line import refuse
        from restock.cli.output import print_json, progress, say
        from restock.errors import ExitCode
        from restock.train.evaluation.eval_run import (
            clones_driven,
            drive_evaluation,
            plan_evaluation,
            read_recorded,
            settings,
        )
        from restock.train.evaluation.regression import (
            check_margin,
            read_baseline,
            read_run_evaluation,
            regressed,
            regression,
        )
        from restock.train.evaluation.regression import save_baseline as save
        from restock.train.run.measures import summary_rows

        if self.baseline is None:
            refuse(
                self,
                ("check", "margin"),
                "has no effect without --baseline",
                remedy="name the run or the saved baseline to compare with",
            )
        if not self.drive:
            names = ("episodes", "perturbations", "seed", "limiter")
            refuse(self, names, "has no effect with --no-drive", remedy="leave out one of them")
        check_margin(self.margin)
        beside = self.baseline if self.baseline in _names(self.policies) else None
        baseline = None
        if self.baseline is not None and beside is None:
            baseline = read_baseline(self.baseline)
        plan = plan_evaluation(
            self.run_path,
            policies=_names(self.policies),
            perturbations=_names(self.perturbations),
            episodes=self.episodes,
            first_seed=self.seed,
            layouts=self.layouts,
            missions=self.missions,
            limiter=self.limiter,
        )
        if self.dry_run:
            print_json({**settings(plan), "episodes": plan.total})
            return 0
        document: dict[str, Any] = {}
        if self.drive:
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
        elif self.baseline is None and self.save_as_baseline is None and not self.video:
            shown, text = read_recorded(self.run_path)
            document = {"results": summary_rows(shown), "recorded": text}
        if self.video:
            from restock.train.evaluation.film import film_evaluation

            with progress("filming", None) as advance:
                films, missing = film_evaluation(plan, advance)
            document |= {"films": [str(path) for path in films], "not_filmed": missing}
        compared = None
        if beside is not None:
            baseline = read_run_evaluation(self.run_path, beside)
        if baseline is not None:
            compared = regression(baseline, read_run_evaluation(self.run_path), margin=self.margin)
            document |= {"baseline": baseline.name, "margin": self.margin, "regression": compared}
        if self.save_as_baseline is not None:
            document["saved"] = str(save(self.run_path, self.save_as_baseline))
        if self.json:
            print_json(document)
        else:
            self._show(document)
        failed = self.check and compared is not None and regressed(compared)
        return int(ExitCode.FAILED if failed else ExitCode.OK)

    def _show(self, document: dict[str, Any]) -> None:
        from restock.cli.learning.eval_tables import show_measures, show_regression
        from restock.cli.output import say
        from restock.words import policy_words

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
        if "regression" in document:
            show_regression(document["regression"], document["baseline"], self.margin)
        if "saved" in document:
            say(f"baseline saved as {document['saved']}")

    def _evaluate_off_policy(self, logs: str) -> int:
        from restock.cli.learning.eval_tables import show_off_policy
        from restock.cli.output import print_json, progress, say
        from restock.errors import ConfigError
        from restock.train.evaluation.ope import OpeConfig, evaluate_planned, plan_off_policy
        from restock.words import counted

        try:
            config = OpeConfig(epsilon=self.epsilon, horizon=self.horizon)
        except ValueError as error:
            raise ConfigError(str(error), where="restock eval") from error
        plan = plan_off_policy(self.run_path, None if logs == "own" else logs, config)
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
            result = evaluate_planned(plan, advance)
        show_off_policy(self.run_path, result, config, as_json=self.json)
        return 0


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]
