"""The noise of the twin's sensors."""

import numpy as np
from scipy.signal import lfilter

from restock.ingest.profile.profile import load_profile
from restock.train.twin.floors.layout import default_warehouse
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.physics.sensing import DRIFT_TIME_S, Sensing
from restock.train.twin.physics.simulation import Simulation

TASK = load_profile("warehouse_amr").task


def test_localisation_drifts_as_an_autoregressive_walk() -> None:
    sensing = Sensing(Simulation(4, TASK, default_warehouse(), 0.01, nthread=1), TASK)
    keep = np.exp(-TASK.control_period_s / DRIFT_TIME_S)
    walks = []
    for env in range(4):
        sensing.reset(env, np.random.SeedSequence(env), Perturbation())
        sensing._draw(env, TASK.time_limit_steps)
        walk = sensing._noise[env, :, 3:5]
        drawn = np.random.Generator(np.random.SFC64(np.random.SeedSequence(env))).standard_normal(
            dtype=np.float32, size=sensing._noise[env].shape
        )[:, 3:5]
        drawn[1:] *= np.sqrt(1 - keep**2)
        drawn[:] = lfilter([1.0], [1.0, -keep], drawn, axis=0)
        assert np.array_equal(walk, drawn)  # to the bit: episodes of earlier runs stay as they were
        walks.append(walk)
    assert 0.5 < np.var(walks) < 1.5
