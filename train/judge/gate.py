"""Test in every condition whether a policy is not worse than the baseline that drives today.

Both drive the same missions in the twin, pair by pair, until each cell (a condition, on some
floors, under a perturbation, by one measure) is decided or the budget ends. The policy passes if
*every* cell shows that it is worse by less than the margin. A policy that is worse by the margin or
more in any cell passes only if that cell errs, so the error of the whole verdict is that of one
cell. The error of calling a cell "worse" is divided by the number of cells.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from restock.errors import ConfigError, RunError, counted, quoted
from restock.files import read_json, write_table, write_text
from restock.process import interrupts_raised
from restock.train.dqn.config import TrainConfig, parse_config
from restock.train.evaluation.eval_run import (
    CLEAN,
    EvaluationPlan,
    Results,
    episodes_table,
    evaluation_env,
    make_policy,
    plan_evaluation,
    run_policy,
)
from restock.train.evaluation.evaluate import EpisodeResult
from restock.train.judge.sequential import (
    NOT_SHOWN,
    NOT_WORSE,
    WORSE,
    ConfidenceSequence,
    pairs_needed,
)
from restock.train.run.kept_evaluations import cell_name
from restock.train.run.run import Run, kept_policy, run_clocks
from restock.train.run.run_profile import profile_of_run, run_panel
from restock.train.twin.calibration.twin_gap import TwinGap, gap_folder, read_gap
from restock.train.twin.missions import DEFAULT_CONDITIONS, KINDS, MISSIONS
from restock.train.twin.physics.episode import EpisodeSpec
from restock.train.twin.physics.perturbation import PERTURBATIONS

Document = dict[str, Any]
FOLDER = "gate"  # relative to the run's folder
DOCUMENT, EPISODES = "gate.json", "episodes.parquet"
ERROR = 0.05  # largest probability that the whole verdict is wrong
FIRST_SEED = 1_000_000  # far from the seeds of evaluations
ROUND = 32  # pairs of episodes per kind between two checks of which cells are decided
MAX_MISSIONS = 3  # limit of a kind's missions, in budgets: a kind may have several cells


@dataclass(frozen=True)
class Measure:
    """A measure by which a policy may not be worse.

    `better` returns by how much the policy was better in a pair of episodes (policy, baseline), or
    None if the pair does not show it. The difference is clipped to ±`bound`; `variance` is the
    expected variance of the difference.
    """

    name: str
    unit: str
    bound: float
    variance: float
    better: Callable[[EpisodeResult, EpisodeResult], float | None]


def _less(name: str) -> Callable[[EpisodeResult, EpisodeResult], float | None]:
    """Return a `better` function: the baseline's value of a field less the policy's."""

    def better(policy: EpisodeResult, baseline: EpisodeResult) -> float | None:
        own, other = getattr(policy, name), getattr(baseline, name)
        return None if own is None or other is None else float(other) - float(own)

    return better


def _success(policy: EpisodeResult, baseline: EpisodeResult) -> float | None:
    return float(bool(policy.success)) - float(bool(baseline.success))


def _closest(policy: EpisodeResult, baseline: EpisodeResult) -> float | None:
    if policy.closest_person_m is None or baseline.closest_person_m is None:
        return None
    return min(policy.closest_person_m, 2.0) - min(baseline.closest_person_m, 2.0)


def _time(policy: EpisodeResult, baseline: EpisodeResult) -> float | None:
    return baseline.time_s - policy.time_s if policy.success and baseline.success else None


SUCCESS = "success"
BUMPS = "bumps_per_km"
STOPPED = "stopped_s"
MEASURES = {
    one.name: one
    for one in (  # described in docs/eval.md
        Measure(SUCCESS, "", 1, 0.25, _success),
        Measure(BUMPS, "/km", 10, 0.1, _less("bumps")),
        Measure("closest_person_m", "m", 2, 0.1, _closest),
        Measure(STOPPED, "s", 30, 9, _less("stopped_s")),
        Measure("time_lost_s", "s", 30, 9, _time),
    )
}


@dataclass
class Cell:
    """One condition on some floors under a perturbation, by one measure."""

    layouts: str
    perturbation: str
    condition: str  # with the blocked share of the aisle, if it has one
    measure: Measure
    margin: float  # in the measure's unit
    error_high: float  # largest probability of wrongly calling the policy worse
    scale: float = 1.0  # converts the margin's unit to that of differences between episodes
    pairs: int = 0
    unknown: int = 0  # pairs in which the measure is None

    def __post_init__(self) -> None:
        self.sequence = ConfidenceSequence(
            self.measure.bound,
            -self.margin * self.scale,
            variance=self.measure.variance,
            error_low=ERROR,
            error_high=self.error_high,
        )

    def add(self, pairs: Sequence[tuple[EpisodeResult, EpisodeResult]]) -> None:
        """Add a round of pairs (policy, baseline)."""
        for policy, baseline in pairs:
            self.pairs += 1
            if (better := self.measure.better(policy, baseline)) is None:
                self.unknown += 1
            elif not self.decided:
                bound = self.measure.bound
                self.sequence.add(min(max(better, -bound), bound))

    @property
    def decided(self) -> bool:
        """Return whether the policy is shown to be worse or not worse in this cell."""
        return self.verdict != NOT_SHOWN

    @property
    def name(self) -> str:
        """Return a name for people: the condition, then perturbation and measure unless default."""
        parts = [_words(self.condition)]
        parts += [self.perturbation] * (self.perturbation != CLEAN)
        parts += [_words(self.measure.name)] * (self.measure.name != SUCCESS)
        return ", ".join(parts)

    @property
    def verdict(self) -> str:
        """Return what is shown: "not worse", "worse" or "not shown"."""
        if self.sequence.above_at is not None:
            return NOT_WORSE
        return WORSE if self.sequence.below_at is not None else NOT_SHOWN

    def document(self) -> dict[str, Any]:
        """Return the cell as JSON values: differences and bounds in the measure's unit."""
        of, scale = self.sequence, self.scale
        return {
            "name": self.name,
            "layouts": self.layouts,
            "perturbation": self.perturbation,
            "condition": self.condition,
            "measure": self.measure.name,
            "unit": self.measure.unit,
            "margin": self.margin,
            "pairs": of.pairs,
            "pairs_driven": self.pairs,
            "pairs_unknown": self.unknown,
            "difference": None if of.mean is None else of.mean / scale,
            "low": of.low[-1] / scale if of.low else None,
            "high": of.high[-1] / scale if of.high else None,
            "verdict": self.verdict,
        }


def _km_driven(pairs: Sequence[tuple[EpisodeResult, EpisodeResult]]) -> float:
    """Return the kilometres that the baseline drove in an episode, on average."""
    km = [(baseline.distance_m or 0.0) / 1000 for _, baseline in pairs]
    return max(sum(km) / len(km), 1e-6)


@dataclass(frozen=True)
class GatePlan:
    """A checked request for a gate."""

    plans: tuple[EvaluationPlan, ...]  # one per value of `layouts`
    margins: Mapping[str, float]  # by measure
    budget: int  # largest number of pairs per cell
    gap: TwinGap | None  # gap of the twin to the logs; None if not measured

    @property
    def run(self) -> Run:
        """Return the run whose policy is judged."""
        return self.plans[0].run

    @property
    def baseline(self) -> str:
        """Return the baseline's name in evaluations."""
        return self.plans[0].policies[1]

    @property
    def cells(self) -> int:
        """Return the number of cells."""
        blocks = sum(max(len(MISSIONS[kind].blocks), 1) for kind in self.plans[0].episodes)
        settings = sum(len(plan.perturbations) for plan in self.plans)
        return blocks * settings * len(self.margins)


def plan_gate(
    path: Path,
    baseline: str,
    *,
    margins: Mapping[str, float] | None = None,
    conditions: Sequence[str] = (),
    perturbations: Sequence[str] = (CLEAN,),
    layouts: Sequence[str] = (),
    limiter: str | None = None,
    budget: int = 1000,
    first_seed: int = FIRST_SEED,
) -> GatePlan:
    """Check a request without driving anything.

    Args:
        baseline: planner, operator, random, cloned, a run's folder, or a file.onnx.
        margins: by how much the policy may be worse, by measure; .05 for success unless given.
        conditions: kinds of missions; empty: those that the run was trained on.
        layouts: floors in the form of `env.layouts`, each judged by itself; empty: the run's own.
        budget: largest number of pairs of episodes per cell.

    Raises:
        RunError: the run or a policy is missing, the run was interrupted after its policy was
            saved, or the twin cannot be trusted in a condition.
        ConfigError: no verdict is possible with a margin, condition, budget or seed.
    """
    margins = {SUCCESS: 0.05, **(margins or {})}
    _check_margins(margins, limiter)
    run = Run.open(path)
    config = parse_config(run.document["config"], where=str(path / "config.json"))
    trained = tuple(config.env.conditions or DEFAULT_CONDITIONS)
    kinds = tuple(conditions) or trained
    if untrained := [kind for kind in kinds if kind not in trained]:
        raise ConfigError(
            f"the policy was not trained on {', '.join(untrained)}",
            where="--conditions",
            remedy=f"choose from {', '.join(trained)}",
        )
    _check_budget(budget, margins)
    plans = tuple(
        plan_evaluation(
            path,
            policies=("agent", policy_name(baseline)),
            perturbations=perturbations,
            episodes=dict.fromkeys(kinds, MAX_MISSIONS * budget),
            first_seed=first_seed,
            layouts=one,
            limiter=limiter,
        )
        for one in layouts or (None,)
    )
    plan = GatePlan(plans, margins, budget, find_gap(run))
    _refuse_meaningless(plan, config)
    return plan


def policy_name(baseline: str) -> str:
    """Return a baseline's name in evaluations: "run:" for a folder, "onnx:" for a .onnx file."""
    if Path(baseline).is_dir():
        return f"run:{baseline}"
    return f"onnx:{baseline}" if baseline.endswith(".onnx") and ":" not in baseline else baseline


def find_gap(run: Run) -> TwinGap | None:
    """Read the twin's gap to the logs, of the run or its panel's store; None if not measured."""
    panel = run_panel(run.document)
    places = [run.path]
    if panel is not None and "://" not in str(panel.header.store):
        places.append(Path(panel.header.store))
    folder = gap_folder(places)
    return None if folder is None else read_gap(folder)


def _check_margins(margins: Mapping[str, float], limiter: str | None) -> None:
    for name, margin in margins.items():
        if name not in MEASURES:
            raise ConfigError(
                f"there is no measure {name!r}",
                where="--margins",
                remedy=f"choose from {', '.join(MEASURES)}",
            )
        most = 1.0 if name == SUCCESS else math.inf
        if not 0 < margin <= most or not math.isfinite(margin):
            limits = "above 0, and at most 1" if name == SUCCESS else "above 0"
            raise ConfigError(f"must be {limits}, got {margin:g}", where=f"--margins {name}")
    if STOPPED in margins and limiter is None:
        raise ConfigError(
            "nothing stops the robot without a limiter",
            where=f"--margins {STOPPED}",
            remedy="give --limiter profile, or a file with a [limiter]",
        )


def _check_budget(budget: int, margins: Mapping[str, float]) -> None:
    """Raise ConfigError if the budget is too small even for policies that never differ."""
    needed = max(
        pairs_needed(MEASURES[name].bound, -margin, variance=MEASURES[name].variance)
        for name, margin in margins.items()
        if name != BUMPS  # its margin per episode depends on how far the baseline drives
    )
    if budget < needed:
        raise ConfigError(
            f"{budget:,} pairs of episodes cannot show anything with these margins",
            where="--budget",
            remedy=f"give at least {needed}; policies that differ in some episodes need more",
        )


def _refuse_meaningless(plan: GatePlan, config: TrainConfig) -> None:
    """Raise ConfigError or RunError if a verdict would mean nothing."""
    first, where = plan.plans[0], str(plan.run.path)
    kinds = tuple(first.episodes)
    for one in plan.plans:
        for kind in (kind for kind in kinds if kind in one.left_out):
            raise ConfigError(
                f"{', '.join(one.left_out[kind])} has no room for missions of {kind}",
                where="--conditions",
                remedy="leave it out, or give other floors: without missions, nothing is shown",
            )
    last = first.first_seed + MAX_MISSIONS * plan.budget
    chosen = config.evaluation
    if chosen.seed < last and first.first_seed < chosen.seed + chosen.episodes:
        raise ConfigError(
            f"the policy was selected on missions of the seeds {chosen.seed} to"
            f" {chosen.seed + chosen.episodes - 1}, which are among these",
            where="--seed",
            remedy=f"leave it out: the default is {FIRST_SEED}",
        )
    origin, clocks, schedule = kept_policy(plan.run), run_clocks(plan.run), config.schedule
    steps, seconds = clocks.get("env_steps", 0), clocks.get("wall_s", 0.0)
    unfinished = config.env.twin and steps < schedule.env_steps
    unfinished &= schedule.seconds is None or seconds < schedule.seconds
    if unfinished and origin is not None and origin.env_steps < origin.run_env_steps:
        raise RunError(
            f"was interrupted after {steps:,} of {schedule.env_steps:,} steps, so the gate would"
            f" judge the {origin.text}",
            where=where,
            remedy=f"finish it: `restock train --resume {quoted(where)}`",
        )
    if bad := sorted(set(plan.gap.untrusted) & set(kinds)) if plan.gap is not None else []:
        raise RunError(
            f"the twin cannot be trusted in {', '.join(bad)}: its gap to the logs is too large",
            where=where,
            remedy="fit the twin (`restock twin fit`), or leave these out with --conditions",
        )
    if profile_of_run(plan.run).task.goal == "none":
        raise RunError("its task has no goal, so no success can be compared", where=where)


@interrupts_raised
def drive_gate(plan: GatePlan, progress: Callable[[str], None] = lambda text: None) -> Document:
    """Drive pairs until every cell is decided or has its budget; write and return the document.

    The document is written to RUN/gate/gate.json, the episodes to RUN/gate/episodes.parquet.
    `progress` is called after each round with a text on how many cells are still open.
    """
    cells: dict[tuple[str, ...], Cell] = {}
    tables = [_drive(one, plan, cells, progress) for one in plan.plans]
    document = _document(plan, list(cells.values()))
    folder = plan.run.path / FOLDER
    write_table(pa.concat_tables(tables), folder / EPISODES)
    write_text(folder / DOCUMENT, json.dumps(document, indent=1) + "\n")
    return document


def _drive(
    plan: EvaluationPlan,
    gate: GatePlan,
    cells: dict[tuple[str, ...], Cell],
    progress: Callable[[str], None],
) -> pa.Table:
    """Drive pairs on one set of floors, add them to `cells`, and return the table of episodes."""
    env = evaluation_env(plan)
    env.limits = plan.limits
    drivers = {name: make_policy(name, plan) for name in plan.policies}
    driven: Results = {}
    missions = {(name, kind): 0 for name in plan.perturbations for kind in plan.episodes}
    while open_ := [
        (*of, done) for of, done in missions.items() if _is_open(plan, gate, cells, *of, done)
    ]:
        specs = [
            (name, EpisodeSpec(kind, plan.first_seed + done + n, plan.perturbations[name]))
            for name, kind, done in open_
            for n in range(ROUND)
        ]
        results = [
            run_policy(plan, env, driver, [spec for _, spec in specs])
            for driver in drivers.values()
        ]
        pairs: dict[tuple[str, str], list[tuple[EpisodeResult, EpisodeResult]]] = {}
        for (name, _), policy, baseline in zip(specs, *results, strict=True):
            pairs.setdefault((name, cell_name(policy.condition, policy.block)), []).append(
                (policy, baseline)
            )
            for who, result in zip(drivers, (policy, baseline), strict=True):
                driven.setdefault((who, name), []).append(result)
        for (name, condition), several in pairs.items():
            for measure, margin in gate.margins.items():
                key = plan.layouts, name, condition, measure
                if key not in cells:
                    scale = _km_driven(several) if measure == BUMPS else 1.0
                    error = ERROR / gate.cells
                    cells[key] = Cell(*key[:3], MEASURES[measure], margin, error, scale)
                    if measure == BUMPS:  # these pairs gave the scale, so they must not count
                        continue
                cells[key].add(several)
        for name, kind, _ in open_:
            missions[name, kind] += ROUND
        left = sum(not cell.decided for cell in cells.values())
        progress(f"{left} of {len(cells)} open after {max(missions.values()):,} pairs")
    return episodes_table(driven, plan, {name: one.version for name, one in drivers.items()})


def _is_open(
    plan: EvaluationPlan,
    gate: GatePlan,
    cells: Mapping[tuple[str, ...], Cell],
    perturbation: str,
    kind: str,
    done: int,
) -> bool:
    """Return whether more missions of a kind may still decide one of its cells."""
    if done >= MAX_MISSIONS * gate.budget:
        return False
    own = [
        cell
        for (layouts, name, condition, _), cell in cells.items()
        if (layouts, name) == (plan.layouts, perturbation) and condition.split(" (")[0] == kind
    ]
    return not own or any(not cell.decided and cell.pairs < gate.budget for cell in own)


def _document(plan: GatePlan, cells: Sequence[Cell]) -> Document:
    found = [cell.document() for cell in cells]
    verdicts = {cell["verdict"] for cell in found}
    verdict = WORSE if WORSE in verdicts else NOT_SHOWN if NOT_SHOWN in verdicts else NOT_WORSE
    first, origin = plan.plans[0], kept_policy(plan.run)
    return {
        "verdict": verdict,
        "claim": _claim(plan, found, verdict),
        "run": str(plan.run.path),
        "policy": None if origin is None else origin.document,
        "baseline": plan.baseline,
        "margins": dict(plan.margins),
        "error": ERROR,
        "budget": plan.budget,
        "first_seed": first.first_seed,
        "cells": found,
        "limits": list(_limits(plan, found)),
    }


def _claim(plan: GatePlan, cells: Sequence[Document], verdict: str) -> str:
    """Return a sentence on what was shown."""
    who = f"the policy of {plan.run.path.name} against {plan.baseline}"
    names = {
        word: list(dict.fromkeys(cell["name"] for cell in cells if cell["verdict"] == word))
        for word in (WORSE, NOT_SHOWN)
    }
    if verdict == NOT_WORSE:
        every = counted(len({cell["condition"] for cell in cells}), "condition")
        return f"{who}: shown not to be worse by the margins, in all of {every}"
    parts = [f"{word} in {', '.join(of)}" for word, of in names.items() if of]
    return f"{who}: {'; '.join(parts)}".replace(NOT_SHOWN, "not shown to be no worse")


def _words(name: str) -> str:
    return name.replace("_", " ")


def _limits(plan: GatePlan, cells: Sequence[Document]) -> Iterator[str]:
    """Yield sentences on what the verdict does not cover."""
    first = plan.plans[0]
    yield (
        f"A policy that is worse by a margin or more in any condition passes with a probability of"
        f" at most {ERROR:.0%}, whenever one looks; this holds for missions as the twin draws"
        " them, not for the robot's real missions."
    )
    if plan.gap is None:
        yield (
            "The gap between twin and robot was not measured: `restock twin gap STORE` does that."
        )
    else:
        shown = ", ".join(f"{_words(one.condition)} {one.verdict}" for one in plan.gap.verdicts)
        yield f"Verdicts on the twin's gap to the logs: {shown}."
    if left := [kind for kind in KINDS if kind not in first.episodes]:
        yield f"Conditions that were not tested: {', '.join(map(_words, left))}."
    if left := [name for name in PERTURBATIONS if name not in (*first.perturbations, "nominal")]:
        yield f"Perturbations that were not tested: {', '.join(left)}."
    if left := [name for name in MEASURES if name not in plan.margins]:
        yield f"Measures that were not tested: {', '.join(map(_words, left))}."
    yield f"Floors: {'; '.join(one.layouts for one in plan.plans)}."
    for cell in cells:
        if cell["pairs_unknown"]:
            yield (
                f"{cell['name']}: in {cell['pairs_unknown']:,} of {cell['pairs_driven']:,} pairs"
                " the measure is unknown."
            )


def passed_gate(path: Path, baseline: str) -> Document:
    """Read a run's last gate, whatever its verdict.

    Raises:
        RunError: there was none, it is damaged, or it judged another baseline or another policy
            than the one that the run has now.
    """
    again = f"run `restock gate {quoted(path)} --baseline {quoted(baseline)}`"
    file = path / FOLDER / DOCUMENT
    if not file.is_file():
        raise RunError("was not judged by `restock gate`", where=str(path), remedy=again)
    document = read_json(file)
    if not isinstance(document, dict) or "cells" not in document:
        raise RunError("is not the result of a gate", where=str(file), remedy=again)
    if document["baseline"] != policy_name(baseline):
        raise RunError(
            f"is a gate against {document['baseline']}, not {baseline}",
            where=str(file),
            remedy=again,
        )
    origin = kept_policy(Run.open(path))
    if document["policy"] != (None if origin is None else origin.document):
        raise RunError("judged another policy of the run", where=str(file), remedy=again)
    return document
