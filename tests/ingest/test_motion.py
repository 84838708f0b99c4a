"""Speeds from poses, for robots without odometry."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.driven_robot import SPEED_MPS, Drive, write_bag
from support.ingested import ingested, proposed

from restock.ingest.steps.frames import PoseSeries, motion_at

NS = 10**9


def circle(stamps_s: Any, speed: float, turn: float, noise: float = 0.0, seed: int = 0) -> Any:
    """Return poses on a circle through the origin, with white noise."""
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
def test_speed_is_slope_of_line_through_last_poses(seed, speed, turn, window):
    rng = np.random.default_rng(seed)
    poses = circle(np.cumsum(rng.uniform(0.02, 0.12, 80)), speed, turn, 0.01, seed)
    ticks = np.arange(0, 5 * NS, NS // 10)
    found = motion_at(poses, ticks, window, 1.0)
    for index, tick in enumerate(ticks.tolist()):  # tick by tick, as in the definition
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


def test_jittering_stamps_do_not_inflate_speed():
    """A pose stamped 6 ms after the previous one used to give ten times the speed."""
    even = np.arange(0, 20, 0.1)
    # stamped almost with the next one
    late = np.where(np.arange(200) % 4 == 0, 0.094, 0.0) * (even > 5)
    poses = circle(even, 0.4, 0.5)
    poses = PoseSeries.of(
        poses.stamp_ns + np.rint(late * NS).astype(int), *[*vars(poses).values()][1:]
    )
    kept = np.arange(200) % 8 < 6  # some poses are lost
    poses = PoseSeries(*(column[kept] for column in vars(poses).values()))
    found = motion_at(poses, np.arange(6 * NS, 19 * NS, NS // 10), 0.2, 1.0)
    assert set(found.problem) == {""}
    assert found.forward_mps == pytest.approx(np.full(130, 0.4), abs=0.2)


class NoOdometry(Drive):
    drop = ("/odom", "/goal_pose", "/plan")


class RelocalisedDrive(NoOdometry):
    """Drive whose localiser moves it 0.38 m ahead after 3 s."""

    def x_at(self, time_s: Any) -> Any:
        return super().x_at(time_s) + 0.38 * (time_s > 3.0)


def test_small_pose_jumps_are_counted_as_jumps(tmp_path, capsys):
    """Jumps below max_pose_jump_m used to give speeds of up to five times the fastest action."""
    bag, file = write_bag(RelocalisedDrive(8.0), tmp_path / "bag"), tmp_path / "p.toml"
    proposed(bag, file)
    query = "SELECT max(wheel_speed_mps), count(*) > 30 FROM transitions"
    with ingested(bag, file, tmp_path / "s") as store:
        assert store.sql(query).fetchall() == [(pytest.approx(SPEED_MPS), True)]
    assert "wheels: a pose jump within" in capsys.readouterr().out


def test_speeds_from_poses_are_used_and_reported(tmp_path, capsys, shell):
    bag, file, store = write_bag(NoOdometry(), tmp_path / "bag"), tmp_path / "p", tmp_path / "s"
    assert "wheel_slip" not in proposed(bag, file).shipped_conditions
    assert "# [inputs.wheels]  # no usable odometry; instead: speeds from poses" in file.read_text()
    with ingested(bag, file, store) as opened:
        query = "SELECT min(wheel_speed_mps), max(wheel_speed_mps) FROM transitions"
        assert opened.sql(query).fetchall() == [(pytest.approx(SPEED_MPS),) * 2]
    assert "no wheels: speeds from the poses of the last" in capsys.readouterr().out
    audits = shell.json("audit", store, code={0, 1, 3})["audits"]
    (found,) = [audit for audit in audits if audit["audit"] == "speeds_from_poses"]
    assert (found["status"], found["rows"]) == ("warn", 1)


def test_profile_needs_wheels_or_motion(tmp_path, shell):
    bag, file = write_bag(NoOdometry(), tmp_path / "bag"), tmp_path / "p.toml"
    proposed(bag, file)
    text = file.read_text()
    for wrong, message in (
        (text.replace("[motion]", "# [motion]").replace("window_s", "# window_s"), "no `motion`"),
        (text.replace('"near_collision"', '"wheel_slip"'), "wheel_slip cannot be detected"),
        (text.replace("window_s = 0.", "window_s = -0."), "motion.window_s must be in"),
    ):
        file.write_text(wrong)
        assert message in shell.err("profile", "check", file, bag)
