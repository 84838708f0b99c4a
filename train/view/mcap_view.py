"""Write a traced row's moment as an MCAP file that Foxglove and Rerun open.

It has the recording's own topics, and Restock's beside them.

Restock's are ROS 2 messages under `/restock/`, in frames of their own (`map` > `restock_base` >
`restock_laser`, `restock_sectors`), so that they are drawn whatever transforms the robot publishes.
If a run is named, its critic is shown along the steps: the value of the action taken, and its TD
error.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from mcap.writer import CompressionType, Writer

from restock.arrays import F32, F64, Ints
from restock.errors import ConfigError, RunError, StoreError
from restock.files import temporary_name, write_text
from restock.ingest.decoding.columns import Channel
from restock.replay.trace.moment import Moment, SeenScan, find_moment
from restock.replay.trace.trace import Trace
from restock.train.dqn.config import TrainConfig, parse_config
from restock.train.evaluation.policies import load_agent, make_learner
from restock.train.run import checkpoint
from restock.train.run.run import Run
from restock.train.run.run_profile import profile_of_run
from restock.train.twin.recording.bag_writer import build, serialise, stamp, typestore


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


@dataclass(frozen=True)
class Critic:
    """A critic's values over T steps, from the last checkpoint of a run, else its kept policy."""

    run: str
    weights: str  # which networks: a text for people
    gradient_steps: int
    value: F64  # (T,) Q of the action that was taken; NaN if it is not plausible
    best: F64  # (T,) the largest Q
    greedy: Ints  # (T,) the action of that
    td: F64  # (T,) Q(s, a) less the target, over one step


def critic_along(path: str | Path, moment: Moment) -> Critic:
    """Compute a run's critic along a moment's steps.

    The target is that of one step, by the target network of the last checkpoint; a run of which
    only its best policy is left bootstraps from that.

    Raises:
        RunError: no such run, none of its checkpoints is left, or it is of another task.
    """
    run = Run.open(Path(path))
    task = profile_of_run(run).task
    if task.hash != moment.task.hash:
        raise RunError(
            f"was trained on task {task.hash}, these steps are of {moment.task.hash}",
            where=str(run.path),
            remedy="give a run of the same task with --critic, or leave out the critic: --critic "
            "none",
        )
    config = parse_config(run.document["config"], where=str(run.path / "config.json"))
    rows = _packed(moment, config.loss.discount)
    if run.latest.is_file():
        return _of_checkpoint(run, config, rows, moment)
    return _of_policy(run, rows, moment)


def _packed(moment: Moment, discount: float) -> F32:
    """Pack the steps as rows of a batch, (T, 2D + 3)."""
    after = np.asarray(moment.column("next_observation"), np.float32)
    goes_on = ~np.asarray(moment.column("terminated"), np.bool_)
    last = np.stack(
        [moment.column("action"), moment.column("reward"), discount * goes_on], axis=1
    ).astype(np.float32)
    return np.concatenate([moment.observations, after, last], axis=1)


def _of_checkpoint(run: Run, config: TrainConfig, rows: F32, moment: Moment) -> Critic:
    task = moment.task
    learner = make_learner(config, task)
    state = checkpoint.load(run.latest)
    try:
        learner.load_state_dict(state["learner"])
    except (KeyError, ValueError, RunError) as error:
        raise RunError(
            f"contains no learner that this Restock can read: {error}",
            where=str(run.latest),
            remedy="choose another run with --critic, or --critic none",
        ) from error
    td, q, _ = learner.td_error(torch.from_numpy(rows).to(learner.device))
    named = f"its last checkpoint, after {learner.gradient_steps:,} updates"
    return _critic(run, named, learner.gradient_steps, q, td, moment)


@torch.no_grad()
def _of_policy(run: Run, rows: F32, moment: Moment) -> Critic:
    agent = load_agent(run)
    size = moment.task.observation_size
    q = agent.network(torch.from_numpy(rows[:, :size]))
    after = agent.network(torch.from_numpy(rows[:, size : 2 * size])).amax(dim=1)
    reward, discount = torch.from_numpy(rows[:, -2]), torch.from_numpy(rows[:, -1])
    action = torch.from_numpy(rows[:, -3]).long()
    td = q.gather(1, action[:, None])[:, 0] - (reward + discount * after)
    steps = 0 if agent.origin is None else agent.origin.gradient_steps
    named = f"the policy that it kept, from update {steps:,}, used as its own target"
    return _critic(run, named, steps, q, td, moment)


def _critic(
    run: Run, weights: str, steps: int, q: torch.Tensor, td: torch.Tensor, moment: Moment
) -> Critic:
    values = q.detach().cpu().numpy().astype(np.float64)
    taken = values[np.arange(len(values)), np.asarray(moment.column("action"), np.int64)]
    return Critic(
        run=str(run.path),
        weights=weights,
        gradient_steps=steps,
        value=np.where(np.isfinite(taken), taken, np.nan),
        best=values.max(axis=1),
        greedy=values.argmax(axis=1),
        td=np.where(np.isfinite(taken), td.detach().cpu().numpy().astype(np.float64), np.nan),
    )


_BOX, _ADD = 1, 0


# One message: log time, topic, type, content.
_Shown = tuple[int, str, str, Any]


def write_mcap(
    stream: BinaryIO, moment: Moment, critic: Critic | None
) -> dict[str, tuple[str, int]]:
    """Write the moment.

    Returns the type and the number of messages of each topic.
    """
    writer = Writer(stream, compression=CompressionType.ZSTD)
    writer.start(profile="ros2", library="restock")
    counts, types = Counter[str](), dict[str, str]()
    channels: dict[Channel, int] = {}
    schemas: dict[tuple[str, bytes], int] = {}
    for message in moment.messages:
        if message.channel not in channels:
            number = _own_channel(writer, message.channel, schemas)
            if number is None:
                moment.notes.append(
                    f"{message.channel.topic} is left out: its file does not define"
                    f" {message.channel.type}"
                )
            channels[message.channel] = -1 if number is None else number
        if channels[message.channel] < 0:
            continue
        # Values from before the moment are repeated at its start, where a viewer begins.
        log_ns = max(message.log_time_ns, moment.window_ns[0])
        number = channels[message.channel]
        writer.add_message(number, log_ns, message.payload, message.publish_time_ns)
        counts[message.channel.topic] += 1
        types[message.channel.topic] = message.channel.type
    numbers: dict[str, int] = {}
    for log_ns, topic, kind, content in _shown(moment, critic):
        if topic not in numbers:
            definition = typestore().generate_msgdef(kind, ros_version=2)[0].encode()
            schema = _schema(writer, kind, "ros2msg", definition, schemas)
            numbers[topic] = writer.register_channel(topic, "cdr", schema)
        writer.add_message(numbers[topic], log_ns, serialise(content), log_ns)
        counts[topic] += 1
        types[topic] = kind
    writer.finish()  # type: ignore[no-untyped-call]
    return {topic: (types[topic], count) for topic, count in sorted(counts.items())}


def _own_channel(
    writer: Writer, channel: Channel, schemas: dict[tuple[str, bytes], int]
) -> int | None:
    """Register a channel of the recording in this file; None if its message type is unknown."""
    definition, form, kind = channel.definition, channel.definition_format, channel.type
    if not definition:  # an older bag: what the distribution defines
        if channel.encoding != "cdr" or kind not in typestore().types:
            return None
        definition = typestore().generate_msgdef(kind, ros_version=2)[0].encode()
        form = "ros2msg"
    if form == "ros1msg":
        kind = kind.replace("/msg/", "/")
    schema = _schema(writer, kind, form, definition, schemas)
    return writer.register_channel(channel.topic, channel.encoding, schema)


def _schema(
    writer: Writer, kind: str, form: str, definition: bytes, known: dict[tuple[str, bytes], int]
) -> int:
    if (kind, definition) not in known:
        known[kind, definition] = writer.register_schema(kind, form, definition)
    return known[kind, definition]


def _shown(moment: Moment, critic: Critic | None) -> Iterator[_Shown]:
    """Yield Restock's messages of every step, then of every tick of the recording."""
    sectors = moment.sector_scans()
    for index, (step, log_ns) in enumerate(zip(moment.steps, moment.log_ns, strict=True)):
        yield (
            log_ns,
            "/restock/tf",
            "tf2_msgs/msg/TFMessage",
            _transforms(moment, step, log_ns),
        )
        pose = _pose(step["pose_x_m"], step["pose_y_m"], step["pose_yaw_rad"])
        yield (
            *(log_ns, "/restock/pose", "geometry_msgs/msg/PoseStamped"),
            build(
                "geometry_msgs/msg/PoseStamped",
                header={"frame_id": "map", "stamp": stamp(log_ns)},
                pose=pose,
            ),
        )
        body = _body(moment, log_ns)
        yield log_ns, "/restock/body", "visualization_msgs/msg/Marker", body
        if sectors:
            scan = _scan("restock_sectors", sectors[index], log_ns)
            yield log_ns, "/restock/seen", "sensor_msgs/msg/LaserScan", scan
        yield (
            *(log_ns, "/restock/waypoints", "nav_msgs/msg/Path"),
            _path(
                "restock_base",
                log_ns,
                [
                    (0.0, 0.0),
                    (step["waypoint_near_x_m"], step["waypoint_near_y_m"]),
                    (step["waypoint_far_x_m"], step["waypoint_far_y_m"]),
                ],
            ),
        )
        command = build(
            "geometry_msgs/msg/Twist",
            linear={"x": float(step["command_speed_mps"])},
            angular={"z": float(step["command_yaw_rate_radps"])},
        )
        yield log_ns, "/restock/command", "geometry_msgs/msg/Twist", command
        for name, text in texts_of(moment, critic, index).items():
            content = build("std_msgs/msg/String", data=text)
            yield log_ns, f"/restock/{name}", "std_msgs/msg/String", content
        for name, number in numbers_of(moment, critic, index).items():
            if math.isfinite(number):
                content = build("std_msgs/msg/Float64", data=number)
                yield log_ns, f"/restock/{name}", "std_msgs/msg/Float64", content
        if step["transition_id"] == moment.at["transition_id"]:
            content = build("std_msgs/msg/String", data=about(moment, critic))
            yield log_ns, "/restock/moment", "std_msgs/msg/String", content
    yield from _recorded(moment)


def _recorded(moment: Moment) -> Iterator[_Shown]:
    """Yield the scan, plan and goal that the profile read, whenever they are new."""
    if moment.seen is None:
        return
    seen, before, ordered, drawn = moment.seen, None, None, -1
    for stamp_ns, scan, plan, goal in zip(
        seen.stamp_ns.tolist(), seen.scans, seen.plans_m, seen.goals_m, strict=True
    ):
        log_ns = stamp_ns + moment.log_offset_ns
        if scan is not None and scan.stamp_ns != drawn:
            drawn = scan.stamp_ns
            kind = "sensor_msgs/msg/LaserScan"
            yield log_ns, "/restock/scan", kind, _scan("restock_laser", scan, log_ns)
        if plan is not None and plan is not before:
            before = plan
            points = [(float(x), float(y)) for x, y in plan]
            yield (
                log_ns,
                "/restock/plan",
                "nav_msgs/msg/Path",
                _path("map", log_ns, points),
            )
        if goal is not None and goal != ordered:
            ordered = goal
            header = {"frame_id": "map", "stamp": stamp(log_ns)}
            kind = "geometry_msgs/msg/PoseStamped"
            yield (
                log_ns,
                "/restock/goal",
                kind,
                build(kind, header=header, pose=_pose(*goal, 0.0)),
            )


def _transforms(moment: Moment, step: dict[str, Any], log_ns: int) -> Any:
    body = moment.task.body
    frames = (
        ("map", "restock_base", step["pose_x_m"], step["pose_y_m"], step["pose_yaw_rad"]),
        ("restock_base", "restock_laser", body.lidar_x_m, 0.0, body.lidar_yaw_rad),
        (
            "restock_base",
            "restock_sectors",
            body.lidar_x_m,
            0.0,
            0.0,
        ),  # bearings against the robot's forward axis
    )
    return build(
        "tf2_msgs/msg/TFMessage",
        transforms=[
            build(
                "geometry_msgs/msg/TransformStamped",
                header={"frame_id": parent, "stamp": stamp(log_ns)},
                child_frame_id=child,
                transform={
                    "translation": {"x": float(x), "y": float(y)},
                    "rotation": _turn(yaw),
                },
            )
            for parent, child, x, y, yaw in frames
        ],
    )


def _scan(frame: str, scan: SeenScan, log_ns: int) -> Any:
    ranges = scan.ranges_m.astype(np.float32)
    farthest = float(np.max(ranges[np.isfinite(ranges)], initial=1.0))
    return build(
        "sensor_msgs/msg/LaserScan",
        header={"frame_id": frame, "stamp": stamp(log_ns)},
        angle_min=scan.angle_min_rad,
        angle_max=scan.angle_min_rad + scan.angle_increment_rad * (len(ranges) - 1),
        angle_increment=scan.angle_increment_rad,
        range_max=farthest,
        ranges=ranges,
    )


def _path(frame: str, log_ns: int, points: list[tuple[float, float]]) -> Any:
    header = {"frame_id": frame, "stamp": stamp(log_ns)}
    poses = [
        build("geometry_msgs/msg/PoseStamped", header=header, pose=_pose(x, y, 0.0))
        for x, y in points
    ]
    return build("nav_msgs/msg/Path", header=header, poses=poses)


def _body(moment: Moment, log_ns: int) -> Any:
    body = moment.task.body
    near = {"position": {"z": 0.1}}
    return build(
        "visualization_msgs/msg/Marker",
        header={"frame_id": "restock_base", "stamp": stamp(log_ns)},
        ns="restock",
        type=_BOX,
        action=_ADD,
        pose=near,
        scale={"x": body.length_m, "y": body.width_m, "z": 0.2},
        color={"r": 0.94, "g": 0.51, "b": 0.12, "a": 0.6},
        frame_locked=True,
    )


def _pose(x_m: float, y_m: float, yaw_rad: float) -> dict[str, Any]:
    return {"position": {"x": float(x_m), "y": float(y_m)}, "orientation": _turn(yaw_rad)}


def _turn(yaw_rad: float) -> dict[str, float]:
    return {"z": math.sin(yaw_rad / 2), "w": math.cos(yaw_rad / 2)}


def texts_of(moment: Moment, critic: Critic | None, index: int) -> dict[str, str]:
    """Return a step's texts: labels, driver, action."""
    step, names = moment.steps[index], moment.task.action_names
    texts = {
        "condition": step["condition"],
        "conditions": _conditions(step["conditions"]),
        "true_condition": step["true_condition"],
        "behaviour_policy": step["behaviour_policy"],
        "action": names[step["action"]],
    }
    if critic is not None:
        texts["critic/greedy_action"] = names[int(critic.greedy[index])]
    return {name: text for name, text in texts.items() if text}


def _conditions(names: list[str] | None) -> str:
    """Join the labels of a step; empty if nobody labelled it."""
    return "" if names is None else ", ".join(names) or "nominal"


def numbers_of(moment: Moment, critic: Critic | None, index: int) -> dict[str, float]:
    """Return a step's numbers to plot, as far as the store has them."""
    step = moment.steps[index]
    names = {
        "reward": "reward",
        "speed/command_mps": "command_speed_mps",
        "speed/wheels_mps": "wheel_speed_mps",
        "speed/localised_mps": "localised_speed_mps",
        "turn/command_radps": "command_yaw_rate_radps",
        "turn/gyro_radps": "gyro_yaw_rate_radps",
        "clearance/least_m": "clearance_m",
        "clearance/ahead_m": "clearance_ahead_m",
    }
    numbers = {
        name: float(step[column]) for name, column in names.items() if step[column] is not None
    }
    if critic is not None:
        numbers["critic/value"] = float(critic.value[index])
        numbers["critic/best_value"] = float(critic.best[index])
        numbers["critic/td_error"] = float(critic.td[index])
    return numbers


def about(moment: Moment, critic: Critic | None) -> str:
    """Return as JSON which transition the moment is about."""
    keys = ("transition_id", "episode_id", "step_index", "stamp_ns", "condition", "zone")
    reported = {key: moment.at[key] for key in (*keys, "behaviour_policy", "reward", "source_file")}
    if critic is not None:
        reported["critic"] = f"{critic.run}: {critic.weights}"
    return json.dumps(reported)
