"""Train d3rlpy's discrete CQL on an export, in a Python that has d3rlpy: it needs an old Gymnasium.

    PYTHON benchmarks/discrete_cql.py rows.h5 policy.pt UPDATES SEED

The network's widths, batch size, learning rate, discount and steps of a return are R's
(benchmarks/evidence/twin-nominal.toml); the target is a copy as old in the mean as R's. `alpha` is
d3rlpy's default. The policy is saved as TorchScript, which needs no d3rlpy.
"""

from __future__ import annotations

import sys

import d3rlpy  # type: ignore[import-not-found]
import torch

DISCOUNT = 0.99


def main(rows: str, policy: str, updates: str, seed: str) -> None:
    torch.set_num_threads(1)
    d3rlpy.seed(int(seed))
    with open(rows, "rb") as file:  # noqa: PTH123 - as d3rlpy's documentation does it
        dataset = d3rlpy.dataset.ReplayBuffer.load(
            file,
            d3rlpy.dataset.InfiniteBuffer(),
            transition_picker=d3rlpy.dataset.MultiStepTransitionPicker(3, DISCOUNT),
        )
    layers = d3rlpy.models.VectorEncoderFactory([256, 256], use_layer_norm=True)
    settings = d3rlpy.algos.DiscreteCQLConfig(
        batch_size=128,
        learning_rate=1e-3,
        gamma=DISCOUNT,
        encoder_factory=layers,
        target_update_interval=400,
    )
    algorithm = settings.create(device="cpu:0")
    algorithm.build_with_dataset(dataset)
    for _ in range(int(updates)):
        algorithm.update(dataset.sample_transition_batch(128))
    algorithm.save_policy(policy)


if __name__ == "__main__":
    main(*sys.argv[1:])
