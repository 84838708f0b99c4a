"""The ROS 2 node under a real rclpy, over DDS on loopback: run with `make test-ros`."""

import signal
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="no rclpy: `make test-ros` has one")
pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")

from support.ros_domain import BEFORE_NS, RosGraph, domain, node_process
from support.ros_graph import Graph, message_class
from support.twin_robot import TwinRobot, follower_onnx

from restock.cli import main
from restock.ingest.live import node as live
from restock.ingest.live.observer import LiveObserver
from restock.ingest.profile.profile import load_profile, profile_toml
from restock.replay.store.store import Store
from restock.train.twin.physics.episode import EpisodeSpec
from restock.train.twin.recording.bag_writer import serialise

PROFILE = load_profile("warehouse_amr")
SPEC = EpisodeSpec("nominal", 20_003)
PERIOD_NS = round(PROFILE.task.control_period_s * 1e9)
COMMAND, WHO, TWIST = "/cmd_vel", "/behaviour_policy", "geometry_msgs/msg/Twist"
STATES = {"configure": "inactive", "activate": "active", "shutdown": "finalized"}
BOOL = "std_msgs/msg/Bool"
SENDS = LiveObserver(PROFILE).topics | {live.TAKEOVER: BOOL}
HEARS = {
    COMMAND: TWIST,
    WHO: "std_msgs/msg/String",
    live.SHADOW: TWIST,
    live.PROPOSAL: TWIST,
    live.ACTION: "std_msgs/msg/Int16",
    live.LIMITER: "std_msgs/msg/UInt8",
}
SIMULATED = ("--ros-args", "-p", "use_sim_time:=true", "-p", "watchdog_s:=60.0")
DRIVES = ("--activate", "--drive", *SIMULATED)


@pytest.fixture(scope="module", autouse=True)
def own_domain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with domain(tmp_path_factory.mktemp("ros")):
        yield


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return follower_onnx(tmp_path_factory.mktemp("policy") / "p.onnx", PROFILE)


@pytest.fixture
def graph() -> Iterator[RosGraph]:
    made = RosGraph(SENDS, HEARS, keep="/goal_pose")
    yield made
    made.close()


def drive_by_hand(graph: Graph, step: int, hand: range) -> None:
    """Press the button and drive to and fro during the steps of `hand`."""
    pressed = message_class(BOOL)()
    pressed.data = step in hand
    graph.send(live.TAKEOVER, pressed)
    if step in hand:
        command = message_class(TWIST)()
        command.linear.x = -0.4 if step - hand.start < len(hand) / 2 else 0.4
        graph.send(COMMAND, command)


def episode(graph: RosGraph, hand: range = range(0)) -> Iterator[TwinRobot]:
    """Drive an episode with the node of another process; yield the robot at each control period."""
    robot = TwinRobot(graph, SPEC)
    now_ns = int(robot.env.signals["stamp_ns"][0])
    graph.until(graph.matched)
    # A timer fires once its clock exists, at first without any input.
    with graph.more(live.LIMITER, COMMAND, meanwhile=partial(graph.clock, now_ns - PERIOD_NS)):
        pass
    for step in range(240):
        with graph.more(live.LIMITER, COMMAND, meanwhile=partial(graph.clock, now_ns)):
            graph.clock(now_ns - BEFORE_NS)
            robot.sense()
            drive_by_hand(graph, step, hand)
            graph.settled()
        ended = robot.drive()
        now_ns += PERIOD_NS
        yield robot
        if ended:
            return


def test_node_drives_twin_to_goal_with_takeover(policy, graph, tmp_path):
    with node_process(tmp_path / "log", str(policy), *DRIVES):
        *_, robot = drives = list(episode(graph, hand := range(20, 30)))
    assert bool(robot.info["success"][0])
    assert "incompatible QoS" not in (tmp_path / "log").read_text(encoding="utf-8")
    profile, store = tmp_path / "with_node.toml", tmp_path / "store"
    profile.write_text(profile_toml(live.with_node_topics(PROFILE)), encoding="utf-8")
    bag = graph.write(tmp_path / "bag")
    assert main(["ingest", str(bag), "--profile", str(profile), "--store", str(store)]) == 0
    with Store(store) as opened:
        rows = dict(
            opened.sql("SELECT behaviour_policy, count(*) FROM transitions GROUP BY 1").fetchall()
        )
    assert rows["operator"] == pytest.approx(len(hand), abs=1)
    assert rows["restock"] == pytest.approx(len(drives) - len(hand), abs=3)
    assert set(rows) <= {"operator", "restock", PROFILE.behaviour_policy}


@pytest.mark.parametrize(
    ("to", "number"),
    [
        ((), signal.SIGINT),
        ((), signal.SIGTERM),
        (("configure",), signal.SIGTERM),
        (("configure", "activate"), signal.SIGINT),  # in shadow mode
        (("configure", "shutdown"), signal.SIGINT),
    ],
)
def test_signal_ends_node_in_every_state(policy, graph, tmp_path, to, number):
    log = tmp_path / "log"
    with node_process(log, str(policy)) as process:
        graph.until(lambda: "waits for" in log.read_text(encoding="utf-8"))
        for label in to:
            graph.change(label, STATES[label])
        process.send_signal(number)
        assert process.wait(120) == 0
    assert "interrupted: stopping" in log.read_text(encoding="utf-8")
    assert not graph.of(COMMAND)


def test_signal_while_driving_sends_stop(policy, graph, tmp_path):
    with node_process(tmp_path / "log", str(policy), *DRIVES) as process:
        for _ in episode(graph):
            if graph.of(COMMAND)[-1].linear.x > 0:
                break
        process.send_signal(signal.SIGTERM)
        assert process.wait(120) == 0
        graph.until(lambda: len(graph.of(WHO)) == 2)
        graph.until(lambda: graph.of(COMMAND)[-1].linear.x == 0)
    assert graph.of(WHO)[-1].data == PROFILE.behaviour_policy


def test_stub_and_rclpy_give_the_same_commands(policy: Path, graph: RosGraph) -> None:
    from rclpy.parameter import Parameter

    robot, hand, steps = TwinRobot(graph, SPEC), range(10, 15), 30
    first_ns = int(robot.env.signals["stamp_ns"][0])
    node = live.lifecycle_node(live.load_ros(), policy, drive=True)
    node.set_parameters([Parameter("use_sim_time", value=True)])
    node.declare_parameter("watchdog_s", 60.0)
    graph.add(node)

    def clock(now_ns: int) -> None:
        graph.until(
            lambda: node.get_clock().now().nanoseconds == now_ns, lambda: graph.clock(now_ns)
        )

    clock(first_ns - PERIOD_NS)
    assert node.trigger_configure().name == node.trigger_activate().name == "SUCCESS"
    heard: Counter[str] = Counter()
    receive = node.policy.pilot.receive

    def count(topic: str, message: Any, now_ns: int) -> None:
        receive(topic, message, now_ns)
        heard[topic] += 1

    node.policy.pilot.receive = count
    graph.until(graph.matched)
    graph.until(
        lambda: all(
            publisher.get_subscription_count() for publisher in node.policy._published.values()
        )
    )
    messages: list[list[tuple[str, Any]]] = []
    send = graph.send

    def send_and_keep(topic: str, message: Any, *offered: Any) -> None:
        messages[-1].append((topic, message))
        send(topic, message, *offered)

    graph.send = send_and_keep  # type: ignore[method-assign]
    for step in range(steps):
        now_ns = int(robot.env.signals["stamp_ns"][0])
        clock(now_ns - BEFORE_NS)
        messages.append([])
        before = heard.copy()
        robot.sense()
        drive_by_hand(graph, step, hand)
        for topic, _ in messages[-1]:
            graph.until(lambda topic=topic, before=before: heard[topic] > before[topic])
        clock(now_ns)
        for topic in HEARS.keys() - {WHO}:
            graph.until(lambda topic=topic: len(graph.of(topic)) == len(messages))
        graph.until(lambda: heard[COMMAND] == len(messages))
        robot.drive()
    graph.until(lambda: len(graph.of(WHO)) == 3)
    stub = Graph(parameters={"watchdog_s": 60.0})
    stubbed = live.lifecycle_node(stub.ros(), policy, drive=True)
    stubbed.trigger_configure()
    stubbed.trigger_activate()
    for step, sent in enumerate(messages):
        stub.now_ns = first_ns + step * PERIOD_NS - BEFORE_NS
        for topic, message in sent:
            stub.send(topic, message)
        stub.now_ns += BEFORE_NS
        stub.fire()
    for topic in HEARS:
        ours, theirs = (
            [serialise(message) for message in each.of(topic)] for each in (stub, graph)
        )
        assert ours == theirs, topic
    node.trigger_shutdown()
    node.destroy_node()
