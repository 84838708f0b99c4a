"""Keep the episodes that `restock eval` drove in `RUN/eval/episodes.parquet`, and measure them.

An episode is identified by its policy and version, floors, perturbation, condition and seed. If it
is driven again, it replaces the earlier one; all others are kept. Pages show the floors of the last
evaluation, the newest version of the run's own policy, and the newest limits of a limited policy.

Intervals of measures are 95 %: Wilson's for success, a bootstrap over episodes for the rest. They
include the effect of other episodes of the kind, not that of another training seed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from restock.errors import RunError, counted, quoted
from restock.files import read_table, write_table
from restock.stats import (
    NOT_KNOWN,
    ConfidenceInterval,
    clustered_ratio,
    interval_text,
    mean_over_strata,
    wilson,
)
from restock.train.run.run_tables import EVAL_CLONES, EVAL_EPISODES

Mission = tuple[str | None, str, int, str]
FILE = Path("eval") / "episodes.parquet"  # in a run's directory
LIMITED = "limited:"  # prefix of a policy whose commands pass the limiter
_KEY_COLUMNS = ("policy", "version", "layouts", "perturbation", "perturbation_values", "condition")


def read_evaluations(run: Path) -> pa.Table:
    """Read all episodes that a run's evaluations drove; the table is empty without any.

    Raises:
        RunError: the file is damaged.
    """
    file = run / FILE
    if not file.is_file():
        return EVAL_EPISODES.empty_table()
    return read_table(
        file,
        EVAL_EPISODES,
        error=RunError,
        remedy=f"remove it, then `restock eval {quoted(run)}` again",
    )


def add_evaluation(run: Path, driven: pa.Table) -> pa.Table:
    """Add an evaluation to the earlier ones, replacing episodes that were driven again.

    Time lost is computed for all episodes, against the planner's last drive of the same mission.
    Returns the added rows with their time lost.
    """
    earlier, new = read_evaluations(run), set(_episode_keys(driven))
    kept = [name not in new for name in _episode_keys(earlier)]
    episodes = pa.concat_tables([earlier.filter(pa.array(kept, pa.bool_())), driven])
    rows = episodes.to_pylist()
    planner_s = planner_times(rows)
    lost = [
        row["time_s"] - planner_s[mission_of(row)]
        if row["success"] and mission_of(row) in planner_s
        else None
        for row in rows
    ]
    place = episodes.schema.get_field_index("time_lost_s")
    column = pa.array(lost, pa.float64())
    episodes = episodes.set_column(place, episodes.schema.field(place), column)
    write_table(episodes, run / FILE)
    return episodes.slice(episodes.num_rows - driven.num_rows)


def planner_times(rows: Iterable[Mapping[str, Any]]) -> dict[Mission, float]:
    """Return how long the planner took on each mission in which it arrived."""
    return {
        mission_of(row): row["time_s"]
        for row in rows
        if row["policy"] == "planner" and row["success"]
    }


def mission_of(row: Mapping[str, Any]) -> Mission:
    """Return the key of a mission: floors, condition, seed, and parameters in force."""
    values = str(sorted(row["perturbation_values"] or ()))
    return row["layouts"], row["condition"], row["episode_seed"], values


def shown_evaluation(run: Path) -> tuple[pa.Table, str]:
    """Return the episodes to show and compare, and a sentence that counts them.

    Raises:
        RunError: the file is damaged.
    """
    table = read_evaluations(run)
    if not table.num_rows:
        return table, ""
    last = table.slice(table.num_rows - 1).to_pylist()[0]
    policies, versions, layouts = (
        table[name].to_pylist() for name in ("policy", "version", "layouts")
    )
    newest = dict(zip(policies, versions, strict=True))
    version = newest.get("agent")
    mask = [
        driven == last["layouts"] and (not _has_versions(policy) or made == newest[policy])
        for policy, made, driven in zip(policies, versions, layouts, strict=True)
    ]
    shown = table.filter(pa.array(mask, pa.bool_()))
    seeds = shown["episode_seed"]
    text = f"{shown.num_rows:,} of {table.num_rows:,} episodes that `restock eval` drove: "
    floors = _floor_names(last["layouts"] or "not named")
    text += f"floors {floors}, policy {version or 'not named'}"
    if (step := trained_step(shown)) is not None:
        text += f" of step {step:,}"
    return shown, text + f", seeds {pc.min(seeds).as_py()} to {pc.max(seeds).as_py()}."


def trained_step(shown: pa.Table) -> int | None:
    """Return the environment steps of training after which the run's own policy was saved."""
    own = shown.filter(pc.equal(shown["policy"], "agent"))
    step: int | None = own["trained_env_steps"][-1].as_py() if own.num_rows else None
    return step


def _floor_names(layouts: str) -> str:
    """Shorten a list of floors: drop folders, and of more than 3 all but the first and the last."""
    names = [part.rpartition("/")[2].strip() for part in layouts.split(",")]
    shown = names if len(names) <= 3 else [f"{names[0]} to {names[-1]} ({len(names)})"]
    return ", ".join(shown)


def _has_versions(policy: str) -> bool:
    """Return whether a policy of this name changes with the run or with the limiter's settings."""
    return policy == "agent" or policy.startswith(LIMITED)


def _episode_keys(table: pa.Table) -> list[tuple[str, ...]]:
    columns = [list(map(str, table[name].to_pylist())) for name in _KEY_COLUMNS]
    return list(zip(*columns, map(str, table["episode_seed"].to_pylist()), strict=True))


CLONES = Path("eval") / "clones.parquet"  # in a run's directory


@dataclass(frozen=True)
class CloneQuality:
    """The quality of a clone, a row of `RUN/eval/clones.parquet`: `EVAL_CLONES` explains it."""

    policy: str
    drivers: list[str]
    rows: int
    episodes: int
    updates: int
    training_log_likelihood: float
    held_out_rows: int
    log_likelihood: float | None
    frequencies_log_likelihood: float | None
    agreement: float | None
    repeating: float | None
    changed_agreement: float | None
    note: str | None

    @property
    def poor(self) -> str | None:
        """Return why the clone should not stand in for its drivers; None if no measure shows it."""
        if self.log_likelihood is None or self.agreement is None:
            return "the quality of the clone is not known: no row of its drivers is held out"
        if self.log_likelihood <= (self.frequencies_log_likelihood or 0.0):
            return (
                "a poor clone: held-out actions are not more likely under it than under the "
                "frequency of each action"
            )
        if self.agreement <= (self.repeating or 0.0):
            return "a poor clone: repeating the last action agrees as often with held-out rows"
        return None

    @property
    def text(self) -> str:
        """Describe the clone and its quality in a sentence or two."""
        description = (
            f"{self.policy} is behaviour cloning of {', '.join(self.drivers) or 'unnamed drivers'}"
            f" ({counted(self.rows, 'row')} of"
            f" {counted(self.episodes, 'episode')})"
        )
        if self.agreement is not None:
            description += (
                f"; in {self.held_out_rows:,} held-out rows the drivers' action is its likeliest "
                f"in {self.agreement:.0%} (repeating the last one: {self.repeating:.0%}"
            )
            if self.changed_agreement is not None:
                description += f"; where they changed it: {self.changed_agreement:.0%}"
            description += ")"
        return ". ".join(part for part in (description, self.poor, self.note) if part)


def read_clones(run: Path) -> list[CloneQuality]:
    """Read the clones' qualities, one per policy; raise RunError if the file is damaged."""
    if not (run / CLONES).is_file():
        return []
    table = read_table(run / CLONES, EVAL_CLONES, error=RunError, remedy="remove it")
    return [CloneQuality(**row) for row in table.to_pylist()]


def keep_clone(run: Path, quality: CloneQuality) -> None:
    """Add a clone's quality to the run, replacing that of the same policy."""
    others = [row for row in read_clones(run) if row.policy != quality.policy]
    rows = [asdict(row) for row in (*others, quality)]
    write_table(pa.Table.from_pylist(rows, schema=EVAL_CLONES), run / CLONES)


Row = Mapping[str, Any]


def cell_name(condition: str, block: str) -> str:
    """Name a cell: `blocked_aisle (partial)`, or the condition alone if it has no blocks."""
    return condition if block in ("none", "") else f"{condition} ({block})"


def summary_rows(episodes: Iterable[Row]) -> list[dict[str, Any]]:
    """Compute the `measures` per policy, perturbation and condition.

    Blocked aisles are split into partial and full.
    """
    groups: dict[tuple[str, str], dict[str, list[Row]]] = {}
    for row in episodes:
        group = groups.setdefault((row["policy"], row["perturbation"]), {})
        group.setdefault(cell_name(row["condition"], row["block"]), []).append(row)
    return [
        {"policy": policy, "perturbation": perturbation, "condition": cell, **measures(group[cell])}
        for (policy, perturbation), group in groups.items()
        for cell in sorted(group, key=lambda cell: (cell != "nominal", cell))
    ]


def measures(episodes: Sequence[Row]) -> dict[str, Any]:
    """Compute the measures of one cell's episodes; None if no episode has the value.

    Success is None if the task has no goal, the closest approach if nobody was near, and time lost
    if the planner did not drive to the goal. Files of an earlier Restock lack further values.
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
        **_limited_shares(episodes),
        "time_lost_episodes": len(lost),
        **_mean("time_lost_s", lost),
    }


def measured_row(row: Row) -> dict[str, Any]:
    """Return a cell's measures as texts for a table: docs/eval.md explains each."""

    def text(name: str, form: str) -> str:
        ends = row.get(f"{name}_low"), row.get(f"{name}_high")
        return "" if row[name] is None else interval_text(row[name], *ends, form)

    nearest, held = row["closest_person_least_m"], row["limited_share"]
    return {
        "episodes": row["episodes"],
        "success": text("success", ".2f") or "no goal",
        "discounted return": text("discounted_return", ".2f"),
        "bumps per km": text("bumps_per_km", ".1f"),
        "people, least (mean) m": ""
        if nearest is None
        else f"{nearest:.2f} ({row['closest_person_m']:.2f})",
        "time s": "" if row["time_s"] is None else f"{row['time_s']:.1f}",
        "lost s": text("time_lost_s", "+.1f"),
        "held back": "" if held is None else f"{held:.0%} ({row['stopped_share']:.0%} to a stop)",
    }


def _limited_shares(episodes: Sequence[Row]) -> dict[str, float | None]:
    """Return the shares of driven time in which a limiter reduced commands, and stopped them."""
    behind = [row for row in episodes if row.get("limited_s") is not None]
    time_s = sum(row["time_s"] for row in behind)
    return {
        f"{name}_share": sum(row[f"{name}_s"] for row in behind) / time_s if time_s else None
        for name in ("limited", "stopped")
    }


def _bumps_per_km(episodes: Sequence[Row]) -> ConfidenceInterval:
    """Return all bumps over all kilometres: each episode counts in proportion to its distance.

    If there is no bump, resamples do not vary, so the upper end is that of a Poisson rate.
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


def _interval(name: str, interval: ConfidenceInterval) -> dict[str, float | None]:
    values = {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
    return {key: None if np.isnan(value) else value for key, value in values.items()}
