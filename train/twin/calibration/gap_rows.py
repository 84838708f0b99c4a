"""A gap as rows: one statistic each, with its interval over episodes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.stats import ConfidenceInterval, clustered_quantiles, clustered_ratio
from restock.train.twin.calibration.logged_steps import LoggedSteps
from restock.train.twin.calibration.one_step import OneStep
from restock.train.twin.calibration.path_gap import QUANTITIES, PathGap

Rows = list[dict[str, Any]]
PERSISTENCE = "persistence"


def path_rows(paths: list[PathGap], rng: np.random.Generator) -> Rows:
    """Median and 90th percentile of every quantity, by condition, horizon and source."""
    found = []
    for path in paths:
        for condition, mask in path.holds.items():
            for source, gaps in path.gaps.items():
                for quantity, values in gaps.items():
                    known = mask & np.isfinite(values)
                    episode = path.episode_id[known]
                    median, p90 = clustered_quantiles(values[known], episode, (0.5, 0.9), rng=rng)
                    found.append(
                        {
                            "condition": condition,
                            "horizon_s": path.horizon_s,
                            "quantity": quantity,
                            "unit": QUANTITIES[quantity],
                            "source": source,
                            "segments": int(known.sum()),
                            "episodes": len(np.unique(episode)),
                            **_spread_out("median", median),
                            **_spread_out("p90", p90),
                        }
                    )
    return found


def observation_rows(
    steps: LoggedSteps,
    stepped: OneStep,
    chosen: Mapping[str, NDArray[np.bool_]],
    rng: np.random.Generator,
) -> Rows:
    """Mean absolute gap of every component that the twin could get wrong."""
    seen = {name: side.observation for name, side in stepped.twins.items()}
    seen |= {PERSISTENCE: stepped.now}
    found = []
    for column, component in enumerate(steps.task.observation_names):
        if component.startswith("previous_action_"):  # the action that was applied
            continue
        if component.startswith(("clearance_", "closing_")) and not stepped.lidar:
            continue
        if component.startswith(("near_", "far_", "goal_")) and steps.task.goal != "route":
            continue
        for condition, mask in chosen.items():
            rows = mask & stepped.valid
            episode = steps.episode_id[stepped.rows[rows]]
            for source, values in seen.items():
                off = np.abs(values[rows, column] - stepped.logged.observation[rows, column])
                mean = clustered_ratio(off, np.ones(len(off)), episode, rng=rng)
                found.append(
                    {
                        "condition": condition,
                        "component": component,
                        "source": source,
                        "steps": int(rows.sum()),
                        **_spread_out("mean_gap", mean),
                    }
                )
    return found


def reward_rows(
    steps: LoggedSteps,
    stepped: OneStep,
    chosen: Mapping[str, NDArray[np.bool_]],
    rng: np.random.Generator,
) -> tuple[Rows, dict[tuple[str, str], ConfidenceInterval]]:
    """Gaps by term, and by (condition, source) the whole gap over the reward's own spread.

    The spread is the distance of a step's reward from the median, taken to be a step's cost at
    least: standing still earns the same at every step, and next to that any gap is large.
    """
    found, ratios = [], {}
    least = abs(steps.task.rewards.step)
    for condition, mask in chosen.items():
        rows = mask & stepped.valid
        episode = steps.episode_id[stepped.rows[rows]]
        logged = {"reward": stepped.logged.reward, **stepped.logged.terms}
        for source, side in stepped.twins.items():
            for term, values in {"reward": side.reward, **side.terms}.items():
                off = values[rows] - logged[term][rows]
                there = logged[term][rows]
                spread = np.abs(there - np.median(there)) if len(there) else there
                mean = clustered_ratio(np.abs(off), np.ones(len(off)), episode, rng=rng)
                if term == "reward":
                    ratios[condition, source] = clustered_ratio(
                        np.abs(off), np.maximum(spread, least), episode, rng=rng
                    )
                found.append(
                    {
                        "condition": condition,
                        "term": term,
                        "source": source,
                        "steps": int(rows.sum()),
                        **_spread_out("mean_gap", mean),
                        "bias": float(off.mean()) if len(off) else None,
                        "logged_mean": float(there.mean()) if len(there) else None,
                        "logged_spread": float(spread.mean()) if len(spread) else None,
                    }
                )
    return found, ratios


def _spread_out(name: str, found: ConfidenceInterval) -> dict[str, float | None]:
    """An estimate as values of a row; NaN as None."""
    values = {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}
    return {key: None if np.isnan(value) else value for key, value in values.items()}


def estimate(row: Mapping[str, Any], name: str) -> ConfidenceInterval:
    values = (row[name], row[f"{name}_low"], row[f"{name}_high"])
    return ConfidenceInterval(
        *(float("nan") if value is None else float(value) for value in values)
    )
