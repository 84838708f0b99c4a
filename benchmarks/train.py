"""How long one update takes, beside other libraries, in one interleaved run.

    python benchmarks/train.py [--batch 128] [--quick] [--json] [--check]

Equal network (2 x 256 ReLU; no LayerNorm, which the peers' MLPs do not have), equal batch, Adam,
plain DQN targets, one thread, sampling from a full buffer included: CleanRL's logic,
Stable-Baselines3, Tianshou, TorchRL and d3rlpy, each where it is installed (d3rlpy in a Python of
its own, `--neighbours`) and with its own defaults; the first two once more with Restock's
settings (a Polyak pull at every update, fused Adam: `_equal`). Then Restock's own ways: compiled
where `restock --version` says so, by PyTorch's operations (`_manual`), by autograd, with
LayerNorm, its default (double DQN, LayerNorm, half of the batch from logs by quotas), and that
with the record of what was fed. The floor is the update's matrix products by the faster of
PyTorch's two libraries, and nothing else.
Figures are CPU times. `--check` exits 1 where a target of the design is missed.
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
from own_updates import Restock, config, products
from train_peers import (
    Arrays,
    Updates,
    cleanrl,
    d3rlpy,
    data,
    stable_baselines3,
    tianshou,
    torchrl,
)

from restock.train.dqn.config import TrainConfig
from restock.train.run.run import Run

# Times the best matrix products alone, at most; or CleanRL's logic so many times Restock's update,
# at least, where products of PyTorch's are slow: nothing that multiplies is ahead of its products.
PRODUCTS_TARGET, CLEANRL_TARGET = 1.15, 1.5
IN_PLACE_TARGET = 1.1  # times the same arithmetic on one batch that lies ready, at most
FEED_TARGET = 0.06  # of an update, at most


def in_place(settings: TrainConfig, arrays: Arrays) -> Updates:
    """Return the arithmetic of an update alone: one batch, drawn beforehand, again and again."""
    whole = Restock(settings, arrays)
    learner, rows = whole.learner, whole.batches.draw_online().rows.clone()

    def update(updates: int) -> None:
        for _ in range(updates):
            learner.update(rows)
            learner.target.after(learner.gradient_steps)

    return update


def us_of(run: Updates, updates: int) -> float:
    """CPU microseconds of one update, by its own account where it is made in another process."""
    began = time.process_time()
    elsewhere_s = run(updates)
    here_s = time.process_time() - began
    return (here_s if elsewhere_s is None else elsewhere_s) / updates * 1e6


def lines(answer: dict[str, Any]) -> Iterator[str]:
    """Yield the figures, for people."""
    for name, value in answer["us_per_update"].items():
        yield f"{name:28s} {value:7.0f} us an update"
    for name, value in answer["ratios"].items():
        yield f"{name} / restock: {value:.2f}x"
    yield from (f"{name}: not installed, left out" for name in answer["left_out"])
    over, share = answer["over_in_place"], answer["record_share"]
    yield (
        f"restock / the best products alone: {answer['over_products']:.2f}x (target at most"
        f" {PRODUCTS_TARGET}x, or cleanrl / restock at least {CLEANRL_TARGET}x)"
    )
    yield f"restock / in place: {over:.2f}x (target at most {IN_PLACE_TARGET}x)"
    yield f"record of what was fed: {share:.1%} of an update (target at most {FEED_TARGET:.0%})"


def main() -> int:
    parser = option_parser(__doc__, quick="fewer rounds and updates")
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument(
        "--neighbours",
        type=Path,
        default=Path(".venv-neighbours/bin/python"),
        help="a Python that has d3rlpy",
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    batch, arrays = options.batch, data(np.random.default_rng(0))
    equal = config(batch, network={"layer_norm": False}, loss={"double": False})
    normed, default = config(batch, loss={"double": False}), config(batch)
    peers = {
        "cleanrl": cleanrl(batch, arrays),
        "cleanrl_equal": cleanrl(batch, arrays, equal=True),
        "stable_baselines3": stable_baselines3(batch, arrays),
        "stable_baselines3_equal": stable_baselines3(batch, arrays, equal=True),
        "tianshou": tianshou(batch, arrays),
        "torchrl": torchrl(batch, arrays),
        "d3rlpy": d3rlpy(batch, arrays, options.neighbours),
    }
    with tempfile.TemporaryDirectory() as folder:
        run = Run.create(Path(folder) / "run", {})
        contenders: dict[str, Updates] = {
            "products": products(batch),
            "restock_in_place": in_place(equal, arrays),
            "restock": Restock(equal, arrays),
            "restock_autograd": Restock(equal, arrays, path="autograd"),
            **{name: peer for name, peer in peers.items() if peer is not None},
            "restock_layer_norm": Restock(normed, arrays),
            "restock_layer_norm_autograd": Restock(normed, arrays, path="autograd"),
            "restock_default": Restock(default, arrays, logs=True),
            "restock_default_recorded": Restock(default, arrays, run=run, logs=True),
        }
        rounds, updates = (5, 40) if options.quick else (15, 200)
        timed = {name: partial(us_of, update, updates) for name, update in contenders.items()}
        in_turns(timed, 1)  # warm
        us = medians(in_turns(timed, rounds))
    ratios = {name: us[name] / us["restock"] for name in peers if name in us}
    over = us["restock"] / us["restock_in_place"]
    feed = us["restock_default_recorded"] / us["restock_default"] - 1
    products_alone, missed = us["restock"] / us["products"], []
    if products_alone > PRODUCTS_TARGET and ratios.get("cleanrl", 0.0) < CLEANRL_TARGET:
        missed.append(
            f"over the best products alone: {products_alone:.2f}x, target {PRODUCTS_TARGET}x; or"
            f" cleanrl: {ratios.get('cleanrl', 0.0):.2f}x, target {CLEANRL_TARGET}x"
        )
    if over > IN_PLACE_TARGET:
        missed.append(f"over the arithmetic in place: {over:.2f}x, target {IN_PLACE_TARGET}x")
    if feed > FEED_TARGET:
        missed.append(f"record: {feed:.1%} of an update, target {FEED_TARGET:.0%}")
    answer = {
        "batch": batch,
        "us_per_update": us,
        "ratios": ratios,
        "over_in_place": over,
        "over_products": products_alone,
        "left_out": [name for name, peer in peers.items() if peer is None],
        "record_share": feed,
    }
    return finish(options, answer, missed, lines(answer))


if __name__ == "__main__":
    sys.exit(main())
