"""Speeds from poses, where a robot has no odometry."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.driven_robot import SPEED_MPS, Drive, write_bag
from support.paths import SHARED

from restock.cli import main
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import load_profile
from restock.ingest.steps.episodes import steps_of
from restock.ingest.steps.frames import PoseSeries, motion_at
from restock.ingest.steps.needs import read_topics

NS = 10**9


def circle(stamps_s: Any, speed: float, turn: float, noise: float = 0.0, seed: int = 0) -> Any:
    """Poses on a circle through the origin, and white noise on them."""
    rng, yaw = np.random.default_rng(seed), np.asarray(stamps_s) * turn
    radius = speed / turn
    x, y = radius * np.sin(yaw), radius * (1 - np.cos(yaw))
    stamps = np.rint(np.asarray(stamps_s) * NS).astype(np.int64)
    x, y, yaw = (column + rng.normal(0, noise, len(stamps)) for column in (x, y, yaw))
    return PoseSeries.of(stamps, x, y, np.arctan2(np.sin(yaw), np.cos(yaw)))


@given(
    seed=st.integers(0, 1000),
    speed=st.floats(-1, 1),
    turn=st.floats(0.2, 2),
    window=st.sampled_from([0.2, 0.5, 1.0]),
)
def test_it_is_the_slope_of_a_line_through_the_last_poses(seed, speed, turn, window):
    rng = np.random.default_rng(seed)
    poses = circle(np.cumsum(rng.uniform(0.02, 0.12, 80)), speed, turn, 0.01, seed)
    ticks = np.arange(0, 5 * NS, NS // 10)
    found = motion_at(poses, ticks, window, 1.0)
    for index, tick in enumerate(ticks.tolist()):  # one by one, as one would write it down
        before = [i for i, stamp in enumerate(poses.stamp_ns.tolist()) if stamp <= tick]
        ago = [(poses.stamp_ns[before[-1]] - poses.stamp_ns[i]) / NS for i in before]
        assert (found.problem[index] == "") == any(window / 2 <= s <= 2 * window for s in ago)
        if found.problem[index]:
            continue
        used = [i for i, s in zip(before, ago, strict=True) if s <= window]
        if ago[used[0]] < window / 2:
            used = [used[0] - 1, *used]
        since = (poses.stamp_ns[used] - poses.stamp_ns[used[0]]) / NS
        yaw = np.unwrap(poses.yaw_rad[used])
        vx, vy, rate = (np.polyfit(since, c, 1)[0] for c in (poses.x_m[used], poses.y_m[used], yaw))
        ahead = yaw.mean()
        forward, left = (
            vx * np.cos(ahead) + vy * np.sin(ahead),
            vy * np.cos(ahead) - vx * np.sin(ahead),
        )
        assert found.forward_mps[index] == pytest.approx(forward, abs=1e-6)
        assert found.lateral_mps[index] == pytest.approx(left, abs=1e-6)
        assert found.yaw_rate_radps[index] == pytest.approx(rate, abs=1e-6)


@given(seed=st.integers(0, 1000), known=st.integers(0, 79))
def test_no_speed_sees_a_later_pose(seed, known):
    rng = np.random.default_rng(seed)
    poses = circle(np.cumsum(rng.uniform(0.02, 0.12, 80)), 0.5, 0.7, 0.01, seed)
    now = poses.stamp_ns[known : known + 1]
    past = PoseSeries(*(c[: known + 1] for c in vars(poses).values()))
    for name, column in vars(motion_at(poses, now, 0.4, 1.0)).items():
        assert column.tolist() == getattr(motion_at(past, now, 0.4, 1.0), name).tolist()


def test_poses_that_arrive_together_are_no_speed():
    """Of stamps that jitter, a pose 6 ms after the one before it gave ten times the speed."""
    even = np.arange(0, 20, 0.1)
    late = np.where(np.arange(200) % 4 == 0, 0.094, 0.0) * (even > 5)  # with the next one
    poses = circle(even, 0.4, 0.5)
    poses = PoseSeries.of(
        poses.stamp_ns + np.rint(late * NS).astype(int), *[*vars(poses).values()][1:]
    )
    kept = np.arange(200) % 8 < 6  # and some are lost
    poses = PoseSeries(*(column[kept] for column in vars(poses).values()))
    found = motion_at(poses, np.arange(6 * NS, 19 * NS, NS // 10), 0.2, 1.0)
    assert set(found.problem) == {""}
    assert found.forward_mps == pytest.approx(np.full(130, 0.4), abs=0.2)


class Relocalised(Drive):
    """Its localiser finds it .38 m further on, after 3 s."""

    def x_at(self, time_s: Any) -> Any:
        return super().x_at(time_s) + 0.38 * (time_s > 3.0)

    def topics(self) -> dict[str, TopicColumns]:
        topics = super().topics()
        del topics["/odom"], topics["/goal_pose"], topics["/plan"]
        return topics


def test_a_jump_that_no_robot_drives_is_counted_as_one(tmp_path, capsys):
    """Jumps of less than max_pose_jump_m were speeds of up to five times the fastest action."""
    bag, file, store = write_bag(Relocalised(8.0), tmp_path / "b"), tmp_path / "p", tmp_path / "s"
    assert main(["profile", "new", str(bag), "--out", str(file)]) == 0
    assert main(["ingest", str(bag), "--profile", str(file), "--store", str(store)]) == 0
    assert "wheels: a pose jump within" in capsys.readouterr().out
    query = "SELECT max(wheel_speed_mps) AS high, count(*) AS rows FROM transitions"
    assert main(["sql", str(store), query, "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["high"] == pytest.approx(SPEED_MPS)
    assert row["rows"] > 30


class NoOdometry(Drive):
    def topics(self) -> dict[str, TopicColumns]:
        topics = super().topics()
        del topics["/odom"], topics["/goal_pose"], topics["/plan"]
        return topics


def test_a_robot_without_odometry_is_read_and_said(tmp_path, capsys):
    bag, file, store = write_bag(NoOdometry(), tmp_path / "bag"), tmp_path / "p", tmp_path / "s"
    assert main(["profile", "new", str(bag), "--out", str(file)]) == 0
    assert "# [inputs.wheels]  # no usable odometry; instead: speeds from poses" in file.read_text()
    assert "wheel_slip" not in load_profile(file).shipped_conditions
    assert main(["ingest", str(bag), "--profile", str(file), "--store", str(store)]) == 0
    assert "no wheels: speeds from the poses of the last" in capsys.readouterr().out
    query = "SELECT min(wheel_speed_mps) AS low, max(wheel_speed_mps) AS high FROM transitions"
    assert main(["sql", str(store), query, "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["low"] == pytest.approx(SPEED_MPS) == row["high"]
    main(["audit", str(store), "--json"])
    said = json.loads(capsys.readouterr().out)["audits"]
    (found,) = [each for each in said if each["audit"] == "speeds_from_poses"]
    assert (found["status"], found["rows"]) == ("warn", 1)


def test_a_profile_has_wheels_or_motion(tmp_path, capsys):
    bag, file = write_bag(NoOdometry(), tmp_path / "bag"), tmp_path / "p.toml"
    main(["profile", "new", str(bag), "--out", str(file)])
    text = file.read_text()
    for wrong, what in (
        (text.replace("[motion]", "# [motion]").replace("window_s", "# window_s"), "no `motion`"),
        (text.replace('"near_collision"', '"wheel_slip"'), "wheel_slip cannot be detected"),
        (text.replace("window_s = 0.", "window_s = -0."), "motion.window_s must be in"),
    ):
        file.write_text(wrong)
        capsys.readouterr()
        assert main(["profile", "check", str(file), str(bag)]) == 2
        assert what in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
def test_a_real_robot_in_motion_capture(tmp_path, capsys):
    rows = []
    for name in ("test_2026-02-19-10-53-01", "test_2026-02-19-10-53-01.bag"):
        path, file = SHARED / "jackal-mocap" / name, tmp_path / f"{name}.toml"
        assert main(["profile", "new", str(path), "--out", str(file)]) == 0
        rows.append(_speeds(path, file))
    assert len(rows[0]) == 266
    assert np.array_equal(rows[0], rows[1])


def _speeds(path: Path, profile: Path) -> Any:
    with open_recording(path) as recording:
        made = load_profile(profile)
        steps = steps_of(made, read_topics(recording, made))
    names = ("wheel_speed_mps", "wheel_yaw_rate_radps", "pose_x_m", "command_speed_mps")
    return np.stack([steps.signals[name] for name in names], axis=1)
