"""Proposals of `restock profile new`: a row of `ROBOTS` per robot, and the evidence behind it."""

import contextlib
import io
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bag_samples import write_bag as write_sample_bag
from support.driven_robot import (
    BEAMS,
    SPEED_MPS,
    START_NS,
    Drive,
    columns,
    pose,
    ragged,
    scans,
    transforms,
    typed_topics,
    write_bag,
    write_topics,
)
from support.ingested import ingested
from support.paths import ROOT, SHARED, sample_transitions

from restock.cli import main
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import Profile, load_profile, parse_profile
from restock.ingest.propose.clock_choice import drivable
from restock.ingest.propose.commands import Commands
from restock.ingest.propose.drives import propose_profile
from restock.ingest.propose.proposal_lines import actions_of
from restock.ingest.propose.robot_choice import RobotProposal
from restock.ingest.steps.align import NS
from restock.ingest.task.task import Body, Task
from restock.train.twin.physics.simulation import blocks_of
from restock.train.twin.survey.poses import candidate_poses

SAMPLE = ROOT / "sample_logs" / "amr_tuesday"
ROWS = sample_transitions("amr_tuesday")
TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
Topics = dict[str, tuple[str, TopicColumns]]
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")


def profile_json(*arguments: object) -> tuple[int, Any]:
    """Run `restock profile … --json` and return the exit code and the document."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = main(["profile", *map(str, arguments), "--json"])
    return code, json.loads(out.getvalue())


def propose(recording: Path, *options: str, code: int = 0) -> tuple[Any, Profile, Path]:
    """Return the document of a proposal, the profile, and its file beside the recording."""
    exit_code, document = profile_json("new", recording, *options)
    assert exit_code == code, document
    file = recording.parent / f"{recording.name}.toml"
    file.write_text(document["toml"])
    return document, load_profile(file), file


def check_outcome(profile: Path, recording: Path) -> Any:
    code, document = profile_json("check", profile, recording)
    assert (code, document["problems"]) == (0, [])
    return document["outcome"]


# -- robots ----------------------------------------------------------------------------------


def plain_topics(seconds: float = 6.0, **changes: Any) -> Topics:
    """Return the topics of a plain drive, without those in `drop` and with those in `add`."""
    drop, add = changes.pop("drop", ()), changes.pop("add", {})
    topics = typed_topics(Drive(seconds, **changes))
    return {name: topic for name, topic in topics.items() if name not in drop} | add


@dataclass
class CommandedDrive(Drive):
    """Drive with commands at `times_s`, at `pace` of log time, with poses up to `off_m` off."""

    times_s: Any = ()
    pace: float = 1.0
    nearest_m: float = 3.0
    off_m: float = 0.0
    odometry_alone: bool = False

    def topics(self) -> dict[str, TopicColumns]:
        topics = super().topics()
        del topics["/plan"], topics["/goal_pose"], topics["/behaviour_policy"]
        scan, poses = topics["/scan"], topics["/amcl_pose"].fields
        scan.fields.update(scans(np.full((len(scan), BEAMS), self.nearest_m)))
        x = np.asarray(poses["pose.pose.position.x"])
        off = self.off_m * np.random.default_rng(0).uniform(-1, 1, len(x))
        poses["pose.pose.position.x"] = x + off
        if self.odometry_alone:
            del topics["/imu"], topics["/amcl_pose"]
            at = np.arange(0, self.duration_s, 0.02)
            topics["/odom"].fields.update(pose("pose.pose", self.x_at(at), 1.0))
        if len(self.times_s):
            fields = {"linear.x": np.full(len(self.times_s), 0.4)}
            fields["angular.z"] = 0 * fields["linear.x"]
            topics["/cmd_vel"] = columns(np.array(self.times_s), fields, stamped=False)
        return {name: self.received(topic) for name, topic in topics.items()}

    def received(self, topic: TopicColumns) -> TopicColumns:
        log = START_NS + np.rint((topic.log_time_ns - START_NS) / self.pace).astype(np.int64)
        return TopicColumns(log, log, topic.fields)


class ErraticClockDrive(CommandedDrive):
    """Drive whose clock has no fixed pace against log time, as it pauses now and then."""

    def received(self, topic: TopicColumns) -> TopicColumns:
        since = (topic.log_time_ns - START_NS) / NS
        log = START_NS + np.rint((since * 1.5 + 0.35 * np.floor(since / 0.7)) * NS).astype(np.int64)
        return TopicColumns(log, log, topic.fields)

    def topics(self) -> dict[str, TopicColumns]:
        topics = super().topics()
        odom, slow = topics["/odom"], np.arange(0, len(topics["/odom"]), 30)
        fields = {path: np.asarray(column)[slow] for path, column in odom.fields.items()}
        fields |= pose("pose.pose", 0.4 * np.arange(len(slow)), 0.0)
        odom = TopicColumns(odom.log_time_ns[slow], odom.log_time_ns[slow], fields)
        return {"/cmd_vel": topics["/cmd_vel"], "/odom": odom, "/bumper": topics["/bumper"]}


@dataclass
class ShuttleDrive(Drive):
    """Drive ahead and back in turns of 2 s, without goals."""

    duration_s: float = 24.0
    ahead_mps: float = 0.5
    back_mps: float = 0.5

    def topics(self) -> dict[str, Any]:
        def speed_at(at_s: Any) -> Any:
            return np.where(at_s % 4 < 2, self.ahead_mps, -self.back_mps)

        ticks, fast = np.arange(0, self.duration_s, 0.2), np.arange(0, self.duration_s, 0.02)
        typed = super().topics()
        del typed["/goal_pose"], typed["/plan"]
        commanded_speed_command = {"linear.x": speed_at(ticks), "angular.z": 0 * ticks}
        typed["/cmd_vel"] = columns(ticks + 0.005, commanded_speed_command, stamped=False)
        moved = {"twist.twist.linear.x": speed_at(fast - 0.005), "twist.twist.angular.z": 0 * fast}
        typed["/odom"] = columns(fast, moved)
        x_m = 1.0 + np.cumsum(speed_at(fast)) * 0.02
        at_s = np.arange(0, self.duration_s, 0.1)
        typed["/amcl_pose"].fields["pose.pose.position.x"] = np.interp(at_s, fast, x_m)
        return typed


class UtmDrive(Drive):
    """Drive with poses in UTM coordinates, without goal and plan."""

    drop = ("/goal_pose", "/plan")

    def topics(self):
        topics = super().topics()
        for axis, far_m in (("x", 4.5e5), ("y", 5.2e6)):
            topics["/amcl_pose"].fields[f"pose.pose.position.{axis}"] += far_m
        return topics


def with_speed_command(ahead_mps: float, aside_mps: float = 0.0, seconds: float = 3.0) -> Topics:
    """Return the plain drive with commands of these speeds, whatever its motion."""
    count = len(ticks := np.arange(0, seconds, 0.2))
    speeds = {"linear.x": ahead_mps, "linear.y": aside_mps, "angular.z": 0.0}
    fields = {path: np.full(count, speed) for path, speed in speeds.items()}
    return plain_topics(
        seconds, add={"/cmd_vel": (TWIST, columns(ticks + 0.005, fields, stamped=False))}
    )


def local_plan(topic: str, **changes: Any) -> Topics:
    """Return a drive with a controller's local plan, more frequent than the global plan."""
    path = {f"poses[].pose.position.{axis}": ragged([np.full(60, 1.0)] * 2) for axis in "xy"}
    near = columns(np.arange(0.0, 6.0, 0.1), path)
    return plain_topics(**changes, add={topic: ("nav_msgs/msg/Path", near)})


def with_move_base_goals() -> Topics:
    """Return a drive with goals whose frame is in their pose, as the action header has none."""
    topics = plain_topics()
    _, sent = topics.pop("/goal_pose")
    position = "goal.target_pose.pose.position"
    fields = {path.replace("pose.position", position): c for path, c in sent.fields.items()}
    fields["goal.target_pose.header.frame_id"] = np.full(len(sent), "odom", object)
    goals = "move_base_msgs/msg/MoveBaseActionGoal", replace(sent, fields=fields)
    return topics | {"/move_base/goal": goals}


def without_gyro() -> Topics:
    topics = plain_topics()
    unknown = np.zeros((len(topics["/imu"][1]), 9))
    unknown[:, 0] = -1
    topics["/imu"][1].fields["angular_velocity_covariance"] = unknown
    return topics


def two_lidars() -> Topics:
    topics = plain_topics()
    topics["/scan_front"] = topics["/scan_back"] = topics.pop("/scan")
    return topics


def with_laser(frame: str = "laser", **tf: tuple[str, TopicColumns]) -> Topics:
    topics = plain_topics()
    scan = topics["/scan"][1]
    scan.fields["header.frame_id"] = np.full(len(scan), frame, object)
    for limit, value in (("range_min", 0.05), ("range_max", 8.0)):
        scan.fields[limit] = np.full(len(scan), value)
    return topics | {f"/{name}": topic for name, topic in tf.items()}


TENTHS = np.arange(60) * 0.1
MOVING = transforms(TENTHS, ("odom", "base_link"))
STATIC = transforms(np.zeros(1), ("base_link", "mast"), ("mast", "laser", 0.0, 0.0, np.pi / 2))
ODOMETRY = ("--odometry-as-command",)
OVERSPEED = with_speed_command(3 * SPEED_MPS, seconds=12.0)
UNEVEN_S = np.cumsum(np.random.default_rng(0).choice([0.06, 0.1, 0.1, 0.1, 0.17], 200))
HALF_SECONDS_S = 0.5 * np.arange(56) + np.random.default_rng(0).uniform(0, 0.04, 56)


def reverse_actions(actions: Any) -> list[tuple[float, float]]:
    return [(speed, turn) for speed, turn in actions if speed < 0]


def topics_of(*names: str) -> Callable[[Profile], Any]:
    return lambda p: tuple(getattr(getattr(p.inputs, name), "topic", None) for name in names)


# name: (topics, options, function of the profile, its result, texts that the TOML has or lacks (-))
ROBOTS: dict[str, tuple[Topics | Drive, tuple[str, ...], Callable[[Any], Any], Any, list[str]]] = {
    # Topics and their roles.
    "navigation": (
        plain_topics(proposals="/mux/input/navi"), (), topics_of("command", "nav_command"),
        ("/cmd_vel", "/mux/input/navi"), ["beside the command that is driven (/cmd_vel)"],
    ),
    "joystick": (
        plain_topics(proposals="/joy/cmd_vel"), (), topics_of("command", "nav_command"),
        ("/cmd_vel", None), [],
    ),
    "local plan beside plan": (
        local_plan("/local_plan"), (), topics_of("plan"), ("/plan",), [],
    ),
    "local plan alone": (
        local_plan("/move_base/DWAPlannerROS/local_plan", drop=("/plan",)), (),
        lambda p: p.goal.source, "hindsight", [],
    ),
    "move_base goals": (
        with_move_base_goals(), (), topics_of("goal"), ("/move_base/goal",), [],
    ),
    "two lidars": (two_lidars(), (), topics_of("scan"), ("/scan_front",), ["or /scan_back?"]),
    "bumper": (
        plain_topics(), (), lambda p: p.task.bump_terminates, True, ["- no bumper seen"],
    ),
    "no bumper": (
        plain_topics(drop=("/bumper",)), (), lambda p: p.task.bump_terminates, True,
        ["no bumper seen"],
    ),
    "no commands": (
        plain_topics(drop=("/cmd_vel", "/scan")), ODOMETRY, topics_of("command"), ("/odom",),
        ["no command was recorded: the measured motion is used"],
    ),
    "IMU without gyro": (
        without_gyro(), (), topics_of("imu"), (None,),
        ["messages of /imu have no estimate of angular_velocity"],
    ),
    # Commands: speeds, holds, and the clock.
    "slow reverse": (
        ShuttleDrive(8.0, back_mps=0.1), (),
        lambda p: reverse_actions(p.task.actions), [(-0.1, 0.0)], [],
    ),
    "sideways": (with_speed_command(0.4, 0.3), (), topics_of("command"), ("/cmd_vel",), []),
    "commands at three times its speed": (
        OVERSPEED, (),
        lambda p: (p.robot.max_speed_mps, p.robot.origin_of("max_speed_mps"),
                   max(speed for speed, _ in p.task.actions)),
        (SPEED_MPS, "logs", SPEED_MPS), ["beyond 0.5 m/s were commanded"],
    ),
    "commands at 2 Hz": (
        CommandedDrive(30.0, times_s=HALF_SECONDS_S), (),
        lambda p: (p.task.control_period_s, p.clock.max_gap_s > 1.0),
        (pytest.approx(0.5), True), ["- time_limit_steps"],
    ),
    "uneven commands": (
        CommandedDrive(float(UNEVEN_S[-1]), times_s=UNEVEN_S), (),
        lambda p: p.clock.steps, "rate", [],
    ),
    "even commands at 5 Hz": (
        CommandedDrive(30.0, times_s=0.2 * np.arange(150)), (),
        lambda p: (p.clock.steps, p.task.time_limit_steps), ("command", 250),
        ["time_limit_steps = 250  # 20 m at 0.4 m/s"],
    ),
    **{
        f"at {pace} of real time": (
            CommandedDrive(15.0, pace=pace), (),
            lambda p: (p.clock.alignment, p.task.control_period_s),
            ("header.stamp", pytest.approx(0.2)),
            ["Header stamps run at" if pace != 1.0 else "- Header stamps run at"],
        )
        for pace in (0.5, 0.97, 1.0)
    },
    "erratic clock": (
        ErraticClockDrive(40.0), (), lambda p: p.clock.alignment, "log_time",
        ["[inputs.pose]", "Log time, as header stamps do not work: "],
    ),
    # Clearance limits, and the noise of poses and wheels.
    **{
        f"{width_m} m wide": (
            CommandedDrive(4.0), ("--footprint", f"0.3x{width_m}"),
            lambda p: p.task.rewards.tight_clearance_m, near_m,
            ["tight_clearance_m" if near_m < 0.15 else "- tight_clearance_m"],
        )
        for width_m, near_m in ((0.1, 0.05), (0.3, 0.09), (0.7, 0.15))
    },
    **{
        f"poses off by {off_m} m": (
            CommandedDrive(20.0, off_m=off_m), (), lambda p: p.noise.localiser_m,
            pytest.approx(max(off_m / 2, 0.01), rel=0.3),
            ["[noise]" if off_m > 0.02 else "- [noise]"],
        )
        for off_m in (0.0, 0.03, 0.1)
    },
    "odometry alone": (
        CommandedDrive(10.0, odometry_alone=True), (),
        lambda p: {"wheel_slip", "slippery_floor"} & {rule.name for rule in p.definitions},
        set(), ["wheel_slip"],  # the text says why it is missing
    ),
    # The lidar's yaw is a guess unless a transform gives it.
    "lidar without transform": (
        with_laser(tf=MOVING), (), lambda p: p.task.body.lidar_yaw_rad, 0.0,
        ["zero points straight ahead, as no transform places its frame, laser"],
    ),
    "lidar with transform": (
        with_laser(tf=MOVING, tf_static=STATIC), (), lambda p: p.task.body.lidar_yaw_rad,
        pytest.approx(np.pi / 2, abs=1e-3), ["- no transform places"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ROBOTS)
def test_proposal_fits_its_robot(name, tmp_path):
    robot, options, property_of, expected, texts = ROBOTS[name]
    topics = typed_topics(robot) if isinstance(robot, Drive) else robot
    document, profile, file = propose(write_topics(topics, tmp_path / "bag"), *options)
    assert document["problems"] == []
    assert property_of(profile) == expected
    text = " ".join(file.read_text().replace("\n# ", " ").split(" "))
    for part in texts:
        assert (part.removeprefix("- ") in text) is not part.startswith("- "), part
    assert document["transitions"] > 5


# -- advice, and rows of the proposed profile -----------------------------------------------------


def test_unusual_commands_give_advice(tmp_path):
    """Sideways commands, and commands that never move; `start` shows the same advice."""
    advice = {}
    for name, topics in (
        ("aside", with_speed_command(0.4, 0.3)),
        ("never", with_speed_command(0.0)),
    ):
        document, _, _ = propose(write_topics(topics, tmp_path / name))
        advice[name] = {item["key"]: item["text"] for item in document["advice"]}
    assert "contain a sideways speed, up to 0.3 m/s" in advice["aside"]["inputs.command"]
    assert "the actions are a guess" in advice["never"]["task.actions"]
    assert not {"task.actions", "inputs.command"} <= advice["aside"].keys()


def test_proposal_without_commands_is_unusable(tmp_path):
    bag = write_topics(plain_topics(drop=("/cmd_vel", "/scan")), tmp_path / "bag")
    code, document = profile_json("new", bag)
    assert (code, document["missing"]) == (3, ["command"])
    (tmp_path / "p.toml").write_text(document["toml"])
    assert main(["profile", "check", str(tmp_path / "p.toml"), str(bag)]) == 2


def test_command_hold_follows_observed_motion(tmp_path):
    times = (*np.arange(0, 1, 0.1), 6.0, 17.0)
    bag = write_bag(CommandedDrive(20.0, times_s=times), tmp_path / "bag")
    document, profile, file = propose(bag)
    assert (profile.clock.steps, profile.inputs.command.max_age_s) == ("rate", pytest.approx(11))
    assert document["transitions"] > 90  # 20 s at 5 Hz
    strict = file.read_text().replace("max_age_s = 11", "max_age_s = 1", 1)
    file.write_text(strict)
    _, document = profile_json("check", file, bag)
    (line,) = [line for line in document["advice"] if "inputs.command.max_age_s" in line]
    promised = int(line.split("without it (latched) ")[1].split()[0])
    before, after = strict.split("[inputs.command]")
    file.write_text(f"{before}[inputs.command]{after.replace('max_age_s', '# max_age_s', 1)}")
    assert (
        check_outcome(file, bag)["transitions"] == promised > 3 * document["outcome"]["transitions"]
    )


def test_outline_contradicted_by_lidar_gives_advice(tmp_path):
    bag = write_bag(CommandedDrive(10.0, nearest_m=0.28), tmp_path / "bag")
    document, _, file = propose(bag)
    texts = [item["text"] for item in document["advice"] if item["key"] == "task.body"]
    assert any("inside the robot at 100%" in text for text in texts)
    assert any(
        "`task.body`: with an outline of 0.6" in advice
        for advice in profile_json("check", file, bag)[1]["advice"]
    )
    assert propose(bag, "--footprint", "0.1x0.1")[0]["advice"] == []


def test_utm_poses_are_stored_to_the_millimetre(tmp_path):
    recording, store = write_bag(UtmDrive(8.0), tmp_path / "bag"), tmp_path / "store"
    _, profile, file = propose(recording)
    query = "SELECT pose_x_m, pose_y_m FROM transitions ORDER BY stamp_ns"
    with ingested(recording, file, store) as rows:
        found = rows.sql(query).fetchnumpy()
    x, y = found["pose_x_m"].astype(float), found["pose_y_m"].astype(float)
    driven = 1 + 0.5 * np.arange(len(x)) * 0.2
    assert x + profile.origin_m[0] == pytest.approx(4.5e5 + driven, abs=1e-3)
    assert y + profile.origin_m[1] == pytest.approx(5.2e6 + 1, abs=1e-3)
    with open_recording(recording) as opened:
        # poses of a floor plan, from the same origin
        (surveyed,) = candidate_poses(opened, profile)
    assert surveyed.places_m[0] == pytest.approx([x[0], y[0]], abs=1e-3)


# -- evidence behind the choices ------------------------------------------------------------------


def fastest_commands(speeds: Any, turns: Any = 0.0) -> Commands:
    speeds = np.asarray(speeds, np.float64)
    return Commands().fastest(speeds, np.broadcast_to(turns, speeds.shape))


def test_reverse_actions_of_a_car_follow_its_logs():
    car = RobotProposal(values={"drive": "ackermann", "wheelbase_m": 0.4, "max_steering_rad": 0.5})
    backs = reverse_actions(actions_of(fastest_commands([*[1.0] * 50, *[-0.8] * 50], 0.5), car))
    assert {speed for speed, _ in backs} == {-0.8}
    assert sorted(np.sign(turn) for _, turn in backs) == [-1, 0, 1]
    assert reverse_actions(actions_of(fastest_commands([1.0, 0.5], 0.5), car)) == []


def test_proposed_control_period_suits_the_twin() -> None:
    """A drive of 145 s once gave a period of 0.13 s, for which no twin could be built."""
    for period_s in np.arange(0.08, 0.5001, 0.001):
        found = drivable(float(period_s))
        assert found == pytest.approx(period_s, abs=0.025)
        actions = ((0.0, 0.0), (0.4, 0.0))
        task = Task(body=Body(0.6, 0.5), actions=actions, control_period_s=found)
        assert np.prod(blocks_of(task, 0.01)) == pytest.approx(found)
    for kept in (0.08, 0.1, 0.12, 0.2, 0.3, 0.5):
        assert drivable(kept) == kept
    # Commands 0.2 s apart once gave a period of 0.21 s, which no log of them can follow.
    assert [drivable(near) for near in (0.1015, 0.2003, 0.3012)] == [0.1, 0.2, 0.3]


# -- the sample bag and recordings from elsewhere, with all their signals -------------------------


def with_all_signals(toml: str) -> str:
    """Return the proposal with every commented-out custom signal enabled."""
    lines, inside = [], False
    for line in toml.splitlines():
        inside = line.startswith("# [signals.") or (inside and line.startswith("# "))
        lines.append(line.removeprefix("# ") if inside else line)
    return "\n".join(lines)


def test_proposal_for_sample_bag_with_all_signals(tmp_path):
    _, document = profile_json("new", SAMPLE)
    text, file = document["toml"], tmp_path / "p.toml"
    count = len(re.findall(r"^# \[signals\.", text, re.M))
    assert count >= 8
    assert document["transitions"] == ROWS
    assert 'alignment = "header.stamp"' in text
    assert parse_profile(text, where="p").frames is None
    taken = re.sub(r"^# (\[frames\]|fixed|base|max_age_s = 0.5)", r"\1", text, flags=re.M)
    assert parse_profile(taken, where="p").frames is not None
    file.write_text(with_all_signals(text))
    outcome = check_outcome(file, SAMPLE)
    assert outcome["transitions"] == ROWS
    assert len(outcome["signals"]) == count
    assert all(signal["steps"] > 0 and signal["unread"] == 0 for signal in outcome["signals"])
    names = {signal["name"]: signal["unit"] for signal in outcome["signals"]}
    assert names["diagnostics_battery_voltage_v"] == "V"
    assert names["joint_states_velocity_left_wheel_joint_radps"] == "rad/s"
    assert not any("ground_truth" in name for name in names)  # a real robot does not know it


def test_pose_from_transforms_without_pose_topic(tmp_path):
    """Use the sample's topics without /amcl_pose."""
    with open_recording(SAMPLE) as recording:
        del recording.topics["/amcl_pose"]
        text = propose_profile(recording, "amr").toml
    profile = parse_profile(text, where="p")
    assert profile.inputs.pose is None
    assert (profile.frames.fixed, profile.frames.base) == ("map", "base_link")
    (tmp_path / "p.toml").write_text(text)
    assert check_outcome(tmp_path / "p.toml", SAMPLE)["transitions"] > 600


def test_proposal_for_bag_of_arbitrary_types(tmp_path):
    document, _, _ = propose(write_sample_bag(tmp_path / "bag"), *ODOMETRY)
    assert document["missing"] == document["problems"] == []
    assert document["signals"] == len(re.findall(r"^# \[signals\.", document["toml"], re.M)) > 4
    parse_profile(with_all_signals(document["toml"]), where="p")


SHARED_BAGS = {  # shared recordings -> transitions of the proposal, fastest reverse speed
    "turtlebot3-sim-humble": (133, None),
    "turtlebot3-sim-sparse-cmd": (208, None),
    "ros1/husky_robot_localization.bag": (3903, None),
    "sim-time-husky": (77, None),
    "sim-time-mobrob": (41, None),
    "sim-time-robot-kf": (520, None),
    "robots/turtlebot3-sim/rosbag_test": (113, None),
    "robots/turtlebot3-sim-clock/ros2bag": (17, None),
    "robots/neato-map-ros1/ac109_3_demo.bag": (None, -0.0927),
    "jetacker": (None, -1.0),
}
MEASURED = ("ros1/husky_robot_localization.bag", "sim-time-mobrob", "sim-time-robot-kf")


@pytest.mark.long
@needs_shared
@pytest.mark.parametrize("name", SHARED_BAGS)
def test_proposals_for_shared_recordings(name, tmp_path):
    recording, (transitions, back_mps) = SHARED / name, SHARED_BAGS[name]
    code, document = profile_json("new", recording, *(ODOMETRY if name in MEASURED else ()))
    assert code == (3 if document["losses"] else 0)  # one of them lacks a file
    profile = parse_profile(document["toml"], where="p")
    if back_mps is not None:
        slowest = min(speed for speed, _ in reverse_actions(profile.task.actions))
        assert slowest == pytest.approx(back_mps, rel=0.01)
        return
    assert document["transitions"] == transitions
    if name.startswith(("turtlebot3", "ros1")):
        file = tmp_path / "p.toml"
        file.write_text(with_all_signals(document["toml"]))
        outcome = check_outcome(file, recording)
        assert outcome["transitions"] == transitions
        assert len(outcome["signals"]) > 4
        assert all(signal["found"] for signal in outcome["signals"])
        # a small robot, whose rows were once nearly all labelled recovery
        if name == "turtlebot3-sim-humble":
            assert outcome["conditions"]["recovery"] <= 1
