"""Topics that the node publishes, and how a profile reads them from a recording.

The limiter's rule, the proposed action and what would have been driven become columns
(`limiter_rule`, `shadow_action`, `shadow_speed_mps`, `shadow_yaw_rate_radps`), null in recordings
without a node; the exposure `limited` labels the steps at which the limiter held a command back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import msgspec

from restock.errors import ConfigError
from restock.ingest.profile.inputs import Input, is_motion
from restock.ingest.profile.profile import Profile
from restock.ingest.profile.tables import CustomSignal
from restock.ingest.task.conditions import Condition
from restock.ingest.task.limiter import RULES

PROPOSAL, SHADOW = "/restock/proposal", "/restock/shadow_cmd_vel"
ACTION, LIMITER = "/restock/action", "/restock/limiter"
TAKEOVER = "/restock/takeover"
BEHAVIOUR = "/behaviour_policy"
STRING = "std_msgs/msg/String"
TWISTS = {  # message type -> where speed and yaw rate are in it
    "geometry_msgs/msg/Twist": ("linear.x", "angular.z"),
    "geometry_msgs/msg/TwistStamped": ("twist.linear.x", "twist.angular.z"),
}


@dataclass(frozen=True)
class CommandForm:
    """A type of command, and where it says what."""

    topic: str
    type: str
    speed: str  # field paths
    turn: str
    wheelbase_m: float | None = None  # `turn` is a steering angle

    @classmethod
    def of(cls, profile: Profile, topic: str = "", kind: str = "") -> CommandForm:
        """Return the form of a robot's command; `topic` and `kind` replace the profile's.

        Raises:
            ConfigError: a type that the profile does not read and that is no twist.
        """
        command = profile.inputs.command
        measured = is_motion(command.type)  # its commands were not recorded
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
        """Write this command into the message; a value that is not finite becomes a stop."""
        turn = yaw_rate_radps
        if not (math.isfinite(speed_mps) and math.isfinite(turn)):
            speed_mps = turn = 0.0
        if self.wheelbase_m is not None:  # standing still it cannot turn
            turn = math.atan(turn * self.wheelbase_m / speed_mps) if speed_mps else 0.0
        for path, value in ((self.speed, speed_mps), (self.turn, turn)):
            *way, last = path.split(".")
            holder = message
            for name in way:
                holder = getattr(holder, name)
            setattr(holder, last, float(value))
        return message


def with_node_topics(profile: Profile) -> Profile:
    """Return the profile with inputs for what the node published beside the robot's own topics."""
    form = CommandForm.of(profile)
    age_s = 2 * profile.task.control_period_s

    def signal(topic: str, kind: str, path: str, unit: str, doc: str) -> CustomSignal:
        return CustomSignal(topic, kind, path, unit, max_age_s=age_s, doc=doc)

    rules = ", ".join(f"{number} {rule}" for number, rule in enumerate(RULES))
    said = "of the command that the policy would have sent, after its limiter"
    signals = {
        "shadow_action": signal(
            ACTION, "std_msgs/msg/Int16", "data", "1", "index of the action that it proposed"
        ),
        "shadow_speed_mps": signal(SHADOW, form.type, form.speed, "m/s", f"speed {said}"),
        "limiter_rule": signal(LIMITER, "std_msgs/msg/UInt8", "data", "1", rules),
    }
    if form.wheelbase_m is None:
        signals["shadow_yaw_rate_radps"] = signal(
            SHADOW, form.type, form.turn, "rad/s", f"yaw rate {said}"
        )
    limited = Condition(
        name="limited",
        timing="pre",
        kind="exposure",
        sql="coalesce(limiter_rule, 0) > 0",
        doc="The limiter held back what the policy proposed.",
    )
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


__all__ = ["CommandForm", "with_node_topics"]
