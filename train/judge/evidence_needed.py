"""How many hours of driving it takes until the twin and a policy can be judged by a store's logs.

Both are refused below a number of episodes: see `TrustLimits` and `EssGate`. What is missing is
told in hours of drives like those in the store. It is the least: more driving may still leave the
twin undecided, and weights are refused too if a policy seldom does what the logs' drivers did.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from restock.ingest.task.conditions import NOMINAL
from restock.replay.store.store import Store
from restock.train.evaluation.ope import EssGate
from restock.train.twin.calibration.logged_steps import logged_steps
from restock.train.twin.calibration.path_gap import overlapping_segments
from restock.train.twin.calibration.twin_gap import GapConfig


@dataclass(frozen=True)
class Evidence:
    """What one judgement needs, and how much of it a store holds."""

    purpose: str  # "judge the twin in nominal driving"
    needed: str  # "20 segments of 3 s in 5 episodes"
    held: str  # "12 in 2"
    more_h: float | None  # hours of drives like these that are missing; None: none is like this

    def __str__(self) -> str:
        missing = (
            "no drive is long enough"
            if self.more_h is None
            else f"at least {self.more_h:.2g} h more of such drives"
            if self.more_h
            else "enough"
        )
        return f"to {self.purpose}: {self.needed}; these logs hold {self.held}: {missing}"


def twin_evidence(store: Store, config: GapConfig) -> Evidence:
    """Return what the verdict of `restock twin gap` on nominal driving needs of a store.

    Raises:
        ConfigError: a horizon that is not some control periods, or a robot that the twin cannot
            build.
        StoreError: the store has rows of several tasks, or none.
    """
    limits, steps = config.limits, logged_steps(store)
    cut, counted = overlapping_segments(steps, limits.horizon_s, config)
    nominal = counted.get(NOMINAL, np.zeros(len(cut), np.bool_))
    segments, with_one = int(nominal.sum()), len(np.unique(cut.episode_id[nominal]))
    driven_h = len(steps) * steps.task.control_period_s / 3600
    return Evidence(
        "judge the twin in nominal driving",
        f"{limits.segments} segments of {limits.horizon_s:g} s in {limits.episodes} episodes",
        f"{segments:,} in {with_one:,}",
        _more_h(driven_h, (segments, limits.segments), (with_one, limits.episodes)),
    )


def policy_evidence(store: Store, held_out_share: float, gate: EssGate) -> Evidence:
    """Return what an estimate by importance weights needs, of a store's one task.

    Args:
        store: the logs.
        held_out_share: of the rows, by the mixture's evaluation split; above 0.
        gate: what the weights must be worth.

    Raises:
        StoreError: the store has rows of several tasks, or none.
    """
    ((rows, episodes),) = store.sql(
        "SELECT count(*), count(DISTINCT episode_id) FROM transitions"
    ).fetchall()
    least = round(gate.episodes / held_out_share)
    return Evidence(
        "judge a policy by held-out logs",
        f"{least} episodes, of which {gate.episodes:g} are held out",
        f"{episodes:,}",
        _more_h(rows * store.task().control_period_s / 3600, (episodes, least)),
    )


def _more_h(driven_h: float, *counts: tuple[int, int]) -> float | None:
    """Hours that are missing, of counts that are there and that are needed."""
    if not all(there for there, _ in counts):
        return None
    return driven_h * max(0.0, *(least / there - 1 for there, least in counts))
