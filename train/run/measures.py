"""Measures of a policy's episodes: success, return and safety, each with an interval.

Episodes are rows of a run's `eval/episodes` (`EVAL_EPISODES`). Intervals are 95 %: Wilson's of
success, a bootstrap over episodes of the rest. They cover what other episodes of the kind would
have changed, not what another training seed would have.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from restock.stats import NOT_KNOWN, ConfidenceInterval, clustered_ratio, mean_over_strata, wilson

Row = Mapping[str, Any]


def cell_name(condition: str, block: str) -> str:
    """`blocked_aisle (partial)`, but `nominal`."""
    return condition if block in ("none", "") else f"{condition} ({block})"


def summary_rows(episodes: Iterable[Row]) -> list[dict[str, Any]]:
    """Compute the `measures` per policy, perturbation and condition.

    Blocked aisles are split into partial and full.
    """
    cells: dict[tuple[str, str], dict[str, list[Row]]] = {}
    for row in episodes:
        of = cells.setdefault((row["policy"], row["perturbation"]), {})
        of.setdefault(cell_name(row["condition"], row["block"]), []).append(row)
    return [
        {"policy": policy, "perturbation": perturbation, "condition": cell, **measures(of[cell])}
        for (policy, perturbation), of in cells.items()
        for cell in sorted(of, key=lambda cell: (cell != "nominal", cell))
    ]


def measures(episodes: Sequence[Row]) -> dict[str, Any]:
    """Compute the measures of one cell's episodes; None if no episode has the value.

    Success is unknown of a task without a goal, the closest approach where nobody was about, time
    lost where the planner did not arrive or was not driven, the rest in files from before it was
    measured.
    """

    def known(name: str) -> list[float]:
        return [row[name] for row in episodes if row[name] is not None]

    successes = sum(bool(row["success"]) for row in episodes)
    goal = all(row["success"] is not None for row in episodes)
    low, high = wilson(successes, len(episodes)) if goal else (None, None)
    arrived = [row["time_s"] for row in episodes if row["success"]]
    near, lost = known("closest_person_m"), known("time_lost_s")
    return {
        "episodes": len(episodes),
        "success": successes / len(episodes) if goal else None,
        "success_low": low,
        "success_high": high,
        **_mean("return", known("return")),
        **_mean("discounted_return", known("discounted_return")),
        "bumps_per_episode": float(np.mean([row["bumps"] for row in episodes])),
        "distance_km": sum(known("distance_m")) / 1000,
        **_interval("bumps_per_km", _bumps_per_km(episodes)),
        "episodes_with_people": len(near),
        "closest_person_least_m": min(near, default=None),
        **_mean("closest_person_m", near),
        "time_s": float(np.mean(arrived)) if arrived else None,
        **_limited(episodes),
        "time_lost_episodes": len(lost),
        **_mean("time_lost_s", lost),
    }


def _limited(episodes: Sequence[Row]) -> dict[str, float | None]:
    """Return the share of driven time that a limiter held commands back, and of that to a stop."""
    behind = [row for row in episodes if row.get("limited_s") is not None]
    time_s = sum(row["time_s"] for row in behind)
    return {
        f"{name}_share": sum(row[f"{name}_s"] for row in behind) / time_s if time_s else None
        for name in ("limited", "stopped")
    }


def _bumps_per_km(episodes: Sequence[Row]) -> ConfidenceInterval:
    """Return all bumps over all kilometres: an episode counts by how far it went.

    Where nothing was touched resamples do not vary: the upper end is then that of a Poisson rate.
    """
    reported = [row for row in episodes if row["distance_m"] is not None]
    km = np.array([row["distance_m"] / 1000 for row in reported])
    bumps = np.array([row["bumps"] for row in reported])
    if not bumps.any() and km.sum():
        return ConfidenceInterval(0.0, 0.0, -math.log(0.025) / float(km.sum()))
    return clustered_ratio(bumps, km, np.arange(len(reported)), rng=np.random.default_rng(0))


def _mean(name: str, values: Iterable[float]) -> dict[str, float | None]:
    known = np.array(list(values), np.float64)
    if not len(known):
        return _interval(name, NOT_KNOWN)
    if len(known) == 1:  # nothing to resample
        return _interval(name, ConfidenceInterval(float(known[0]), float("nan"), float("nan")))
    return _interval(name, mean_over_strata([known], rng=np.random.default_rng(0)))


def _interval(name: str, of: ConfidenceInterval) -> dict[str, float | None]:
    values = {name: of.value, f"{name}_low": of.low, f"{name}_high": of.high}
    return {key: None if np.isnan(value) else value for key, value in values.items()}


__all__ = ["cell_name", "measures", "summary_rows"]
