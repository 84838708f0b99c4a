"""The ROS 2 node on a stub of rclpy: it drives to its goal and stops for unreliable input."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from support.ingested import ingested
from support.policy_files import changed_policy
from support.ros_graph import VOLATILE, Durability, Graph, QoS, Returned, message_class
from support.twin_robot import TwinRobot, follower_onnx

from restock.cli import run_node
from restock.ingest.live.node import (
    ACTION,
    LIMITER,
    SHADOW,
    TAKEOVER,
    lifecycle_node,
    with_node_topics,
)
from restock.ingest.profile.profile import load_profile, profile_toml
from restock.ingest.task.robot import STOP, Limiter
from restock.train.twin.physics.episode import EpisodeSpec
from restock.train.twin.recording.bag_writer import stamp

PROFILE = load_profile("warehouse_amr")
SPEC = EpisodeSpec("nominal", 20_003)
COMMAND = "/cmd_vel"

pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return follower_onnx(tmp_path_factory.mktemp("policy") / "p.onnx", PROFILE)


def configured_node(policy: Path, *, drive: bool = True, **parameters: Any) -> tuple[Graph, Any]:
    graph = Graph(parameters=parameters)
    node = lifecycle_node(graph.ros(), policy, drive=drive)
    assert node.trigger_configure() is Returned.SUCCESS, graph.logged
    return graph, node


def drive_until_done(
    robot: TwinRobot, before_decision: Callable[[int], None] | None = None, steps: int = 240
) -> int:
    """Return the steps until the episode ended; `before_decision` is called at each step."""
    for step in range(steps):
        robot.sense()
        if before_decision is not None:
            before_decision(step)
        robot.graph.fire()
        if robot.drive():
            return step + 1
    return steps


def drive_some_steps(policy: Path, steps: int = 8) -> tuple[Graph, Any, TwinRobot]:
    """Return the graph, the active node, and a robot that it drove for some steps."""
    graph, node = configured_node(policy)
    node.trigger_activate()
    robot = TwinRobot(graph, SPEC)
    drive_until_done(robot, steps=steps)
    return graph, node, robot


def speeds(graph: Graph, topic: str = COMMAND) -> list[tuple[float, float]]:
    return [(message.linear.x, message.angular.z) for message in graph.of(topic)]


def test_node_drives_twin_to_its_goal(policy: Path) -> None:
    graph, node = configured_node(policy)
    assert node.trigger_activate() is Returned.SUCCESS
    robot, seen = TwinRobot(graph, SPEC), []

    def record_observation(_: int) -> None:
        seen.append(robot.env.observation[0])

    pilot, live = node.policy.pilot, []
    decide = pilot.decide
    pilot.decide = lambda now_ns: live.append(decide(now_ns)) or live[-1]
    steps = drive_until_done(robot, record_observation)
    assert bool(robot.info["success"][0])
    assert len(live) == steps == len(graph.of(COMMAND))
    assert not [decision.reason for decision in live if decision.reason]
    observed = np.stack([decision.observed.observation for decision in live])
    np.testing.assert_allclose(observed, np.stack(seen), atol=2e-4)
    assert speeds(graph) == [decision.command for decision in live]
    driver = json.loads(graph.of("/behaviour_policy")[0].data)
    assert driver == {"policy": "restock", "version": "follower 1"}
    graph.fire(steady=True)
    diagnostics = graph.of("/diagnostics")[-1].status[0]
    assert {entry.key: entry.value for entry in diagnostics.values}["decisions"] == str(steps)


def test_node_commands_only_when_active(policy: Path) -> None:
    graph, node = configured_node(policy)
    robot = TwinRobot(graph, SPEC)
    drive_until_done(robot, steps=3)
    assert not graph.of(COMMAND)  # inactive
    node.trigger_activate()
    drive_until_done(robot, steps=8)
    assert speeds(graph)[-1][0] > 0
    assert node.trigger_deactivate() is Returned.SUCCESS
    assert speeds(graph)[-1] == (0.0, 0.0)
    assert graph.of("/behaviour_policy")[-1].data == PROFILE.behaviour_policy
    count = len(graph.of(COMMAND))
    drive_until_done(robot, steps=2)
    graph.fire(steady=True)
    assert len(graph.of(COMMAND)) == count
    # Activate again, and shut down from the active state.
    node.trigger_activate()
    drive_until_done(robot, steps=4)
    assert node.trigger_shutdown() is Returned.SUCCESS
    assert speeds(graph)[-1] == (0.0, 0.0)
    assert not graph.timers
    assert not any(topic != COMMAND and heard for topic, heard in graph.heard.items())


def test_latched_message_is_requested_from_latching_publisher(policy: Path) -> None:
    """The stub fails if a volatile publisher is asked for kept messages; rclpy only warns."""
    latching, goal = QoS(1, durability=Durability.TRANSIENT_LOCAL), "geometry_msgs/msg/PoseStamped"
    for earlier in (True, False):
        graph = Graph()
        graph.send("/goal_pose", message_class(goal)(), latching if earlier else VOLATILE)
        node = lifecycle_node(graph.ros(), policy)
        assert node.trigger_configure() is Returned.SUCCESS, graph.logged
        buffer = node.policy.pilot.observer._buffers["/goal_pose"]
        assert len(buffer) == earlier
        assert len(graph.heard["/goal_pose"]) == 1 + earlier
        graph.offered["/goal_pose"] = VOLATILE if earlier else latching
        graph.fire(steady=True)
        assert len(buffer) == 1
        assert len(graph.heard["/goal_pose"]) == 2 - earlier
        assert len(graph.heard["/scan"]) == 1  # other topics have no extra subscription
    assert node.trigger_shutdown() is Returned.SUCCESS
    assert not any(graph.heard.values())


def test_reconfiguration_applies_new_limits(tmp_path: Path) -> None:
    def limited_policy(name: str, speed_mps: float) -> Path:
        limiter = Limiter(max_speed_mps=speed_mps, reaction_s=0.0)
        profile = msgspec.structs.replace(PROFILE, limiter=limiter)
        return follower_onnx(tmp_path / f"{name}.onnx", profile)

    graph, node = configured_node(limited_policy("first", 0.9))
    limits = node.policy.pilot.limits
    assert (limits.fastest[0], limits.reaction_s) == (0.9, 0.0)  # 0 s is a valid time
    node._values["policy"] = str(limited_policy("second", 0.3))  # as `ros2 param set` does
    node._values["limiter_stop_m"] = 0.5
    node.trigger_cleanup()
    assert node.trigger_configure() is Returned.SUCCESS, graph.logged
    limits = node.policy.pilot.limits
    assert (limits.fastest[0], limits.stop_m) == (0.3, 0.5)


def test_node_stops_for_silence_stale_input_and_stalled_timer(policy, monkeypatch):
    graph, node = configured_node(policy)
    node.trigger_activate()
    graph.fire()
    assert speeds(graph) == [(0.0, 0.0)]
    assert "nothing received yet" in node.policy.pilot.reason
    robot = TwinRobot(graph, SPEC)
    drive_until_done(robot, steps=8)
    assert speeds(graph)[-1][0] > 0
    graph.now_ns += 2 * 10**9  # no messages arrive any more
    graph.fire()
    assert speeds(graph)[-1] == (0.0, 0.0)
    assert "stale" in node.policy.pilot.reason
    drive_until_done(robot, steps=3)
    count, later = len(graph.of(COMMAND)), time.monotonic() + 10
    monkeypatch.setattr(time, "monotonic", lambda: later)
    graph.fire(steady=True)
    assert len(graph.of(COMMAND)) == count + 1
    assert speeds(graph)[-1] == (0.0, 0.0)
    assert node.policy.pilot.counts["stop: watchdog"] == 1
    assert graph.of("/diagnostics")[-1].status[0].message == "stalled"


def test_node_stops_for_invalid_input_and_counts_it(policy: Path) -> None:
    graph, node, robot = drive_some_steps(policy)
    pilot, beams = node.policy.pilot, len(robot.env.simulation.bearings_rad)
    for invalid in (np.nan, 0.0):
        robot.sense(ranges=np.full(beams, invalid, np.float32))
        graph.fire()
        assert speeds(graph)[-1] == (0.0, 0.0)
        assert pilot.reason == "scan: no beam has a valid range"
        robot.drive()
    # A message of another type is ignored and counted.
    graph.send("/odom", message_class("std_msgs/msg/Bool")())
    assert pilot.unreadable == {"/odom": 1}
    # If the clock is set back, earlier messages are discarded.
    graph.now_ns -= 10**12
    graph.fire()
    assert pilot.reason == "clock: went back"
    graph.fire()
    assert "nothing received yet" in pilot.reason
    assert speeds(graph)[-1] == (0.0, 0.0)
    assert all(np.isfinite(pair).all() for pair in speeds(graph))


def test_node_stops_for_minus_infinity_ranges(policy: Path) -> None:
    """The scan has -inf (REP 117) ahead of a robot that drives ahead."""
    graph, _, robot = drive_some_steps(policy)
    assert speeds(graph)[-1][0] > 0
    ranges = robot.env.sensing.ranges_m[0].astype(np.float32)
    ranges[np.abs(robot.env.simulation.bearings_rad) < 0.2] = -np.inf
    robot.sense(ranges=ranges)
    graph.fire()
    assert graph.of(SHADOW)[-1].linear.x == 0
    assert graph.of(LIMITER)[-1].data == STOP
    assert speeds(graph)[-1] == (0.0, 0.0)
    robot.sense()
    graph.fire()
    assert speeds(graph)[-1][0] > 0


def test_messages_ahead_of_clock_are_rejected_and_reported(policy: Path) -> None:
    """If accepted, the first one would advance the clock and make a dead lidar look alive."""
    graph, node = configured_node(policy)
    node.trigger_activate()
    robot, send, ahead_s = TwinRobot(graph, SPEC), graph.send, 3600

    def send_stamped_ahead(topic: str, message: Any, *offered: Any) -> None:
        if topic == "/scan":
            message.header.stamp = stamp(graph.now_ns + round(ahead_s * 1e9))
        send(topic, message, *offered)

    graph.send = send_stamped_ahead  # type: ignore[method-assign]
    drive_until_done(robot, steps=2)
    assert node.policy.pilot.reason == "nothing received yet on /scan"
    ahead_s = 0.1  # as with a simulator's clock
    drive_until_done(robot, steps=6)
    assert speeds(graph)[-1][0] > 0
    ahead_s = 0.5
    drive_until_done(robot, steps=4)
    assert node.policy.pilot.reason == "scan: stale"
    assert speeds(graph)[-1] == (0.0, 0.0)
    assert node.policy.pilot.observer.left_out == {}
    graph.fire(steady=True)
    values = {entry.key: entry.value for entry in graph.of("/diagnostics")[-1].status[0].values}
    assert values["ahead of the clock: /scan"] == "6"


def test_node_stops_for_overflowing_action_values(policy: Path, tmp_path: Path) -> None:
    import onnx

    def enlarge(model: Any) -> None:
        (weight,) = [tensor for tensor in model.graph.initializer if tensor.name == "weight"]
        large = np.full(tuple(weight.dims), 3e38, np.float32)
        weight.CopyFrom(onnx.numpy_helper.from_array(large, "weight"))

    graph, node, _ = drive_some_steps(changed_policy(policy, tmp_path / "large.onnx", enlarge))
    assert node.policy.pilot.reason == "policy: the value of its action is not a finite number"
    assert speeds(graph)[-1] == (0.0, 0.0)


def test_unsuitable_policy_leaves_node_unconfigured(policy: Path, tmp_path: Path) -> None:
    other = tmp_path / "turtlebot3.toml"
    other.write_text(profile_toml(load_profile("turtlebot3")), encoding="utf-8")
    for parameters, message in (
        ({"profile": str(other)}, "was made for task"),
        ({"policy": str(tmp_path / "none.onnx")}, "no such file"),
        ({"cmd_vel_type": "std_msgs/msg/Bool"}, "neither the profile's command nor a twist"),
        ({"watchdog_s": 0.0}, "must be within 0 and 60 s"),
        ({"limiter_stop_m": 99.0}, "stop_m"),
        ({"limiter_max_speed_mps": 0.0}, "max_speed_mps"),
        ({"limiter_stop_m": 1}, "not <class 'float'>"),
    ):
        graph = Graph(parameters=parameters)
        node = lifecycle_node(graph.ros(), policy)
        assert node.trigger_configure() is Returned.FAILURE
        assert node.state == "unconfigured"
        assert message in graph.logged[-1]
        assert not graph.timers


def test_parameters_set_command_topic_and_limits(policy: Path) -> None:
    graph, node = configured_node(
        policy,
        cmd_vel_topic="/cmd_vel_policy",
        cmd_vel_type="geometry_msgs/msg/TwistStamped",
        limiter_max_speed_mps=0.3,
    )
    node.trigger_activate()
    robot = TwinRobot(graph, SPEC)
    drive_until_done(robot, steps=6)  # the command is not on /cmd_vel, so the robot stands
    sent = graph.of("/cmd_vel_policy")
    assert max(message.twist.linear.x for message in sent) == pytest.approx(0.3)
    assert sent[-1].header.stamp.sec > 0
    assert {message.data for message in graph.of(LIMITER)} & {1}


def test_node_commands_nothing_in_shadow(policy, tmp_path, capsys):
    graph, node = configured_node(policy, drive=False)
    node.trigger_activate()
    robot, twist = TwinRobot(graph, SPEC), message_class("geometry_msgs/msg/Twist")

    def send_planner_command(step: int) -> None:
        """Repeat navigation's proposal, with a stop every few steps."""
        command = twist()
        proposed = graph.of("/cmd_vel_nav")[-1]
        if step % 5:
            command.linear.x, command.angular.z = proposed.linear.x, proposed.angular.z
        commands.append(command)

    commands: list[Any] = []
    steps = 0
    while steps < 40:
        robot.sense()
        send_planner_command(steps)
        graph.fire()
        graph.send(COMMAND, commands[-1])
        robot.drive()
        steps += 1
    assert len(graph.of(COMMAND)) == steps  # all of them from the planner
    assert len(graph.of(SHADOW)) == len(graph.of(ACTION)) == steps
    assert not graph.of("/behaviour_policy")
    profile = tmp_path / "with_node.toml"
    assert run_node([str(policy), "--write-profile", str(profile)]) == 0
    bag = graph.write(tmp_path / "bag")
    with ingested(bag, profile, tmp_path / "store") as store:
        rows, agreement, limited, policies = store.sql(
            "SELECT count(*), avg((shadow_action = action)::INT),"
            " count(*) FILTER (list_contains(exposures, 'limited') != (limiter_rule > 0)),"
            " list(DISTINCT behaviour_policy) FROM transitions WHERE shadow_action IS NOT NULL"
        ).fetchall()[0]
    assert rows > 30
    assert agreement == pytest.approx(0.8, abs=0.06)
    assert limited == 0
    assert policies == [PROFILE.behaviour_policy]


def test_takeover_silences_node_and_labels_operator(policy, tmp_path):
    graph, node = configured_node(policy)
    node.trigger_activate()
    robot = TwinRobot(graph, SPEC)
    button, twist = message_class("std_msgs/msg/Bool"), message_class("geometry_msgs/msg/Twist")
    by_hand = range(10, 20)
    for step in range(30):
        robot.sense()
        pressed = button()
        pressed.data = step in by_hand
        graph.send(TAKEOVER, pressed)
        before = len(graph.of(COMMAND))
        graph.fire()
        assert len(graph.of(COMMAND)) == before + (step not in by_hand)
        if step in by_hand:
            command = twist()
            command.linear.x = -0.4 if step < 15 else 0.4
            graph.send(COMMAND, command)
        robot.drive()
    counts = node.policy.pilot.counts
    assert (counts["takeovers"], counts["taken over"]) == (1, len(by_hand))
    assert [message.data for message in graph.of("/behaviour_policy")][1] == "operator"
    profile = tmp_path / "with_node.toml"
    profile.write_text(profile_toml(with_node_topics(PROFILE)), encoding="utf-8")
    rows = {}
    for name, omitted_topics in (("driver topic", ()), ("button", ("/behaviour_policy",))):
        partial = Graph(
            sent=[message for message in graph.sent if message[1] not in omitted_topics]
        )
        bag, store_path = partial.write(tmp_path / name), tmp_path / f"{name} store"
        with ingested(bag, profile, store_path) as store:
            rows[name] = store.sql(
                "SELECT behaviour_policy, count(*) FROM transitions GROUP BY 1 ORDER BY 1"
            ).fetchall()
    assert rows["driver topic"] == [("operator", 10), ("restock", 19)]
    assert dict(rows["button"])["operator"] == 10
