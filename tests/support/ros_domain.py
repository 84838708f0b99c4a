"""The stub's graph on a real one: what is sent crosses DDS on loopback, and what comes back."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rclpy
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from restock.ingest.live.node import load_ros, quality
from restock.train.twin.recording.bag_writer import build, serialise, stamp, typestore
from support.ros_graph import VOLATILE, Graph, QoS

CLOCK = "/clock"
BEFORE_NS = 1_000_000  # as a simulator whose clock comes at 1 kHz
RUN = "from restock.cli import run_node; raise SystemExit(run_node())"


@contextmanager
def domain(to: Path) -> Iterator[None]:
    """Give this process and its children a ROS domain of their own, on this machine alone."""
    os.environ |= {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(to),
    }
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    yield
    rclpy.try_shutdown()


class RosGraph(Graph):
    """Publishes to `outputs` and hears `inputs` (topic to type), by a node of its own."""

    def __init__(self, outputs: Mapping[str, str], inputs: Mapping[str, str], keep: str) -> None:
        # Late subscribers get the last message of the topic `keep`.
        super().__init__()
        ros = load_ros()
        self._kind = ros.get_message
        self.node = rclpy.create_node("twin")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.publishers = {
            topic: self.node.create_publisher(
                ros.get_message(kind), topic, quality(ros, 1, latched=True) if topic == keep else 10
            )
            for topic, kind in {**outputs, CLOCK: "rosgraph_msgs/msg/Clock"}.items()
        }
        self._listens = set(inputs)
        self._get = self.node.create_client(GetState, "/restock_policy/get_state")
        self._change = self.node.create_client(ChangeState, "/restock_policy/change_state")
        for topic, kind in inputs.items():
            self._listen(topic, kind, ros)

    def _listen(self, topic: str, kind: str, ros: Any) -> None:
        def take(raw: bytes) -> None:
            message = typestore().deserialize_cdr(raw, kind)
            super(RosGraph, self).send(topic, message)

        qos = quality(ros, 1, latched=True) if topic == "/behaviour_policy" else 100
        self.node.create_subscription(ros.get_message(kind), topic, take, qos, raw=True)

    def send(self, topic: str, message: Any, offered: QoS = VOLATILE) -> None:
        self.publishers[topic].publish(serialise(message))
        if topic not in self._listens:  # else it comes back
            super().send(topic, message, offered)

    def clock(self, now_ns: int) -> None:
        self.publishers[CLOCK].publish(
            serialise(build("rosgraph_msgs/msg/Clock", clock=stamp(now_ns)))
        )

    def add(self, node: Any) -> None:
        """Spin another node of this process along."""
        self._executor.add_node(node)

    def until(self, so: Callable[[], bool], meanwhile: Callable[[], None] = lambda: None) -> None:
        """Spin until it is so, for two minutes at most."""
        end_s = time.monotonic() + 120
        while not so():
            assert time.monotonic() < end_s, "waited in vain"
            self._executor.spin_once(timeout_sec=0.1)
            meanwhile()

    @contextmanager
    def more(self, *topics: str, meanwhile: Callable[[], None]) -> Iterator[None]:
        """Spin until each of these topics has brought another message than before."""
        before = {topic: len(self.of(topic)) for topic in topics}
        yield
        for topic, count in before.items():
            self.until(lambda topic=topic, count=count: len(self.of(topic)) > count, meanwhile)

    def state(self) -> str:
        """Return the node's lifecycle state."""
        return str(self._call(self._get, GetState.Request()).current_state.label)

    def change(self, label: str, to: str) -> None:
        """Ask for a transition, and wait for the state that it leads to."""
        request = ChangeState.Request()
        request.transition.label = label
        self._call(self._change, request)
        assert self.state() == to

    def _call(self, client: Any, request: Any) -> Any:
        """Return a service's answer, asked for each second: DDS may not know yet whom to answer."""
        self.until(client.service_is_ready)
        began_s, answers = time.monotonic(), [client.call_async(request)]

        def again() -> None:
            if time.monotonic() - began_s > len(answers):
                answers.append(client.call_async(request))

        self.until(lambda: any(each.done() for each in answers), again)
        return next(each.result() for each in answers if each.done())

    def settled(self) -> None:
        """Wait until the node has taken what was sent: its executor takes messages first."""
        for _ in range(3):
            self.state()

    def matched(self) -> bool:
        """Return whether somebody hears each topic, and each topic that is heard is published."""
        counts = self.node.count_publishers
        return all(each.get_subscription_count() for each in self.publishers.values()) and all(
            counts(topic) for topic in self._listens
        )

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()


@contextmanager
def node_process(log: Path, *args: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run `restock-node` in a process of its own; its output is in `log`."""
    with log.open("wb") as out:
        process = subprocess.Popen(
            [sys.executable, "-c", RUN, *args], stdout=out, stderr=subprocess.STDOUT
        )
        try:
            yield process
            process.send_signal(signal.SIGTERM)
            assert process.wait(120) == 0, log.read_text(encoding="utf-8")
        finally:
            process.kill()
            process.wait()
