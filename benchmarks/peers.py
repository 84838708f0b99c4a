"""Peers, fairly: DQNs of other libraries and Restock's at equal CPU time, on the same missions.

    python benchmarks/peers.py --out DIR [--cpu-seconds 240] [--seeds 5] [--missions 300]
    python benchmarks/peers.py --out DIR --quick           # minutes: shows only that it runs

Stable-Baselines3, Tianshou (each where it is installed) and CleanRL's DQN in one file, by the
examples in docs/examples as they are: network, learning rate, batch, discount, ring, exploration,
updates per step and target are those of `restock train`, as far as each can follow; each example
says what it lacks. Each runs without logs and, but for Tianshou's, with the sample logs in its
buffer, of which it then learns first, too. Restock's default recipe has the same logs and no
teacher, the navigation stack's planner or the twin's operator. The logs are one panel for all:
`coverage`, without a limit on draws.

A run is a process with one thread that ends after so many CPU seconds, its imports not counted.
Nobody chooses a policy on the way: the last one drives `--missions` of each kind that nobody
trained in, the same ones for all. Intervals draw seeds and missions again (of few seeds: too
narrow). Runs go seed by seed, and what is done is not done again.
"""

from __future__ import annotations

import importlib.util
import json
import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import numpy as np
from harness import finish, markdown, mean_interval, option_parser, run_restock
from numpy.typing import NDArray

from restock.files import write_text
from restock.stats import interval_text

ROOT = Path(__file__).parent.parent
LIBRARIES = {  # example: distribution, name of what learns in its `main`, its Q of observations
    "cleanrl_dqn": ("torch", "q_network", lambda made: made),
    "sb3_dqn": ("stable_baselines3", "model", lambda made: made.q_net),
    "sb3_mixture": ("stable_baselines3", "model", lambda made: made.q_net),
    "tianshou_dqn": ("tianshou", "policy", lambda made: lambda seen: made.model(seen)[0]),
}
ARMS: dict[str, tuple[str, bool]] = {  # example, or Restock's teacher; whether with logs
    "CleanRL": ("cleanrl_dqn", False),
    "Stable-Baselines3": ("sb3_dqn", False),
    "Tianshou": ("tianshou_dqn", False),
    "CleanRL, logs": ("cleanrl_dqn", True),
    "Stable-Baselines3, logs": ("sb3_mixture", True),
    "Restock, no teacher": ("none", True),
    "Restock, planner": ("planner", True),
    "Restock, operator": ("operator", True),
}
ENDLESS = 10_000_000  # environment steps: the time ends first
FIRST_SEED = 70_000
RARE = ("wheel_slip", "blocked_aisle", "near_collision")
CELLS = ("nominal", "wheel_slip", "blocked_aisle partial", "blocked_aisle full", "near_collision")
MIXTURE = """
[[strata]]
name = "nominal"
unit = "episode"
share = 0.4
[each_condition]
unit = "episode"
share = "equal"
"""


class TimeIsUp(BaseException):
    """The CPU time of a run is spent."""


class Greedy:
    """Always the best action by a Q of observations, (N, D) to (N, A)."""

    name, version = "peer", ""

    def __init__(self, q: Callable[[Any], Any]) -> None:
        self.q = q

    def act(self, env: Any, observation: NDArray[np.float32]) -> tuple[Any, Any]:
        import torch

        with torch.no_grad():
            action = self.q(torch.from_numpy(observation)).argmax(1).numpy()
        return action, np.ones(len(action), np.float32)


def main() -> int:
    if sys.argv[1:2] == ["--child"]:
        return child(*sys.argv[2:])
    parser = option_parser(__doc__, quick="30 CPU seconds, two missions of each kind, one seed")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cpu-seconds", type=int, default=240)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--missions", type=int, default=300, help="of each kind")
    options = parser.parse_args()
    seconds, seeds, missions = options.cpu_seconds, options.seeds, options.missions
    if options.quick:
        seconds, seeds, missions = 30, 1, 2
    out: Path = options.out / f"{seconds}s-{missions}"
    panel = logs(out)
    arms = {
        arm: (source, with_logs)
        for arm, (source, with_logs) in ARMS.items()
        if source not in LIBRARIES or importlib.util.find_spec(LIBRARIES[source][0])
    }
    for seed in range(seeds):
        for arm, (source, with_logs) in arms.items():
            result = run_file(out, arm, seed)
            if not result.exists():
                print(f"seed {seed}: {arm}", file=sys.stderr, flush=True)
                words = [source, str(panel) if with_logs else "", str(seed), str(seconds)]
                command = [sys.executable, __file__, "--child", *words, str(missions), str(result)]
                with result.with_suffix(".log").open("w", encoding="utf-8") as log:
                    subprocess.run(
                        command, check=True, stdout=log, stderr=log, env=os.environ | ONE_THREAD
                    )
    for name in ("planner", "operator"):
        if not run_file(out, name, 0).exists():
            driven(name, None, missions, run_file(out, name, 0), {})
    rows = table(out, arms, seeds)
    left_out = [f"{arm}: not installed, left out" for arm in ARMS if arm not in arms]
    return finish(options, rows, [], [as_markdown(rows), *left_out])


ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


def logs(out: Path) -> Path:
    """Return the panel of the sample logs, made if it is not there."""
    store, panel, mixture = out / "store", out / "panel", out / "mixture.toml"
    if not panel.exists():
        out.mkdir(parents=True, exist_ok=True)
        write_text(mixture, MIXTURE)
        run_restock(["ingest", str(ROOT / "sample_logs"), "--store", str(store)])
        run_restock(["mix", str(store), "--mixture", str(mixture), "--out", str(panel)])
    return panel


def run_file(out: Path, arm: str, seed: int) -> Path:
    return out / f"{arm.replace(', ', '-').replace(' ', '_')}-{seed}.json"


def child(source: str, panel: str, seed: str, seconds: str, missions: str, result: str) -> int:
    """Train one run until its CPU time is spent, then drive with what it learnt."""
    import torch

    torch.set_num_threads(1)
    learn = library if source in LIBRARIES else restock_run
    folder = Path(result).with_suffix("")
    policy, learnt = learn(source, panel, int(seed), int(seconds), folder)
    driven("agent", policy, int(missions), Path(result), learnt)
    return 0


def library(
    source: str, panel: str, seed: int, seconds: int, folder: Path
) -> tuple[Any, dict[str, Any]]:
    """Run an example's `main` until its time is up, and take what learns out of its frame."""
    spec = importlib.util.spec_from_file_location(source, ROOT / f"docs/examples/{source}.py")
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    given: dict[str, Any] = {"steps": ENDLESS, "seed": seed}
    given |= {"panel": panel} if panel else {}
    if panel and source != "cleanrl_dqn":
        given["run"] = str(folder)
    spec.loader.exec_module(example)
    began = time.process_time()
    end_after(seconds, time_is_up)
    try:
        example.main(**given)
    except TimeIsUp as up:
        spent = time.process_time() - began
        frames = [frame.f_locals for frame, _ in traceback.walk_tb(up.__traceback__)]
    _, name, q_of = LIBRARIES[source]
    local = next((one for one in frames if name in one), None)
    if local is None:
        raise SystemExit(f"{source}: {seconds} s of CPU are over before it has begun: give more")
    return Greedy(q_of(local[name])), {"cpu_s": spent, **counted(local)}


def counted(local: dict[str, Any]) -> dict[str, int]:
    """Return the steps and updates that an example had made, of the names in its `main`."""
    if "model" in local:
        return {"env_steps": local["model"].num_timesteps, "updates": local["model"]._n_updates}
    if "policy" in local:
        steps = getattr(local.get("collector"), "collect_step", 0)
        return {"env_steps": steps, "updates": getattr(local.get("algorithm"), "_iter", 0)}
    return {"env_steps": local.get("step", 0), "updates": local.get("updates", 0)}


def restock_run(
    teacher: str, panel: str, seed: int, seconds: int, folder: Path
) -> tuple[Any, dict[str, Any]]:
    """Train by the default recipe until the time is up, which is what Ctrl-C does."""
    from restock.cli import main as restock
    from restock.train import Run
    from restock.train.evaluation.policies import load_agent
    from restock.train.run.run import run_clocks

    settings = [f"teacher.source={teacher}", f"schedule.env_steps={ENDLESS}", f"seed={seed}"]
    settings += [f"evaluation.every_env_steps={ENDLESS}", "record.trackers=[]"]
    settings += ["evaluation.episodes=1"]  # after the offline updates
    words = [word for setting in settings for word in ("--set", setting)]
    importlib.import_module("restock.train.loop")  # as the examples' imports, not counted
    began = time.process_time()
    end_after(seconds, lambda: signal.raise_signal(signal.SIGINT))
    restock(["train", "--panel", panel, "--out", str(folder), *words])
    spent, run = time.process_time() - began, Run.open(folder)
    clocks = run_clocks(run)
    made = {"env_steps": clocks["env_steps"], "updates": clocks["gradient_steps"]}
    return load_agent(run), {"cpu_s": spent, **made}


def end_after(seconds: int, over: Callable[[], object]) -> None:
    """Call `over` once, when this process has spent so many CPU seconds from now on."""
    end, hard = time.process_time() + seconds, resource.getrlimit(resource.RLIMIT_CPU)[1]
    soft = round(end)

    def up(number: int, frame: FrameType | None) -> None:
        nonlocal soft
        spent = time.process_time() >= end  # the kernel counts ticks, some percent too many
        soft = hard if spent else soft + 1
        resource.setrlimit(resource.RLIMIT_CPU, (soft, hard))
        if spent:
            over()

    signal.signal(signal.SIGXCPU, up)
    resource.setrlimit(resource.RLIMIT_CPU, (soft, hard))


def time_is_up() -> NoReturn:
    raise TimeIsUp


def driven(name: str, policy: Any, missions: int, result: Path, learnt: dict[str, Any]) -> None:
    """Drive the missions, and keep each one's success."""
    from twin_runs import drive_missions

    from restock.train.twin.env.drivers import Operator, PlannerFollower
    from restock.train.twin.missions import KINDS

    driver = {"planner": PlannerFollower, "operator": Operator}.get(name, lambda: policy)()
    episodes = drive_missions(driver, KINDS, missions, FIRST_SEED)
    success: dict[str, list[bool]] = {}
    for one in sorted(episodes, key=lambda one: one.episode_seed):
        cell = one.condition + ("" if one.block == "none" else f" {one.block}")
        success.setdefault(cell, []).append(bool(one.success))
    write_text(result, json.dumps({**learnt, "success": success}) + "\n")


def table(out: Path, arms: dict[str, Any], seeds: int) -> list[dict[str, Any]]:
    """Return a row for each arm and scripted driver: success by cell, rare success, clocks."""
    rng, rows = np.random.default_rng(0), []
    for arm in (*arms, "planner", "operator"):
        count = seeds if arm in arms else 1
        runs = [json.loads(run_file(out, arm, seed).read_text()) for seed in range(count)]
        row: dict[str, Any] = {"arm": arm, "seeds": count if arm in arms else None}
        cells = {
            cell: np.array([run["success"][cell] for run in runs], np.float64)
            for cell in CELLS
            if cell in runs[0]["success"]
        }
        for cell, values in cells.items():
            row[cell] = [float(values.mean()), *mean_interval(values, rng, 2000)]
        kinds = [[v for cell, v in cells.items() if cell.startswith(kind)] for kind in RARE]
        weighed = [v / v.shape[1] / len(kind) / len(RARE) for kind in kinds for v in kind]
        rare = np.concatenate(weighed, axis=1)
        ends = mean_interval(rare * rare.shape[1], rng, 2000)
        row["rare"] = [float(rare.sum(axis=1).mean()), *ends]
        for clock in ("cpu_s", "env_steps", "updates"):
            if clock in runs[0]:
                row[clock] = float(np.mean([run[clock] for run in runs]))
        rows.append(row)
    return rows


def as_markdown(rows: list[dict[str, Any]]) -> str:
    cells = [cell for cell in CELLS if cell in rows[0]]
    header = ["arm", "seeds", "rare", *cells, "CPU s", "steps", "updates"]
    return markdown(
        [name.replace("_", " ") for name in header],
        [
            [row["arm"], row["seeds"] or ""]
            + [interval_text(*row[cell]) for cell in ("rare", *cells)]
            + [f"{row[c]:,.0f}" if c in row else "" for c in ("cpu_s", "env_steps", "updates")]
            for row in rows
        ],
    )


if __name__ == "__main__":
    sys.exit(main())
