"""The known map and a dry floor."""

from __future__ import annotations

import numpy as np

from restock.arrays import F64
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.missions.mission import Mission, Staged


def stage(rng: np.random.Generator, warehouse: Warehouse, plan: F64) -> Staged:
    """Stage nothing."""
    return Staged()


MISSION = Mission("nominal", stage, share=0.4, natural=0.80, colour="#6b7280", place=0)
