"""The robots' bodies as a perturbation has them: payload, wheels, and the pull of a slope."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from restock.train.twin.physics.model import CHASSIS_KG, TRACK_M, WHEEL_RADIUS_M, Handles
from restock.train.twin.physics.perturbation import Perturbation

F64 = NDArray[np.float64]

GRAVITY_MPS2 = 9.81


class RobotBody:
    """What a perturbation changes of N robots, written into the batch that holds them.

    Fields are made per-simulation when first needed: as long as no episode asks for it, all share
    the model's.
    """

    def __init__(self, batch: Any, model: mujoco.MjModel, handles: Handles, num_envs: int) -> None:
        self.batch, self.model, self.handles = batch, model, handles
        self.radius_m = np.full(num_envs, WHEEL_RADIUS_M)  # (N,) of the wheels
        self._masses = self._radii = self._sloped = False

    def apply(self, env: int, perturbation: Perturbation) -> None:
        """Write a perturbation's payload, wheels and slope into one environment."""
        self._slope(env, perturbation)
        if perturbation.payload_kg or self._masses:
            self._masses = True
            body = self.handles.chassis_body
            mass, inertia = self.batch.expand("body_mass"), self.batch.expand("body_inertia")
            scale = 1.0 + perturbation.payload_kg / CHASSIS_KG
            mass[env, body] = self.model.body_mass[body] * scale
            inertia[env, body] = self.model.body_inertia[body] * scale
        if (perturbation.wheel_radius_scale, perturbation.track_scale) != (1, 1) or self._radii:
            self._radii = True
            radius = WHEEL_RADIUS_M * perturbation.wheel_radius_scale
            self.radius_m[env] = radius
            size, bound = self.batch.expand("geom_size"), self.batch.expand("geom_rbound")
            place = self.batch.expand("body_pos")
            for geom in self.handles.wheel_geoms:
                size[env, geom, 0] = bound[env, geom] = radius
            for body, side in zip(self.handles.wheel_bodies, (1, -1), strict=True):
                place[env, body, 1] = side * TRACK_M / 2 * perturbation.track_scale
                # So that the casters keep their share of the load.
                place[env, body, 2] = radius - WHEEL_RADIUS_M
        if self._masses or self._radii:
            self.batch.set_const(np.array([env]))

    def _slope(self, env: int, perturbation: Perturbation) -> None:
        """Gravity along a sloping floor, as a force on the chassis in place of a tilted floor."""
        rise = np.array([perturbation.slope_x, perturbation.slope_y])
        if not rise.any() and not self._sloped:
            return
        self._sloped = True
        body = self.handles.chassis_body
        weight = (self.model.body_subtreemass[body] + perturbation.payload_kg) * GRAVITY_MPS2
        force = self.batch.bind("xfrc_applied")
        force[env, body, :2] = -weight * rise / np.sqrt(1 + rise @ rise)
