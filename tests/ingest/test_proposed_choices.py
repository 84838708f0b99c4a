"""What a proposal chooses by the recording, and what it says that its choices cost."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.driven_robot import BEAMS, START_NS, Drive, pose, scans, write_bag
from support.paths import SHARED

from restock.cli import main
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import load_profile
from restock.ingest.propose.clock_choice import drivable
from restock.ingest.propose.commands import CommandHold, command_hold
from restock.ingest.steps.align import NS
from restock.ingest.steps.frames import PoseSeries
from restock.ingest.task.scan import Body
from restock.ingest.task.task import Task
from restock.train.twin.physics.simulation import blocks_of

PACES = [0.5, 0.9, 0.97, 1.0, 1.1]


@dataclass
class Commanded(Drive):
    """Commands at these times (s), received while the robot's clock ran at `pace` of log time."""

    times_s: tuple[float, ...] = ()
    pace: float = 1.0
    nearest_m: float = 3.0

    def topics(self) -> dict[str, TopicColumns]:
        topics = super().topics()
        del topics["/plan"], topics["/goal_pose"], topics["/behaviour_policy"]
        scan = topics["/scan"]
        scan.fields.update(scans(np.full((len(scan), BEAMS), self.nearest_m)))
        if self.times_s:
            at = START_NS + np.rint(np.array(self.times_s) * NS).astype(np.int64)
            count = len(at)
            fields = {"linear.x": np.full(count, 0.4), "angular.z": np.zeros(count)}
            topics["/cmd_vel"] = TopicColumns(at, at, fields)
        return {name: self._received(columns) for name, columns in topics.items()}

    def _received(self, columns: TopicColumns) -> TopicColumns:
        log = START_NS + np.rint((columns.log_time_ns - START_NS) / self.pace).astype(np.int64)
        return TopicColumns(log, log, columns.fields)


def propose(
    drive: Drive, folder: Path, capsys: pytest.CaptureFixture[str], *options: str, code: int = 0
) -> tuple[Path, dict[str, Any], Path]:
    """Return the bag, what `profile new --json` says, and the profile as a file."""
    bag = write_bag(drive, folder / "bag")
    assert main(["profile", "new", str(bag), "--json", *options]) == code
    said = json.loads(capsys.readouterr().out)
    file = folder / "proposed.toml"
    file.write_text(said["toml"])
    return bag, said, file


def test_commands_twice_a_second_make_no_gaps(tmp_path, capsys):
    rng = np.random.default_rng(0)
    times = 0.5 * np.arange(56) + rng.uniform(0, 0.04, 56)
    _, said, file = propose(Commanded(30.0, times_s=tuple(times)), tmp_path, capsys)
    assert (said["ticks"], said["transitions"]) == (56, 55)
    profile = load_profile(file)
    assert profile.task.control_period_s == pytest.approx(0.5)
    assert profile.clock.max_gap_s > 2 * profile.task.control_period_s
    assert said["advice"] == [
        {"key": "task.body", "text": "a guess, as the recording does not contain it: --footprint"}
    ]


def test_a_hold_is_read_from_how_long_the_robot_drives_on(tmp_path, capsys):
    times = (*np.arange(0, 1, 0.1), 6.0, 17.0)
    bag, said, file = propose(Commanded(20.0, times_s=tuple(times)), tmp_path, capsys)
    profile = load_profile(file)
    assert (profile.clock.steps, profile.inputs.command.max_age_s) == ("rate", pytest.approx(11))
    assert "drove on to the end of 3 of 3 gaps" in said["toml"]
    assert said["transitions"] > 90  # 20 s, five a second
    strict = file.read_text().replace("max_age_s = 11", "max_age_s = 1", 1)
    file.write_text(strict)
    assert main(["profile", "check", str(file), str(bag), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    (line,) = [line for line in said["advice"] if "inputs.command.max_age_s" in line]
    before = said["outcome"]["transitions"]
    assert f"{before:,} transitions" in line
    promised = int(line.split("without it (latched) ")[1].split()[0])
    held = strict.split("[inputs.command]")
    held[1] = held[1].replace("max_age_s", "# max_age_s", 1)
    file.write_text("[inputs.command]".join(held))
    assert main(["profile", "check", str(file), str(bag), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["outcome"]["transitions"] == promised > 3 * before


def driven(until_s: float, reported: list[tuple[float, float]]) -> CommandHold:
    """Return what is read of commands (time, speed) to a robot that goes .5 m/s, then stands."""
    at = np.arange(0, 30, 0.05)
    x = 0.5 * np.minimum(at, until_s)
    poses = PoseSeries((at * NS).astype(np.int64), x, np.zeros(len(at)), np.zeros(len(at)))
    times, speeds = (np.array(column) for column in zip(*reported, strict=True))
    return command_hold(times, speeds, np.zeros(len(times)), poses)


def test_a_driver_that_times_out_is_seen():
    hold = driven(10.6, [(0.1 * i, 0.5) for i in range(101)])
    assert hold.age_s == pytest.approx(0.6, abs=0.5)
    assert "it stood in 1 of them" in hold.comments[0]


def test_a_robot_that_is_moved_later_by_hand_did_not_drive_on():
    at = np.arange(0, 30, 0.05)
    x = 0.5 * np.minimum(at, 10.6) + np.maximum(at - 27, 0)
    poses = PoseSeries((at * NS).astype(np.int64), x, np.zeros(len(at)), np.zeros(len(at)))
    times = np.arange(0, 10.05, 0.1)
    hold = command_hold(times, np.full(len(times), 0.5), np.zeros(len(times)), poses)
    assert hold.age_s is not None
    assert hold.age_s < 1.2


def test_a_command_to_stop_holds_if_the_robot_stands():
    reported = [(0.1 * i, 0.5) for i in range(101)] + [(10.1, 0.0)]
    assert driven(10.2, reported).stops_hold
    assert not driven(25.0, reported).stops_hold  # somebody else drives it


def test_an_outline_that_the_lidar_contradicts_is_said(tmp_path, capsys):
    bag, said, file = propose(Commanded(10.0, nearest_m=0.28), tmp_path, capsys)
    texts = [each["text"] for each in said["advice"] if each["key"] == "task.body"]
    assert "inside the robot at 50" in texts[0]
    assert main(["profile", "check", str(file), str(bag)]) == 0
    out = capsys.readouterr().out
    assert "try: `recovery` holds on 48 of 48 transitions" in out
    assert "try: `task.body`: with an outline of 0.6 x 0.5 m" in out
    other = tmp_path / "small"
    other.mkdir()
    small = Commanded(10.0, nearest_m=0.28)
    _, said, file = propose(small, other, capsys, "--footprint", "0.1x0.1")
    assert said["advice"] == []
    body = load_profile(file).task.body
    assert (body.length_m, body.width_m) == (0.1, 0.1)


@pytest.mark.parametrize(
    ("width_m", "near_m"), [(0.1, 0.05), (0.3, 0.09), (0.5, 0.15), (0.7, 0.15)]
)
def test_how_near_is_near_follows_the_width(width_m, near_m, tmp_path, capsys):
    outline = f"0.3x{width_m}"
    _, said, file = propose(Commanded(10.0), tmp_path, capsys, "--footprint", outline)
    profile = load_profile(file)
    assert profile.task.rewards.tight_clearance_m == near_m
    near = next(one for one in profile.conditions if one.name == "near_collision")
    assert near.constants["tight_clearance_m"] == near_m
    assert ("tight_clearance_m" in said["toml"]) == (near_m < 0.15)


@dataclass
class Unsteady(Commanded):
    """Poses that lie up to this far ahead of where the robot is, or behind it, by turns."""

    off_m: float = 0.0
    odometry_alone: bool = False

    def topics(self) -> dict[str, TopicColumns]:
        topics = super().topics()
        poses = topics["/amcl_pose"].fields
        x = np.asarray(poses["pose.pose.position.x"])
        off = self.off_m * np.random.default_rng(0).uniform(-1, 1, len(x))
        poses["pose.pose.position.x"] = x + off
        if self.odometry_alone:
            del topics["/imu"], topics["/amcl_pose"]
            at = np.arange(0, self.duration_s, 0.02)
            topics["/odom"].fields.update(pose("pose.pose", self.x_at(at), 1.0))
        return topics


def test_by_how_much_poses_and_wheels_differ_is_measured(tmp_path, capsys):
    for off_m in (0.0, 0.03, 0.1):
        folder = tmp_path / str(off_m)
        folder.mkdir()
        bag, said, file = propose(Unsteady(20.0, off_m=off_m), folder, capsys)
        profile = load_profile(file)
        assert ("[noise]" in said["toml"]) == (off_m > 0.02)
        assert profile.noise.localiser_m == pytest.approx(max(off_m / 2, 0.01), rel=0.3)
        assert main(["profile", "check", str(file), str(bag)]) == 0
        assert "`wheel_slip` holds" not in capsys.readouterr().out


def test_odometry_alone_shows_no_slip(tmp_path, capsys):
    _, said, file = propose(Unsteady(10.0), tmp_path, capsys)
    assert "wheel_slip" in load_profile(file).shipped_conditions
    alone = tmp_path / "alone"
    alone.mkdir()
    _, said, file = propose(Unsteady(10.0, odometry_alone=True), alone, capsys)
    profile = load_profile(file)
    assert profile.inputs.pose is not None
    assert profile.inputs.pose.topic == profile.inputs.wheels.topic == "/odom"
    assert not {"wheel_slip", "slippery_floor"} & {one.name for one in profile.definitions}
    assert "wheel_slip" in said["toml"]  # why it is not there


@pytest.mark.parametrize("pace", PACES)
def test_periods_are_in_the_robots_own_time(pace, tmp_path, capsys):
    drive = Commanded(30.0, pace=pace)
    bag, said, file = propose(drive, tmp_path, capsys)
    profile = load_profile(file)
    assert profile.clock.alignment == "header.stamp"
    assert profile.task.control_period_s == pytest.approx(0.2)
    assert said["transitions"] == 147
    assert ("Header stamps run at" in said["toml"]) == (pace != 1.0)
    assert main(["profile", "check", str(file), str(bag), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["outcome"]["transitions"] == said["transitions"]


def test_log_time_where_stamps_cannot_be_followed(tmp_path, capsys):
    class Erratic(Commanded):
        def _received(self, columns: TopicColumns) -> TopicColumns:
            since = (columns.log_time_ns - START_NS) / NS
            log = since * 1.5 + 0.35 * np.floor(since / 0.7)  # and stands still now and then
            stamps = START_NS + np.rint(log * NS).astype(np.int64)
            return TopicColumns(stamps, stamps, columns.fields)

        def topics(self) -> dict[str, TopicColumns]:
            topics = super().topics()
            slow = np.arange(0, len(topics["/odom"]), 30)
            for name in ("/imu", "/amcl_pose", "/scan"):
                del topics[name]
            odom = topics["/odom"]
            fields = {path: np.asarray(column)[slow] for path, column in odom.fields.items()}
            fields |= pose("pose.pose", 0.4 * np.arange(len(slow)), 0.0)
            topics["/odom"] = TopicColumns(odom.log_time_ns[slow], odom.log_time_ns[slow], fields)
            return topics

    _, said, file = propose(Erratic(40.0), tmp_path, capsys)
    assert "[inputs.pose]" in said["toml"]
    assert load_profile(file).clock.alignment == "log_time"
    assert "Log time, as header stamps do not work: " in said["toml"]


@pytest.mark.long
@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
@pytest.mark.parametrize(
    ("bag", "transitions", "options"),
    [
        ("sim-time-husky", 77, ()),
        ("sim-time-mobrob", 41, ("--odometry-as-command",)),
        ("sim-time-robot-kf", 520, ("--odometry-as-command",)),
        ("robots/turtlebot3-sim/rosbag_test", 113, ()),
        ("robots/turtlebot3-sim-clock/ros2bag", 17, ()),
    ],
)
def test_of_simulations(bag, transitions, options, capsys):
    code = main(["profile", "new", str(SHARED / bag), "--json", *options])
    said = json.loads(capsys.readouterr().out)
    assert code == (3 if said["losses"] else 0)  # of one a file is missing
    assert said["transitions"] == transitions


@pytest.mark.long
@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
def test_a_small_robots_rows_are_not_all_recovery(tmp_path, capsys):
    file = tmp_path / "p.toml"
    bag = str(SHARED / "turtlebot3-sim-humble")
    assert main(["profile", "new", bag, "--out", str(file)]) == 0
    assert main(["profile", "check", str(file), bag, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["outcome"]["conditions"]["recovery"] <= 1  # was 124


def test_every_proposed_period_is_one_that_the_twin_can_drive() -> None:
    """Of 145 s of a fra2mo, .13 s were proposed, and then no twin could be built."""
    for period_s in np.arange(0.08, 0.5001, 0.001):
        proposed = drivable(float(period_s))
        assert proposed == pytest.approx(period_s, abs=0.025)
        task = Task(
            body=Body(0.6, 0.5), actions=((0.0, 0.0), (0.4, 0.0)), control_period_s=proposed
        )
        assert np.prod(blocks_of(task, 0.01)) == pytest.approx(proposed)
    for kept in (0.08, 0.1, 0.12, 0.2, 0.3, 0.5):
        assert drivable(kept) == kept
    # Of commands a fifth of a second apart .21 s were proposed, which no log of theirs can follow.
    assert [drivable(near) for near in (0.1015, 0.2003, 0.3012)] == [0.1, 0.2, 0.3]


def test_uneven_commands_get_a_tick_every_period(tmp_path, capsys):
    """Else nothing of the drive can be compared with the twin, which decides evenly."""
    rng = np.random.default_rng(0)
    uneven = np.cumsum(rng.choice([0.06, 0.1, 0.1, 0.1, 0.17], 200))
    for times, steps in ((uneven, "rate"), (np.arange(0, 20, 0.1), "command")):
        drive = Commanded(float(times[-1]), times_s=tuple(times))
        assert f'steps = "{steps}"' in propose(drive, tmp_path / steps, capsys)[1]["toml"]


def test_a_slow_robot_gets_time_to_arrive(tmp_path, capsys):
    """A Neato at .28 m/s got 48 s: less than the missions on its own floor take."""
    even = tuple(0.2 * np.arange(150))
    _, said, file = propose(Commanded(30.0, times_s=even), tmp_path, capsys)
    assert "time_limit_steps = 250  # 20 m at 0.4 m/s" in said["toml"]
    task = load_profile(file).task
    fastest_mps = max(speed for speed, _ in task.actions)
    assert task.time_limit_steps * task.control_period_s * fastest_mps >= 20.0


def test_a_fast_robot_keeps_the_default_time_limit(tmp_path, capsys):
    _, said, _ = propose(Commanded(30.0, times_s=tuple(0.5 * np.arange(60))), tmp_path, capsys)
    assert "time_limit_steps" not in said["toml"]
