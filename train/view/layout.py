"""The Foxglove layout of a moment: the floor, the speeds, the critic and the labels."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_EVALUATION = "/restock/evaluation/"  # an episode of an evaluation, with topics of the same names
# What is drawn of Restock's topics, and how.
_DRAWN: dict[str, dict[str, Any]] = {
    "/restock/scan": {"pointSize": 4, "colorMode": "flat", "flatColor": "#d0312dff"},
    "/restock/seen": {"pointSize": 8, "colorMode": "flat", "flatColor": "#1f6fb2ff"},
    "/restock/plan": {"type": "line", "lineWidth": 0.04, "gradient": ["#1f9d4dff"] * 2},
    "/restock/waypoints": {"type": "line", "lineWidth": 0.04, "gradient": ["#e07b00ff"] * 2},
    "/restock/goal": {"type": "arrow", "color": "#1f9d4dff"},
    "/restock/pose": {"type": "axis", "axisScale": 0.4},
    "/restock/body": {},
}


def foxglove_layout(
    topics: Mapping[str, str], floors: Mapping[str, tuple[str, tuple[float, float]]]
) -> dict[str, Any]:
    """A layout to import in Foxglove.

    Args:
        topics: those of the file -> their types; what is not among them is not shown.
        floors: one view each, by name: the frame of its map, and what the camera looks at there,
            in metres.
    """
    drawn = {
        place: {"visible": True, **how}
        for name, how in _DRAWN.items()
        for place in _both(name)
        if place in topics
    }
    maps = [name for name, kind in topics.items() if kind == "nav_msgs/msg/OccupancyGrid"]
    drawn |= {name: {"visible": True, "colorMode": "map", "drawBehind": True} for name in maps}
    markers = [n for n, k in topics.items() if k == "visualization_msgs/msg/MarkerArray"]
    drawn |= {name: {"visible": True} for name in markers}
    panels: dict[str, Any] = {
        **{f"3D!{name}": _floor(drawn, *floor) for name, floor in floors.items()},
        "Plot!speed": _plot(topics, "/restock/speed/command_mps", "/restock/speed/wheels_mps"),
        "Plot!critic": _plot(
            topics, "/restock/critic/value", "/restock/critic/best_value", "/restock/reward"
        ),
        "Plot!td": _plot(topics, "/restock/critic/td_error"),
        "StateTransitions!labels": {
            "paths": [
                {
                    "value": f"{place}.data",
                    "label": f"evaluation: {label}" if place != name else label,
                    "timestampMethod": "receiveTime",
                }
                for name, label in (
                    ("/restock/condition", "condition"),
                    ("/restock/true_condition", "true condition"),
                    ("/restock/behaviour_policy", "who acted"),
                    ("/restock/action", "action"),
                    ("/restock/critic/greedy_action", "the critic's best"),
                )
                for place in _both(name)
                if place in topics
            ],
            "isSynced": True,
        },
        "RawMessages!moment": {"topicPath": "/restock/moment.data"},
    }
    images = [name for name, kind in topics.items() if kind in _IMAGES][:1]
    if images:
        panels["Image!camera"] = {"imageMode": {"imageTopic": images[0]}}
    right = ["Plot!speed", "Plot!critic", "Plot!td", "StateTransitions!labels"]
    if "/restock/critic/value" not in topics:
        panels.pop("Plot!td")
        right.remove("Plot!td")
    right += ["Image!camera"] * bool(images) + ["RawMessages!moment"]
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "splitPercentage": 55,
            "first": _column([f"3D!{name}" for name in floors]),
            "second": _column(right),
        },
    }


def _both(topic: str) -> tuple[str, str]:
    """Of the logged episode, and of the evaluation's."""
    return topic, topic.replace("/restock/", _EVALUATION)


def _floor(drawn: dict[str, Any], frame: str, middle_m: tuple[float, float]) -> dict[str, Any]:
    return {
        "scene": {"transforms": {"showLabel": False, "axisSize": 0.3}},
        "topics": drawn,
        "followTf": frame,
        "fixedFrame": frame,
        "followMode": "follow-none",
        "cameraState": {
            **{"distance": 9, "perspective": True, "phi": 30, "thetaOffset": 0},
            **{"targetOffset": [*middle_m, 0], "fovy": 45, "near": 0.1, "far": 500},
        },
    }


def _plot(topics: Collection[str], *names: str) -> dict[str, Any]:
    paths = [
        {
            "enabled": True,
            "label": place.removeprefix("/restock/"),
            "value": f"{place}.data",
            "timestampMethod": "receiveTime",
        }
        for name in names
        for place in _both(name)
        if place in topics
    ]
    return {"paths": paths, "showLegend": True, "isSynced": True}


def _column(names: list[str]) -> Any:
    """Panels one below the other, of equal height."""
    if len(names) == 1:
        return names[0]
    return {
        "direction": "column",
        "splitPercentage": round(100 / len(names)),
        "first": names[0],
        "second": _column(names[1:]),
    }
