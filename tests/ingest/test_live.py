"""A policy on a running robot: its observations equal those of an ingest, its actions torch's."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from support.kept_run import kept_network, kept_run
from support.paths import ROOT
from support.profile_texts import WAREHOUSE

from restock.cli import run_node
from restock.errors import ConfigError, RecordingError
from restock.ingest.live.observer import LiveObserver
from restock.ingest.live.pilot import Pilot, play
from restock.ingest.live.policy_file import PolicyFile
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile, profile_toml
from restock.ingest.profile.tables import Frames
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store
from restock.train.evaluation.policies import GreedyPolicy
from restock.train.twin.recording.bag_writer import typestore

BAG = ROOT / "sample_logs" / "amr_tuesday"
PROFILE = load_profile("warehouse_amr")
TASK = PROFILE.task
GOALS = ("[inputs.goal]", "[inputs.plan]", 'goal.source = "logged"')


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an exported, untrained policy."""
    return export_policy(tmp_path_factory.mktemp("runs"))


def export_policy(folder: Path, profile: str = "warehouse_amr") -> Path:
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    from restock.train.evaluation.onnx_policy import export_onnx

    out = folder / "policy.onnx"
    export_onnx(kept_run(folder / "a", profile=profile), out)
    return out


@pytest.mark.long
def test_live_observations_match_ingest(tmp_path):
    """The task has tracks and observation entries of its own, which are the last 20."""
    nearing = "lag(clearance_m, 2) OVER episode - clearance_m"
    own = f'observed = {{ nearing = "{nearing}", go = "goal_distance_m" }}\n'
    text = profile_toml(PROFILE).replace("\n[task]\n", f"\n[task]\ntracks = 3\n{own}")
    (tmp_path / "tracking.toml").write_text(text)
    profile = load_profile(tmp_path / "tracking.toml")
    policy = PolicyFile(export_policy(tmp_path, str(tmp_path / "tracking.toml")))
    decisions = {played.log_time_ns: played for played in play(Pilot(policy, None), BAG)}
    assert "rclpy" not in sys.modules

    ingest(BAG, profile, store=StoreWriter(tmp_path / "store"))
    with Store(tmp_path / "store") as store:
        rows = store.sql(
            "SELECT observation, stamp_ns + clock_offset_ns AS log_time_ns, action"
            " FROM transitions JOIN (SELECT ingest_id, clock_offset_ns FROM recordings)"
            " USING (ingest_id) ORDER BY transition_id"
        ).to_arrow_table()
    stored = np.stack(rows["observation"].to_pylist()).astype(np.float32)
    times = rows["log_time_ns"].to_pylist()
    assert len(times) > 700
    assert stored[:, profile.task.observation_names.index("nav_known")].all()
    assert stored[:, -5].sum() > 20  # steps with a track
    assert np.count_nonzero(stored[:, -2]) > 700
    assert set(times) <= decisions.keys()  # a decision for every step
    live = np.stack([decisions[at].decision.observed.observation for at in times])
    assert not any(decisions[at].decision.reason for at in times)
    np.testing.assert_allclose(live[:, :-20], stored[:, :-20], rtol=1e-6, atol=1e-6)
    # A running robot knows the offset of its clock within microseconds.
    np.testing.assert_allclose(live[:, -20:], stored[:, -20:], atol=1e-4)
    greedy, _ = GreedyPolicy(kept_network(task=profile.task)).act(None, live)
    assert [decisions[at].decision.action for at in times] == greedy.tolist()
    assert len(set(greedy.tolist())) > 1
    assert [decisions[at].drove for at in times] == rows["action"].to_pylist()
    # Without a limiter the command is that of the action table.
    decision = decisions[times[0]].decision
    assert decision.command == decision.proposal == profile.task.actions[decision.action]


def test_recording_with_truncated_message_cannot_be_played(policy, tmp_path):
    bag = tmp_path / "bag"
    with Writer(bag, version=9) as writer:
        to = writer.add_connection("/cmd_vel", "geometry_msgs/msg/Twist", typestore=typestore())
        writer.write(to, 1, bytes(20))
    with pytest.raises(RecordingError, match="cannot be played"):
        list(play(Pilot(PolicyFile(policy), None), bag))


@pytest.mark.long
def test_node_command_plays_a_recording(policy, tmp_path, capsys):
    assert run_node([str(policy), "--on", str(BAG)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["decisions"] > 700
    assert 0 < report["latency_ms"]["p50"] <= report["latency_ms"]["p99"]
    assert 0 < report["agreement"] < 1
    assert report["limited"]
    assert not report["unreadable"]
    # A missing recording, policy or ROS is reported.
    assert run_node([str(policy), "--on", str(tmp_path / "none")]) == 2
    assert run_node([str(tmp_path / "none.onnx"), "--on", str(BAG)]) == 2
    assert run_node([str(policy)]) == 2
    stderr = capsys.readouterr().err
    assert "none: no such file or folder" in stderr
    assert "none.onnx: no such file" in stderr
    assert "needs ROS 2" in stderr


def stamped(stamp_ns: int, **fields: Any) -> SimpleNamespace:
    stamp = SimpleNamespace(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp), **fields)


def odometry(stamp_ns: int, speed_mps: float) -> SimpleNamespace:
    twist = SimpleNamespace(linear=SimpleNamespace(x=speed_mps), angular=SimpleNamespace(z=0.0))
    return stamped(stamp_ns, twist=SimpleNamespace(twist=twist))


def test_message_off_the_clock_is_dropped_and_counted():
    observer = LiveObserver(PROFILE)
    for index in range(5):
        observer.receive("/odom", odometry(index * 10**8, 1.0), index * 10**8 + 2_000_000)
    observer.receive("/odom", odometry(6 * 10**8 + 2 * 10**9, 1.0), 6 * 10**8)
    assert observer.left_out == {"/odom": 1}
    assert observer.offset_ns == 2_000_000


def test_observer_memory_does_not_grow():
    observer = LiveObserver(PROFILE)
    for index in range(1000):
        observer.receive("/odom", odometry(index * 10**7, 1.0), index * 10**7)
        if index % 20 == 19:
            observer.observe(index * 10**7)
    assert sum(len(held) for held in observer._buffers.values()) < 30


def test_observer_rejects_frames_and_hindsight_goals(tmp_path: Path) -> None:
    framed = msgspec.structs.replace(PROFILE, frames=Frames())
    file = tmp_path / "hindsight.toml"
    without_goals = WAREHOUSE.split("[inputs.goal]")[0]
    file.write_text(f'{without_goals}\n[goal]\nsource = "hindsight"\n')
    for profile, needs in ((framed, ("[inputs.pose]",)), (load_profile(str(file)), GOALS)):
        with pytest.raises(ConfigError) as error:
            LiveObserver(profile)
        assert all(text in str(error.value) for text in needs)
