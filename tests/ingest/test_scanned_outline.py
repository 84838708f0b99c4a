"""Outlines derived from scans: free space, the robot's own parts, and the lidar's transform."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from support import ingested
from support.driven_robot import (
    BEAMS,
    Drive,
    columns,
    pose,
    scans,
    transforms,
    typed_columns,
    write_topics,
)
from support.paths import SHARED

from restock.cli import main
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import Profile
from restock.replay.store.store import Store

KEPT = ("/cmd_vel", "/amcl_pose", "/odom", "/scan")


@dataclass
class TurningDrive(Drive):
    """Drive that turns as it moves, with a wall at `nearest_m` on one side of the room."""

    nearest_m: float = 0.25
    near_scans: int = 8
    # distance of the robot's own post, straight behind, which the lidar always sees
    post_m: float | None = None

    def topics(self) -> dict[str, TopicColumns]:
        found = {name: c for name, c in super().topics().items() if name in KEPT}
        stamps = (found["/amcl_pose"].fields["header.stamp"] - 1_700_000_000 * 10**9) * 1e-9
        yaw = stamps  # rad
        turned = pose("pose.pose", self.x_at(stamps), 1.0)
        turned["pose.pose.orientation.z"] = np.sin(yaw / 2)
        turned["pose.pose.orientation.w"] = np.cos(yaw / 2)
        found["/amcl_pose"] = columns(stamps, turned)
        count = len(found["/scan"])
        ranges = np.full((count, BEAMS), 2.0) + np.linspace(0, 0.5, count)[:, None]
        ranges[10 : 10 + self.near_scans, 20] = self.nearest_m
        ranges[3, 40] = 0.05  # a speck of dust
        if self.post_m is not None:
            ranges[:, 0] = self.post_m
        found["/scan"].fields.update(scans(ranges))
        found["/scan"].fields["range_min"] = np.full(count, 0.02)
        found["/scan"].fields["range_max"] = np.full(count, 5.0)
        return found


def propose(topics: dict[str, TopicColumns], folder: Path, *options: str) -> tuple[Profile, str]:
    """Return the profile proposed for these topics, and its text."""
    bag = write_topics(typed_columns(topics), folder / "bag", storage="mcap")
    profile = ingested.proposed(bag, folder / "p.toml", *options, codes=(0, 3))
    return profile, (folder / "p.toml").read_text()


@pytest.mark.parametrize(
    ("drive", "length_m", "text_part"),
    [
        (TurningDrive(12.0), 0.3125, "which saw nothing nearer than 0.25 m: MEASURE IT"),
        (TurningDrive(12.0, nearest_m=0.9), 0.6, "A GUESS, as the recording does not contain it"),
        (
            TurningDrive(12.0, near_scans=1),
            0.6,
            "",
        ),  # a single odd return does not shrink the outline
        (TurningDrive(12.0, nearest_m=0.06), 0.1, ""),  # smaller than any robot
    ],
)
def test_guessed_outline_is_within_free_space(drive, length_m, text_part, tmp_path):
    profile, text = propose(drive.topics(), tmp_path)
    assert profile.task.body.length_m == pytest.approx(length_m)
    assert text_part in text


@dataclass
class PassingDrive(TurningDrive):
    """Drive past a pole at each step, at constant speed."""

    def topics(self) -> dict[str, TopicColumns]:
        found = super().topics()
        count = len(found["/scan"])
        ranges = np.full((count, BEAMS), 2.0) + np.linspace(0, 0.5, count)[:, None]
        ranges[np.arange(count), 18 + 36 * (np.arange(count) // 10 % 2)] = 0.325
        found["/scan"].fields.update(scans(ranges))
        return found


def test_conditions_with_guessed_outline_are_uncertain(tmp_path, capsys):
    """A robot 0.33 m wide passes poles at 0.16 m; with a guess of 0.48 m each was too near."""
    _, text = propose(PassingDrive(12.0, nearest_m=0.325).topics(), tmp_path)
    toml, store = tmp_path / "p.toml", tmp_path / "store"
    held = "SELECT rows_held FROM coverage_by_condition WHERE condition = 'near_collision'"
    marked = "SELECT uncertain_conditions FROM recordings"

    def uncertain_conditions() -> list[str]:
        assert main(
            ["ingest", str(tmp_path / "bag"), "--profile", str(toml), "--store", str(store)]
        ) in (0, 3)
        with Store(store) as opened:
            assert opened.sql(held).fetchall() == [(0,)]
            (names,) = opened.sql(marked).fetchall()[0]
        return names

    assert {"near_collision", "recovery"} <= {*uncertain_conditions()}
    capsys.readouterr()
    main(["coverage", str(store)])
    main(["mix", str(store), "--mixture", "coverage", "--dry-run"])
    printed = capsys.readouterr()
    assert (printed.out + printed.err).count("outline is a guess") == 2
    toml.write_text(text.replace('outline = "default"', "#"))  # as if measured, with the same size
    assert uncertain_conditions() == []


def test_own_parts_belong_to_body(tmp_path):
    """The robot's own post is 0.21 m behind; a wall is 0.3 m away once."""
    profile, text = propose(TurningDrive(12.0, nearest_m=0.3, post_m=0.21).topics(), tmp_path)
    body = profile.task.body
    assert body.length_m == pytest.approx(0.42, abs=1e-3)  # includes the post
    assert profile.task.range_min_m == pytest.approx(0.225)
    assert "range_min_m = 0.225  # beyond the robot's own parts" in text


def test_objects_beside_unturned_robot_are_not_own_parts(tmp_path):
    straight = {"/amcl_pose": Drive(12.0).topics()["/amcl_pose"]}
    profile, _ = propose(TurningDrive(12.0, post_m=0.21).topics() | straight, tmp_path)
    assert profile.task.range_min_m == pytest.approx(0.02)
    assert profile.task.body.length_m == pytest.approx(0.2625)


def lidar_at(x_m: float, y_m: float, yaw_rad: float, roll_rad: float = 0.0) -> TopicColumns:
    """Return the transform of the scans' frame: roll, then yaw."""
    return transforms(np.zeros(1), ("base_link", "lidar", x_m, y_m, yaw_rad, roll_rad))[1]


@dataclass
class FramedScanDrive(TurningDrive):
    """Drive whose scans name their frame."""

    def topics(self) -> dict[str, TopicColumns]:
        found = super().topics()
        found["/scan"].fields["header.frame_id"] = np.full(len(found["/scan"]), "lidar", object)
        return found


def test_guessed_outline_includes_lidar_position(tmp_path):
    """The lidar is at a corner. Its yaw used to be dropped together with its position."""
    more = {"/tf_static": lidar_at(-0.35, -0.3, -2.356)}
    profile, text = propose(FramedScanDrive(12.0).topics() | more, tmp_path)
    body = profile.task.body
    assert (body.length_m, body.width_m) == pytest.approx((0.7, 0.6), abs=1e-3)
    scan = profile.inputs.scans["scan"]
    assert scan.lidar_at_m == pytest.approx((-0.35, -0.3), abs=1e-3)
    assert scan.lidar_yaw_rad == pytest.approx(-2.356, abs=1e-3)
    assert (body.lidar_x_m, body.lidar_yaw_rad) == (0, 0)
    assert "upside_down" not in text


def test_lidar_outside_outline_keeps_its_yaw(tmp_path):
    """The base frame is off centre, as on a car, between the rear wheels."""
    more = {"/tf_static": lidar_at(0.9, 0.0, 3.0)}
    profile, text = propose(
        FramedScanDrive(12.0).topics() | more, tmp_path, "--footprint", "1.2x0.6"
    )
    body = profile.task.body
    assert (body.length_m, body.lidar_x_m, body.lidar_yaw_rad) == (1.2, 0.0, pytest.approx(3.0))
    assert "; a guess; base_link has it 0.90 m ahead, outside" in text


def test_upside_down_lidar_gives_the_same_rows(tmp_path, capsys):
    """The transform says so: an object on the robot's left is on the lidar's right."""
    found, texts = [], []
    for roll, sign in ((0.0, 1), (np.pi, -1)):
        topics = FramedScanDrive(12.0, near_scans=60).topics()
        scan = topics["/scan"].fields
        for angle in ("angle_min", "angle_max", "angle_increment"):
            if angle in scan:
                scan[angle] = sign * np.asarray(scan[angle])
        topics["/tf_static"] = lidar_at(0.1, 0.0, 0.3, roll)
        folder = tmp_path / str(sign)
        _, text = propose(topics, folder)
        printed = capsys.readouterr()
        assert ("hangs upside down by its frame" in printed.out + printed.err) == (sign < 0)
        with ingested.ingested(folder / "bag", folder / "p.toml", folder / "store") as opened:
            found.append(opened.sql("SELECT observation, action FROM transitions").fetchall())
        lines = text.splitlines()
        texts.append({line.split("  #")[0] for line in lines if not line.startswith("#")})
    assert found[0] == found[1]
    assert len(found[0]) > 20
    assert texts[1] - texts[0] == {"upside_down = true"}


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
@pytest.mark.parametrize(
    ("name", "size_m", "lidar"),
    [
        ("fleet-neato/2024-danpark/drive_square", (0.269, 0.269), (-0.084, np.pi)),
        ("robots/neato-map-ros1/ac109_3_demo.bag", (0.264, 0.264), (-0.102, np.pi)),
        ("fleet-turtlebot3/dwa-goal/rosbag2_2025_12_16-15_31_16", (0.191, 0.191), (0, 0)),
    ],
)
def test_outlines_of_real_robots(name, size_m, lidar, tmp_path):
    """A Neato is 0.33 m long with a backward lidar behind its middle; a Burger is 0.14 m long."""
    body = ingested.proposed(SHARED / name, tmp_path / "p.toml", codes=(0, 3)).task.body
    assert (body.length_m, body.width_m) == pytest.approx(size_m, abs=0.005)
    assert body.lidar_x_m == pytest.approx(lidar[0], abs=0.005)
    assert abs(body.lidar_yaw_rad) == pytest.approx(lidar[1], abs=0.02)
