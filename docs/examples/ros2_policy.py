"""An exported policy as a ROS 2 node: messages in, a velocity command out at 5 Hz.

On a robot (`rclpy` installed):

    rclpy.init()
    node = rclpy.create_node("restock_policy")
    PolicyNode(node, Path("policy.onnx"), message_class=rosidl_runtime_py.utilities.get_message)
    rclpy.spin(node)

Without ROS, on a recording, against the commands that it holds:

    python docs/examples/ros2_policy.py policy.onnx sample_logs/amr_tuesday

The observation is made by `restock.ingest.LiveObserver`, from the very functions that read the logs
the policy learnt from. What cannot be acted on (a topic that is silent or stale) is a stop.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from restock.ingest import LiveObserver, load_profile

STOP = 0  # action 0 of every task


class PolicyNode:
    """Holds what is received, and decides when its timer fires.

    `node` is an `rclpy.node.Node`, or anything with its four methods below.
    """

    def __init__(self, node: Any, policy: Path, message_class: Callable[[str], Any]) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # a small network: handing it out costs more
        self.session = onnxruntime.InferenceSession(str(policy), options)
        metadata = self.session.get_modelmeta().custom_metadata_map
        profile = load_profile(metadata["profile"])
        if profile.task.hash != metadata["task_hash"]:
            raise ValueError(
                f"{policy} is of task {metadata['task_hash']}, not {profile.task.hash}"
            )
        self.actions = json.loads(metadata["actions"])
        self.observer = LiveObserver(profile)
        self.clock = node.get_clock()
        self.twist = message_class(profile.inputs.command.type)
        self.commands = node.create_publisher(self.twist, profile.inputs.command.topic, 10)
        for topic, kind in self.observer.topics.items():
            # The command topic too: whoever drives, what was in force is part of the observation.
            node.create_subscription(message_class(kind), topic, partial(self.receive, topic), 10)
        node.create_timer(profile.task.control_period_s, self.decide)

    def receive(self, topic: str, message: Any) -> None:
        self.observer.receive(topic, message, self.clock.now().nanoseconds)

    def decide(self) -> None:
        known = self.observer.observe(self.clock.now().nanoseconds)
        action = STOP
        if not known.problem:
            (action,) = self.session.run(["action"], {"observation": known.observation[None]})[0]
        speed_mps, yaw_rate_radps = self.actions[action]
        command = self.twist()
        command.linear.x, command.angular.z = float(speed_mps), float(yaw_rate_radps)
        self.commands.publish(command)
        self.last = known, int(action)


class BagNode:
    """Stands in for rclpy's node and plays a recording to it, in the order of log time.

    The timer fires when the recorded robot's own did: just before each of its commands, so that
    a decision can be laid beside the step that `restock ingest` makes of it.
    """

    def __init__(self, recording: Path) -> None:
        self.recording, self.nanoseconds = recording, 0
        self.callbacks: dict[str, Callable[[Any], None]] = {}
        self.published: list[Any] = []

    def get_clock(self) -> BagNode:
        return self

    def now(self) -> BagNode:
        return self

    def create_publisher(self, kind: Any, topic: str, depth: int) -> BagNode:
        self.command_topic = topic
        return self

    def publish(self, message: Any) -> None:
        self.published.append(message)

    def create_subscription(
        self, kind: Any, topic: str, callback: Callable[[Any], None], depth: int
    ) -> None:
        self.callbacks[topic] = callback

    def create_timer(self, period_s: float, callback: Callable[[], None]) -> None:
        self.period_ns, self.timer = round(period_s * 1e9), callback

    def play(self, decided: Callable[[int, float], None]) -> None:
        """Play it all; `decided` receives each decision's time (ns) and duration (s)."""
        from rosbags.highlevel import AnyReader

        fired_ns = -self.period_ns
        with AnyReader([self.recording]) as reader:
            wanted = [c for c in reader.connections if c.topic in self.callbacks]
            for connection, self.nanoseconds, raw in reader.messages(wanted):
                due = self.nanoseconds - fired_ns >= 0.75 * self.period_ns
                if connection.topic == self.command_topic and due:
                    fired_ns = self.nanoseconds
                    began = time.perf_counter()
                    self.timer()
                    decided(self.nanoseconds, time.perf_counter() - began)
                self.callbacks[connection.topic](reader.deserialize(raw, connection.msgtype))


def twist_class(kind: str) -> Any:
    """A substitute for a ROS message class: only commands are ever made here."""
    from types import SimpleNamespace

    def make() -> Any:
        return SimpleNamespace(
            linear=SimpleNamespace(x=0.0, y=0.0, z=0.0),
            angular=SimpleNamespace(x=0.0, y=0.0, z=0.0),
        )

    return make


def main(policy: Path, recording: Path) -> dict[str, Any]:
    bag = BagNode(recording)
    node = PolicyNode(bag, policy, twist_class)
    took_s: list[float] = []
    stops: dict[str, int] = {}

    def decided(_: int, seconds: float) -> None:
        took_s.append(seconds)
        if problem := node.last[0].problem:
            stops[problem] = stops.get(problem, 0) + 1

    bag.play(decided)
    p50, p99 = np.quantile(took_s, [0.5, 0.99]) * 1e3
    return {
        "decisions": len(took_s),
        "latency_ms": {"p50": round(p50, 3), "p99": round(p99, 3)},
        "stopped_for": stops,
    }


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]), Path(sys.argv[2])), indent=1))  # noqa: T201
