"""A ROS graph in one process: rclpy stubbed at its API's edge, for a node that runs without ROS.

It has what `restock.ingest.live.node` imports and nothing else, written after rclpy's own source:
the transitions and what their callbacks return, lifecycle publishers that are silent until they are
enabled, which requests of QoS match which offers, timers by the node's clock or a steady one.
`test_ros.py` compares it with rclpy: the same commands for the same messages.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from restock.train.twin.recording.bag_writer import build, serialise, stamp, typestore

Reliability = Enum("Reliability", "RELIABLE BEST_EFFORT")
Durability = Enum("Durability", "VOLATILE TRANSIENT_LOCAL")
Returned = Enum("Returned", "SUCCESS FAILURE ERROR")
ClockType = Enum("ClockType", "ROS_TIME STEADY_TIME")


@dataclass(frozen=True)
class QoS:
    depth: int
    reliability: Reliability = Reliability.RELIABLE
    durability: Durability = Durability.VOLATILE

    def offers(self, requested: "QoS") -> bool:
        """Whether a subscription that asks for this gets anything of a publisher with mine."""
        reliable = self.reliability is Reliability.RELIABLE
        latched = self.durability is Durability.TRANSIENT_LOCAL
        return (reliable or requested.reliability is Reliability.BEST_EFFORT) and (
            latched or requested.durability is Durability.VOLATILE
        )


VOLATILE = QoS(10)


@dataclass
class Graph:
    """Who listens to what; every message that was sent, with its time."""

    now_ns: int = 1_000_000_000
    sent: list[tuple[int, str, Any]] = field(default_factory=list)
    heard: dict[str, list[tuple[QoS, Callable[[Any], None]]]] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)  # of the launch file
    logged: list[str] = field(default_factory=list)
    timers: list[SimpleNamespace] = field(default_factory=list)
    offered: dict[str, QoS] = field(default_factory=dict)  # by the last publisher of a topic

    def send(self, topic: str, message: Any, offered: QoS = VOLATILE) -> None:
        self.sent.append((self.now_ns, topic, message))
        self.offered[topic] = offered
        for requested, callback in list(self.heard.get(topic, ())):
            if offered.offers(requested):
                callback(message)

    def of(self, topic: str) -> list[Any]:
        return [message for _, name, message in self.sent if name == topic]

    def fire(self, *, steady: bool = False) -> None:
        """Every timer of a clock once."""
        for timer in list(self.timers):
            if timer.steady == steady:
                timer.callback()

    def ros(self) -> SimpleNamespace:
        class Bound(LifecycleNode):
            def __init__(bound, name: str) -> None:
                super().__init__(self, name)

        return SimpleNamespace(
            rclpy=None,
            LifecycleNode=Bound,
            TransitionCallbackReturn=Returned,
            QoSProfile=QoS,
            ReliabilityPolicy=Reliability,
            DurabilityPolicy=Durability,
            MutuallyExclusiveCallbackGroup=object,
            MultiThreadedExecutor=None,
            Clock=lambda clock_type: clock_type,
            ClockType=ClockType,
            SignalHandlerOptions=None,
            Duration=lambda seconds: seconds,
            get_message=message_class,
        )

    def write(self, path: Path) -> Path:
        """All that was sent, as a rosbag2 in MCAP."""
        from rosbags.rosbag2 import StoragePlugin, Writer

        with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections: dict[str, Any] = {}
            for now_ns, topic, message in self.sent:
                if topic not in connections:
                    kind = message.__msgtype__
                    connections[topic] = writer.add_connection(topic, kind, typestore=typestore())
                writer.write(connections[topic], now_ns, serialise(message))
        return path


class message_class:
    """Makes empty messages, mutable as rclpy's are; knows the constants of the type."""

    def __init__(self, kind: str) -> None:
        if kind not in typestore().types:
            raise ModuleNotFoundError(f"No module named {kind.split('/')[0]!r}")
        self.kind = kind

    def __call__(self) -> Any:
        return build(self.kind)

    def __getattr__(self, name: str) -> Any:
        return getattr(typestore().types[self.kind], name)


class Publisher:
    def __init__(self, graph: Graph, topic: str, qos: QoS | int, *, enabled: bool) -> None:
        self.graph, self.topic, self.enabled = graph, topic, enabled
        self.unsent: tuple[int, str, Any] | None = None  # goes with its publisher
        self.qos = QoS(qos) if isinstance(qos, int) else qos

    def publish(self, message: Any) -> None:
        if self.enabled:
            self.graph.send(self.topic, message, self.qos)
            self.unsent = self.graph.sent[-1]

    def wait_for_all_acked(self, timeout_s: float) -> bool:
        self.unsent = None
        return True


class LifecycleNode:
    def __init__(self, graph: Graph, name: str) -> None:
        self.graph, self.name, self.state = graph, name, "unconfigured"
        self._managed: list[Publisher] = []
        self._values: dict[str, Any] = {}

    # -- rclpy.node.Node

    def has_parameter(self, name: str) -> bool:
        return name in self._values

    def declare_parameter(self, name: str, value: Any) -> None:
        given = self.graph.parameters.get(name, value)
        if type(given) is not type(value):
            raise TypeError(f"parameter {name} is {type(given)}, not {type(value)}")
        self._values[name] = given

    def get_parameter(self, name: str) -> Any:
        return SimpleNamespace(value=self._values[name])

    def get_clock(self) -> Any:
        now = self.graph.now_ns
        moment = SimpleNamespace(nanoseconds=now, to_msg=lambda: stamp(now))
        return SimpleNamespace(now=lambda: moment)

    def get_logger(self) -> Any:
        return SimpleNamespace(info=self.graph.logged.append, error=self.graph.logged.append)

    def create_publisher(self, kind: Any, topic: str, qos: QoS | int) -> Publisher:
        return Publisher(self.graph, topic, qos, enabled=True)

    def create_lifecycle_publisher(self, kind: Any, topic: str, qos: QoS | int) -> Publisher:
        self._managed.append(Publisher(self.graph, topic, qos, enabled=False))
        return self._managed[-1]

    def create_subscription(
        self, kind: Any, topic: str, callback: Callable[[Any], None], qos: QoS
    ) -> Any:
        self.graph.heard.setdefault(topic, []).append(entry := (qos, callback))
        if qos.durability is Durability.TRANSIENT_LOCAL and (kept := self.graph.of(topic)):
            assert self.graph.offered[topic].offers(qos), f"{topic}: incompatible QoS"
            callback(kept[-1])
        return topic, entry

    def resolve_topic_name(self, topic: str) -> str:
        return topic

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        offered = self.graph.offered.get(topic)
        return [] if offered is None else [SimpleNamespace(qos_profile=offered)]

    def create_timer(
        self, period_s: float, callback: Any, callback_group: Any = None, clock: Any = None
    ) -> Any:
        steady = clock is ClockType.STEADY_TIME
        timer = SimpleNamespace(period_s=period_s, callback=callback, steady=steady)
        self.graph.timers.append(timer)
        return timer

    def destroy_publisher(self, publisher: Publisher) -> None:
        publisher.enabled = False

    def destroy_lifecycle_publisher(self, publisher: Publisher) -> None:
        self._managed.remove(publisher)
        publisher.enabled = False
        if publisher.unsent is not None:
            self.graph.sent.remove(publisher.unsent)

    def destroy_subscription(self, subscription: Any) -> None:
        topic, entry = subscription
        self.graph.heard[topic].remove(entry)

    def destroy_timer(self, timer: Any) -> None:
        self.graph.timers.remove(timer)

    # -- rclpy.lifecycle.LifecycleNodeMixin

    def on_configure(self, state: Any) -> Returned:
        return Returned.SUCCESS

    on_cleanup = on_shutdown = on_error = on_configure

    def on_activate(self, state: Any) -> Returned:
        for publisher in self._managed:
            publisher.enabled = True
        return Returned.SUCCESS

    def on_deactivate(self, state: Any) -> Returned:
        for publisher in self._managed:
            publisher.enabled = False
        return Returned.SUCCESS

    def _change(self, callback: Callable[[Any], Returned], to: str) -> Returned:
        before = self.state
        returned = callback(SimpleNamespace(label=before))
        if returned is Returned.SUCCESS:
            self.state = to
        elif returned is Returned.ERROR:
            self.state = "unconfigured" if self.on_error(None) is Returned.SUCCESS else "finalized"
        return returned

    def trigger_configure(self) -> Returned:
        return self._change(self.on_configure, "inactive")

    def trigger_activate(self) -> Returned:
        return self._change(self.on_activate, "active")

    def trigger_deactivate(self) -> Returned:
        return self._change(self.on_deactivate, "inactive")

    def trigger_cleanup(self) -> Returned:
        return self._change(self.on_cleanup, "unconfigured")

    def trigger_shutdown(self) -> Returned:
        return self._change(self.on_shutdown, "finalized")
