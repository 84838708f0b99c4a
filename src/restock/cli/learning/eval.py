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
    """Drive a run's kept policy through fixed episodes, beside the scripted and a random policy.

    Every policy drives the same seeded episodes of every condition that its floors have room for,
    clean and under each perturbation. Prints success, return, bumps a kilometre, the closest
    approach to people and the time lost against the planner, with 95 % intervals, with partly and
    wholly blocked aisles apart, and adds to RUN/eval/episodes.parquet.

    With --baseline it is compared with another run or a saved baseline on the same episodes.
    With --on-logs nothing drives: off-policy evaluation on logged episodes that it did not
    learn from (docs/off-policy.md), into RUN/eval/off_policy.parquet.

    Example: `restock eval runs/a --perturbations none,friction,latency`
    """

    run_path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run directory."""
    episodes: Annotated[str, tyro.conf.arg(metavar="N|KIND=N,...")] = "20"
    """Episodes per kind (nominal, wheel_slip, blocked_aisle, near_collision); or by kind, as
    nominal=1000,wheel_slip=300: kinds that are not named are not driven."""
    perturbations: str = "none,friction,latency"
    """Comma-separated: none, friction, latency, payload, wheels, sensors, or FILE.toml (as
    `restock twin fit` writes it)."""
    policies: str = "agent,planner,random"
    """Comma-separated: agent (the run's best), planner, operator, random, cloned (the way the logs
    were driven, by behaviour cloning), cloned:DRIVER, onnx:FILE, run:DIRECTORY."""
    seed: int = 10_000
    """Seed of the first episode; the same seeds for every policy."""
    baseline: str | None = None
    """Compare with this run, a saved baseline, or another of the --policies (cloned, planner), on
    the same episodes, per condition."""
    margin: float = 0.05
    """With --baseline: a success lower by more than this, with the interval below 0, is worse."""
    check: bool = False
    """With --baseline: exit 1 where a condition is worse, or cannot be compared."""
    save_as_baseline: str | None = None
    """Keep the evaluation as baselines/NAME.parquet (or in the .parquet file that is named)."""
    drive: bool = True
    """Drive nothing: use the episodes in RUN/eval/episodes.parquet."""
    video: bool = False
    """Film the agent's worst failure and a rescue of each condition, from above, into
    RUN/eval/films: episodes of the evaluation, driven again. `restock report` shows them."""
    on_logs: str | None = None
    """Off-policy evaluation on a store's episodes, or on those that a panel holds out. "own": its
    own panel."""
    epsilon: float = 0.1
    """With --on-logs: probability of a random action of the evaluated policy, else greedy."""
    horizon: int | None = None
    """With --on-logs: how many steps importance weights reach; default all."""
    layouts: str | None = None
    """Floors to drive on, e.g. generated:test (default: the run's own; where it trained on
    generated:train, the test floors)."""
    limiter: Annotated[str | None, tyro.conf.arg(metavar="profile|FILE.toml")] = None
    """Drive each policy once more with the limiter in front of it, as limited:NAME: by the
    profile's [limiter], or a file's (docs/deploy.md)."""
    missions: str = "drawn"
    """drawn: by their seeds, on the floor. logged: start and goal of the logged episodes that the
    run's panel holds out, on the floor of the logs; logged:all: of those trained on too."""
    dry_run: bool = False
    """Check everything and print what would be driven; write nothing."""
    json: bool = False
    """Print the table and the settings as JSON."""

    def run(self) -> int:
        from restock.cli.command_line import refuse

        if self.on_logs is not None:
            why = "does not go with --on-logs: nothing drives"
            refuse(self, _DRIVES, why, remedy="leave one of them out")
            return self._evaluate_off_policy(self.on_logs)
        refuse(self, ("epsilon", "horizon"), "is of --on-logs", remedy="give that too")
        return self._drive()

    def _drive(self) -> int:
        from restock.cli.output import print_json, progress, say
        from restock.errors import ConfigError, ExitCode
        from restock.train.evaluation.eval_run import clones_driven, drive_evaluation
        from restock.train.evaluation.evaluation_plan import plan_evaluation, settings
        from restock.train.evaluation.regression import of_baseline, of_run, regressed, regression
        from restock.train.evaluation.regression import save_baseline as save
        from restock.train.run.measures import summary_rows

        if self.check and self.baseline is None:
            raise ConfigError(
                "says nothing without --baseline",
                where="--check",
                remedy="name the run or the saved baseline to compare with",
            )
        beside = self.baseline if self.baseline in _names(self.policies) else None
        baseline = None
        if self.baseline is not None and beside is None:
            baseline = of_baseline(self.baseline)
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
                say(f"left out: {kind}, no room for it on {', '.join(floors)}")
            with progress("driving", plan.total) as advance:
                rows = summary_rows(drive_evaluation(plan, advance))
            clones = [{**asdict(one), "text": one.text} for one in clones_driven(plan)]
            document = {**settings(plan), "results": rows, "clones": clones}
        if self.video:
            from restock.train.evaluation.film import film_evaluation

            with progress("filming", None) as advance:
                films, missing = film_evaluation(plan, advance)
            document |= {"films": [str(path) for path in films], "not_filmed": missing}
        compared = None
        if beside is not None:
            baseline = of_run(self.run_path, beside)
        if baseline is not None:
            compared = regression(baseline, of_run(self.run_path), margin=self.margin)
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

        if (rows := document.get("results")) is not None:
            show_measures(rows)
            for clone in document["clones"]:
                say(clone["text"])
            say(f"added to {self.run_path / 'eval' / 'episodes.parquet'}")
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
        from restock.cli.output import progress
        from restock.errors import ConfigError
        from restock.train.evaluation.ope import OpeConfig, evaluate_run_off_policy

        try:
            config = OpeConfig(epsilon=self.epsilon, horizon=self.horizon)
        except ValueError as error:
            raise ConfigError(str(error), where="restock eval") from error
        named = None if logs == "own" else logs
        with progress("off-policy evaluation", 2) as advance:
            result = evaluate_run_off_policy(
                self.run_path, named, config, advance, write=not self.dry_run
            )
        show_off_policy(self.run_path, result, config, as_json=self.json)
        return 0


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]
