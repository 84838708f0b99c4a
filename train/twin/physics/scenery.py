"""What stands and moves around the robots: boxes of the one model, written into its batch.

Racks and walls are geoms, placed again where an episode is on another floor; pallets, people and
forklifts are mocap bodies.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from restock.arrays import F64, Ints
from restock.state import Stateful
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.obstacles import PALLETS, PARKED_M
from restock.train.twin.physics.episode import Episode
from restock.train.twin.physics.model import MOVING_HALF_M, Handles, building_boxes
from restock.train.twin.physics.traffic import Traffic


class Scenery(Stateful):
    """The scenery of N warehouses. Arrays lead with the environment."""

    STATE = ("walked", "traffic")

    def __init__(
        self,
        batch: Any,
        handles: Handles,
        floors: Sequence[Warehouse],
        rack_slots: int,
        robot_half_m: tuple[float, float],
        lidar_z_m: float,
        moves: F64,
    ) -> None:
        """`moves` (N, substeps, 3 * nmocap) are the mocap positions of the coming block, which
        are written here and read by who runs it."""
        num_envs = len(moves)
        self.batch, self.handles, self.moves = batch, handles, moves
        self.traffic = Traffic(num_envs, robot_half_m)
        self.pallets = np.full((num_envs, PALLETS, 3), PARKED_M[0])
        self.walked = np.zeros(0, np.int64)  # where traffic moved in the last block
        self.position_m = batch.bind("mocap_pos")  # (N, nmocap, 3) of pallets, people, forklifts
        self.quat = batch.bind("mocap_quat")
        self.buildings = [building_boxes(floor, rack_slots, lidar_z_m) for floor in floors]
        self.floor = np.zeros(num_envs, np.int64)  # whose building stands

    def build(self, env: int, floor: int) -> None:
        """Racks and walls of a floor."""
        if floor == self.floor[env]:
            return
        self.floor[env] = floor
        where, (middle, half) = self.handles.building, self.buildings[floor]
        self.batch.expand("geom_pos")[env, where] = middle
        self.batch.expand("geom_size")[env, where] = half
        self.batch.expand("geom_aabb")[env, where, 3:] = half
        self.batch.expand("geom_rbound")[env, where] = np.sqrt((half**2).sum(axis=1))

    def reset(self, env: int, episode: Episode) -> None:
        """Pallets, people and forklifts as an episode begins."""
        self.pallets[env] = episode.pallets
        self.position_m[env, :, :2] = PARKED_M[:2]
        self.position_m[env, :, 2] = MOVING_HALF_M[:, 2]  # they stand on the floor
        self.quat[env, :, :] = (1.0, 0.0, 0.0, 0.0)
        span = self.handles.pallets
        self.position_m[env, span, :2] = episode.pallets[:, :2]
        self.quat[env, span] = quaternion(episode.pallets[:, 2])
        self.traffic.reset(env, episode.walks)
        ids = np.array([env])
        self._show_traffic(ids)
        self.stand_still(ids)

    def walk(self, ids: Ints) -> None:
        """Show traffic in `ids` where it now is, at the end of the coming block.

        On the way there it moves a little at every substep: a jump of a block's length would
        strike the robot like a hammer.
        """
        self.stand_still(self.walked)  # who stood still since
        self.walked = ids
        if not len(ids):
            return
        begin = self.position_m[ids][:, None].copy()
        self._show_traffic(ids)
        end = self.position_m[ids][:, None]
        substeps = self.moves.shape[1]
        share = ((np.arange(substeps) + 1) / substeps)[None, :, None, None]
        jumped = (np.abs(end - begin) > 1.0).any(axis=-1, keepdims=True)
        path = np.where(jumped, end, begin + share * (end - begin))
        self.moves[ids] = path.reshape(len(ids), substeps, -1)

    def stand_still(self, ids: Ints) -> None:
        """Nothing moves in `ids` during the coming block."""
        self.moves[ids] = self.position_m[ids].reshape(len(ids), 1, self.moves.shape[2])

    def restored(self) -> None:
        """Bodies stand where the restored physics has them."""
        self.stand_still(np.arange(len(self.moves)))

    def _show_traffic(self, ids: Ints) -> None:
        if len(ids):
            people = slice(self.handles.people.start, self.handles.forklifts.stop)
            self.position_m[ids, people, :2] = self.traffic.position_m[ids]
            self.quat[ids, people] = quaternion(self.traffic.heading_rad[ids])


def quaternion(yaw_rad: F64) -> F64:
    """Unit quaternions (..., 4), w first, of headings (...)."""
    half = yaw_rad / 2
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def rotated(quat: F64, vector: F64) -> F64:
    """Vectors (..., 3) turned by unit quaternions (..., 4), w first."""
    axis = quat[..., 1:]
    across = 2 * np.cross(axis, vector)
    turned: F64 = vector + quat[..., :1] * across + np.cross(axis, across)
    return turned
