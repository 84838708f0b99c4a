"""The action table of a proposal: it goes as fast, ahead and in reverse, as the logs' commands."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from support.driven_robot import Drive, columns, write_bag
from support.paths import SHARED

from restock.cli import main
from restock.ingest.profile.profile import load_profile, parse_profile
from restock.ingest.propose.commands import Commands
from restock.ingest.propose.proposal_lines import actions_of
from restock.ingest.propose.robot_choice import RobotProposal
from restock.ingest.task.scan import Body
from restock.ingest.task.task import Task, nearest_action
from restock.replay.store.store import Store

FAR = 0.25  # scaled distance from which ingest counts a command as far from its action


@dataclass
class Shuttle(Drive):
    """It drives ahead and back, in turns of 2 s, without goals."""

    duration_s: float = 24.0
    ahead_mps: float = 0.5
    back_mps: float = 0.5

    def topics(self) -> dict[str, Any]:
        def speed_at(at_s: Any) -> Any:
            return np.where(at_s % 4 < 2, self.ahead_mps, -self.back_mps)

        ticks, fast = np.arange(0, self.duration_s, 0.2), np.arange(0, self.duration_s, 0.02)
        found = super().topics()
        for topic in ("/goal_pose", "/plan"):
            del found[topic]
        reported = {"linear.x": speed_at(ticks), "angular.z": 0 * ticks}
        found["/cmd_vel"] = columns(ticks + 0.005, reported, stamped=False)
        moved = {"twist.twist.linear.x": speed_at(fast - 0.005), "twist.twist.angular.z": 0 * fast}
        found["/odom"] = columns(fast, moved)
        x_m = 1.0 + np.cumsum(speed_at(fast)) * 0.02
        at_s = np.arange(0, self.duration_s, 0.1)
        found["/amcl_pose"].fields["pose.pose.position.x"] = np.interp(at_s, fast, x_m)
        return found


def reverse(actions: Any) -> list[tuple[float, float]]:
    return [(speed, turn) for speed, turn in actions if speed < 0]


def reported(speeds: Any, turns: Any = 0.0) -> Commands:
    speeds = np.asarray(speeds, np.float64)
    return Commands().fastest(speeds, np.broadcast_to(turns, speeds.shape))


@pytest.mark.parametrize(("ahead_mps", "back_mps"), [(0.5, 0.5), (0.5, 0.1), (0.2, 0.2)])
def test_a_robot_backs_up_as_fast_as_its_logs(ahead_mps, back_mps, tmp_path):
    bag = write_bag(Shuttle(ahead_mps=ahead_mps, back_mps=back_mps), tmp_path / "bag")
    file = tmp_path / "robot.toml"
    assert main(["profile", "new", str(bag), "--out", str(file)]) == 0
    assert reverse(load_profile(file).task.actions) == [(-back_mps, 0.0)]
    assert main(["ingest", str(bag), "--profile", str(file), "--store", str(tmp_path / "s")]) == 0
    with Store(tmp_path / "s") as store:
        far, rows = store.sql(
            f"SELECT count(*) FILTER (action_residual > {FAR}), count(*) FROM transitions"
        ).fetchall()[0]
    assert rows > 60
    assert far == 0


def test_without_reverse_commands_there_is_no_reverse_action():
    assert reverse(actions_of(reported([0.0, 0.2, 0.5]), RobotProposal())) == []


def test_an_outlier_is_no_reverse_speed():
    """Neither faster than all usual commands, nor by one of hundreds."""
    once = [*[0.5] * 400, *[-0.2] * 200, -0.5]
    assert reverse(actions_of(reported(once), RobotProposal())) == [(-0.2, 0.0)]
    beyond = [*[0.5] * 400, -3.0]
    assert reverse(actions_of(reported(beyond), RobotProposal())) == [(-0.5, 0.0)]


def test_what_the_robot_did_not_reach_is_no_reverse_speed_either():
    limited = reported([*[0.5] * 9, *[-0.5] * 9]).limited(0.3, None)
    assert reverse(actions_of(limited, RobotProposal())) == [(-0.3, 0.0)]


@pytest.mark.parametrize("slowest", [0.0, 0.3, 0.6, 1.0])
@pytest.mark.parametrize("fastest", [0.3, 0.7, 1.0])
def test_reverse_at_many_speeds_is_near_an_action(slowest, fastest):
    back = np.linspace(min(slowest, fastest), fastest, 200)
    speeds = np.concatenate([np.ones(300), -back])
    actions = actions_of(reported(speeds), RobotProposal())
    task = Task(body=Body(0.6, 0.5), actions=tuple(actions))
    assert nearest_action(task, speeds, 0 * speeds)[1].max() <= FAR


def test_a_car_backs_up_and_turns_as_fast_as_its_logs():
    car = RobotProposal(values={"drive": "ackermann", "wheelbase_m": 0.4, "max_steering_rad": 0.5})
    commands = reported([*[1.0] * 50, *[-0.8] * 50], 0.5)
    backs = reverse(actions_of(commands, car))
    assert {speed for speed, _ in backs} == {-0.8}
    assert sorted(np.sign(turn) for _, turn in backs) == [-1, 0, 1]
    assert reverse(actions_of(reported([1.0, 0.5], 0.5), car)) == []


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
@pytest.mark.parametrize(
    ("name", "speed_mps"),
    [("robots/neato-map-ros1/ac109_3_demo.bag", 0.0927), ("jetacker", 1.0)],
)
def test_of_robots_that_back_up(name, speed_mps, capsys):
    assert main(["profile", "new", str(SHARED / name), "--json"]) == 0
    profile = parse_profile(json.loads(capsys.readouterr().out)["toml"], where="p")
    backs = reverse(profile.task.actions)
    assert min(speed for speed, _ in backs) == pytest.approx(-speed_mps, rel=0.01)
