"""d3rlpy's DQN update, for `benchmarks/train.py`, in a Python that has d3rlpy.

Reads the path of the rows (.npz) from stdin, says "ready", then for each line `n` makes n updates
and prints the CPU seconds they took.
"""

from __future__ import annotations

import os
import sys
import time

import d3rlpy
import numpy as np
import torch

COPY_EVERY = 500


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")  # d3rlpy's own lines go to stderr
    os.dup2(2, 1)
    torch.set_num_threads(1)
    batch = int(sys.argv[1])
    with np.load(sys.stdin.readline().strip()) as rows:
        names = ("observation", "action", "reward", "done")
        observation, action, reward, done = (rows[name] for name in names)
    # Next observations are the rows that follow: d3rlpy keeps episodes, not pairs.
    done[-1] = 1
    dataset = d3rlpy.dataset.MDPDataset(observation, action[:, 0], reward[:, 0], done[:, 0])
    algorithm = d3rlpy.algos.DQNConfig(
        batch_size=batch,
        gamma=0.97,
        learning_rate=3e-4,
        encoder_factory=d3rlpy.models.VectorEncoderFactory([256, 256]),
        target_update_interval=COPY_EVERY,
    ).create(device="cpu:0")
    algorithm.create_impl(observation.shape[1:], int(action.max()) + 1)
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        began = time.process_time()
        for _ in range(int(line)):
            algorithm.update(dataset.sample_transition_batch(batch))
        print(time.process_time() - began, file=answers, flush=True)


if __name__ == "__main__":
    main()
