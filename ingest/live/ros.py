"""The edge to ROS 2: every name of rclpy that the node uses, imported here and nowhere else."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from restock.errors import ConfigError


@dataclass(frozen=True)
class Ros:
    """rclpy of a sourced ROS 2: Jazzy or later, whose Python is 3.12."""

    rclpy: Any  # the module
    LifecycleNode: Any
    TransitionCallbackReturn: Any
    QoSProfile: Any
    ReliabilityPolicy: Any
    DurabilityPolicy: Any
    MutuallyExclusiveCallbackGroup: Any
    MultiThreadedExecutor: Any
    Clock: Any
    ClockType: Any
    SignalHandlerOptions: Any
    get_message: Any  # "std_msgs/msg/Bool" -> its class

    def sensor_qos(self) -> Any:
        """Matches whatever a publisher offers."""
        return self._qos(10, self.ReliabilityPolicy.BEST_EFFORT, self.DurabilityPolicy.VOLATILE)

    def command_qos(self) -> Any:
        """The newest alone, surely."""
        return self._qos(1, self.ReliabilityPolicy.RELIABLE, self.DurabilityPolicy.VOLATILE)

    def latched_qos(self) -> Any:
        """What was said last, to those who come later too."""
        return self._qos(1, self.ReliabilityPolicy.RELIABLE, self.DurabilityPolicy.TRANSIENT_LOCAL)

    def _qos(self, depth: int, reliability: Any, durability: Any) -> Any:
        return self.QoSProfile(depth=depth, reliability=reliability, durability=durability)


def load_ros() -> Ros:
    """The ROS 2 that is sourced.

    Raises:
        ConfigError: there is none.
    """
    names = {
        "rclpy.lifecycle": ("LifecycleNode", "TransitionCallbackReturn"),
        "rclpy.qos": ("QoSProfile", "ReliabilityPolicy", "DurabilityPolicy"),
        "rclpy.callback_groups": ("MutuallyExclusiveCallbackGroup",),
        "rclpy.executors": ("MultiThreadedExecutor",),
        "rclpy.clock": ("Clock", "ClockType"),
        "rclpy.signals": ("SignalHandlerOptions",),
        "rosidl_runtime_py.utilities": ("get_message",),
    }
    try:
        found = {
            name: getattr(import_module(module), name)
            for module, each in names.items()
            for name in each
        }
        return Ros(rclpy=import_module("rclpy"), **found)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"needs ROS 2, whose rclpy cannot be imported: {error}",
            where="restock-node",
            remedy="source /opt/ros/DISTRO/setup.bash (Jazzy or later), in an environment made"
            " with --system-site-packages; without ROS, --on RECORDING plays a recording to it",
        ) from error


__all__ = ["Ros", "load_ros"]
