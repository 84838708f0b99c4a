"""Train another library's algorithm as an arm of a study, in the same twin, kept as a run.

Stable-Baselines3's DQN and PPO learn with their own code. The environment, its conditions, the
number of environment steps, the fixed episodes that choose the policy to keep, the discount and the
network's widths are those of the study's settings; DQN also has their replay (one buffer drawn
uniformly, as `restock.train.libraries.sb3_buffer` records it), exploration and target rule. What
is kept is the policy in Restock's own network, weight for weight, so `restock eval`, `export` and
`compare` take the run as any other. What the library was called with is in `config.json`, under
`library`.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any, Literal

import msgspec
import torch

from restock.errors import ConfigError, RestockError
from restock.files import write_text
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import Task
from restock.process import expect_installed, kill_as_interrupt
from restock.train.dqn.algorithm import make_algorithm
from restock.train.dqn.config import Hard, NetworkConfig, TrainConfig, describe, load_config
from restock.train.dqn.network import QNetwork
from restock.train.evaluation.evaluate import (
    Score,
    fixed_episodes,
    run_episodes,
    score,
)
from restock.train.evaluation.policies import GreedyPolicy, save_agent
from restock.train.feed.practice import make_twin
from restock.train.libraries.mixed_feed import create_run
from restock.train.resolve import resolve_config
from restock.train.run.run import Run
from restock.train.twin.floors.floors import layouts_of_split

Library = Literal["sb3-dqn", "sb3-ppo"]
DISTRIBUTION = "stable-baselines3"
TRAINED = "library.json"  # in the run's directory: it was trained to its end
_EVALUATION_ENVS = 32


class LibraryArm(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A run to make."""

    out: str
    library: Library
    settings: tuple[str, ...] = ()  # key=value, as of `restock train --set`
    arguments: dict[str, Any] = msgspec.field(default_factory=dict)  # the algorithm's own


def resolve(settings: tuple[str, ...], library: Library) -> TrainConfig:
    """Return the study's settings in a form that the library can follow.

    Raises:
        ConfigError: settings that it has no counterpart of.
    """
    config = load_config(None, settings)
    plain = NetworkConfig(hidden=config.network.hidden, layer_norm=False)
    refused = [
        name
        for name, bad in (
            ("replay.ring_reserved", config.replay.ring_reserved > 0),
            ("schedule.seconds", config.schedule.seconds is not None),
            ('replay.ring_capacity "auto"', config.replay.ring_capacity == "auto"),
            ("teacher.source", config.teacher.source not in (None, "none")),
            ("network.members", config.network.members > 1),
            ("practice.rule", config.practice.rule != "natural"),
            ("evaluation.missions", config.evaluation.missions != "drawn"),
        )
        if bad
    ]
    if refused:
        raise ConfigError(
            f"{library} does not have {', '.join(refused)}, which the settings ask for",
            remedy="give these settings to the other arms, not to the whole study",
        )
    loss = msgspec.structs.replace(config.loss, double=False)
    return resolve_config(msgspec.structs.replace(config, network=plain, loss=loss), None)


def dqn_arguments(config: TrainConfig) -> dict[str, Any]:
    """Return the arguments that make `stable_baselines3.DQN` follow a config.

    Its intervals count calls and steps.
    """
    count, schedule = config.env.num_envs, config.schedule
    per_call = schedule.updates_per_env_step * count
    calls, updates = (1, round(per_call)) if per_call >= 1 else (round(1 / per_call), 1)
    target = config.target
    if isinstance(target, Hard):
        interval, tau = round(target.every / schedule.updates_per_env_step), 1.0
    else:  # moves once after all updates of a call, as far as it would have moved in them
        interval, tau = calls * count, 1 - (1 - target.tau) ** updates
    return {
        "learning_rate": config.optimizer.learning_rate,
        "buffer_size": config.replay.ring_rows,
        "learning_starts": schedule.warmup_env_steps,
        "batch_size": config.replay.batch_size,
        "gamma": config.loss.discount,
        "train_freq": calls,
        "gradient_steps": updates,
        "target_update_interval": interval,
        "tau": tau,
        "exploration_fraction": min(config.epsilon.steps / max(schedule.env_steps, 1), 1.0),
        "exploration_initial_eps": config.epsilon.start,
        "exploration_final_eps": config.epsilon.end,
        "max_grad_norm": 10.0,
    }


def ppo_arguments(config: TrainConfig) -> dict[str, Any]:
    """Return the arguments of `stable_baselines3.PPO`: its defaults, with 2,048 steps a rollout."""
    steps = min(2048, config.schedule.env_steps) // config.env.num_envs
    return {"gamma": config.loss.discount, "n_steps": max(steps, 2)}


class Evaluations:
    """The fixed episodes of a study, driven now and then; the best policy is kept."""

    def __init__(self, run: Run, config: TrainConfig, task: Task) -> None:
        self.run, self.config, self.task = run, config, task
        names = list(config.env.conditions)
        given = config.evaluation
        self.specs = fixed_episodes(names, given.episodes, given.seed)
        count = min(_EVALUATION_ENVS, len(self.specs))
        layouts = given.layouts or layouts_of_split(config.env.layouts, "validation")
        self.env = make_twin(config, load_profile(config.profile), count, layouts=layouts)
        self.best: Score | None = None
        self.at = 0  # environment steps of the last one

    def due(self, env_steps: int) -> bool:
        return env_steps - self.at >= self.config.evaluation.every_env_steps

    def drive(self, network: QNetwork, env_steps: int, gradient_steps: int) -> None:
        """Evaluate a policy; keep it if it is the best so far."""
        results = run_episodes(
            self.env,
            GreedyPolicy(network),
            self.specs,
            control_period_s=self.task.control_period_s,
            time_limit_steps=self.task.time_limit_steps,
            goal=self.task.goal != "none",
            discount=self.config.loss.discount,
        )
        self.at, evaluated = env_steps, score(results)
        clocks = {"env_steps": env_steps, "gradient_steps": gradient_steps}
        if best := evaluated.beats(self.best):
            self.best = evaluated
            save_agent(self.run, network, self.task, evaluated, clocks)
        self.run.append("evaluations", [{**clocks, **r.row, "best": best} for r in results])
        self.run.flush()


def train_library(arm: LibraryArm) -> None:
    """Make the run.

    Raises:
        ConfigError: the library is not installed, or refuses its arguments.
        RunError: there is something at `arm.out` already.
    """
    expect_installed("an arm of a library", "stable_baselines3")
    from restock.train.libraries import sb3_drive

    config = resolve(arm.settings, arm.library)
    profile = load_profile(config.profile)
    on_policy = arm.library == "sb3-ppo"
    arguments = (ppo_arguments if on_policy else dqn_arguments)(config) | arm.arguments
    known = {"name": DISTRIBUTION, "algorithm": arm.library}
    if on_policy:  # these settings do not apply to the library
        known |= {"replay": "none: each rollout is used once, then discarded", "target": "none"}
    elif arm.arguments:  # its own arguments may have changed replay, exploration or target
        known |= {"replay": f"changed by {arm.arguments}", "target": f"changed by {arm.arguments}"}
    run = create_run(
        Path(arm.out),
        known | {"arguments": arguments},
        profile,
        None,
        msgspec.to_builtins(config),
        target={"rule": "none"} if on_policy else describe(config.target),
        seeds={"run": config.seed, "evaluation": config.evaluation.seed},
    )
    began = time.monotonic()
    evaluations = Evaluations(run, config, profile.task)
    drive = sb3_drive.ppo if on_policy else sb3_drive.dqn
    env_steps, updates = drive(config, arguments, run, evaluations)
    ended = {"env_steps": env_steps, "updates": updates, "wall_s": time.monotonic() - began}
    write_text(run.path / TRAINED, json.dumps(ended, indent=1) + "\n")


def as_network(config: TrainConfig, task: Task, linears: list[Any]) -> QNetwork:
    """Copy a library's linear layers, in order, into Restock's network, which computes the same."""
    make = make_algorithm(config.loss).make_network
    network = make(config.network, task.observation_size, len(task.actions))
    layers = [module for module in network.modules() if isinstance(module, torch.nn.Linear)]
    with torch.no_grad():
        for layer, given in zip(layers, linears, strict=True):
            layer.weight.copy_(given.weight)
            layer.bias.copy_(given.bias)
    return network.eval()


def main(words: list[str]) -> int:
    """Run `python -m restock.train.libraries.library_arm JSON`: one run in its own process."""
    try:
        with kill_as_interrupt():
            train_library(msgspec.json.decode(words[0], type=LibraryArm))
    except RestockError as error:
        sys.stderr.write(f"error: {error}\n")
        return int(error.exit_code)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
