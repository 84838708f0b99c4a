"""What a policy's episodes came to: success, return and safety side by side, each with an interval.

Intervals are 95 %: Wilson's of success, a bootstrap over episodes of the rest. They say what other
episodes of the kind would have changed, not what another training seed would have.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from restock.stats import NOT_KNOWN, ConfidenceInterval, clustered_ratio, mean_over_strata, wilson
from restock.train.evaluation.evaluate import EpisodeResult, cell_name
from restock.train.feed.fresh_log import Entries, values_entries

# What names a mission on one set of floors: condition, seed, and the parameters in force.
Mission = tuple[str, int, str]


def mission_of(result: EpisodeResult) -> Mission:
    values = values_entries(result.perturbation_values)
    return mission_named(result.condition, result.episode_seed, values)


def mission_named(condition: str, seed: int, values: Entries | None) -> Mission:
    return condition, seed, str(sorted(values or ()))


def with_time_lost(
    results: Sequence[EpisodeResult], planner_s: Mapping[Mission, float]
) -> list[EpisodeResult]:
    """The same with the seconds lost against the planner, where both arrived.

    Args:
        planner_s: time of the planner, of the missions in which it succeeded.
    """
    return [
        replace(
            result,
            time_lost_s=result.time_s - planner_s[mission_of(result)]
            if result.success and mission_of(result) in planner_s
            else None,
        )
        for result in results
    ]


def summary_rows(
    results: Mapping[tuple[str, str], Sequence[EpisodeResult]],
) -> list[dict[str, Any]]:
    """Per (policy, perturbation) and condition, blocked aisles by partial and full: a table's rows.

    What no episode tells is None: success of a task without a goal, the closest approach where
    nobody was about, time lost where the planner did not arrive or was not driven.
    """
    rows = []
    for (policy, perturbation), episodes in results.items():
        cells: dict[str, list[EpisodeResult]] = {}
        for result in episodes:
            cells.setdefault(cell_name(result.condition, result.block), []).append(result)
        for cell in sorted(cells, key=_cell_order):
            named = {"policy": policy, "perturbation": perturbation, "condition": cell}
            rows.append({**named, **measures(cells[cell])})
    return rows


def measures(group: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Of the episodes of one cell."""
    successes = sum(bool(result.success) for result in group)
    goal = all(result.success is not None for result in group)
    low, high = wilson(successes, len(group)) if goal else (None, None)
    arrived = [result.time_s for result in group if result.success]
    lost = [result.time_lost_s for result in group if result.time_lost_s is not None]
    near = [result.closest_person_m for result in group if result.closest_person_m is not None]
    return {
        "episodes": len(group),
        "success": successes / len(group) if goal else None,
        "success_low": low,
        "success_high": high,
        **_mean("return", [result.undiscounted_return for result in group]),
        **_mean("discounted_return", [result.discounted_return for result in group]),
        "bumps_per_episode": float(np.mean([result.bumps for result in group])),
        "distance_km": sum(result.distance_m or 0.0 for result in group) / 1000,
        **_interval("bumps_per_km", _bumps_per_km(group)),
        "episodes_with_people": len(near),
        "closest_person_least_m": min(near, default=None),
        **_mean("closest_person_m", near),
        "time_s": float(np.mean(arrived)) if arrived else None,
        "time_lost_episodes": len(lost),
        **_mean("time_lost_s", lost),
    }


def _bumps_per_km(group: Sequence[EpisodeResult]) -> ConfidenceInterval:
    """All bumps over all kilometres: an episode counts by how far it went.

    Where nothing was touched resamples do not vary: the upper end is then that of a Poisson rate.
    """
    km = np.array([(result.distance_m or 0.0) / 1000 for result in group])
    bumps = np.array([result.bumps for result in group])
    if not bumps.any() and km.sum():
        return ConfidenceInterval(0.0, 0.0, -math.log(0.025) / float(km.sum()))
    return clustered_ratio(bumps, km, np.arange(len(group)), rng=np.random.default_rng(0))


def _mean(name: str, values: Iterable[float | None]) -> dict[str, float | None]:
    known = np.array([value for value in values if value is not None], np.float64)
    if not len(known):
        return _interval(name, NOT_KNOWN)
    if len(known) == 1:  # nothing to resample
        return _interval(name, ConfidenceInterval(float(known[0]), float("nan"), float("nan")))
    return _interval(name, mean_over_strata([known], rng=np.random.default_rng(0)))


def _interval(name: str, of: ConfidenceInterval) -> dict[str, float | None]:
    values = {name: of.value, f"{name}_low": of.low, f"{name}_high": of.high}
    return {key: None if np.isnan(value) else value for key, value in values.items()}


def _cell_order(cell: str) -> tuple[int, str]:
    return (0 if cell == "nominal" else 1, cell)


__all__ = ["Mission", "measures", "mission_named", "mission_of", "summary_rows", "with_time_lost"]
