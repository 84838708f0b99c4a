"""Does the reward want what is measured? Returns of drivers on the same missions, by reward.

    python benchmarks/reward.py [--runs RUN …] [--episodes 200] [--json] [--check]

The operator, the planner and the policies of `--runs` drive the same missions, `--episodes` of each
cell, and every part of the reward is kept. So one drive can be judged by several rewards: with and
without a protective stop (a bump ends the episode: what comes after it does not count), at other
costs and discounts. Success (at the goal without a bump) is the same for all of them.

`--check` exits 1 where the shipped profile's reward, at the default discount, returns surely less
(95 %, paired over missions) to a driver that surely succeeds more.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from harness import finish, markdown, option_parser
from numpy.typing import NDArray

from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import Rewards, reward_parts
from restock.train.dqn.config import LossConfig
from restock.train.evaluation.policies import load_agent
from restock.train.run.kept_evaluations import cell_name
from restock.train.run.run import Run
from restock.train.twin.env.drivers import Operator, PlannerFollower
from restock.train.twin.env.interface import Policy
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.missions import KINDS
from restock.train.twin.physics.episode import EpisodeSpec

FIRST_SEED = 700_000
ENVS = 32
Z = 1.96  # 95 %
# The shipped profile's, before a bump ended episodes.
EARLIER = Rewards(slip_per_mps=-0.3, bump=-3.0)


@dataclass(frozen=True)
class Judge:
    """A reward, whether a bump ends the episode (else it costs every step pressed), a discount."""

    rewards: Rewards
    stop: bool
    discount: float


@dataclass(frozen=True)
class Driven:
    """One driver's missions: each event of each step, to be judged afterwards."""

    cell: list[str]  # (E,)
    success: NDArray[np.bool_]  # (E,)
    bumped: NDArray[np.bool_]  # (E,)
    parts: list[dict[str, NDArray[np.float64]]]  # (E,) of (steps,) at a weight of 1; and pressed

    def returns(self, judge: Judge) -> NDArray[np.float64]:
        """Discounted return of each mission, (E,)."""
        weights = msgspec.structs.asdict(judge.rewards)
        values = []
        for parts in self.parts:
            counted = dict(parts)
            pressed = counted.pop("pressed")
            if not judge.stop:
                counted["bump"] = pressed
            reward = sum(weights[name] * value for name, value in counted.items())
            if judge.stop and pressed.any():
                reward = reward[: int(np.argmax(pressed > 0)) + 1]
            values.append(float(reward @ judge.discount ** np.arange(len(reward))))
        return np.array(values)


def drive(policy: Policy, specs: Sequence[EpisodeSpec], task: Any) -> Driven:
    """Every mission to its end: at the goal or out of time, bumps or not."""
    going_on = msgspec.structs.replace(task, bump_terminates=False)
    names = {field.name for field in msgspec.structs.fields(Rewards)}
    ones = dict.fromkeys(names - {"tight_clearance_m", "harsh_mps2"}, 1.0)
    unit = msgspec.structs.replace(going_on, rewards=msgspec.structs.replace(task.rewards, **ones))
    env = WarehouseVectorEnv(ENVS, task=going_on, seed=FIRST_SEED)
    env.set_episodes(list(specs))
    observation, _ = env.reset(seed=0)
    steps: list[dict[str, list[float]]] = [{} for _ in range(ENVS)]
    done: list[Any] = [None] * len(specs)
    while any(one is None for one in done):
        action, _ = policy.act(env, observation)
        now, before = env.signals, env.previous_action.copy()
        observation, _, terminated, truncated, info = env.step(action)
        after = info["signals"]
        parts = reward_parts(unit, now, after, info["progress_m"], action, before)
        parts["pressed"] = after["bumped"].astype(np.float64)
        for place in range(ENVS):
            for name, value in parts.items():
                steps[place].setdefault(name, []).append(float(value[place]))
        for place in np.flatnonzero(terminated | truncated).tolist():
            index = int(info["episode_number"][place])
            if index >= 0:
                of = {name: np.array(values) for name, values in steps[place].items()}
                cell = cell_name(specs[index].condition, str(info["block"][place]))
                done[index] = (cell, bool(info["success"][place]), bool(of["bump"].any()), of)
            steps[place] = {}
    cells, success, bumped, parts_of = zip(*done, strict=True)
    return Driven(list(cells), np.array(success), np.array(bumped), list(parts_of))


def missions(per_cell: int) -> list[EpisodeSpec]:
    """Return the same missions each time; those of blocked aisles twice, as they block two ways."""
    return [
        EpisodeSpec(kind, FIRST_SEED + index)
        for kind in KINDS
        for index in range(per_cell * (2 if kind == "blocked_aisle" else 1))
    ]


def misleading(driven: Mapping[str, Driven], judge: Judge) -> list[dict[str, Any]]:
    """Return cells and pairs where the driver that surely succeeds more surely earns less."""
    found = []
    returns = {name: one.returns(judge) for name, one in driven.items()}
    cells = np.array(next(iter(driven.values())).cell)
    for cell in sorted(set(cells)):
        ids = np.flatnonzero(cells == cell)
        for better, worse in permutations(driven, 2):
            more = np.subtract(
                *(driven[name].success[ids].astype(float) for name in (better, worse))
            )
            earns = returns[better][ids] - returns[worse][ids]
            if _bounds(more)[0] > 0 and _bounds(earns)[1] < 0:
                found.append(
                    {
                        "cell": cell,
                        "succeeds more": better,
                        "earns more": worse,
                        "success": float(more.mean()),
                        "return": float(earns.mean()),
                    }
                )
    return found


def _bounds(difference: NDArray[Any]) -> tuple[float, float]:
    """95 % of the mean of paired differences (n,)."""
    half = Z * difference.std(ddof=1) / np.sqrt(len(difference))
    return float(difference.mean() - half), float(difference.mean() + half)


def main() -> int:
    parser = option_parser(__doc__)
    parser.add_argument("--runs", nargs="*", type=Path, default=[], help="runs whose best drives")
    parser.add_argument("--episodes", type=int, default=200, help="of each cell")
    options = parser.parse_args()
    task = load_profile("warehouse_amr").task
    shipped = f"shipped, {LossConfig().discount:g}"
    judges = {
        "earlier, 0.97": Judge(EARLIER, False, 0.97),
        "earlier, 0.99": Judge(EARLIER, False, 0.99),
        shipped: Judge(task.rewards, task.bump_terminates, LossConfig().discount),
    }
    drivers: dict[str, Policy] = {
        "operator": Operator(epsilon=0.0),
        "planner": PlannerFollower(epsilon=0.0),
        **{path.name: load_agent(Run.open(path)) for path in options.runs},
    }
    specs = missions(options.episodes)
    driven = {}
    for name, policy in drivers.items():
        driven[name] = drive(policy, specs, task)
        print(f"{name} has driven", file=sys.stderr)
    cells = np.array(driven["planner"].cell)
    rows = [
        {
            "cell": cell,
            "driver": name,
            "missions": int((cells == cell).sum()),
            "success": float(one.success[cells == cell].mean()),
            "bumped": float(one.bumped[cells == cell].mean()),
            **{
                label: float(one.returns(judge)[cells == cell].mean())
                for label, judge in judges.items()
            },
        }
        for cell in sorted(set(cells))
        for name, one in driven.items()
    ]
    wrong = {label: misleading(driven, judge) for label, judge in judges.items()}
    header = list(rows[0])
    lines = [
        markdown(header, [[_short(value) for value in row.values()] for row in rows]),
        *(f"{label}: {len(found)} orders reversed" for label, found in wrong.items()),
        *(f"  {label}: {one}" for label, found in wrong.items() for one in found),
    ]
    missed = [f"{one}" for one in wrong[shipped]]
    return finish(options, {"rows": rows, "reversed": wrong}, missed, lines)


def _short(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main())
