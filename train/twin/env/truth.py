"""The true conditions of every step, from the simulator: kept apart from labels to score them.

A step's conditions are what was physically so over [t, t + 1), by the contract's names:

- wheel_slip: a wheel stood on a slippery patch and moved over the floor by more than the task's
  `slip_limit_mps`;
- near_collision: at t + 1 something was nearer to the body than the task's `tight_clearance_m`, or
  the bumper was pressed;
- recovery: after such an event until there was twice that room, or 2 s, known at t;
- blocked_aisle: at t, pallets lay on the plan within `BLOCK_AHEAD_M` of the robot's middle.

Exposures are what was so at t, whatever came of it:

- closing_traffic: someone within 2 m of the body had come nearer, over the step before, by .1 m/s;
- plan_blocked: pallets lay on the plan within 2.2 m of the robot's middle;
- slippery_floor: a wheel stood on a slippery patch.

Several may hold at once: the text of a step names all of them, sorted, with commas between, and is
"nominal" where none holds. `restock.ingest.task.label_scores.primary_of` makes it one.

`info` says more of a step than observation and reward. It holds arrays (N,) about the step just
taken, whole even if an episode ended:

- `signals`: the stored signals at t + 1, before any autoreset (`env.signals`: after it). Its
  `command_*` columns are the commands of [t, t + 1); `progress_m` along the plan in force at t;
- `true_condition`: the conditions over [t, t + 1); `true_exposure`: the exposures at t;
  `episode_condition`, `block` (none, partial, full), `episode_seed`, `perturbation` and `layout`
  (their names), `floor` (the layout itself), `episode_number` (place in `set_episodes`, or -1),
  `mission_arm` (place among `mission_arms`, -1 if none was requested); `perturbation_values`, as
  JSON those that are not nominal;
- `success` (at the goal without any bump, at the episode's end), `bumps` (steps with a bump so
  far), `episode_steps`, `true_pose` (N, 3);
- `travelled_m`, over ground in [t, t + 1); `closest_person_m`, the least true distance so far from
  the body's edge to a person or forklift, as the crow flies, of the episodes of `set_episodes`:
  inf if nobody is on the floor, and in others, where it is not measured;
- `invalid`: the physics diverged: the episode is truncated and the step must not enter replay;
- `final_obs`, with the mask `_final_obs`;
- in the continuous action space, and behind a limiter (`env.limits`), `action`, the nearest of the
  task's, and `action_residual`;
- behind a limiter `limiter`, the rule that held: `restock.ingest.task.robot.RULES`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.ingest.task.label_scores import truth_text
from restock.ingest.task.signals import Signals
from restock.ingest.task.surroundings import view_route
from restock.ingest.task.task import Task, reached_goal
from restock.state import Stateful
from restock.train.twin.env.interface import Info
from restock.train.twin.floors.layout import AGENTS, pallet_half_m
from restock.train.twin.missions import MISSIONS
from restock.train.twin.missions.mission import Situation
from restock.train.twin.physics.simulation import Simulation

if TYPE_CHECKING:
    from restock.train.twin.env.vector_env import WarehouseVectorEnv


AFTERMATH = "recovery"
SCORED = {one.name: one.is_true for one in MISSIONS.values() if one.is_true is not None}
NAMES = (*SCORED, AFTERMATH)
EXPOSURES = ("closing_traffic", "plan_blocked", "slippery_floor")


def _texts(names: tuple[str, ...]) -> NDArray[np.str_]:
    """Return the text of every set of names: bit i of a set's index is names[i]."""
    sets = range(1 << len(names))
    return np.array([truth_text(n for bit, n in enumerate(names) if s >> bit & 1) for s in sets])


_TEXTS, _EXPOSED = _texts(NAMES), _texts(EXPOSURES)
AFTERMATH_S = 2.0
CLOSING_WITHIN_M, CLOSING_MPS = 2.0, 0.1
VIEW_M = tuple(0.2 * step for step in range(1, 12))  # of the plan; the look-ahead's far end
BLOCK_AHEAD = 6  # of them are just ahead: to 1.2 m
REACH_M = VIEW_M[-1] + 1.5  # a pallet farther off than this is not in view
MARGIN = 0.4  # of the body's width: how far beside the plan a pallet is still in the way


class Truth(Stateful):
    """State that true conditions depend on, for N environments."""

    STATE = ("aftermath_s", "blocked", "traffic_gap_m", "exposed")

    def __init__(self, task: Task, num_envs: int) -> None:
        self._period_s = task.control_period_s
        self._near_m = task.rewards.tight_clearance_m
        self._margin_m = MARGIN * task.body.width_m
        self.aftermath_s = np.zeros(num_envs)  # left of it; 0: none
        self.blocked = np.zeros(num_envs, np.bool_)  # at t
        self.traffic_gap_m = np.full((num_envs, AGENTS), np.inf)  # to each, at t; inf: not there
        self.exposed = np.zeros((num_envs, len(EXPOSURES)), np.bool_)  # at t

    def reset(self, ids: Ints) -> None:
        self.aftermath_s[ids] = 0.0
        self.blocked[ids] = False
        self.traffic_gap_m[ids] = np.inf
        self.exposed[ids] = False

    def note_situation(self, simulation: Simulation, plans_m: F64) -> None:
        """Note what every robot is exposed to at the start of a step."""
        pose, pallets = simulation.pose(), simulation.pallets
        ahead = np.zeros((len(pose), len(VIEW_M)), np.bool_)
        gap = np.abs(pallets[:, :, :2] - pose[:, None, :2]).max(axis=-1).min(axis=1)
        with_pallets = np.flatnonzero(gap < REACH_M)
        if len(with_pallets):
            ahead[with_pallets] = _blocked(
                pose[with_pallets], plans_m[with_pallets], pallets[with_pallets], self._margin_m
            )
        self.blocked[:] = ahead[:, :BLOCK_AHEAD].any(axis=1)
        gaps_m = simulation.traffic.gaps_m(simulation.middle(pose))
        with np.errstate(invalid="ignore"):  # who was not there, or is not, is at infinity
            came_m = self.traffic_gap_m - gaps_m
        came = np.isfinite(came_m) & (came_m > CLOSING_MPS * self._period_s)
        self.exposed[:, 0] = (came & (gaps_m < CLOSING_WITHIN_M)).any(axis=1)
        self.exposed[:, 1] = ahead.any(axis=1)
        self.exposed[:, 2] = simulation.friction.on_patch(pose)
        self.traffic_gap_m = gaps_m

    def exposure(self) -> NDArray[np.str_]:
        """Return all exposures (N,) of the current step, as one text each."""
        which = (self.exposed << np.arange(len(EXPOSURES))).sum(axis=1)
        texts: NDArray[np.str_] = _EXPOSED[which]
        return texts

    def condition(self, slipped: Bools, bumped: Bools, clearance_m: F64) -> NDArray[np.str_]:
        """Return all conditions (N,) of the step that ends now, as one text each."""
        near = bumped | (clearance_m < self._near_m)
        now = Situation(self.blocked, near, slipped, clearance_m, self.traffic_gap_m)
        missions = [is_true(now) for is_true in SCORED.values()]
        held = np.stack([*missions, self.aftermath_s > 0])  # as NAMES
        which = (held << np.arange(len(NAMES))[:, None]).sum(axis=0)
        left = np.maximum(self.aftermath_s - self._period_s, 0.0)
        left[(clearance_m > 2 * self._near_m) & ~near] = 0.0
        self.aftermath_s = np.where(near, AFTERMATH_S, left)
        texts: NDArray[np.str_] = _TEXTS[which]
        return texts


def _blocked(pose: F64, plans_m: F64, pallets: F64, margin_m: float) -> Bools:
    """Return whether a pallet is within the robot's breadth of the plan at VIEW_M, (n, VIEW_M)."""
    view = view_route(plans_m, pose[:, 0], pose[:, 1], np.zeros(len(pose)), VIEW_M)
    points = view.look_ahead_m + pose[:, None, :2]  # heading 0: offsets in the map frame
    gap = np.abs(points[:, :, None] - pallets[:, None, :, :2])
    half = pallet_half_m(pallets[:, None, :, 2]) + margin_m
    return np.asarray((gap <= half).all(axis=-1).any(axis=-1), np.bool_)


def info_now(env: WarehouseVectorEnv) -> Info:
    """Return the episodes now running and the current signals."""
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
    """Return the info of a step that led to the signals `after` under true `condition` (N,)."""
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
