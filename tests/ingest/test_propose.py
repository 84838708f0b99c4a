"""Proposed profiles: they load, check clean, and so do all the custom signals they offer."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.bag_samples import write_bag as write_sample_bag
from support.driven_robot import Drive, columns, ragged, typed_topics, write_bag, write_topics
from support.paths import ROOT, SHARED, sample_transitions

from restock.cli import main
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.profile.profile import load_profile, parse_profile
from restock.ingest.propose.propose import propose_profile
from restock.replay.store.store import Store
from restock.train.twin.survey.poses import candidate_poses

SAMPLES = ROOT / "sample_logs"
ROWS = sample_transitions("amr_tuesday")
ROBOTS = {  # of others -> transitions of the proposal
    "turtlebot3-sim-humble": 133,
    "turtlebot3-sim-sparse-cmd": 208,
    "ros1/husky_robot_localization.bag": 3903,
}


def with_all_signals(toml: str) -> str:
    """Return the proposal with every commented-out custom signal taken in."""
    lines, inside = [], False
    for line in toml.splitlines():
        inside = line.startswith("# [signals.") or (inside and line.startswith("# "))
        lines.append(line.removeprefix("# ") if inside else line)
    return "\n".join(lines)


def check(profile: Path, recording: Path, capsys: pytest.CaptureFixture[str]) -> dict:
    assert main(["profile", "check", str(profile), str(recording), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["problems"] == []
    return said["outcome"]


def proposed(
    recording: Path, folder: Path, capsys: pytest.CaptureFixture[str], *options: str
) -> Path:
    file = folder / "proposed.toml"
    assert main(["profile", "new", str(recording), "--out", str(file), *options]) == 0
    assert "restock:" not in capsys.readouterr().err  # no problem, though perhaps advice
    return file


def test_of_the_sample_bag_and_with_all_its_signals(tmp_path, capsys):
    recording = SAMPLES / "amr_tuesday"
    file = proposed(recording, tmp_path, capsys)
    assert check(file, recording, capsys)["transitions"] == ROWS
    text = file.read_text()
    count = len(re.findall(r"^# \[signals\.", text, re.M))
    assert count >= 8
    file.write_text(with_all_signals(text))
    outcome = check(file, recording, capsys)
    assert outcome["transitions"] == ROWS
    assert len(outcome["signals"]) == count
    for signal in outcome["signals"]:
        assert signal["steps"] > 0, signal["name"]
        assert signal["unread"] == 0, signal["name"]
    names = {signal["name"]: signal["unit"] for signal in outcome["signals"]}
    assert names["diagnostics_battery_voltage_v"] == "V"
    assert names["joint_states_velocity_left_wheel_joint_radps"] == "rad/s"
    assert not any("ground_truth" in name for name in names)  # no robot knows it


@pytest.mark.parametrize("topic", ["/cmd_vel_nav", "/nav_vel", "/cmd_vel_raw", "/mux/input/navi"])
def test_what_navigation_proposes_is_taken_for_that(topic, tmp_path, capsys):
    bag = write_bag(Drive(proposals=topic), tmp_path / "bag")
    file = proposed(bag, tmp_path, capsys)
    inputs = load_profile(file).inputs
    assert inputs.command.topic == "/cmd_vel"
    assert (inputs.nav_command.topic, inputs.nav_command.optional) == (topic, True)
    assert "beside the command that is driven (/cmd_vel)" in file.read_text()
    assert main(["ingest", str(bag), "--profile", str(file), "--store", str(tmp_path / "s")]) == 0
    with Store(tmp_path / "s") as store:
        found = store.sql("SELECT DISTINCT nav_speed_mps, nav_yaw_rate_radps FROM transitions")
        assert found.fetchall() == [(pytest.approx(0.3), pytest.approx(0.1))]


@pytest.mark.parametrize("topic", ["/local_plan", "/move_base/DWAPlannerROS/local_plan"])
def test_what_a_controller_looks_at_is_no_plan(topic, tmp_path, capsys):
    """It comes more often than the plan, and does not lead to the goal."""
    drive = Drive()
    near = columns(
        np.arange(0.0, drive.duration_s, 0.1),
        {f"poses[].pose.position.{axis}": ragged([np.full(100, 1.0)] * 2) for axis in "xy"},
    )
    topics = {**typed_topics(drive), topic: ("nav_msgs/msg/Path", near)}
    file = proposed(write_topics(topics, tmp_path / "bag"), tmp_path, capsys)
    assert load_profile(file).inputs.plan.topic == "/plan"
    del topics["/plan"]
    file.unlink()
    file = proposed(write_topics(topics, tmp_path / "no_plan"), tmp_path, capsys)
    assert load_profile(file).goal.source == "hindsight"


def test_the_goals_that_move_base_was_sent_are_goals(tmp_path, capsys):
    """And they are in the frame of the pose in them: the action's own header has none."""
    topics = typed_topics(Drive())
    _, sent = topics.pop("/goal_pose")
    pose = "goal.target_pose.pose.position"
    fields = {path.replace("pose.position", pose): c for path, c in sent.fields.items()}
    fields["goal.target_pose.header.frame_id"] = np.full(len(sent), "odom", object)
    goals = replace(sent, fields=fields)
    topics["/move_base/goal"] = ("move_base_msgs/msg/MoveBaseActionGoal", goals)
    topics["/plan"][1].fields["header.frame_id"] = np.full(len(topics["/plan"][1]), "map", object)
    bag = write_topics(topics, tmp_path / "bag")
    file = proposed(bag, tmp_path, capsys)
    assert load_profile(file).inputs.goal.topic == "/move_base/goal"
    outcome = check(file, bag, capsys)
    assert outcome["transitions"] > 10
    assert any("goal odom; plan map" in note for note in outcome["notes"])


def test_of_two_lidars_the_one_that_looks_back_is_not_taken(tmp_path, capsys):
    topics = typed_topics(Drive())
    topics["/scan_front"] = topics["/scan_back"] = topics.pop("/scan")
    file = proposed(write_topics(topics, tmp_path / "bag"), tmp_path, capsys)
    assert load_profile(file).inputs.scan.topic == "/scan_front"
    assert "or /scan_back?" in file.read_text()


def test_the_only_command_is_no_proposal(tmp_path):
    for topic in ("/joy/cmd_vel", None):
        with open_recording(write_bag(Drive(proposals=topic), tmp_path / f"{topic}"[-4:])) as bag:
            profile = parse_profile(propose_profile(bag, "mine").toml, where="p")
        assert profile.inputs.nav_command is None
        assert profile.inputs.command.topic == "/cmd_vel"


def test_rates_are_of_the_time_that_was_recorded(tmp_path):
    """Of that in which commands came often, a scan of 7 Hz was said to be one of 19."""
    topics = typed_topics(Drive(duration_s=20))
    often = np.append(np.arange(0, 2, 0.1), [6.0, 12.0, 18.0])
    speed = {"linear.x": np.full(len(often), 0.4), "angular.z": np.zeros(len(often))}
    topics["/cmd_vel"] = topics["/cmd_vel"][0], columns(often, speed, stamped=False)
    with open_recording(write_topics(topics, tmp_path / "bag")) as bag:
        text = propose_profile(bag, "mine").toml
        seconds = (bag.span_ns[1] - bag.span_ns[0]) * 1e-9
        rates = {t: topic.expected / seconds for t, topic in bag.topics.items()}
    for topic in ("/odom", "/scan", "/cmd_vel"):
        said = re.search(rf"^# {topic} +\S+ +([\d.]+) Hz", text, re.M)
        assert float(said[1]) == pytest.approx(rates[topic], rel=0.05, abs=0.06)


def test_it_says_rates_roles_clock_lidar_and_frames(capsys):
    with open_recording(SAMPLES / "amr_tuesday") as recording:
        text = propose_profile(recording, "amr").toml
    assert re.search(r"^# /odom +nav_msgs/msg/Odometry +\d+\.\d Hz  wheels$", text, re.M)
    assert 'alignment = "header.stamp"  # log time is 0.001 s ahead of it' in text
    assert "range_min_m = 0.05" in text
    assert "# [frames]  # instead of inputs.pose, from /tf: map -> odom -> base_link" in text
    assert parse_profile(text, where="p").frames is None
    taken = re.sub(r"^# (\[frames\]|fixed|base|max_age_s = 0.5)", r"\1", text, flags=re.M)
    assert parse_profile(taken, where="p").frames is not None


def test_without_a_pose_topic_the_pose_is_from_transforms(tmp_path, capsys):
    """A recording of the sample's topics but for /amcl_pose."""
    with open_recording(SAMPLES / "amr_tuesday") as recording:
        del recording.topics["/amcl_pose"]
        text = propose_profile(recording, "amr").toml
    assert "# [inputs.pose]  # from transforms, by [frames]" in text
    profile = parse_profile(text, where="p")
    assert profile.inputs.pose is None
    assert profile.frames is not None
    assert (profile.frames.fixed, profile.frames.base) == ("map", "base_link")
    file = tmp_path / "p.toml"
    file.write_text(text)
    assert check(file, SAMPLES / "amr_tuesday", capsys)["transitions"] > 600


def test_without_commands_what_the_robot_did_stands_for_them(tmp_path, capsys):
    class Uncommanded(Drive):
        def topics(self):
            topics = super().topics()
            del topics["/cmd_vel"], topics["/scan"]
            return topics

    bag = write_bag(Uncommanded(), tmp_path / "bag")
    lacking = tmp_path / "lacking.toml"
    assert main(["profile", "new", str(bag), "--out", str(lacking)]) == 3
    assert "no topic for command, which every profile needs" in (said := capsys.readouterr().err)
    assert "--odometry-as-command" in said
    assert "# NOT USABLE YET: no topic for command" in lacking.read_text()
    assert main(["profile", "check", str(lacking), str(bag)]) == 2
    capsys.readouterr()
    file = proposed(bag, tmp_path, capsys, "--odometry-as-command")
    assert "# No command was recorded: the measured motion is used" in file.read_text()
    profile = load_profile(file)
    assert profile.inputs.command.topic == "/odom"
    outcome = check(file, bag, capsys)
    assert outcome["transitions"] > 20
    stand_ins = {item["input"] for item in outcome["stand_ins"]}
    truth = {"true_condition", "true_exposure", "perturbation"}
    assert stand_ins == {"command", "scan", "nav_command"} | truth


def test_every_type_of_a_bag_without_a_robot_is_gone_through(tmp_path, capsys):
    bag = write_sample_bag(tmp_path / "bag")
    assert main(["profile", "new", str(bag), "--json", "--odometry-as-command"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["missing"] == said["problems"] == []
    assert said["signals"] == len(re.findall(r"^# \[signals\.", said["toml"], re.M)) > 4
    parse_profile(with_all_signals(said["toml"]), where="p")


@pytest.mark.long
@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
@pytest.mark.parametrize("name", ROBOTS)
def test_of_others_robots_and_with_all_its_signals(name, tmp_path, capsys):
    recording = SHARED / name
    options = ["--odometry-as-command"] if name.startswith("ros1") else []
    file = proposed(recording, tmp_path, capsys, *options)
    assert check(file, recording, capsys)["transitions"] == ROBOTS[name]
    file.write_text(with_all_signals(file.read_text()))
    outcome = check(file, recording, capsys)
    assert outcome["transitions"] == ROBOTS[name]
    assert len(outcome["signals"]) > 4
    assert all(signal["found"] for signal in outcome["signals"])


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
@pytest.mark.parametrize(
    ("name", "missing"),
    [
        ("jazzy-mcap-backsteps", ["command", "pose"]),
        ("nav2-file-zstd", ["pose"]),
    ],
)
def test_what_others_recordings_lack_is_named(name, missing, tmp_path, capsys):
    file = tmp_path / "p.toml"
    assert main(["profile", "new", str(SHARED / name), "--out", str(file)]) == 3
    said = capsys.readouterr().err
    assert [word for word in ("command", "pose") if f"no topic for {word}" in said] == (missing)
    assert main(["profile", "check", str(file), str(SHARED / name)]) == 2
    assert f"`inputs.{missing[0]}`" in capsys.readouterr().err


class Utm(Drive):
    """Its poses are UTM coordinates; it has neither goal nor plan."""

    def topics(self):
        topics = super().topics()
        del topics["/goal_pose"], topics["/plan"]
        for axis, far_m in (("x", 4.5e5), ("y", 5.2e6)):
            topics["/amcl_pose"].fields[f"pose.pose.position.{axis}"] += far_m
        return topics


def test_poses_in_utm_coordinates_are_stored_to_the_millimetre(tmp_path, capsys):
    """They were refused, with a remedy for recordings still to be made."""
    recording = write_bag(Utm(8.0), tmp_path / "bag")
    file = proposed(recording, tmp_path, capsys)
    profile = load_profile(file)
    assert profile.origin_m == pytest.approx((4.5e5 + 1 + 0.5 * 4.0, 5.2e6 + 1), abs=1)
    store = tmp_path / "store"
    assert main(["ingest", str(recording), "--profile", str(file), "--store", str(store)]) == 0
    assert f"positions: metres from ({profile.origin_m[0]:.0f}, 5200001)" in capsys.readouterr().out
    with Store(store) as rows:
        found = rows.sql(
            "SELECT pose_x_m, pose_y_m FROM transitions ORDER BY stamp_ns"
        ).fetchnumpy()
    x, y = found["pose_x_m"].astype(float), found["pose_y_m"].astype(float)
    driven = 1 + 0.5 * np.arange(len(x)) * 0.2
    assert x + profile.origin_m[0] == pytest.approx(4.5e5 + driven, abs=1e-3)
    assert y + profile.origin_m[1] == pytest.approx(5.2e6 + 1, abs=1e-3)
    with open_recording(recording) as opened:
        (surveyed,) = candidate_poses(opened, profile)  # of a floor: from the same origin
    assert surveyed.places_m[0] == pytest.approx([x[0], y[0]], abs=1e-3)


@pytest.mark.parametrize("bumper", [True, False])
def test_a_contact_ends_an_episode_with_or_without_a_bumper(bumper, tmp_path, capsys):
    class Robot(Drive):
        def topics(self):
            topics = super().topics()
            if not bumper:
                del topics["/bumper"]
            return topics

    recording = write_bag(Robot(8.0), tmp_path / "bag")
    file = proposed(recording, tmp_path, capsys)
    assert load_profile(file).task.bump_terminates
    assert ("no bumper seen" in file.read_text()) is not bumper
    assert check(file, recording, capsys)["transitions"] > 30
