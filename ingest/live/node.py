"""A ROS 2 lifecycle node that drives by an exported policy, or reports what it would drive.

Unconfigured, it has no policy. Configured (inactive), it listens, decides and reports on
/diagnostics, but publishes no commands. Active, it publishes commands; in shadow mode it only
publishes what they would have been. It publishes a stop if an input is unreliable, if its timer
stalls (a steady clock watches it), or if it is deactivated or shut down. While a person drives, it
publishes no commands.

In a recording of its topics, the limiter's rule, the proposed action and the command that it would
have sent become columns (`limiter_rule`, `shadow_action`, `shadow_speed_mps`,
`shadow_yaw_rate_radps`), which are null without the node. The exposure `limited` labels the steps
at which the limiter held a command back.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec

from restock.errors import ConfigError
from restock.ingest.live.pilot import Decision, Pilot
from restock.ingest.live.policy_file import PolicyFile
from restock.ingest.profile.profile import Profile
from restock.ingest.profile.tables import CustomSignal, Input, is_motion
from restock.ingest.task.conditions import Condition
from restock.ingest.task.robot import RULES, Limiter, Limits

PROPOSAL, SHADOW = "/restock/proposal", "/restock/shadow_cmd_vel"
ACTION, LIMITER = "/restock/action", "/restock/limiter"
TAKEOVER = "/restock/takeover"
BEHAVIOUR = "/behaviour_policy"
STRING = "std_msgs/msg/String"
TWISTS = {  # message type -> field paths of speed and yaw rate
    "geometry_msgs/msg/Twist": ("linear.x", "angular.z"),
    "geometry_msgs/msg/TwistStamped": ("twist.linear.x", "twist.angular.z"),
}


@dataclass(frozen=True)
class CommandForm:
    """The topic and type of a command, and the fields of speed and turn."""

    topic: str
    type: str
    speed: str  # field paths
    turn: str
    wheelbase_m: float | None = None  # if set, `turn` is a steering angle

    @classmethod
    def of(cls, profile: Profile, topic: str = "", kind: str = "") -> CommandForm:
        """Return the form of a robot's command; `topic` and `kind` replace the profile's.

        Raises:
            ConfigError: `kind` is neither the profile's command nor a twist.
        """
        command = profile.inputs.command
        measured = is_motion(command.type)  # the measured motion stands in for unrecorded commands
        topic = topic or ("/cmd_vel" if measured else command.topic)
        kind = kind or ("geometry_msgs/msg/Twist" if measured else command.type)
        if kind == command.type:
            turn = command.fields.get("steering_rad") or command.fields["yaw_rate_radps"]
            return cls(topic, kind, command.fields["speed_mps"], turn, command.wheelbase_m)
        if kind not in TWISTS:
            raise ConfigError(
                f"{kind!r} is neither the profile's command nor a twist",
                where="cmd_vel_type",
                remedy=f"choose from {', '.join([command.type, *TWISTS])}",
            )
        return cls(topic, kind, *TWISTS[kind])

    def fill(self, message: Any, speed_mps: float, yaw_rate_radps: float) -> Any:
        """Write a command into the message; write a stop if a value is not finite."""
        turn = yaw_rate_radps
        if not (math.isfinite(speed_mps) and math.isfinite(turn)):
            speed_mps = turn = 0.0
        if self.wheelbase_m is not None:  # at speed 0 a steered robot cannot turn
            turn = math.atan(turn * self.wheelbase_m / speed_mps) if speed_mps else 0.0
        for path, value in ((self.speed, speed_mps), (self.turn, turn)):
            *way, last = path.split(".")
            holder = message
            for name in way:
                holder = getattr(holder, name)
            setattr(holder, last, float(value))
        return message


def with_node_topics(profile: Profile) -> Profile:
    """Return the profile, extended by inputs and signals from the topics of this node."""
    form = CommandForm.of(profile)
    age_s = 2 * profile.task.control_period_s

    def signal(topic: str, kind: str, path: str, unit: str, doc: str) -> CustomSignal:
        return CustomSignal(topic, kind, path, unit, max_age_s=age_s, doc=doc)

    rules = ", ".join(f"{number} {rule}" for number, rule in enumerate(RULES))
    subject = "of the command that the policy would have sent, after its limiter"
    signals = {
        "shadow_action": signal(
            ACTION, "std_msgs/msg/Int16", "data", "1", "index of the action that it proposed"
        ),
        "shadow_speed_mps": signal(SHADOW, form.type, form.speed, "m/s", f"speed {subject}"),
        "limiter_rule": signal(LIMITER, "std_msgs/msg/UInt8", "data", "1", rules),
    }
    if form.wheelbase_m is None:
        signals["shadow_yaw_rate_radps"] = signal(
            SHADOW, form.type, form.turn, "rad/s", f"yaw rate {subject}"
        )
    doc = "The limiter held back what the policy proposed."
    held = "coalesce(limiter_rule, 0) > 0"
    limited = Condition(name="limited", timing="pre", kind="exposure", sql=held, doc=doc)
    inputs, people = profile.inputs, profile.command_sources
    if inputs.behaviour_policy is None:
        reported = Input(BEHAVIOUR, STRING, {"text": "data"}, optional=True)
        inputs = msgspec.structs.replace(inputs, behaviour_policy=reported)
    if "operator" not in people:
        button = Input(TAKEOVER, "std_msgs/msg/Bool", {"pressed": "data"})
        people = {**people, "operator": button}
    own = [one for one in profile.own_conditions if one.name != limited.name]
    return msgspec.structs.replace(
        profile,
        inputs=inputs,
        command_sources=people,
        signals={**signals, **profile.signals},
        own_conditions=[*own, limited],
    )


def quality(ros: Any, depth: int, *, reliable: bool = True, latched: bool = False) -> Any:
    """Return a quality of service; if not `reliable`, a subscription accepts any publisher.

    With `latched`, late subscribers also get the last message.
    """
    reliability, durability = ros.ReliabilityPolicy, ros.DurabilityPolicy
    return ros.QoSProfile(
        depth=depth,
        reliability=reliability.RELIABLE if reliable else reliability.BEST_EFFORT,
        durability=durability.TRANSIENT_LOCAL if latched else durability.VOLATILE,
    )


def load_ros() -> SimpleNamespace:
    """Import rclpy of the sourced ROS 2 (Jazzy or later), and return its classes by name.

    `get_message` returns the class of a message type.

    Raises:
        ConfigError: rclpy cannot be imported.
    """
    names = {
        "rclpy.lifecycle": ("LifecycleNode", "TransitionCallbackReturn"),
        "rclpy.qos": ("QoSProfile", "ReliabilityPolicy", "DurabilityPolicy"),
        "rclpy.callback_groups": ("MutuallyExclusiveCallbackGroup",),
        "rclpy.executors": ("MultiThreadedExecutor",),
        "rclpy.clock": ("Clock", "ClockType"),
        "rclpy.signals": ("SignalHandlerOptions",),
        "rclpy.duration": ("Duration",),
    }
    try:
        found = {
            name: getattr(import_module(module), name)
            for module, each in names.items()
            for name in each
        }
        return SimpleNamespace(rclpy=import_module("rclpy"), get_message=_message_class, **found)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"needs ROS 2, whose rclpy cannot be imported: {error}",
            where="restock-node",
            remedy="source /opt/ros/DISTRO/setup.bash (Jazzy or later), in an environment made"
            " with --system-site-packages; without ROS, --on RECORDING plays a recording to it",
        ) from error


def _message_class(kind: str) -> Any:
    package, folder, name = kind.split("/")
    return getattr(import_module(f"{package}.{folder}"), name)


DIAGNOSTICS_S = 1.0
DISCOVERY_S = 1.0
MAX_AHEAD_S = 0.2  # limit of stamps ahead of the clock: simulators publish /clock at 10 Hz or more
ACKED_S = 0.5  # longest wait, per topic, until subscribers acknowledge the last stop
WAKE_S = 0.2  # SIGINT and SIGTERM are handled within this time
NAME = "restock_policy"


class PolicyNode:
    """What a lifecycle node does in its transitions; `node` is an rclpy LifecycleNode."""

    def __init__(self, ros: Any, node: Any, policy: Path, *, drive: bool = False) -> None:
        self.ros, self.node = ros, node
        self.pilot: Pilot | None = None
        self.active = False
        self._watch_group = ros.MutuallyExclusiveCallbackGroup()
        self._commanding = threading.Lock()  # so that no command follows the last stop
        self._decided_s = math.inf  # time of the last decision, by the steady clock
        self._published_driver = ""  # who drives, as last published
        self._classes: dict[str, Any] = {}
        self._published: dict[str, Any] = {}
        self._reports: Any = None
        self._subscriptions: dict[str, Any] = {}  # best effort, which matches any publisher
        self._latched: dict[str, Any] = {}  # additional subscriptions, while a publisher latches
        self._latching: dict[str, Any] = {}  # topic that may be latched -> message class
        self._timers: list[Any] = []
        self._parameter("policy", str(policy))
        self._parameter("profile", "")
        self._parameter("shadow", not drive)
        self._parameter("limiter", True)
        self._parameter("cmd_vel_topic", "")  # "" here and below: as in the profile
        self._parameter("cmd_vel_type", "")

    # -- transitions ----------------------------------------------------------------------------

    def configure(self) -> None:
        """Read the policy, and create publishers, subscriptions and timers.

        Raises:
            RestockError: the policy or a parameter cannot be used.
        """
        policy = PolicyFile(Path(self._value("policy")), self._value("profile") or None)
        profile, task = policy.profile, policy.profile.task
        given_s = self._number("watchdog_s")
        self.watchdog_s = 2.5 * task.control_period_s if given_s is None else given_s
        if not 0 < self.watchdog_s <= 60:
            raise ConfigError(
                f"must be within 0 and 60 s, got {self.watchdog_s:g}", where="watchdog_s"
            )
        limits = self._limits(policy)
        self.form = CommandForm.of(
            profile, self._value("cmd_vel_topic"), self._value("cmd_vel_type")
        )
        self.shadow = bool(self._value("shadow"))
        pilot = Pilot(policy, limits, TAKEOVER, MAX_AHEAD_S)
        reported = profile.inputs.behaviour_policy
        kinds = {
            "proposal": (PROPOSAL, self.form.type),
            "action": (ACTION, "std_msgs/msg/Int16"),
            "limiter": (LIMITER, "std_msgs/msg/UInt8"),
            "shadow": (SHADOW, self.form.type),
        }
        if not self.shadow:
            kinds["command"] = (self.form.topic, self.form.type)
            kinds["behaviour"] = (BEHAVIOUR if reported is None else reported.topic, STRING)
        self._published_driver = ""
        self._classes = {name: self._class(kind) for name, (_, kind) in kinds.items()}
        classes = {topic: self._class(kind) for topic, kind in pilot.topics.items()}
        self._published = {
            name: self.node.create_lifecycle_publisher(
                self._classes[name],
                topic,
                quality(self.ros, 1, latched=name == "behaviour"),
            )
            for name, (topic, _) in kinds.items()
        }
        status = self._classes["diagnostics"] = self._class("diagnostic_msgs/msg/DiagnosticArray")
        self._reports = self.node.create_publisher(status, "/diagnostics", 10)
        self.pilot = pilot
        self._subscriptions = {
            topic: self._subscribe(topic, kind, quality(self.ros, 10, reliable=False))
            for topic, kind in classes.items()
        }
        self._latching = {topic: classes[topic] for topic in sorted(pilot.latched)}
        self._match_latched()
        # Control ticks follow the node's clock, which obeys use_sim_time; the rest, a steady clock.
        steady = self.ros.Clock(clock_type=self.ros.ClockType.STEADY_TIME)
        self._timers = [
            self.node.create_timer(task.control_period_s, self._tick),
            self.node.create_timer(
                self.watchdog_s / 2,
                self._check_watchdog,
                callback_group=self._watch_group,
                clock=steady,
            ),
            self.node.create_timer(DIAGNOSTICS_S, self._report, clock=steady),
            self.node.create_timer(DISCOVERY_S, self._match_latched, clock=steady),
        ]
        mode = "shadow: it sends no commands" if self.shadow else f"it drives {self.form.topic}"
        self._log(f"{policy.path}: profile {profile.name}, task {task.hash}, {mode}")

    def activate(self) -> None:
        """Start to publish; the lifecycle publishers must be enabled already."""
        self._decided_s, self.active = time.monotonic(), True
        self._publish_driver(self._own_policy())

    def deactivate(self) -> None:
        """Publish a stop, then nothing more; the lifecycle publishers must still be enabled."""
        with self._commanding:
            if self.active and self._is_driving():
                self._command(0.0, 0.0)
                assert self.pilot is not None
                self._publish_driver(self.pilot.profile.behaviour_policy)
                self._await_delivery()
            self.active = False

    def _await_delivery(self) -> None:
        """Wait until subscribers have the stop, as unsent messages are lost with the publisher."""
        for name in ("command", "behaviour"):
            try:
                acked = self._published[name].wait_for_all_acked(self.ros.Duration(seconds=ACKED_S))
            except RuntimeError:  # this middleware does not support it
                continue
            if not acked:
                self._log(f"last {name}: not all subscribers received it within {ACKED_S:g} s")

    def cleanup(self) -> None:
        """Destroy what `configure` created."""
        self.deactivate()
        self.pilot = None
        for timer in self._timers:
            self.node.destroy_timer(timer)
        for subscription in (*self._subscriptions.values(), *self._latched.values()):
            self.node.destroy_subscription(subscription)
        for publisher in self._published.values():
            self.node.destroy_lifecycle_publisher(publisher)
        if self._reports is not None:
            self.node.destroy_publisher(self._reports)
        self._timers, self._published, self._reports = [], {}, None
        self._subscriptions, self._latched, self._latching = {}, {}, {}

    # -- messages and ticks ---------------------------------------------------------------------

    def _subscribe(self, topic: str, kind: Any, qos: Any) -> Any:
        return self.node.create_subscription(kind, topic, partial(self._receive, topic), qos)

    def _match_latched(self) -> None:
        """Subscribe to latched messages of each topic that a publisher latches now, and only then.

        From publishers that do not latch, such a subscription gets nothing, and both sides warn.
        """
        keeps = self.ros.DurabilityPolicy.TRANSIENT_LOCAL
        for topic, kind in self._latching.items():
            offers = self.node.get_publishers_info_by_topic(self.node.resolve_topic_name(topic))
            offered = any(one.qos_profile.durability == keeps for one in offers)
            if offered and topic not in self._latched:
                self._latched[topic] = self._subscribe(
                    topic, kind, quality(self.ros, 1, latched=True)
                )
            elif not offered and topic in self._latched:
                self.node.destroy_subscription(self._latched.pop(topic))

    def _receive(self, topic: str, message: Any) -> None:
        if self.pilot is not None:
            self.pilot.receive(topic, message, self._now_ns())

    def _tick(self) -> None:
        if self.pilot is None:
            return
        began_s = time.monotonic()
        decision = self.pilot.decide(self._now_ns())
        self._decided_s = time.monotonic()
        late = self._decided_s - began_s > self.watchdog_s  # the watchdog has stopped the robot
        with self._commanding:
            if not self.active:
                return
            self._publish_shadow(decision)
            if self.shadow:
                return
            if decision.taken_over:
                self._publish_driver("operator")
                return
            self._publish_driver(self._own_policy())
            self._command(*((0.0, 0.0) if late else decision.command))

    def _publish_shadow(self, decision: Decision) -> None:
        """Publish the decision and the limiter's rule, to be recorded, whoever drives."""
        rule = self._classes["limiter"]()
        rule.data = decision.rule
        self._published["limiter"].publish(rule)
        self._published["shadow"].publish(self._filled("shadow", *decision.command))
        if decision.action is not None:
            action = self._classes["action"]()
            action.data = decision.action
            self._published["action"].publish(action)
            self._published["proposal"].publish(self._filled("proposal", *decision.proposal))

    def _check_watchdog(self) -> None:
        """Publish a stop if ticks stop coming, because a decision hangs or the clock stopped."""
        with self._commanding:
            if not self.active or self.pilot is None:
                return
            if time.monotonic() - self._decided_s > self.watchdog_s:
                self.pilot.counts["stop: watchdog"] += 1
                if self._is_driving():
                    self._command(0.0, 0.0)

    def _is_driving(self) -> bool:
        """Return whether this node's commands drive the robot."""
        return (
            not self.shadow and self.pilot is not None and not self.pilot.taken_over(self._now_ns())
        )

    def _command(self, speed_mps: float, yaw_rate_radps: float) -> None:
        self._published["command"].publish(self._filled("command", speed_mps, yaw_rate_radps))

    def _filled(self, name: str, speed_mps: float, yaw_rate_radps: float) -> Any:
        message = self._classes[name]()
        if hasattr(message, "header"):
            message.header.stamp = self.node.get_clock().now().to_msg()
        return self.form.fill(message, speed_mps, yaw_rate_radps)

    def _publish_driver(self, who: str) -> None:
        """Publish who drives, once, latched for late subscribers."""
        if not self.shadow and who != self._published_driver:
            message = self._classes["behaviour"]()
            message.data = self._published_driver = who
            self._published["behaviour"].publish(message)

    def _own_policy(self) -> str:
        assert self.pilot is not None
        return json.dumps({"policy": "restock", "version": self.pilot.policy.version})

    def _report(self) -> None:
        """Publish counts of decisions, stops by reason, and interventions to /diagnostics."""
        if self.pilot is None:
            return
        pilot, message = self.pilot, self._classes["diagnostics"]()
        kind = self._class("diagnostic_msgs/msg/DiagnosticStatus")
        pair = self._class("diagnostic_msgs/msg/KeyValue")
        stalled = self.active and time.monotonic() - self._decided_s > self.watchdog_s
        status = kind()
        status.name, status.hardware_id = f"{NAME}: policy", pilot.policy.version
        status.level = kind.ERROR if stalled else kind.WARN if pilot.reason else kind.OK
        mode = "shadow" if self.shadow else "drives"
        status.message = (
            "stalled" if stalled else pilot.reason or (mode if self.active else "ready")
        )
        counts = {**pilot.counts, **{f"unreadable: {k}": n for k, n in pilot.unreadable.items()}}
        counts |= {f"off the clock: {k}": n for k, n in pilot.observer.left_out.items()}
        counts |= {f"ahead of the clock: {k}": n for k, n in pilot.observer.ahead.items()}
        for name, count in counts.items():
            entry = pair()
            entry.key, entry.value = name, str(int(count))
            status.values.append(entry)
        message.header.stamp = self.node.get_clock().now().to_msg()
        message.status.append(status)
        self._reports.publish(message)

    # -- parameters -----------------------------------------------------------------------------

    def _class(self, kind: str) -> Any:
        """Return the class of a message type.

        Raises:
            ConfigError: it is not installed.
        """
        try:
            return self.ros.get_message(kind)
        except (ImportError, AttributeError, ValueError) as error:
            raise ConfigError(
                f"message type {kind} cannot be imported: {error}",
                where="the node",
                remedy="install and source the package that defines it",
            ) from error

    def _parameter(self, name: str, default: Any) -> None:
        if not self.node.has_parameter(name):
            self.node.declare_parameter(name, default)

    def _number(self, name: str) -> float | None:
        """Return a parameter that replaces a number of the profile; None if it is negative."""
        self._parameter(name, -1.0)
        value = float(self._value(name))
        return None if value < 0 else value  # the caller refuses 0 and NaN

    def _value(self, name: str) -> Any:
        return self.node.get_parameter(name).value

    def _limits(self, policy: PolicyFile) -> Limits | None:
        """Return the limits from parameters `limiter_…`, or else the profile; None: no limiter."""
        profile = policy.profile
        limits = {} if profile.limiter is None else msgspec.structs.asdict(profile.limiter)
        for name in Limiter.__struct_fields__:
            if (value := self._number(f"limiter_{name}")) is not None:
                limits[name] = value
        if not self._value("limiter"):
            return None
        if not profile.task.lidar:
            self._log(
                "no lidar: the limiter limits speed and acceleration, but cannot see obstacles"
            )
        try:
            return Limits.of(profile.task, profile.robot, msgspec.convert(limits, Limiter))
        except (ValueError, msgspec.ValidationError) as error:
            raise ConfigError(str(error), where="limiter_…") from error

    def _now_ns(self) -> int:
        return int(self.node.get_clock().now().nanoseconds)

    def _log(self, text: str) -> None:
        self.node.get_logger().info(text)


def lifecycle_node(ros: Any, policy: Path, *, drive: bool = False) -> Any:
    """Create the node, unconfigured.

    Its transitions return SUCCESS. If it cannot be configured, it logs the reason, returns FAILURE
    and stays unconfigured.
    """
    returned = ros.TransitionCallbackReturn

    class Node(ros.LifecycleNode):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(NAME)
            self.policy = PolicyNode(ros, self, policy, drive=drive)

        def on_configure(self, state: Any) -> Any:
            try:
                self.policy.configure()
            except Exception as error:  # noqa: BLE001  (rclpy would not report it)
                self.get_logger().error(f"cannot be configured: {error}")
                self.policy.cleanup()
                return returned.FAILURE
            return super().on_configure(state)

        def on_activate(self, state: Any) -> Any:
            enabled = super().on_activate(state)  # enables the publishers
            if enabled == returned.SUCCESS:
                self.policy.activate()
            return enabled

        def on_deactivate(self, state: Any) -> Any:
            self.policy.deactivate()  # publishes a stop, so before the publishers are disabled
            return super().on_deactivate(state)

        def on_cleanup(self, state: Any) -> Any:
            return self._end(super().on_cleanup, state)

        def on_shutdown(self, state: Any) -> Any:
            return self._end(super().on_shutdown, state)

        def on_error(self, state: Any) -> Any:
            return self._end(super().on_error, state)

        def _end(self, call: Callable[[Any], Any], state: Any) -> Any:
            self.policy.deactivate()
            ended = call(state)
            self.policy.cleanup()
            return ended

    return Node()


def run_node(ros: Any, policy: Path, *, drive: bool = False, activate: bool = False) -> int:
    """Spin the node until SIGINT or SIGTERM; stop the robot before it ends. Returns 0."""
    import signal

    # rclpy's signal handlers would end the context before a last stop could be published. Python's
    # handlers run only after a wait for messages: WAKE_S is short. A launch may signal repeatedly.
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    ros.rclpy.init(signal_handler_options=ros.SignalHandlerOptions.NO)
    node = lifecycle_node(ros, policy, drive=drive)
    executor = ros.MultiThreadedExecutor(num_threads=2)  # so that one is free for the watchdog
    executor.add_node(node)
    try:
        if activate:
            done = node.trigger_configure()
            if done != ros.TransitionCallbackReturn.SUCCESS:
                raise ConfigError("could not be configured: see the node's log", where=str(policy))
            node.trigger_activate()
        else:
            node.get_logger().info("unconfigured: waits for `configure`")
        while not ended.is_set():
            executor.spin_once(timeout_sec=WAKE_S)
        node.get_logger().info("interrupted: stopping")
    finally:
        node.policy.deactivate()
        executor.shutdown()
        node.destroy_node()
        ros.rclpy.try_shutdown()
    return 0
