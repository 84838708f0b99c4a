"""What of a profile only a recording can give: a running robot has no transforms held, no fixes'
frame and no hindsight."""

from __future__ import annotations

from dataclasses import dataclass

from restock.ingest.profile.profile import Profile

_POSE = "name a topic with the pose in the map frame under [inputs.pose]"


@dataclass(frozen=True)
class NotLive:
    """One thing that a profile takes and a running robot does not give."""

    takes: str  # "its pose from transforms"
    why: str  # why it is not there
    topics: str  # the tables of the profile that it needs instead
    remedy: str
    settings: str = ""  # that it needs with them


def not_live(profile: Profile) -> list[NotLive]:
    """What such a profile takes that is not there on a running robot; none: it can be followed."""
    found = []
    pose = profile.inputs.pose
    if profile.frames is not None:
        found.append(
            NotLive(
                "its pose from transforms ([frames])",
                "which are not held live",
                "[inputs.pose]",
                _POSE,
            )
        )
    elif pose is not None and pose.by_fix:
        found.append(
            NotLive(
                "its pose from satellite fixes",
                "whose frame and heading are not computed live",
                "[inputs.pose]",
                f"{_POSE}, such as that of robot_localization's navsat_transform_node",
            )
        )
    if profile.goal_source == "hindsight":
        found.append(
            NotLive(
                "its goals in hindsight",
                "which is not possible live",
                "[inputs.goal], [inputs.plan]",
                "name the topics of goal and plan under [inputs.goal] and [inputs.plan], with"
                ' goal.source = "logged"',
                'goal.source = "logged"',
            )
        )
    return found


__all__ = ["NotLive", "not_live"]
