"""Measure an alarm of stated miss rates on held-out episodes of the twin, and what slowing does.

    python benchmarks/alarm.py [--policy run:runs/a] [--episodes 150] [--held-out 80] [--quick]

The planner (or another policy) drives missions of each kind. The alarm is fitted to some of these
and tested on others: how many failures had no alarm in the window before, with the exact interval
of that share, and how many false alarms there were in the others. Beside it stands the distance to
the nearest observations before failures, in place of the score. Then the same policy drives the
held-out missions behind the limiter, which slows it while the alarm is on.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from harness import finish, markdown, option_parser
from scipy.spatial import cKDTree
from scipy.stats import binomtest

from restock.arrays import F32, F64, Bools, Ints
from restock.ingest.live.alarm import FITTED_S, WINDOW_S, Alarm, count_alarms, fit_alarm
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.robot import Limits, limit
from restock.stats import interval_text, wilson
from restock.train.evaluation.evaluate import (
    STUCK_RADIUS_M,
    EpisodeResult,
    fixed_episodes,
    run_episodes,
)
from restock.train.evaluation.policies import load_policy
from restock.train.twin.env.drivers import PlannerFollower
from restock.train.twin.env.interface import Policy, Step
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.missions import KINDS

PROFILE = load_profile("warehouse_amr")
TASK = PROFILE.task
PERIOD_S = TASK.control_period_s
MISS_RATES = (0.1, 0.2, 0.5)
SLOW_MPS = 0.3
FITTED_SEED, HELD_OUT_SEED = 50_000, 60_000
NEAREST = 5
ENVS = 64


@dataclass(frozen=True)
class Driven:
    """An episode, and the observations (n, D) at which it was decided."""

    result: EpisodeResult
    observation: F32
    position_m: F64  # (n, 2)
    bumped: Bools  # (n,) in [t, t + 1)

    @property
    def window(self) -> F32:
        """Return the observations before the failure began."""
        hit = np.flatnonzero(self.bumped)
        away = np.hypot(*(self.position_m - self.position_m[-1]).T) >= STUCK_RADIUS_M
        onset = hit[0] if len(hit) else int(np.flatnonzero(away)[-1]) + 1 if away.any() else 0
        return self.observation[max(onset - round(WINDOW_S / PERIOD_S), 0) : max(onset, 1)]


def drive(
    policy: Policy, episodes: int, first_seed: int, slow: Alarm | None = None, *, limiter: bool
) -> list[Driven]:
    """Drive missions of each kind; with `slow`, slowly while this alarm is on."""
    env = WarehouseVectorEnv(
        ENVS, task=TASK, action="continuous", nav_command=PROFILE.inputs.nav_command is not None
    )
    limits = Limits.of(TASK, PROFILE.robot, PROFILE.limiter)
    table = np.array(TASK.actions)
    rows: list[list[tuple[Any, ...]]] = [[] for _ in range(ENVS)]
    tracks: dict[int, list[tuple[Any, ...]]] = {}

    def command(observation: F32, action: Ints) -> F64:
        if not limiter:
            return table[action]
        now = env.signals
        before = np.stack([now["command_speed_mps"], now["command_yaw_rate_radps"]], axis=-1)

        def within(limits: Limits) -> F64:
            return limit(limits, table[action], now["sector_clearance_m"], before).command

        if slow is None:
            return within(limits)
        return np.where(
            slow.on(observation)[:, None], within(limits.at_most(SLOW_MPS)), within(limits)
        )

    def step(observation: F32, action: Ints) -> Step:
        position = np.stack([env.signals["pose_x_m"], env.signals["pose_y_m"]], axis=-1)
        observation = observation.copy()
        made: Step = env.step(command(observation, action))
        _, _, terminated, truncated, info = made
        for index in range(ENVS):
            bumped = bool(info["signals"]["bumped"][index])
            rows[index].append((observation[index], position[index], bumped))
            if terminated[index] or truncated[index]:
                tracks[int(info["episode_number"][index])] = rows[index]
                rows[index] = []
        return made

    results = run_episodes(
        env,
        policy,
        fixed_episodes(list(KINDS), episodes, first_seed),
        control_period_s=PERIOD_S,
        time_limit_steps=TASK.time_limit_steps,
        step=step,
    )
    return [
        Driven(result, *map(np.array, zip(*tracks[index], strict=True)))
        for index, result in enumerate(results)
    ]


Score = Callable[[F32], F64]  # of observations (n, D); larger: more like before failures


def nearest_score(failed: Sequence[Driven], safe: Sequence[Driven]) -> Score:
    """Return minus the standardised distance to the nearest observations before failures."""
    scale = np.concatenate([one.observation for one in safe]).std(axis=0) + 1e-6
    last = round(FITTED_S / PERIOD_S)
    tree = cKDTree(np.concatenate([one.window[-last:] for one in failed]) / scale)
    return lambda observation: -tree.query(observation / scale, NEAREST)[0][:, -1]


def tested(
    name: str, rate: float, score: Score, threshold: float, driven: Sequence[Driven]
) -> dict[str, Any]:
    """Return what an alarm comes to on held-out episodes."""
    failed = [one for one in driven if not one.result.success]
    missed = sum(not (score(one.window) >= threshold).any() for one in failed)
    interval = binomtest(missed, len(failed)).proportion_ci()
    row = {
        "score": name,
        "miss_rate": rate,
        "failed": len(failed),
        "missed": missed,
        "share": missed / len(failed),
        "low": interval.low,
        "high": interval.high,
    }
    for kind in ("all", "nominal"):
        on = [
            score(one.observation) >= threshold
            for one in driven
            if one.result.success and kind in ("all", one.result.condition)
        ]
        steps = np.concatenate(on)
        hours = len(steps) * PERIOD_S / 3600
        row |= {
            f"{kind}_per_h": sum(count_alarms(each, PERIOD_S) for each in on) / hours,
            f"{kind}_on": float(steps.mean()),
        }
    return row


def drove(name: str, driven: Sequence[Driven]) -> dict[str, Any]:
    """Return success, bumps and time of missions."""
    results = [one.result for one in driven]
    success = sum(bool(result.success) for result in results)
    low, high = wilson(success, len(results))
    return {
        "drives": name,
        "success": success / len(results),
        "low": low,
        "high": high,
        "bumps": sum(result.bumps for result in results),
        "bumps_per_km": sum(result.bumps for result in results)
        / sum(result.distance_m or 0.0 for result in results)
        * 1e3,
        "arrival_s": float(np.mean([result.time_s for result in results if result.success])),
    }


def main() -> int:
    parser = option_parser(__doc__, "8 episodes of each kind: it shows that all runs")
    parser.add_argument("--policy", default="planner", help="planner, run:RUN or onnx:FILE")
    parser.add_argument("--episodes", type=int, default=150, help="of each kind, to fit to")
    parser.add_argument("--held-out", type=int, default=80, help="of each kind, to test on")
    options = parser.parse_args()
    episodes, held_out = (8, 8) if options.quick else (options.episodes, options.held_out)
    rates = (0.5,) if options.quick else MISS_RATES

    def policy() -> Policy:
        return load_policy(options.policy, TASK) or PlannerFollower()

    fitted = drive(policy(), episodes, FITTED_SEED, limiter=False)
    failed = [one for one in fitted if not one.result.success]
    safe = [one for one in fitted if one.result.success]
    others = drive(policy(), held_out, HELD_OUT_SEED, limiter=False)
    rows, alarms = [], {}
    half = len(failed) // 2
    nearest = nearest_score(failed[:half], safe)
    highest = sorted(float(nearest(one.window).max()) for one in failed[half:])
    for rate in rates:
        alarms[rate] = alarm = fit_alarm(
            [one.window for one in failed],
            [str(one.result.failure) for one in failed],
            [one.observation for one in safe],
            miss_rate=rate,
            period_s=PERIOD_S,
        )
        rows.append(tested("linear", rate, alarm.score, alarm.threshold, others))
        threshold = highest[int(rate * (len(highest) + 1)) - 1]
        rows.append(tested("nearest", rate, nearest, threshold, others))
    drives = [drove("without limiter", others)]
    for name, slow in [
        ("limiter", None),
        *((f"slowed, miss rate {rate:g}", alarm) for rate, alarm in alarms.items()),
    ]:
        drives.append(drove(name, drive(policy(), held_out, HELD_OUT_SEED, slow, limiter=True)))
    figures = {
        "policy": options.policy,
        "failures": alarms[rates[0]].failures,
        "alarms": sorted(rows, key=lambda row: str(row["score"])),
        "drives": drives,
    }
    missed = [
        f"{row['score']}: {row['low']:.2f} is above the miss rate of {row['miss_rate']:g}"
        for row in rows
        if row["low"] > row["miss_rate"]
    ]
    return finish(options, figures, missed, _lines(figures))


def _lines(figures: dict[str, Any]) -> list[str]:
    return [
        f"fitted to {figures['failures']}",
        markdown(
            [
                "score",
                "miss rate",
                "missed",
                "false alarms an hour",
                "on",
                "nominal",
                "on",
            ],
            (
                (
                    row["score"],
                    f"{row['miss_rate']:g}",
                    f"{row['missed']} of {row['failed']}: "
                    + interval_text(row["share"], row["low"], row["high"]),
                    f"{row['all_per_h']:.0f}",
                    f"{row['all_on']:.1%}",
                    f"{row['nominal_per_h']:.0f}",
                    f"{row['nominal_on']:.1%}",
                )
                for row in figures["alarms"]
            ),
        ),
        markdown(
            ["drives", "success", "bumps per km", "seconds to arrive"],
            (
                (
                    row["drives"],
                    interval_text(row["success"], row["low"], row["high"]),
                    f"{row['bumps_per_km']:.0f}",
                    f"{row['arrival_s']:.1f}",
                )
                for row in figures["drives"]
            ),
        ),
    ]


if __name__ == "__main__":
    sys.exit(main())
