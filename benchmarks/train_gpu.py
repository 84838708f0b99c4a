"""How long one update takes on a GPU, beside Stable-Baselines3 on the same device.

    python benchmarks/train_gpu.py [--device cuda] [--quick] [--json] [--check]

Equal network (2 x 256 ReLU), equal batch (256 and 1,024), Adam, plain DQN targets, sampling from a
full buffer of 50,000 rows included: Stable-Baselines3 with its own defaults, and with Restock's
settings (a Polyak pull at every update, fused Adam: `_equal`). Restock as `restock train --device
cuda` makes its updates: drawn and recorded by the host in blocks, made by a CUDA graph. Beside it
the same without the graph (`_launched`), with the rows drawn on the device (`_device_sampler`), and
the default (double DQN, LayerNorm, half of the batch from logs by quotas) without and with its
record. Figures are wall time, the device waited for at the end of each round.
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
from train_peers import ROWS, Arrays, Updates, data, stable_baselines3

from restock.replay.sampling.device import DeviceSampler
from restock.train.dqn.captured_update import CapturedUpdates, UpdateBlock
from restock.train.dqn.config import TrainConfig
from restock.train.run.run import Run
from restock.train.update_blocks import LONGEST

TARGET = 5.0  # times Stable-Baselines3, at either batch
BATCHES = (256, 1024)


class ByDeviceSampler:
    """Drawn where the rows lie; the host sends nothing, and reads the losses of the last block."""

    def __init__(self, batch: int, arrays: Arrays, device: str) -> None:
        whole = Restock(_plain(batch, device), arrays)
        table = torch.from_numpy(whole.batches.ring.rows).to(device)
        self._sampler = DeviceSampler([np.arange(ROWS)], [1.0], batch, seed=0, device=device)
        self._updates = CapturedUpdates(
            whole.learner, table, batch_size=batch, width=table.shape[1], longest=LONGEST
        )
        self._weight = torch.ones(LONGEST, batch, device=device)
        self._none = torch.zeros(LONGEST)

    def __call__(self, updates: int) -> None:
        for begin in range(0, updates, LONGEST):
            count = min(LONGEST, updates - begin)
            rows = torch.stack([self._sampler.draw()[0] for _ in range(count)])
            none = self._none[:count]
            block = UpdateBlock(rows, None, self._weight[:count], none, none, None)
            launched = self._updates.launch(block)
            self._updates.learner.count(count, labelled=False)
        launched.outcome()


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
        "restock_device_sampler": ByDeviceSampler(batch, arrays, device),
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


def lines(answer: dict[str, Any]) -> Iterator[str]:
    """The figures, for people."""
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
    options = parser.parse_args()
    device: str = options.device
    if device == "cuda" and not torch.cuda.is_available():
        print("this PyTorch sees no CUDA device: use --device cpu to try it", file=sys.stderr)
        return 2
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
    name = torch.cuda.get_device_name() if device == "cuda" else "cpu"
    answer = {"device": f"{name}, torch {torch.__version__}", "us_per_update": us, "ratios": ratios}
    missed = [
        f"stable_baselines3 at batch {batch}: {ratio:.2f}x, target {TARGET}x"
        for batch, ratio in ratios.items()
        if ratio < TARGET
    ]
    return finish(options, answer, missed, lines(answer))


if __name__ == "__main__":
    sys.exit(main())
