"""Turn a run's evaluations into windows: figures of its critic, rows and target, and their limits.

A window is one evaluation with the batches since the evaluation before. Its figures, of one
condition k or of all:

    G_k  |TD| held out / |TD| in replay, in condition k
    O_k  |TD| held out in k / the median condition's
    L    mean |Q - Q_target| / mean |Q|
    S    |TD| with the online network bootstrapping / |TD| with the target network

If a network generalises, or memorises few rows, none of these shows what is wrong with its replay.
So three figures describe the rows and not the critic (`restock.train.feed.logs`): a condition's
share of replay over its share of driving, how many of its logged rows look like fresh rows of it,
and whether their next observations follow from them.

The limits were found with faults planted in the twin (benchmarks/planted_faults.py; the table is in
docs/run.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from statistics import median
from typing import Any, Literal

import duckdb
import numpy as np

from restock.errors import RunError
from restock.train.run.run import Run

Cause = Literal["HEALTHY", "BUFFER", "TARGET", "BOTH", "DIVERGENCE", "UNDETERMINED"]
_MIN_ROWS = 20  # held-out rows that a condition needs to be diagnosed
_MIN_TD_ROWS = 100  # held-out rows that its TD errors need, as they vary by factors in few episodes


@dataclass(frozen=True)
class DiagnosisLimits:
    """Limits beyond which a figure is a symptom."""

    gap: float = 3.0  # G_k of a condition; O_k if the condition is not in replay
    relative: float = 3.0  # G_k over the median G; `gap` must be exceeded, too
    gap_everywhere: float = 6.0  # the median G: everything is worse held out
    lag: float = 0.25  # L: the target is far behind
    no_lag: float = 0.002  # L below this: there is effectively no target network
    clock: float = 2.0  # S: the networks disagree
    returns: float = 3.0  # |Q| over an episode's largest |return|, in which rewards may cancel
    explained: float = 0.2  # share of the targets' variance; a critic below it has learnt nothing
    supply: float = 0.1  # least ratio of a condition's share of replay to its share of driving
    agreement: float = 0.1  # least share of a condition's logged rows that look like fresh ones
    unexplained: float = 1.0  # share of next observations' variance; at 1 their mean does as well
    unexplained_relative: float = 1.6  # ratio to the best condition's; `unexplained` applies, too


LIMITS = DiagnosisLimits()


@dataclass(frozen=True)
class Symptom:
    """Figures of one condition in one window, or their medians over several."""

    condition: str
    gap: float | None  # G_k; None: not in replay, or too few rows
    outlier: float | None  # O_k; None: too few rows
    replay_share: float
    met_share: float | None  # share of the steps driven in evaluations
    agreement: float | None  # share of its logged rows that look like fresh ones
    unexplained: float | None  # share of the variance of next observations in its logged rows

    @property
    def supply(self) -> float | None:
        """Return the condition's share of replay divided by its share of driving."""
        return self.replay_share / self.met_share if self.met_share else None


@dataclass(frozen=True)
class Window:
    """The figures of one evaluation, or their medians over several."""

    gradient_steps: int
    symptoms: list[Symptom]
    gap_median: float
    lag: float  # L
    clock: float  # S
    explained: float | None  # share of the targets' variance, in the median condition
    q_abs_max: float
    q_bound: float  # the largest |Q| that the observed rewards and returns allow

    def relative(self, symptom: Symptom) -> float | None:
        """Return G_k divided by the median G; None without G_k."""
        return symptom.gap / max(self.gap_median, 1e-12) if symptom.gap is not None else None

    def bad(self) -> dict[str, list[str]]:
        """Return the conditions whose replay is in doubt, with the reasons in words."""
        follows = [s.unexplained for s in self.symptoms if s.unexplained is not None]
        least = min(follows, default=0.0)
        doubts = {}
        for symptom in self.symptoms:
            reasons = [*self._supply_reasons(symptom), *self._row_reasons(symptom, least)]
            relative = self.relative(symptom)
            if relative is not None and symptom.gap is not None:
                if symptom.gap >= LIMITS.gap and relative >= LIMITS.relative:
                    reasons.append(
                        f"held-out |TD| is {symptom.gap:.1f} times that in replay,"
                        f" {relative:.1f} times the median condition's gap"
                    )
            elif not symptom.replay_share and (symptom.outlier or 0.0) >= LIMITS.gap:
                reasons.append(
                    f"held-out |TD| is {symptom.outlier:.1f} times the median condition's, and "
                    "the condition is not in replay"
                )
            if reasons:
                doubts[symptom.condition] = reasons
        return doubts

    def _supply_reasons(self, symptom: Symptom) -> list[str]:
        if symptom.supply is None:
            return [] if symptom.replay_share else ["is not in replay"]
        if symptom.supply >= LIMITS.supply:
            return []
        share, observed = symptom.replay_share, symptom.met_share
        return [f"is {share:.2%} of replay and {observed:.1%} of the steps when driving"]

    def _row_reasons(self, symptom: Symptom, least: float) -> list[str]:
        reasons = []
        if symptom.agreement is not None and symptom.agreement < LIMITS.agreement:
            reasons.append(
                f"{symptom.agreement:.0%} of its logged rows look like it: check the label"
            )
        rest = symptom.unexplained
        if (
            rest is not None
            and rest >= LIMITS.unexplained
            and rest >= LIMITS.unexplained_relative * least
        ):
            reasons.append(
                f"its logged rows leave {rest:.0%} of the variance of their next observations "
                f"unexplained (another condition: {least:.0%}): check that observations, actions "
                "and next observations match"
            )
        return reasons

    def target(self) -> list[str]:
        """Return in words which figures put the target in doubt; a NaN in L does, too."""
        reasons = []
        if self.lag < LIMITS.no_lag:
            reasons.append(
                f"L is {self.lag:.2g} (at least {LIMITS.no_lag:g} is expected): there is no target"
                " network to speak of"
            )
        elif not self.lag < LIMITS.lag:
            reasons.append(f"L is {self.lag:.3g} (limit {LIMITS.lag:g}): the target is far behind")
        if self.clock >= LIMITS.clock:
            reasons.append(f"S is {self.clock:.3g} (limit {LIMITS.clock:g}): the networks disagree")
        if self.gap_median >= LIMITS.gap_everywhere:
            reasons.append(
                f"the median G is {self.gap_median:.3g} (limit {LIMITS.gap_everywhere:g}):"
                " everything is worse held out"
            )
        return reasons

    def diverged(self) -> bool:
        """Return whether values exceed what rewards allow, or hardly explain their targets."""
        if not np.isfinite(self.q_abs_max) or self.q_abs_max > self.q_bound:
            return True
        # With a frozen target, Q may explain little, too; then the target is at fault.
        if self.explained is None or self.target():
            return False
        return self.explained < LIMITS.explained

    def cause(self) -> Cause:
        """Return the cause that these figures show."""
        if self.diverged():
            return "DIVERGENCE"
        bad = self.bad()
        buffer = 0 < len(bad) <= len(self.symptoms) / 2
        if self.target():
            return "BOTH" if buffer else "TARGET"
        if buffer:
            return "BUFFER"
        return "UNDETERMINED" if bad else "HEALTHY"


def median_window(windows: Sequence[Window]) -> Window:
    """Return each known figure's median over windows; updates and |Q| are the last window's."""

    def middle(name: str, of: Sequence[Any] = windows) -> Any:
        known = [value for item in of if (value := getattr(item, name)) is not None]
        return median(known) if known else None

    conditions = dict.fromkeys(s.condition for window in windows for s in window.symptoms)
    symptoms = []
    for condition in conditions:
        same = [s for window in windows for s in window.symptoms if s.condition == condition]
        names = [name for name in Symptom.__dataclass_fields__ if name != "condition"]
        symptoms.append(Symptom(condition, **{name: middle(name, same) for name in names}))
    gaps = [symptom.gap for symptom in symptoms if symptom.gap is not None]
    return Window(
        gradient_steps=windows[-1].gradient_steps,
        symptoms=symptoms,
        gap_median=median(gaps) if gaps else 1.0,
        lag=middle("lag"),
        clock=middle("clock"),
        explained=middle("explained"),
        q_abs_max=windows[-1].q_abs_max,
        q_bound=windows[-1].q_bound,
    )


def windows_of(run: Run) -> list[Window]:
    """Return the windows of a run: one per evaluation with audited batches before it."""
    query = files("restock.train.judge").joinpath("diagnose.sql").read_text(encoding="utf-8")
    with duckdb.connect() as connection:
        for name in ("evaluation_buffer", "conditions", "progress"):
            connection.register(f"run_{name}", run.table(name))
        rows = connection.sql(query).to_arrow_table().to_pylist()
    rows = [row for row in rows if row["q_abs_max"] is not None]  # None: no batch was audited yet
    if not rows:
        remedy = "continue the run past its first evaluation (evaluation.every_env_steps)"
        if not run.document["config"].get("env", {}).get("twin", True):
            remedy = (
                "it learned from the logs alone, without evaluations: use `restock eval "
                f"{run.path} --on-logs own`"
            )
        raise RunError("has no evaluation to diagnose", where=str(run.path), remedy=remedy)
    bound = _value_bound(run)
    steps = sorted({row["gradient_steps"] for row in rows})
    return [_window([row for row in rows if row["gradient_steps"] == at], bound) for at in steps]


def _window(rows: list[dict[str, Any]], bound: float) -> Window:
    known_well = [row for row in rows if row["evaluation_rows"] >= _MIN_ROWS] or rows
    judged = [row for row in known_well if row["evaluation_rows"] >= _MIN_TD_ROWS]
    middle = median(row["evaluation_td"] for row in judged or known_well)
    symptoms = [
        Symptom(
            row["condition"],
            row["evaluation_td"] / row["replay_td"] if row in judged and row["replay_td"] else None,
            row["evaluation_td"] / max(middle, 1e-12) if row in judged else None,
            row["replay_share"] or 0.0,
            row["met_share"],
            row["agreement"],
            row["unexplained"],
        )
        for row in known_well
    ]
    gaps = [symptom.gap for symptom in symptoms if symptom.gap is not None]
    weight = sum(row["evaluation_rows"] for row in known_well)
    # Clipped at 0: if robots stand, targets hardly vary and the share can be very negative.
    reported = [row["explained"] for row in judged or known_well if row["explained"] is not None]
    known = [max(share, 0.0) for share in reported]

    def mean(name: str) -> float:
        return float(sum(row[name] * row["evaluation_rows"] for row in known_well) / weight)

    return Window(
        gradient_steps=rows[0]["gradient_steps"],
        symptoms=symptoms,
        gap_median=median(gaps) if gaps else 1.0,
        lag=max(rows[0]["lag"] or 0.0, mean("evaluation_lag")),
        clock=mean("evaluation_td_online") / max(mean("evaluation_td"), 1e-12),
        explained=median(known) if known else None,
        q_abs_max=rows[0]["q_abs_max"],
        q_bound=bound,
    )


def _value_bound(run: Run) -> float:
    """Return the largest |Q| that the observed rewards and returns allow.

    By rewards, it is r_max / (1 - gamma) with the largest |reward| of the audited batches. By
    returns, it is `LIMITS.returns` times the largest |return| of an episode; if episodes are
    shorter than 1 / (1 - gamma) steps, the return is extrapolated to this length.
    """
    rewards = run.table("audit")["reward"].to_numpy()
    largest = float(np.abs(rewards).max(initial=0.0)) if len(rewards) else 0.0
    known = (run.document.get("panel") or {}) | run.document["config"].get("loss", {})
    discount = known["discount"]
    bound = largest / (1 - discount) if largest > 0 else float("inf")
    driven = run.table("episodes").select(["return", "steps"]).drop_null()
    if not len(driven):
        return bound
    returned = float(np.abs(driven["return"].to_numpy()).max())
    goes_on = 1 / (1 - discount) / float(driven["steps"].to_numpy().max())
    return float(min(bound, LIMITS.returns * returned * max(goes_on, 1.0)))
