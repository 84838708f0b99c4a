"""The twin on MuJoCo Warp drives the same episodes as on MuJoCo, over short horizons.

What the host changes between two rollouts its device gets, once; a graph does what its substeps do.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from restock.errors import ConfigError
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.physics.perturbation import Perturbation

KINDS = {"nominal": 1.0, "wheel_slip": 1.0, "blocked_aisle": 1.0, "near_collision": 1.0}
HEAVY = Perturbation(name="heavy", payload_kg=30.0, wheel_radius_scale=0.96, friction_scale=0.6)
STEPS = 10  # of .2 s
SUBSTEPS = 10
BOTH = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_MOCAP_POS)

# A GPU adds contact forces up in no fixed order: one of 750 values was .0002 apart after 3 blocks.
STATE_ATOL = 1e-3


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


class Driven:
    """A batch of robots at the beginning of their episodes, and what its rollouts are given."""

    def __init__(self, env: WarehouseVectorEnv, batch: Any) -> None:
        of = env.simulation.batch
        self.batch = batch
        batch.expand("geom_friction")[:] = of.expand("geom_friction")
        batch.state[:] = of.state
        rng = np.random.default_rng(0)
        self.wheels = rng.uniform(1, 6, (env.num_envs, 1, 2))
        self.chassis = env.simulation.handles.chassis_body
        self.wheel_geoms = list(env.simulation.handles.wheel_geoms)

    def rollout(self, times: int = 1, record: tuple[str, ...] = ("sensordata",)) -> Any:
        """Some blocks of substeps; the records of the last."""
        places = self.batch.bind("mocap_pos").reshape(self.batch.nsim, 1, -1)
        control = np.concatenate([self.wheels, places], axis=-1)
        for _ in range(times):
            records = self.batch.rollout(SUBSTEPS, control, BOTH, record)
        return records

    def rays(self) -> np.ndarray:
        """Distances along rays from above the robots, (N, 8), nothing left out."""
        angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
        level = np.stack([np.cos(angle), np.sin(angle), np.zeros(8)], axis=-1)
        above = self.batch.bind("qpos")[:, None, :3] + [0, 0, 0.2]
        return self.batch.ray(above, level, bodyexclude=self.chassis)[0]


def episodes(count: int = 6) -> WarehouseVectorEnv:
    env = WarehouseVectorEnv(count, conditions=KINDS, seed=3)
    env.reset(seed=3)
    return env


def on_warp(env: WarehouseVectorEnv, device: str, capture: bool) -> Driven:
    from restock.train.twin.physics.warp_batch import WarpBatch

    return Driven(env, WarpBatch(env.simulation.model, env.num_envs, 1, device, capture))


def change(driven: Driven) -> None:
    """What a host may change between rollouts, in one simulation each; in the last nothing."""
    batch = driven.batch
    start = batch.bind("qpos")[0].copy()
    batch.reset(np.array([0]), stage=int(mujoco.mjtStage.mjSTAGE_NONE))
    batch.bind("qpos")[0] = start
    batch.bind("qvel")[1, :2] += 0.4
    batch.bind("mocap_pos")[2, 0, :2] = batch.bind("qpos")[2, :2]  # it is pushed out
    batch.bind("qvel")[3, :2] += 0.4
    batch.expand("geom_friction")[3, driven.wheel_geoms, 0] = 0.02
    batch.bind("xfrc_applied")[4, driven.chassis, 2] = 300.0
    batch.bind("xfrc_applied")[4, driven.chassis, 5] = 20.0


@pytest.mark.slow
@pytest.mark.parametrize("capture", [False, True], ids=["launched", "captured"])
def test_what_the_host_changes_between_rollouts_is_seen(device: str, capture: bool) -> None:
    env = episodes()
    ours, theirs = Driven(env, Batch(env.simulation.model, 6, 1)), on_warp(env, device, capture)
    unchanged = Driven(env, Batch(env.simulation.model, 6, 1))
    for driven in (ours, theirs, unchanged):
        driven.rollout(3)
        if driven is not unchanged:
            change(driven)
        driven.rollout(3)
    assert theirs.batch.captured == capture
    for field in ("qpos", "mocap_pos"):
        np.testing.assert_allclose(theirs.batch.bind(field), ours.batch.bind(field), atol=1e-4)
    assert theirs.batch.bind("time") == pytest.approx(ours.batch.bind("time"))
    moved = np.abs(ours.batch.bind("qpos") - unchanged.batch.bind("qpos")).max(axis=1)
    assert (moved[:5] > 0.01).all()
    assert moved[5] == 0


@pytest.mark.slow
def test_a_graph_does_what_its_substeps_do(device: str) -> None:
    env = episodes()
    launched, captured = (on_warp(env, device, capture) for capture in (False, True))
    graphs = []
    for block in range(6):
        if block == 3:  # a field of its own more: the device's model is another one
            for driven in (launched, captured):
                driven.batch.expand("body_mass")[:, driven.chassis] *= np.linspace(1, 2, 6)
                driven.batch.set_const(np.arange(6))
        mine, its = (
            driven.rollout(record=("sensordata", "qvel")) for driven in (launched, captured)
        )
        graphs.append(captured.batch.captured)
        for name in mine:
            np.testing.assert_allclose(its[name], mine[name], atol=1e-4, err_msg=name)
        np.testing.assert_allclose(captured.batch.state, launched.batch.state, atol=STATE_ATOL)
    assert graphs == [False, True, True] * 2
    assert not launched.batch.captured
    assert captured.batch.not_captured == ""


@pytest.mark.slow
@pytest.mark.parametrize("call", ["capture_begin", "capture_launch"])
def test_what_cannot_be_captured_runs_all_the_same(
    device: str, call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import warp

    def refuse(*_: Any, **__: Any) -> None:
        raise RuntimeError("not on this device")

    env = episodes()
    launched, refused = (on_warp(env, device, capture) for capture in (False, True))
    monkeypatch.setattr(warp, call, refuse)
    for driven in (launched, refused):
        driven.rollout(3)
    assert not refused.batch.captured
    assert refused.batch.not_captured == "RuntimeError: not on this device"
    np.testing.assert_allclose(refused.batch.state, launched.batch.state, atol=STATE_ATOL)


@pytest.mark.slow
def test_what_the_device_has_is_not_sent_again(device: str) -> None:
    env = episodes()
    driven = on_warp(env, device, False)
    batch = driven.batch

    def sent(run: Any) -> dict[str, int]:
        batch.sent.clear()
        run()
        return dict(batch.sent)

    given = {"ctrl", "mocap_pos"}  # with the controls of every substep
    rest = {"qpos", "qvel", "qacc_warmstart", "mocap_quat", "xfrc_applied", "geom_friction"}
    assert sent(driven.rollout) == dict.fromkeys(rest, 1)
    assert sent(driven.rollout) == sent(driven.rays) == sent(driven.rays) == {}
    assert sent(lambda: batch.rollout(SUBSTEPS)) == {}  # under the last controls
    batch.bind("qvel")[2] = 0.0
    batch.bind("mocap_pos")[1, 0, 0] += 1.0
    assert sent(driven.rays) == {"qvel": 1, "mocap_pos": 1}
    batch.expand("geom_friction")[0, :, 0] = 0.1
    batch.bind("mocap_pos")[1, 0, 0] += 1.0
    assert sent(driven.rollout) == {"geom_friction": 1}
    batch.state[:] = env.simulation.batch.state  # as when a saved state is restored
    assert not given & set(sent(driven.rollout))
    batch.reset(np.array([4]))
    assert {"qpos", "qvel"} <= set(sent(driven.rays))


@pytest.mark.slow
def test_rays_end_where_mujoco_has_them_end(device: str) -> None:
    env = episodes()
    ours, theirs = Driven(env, Batch(env.simulation.model, 6, 1)), on_warp(env, device, False)
    before = ours.rays()
    np.testing.assert_allclose(theirs.rays(), before, atol=1e-3)
    for driven in (ours, theirs):
        driven.rollout(5)
    np.testing.assert_allclose(theirs.rays(), ours.rays(), atol=5e-3)
    for driven in (ours, theirs):
        batch = driven.batch
        batch.state[:] = env.simulation.batch.state
        batch.bind("mocap_pos")[:, 0] = batch.bind("qpos")[:, :3] + [0.9, 0, 0]
    np.testing.assert_allclose(theirs.rays(), ours.rays(), atol=1e-3)
    assert (ours.rays()[:, 0] < 0.9).all()
    assert (before[:, 0] != ours.rays()[:, 0]).any()


def test_without_the_extra_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(ConfigError, match=r"pip install .*\[mjwarp\]'"):
        WarehouseVectorEnv(1, physics="warp")


def test_physics_that_is_not_there_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown physics 'bullet'"):
        WarehouseVectorEnv(1, physics="bullet")  # type: ignore[arg-type]
