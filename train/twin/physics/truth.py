"""The true conditions of every step, from simulator truth: kept apart from labels, to score them.

A step's conditions are what was physically so over [t, t + 1), by the contract's names:

- wheel_slip: a wheel stood on a slippery patch and moved over the floor by more than .15 m/s;
- near_collision: at t + 1 something was nearer than .15 m to the body, or the bumper was pressed;
- recovery: after such an event until .3 m of room or 2 s, known at t;
- blocked_aisle: at t, pallets lay on the plan within `BLOCK_AHEAD_M` of the robot's middle.

Several may hold at once: the text of a step names all of them, sorted, with commas between, and is
"nominal" where none holds. `restock.ingest.task.label_scores.primary_of` makes it one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.ingest.task.label_scores import truth_text
from restock.ingest.task.route import view_route
from restock.ingest.task.task import Task
from restock.state import Stateful
from restock.train.twin.physics.model import pallet_half_m

NAMES = ("blocked_aisle", "near_collision", "recovery", "wheel_slip")
# The text of every set of conditions: bit i of its place is NAMES[i].
_TEXTS = np.array(
    [
        truth_text(name for bit, name in enumerate(NAMES) if place >> bit & 1)
        for place in range(1 << len(NAMES))
    ]
)
NEAR_M, CLEAR_M, AFTERMATH_S = 0.15, 0.3, 2.0
BLOCK_AHEAD_M = (0.2, 0.4, 0.6, 0.8, 1.0, 1.2)
REACH_M = BLOCK_AHEAD_M[-1] + 1.5  # a pallet farther off than this is not just ahead
BODY_MARGIN_M = 0.2  # how far beside the plan a pallet is still in the way


class Truth(Stateful):
    """Keeps what the true condition needs to remember, for N environments."""

    STATE = ("aftermath_s", "blocked")

    def __init__(self, task: Task, num_envs: int) -> None:
        self._period_s = task.control_period_s
        self.aftermath_s = np.zeros(num_envs)  # left of it; 0: none
        self.blocked = np.zeros(num_envs, np.bool_)  # at t

    def reset(self, ids: Ints) -> None:
        self.aftermath_s[ids] = 0.0
        self.blocked[ids] = False

    def note_blocked(self, pose: F64, plans_m: F64, pallets: F64, ids: Ints) -> None:
        """Note whose plan is blocked just ahead, at the start of a step, for `ids`."""
        self.blocked[ids] = False
        gap = np.abs(pallets[ids, :, :2] - pose[ids, None, :2]).max(axis=-1).min(axis=1)
        with_pallets = ids[gap < REACH_M]
        if len(with_pallets):
            self.blocked[with_pallets] = _blocked(
                pose[with_pallets], plans_m[with_pallets], pallets[with_pallets]
            )

    def condition(self, slipped: Bools, bumped: Bools, clearance_m: F64) -> NDArray[np.str_]:
        """All conditions (N,) of the step that ends now, as one text each."""
        near = bumped | (clearance_m < NEAR_M)
        held = np.stack([self.blocked, near, self.aftermath_s > 0, slipped])  # as NAMES
        which = (held << np.arange(len(NAMES))[:, None]).sum(axis=0)
        left = np.maximum(self.aftermath_s - self._period_s, 0.0)
        left[(clearance_m > CLEAR_M) & ~near] = 0.0
        self.aftermath_s = np.where(near, AFTERMATH_S, left)
        texts: NDArray[np.str_] = _TEXTS[which]
        return texts


def _blocked(pose: F64, plans_m: F64, pallets: F64) -> Bools:
    """Whether a pallet lies within the robot's breadth of the plan just ahead, (n,)."""
    view = view_route(plans_m, pose[:, 0], pose[:, 1], np.zeros(len(pose)), BLOCK_AHEAD_M)
    points = view.look_ahead_m + pose[:, None, :2]  # heading 0: offsets in the map frame
    gap = np.abs(points[:, :, None] - pallets[:, None, :, :2])
    half = pallet_half_m(pallets[:, None, :, 2]) + BODY_MARGIN_M
    inside = (gap <= half).all(axis=-1).reshape(len(pose), -1)
    return np.asarray(inside.any(axis=1), np.bool_)
