"""A traced row's moment, written to an MCAP file that Foxglove and Rerun open."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from restock.errors import ConfigError, StoreError
from restock.files import temporary_name, write_text
from restock.replay.trace.moment import Moment, find_moment
from restock.replay.trace.trace import Trace
from restock.train.view.mcap_view import Critic, critic_along, write_mcap


@dataclass(frozen=True)
class ViewOptions:
    """How much of a moment to show, and which critic."""

    before_s: float = 5.0
    after_s: float = 5.0
    recording: Path | str | None = None  # scans, plans and all other topics are in it
    critic: str | None = None  # a run


def write_view(
    trace: Trace, path: Path | str, options: ViewOptions | None = None
) -> dict[str, Any]:
    """Write the seconds around a traced row; return the file's content by topic.

    Args:
        trace: of a row that lies in a store.
        path: a new file, `.mcap`; a layout for Foxglove is put beside it.

    Raises:
        ConfigError: another ending, or there is a file already.
        StoreError: the row is of the twin: no store has what was before and after it.
    """
    options, path = options or ViewOptions(), Path(path)
    check_view(path)
    if trace.origin is None:
        raise StoreError(
            "is a row from the twin, so there is no recording of it",
            where="--view",
            remedy="`restock twin record --policy run:RUN --missions FILE` drives it again",
        )
    moment = find_moment(
        trace.origin,
        before_s=options.before_s,
        after_s=options.after_s,
        recording=options.recording,
    )
    critic = critic_along(options.critic, moment) if options.critic is not None else None
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_name(path).with_suffix(path.suffix)
    try:
        counts, layout = _write(temporary, moment, critic)
        write_text(layout_of(path), json.dumps(layout, indent=1) + "\n")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return {
        "path": str(path),
        "layout": str(layout_of(path)),
        "steps": len(moment.steps),
        "seconds": (moment.window_ns[1] - moment.window_ns[0]) / 1e9,
        "critic": None if critic is None else f"{critic.run}: {critic.weights}",
        "topics": counts,
        "notes": moment.notes,
    }


def check_view(path: Path) -> None:
    """Raise ConfigError if `path` cannot be written."""
    if path.suffix != ".mcap":
        raise ConfigError(
            f"{path.name!r} must end in .mcap",
            where="--view",
            remedy="choose another name: Foxglove and Rerun open it",
        )
    if path.exists():
        raise ConfigError(
            "exists already", where=str(path), remedy="remove it, or choose another name"
        )


def layout_of(path: Path) -> Path:
    """Return where the Foxglove layout of a file lies."""
    return path.with_suffix(".foxglove.json")


def _write(
    path: Path, moment: Moment, critic: Critic | None
) -> tuple[dict[str, int], dict[str, Any]]:
    with path.open("wb") as stream:
        written = write_mcap(stream, moment, critic)
    middle = float(moment.at["pose_x_m"]), float(moment.at["pose_y_m"])
    types = {topic: kind for topic, (kind, _) in written.items()}
    counts = {topic: count for topic, (_, count) in written.items()}
    return counts, foxglove_layout(types, middle)


_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
# How Restock's topics are drawn.
_DRAWN: dict[str, dict[str, Any]] = {
    "/restock/scan": {"pointSize": 4, "colorMode": "flat", "flatColor": "#d0312dff"},
    "/restock/seen": {"pointSize": 8, "colorMode": "flat", "flatColor": "#1f6fb2ff"},
    "/restock/plan": {"type": "line", "lineWidth": 0.04, "gradient": ["#1f9d4dff"] * 2},
    "/restock/waypoints": {"type": "line", "lineWidth": 0.04, "gradient": ["#e07b00ff"] * 2},
    "/restock/goal": {"type": "arrow", "color": "#1f9d4dff"},
    "/restock/pose": {"type": "axis", "axisScale": 0.4},
    "/restock/body": {},
}


def foxglove_layout(topics: Mapping[str, str], middle_m: tuple[float, float]) -> dict[str, Any]:
    """Make a layout to import in Foxglove.

    Args:
        topics: those of the file -> their types; what is not among them is not shown.
        middle_m: what the camera looks at on the map.
    """
    drawn = {name: {"visible": True, **how} for name, how in _DRAWN.items() if name in topics}
    maps = [name for name, kind in topics.items() if kind == "nav_msgs/msg/OccupancyGrid"]
    drawn |= {name: {"visible": True, "colorMode": "map", "drawBehind": True} for name in maps}
    markers = [n for n, k in topics.items() if k == "visualization_msgs/msg/MarkerArray"]
    drawn |= {name: {"visible": True} for name in markers}
    panels: dict[str, Any] = {
        "3D!moment": _floor(drawn, middle_m),
        "Plot!speed": _plot(topics, "/restock/speed/command_mps", "/restock/speed/wheels_mps"),
        "Plot!critic": _plot(
            topics, "/restock/critic/value", "/restock/critic/best_value", "/restock/reward"
        ),
        "Plot!td": _plot(topics, "/restock/critic/td_error"),
        "StateTransitions!labels": {
            "paths": [
                {
                    "value": f"{name}.data",
                    "label": label,
                    "timestampMethod": "receiveTime",
                }
                for name, label in (
                    ("/restock/condition", "condition"),
                    ("/restock/true_condition", "true condition"),
                    ("/restock/behaviour_policy", "who acted"),
                    ("/restock/action", "action"),
                    ("/restock/critic/greedy_action", "the critic's best"),
                )
                if name in topics
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
            "first": "3D!moment",
            "second": _column(right),
        },
    }


def _floor(drawn: dict[str, Any], middle_m: tuple[float, float]) -> dict[str, Any]:
    return {
        "scene": {"transforms": {"showLabel": False, "axisSize": 0.3}},
        "topics": drawn,
        "followTf": "map",
        "fixedFrame": "map",
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
            "label": name.removeprefix("/restock/"),
            "value": f"{name}.data",
            "timestampMethod": "receiveTime",
        }
        for name in names
        if name in topics
    ]
    return {"paths": paths, "showLegend": True, "isSynced": True}


def _column(names: list[str]) -> Any:
    """Stack panels of equal height."""
    if len(names) == 1:
        return names[0]
    return {
        "direction": "column",
        "splitPercentage": round(100 / len(names)),
        "first": names[0],
        "second": _column(names[1:]),
    }
