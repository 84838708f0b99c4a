"""What can be in a robot's way on a floor: pallets, people, forklifts and slippery patches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from restock.arrays import F64

PALLETS = 2
PALLET_HALF_M = (0.60, 0.40, 0.30)  # long side along the aisle
PEOPLE = 2
PERSON_RADIUS_M = 0.25
PERSON_HALF_HEIGHT_M = 0.85
FORKLIFTS = 1
FORKLIFT_HALF_M = (0.60, 0.40, 0.60)
PARKED_M = (-50.0, -50.0, 1.0)  # where bodies wait that no episode uses
AGENTS = PEOPLE + FORKLIFTS  # the people first
WAY_POINTS = 24
PATCHES = 4  # at most, an episode: parts of the floor with a friction of their own
NO_PATCH = (1e6, 1e6, 0.0, 0.0, 1.0)  # x, y, half x, half y, friction


@dataclass(frozen=True)
class Walk:
    """One agent's way, (WAY_POINTS, 2) evenly spaced, and how it behaves on it."""

    way_m: F64
    speed_mps: float
    trigger: tuple[float, float, float]  # x, y, and how near the robot must come to it
    attentive: bool


def no_pallets() -> F64:
    """Every pallet parked off the floor."""
    return np.tile([PARKED_M[0], PARKED_M[1], 0.0], (PALLETS, 1))


def pallet_half_m(yaw_rad: F64) -> F64:
    """Half sizes (..., 2) along x and y of pallets by heading (...): across, they are exchanged."""
    across = np.abs(np.sin(yaw_rad))[..., None] > 0.7
    return np.where(across, PALLET_HALF_M[1::-1], PALLET_HALF_M[:2])
