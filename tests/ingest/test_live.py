"""A policy on a running robot: what it sees is what an ingest stores, and it acts as in torch."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from support.kept_run import kept_network, kept_run
from support.paths import ROOT

from restock.errors import ConfigError
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import Frames, load_profile
from restock.ingest.steps.live import LiveObserver
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store
from restock.train.evaluation.policies import GreedyPolicy

BAG = ROOT / "sample_logs" / "amr_tuesday"
EXAMPLE = ROOT / "docs" / "examples" / "ros2_policy.py"
PROFILE = load_profile("warehouse_amr")
TASK = PROFILE.task


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exported policy that never learnt anything: which one it is does not matter."""
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    from restock.train.evaluation.onnx_policy import export_onnx

    path = kept_run(tmp_path_factory.mktemp("runs") / "a")
    out = path.parent / "policy.onnx"
    export_onnx(path, out)
    return out


def example() -> Any:
    spec = importlib.util.spec_from_file_location("ros2_policy", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_node_sees_what_ingest_stores_and_acts_as_torch_does(
    policy: Path, tmp_path: Path
) -> None:
    module = example()
    bag = module.BagNode(BAG)
    node = module.PolicyNode(bag, policy, module.twist_class)
    decisions: dict[int, tuple[Any, int]] = {}
    bag.play(lambda log_time_ns, _: decisions.__setitem__(log_time_ns, node.last))
    assert "rclpy" not in sys.modules

    ingest(BAG, PROFILE, store=StoreWriter(tmp_path / "store"))
    with Store(tmp_path / "store") as store:
        rows = store.sql(
            "SELECT observation, stamp_ns + clock_offset_ns AS log_time_ns, action"
            " FROM transitions JOIN (SELECT ingest_id, clock_offset_ns FROM recordings)"
            " USING (ingest_id) ORDER BY transition_id"
        ).to_arrow_table()
    stored = np.stack(rows["observation"].to_pylist()).astype(np.float32)
    times = rows["log_time_ns"].to_pylist()
    assert len(times) > 700
    assert stored[:, TASK.observation_names.index("nav_known")].all()
    assert set(times) <= decisions.keys()  # a decision for every step
    live = np.stack([decisions[at][0].observation for at in times])
    assert not any(decisions[at][0].problem for at in times)
    np.testing.assert_allclose(live, stored, rtol=1e-6, atol=1e-6)
    greedy, _ = GreedyPolicy(kept_network()).act(None, stored)
    assert [decisions[at][1] for at in times] == greedy.tolist()
    assert len(set(greedy.tolist())) > 1
    # What it published is the action table's.
    speeds = {command.linear.x for command in bag.published}
    assert speeds <= {speed for speed, _ in TASK.actions}


def test_the_example_reports_its_latency(policy: Path) -> None:
    found = subprocess.run(
        [sys.executable, str(EXAMPLE), str(policy), str(BAG)],
        capture_output=True,
        text=True,
        check=True,
    )
    said = msgspec.json.decode(found.stdout)
    assert said["decisions"] > 700
    assert 0 < said["latency_ms"]["p50"] <= said["latency_ms"]["p99"]


def stamped(stamp_ns: int, **fields: Any) -> SimpleNamespace:
    stamp = SimpleNamespace(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp), **fields)


def odometry(stamp_ns: int, speed_mps: float) -> SimpleNamespace:
    twist = SimpleNamespace(linear=SimpleNamespace(x=speed_mps), angular=SimpleNamespace(z=0.0))
    return stamped(stamp_ns, twist=SimpleNamespace(twist=twist))


def test_silence_is_a_problem_and_not_an_observation() -> None:
    observer = LiveObserver(PROFILE)
    known = observer.observe(10**9)
    assert "nothing received yet on" in known.problem
    assert "/scan" in known.problem
    assert not known.observation.any()


def test_a_message_off_the_clock_is_left_out_and_counted() -> None:
    observer = LiveObserver(PROFILE)
    for index in range(5):
        observer.receive("/odom", odometry(index * 10**8, 1.0), index * 10**8 + 2_000_000)
    observer.receive("/odom", odometry(10**15, 1.0), 6 * 10**8)
    assert observer.left_out == {"/odom": 1}
    assert observer.offset_ns == 2_000_000


def test_memory_does_not_grow_with_messages() -> None:
    observer = LiveObserver(PROFILE)
    for index in range(1000):
        observer.receive("/odom", odometry(index * 10**7, 1.0), index * 10**7)
        if index % 20 == 19:
            observer.observe(index * 10**7)
    assert sum(len(held) for held in observer._buffers.values()) < 30


def test_a_profile_that_needs_transforms_is_refused() -> None:
    framed = msgspec.structs.replace(PROFILE, frames=Frames())
    with pytest.raises(ConfigError, match="by transforms"):
        LiveObserver(framed)
