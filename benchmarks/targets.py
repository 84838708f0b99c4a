"""Is the default recipe's policy worth driving? Its targets, on episodes that chose nothing.

    python benchmarks/targets.py --out DIR [--budget NAME] [--teacher NAME] [--seeds 5] [--check]
                                 [--profile PATH]

`restock train` on the sample logs with mixture `coverage`, practice by success and the twin's
teacher, once a seed; a budget is a number of environment steps. Beside each, a run of the same seed
is fed uniformly (mixture `uniform`). The policy that each run kept drives, beside planner and
operator, the same `--episodes` of each kind as they are; from ten minutes on, those fed by quotas
also drive 60 of each under every perturbation, and 100 of each on floors that no run saw.
With `--teacher planner` nobody but the planner teaches: runs are fed by quotas alone, and drive the
missions as they are, from a seed on that chose nothing (the margin was chosen on the first 100 of
the others). With Q constant such a policy is the planner, so what it is ahead by is Q's. Its hour
is spent on the runs of ten minutes: the mean of their policies drives (`restock export --to run`).
With `--profile` the logs are ingested by that profile, as one with `tracks`; runs are fed by quotas
alone, drive the missions as they are, and spend their hour in the same way.

Intervals of the agent draw seeds and episodes again (five seeds: a little too narrow), those of
planner and operator are Wilson's. "Ahead" is paired by episode, and by seed of the run fed
uniformly. What is done is not done again; `--check` exits 1 where a target of the budget is missed.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
from harness import finish, markdown, mean_interval, once, option_parser, run_restock
from numpy.typing import NDArray
from twin_runs import trained

from restock.stats import interval_text, wilson
from restock.train.evaluation.policies import load_agent, write_mean
from restock.train.run.run import Run

LOGS = Path(__file__).parent.parent / "sample_logs"
BUDGETS = {"demo": 48_000, "three-minutes": 128_000, "ten-minutes": 288_000, "hour": 1_800_000}
SETTINGS = ["practice.rule=success", "record.trackers=[]", "evaluation.episodes=20"]
PERTURBATIONS = "friction,latency,payload,wheels,sensors"
UNSEEN = "unseen floors"
RARELY_AND_WELL = ["evaluation.every_env_steps=48000", "evaluation.episodes=50"]
UNCHOSEN = "40000"  # seed of the first mission of those that the planner taught
REFERENCES = ("planner", "operator")
CELLS = {  # of the table: name -> condition and block
    "nominal": ("nominal", "none"),
    "wheel slip": ("wheel_slip", "none"),
    "partly blocked": ("blocked_aisle", "partial"),
    "wholly blocked": ("blocked_aisle", "full"),
    "near collision": ("near_collision", "none"),
}
RARE = ("wheel_slip", "blocked_aisle", "near_collision")
RESAMPLES = 2000
EPISODES = """
    SELECT condition, block, episode_seed, layout, success::DOUBLE AS success, bumps, distance_m, time_s
    FROM read_parquet(?) WHERE policy = ? AND perturbation = ? AND (layouts LIKE 'generated%') = ?
    ORDER BY condition, episode_seed, layout
"""  # noqa: E501


def main() -> int:
    parser = option_parser(__doc__, "200 updates, 2,000 steps, 4 episodes: it shows that all runs")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--budget", choices=BUDGETS, default="ten-minutes")
    parser.add_argument("--teacher", choices=("operator", "planner"), default="operator")
    parser.add_argument("--profile", help="of the sample logs; default: warehouse_amr")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=300, help="of each kind, as they are")
    options = parser.parse_args()
    few = (4, 4, 4) if options.quick else (options.episodes, 60, 100)
    alone = options.teacher == "planner"
    paired = not alone and options.profile is None
    mean = not paired and options.budget == "hour"
    budget = "ten-minutes" if mean else options.budget
    steps = BUDGETS[budget]
    if alone:  # nobody is queried, so as long a time has a third more steps
        steps = steps * 4 // 3
    settings = [*SETTINGS, f"schedule.env_steps={steps}"]
    if alone:
        settings += ["teacher.source=planner", *RARELY_AND_WELL]
    if options.quick:
        settings += ["schedule.env_steps=2000", "schedule.offline_updates=200"]
        settings += ["evaluation.every_env_steps=1000", "evaluation.episodes=2"]
    first = ("--seed", UNCHOSEN) if alone else ()
    name = ("planner-" if alone else "") + ("quick" if options.quick else budget)
    runs: dict[str, list[Path]] = {"coverage": []}
    if paired:
        runs["uniform"] = []
    further = paired and BUDGETS[options.budget] >= BUDGETS["ten-minutes"]
    for seed, mixture in itertools.product(range(options.seeds), runs):
        path = options.out / f"{name}-{'' if mixture == 'coverage' else 'uniform-'}{seed}"
        there, began = (path / "done").exists(), (time.process_time(), time.monotonic())
        trained(path, [*settings, f"seed={seed}"], _panel(options, mixture))
        if not there:
            spent = time.process_time() - began[0], time.monotonic() - began[1]
            print(f"{path.name}: {spent[0]:.0f} s of CPU in {spent[1]:.0f} s", file=sys.stderr)
        runs[mixture].append(path)
        if mean:
            continue
        references = REFERENCES if (seed, mixture) == (0, "coverage") else ()
        _judge(
            path,
            few,
            ["agent", *references],
            *first,
            further=further and mixture == "coverage",
        )
    if mean:
        path = options.out / f"{name}-mean"
        made = [load_agent(Run.open(run)).version for run in runs["coverage"]]
        once(path / "made", made, partial(write_mean, runs["coverage"], path))
        _judge(path, few, ["agent", *REFERENCES], *first, further=False)
        runs["coverage"] = [path]
    twins = ["none"]
    if further:
        twins += [*PERTURBATIONS.split(","), UNSEEN]
    rows = _table(runs["coverage"], runs.get("uniform", []), twins)
    missed = (_missed_alone if alone else _missed)(rows, options.budget)
    return finish(options, rows, missed, [_as_markdown(rows)])


def _panel(options: argparse.Namespace, mixture: str) -> Path:
    out: Path = options.out
    store, panel = out / "store", out / ("panel" if mixture == "coverage" else mixture)
    words = [
        "ingest",
        str(LOGS),
        "--store",
        str(store),
        "--profile",
        options.profile or "warehouse_amr",
    ]
    run_restock(words)  # skips what it has
    if not panel.exists():
        run_restock(["mix", str(store), "--mixture", mixture, "--out", str(panel)])
    return panel


def _judge(
    run: Path, episodes: tuple[int, int, int], policies: Sequence[str], *more: str, further: bool
) -> None:
    clean, perturbed, unseen = episodes
    _drive(run, "clean", policies, clean, "none", *more)
    if further:
        _drive(run, "perturbed", policies, perturbed, PERTURBATIONS)
        _drive(run, "unseen", policies, unseen, "none", "--layouts", "generated:test")


def _drive(
    run: Path, mark: str, policies: Sequence[str], episodes: int, perturbations: str, *more: str
) -> None:
    words = ["eval", str(run), "--policies", ",".join(policies), "--perturbations", perturbations]
    words += ["--episodes", str(episodes), *more]
    once(run / f"judged-{mark}", words[2:], partial(run_restock, words))


def _table(
    runs: Sequence[Path], uniform: Sequence[Path], settings: Sequence[str]
) -> list[dict[str, Any]]:
    """Return a row for each cell, and for rare conditions and all of them, of each setting."""
    rng = np.random.default_rng(0)
    rows = []
    for setting in settings:
        drives = {"agent": [_episodes(run, "agent", setting) for run in runs]}
        drives |= {name: [_episodes(runs[0], name, setting)] for name in REFERENCES}
        if setting == "none" and uniform:
            drives["fed_uniformly"] = [_episodes(run, "agent", setting) for run in uniform]
        first = drives["planner"][0]
        parts = {
            cell: np.flatnonzero((first["condition"] == condition) & (first["block"] == block))
            for cell, (condition, block) in CELLS.items()
        }
        conditions = {name: np.flatnonzero(first["condition"] == name) for name in RARE}
        for cell, ids in parts.items():
            rows.append(_row(drives, setting, cell, [ids], rng))
        rows.append(_row(drives, setting, "rare", list(conditions.values()), rng))
    return rows


def _episodes(run: Path, policy: str, setting: str) -> dict[str, NDArray[Any]]:
    unseen = setting == UNSEEN
    path = str(run / "eval" / "episodes.parquet")
    values = [path, policy, "none" if unseen else setting, unseen]
    return dict(duckdb.execute(EPISODES, values).fetchnumpy())


def _row(
    drives: dict[str, list[dict[str, NDArray[Any]]]],
    setting: str,
    cell: str,
    parts: list[NDArray[np.intp]],
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Return one cell, or the mean of several conditions with equal weights."""
    ids = np.concatenate(parts)
    weights = np.concatenate([np.full(len(p), len(ids) / len(parts) / len(p)) for p in parts])
    row: dict[str, Any] = {"setting": setting, "cell": cell, "episodes": len(ids)}
    success = {}
    for name, of in drives.items():
        values = np.stack([drive["success"][ids] for drive in of]) * weights
        success[name] = values
        row[name] = float(values.mean())
        if name in ("agent", "fed_uniformly"):
            row[f"{name}_interval"] = mean_interval(values, rng, RESAMPLES)
        elif len(parts) == 1:
            row[f"{name}_interval"] = wilson(int(values.sum()), values.size)
        row[f"{name}_bumps_per_km"] = 1e3 * float(
            sum(drive["bumps"][ids].sum() for drive in of)
            / sum(drive["distance_m"][ids].sum() for drive in of)
        )
    for name in [name for name in drives if name != "agent"]:  # in order: they share `rng`
        ahead = success["agent"] - success[name]
        row[f"ahead_of_{name}"] = float(ahead.mean())
        row[f"ahead_of_{name}_interval"] = mean_interval(ahead, rng, RESAMPLES)
    for name in REFERENCES:
        row[f"seconds_less_than_{name}"] = _faster(drives, name, ids)
    return row


def _faster(
    drives: dict[str, list[dict[str, NDArray[Any]]]], name: str, ids: NDArray[np.intp]
) -> float:
    """Mean seconds that the agent takes less, over missions in which both succeed."""
    other = drives[name][0]
    gained = []
    for drive in drives["agent"]:
        both = ids[(drive["success"][ids] > 0) & (other["success"][ids] > 0)]
        gained.append(other["time_s"][both] - drive["time_s"][both])
    every = np.concatenate(gained)
    return float(every.mean()) if len(every) else float("nan")


def _missed_alone(rows: Sequence[dict[str, Any]], budget: str) -> list[str]:
    """Return the missed targets of a policy that only the planner taught."""
    at = {row["cell"]: row for row in rows}
    missed = []
    if budget in (least := {"ten-minutes": 0.80, "hour": 0.88}):
        if at["rare"]["agent"] < least[budget]:
            missed.append(f"rare success {at['rare']['agent']:.3f} (at least {least[budget]})")
        if at["partly blocked"]["agent"] < 0.6:
            missed.append(f"partly blocked: {at['partly blocked']['agent']:.3f} (at least 0.6)")
        if at["rare"]["ahead_of_planner"] < 0.1:
            missed.append(f"Q is worth {at['rare']['ahead_of_planner']:.3f} (at least 0.1)")
    for cell in CELLS:
        if at[cell]["ahead_of_planner_interval"][1] < 0:
            missed.append(f"{cell}: below the planner by {-at[cell]['ahead_of_planner']:.3f}")
    return missed


def _missed(rows: Sequence[dict[str, Any]], budget: str) -> list[str]:
    """Return the targets of a budget that are missed, on the episodes as they are."""
    at = {row["cell"]: row for row in rows if row["setting"] == "none"}
    missed = []
    least = {"three-minutes": 0.8, "ten-minutes": 0.9, "hour": 0.95}.get(budget)
    if least is not None and at["rare"]["agent"] < least:
        missed.append(f"rare success {at['rare']['agent']:.3f} (at least {least})")
    for cell in CELLS:
        if at[cell]["ahead_of_planner_interval"][1] < 0:
            missed.append(f"{cell}: below the planner by {-at[cell]['ahead_of_planner']:.3f}")
        if budget == "hour" and at[cell]["agent"] < 0.92:
            missed.append(f"{cell}: {at[cell]['agent']:.3f} (at least 0.92)")
    if budget == "ten-minutes" and at["rare"]["ahead_of_planner"] < 0.15:
        missed.append(f"ahead of the planner by {at['rare']['ahead_of_planner']:.3f} (0.15)")
    if budget == "hour":
        if at["rare"]["agent_bumps_per_km"] > 2 * at["rare"]["operator_bumps_per_km"]:
            missed.append("more than twice the operator's bumps per km")
        if at["rare"]["seconds_less_than_operator"] < 0:
            missed.append("slower than the operator")
    return missed


def _as_markdown(rows: Sequence[dict[str, Any]]) -> str:
    def success(row: dict[str, Any], name: str) -> str:
        low, high = row.get(f"{name}_interval", (None, None))
        return interval_text(row[name], low, high)

    lines = [
        [
            "as it is" if row["setting"] == "none" else row["setting"],
            row["cell"],
            row["episodes"],
            *(success(row, name) for name in ("agent", *REFERENCES)),
            success(row, "fed_uniformly") if "fed_uniformly" in row else "",
            interval_text(
                row["ahead_of_fed_uniformly"], *row["ahead_of_fed_uniformly_interval"], "+.2f"
            )
            if "fed_uniformly" in row
            else "",
            interval_text(row["ahead_of_planner"], ahead[0], ahead[1], "+.2f"),
            "{:.1f}, {:.1f}, {:.1f}".format(
                *(row[f"{name}_bumps_per_km"] for name in ("agent", *REFERENCES))
            ),
            *(
                "it never does" if np.isnan(less) else f"{less:+.1f}"
                for less in (row[f"seconds_less_than_{name}"] for name in REFERENCES)
            ),
        ]
        for row in rows
        for ahead in [row["ahead_of_planner_interval"]]
    ]
    header = ["twin", "cell", "episodes", "agent", *REFERENCES, "fed uniformly", "ahead of it"]
    header += ["ahead of the planner"]
    header += ["bumps per km: agent, planner, operator"]
    return markdown([*header, "s less than planner", "than operator"], lines)


if __name__ == "__main__":
    sys.exit(main())
