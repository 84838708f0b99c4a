"""Save and restore of the vector environment, bit for bit, as arrays and plain JSON.

What follows from an episode's spec (layout, noise, ways of traffic) is laid out again from it;
what changes while it runs (physics, traffic, plans, signals, counters) is stored.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from restock.errors import RunError
from restock.train.twin.physics.episode import EpisodeSpec

if TYPE_CHECKING:
    from restock.train.twin.env.vector_env import WarehouseVectorEnv

_ENV = (
    *("observation", "previous_action", "steps", "bumps", "episode_number", "episode_seed"),
    *("episode_condition", "block", "perturbation_name", "episodes_begun"),
)


def get_state(env: WarehouseVectorEnv) -> dict[str, Any]:
    """{"arrays": {name: array}, "json": {...}} of an environment that was reset."""
    arrays = {f"env.{name}": getattr(env, name).copy() for name in _ENV}
    arrays["env._drawn"] = env.queue.drawn.copy()
    arrays |= {f"simulation.{name}": array for name, array in env.simulation.get_state().items()}
    arrays |= {f"signals.{name}": column.copy() for name, column in env.signals.items()}
    arrays |= {
        "sensing.ranges_m": env.sensing.ranges_m.copy(),
        "sensing.pose": env.sensing.pose.copy(),
        "sensing.pose_stamp_ns": env.sensing.pose_stamp_ns.copy(),
        "sensing.true_clearance_m": env.sensing.true_clearance_m.copy(),
        "truth.aftermath_s": env.truth.aftermath_s.copy(),
        "truth.blocked": env.truth.blocked.copy(),
        "navigation.plans_m": env.navigation.plans_m.copy(),
        "navigation.plan_number": env.navigation.plan_number.copy(),
        "finder.seen": env.navigation.finder.seen.copy(),
        "finder.place": env.navigation.finder.place.copy(),
    }
    json = {
        "task_hash": env.task.hash,
        "floors": [[floor.name, floor.hash] for floor in env.floors],
        "seed": env.queue.seed,
        "conditions": env.queue.conditions,
        "blown_up": env.blown_up,
        "specs": msgspec.to_builtins(env.specs),
        "fixed": msgspec.to_builtins(env.queue.fixed),
        "next_fixed": env.queue.next_fixed,
        "closures": [[list(closure) for closure in found] for found in env.navigation.closures],
    }
    return {"arrays": arrays, "json": json}


def set_state(env: WarehouseVectorEnv, state: dict[str, Any]) -> None:
    """Continue from a state.

    Raises:
        RunError: the state is of another number of environments or another task.
    """
    arrays, json = state["arrays"], state["json"]
    if len(json["specs"]) != env.num_envs or json["task_hash"] != env.task.hash:
        raise RunError(
            f"the saved state is of {len(json['specs'])} environments and task {json['task_hash']},"
            f" this one of {env.num_envs} and task {env.task.hash}",
            where="state of the twin",
            remedy="make the environment as it was made when the state was saved",
        )
    floors = [[floor.name, floor.hash] for floor in env.floors]
    if (saved := json.get("floors", floors)) != floors:
        changed = [name for name, digest in saved if [name, digest] not in floors]
        raise RunError(
            f"the saved state is of other floors: {', '.join(changed) or 'fewer'}"
            f" of {len(saved)} is none of this one's {len(floors)}",
            where="state of the twin",
            remedy="make the environment with the layouts of then; a file may have changed since",
        )
    env.set_conditions(json["conditions"])
    env.queue.seed, env.blown_up = int(json["seed"]), int(json["blown_up"])
    env.queue.fixed = msgspec.convert(json["fixed"], list[EpisodeSpec])
    env.queue.next_fixed = int(json["next_fixed"])
    env.queue.drawn = arrays["env._drawn"].copy()
    for index, spec in enumerate(msgspec.convert(json["specs"], list[EpisodeSpec])):
        env._lay_out(index, spec)
    for name in _ENV:
        setattr(env, name, arrays[f"env.{name}"].copy())
    prefix = "simulation."
    env.simulation.set_state(
        {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}
    )
    prefix = "signals."
    env.signals = {
        name.removeprefix(prefix): array.copy()
        for name, array in arrays.items()
        if name.startswith(prefix)
    }
    for owner, name in (
        (env.sensing, "sensing.ranges_m"),
        (env.sensing, "sensing.pose"),
        (env.sensing, "sensing.pose_stamp_ns"),
        (env.sensing, "sensing.true_clearance_m"),
        (env.truth, "truth.aftermath_s"),
        (env.truth, "truth.blocked"),
        (env.navigation, "navigation.plans_m"),
        (env.navigation, "navigation.plan_number"),
        (env.navigation.finder, "finder.seen"),
        (env.navigation.finder, "finder.place"),
    ):
        setattr(owner, name.split(".")[1], np.array(arrays[name]))
    env.navigation.closures = [
        [(int(segment), int(step)) for segment, step in found] for found in json["closures"]
    ]
