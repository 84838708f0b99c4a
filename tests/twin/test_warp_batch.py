"""The twin on MuJoCo Warp drives the same episodes as on MuJoCo, over short horizons."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
import pytest

from restock.errors import ConfigError
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.physics.perturbation import Perturbation

KINDS = {"nominal": 1.0, "wheel_slip": 1.0, "blocked_aisle": 1.0, "near_collision": 1.0}
HEAVY = Perturbation(name="heavy", payload_kg=30.0, wheel_radius_scale=0.96, friction_scale=0.6)
STEPS = 10  # of .2 s


@pytest.fixture(params=["cpu", "cuda:0"])
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    pytest.importorskip("mujoco_warp")
    warp = pytest.importorskip("warp")
    if request.param.startswith("cuda") and not warp.is_cuda_available():
        pytest.skip("there is no CUDA device here")
    with warp.ScopedDevice(request.param):  # WarpBatch takes Warp's default
        yield request.param


def drive(env: WarehouseVectorEnv) -> list[tuple[np.ndarray, ...]]:
    """Steps under commands that are held for a second, as (pose, observation, reward, bumped)."""
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    steps = []
    for step in range(STEPS):
        if step % 5 == 0:
            action = rng.integers(env.single_action_space.n, size=env.num_envs)
        observation, reward, _, _, info = env.step(action)
        steps.append((info["true_pose"], observation, reward, info["signals"]["bumped"]))
    return steps


@pytest.mark.slow  # Warp compiles its kernels once on a machine: about a minute
@pytest.mark.parametrize("perturbation", [None, HEAVY], ids=["nominal", "heavy"])
def test_two_seconds_agree_within_a_millimetre(device: str, perturbation) -> None:
    given = {"conditions": KINDS, "perturbation": perturbation, "seed": 3}
    ours = drive(WarehouseVectorEnv(8, **given))
    theirs = drive(WarehouseVectorEnv(8, physics="warp", **given))
    moved = np.hypot(*(ours[-1][0] - ours[0][0])[:, :2].T)
    assert moved.max() > 0.5
    for (pose, observation, reward, bumped), (there, seen, earned, touched) in zip(
        ours, theirs, strict=True
    ):
        np.testing.assert_allclose(there, pose, atol=1e-3)
        np.testing.assert_allclose(seen, observation, atol=2e-3)
        np.testing.assert_allclose(earned, reward, atol=2e-3)
        assert touched.tolist() == bumped.tolist()


@pytest.mark.slow
def test_what_blows_up_is_cut_and_counted(device: str) -> None:
    env = WarehouseVectorEnv(2, physics="warp", seed=1)
    env.reset(seed=1)
    env.simulation.qvel[0] = np.nan
    _, reward, terminated, truncated, info = env.step(np.zeros(2, np.int64))
    assert info["invalid"].tolist() == truncated.tolist() == [True, False]
    assert not terminated.any()
    assert reward[0] == 0
    assert env.diverged == 1
    observation, *_, info = env.step(np.zeros(2, np.int64))
    assert np.isfinite(observation).all()
    assert not info["invalid"].any()


def test_without_the_extra_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(ConfigError, match=r"pip install .*\[mjwarp\]'"):
        WarehouseVectorEnv(1, physics="warp")


def test_physics_that_is_not_there_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown physics 'bullet'"):
        WarehouseVectorEnv(1, physics="bullet")  # type: ignore[arg-type]
