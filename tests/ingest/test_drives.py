"""Several drives of one kind of robot: grouping by kind, and one profile for all of them."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from support.driven_robot import FREE_M, PERIOD_S, Drive, columns, scans, write_bag
from support.paths import ROOT

from restock.ingest.containers.open_recording import open_recording
from restock.ingest.containers.recording import Recording
from restock.ingest.profile.profile import load_profile, parse_profile
from restock.ingest.propose import drives as drives_module
from restock.ingest.propose.drives import (
    Lidar,
    Proposal,
    RobotTraits,
    drives_by_kind,
    propose_for_drives,
    robot_kinds,
    robot_traits,
    try_toml,
)

TWIST = "geometry_msgs/msg/Twist"
WHEELS = "".join(
    f'<link name="{side}"><collision><geometry><cylinder radius="0.05" length="0.02"/></geometry>'
    f'</collision></link><joint name="{side}_joint" type="continuous"><parent link="base"/>'
    f'<child link="{side}"/><origin xyz="0 {y} 0" rpy="1.5708 0 0"/><axis xyz="0 0 1"/></joint>'
    for side, y in (("left", 0.2), ("right", -0.2))
)
DESCRIBED = (
    '<robot name="trolley"><link name="base"><collision><geometry><box size="0.7 0.45 0.2"/>'
    f"</geometry></collision></link>{WHEELS}</robot>"
)


@dataclass
class ConfiguredDrive(Drive):
    """Drive without goals, at a commanded speed, seen by a lidar with this many beams."""

    speed_mps: float = 0.4
    every_s: float = PERIOD_S
    beams: int = 72
    description: str | None = None

    def topics(self):
        typed = super().topics()
        ticks = np.arange(0, self.duration_s, self.every_s)
        turned = np.zeros(len(ticks))
        reported = {"linear.x": np.full(len(ticks), self.speed_mps), "angular.z": turned}
        typed["/cmd_vel"] = columns(ticks + 0.005, reported, stamped=False)
        tenth = np.arange(0, self.duration_s, 0.1)
        typed["/scan"] = columns(tenth, scans(np.full((len(tenth), self.beams), FREE_M)))
        for topic in ("/goal_pose", "/plan", "/bumper"):
            del typed[topic]
        if self.description is not None:
            text = {"data": np.array([self.description], object)}
            typed["/robot_description"] = columns(np.array([0.01]), text, stamped=False)
        return typed


@pytest.mark.long
def test_profile_merges_traits_of_several_drives(tmp_path, shell):
    drives = {
        "slow": ConfiguredDrive(duration_s=12.0, speed_mps=0.2),
        "fast": ConfiguredDrive(duration_s=9.0, speed_mps=0.7, every_s=0.1),
        "described": ConfiguredDrive(duration_s=8.0, description=DESCRIBED),
        "another": ConfiguredDrive(duration_s=30.0, speed_mps=2.0, beams=360),
    }
    for name, drive in drives.items():
        write_bag(drive, tmp_path / "bags" / name)
    file = tmp_path / "trolley.toml"
    proposal = shell.json("profile", "new", tmp_path / "bags", "--out", file)
    profile = load_profile(str(file))
    # The fastest command comes from one drive, the outline and the wheels from another.
    assert max(speed for speed, _ in profile.task.actions) == pytest.approx(0.7)
    assert (profile.task.body.length_m, profile.task.body.width_m) == (0.7, 0.45)
    assert profile.robot is not None
    assert profile.robot.wheel_radius_m == 0.05
    # Drives with different command rates get ticks at a fixed period.
    assert profile.clock.steps == "rate"
    assert any("bags/another" in item["text"] for item in proposal["advice"])
    assert "# not of that kind: bags/another: lidar" in file.read_text()
    # The profile gives rows of all three.
    store = tmp_path / "store"
    bags = [str(tmp_path / "bags" / name) for name in ("slow", "fast", "described")]
    ingested = shell.json("ingest", *bags, "--profile", file, "--store", store, code={0, 3})
    rows = [recording["transitions"] for recording in ingested["recordings"]]
    assert all(rows)
    assert sum(rows) == proposal["transitions"]


def traits(**reported) -> RobotTraits:
    empty = RobotTraits("", "", None, "", "", frozenset(), frozenset())
    return replace(empty, **reported)


LIDAR = Lidar("laser", 360, 12.0, simulated=False)


def test_disagreeing_traits_are_different_kinds():
    robots = [
        traits(command=TWIST, frames="odom -> base_link", lidar=LIDAR),
        # beams differ, as the lidar turns at its own pace
        traits(command=TWIST, lidar=replace(LIDAR, beams=351)),
        traits(command=TWIST, lidar=replace(LIDAR, beams=720)),
        traits(command=TWIST, lidar=replace(LIDAR, simulated=True)),
        traits(command="ackermann_msgs/msg/AckermannDrive", lidar=LIDAR),
        traits(command=TWIST, frames="odom -> base_footprint", lidar=LIDAR),
    ]
    assert robot_kinds(robots) == [[0], [1], [2], [3], [4], [5]]
    # Without the robot of other frames nothing contradicts: the two with the same lidar are one
    # kind.
    assert robot_kinds(robots[:5]) == [[0, 1], [2], [3], [4]]


def test_common_topic_names_do_not_define_a_kind():
    usual = {"command": TWIST, "frames": "odom -> base_link"}
    inputs = frozenset({("/cmd_vel", TWIST)})
    topics = inputs | {("/status", "mine/msg/Status")}
    robots = [
        traits(**usual, lidar=LIDAR, inputs=inputs),
        traits(**usual, inputs=inputs, topics=inputs),
        traits(**usual, inputs=inputs, topics=topics | {("/a", "A"), ("/b", "B")}),
        traits(**usual, inputs=inputs, topics=topics | {("/a", "A")}),
    ]
    assert robot_kinds(robots) == [[0], [1], [2, 3]]


def test_read_and_unread_recordings_are_listed(tmp_path, monkeypatch, shell):
    monkeypatch.setattr(drives_module, "drives_by_kind", partial(drives_by_kind, most=2))
    for name, drive in (
        ("a", ConfiguredDrive(9.0)),
        ("b", ConfiguredDrive(4.0)),
        ("c", ConfiguredDrive(8.0)),
    ):
        write_bag(drive, tmp_path / "bags" / name)
    write_bag(ConfiguredDrive(3.0, beams=40), tmp_path / "bags" / "other")
    proposal = shell.json("profile", "new", tmp_path / "bags")
    a, b, c, other = (str(tmp_path / "bags" / name) for name in ("a", "b", "c", "other"))
    assert (proposal["read"], proposal["unread"]) == ([a, c], [b])
    assert [kind["recordings"] for kind in proposal["kinds"]] == [[a, b, c], [other]]
    assert "# not read, of that kind: bags/b\n" in proposal["toml"]
    assert "# not of that kind: bags/other: lidar" in proposal["toml"]


@dataclass
class IdleDrive(ConfiguredDrive):
    """Drive that stands still, as commanded."""

    speed_mps: float = 0.0

    def x_at(self, time_s):
        return 1.0 + 0.0 * time_s


def test_drive_without_rows_is_not_used_as_base(tmp_path, shell):
    """The longest of three drives stood still, and the proposal was refused for all of them."""
    for name, drive in (
        ("a", ConfiguredDrive(16.0)),
        ("b", ConfiguredDrive(15.0)),
        ("idle", IdleDrive(40.0)),
    ):
        write_bag(drive, tmp_path / "bags" / name)
    file, bags = tmp_path / "robot.toml", str(tmp_path / "bags")
    proposal = shell.json("profile", "new", bags, "--out", file, "--hindsight-goals")
    assert proposal["read"][0].endswith("bags/a")
    # Ticks are 0.2 s apart. The goal's radius is reached a little before its position.
    assert 79 + 74 - 4 <= proposal["transitions"] <= 79 + 74
    assert "#   bags/idle: 0  (no transition" in file.read_text()
    reported = "1 of 3 recordings give no transition: bags/idle"
    assert any(reported in item["text"] for item in proposal["advice"])


def propose(*recordings: Recording) -> Proposal:
    paths = [recording.path for recording in recordings]
    drives = drives_by_kind(paths, [robot_traits(recording) for recording in recordings])
    return propose_for_drives(recordings, drives, "amr")


@pytest.mark.long
def test_odometry_is_used_if_a_drive_has_no_map():
    """Of two bags of a TurtleBot 4, one had rows; `restock start` stopped at the other."""
    sample = ROOT / "sample_logs" / "amr_tuesday"
    with open_recording(sample) as mapped, open_recording(sample) as unmapped:
        for recording in (mapped, unmapped):
            del recording.topics["/amcl_pose"]
        map_profile = parse_profile(propose(mapped, mapped).toml, where="p")
        assert map_profile.frames is not None
        assert map_profile.frames.fixed == "map"
        del unmapped.topics["/tf"]
        proposal = propose(mapped, unmapped)
        profile = parse_profile(proposal.toml, where="p")
        assert profile.frames is None
        assert profile.inputs.pose is not None
        assert profile.inputs.pose.topic == "/odom"
        rows = [try_toml(recording, proposal.toml).transitions for recording in (mapped, unmapped)]
        assert min(rows) > 600
        assert sum(rows) == proposal.transitions
