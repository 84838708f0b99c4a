"""Is the twin worth training in? Success and contacts by condition, of drivers and of agents.

    python benchmarks/worth_training.py --out /tmp/worth [--seeds 3] [--env-steps N]
                                        [--episodes 300] [--json] [--check]

Two agents are trained online from nothing, of `--seeds` seeds each: one on all conditions, one on
nominal episodes alone. They, the planner, the operator and chance then drive the same episodes,
none of which was driven in training or chose a checkpoint: `--episodes` of each cell. Cells of
wheel slip are bands of the slipperiest patch's friction, of blocked aisles partly and wholly
blocked ones, of near collisions the kinds of traffic. Intervals of agents hold both seeds and
episodes (bootstrap over both), those of drivers episodes (Wilson). Runs are kept in --out and taken
up where they are.

`--check` exits 1 where one of these does not hold: the operator succeeds in .85 of every cell; the
agent of all conditions beats the planner over all conditions; nominal-only agents are worse in
wheel slip, in blocked aisles and in near collisions, with intervals apart; no condition is trivial
(random driving above .1) or hopeless (nobody but the operator above .3).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from drivers import drive
from harness import finish, markdown, mean_interval, option_parser
from numpy.typing import NDArray
from twin_runs import trained

from restock.stats import percentiles, wilson
from restock.train.evaluation.policies import load_agent
from restock.train.run.run import Run
from restock.train.twin.env.drivers import Operator, PlannerFollower, RandomPolicy
from restock.train.twin.env.interface import Policy
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import PEOPLE
from restock.train.twin.missions import KINDS
from restock.train.twin.physics.episode import Episode, EpisodeSpec, draw_episode

FIRST_SEED = 500_000
AGENTS: dict[str, list[str]] = {
    "agent, all conditions": [
        "env.conditions={nominal=0.15, wheel_slip=0.3, blocked_aisle=0.2, near_collision=0.35}"
    ],
    "agent, nominal only": ["env.conditions={nominal=1.0}"],
}
SETTINGS = [
    "evaluation.every_env_steps=20000",
    "record.trackers=[]",
]
BANDS = (0.02, 0.025, 0.03, 0.045)
RESAMPLES = 2000


def cell_of(episode: Episode) -> str:
    """Return the finest cell of the table that an episode belongs to."""
    kind = episode.spec.condition
    if kind == "wheel_slip":
        friction = episode.patches[episode.patches[:, 2] > 0, 4].min()
        band = int(np.clip(np.searchsorted(BANDS, friction) - 1, 0, len(BANDS) - 2))
        return f"wheel slip, friction {BANDS[band]:.3f} to {BANDS[band + 1]:.3f}"
    if kind == "blocked_aisle":
        return f"blocked aisle, {'partly' if episode.block == 'partial' else 'wholly'}"
    if kind == "near_collision":
        walks = [walk for walk in episode.walks if walk is not None]
        if episode.walks[PEOPLE] is not None:
            return "near collision, with a forklift"
        careless = any(not walk.attentive for walk in walks)
        return f"near collision, {'careless' if careless else 'attentive'} people"
    return kind


def fixed(per_cell: int) -> list[tuple[EpisodeSpec, str]]:
    """`per_cell` episodes of every cell, the same always; each with its cell."""
    env = WarehouseVectorEnv(1)
    episodes: list[tuple[EpisodeSpec, str]] = []
    cells = {"nominal": 1, "wheel_slip": 3, "blocked_aisle": 2, "near_collision": 3}
    for kind in KINDS:
        count: dict[str, int] = {}
        seed = FIRST_SEED
        while len(count) < cells[kind] or min(count.values()) < per_cell:
            spec = EpisodeSpec(kind, seed)
            cell = cell_of(draw_episode(spec, env.floors[0], env.navigation.planners[0]))
            if count.get(cell, 0) < per_cell:
                episodes.append((spec, cell))
            count[cell] = count.get(cell, 0) + 1
            seed += 1
    return episodes


def train(out: Path, agent: str, seed: int, env_steps: int) -> Path:
    """Train the run of an agent and a seed, trained where it is not there or not at its end."""
    settings = [*AGENTS[agent], *SETTINGS, f"schedule.env_steps={env_steps}", f"seed={seed}"]
    return trained(out / f"{agent.replace(', ', '-').replace(' ', '_')}-{seed}", settings).path


def outcomes(policy: Policy, episodes: list[tuple[EpisodeSpec, str]]) -> NDArray[np.float64]:
    """(E, 3): success, whether anything was touched, seconds."""
    results = drive(policy, [spec for spec, _ in episodes])
    return np.array([(r.success, r.bumps > 0, r.time_s) for r in results], np.float64)


def interval(values: NDArray[np.float64], rng: np.random.Generator) -> tuple[float, float]:
    """95 % of the mean of (runs, episodes) of 0 and 1."""
    if len(values) == 1:
        return wilson(int(values.sum()), values.size)
    return mean_interval(values, rng, RESAMPLES)


def groups(cells: list[str]) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """Every condition and every cell, with its episodes."""
    names = np.array(cells)
    conditions = np.array([name.split(",")[0].replace(" ", "_") for name in cells])
    for condition in KINDS:
        yield condition, np.flatnonzero(conditions == condition)
        inner = sorted(set(names[conditions == condition]))
        if len(inner) > 1:
            yield from ((name, np.flatnonzero(names == name)) for name in inner)


def overall(values: NDArray[np.float64], parts: list[NDArray[np.int64]]) -> NDArray[np.float64]:
    """Mean success with every condition worth the same, of (runs, episodes): (runs,)."""
    return np.asarray(np.mean([values[:, ids].mean(axis=1) for ids in parts], axis=0))


def misses(rows: list[dict[str, Any]]) -> list[str]:
    """Return what of `--check` does not hold."""
    at = {(row["driver"], row["cell"]): row for row in rows}
    cells = list(dict.fromkeys(row["cell"] for row in rows if row["cell"] != "overall"))
    every, nominal = AGENTS
    missed = [
        f"the operator succeeds in {at['operator', cell]['success']:.2f} of {cell}"
        for cell in cells
        if at["operator", cell]["success"] < 0.85
    ]
    if at[every, "overall"]["low"] <= at["planner", "overall"]["high"]:
        missed.append("the agent of all conditions does not beat the planner overall")
    for cell in ("wheel_slip", "blocked_aisle", "near_collision"):
        if at[nominal, cell]["high"] >= at[every, cell]["low"]:
            missed.append(f"nominal-only training is not clearly worse in {cell}")
    for cell in cells:
        if at["random", cell]["success"] > 0.1:
            missed.append(f"{cell} is trivial")
        if max(at[name, cell]["success"] for name in ("planner", *AGENTS)) < 0.3:
            missed.append(f"{cell} is hopeless")
    return missed


def main() -> int:
    parser = option_parser(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="where the runs go")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--env-steps", type=int, default=480_000)
    parser.add_argument("--episodes", type=int, default=300, help="of each cell")
    parser.add_argument("--workers", type=int, default=1, help="runs at a time")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        jobs = {
            (agent, seed): pool.submit(train, options.out, agent, seed, options.env_steps)
            for seed in range(options.seeds)
            for agent in AGENTS
        }
        runs = {job: future.result() for job, future in jobs.items()}
    episodes = fixed(options.episodes)
    values: dict[str, NDArray[np.float64]] = {}
    for name, policy in (
        ("random", RandomPolicy()),
        ("planner", PlannerFollower()),
        ("operator", Operator()),
    ):
        values[name] = outcomes(policy, episodes)[None]
    for agent in AGENTS:
        trained = [runs[agent, seed] for seed in range(options.seeds)]
        values[agent] = np.stack([outcomes(load_agent(Run.open(run)), episodes) for run in trained])
    rows = table(values, [cell for _, cell in episodes])
    pq.write_table(pa.Table.from_pylist(rows), options.out / "worth_training.parquet")
    return finish(options, rows, misses(rows), [as_markdown(rows)])


def table(values: dict[str, NDArray[np.float64]], cells: list[str]) -> list[dict[str, Any]]:
    """Return one row per driver and cell of `values` (runs, episodes, 3)."""
    rng = np.random.default_rng(0)
    rows = []
    parts = list(groups(cells))
    conditions = [ids for name, ids in parts if name in KINDS]
    for driver, measured in values.items():
        for cell, ids in parts:
            success = measured[:, ids, 0]
            low, high = interval(success, rng)
            rows.append(
                {
                    "driver": driver,
                    "cell": cell,
                    "episodes": len(ids),
                    "runs": len(measured),
                    "success": float(success.mean()),
                    "low": low,
                    "high": high,
                    "touched": float(measured[:, ids, 1].mean()),
                    "seconds": float(measured[:, ids, 2].mean()),
                }
            )
        draws = []
        for _ in range(RESAMPLES):
            runs = rng.integers(len(measured), size=len(measured))
            drawn = [ids[rng.integers(len(ids), size=len(ids))] for ids in conditions]
            draws.append(overall(measured[runs, :, 0], drawn).mean())
        low, high = percentiles(np.array(draws))
        rows.append(
            {
                "driver": driver,
                "cell": "overall",
                "episodes": len(cells),
                "runs": len(measured),
                "success": float(overall(measured[..., 0], conditions).mean()),
                "low": low,
                "high": high,
                "touched": float(overall(measured[..., 1], conditions).mean()),
                "seconds": float(overall(measured[..., 2], conditions).mean()),
            }
        )
    return rows


def as_markdown(rows: list[dict[str, Any]]) -> str:
    """Return the docs' table: success with its interval, and the share that touched something."""
    drivers = list(dict.fromkeys(row["driver"] for row in rows))
    at = {(row["driver"], row["cell"]): row for row in rows}
    texts = {
        key: f"{m['success']:.2f} [{m['low']:.2f}, {m['high']:.2f}], {m['touched']:.2f}"
        for key, m in at.items()
    }
    cells = dict.fromkeys(row["cell"] for row in rows)
    return markdown(
        ["success [95 %], touched", *drivers],
        [[cell.replace("_", " "), *(texts[name, cell] for name in drivers)] for cell in cells],
    )


if __name__ == "__main__":
    sys.exit(main())
