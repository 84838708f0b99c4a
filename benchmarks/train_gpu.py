"""How long one update takes on a GPU, beside Stable-Baselines3 on the same device.

    python benchmarks/train_gpu.py [--device cuda] [--quick] [--json] [--check] [--runs]

Equal network (2 x 256 ReLU), equal batch (256 and 1,024), Adam, plain DQN targets, sampling from a
full buffer of 50,000 rows included: Stable-Baselines3 with its own defaults, and with Restock's
settings (a Polyak pull at every update, fused Adam: `_equal`). Restock as `restock train --device
cuda` makes its updates: drawn and recorded by the host in blocks, made by a CUDA graph. Beside it
the same without the graph (`_launched`), and the default (double DQN, LayerNorm, half of the batch
from logs by quotas) without and with its record. Figures are wall time, the device waited for at
the end of each round.

`--runs` times whole runs of the default recipe instead, without logs, on the CPU and on the device:
with more updates, and with a wide network and large batches. It shows where a GPU pays.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import finish, in_turns, medians, option_parser
from own_updates import Restock, config
from train_peers import Arrays, Updates, data, stable_baselines3

from restock.train import train
from restock.train.dqn.config import TrainConfig
from restock.train.run.run import Run

WARM_UP = 256  # environment steps before a run's first update
TARGET = 5.0  # times Stable-Baselines3, at either batch
BATCHES = (256, 1024)
WIDE = ["network.hidden=[1024,1024]", "replay.batch_size=1024"]
# Whole runs: settings beside the default's, and environment steps after the warm-up.
RUNS: dict[str, tuple[list[str], int]] = {
    "default": ([], 6_000),
    "an update per step": (["schedule.updates_per_env_step=1"], 6_000),
    "two updates per step": (["schedule.updates_per_env_step=2"], 6_000),
    "2 x 1,024 units, batch 1,024": (WIDE, 2_000),
}


def _plain(batch: int, device: str) -> TrainConfig:
    network, loss = {"layer_norm": False}, {"double": False}
    return config(batch, device=device, network=network, loss=loss)


def us_of(run: Updates, updates: int, device: str) -> float:
    """Microseconds of one update, by the clock."""
    began = time.perf_counter()
    run(updates)
    if device == "cuda":
        torch.cuda.synchronize()
    return (time.perf_counter() - began) / updates * 1e6


def measured(
    batch: int, arrays: Arrays, device: str, rounds: int, updates: int, folder: Path
) -> dict[str, float]:
    """Microseconds of one update of each contender."""
    plain, default = _plain(batch, device), config(batch, device=device)
    run = Run.create(folder / str(batch), {})
    contenders: dict[str, Updates | None] = {
        "stable_baselines3": stable_baselines3(batch, arrays, device=device),
        "stable_baselines3_equal": stable_baselines3(batch, arrays, equal=True, device=device),
        "restock": Restock(plain, arrays, blocks=True),
        "restock_launched": Restock(plain, arrays),
        "restock_default": Restock(default, arrays, logs=True, blocks=True),
        "restock_default_recorded": Restock(default, arrays, logs=True, blocks=True, run=run),
    }
    timed = {
        name: partial(us_of, contender, updates, device)
        for name, contender in contenders.items()
        if contender is not None
    }
    in_turns(timed, 2)  # warm
    return medians(in_turns(timed, rounds))


def seconds_of_runs(device: str, part: float, folder: Path) -> dict[str, dict[str, float]]:
    """Seconds per 1,000 environment steps of whole runs, by what they set and where they learn.

    Each run is made for its warm-up alone, too, and that is subtracted: processes, environments
    and graphs are made once, whatever a run's length.
    """
    found: dict[str, dict[str, float]] = {}
    for name, (settings, steps) in RUNS.items():
        found[name] = {}
        for place in ("cpu", device) if device != "cpu" else ("cpu",):
            took = []
            for number, length in enumerate((64, int(steps * part))):
                began = time.perf_counter()
                train(
                    out=folder / f"{len(found)}-{place}-{number}",
                    settings=[
                        *(f"device={place}", f"schedule.env_steps={WARM_UP + length}"),
                        *(f"schedule.warmup_env_steps={WARM_UP}", "evaluation.episodes=1"),
                        *("record.trackers=[]", *settings),
                    ],
                )
                took.append(time.perf_counter() - began)
            found[name][place] = (took[1] - took[0]) / (int(steps * part) - 64) * 1e3
            print(f"{name}, {place}: {found[name][place]:.2f} s", file=sys.stderr)
    return found


def lines_of_runs(answer: dict[str, Any]) -> Iterator[str]:
    """Yield the figures of whole runs, for people."""
    yield answer["device"]
    for name, by_place in answer["s_per_1000_env_steps"].items():
        each = ", ".join(f"{place} {value:.2f}" for place, value in by_place.items())
        yield f"{name:30s} s per 1,000 environment steps: {each}"


def lines(answer: dict[str, Any]) -> Iterator[str]:
    """Yield the figures, for people."""
    yield answer["device"]
    for batch, of_batch in answer["us_per_update"].items():
        for name, value in of_batch.items():
            yield f"batch {batch:5d}  {name:26s} {value:8.1f} us an update"
        ratio = answer["ratios"].get(batch)
        if ratio is not None:
            yield f"batch {batch:5d}  stable_baselines3 / restock: {ratio:.2f}x (target {TARGET}x)"


def main() -> int:
    parser = option_parser(__doc__, quick="fewer rounds and updates")
    parser.add_argument("--device", choices=["cuda", "cpu"], default="cuda")
    parser.add_argument("--runs", action="store_true", help="whole runs, on the CPU beside it")
    options = parser.parse_args()
    device: str = options.device
    if device == "cuda" and not torch.cuda.is_available():
        print("this PyTorch sees no CUDA device: use --device cpu to try it", file=sys.stderr)
        return 2
    name = torch.cuda.get_device_name() if device == "cuda" else "cpu"
    known = {"device": f"{name}, torch {torch.__version__}"}
    if options.runs:
        with tempfile.TemporaryDirectory() as folder:
            seconds = seconds_of_runs(device, 0.1 if options.quick else 1.0, Path(folder))
        answer = {**known, "s_per_1000_env_steps": seconds}
        return finish(options, answer, [], lines_of_runs(answer))
    torch.set_num_threads(1)
    arrays = data(np.random.default_rng(0))
    rounds, updates = (3, 64) if options.quick else (9, 512)
    with tempfile.TemporaryDirectory() as folder:
        us = {
            batch: measured(batch, arrays, device, rounds, updates, Path(folder))
            for batch in BATCHES
        }
    ratios = {
        batch: of["stable_baselines3"] / of["restock"]
        for batch, of in us.items()
        if "stable_baselines3" in of
    }
    answer = {**known, "us_per_update": us, "ratios": ratios}
    missed = [
        f"stable_baselines3 at batch {batch}: {ratio:.2f}x, target {TARGET}x"
        for batch, ratio in ratios.items()
        if ratio < TARGET
    ]
    return finish(options, answer, missed, lines(answer))


if __name__ == "__main__":
    sys.exit(main())
