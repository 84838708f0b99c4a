"""Several robots in one recording: `restock profile new --robot` selects one."""

from pathlib import Path

import numpy as np
import pytest
from support.driven_robot import Drive, transforms, typed_topics, write_topics
from support.ingested import ingested, proposed

from restock.ingest.containers.open_recording import open_recording
from restock.ingest.profile.profile import parse_profile
from restock.ingest.propose.drives import propose_profile
from restock.ingest.propose.roles import choose_robot

NEEDED = ("/cmd_vel", "/amcl_pose", "/odom")


def write_fleet(folder: Path, own: str = "") -> Path:
    """Write a bag of `/robot1`, without a lidar, and `/robot2`, with a lidar and a longer drive.

    Topics of `/robot1` start with `/robot1` + `own`.
    """
    short, whole = typed_topics(Drive(duration_s=2.0)), typed_topics(Drive(duration_s=3.0))
    topics = {f"/robot1{own}{name}": short[name] for name in NEEDED}
    topics |= {f"/robot2{name}": whole[name] for name in (*NEEDED, "/scan")}
    return write_topics(topics | {"/front/scan": short["/scan"]}, folder / "fleet")


@pytest.mark.parametrize(
    ("flags", "robot", "other"),
    [
        ([], "/robot2", "/robot1"),
        (["--robot", "robot1"], "/robot1", "/robot2"),
        (["--robot", "/robot2/"], "/robot2", "/robot1"),
    ],
)
def test_profile_is_of_selected_robot(flags, robot, other, tmp_path, shell):
    document = shell.json("profile", "new", write_fleet(tmp_path), *flags)
    profile = parse_profile(document["toml"], where="proposed")
    # With one name, the audit stale_labels would mistake two robots' profiles for versions of one.
    assert profile.name == ("fleet" if not flags else f"fleet_{robot.strip('/')}")
    inputs = profile.inputs
    used = (inputs.command, inputs.pose, inputs.wheels)
    assert [source.topic for source in used if source is not None] == [
        f"{robot}{name}" for name in NEEDED
    ]
    assert inputs.scan is not None
    assert inputs.scan.topic == ("/robot2/scan" if robot == "/robot2" else "/front/scan")
    assert document["transitions"] > 5
    advice = next(item["text"] for item in document["advice"] if item["key"] == "name")
    assert advice.startswith(f"of the robot {robot}, one of 2 in the recording: ")
    assert f"--robot NAME` proposes a profile of another name for {other};" in advice


def test_topics_without_namespace_are_not_used(tmp_path):
    short, whole = typed_topics(Drive(duration_s=2.0)), typed_topics(Drive(duration_s=3.0))
    topics = {f"/robot{n}{name}": short[name] for name in NEEDED for n in (1, 2)}
    topics |= {name: whole[name] for name in ("/odom", "/amcl_pose")}  # with more messages
    with open_recording(write_topics(topics, tmp_path / "fleet")) as recording:
        choose_robot(recording, "robot1")
        assert recording.topics["/odom"].expected > recording.topics["/robot1/odom"].expected
        inputs = parse_profile(propose_profile(recording, "p").toml, where="p").inputs
    assert inputs.wheels is not None
    assert (inputs.pose.topic, inputs.wheels.topic) == ("/robot1/amcl_pose", "/robot1/odom")


@pytest.mark.parametrize("robots", [(1, 2), (2,)])
def test_transforms_of_own_namespace_are_used(robots, tmp_path):
    """Nav2 uses `/robot2/tf` if several robots share a graph."""
    drive, topics = Drive(duration_s=4.0), {}
    at_s = np.arange(0, 4, 0.05)
    for n in robots:
        own = typed_topics(drive)
        topics |= {f"/robot{n}{name}": own[name] for name in ("/cmd_vel", "/odom")}
        base = ("odom", "base_link", drive.x_at(at_s) + n, 1.0)
        topics[f"/robot{n}/tf"] = transforms(at_s, ("map", "odom", 0.0, 5.0), base)
    bag, file = write_topics(topics, tmp_path / "bag"), tmp_path / "p.toml"
    frames = proposed(bag, file, "--robot", "/robot2").frames
    assert (frames.fixed, frames.topic) == ("map", "/robot2/tf")
    with ingested(bag, file, tmp_path / "s") as opened:
        x, y = opened.sql("SELECT min(pose_x_m), max(pose_y_m) FROM transitions").fetchall()[0]
    assert (x, y) == (pytest.approx(3.0, abs=0.2), pytest.approx(6.0))


@pytest.mark.parametrize("name", ["robot3", "front"])
def test_unknown_robot_is_rejected_with_existing_ones(name, tmp_path, shell):
    bag, out = write_fleet(tmp_path), tmp_path / "robot.toml"
    stderr = " ".join(shell.err("profile", "new", bag, "--robot", name, "--out", out).split())
    assert f"fleet: there is no robot /{name.strip('/')} in the recording" in stderr
    assert "its robots are /robot1, /robot2" in stderr
    assert not out.exists()
