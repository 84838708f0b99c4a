"""The facts of a report: rows behind every figure, read from run, panel and store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import duckdb

from restock.errors import RestockError, RunError
from restock.files import read_table
from restock.replay.panel.panel import Panel
from restock.replay.store.store import Store
from restock.report.look.blocks import Rows, fetch_rows, statements, words
from restock.train.run.kept_evaluations import (
    CloneQuality,
    read_clones,
    shown_evaluation,
    summary_rows,
    trained_step,
)
from restock.train.run.replay_audit import fed_shares
from restock.train.run.run import PolicyOrigin, Run, kept_policy, run_clocks
from restock.train.run.run_profile import run_panel
from restock.train.twin.calibration.twin_gap import TwinGap, gap_folder, read_gap
from restock.train.twin.floors.floors import open_floors
from restock.train.twin.floors.layout import DEFAULT, Warehouse

PACKAGE = "restock.report.run"
NO_GOAL = "The task has no goal: success is not defined."
_TABLES = (  # tables of a run that run.sql reads
    *("strata", "conditions", "ages", "policies", "practice"),
    *("evaluations", "probe", "progress"),
)


@dataclass
class Facts:
    """The facts that a run's page shows. Lists are empty if the run has not got that far yet."""

    run: Path
    config: dict[str, Any]
    # Results of `run.sql`, by the names of its statements.
    sampled: Rows
    conditions: Rows
    ages: Rows
    policies: Rows
    practice: Rows
    learning: Rows
    td: Rows
    lag: Rows
    loss: Rows
    failures: Rows
    clocks: dict[str, Any]  # environment steps, updates and seconds of training
    cells: Rows  # measures of `restock eval` per policy, perturbation and condition
    evaluation: str  # a sentence: which of the driven episodes are shown
    policy: PolicyOrigin | None  # the policy that the run would drive with now
    driven_step: int | None  # training step of the policy in `cells`
    clones: list[CloneQuality]  # clones of the logs' drivers
    fed: Rows  # shares of all rows fed, per stratum
    off_policy: Rows  # off-policy estimates, over all conditions
    teacher: Rows  # what the teacher's filter did in the last logging interval
    panel: Panel | None = None
    floors: Sequence[Warehouse] = ()  # the floors that the run drives on
    logged: Rows = field(default_factory=list)  # share of logged episodes per condition
    gap: TwinGap | None = None  # between the twin and the logs
    missing: list[str] = field(default_factory=list)  # notes on what could not be read, and why

    @property
    def target_rule(self) -> str:
        """Describe how the target network follows the online one."""
        rule = self.config.get("config", {}).get("target", {})
        if rule.get("rule") == "polyak":
            return f"Polyak τ {rule['tau']:g}"
        return f"hard, every {rule['every']:,}" if rule.get("rule") == "hard" else "?"

    @property
    def twin(self) -> bool:
        """Return whether the run had a twin to drive in."""
        return _has_twin(self.config)

    @property
    def no_goal(self) -> bool:
        """Return whether the task has no goal, so that success is not defined."""
        return bool(self.cells) and all(row["success"] is None for row in self.cells)

    def clean_cells(self, policy: str = "agent") -> Rows:
        """Return the cells of a policy that are without a perturbation."""
        return [
            row for row in self.cells if (row["policy"], row["perturbation"]) == (policy, "none")
        ]


def gather(path: Path) -> Facts:
    """Read the facts of a run, its panel, its panel's store and its gap.

    Raises:
        RunError: there is no run at `path`, or it has logged no update yet.
    """
    run = Run.open(path)
    evaluated, shown = shown_evaluation(path)
    with duckdb.connect() as connection:
        connection.register("evaluated", evaluated)
        for name in _TABLES:
            connection.register(name, run.table(name))
        rows = {
            name: fetch_rows(connection, sql)
            for name, sql in statements(PACKAGE, "run.sql").items()
        }
    if not rows["loss"]:
        raise RunError(
            "has no update to report on yet",
            where=str(path),
            remedy="let it train past its first logging interval",
        )
    (clocks,) = rows.pop("clocks")
    latest = run_clocks(run)  # may be later than the last logged interval
    twin, taught = _has_twin(run.document), run.table("teacher").to_pylist()
    facts = Facts(
        run=path,
        config=run.document,
        clocks={name: max(value, latest.get(name, value)) for name, value in clocks.items()},
        cells=summary_rows(evaluated.to_pylist()),
        evaluation=shown,
        policy=kept_policy(run),
        driven_step=trained_step(evaluated),
        clones=read_clones(path),
        fed=fed_shares(run),
        off_policy=_off_policy(run, twin),
        teacher=[row for row in taught if _clocks(row) == _clocks(taught[-1])],
        **rows,  # type: ignore[arg-type]
    )
    if absent := run.absent:
        facts.missing.append(f"Missing tables, taken as empty: {', '.join(absent)}.")
    if not facts.cells and twin:
        facts.missing.append("`restock eval` has not been run: success is from training only.")
    _add_panel(facts)
    facts.floors = _floors(facts)
    facts.gap = _find_gap(facts)
    return facts


def _has_twin(document: dict[str, Any]) -> bool:
    return bool(document.get("config", {}).get("env", {}).get("twin", True))


def _find_gap(facts: Facts) -> TwinGap | None:
    """Read the gap of a run from RUN/gap, or from the gap folder of its panel's store."""
    places = [facts.run]
    if facts.panel is not None and "://" not in str(facts.panel.header.store):
        places.append(Path(facts.panel.header.store))
    try:
        return None if (folder := gap_folder(places)) is None else read_gap(folder)
    except RestockError as error:
        facts.missing.append(f"Not shown, since it could not be read: {error}")
        return None


def _off_policy(run: Run, twin: bool) -> Rows:
    """Return off-policy estimates on held-out logs, over all conditions.

    The run's table `off_policy` estimates the policy that the logs gave, before it drove in the
    twin. Without a twin, estimates of the kept policy by `restock eval` are preferred.
    """
    kept = run.path / "eval" / "off_policy.parquet"
    table = run.table("off_policy") if twin or not kept.is_file() else read_table(kept)
    return [row for row in table.to_pylist() if row["condition"] == "all"]


def _clocks(row: dict[str, Any]) -> tuple[int, int]:
    return row["env_steps"], row["gradient_steps"]


def _add_panel(facts: Facts) -> None:
    panel = facts.config.get("panel")
    where = panel.get("path") if isinstance(panel, dict) else panel
    if not where:
        facts.missing.append("The run had no panel: it learned from fresh experience alone.")
        return
    try:
        facts.panel = held = (
            run_panel(facts.config) if isinstance(panel, dict) else Panel.open(where)
        )
        assert held is not None
        with Store(held.header.store) as store:
            query = statements(PACKAGE, "store.sql")["logged"]
            facts.logged = fetch_rows(store.connection, query)
    except RestockError as error:
        facts.missing.append(f"Not shown, since it could not be read: {error}")


def _floors(facts: Facts) -> tuple[Warehouse, ...]:
    """Return the run's floors; empty if it has none, or if they cannot be read."""
    layouts = facts.config.get("config", {}).get("env", {}).get("layouts", DEFAULT)
    if not facts.twin and layouts == DEFAULT:  # the logs are not from the default floor
        return ()
    try:
        return open_floors(layouts)
    except RestockError as error:
        facts.missing.append(f"The floor is not drawn, since it could not be read: {error}")
        return ()


def mean_success(cells: Rows) -> float:
    """Average success over conditions; a partly and a wholly blocked aisle count half each.

    A study's `rare` and the choice of a run's kept policy use the same average.
    """
    by_condition = _by_condition(cells)
    return sum(by_condition.values()) / len(by_condition)


def _by_condition(cells: Rows) -> dict[str, float]:
    """Average success by condition, over the condition's cells."""
    found: dict[str, list[float]] = {}
    for row in cells:
        found.setdefault(row["condition"].split(" (")[0], []).append(row["success"])
    return {name: sum(values) / len(values) for name, values in found.items()}


def evaluation_bias(facts: Facts) -> str:
    """Name the imbalance most likely to make the evaluation look too good."""
    cells = facts.clean_cells()
    if facts.no_goal:
        return NO_GOAL
    if not cells or not facts.logged:
        return ""
    success = _by_condition(cells)
    evaluated = 1 / len(success)
    logged = {row["condition"]: row["share"] for row in facts.logged if row["condition"] in success}
    total = sum(logged.values())
    if not total:
        return ""
    logged = {name: logged.get(name, 0.0) / total for name in success}
    as_evaluated = mean_success(cells)
    as_logged = sum(logged[name] * success[name] for name in success)
    worst = max(success, key=lambda n: (evaluated - logged[n]) * (success[n] - as_logged))
    gain = (evaluated - logged[worst]) * (success[worst] - as_logged)
    more = evaluated > logged[worst]
    text = (
        "Evaluation against deployment: weighted by the conditions of the logs' episodes, success"
        f" would be {as_logged:.0%} instead of {as_evaluated:.0%}, the mean over conditions."
    )
    if gain <= 0.0005:
        return text + " No condition's share biases the evaluation upward."
    return text + (
        f" The largest bias comes from {words(worst)}: {evaluated:.0%} of the mean, "
        f"{logged[worst]:.0%} of the logs' episodes, and {'easier' if more else 'harder'} than "
        f"average ({success[worst]:.0%}); it contributes {gain * 100:+.1f} points."
    )
