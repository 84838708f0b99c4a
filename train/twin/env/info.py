"""What the warehouse says of a step beside observation and reward: the truth, and what runs.

`info` holds arrays (N,) about the step just taken, whole even where an episode ended:

- `signals`: the stored signals at t + 1, before any autoreset (`env.signals`: after it). Its
  `command_*` columns are the commands of [t, t + 1); `progress_m` along the plan in force at t;
- `true_condition`: what was physically so over [t, t + 1); `true_exposure`: the situation at t;
  `episode_condition`, `block` (none, partial, full), `episode_seed`, `perturbation` and `layout`
  (their names), `floor` (the layout itself), `episode_number` (place in `set_episodes`, or -1),
  `mission_arm` (place among `mission_arms`, -1 where none was asked for); `perturbation_values`,
  as JSON those that are not nominal;
- `success` (at the goal without any bump, at the episode's end), `bumps` (steps with a bump so
  far), `episode_steps`, `true_pose` (N, 3);
- `travelled_m`, over ground in [t, t + 1); `closest_person_m`, the least true distance so far from
  the body's edge to a person or forklift, as the crow flies, of the episodes of `set_episodes`:
  inf where nobody is on the floor, and in others, where it is not measured;
- `invalid`: the physics diverged: the episode is truncated and the step must not enter replay;
- `final_obs`, with the mask `_final_obs`;
- in the continuous action space, and behind a limiter (`env.limits`), `action`, the nearest of the
  task's, and `action_residual`;
- behind a limiter `limiter`, the rule that held: `restock.ingest.task.limiter.RULES`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools
from restock.ingest.task.signals import Signals
from restock.ingest.task.task import reached_goal
from restock.train.twin.env.interface import Info

if TYPE_CHECKING:
    from restock.train.twin.env.vector_env import WarehouseVectorEnv


def info_now(env: WarehouseVectorEnv) -> Info:
    """What runs in each environment, and the signals that are there."""
    return {
        "signals": {name: column.copy() for name, column in env.signals.items()},
        "episode_condition": env.episode_condition.copy(),
        "block": env.block.copy(),
        "episode_seed": env.episode_seed.copy(),
        "perturbation": env.perturbation_name.copy(),
        "perturbation_values": env.perturbation_values.copy(),
        "layout": env.layout_names[env.layout],
        "floor": env.floor_objects[env.layout],
        "episode_number": env.episode_number.copy(),
        "mission_arm": env.mission_arm.copy(),
        "episode_steps": env.steps.copy(),
        "bumps": env.bumps.copy(),
        "true_pose": env.simulation.pose(),
    }


def info_after(
    env: WarehouseVectorEnv,
    after: Signals,
    progress_m: F64,
    condition: NDArray[np.str_],
    ended: Bools,
) -> Info:
    """Of a step that led to the signals `after`; `condition` (N,) is what was so over it."""
    sim = env.simulation
    return info_now(env) | {
        "signals": after,
        "progress_m": progress_m,
        "true_condition": condition,
        "true_exposure": env.truth.exposure(),
        "success": ended & reached_goal(env.task, after) & (env.bumps == 0),
        "invalid": sim.diverged.copy(),
        "travelled_m": sim.travelled_m,
        # Not NaN, which Gymnasium's checker takes for two different values.
        "closest_person_m": np.nan_to_num(sim.traffic.closest_m, nan=np.inf, posinf=np.inf),
    }


__all__ = ["info_after", "info_now"]
