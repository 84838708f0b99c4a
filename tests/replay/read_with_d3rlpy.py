"""Read exports with the real d3rlpy and print what it finds: run by test_export.py."""

import json
import sys

import d3rlpy


def read(path: str) -> dict[str, object]:
    """Train a learner on the file and return its episodes."""
    with open(path, "rb") as file:  # noqa: PTH123 - as d3rlpy's documentation does it
        dataset = d3rlpy.dataset.ReplayBuffer.load(file, d3rlpy.dataset.InfiniteBuffer())
    discrete = dataset.dataset_info.action_space == d3rlpy.constants.ActionSpace.DISCRETE
    episodes = []
    for episode in dataset.episodes:
        steps = [dataset.transition_picker(episode, i) for i in range(episode.transition_count)]
        episodes.append(
            {
                "terminated": bool(episode.terminated),
                "actions": [step.action.tolist() for step in steps],
                "rewards": [float(step.reward[0]) for step in steps],
                "first": [float(step.observation[0]) for step in steps],
                "next_first": [float(step.next_observation[0]) for step in steps],
                "terminal": [step.terminal for step in steps],
            }
        )
    algorithm = d3rlpy.algos.DQNConfig() if discrete else d3rlpy.algos.TD3Config()
    algorithm.create(device="cpu").fit(
        dataset,
        n_steps=3,
        n_steps_per_epoch=3,
        show_progress=False,
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
    )
    return {"transitions": dataset.transition_count, "discrete": discrete, "episodes": episodes}


sys.stdout.write("\n" + json.dumps([read(path) for path in sys.argv[1:]]) + "\n")
