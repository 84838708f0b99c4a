"""A moment as a Rerun recording (`.rrd`), its layout within."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from restock.arrays import F64
from restock.imports import import_extra
from restock.replay.trace.moment import Moment
from restock.replay.trace.seen_at_ticks import SeenScan
from restock.train.view.critic import Critic
from restock.train.view.reported import about, about_evaluated, numbers_of, texts_of

if TYPE_CHECKING:  # it needs the twin and its physics
    from restock.train.view.evaluated import Beside, Evaluated

TIMELINE = "log_time"
_COLOURS = {"scan": (208, 49, 45), "seen": (31, 111, 178), "plan": (31, 157, 77)}


def require_rerun() -> Any:
    """The module.

    Raises:
        ConfigError: it is not installed.
    """
    return import_extra(
        "rerun",
        "view",
        "an .rrd file is written by Rerun",
        where="--view",
        instead="give a name that ends in .mcap",
    )


def write_rerun(
    path: Path, moment: Moment, critic: Critic | None, beside: Beside | None = None
) -> dict[str, int]:
    """Write the moment to `path`, and an episode of an evaluation beside it; returns how often each
    entity was logged."""
    rr = require_rerun()
    stream = rr.RecordingStream("restock", recording_id=str(moment.at["transition_id"]))
    stream.save(str(path), default_blueprint=_blueprint(critic, beside))
    log = _Log(rr, stream)
    _steps(log, rr, moment, critic, about(moment, critic))
    if beside is not None:
        log.below = "evaluation/"
        evaluated = beside.evaluated
        _floor(log, rr, evaluated)
        reported = about_evaluated(evaluated, beside.critic)
        _steps(log, rr, evaluated.moment, beside.critic, reported)
    stream.flush()
    stream.disconnect()
    return dict(sorted(log.counts.items()))


def _steps(log: _Log, rr: Any, moment: Moment, critic: Critic | None, reported: str) -> None:
    log.put("moment", rr.TextDocument(reported), static=True)
    body = moment.task.body
    half = (body.length_m / 2, body.width_m / 2, 0.1)
    box = rr.Boxes3D(half_sizes=[half], centers=[(0, 0, 0.1)], colors=[(240, 130, 30)])
    log.put("map/robot/body", box, static=True)
    way = [(float(s["pose_x_m"]), float(s["pose_y_m"]), 0.0) for s in moment.steps]
    log.put("map/driven", rr.LineStrips3D([way], colors=[(150, 150, 150)]), static=True)
    sectors, said = moment.sector_scans(), dict[str, str]()
    for index, (step, log_ns) in enumerate(zip(moment.steps, moment.log_ns, strict=True)):
        log.at(log_ns)
        log.put("map/robot", _placed(rr, step))
        if sectors:
            ends = _ends(sectors[index], body.lidar_x_m, 0.0)
            log.put("map/robot/seen", _points(rr, "seen", ends))
        ahead = [
            (float(step[f"waypoint_{name}_x_m"]), float(step[f"waypoint_{name}_y_m"]), 0.0)
            for name in ("near", "far")
        ]
        line = rr.LineStrips3D([[(0.0, 0.0, 0.0), *ahead]], colors=[(224, 123, 0)])
        log.put("map/robot/waypoints", line)
        for name, number in numbers_of(moment, critic, index).items():
            if math.isfinite(number):
                log.put(name, rr.Scalars([number]))
        for name, text in texts_of(moment, critic, index).items():
            if said.get(name) != text:  # a log of what changed
                said[name] = text
                log.put(f"labels/{name}", rr.TextLog(f"{name}: {text}"))
    _recorded(log, rr, moment)


def _floor(log: _Log, rr: Any, evaluated: Evaluated) -> None:
    """The racks, and people, forklifts and pallets at each step."""
    racks = np.array(evaluated.racks_m).reshape(-1, 2, 2)
    middles = np.column_stack([racks.mean(axis=1), np.full(len(racks), 0.5)])
    halves = np.column_stack([np.ptp(racks, axis=1) / 2, np.full(len(racks), 0.5)])
    log.put("map/racks", rr.Boxes3D(centers=middles, half_sizes=halves), static=True)
    for log_ns, others in zip(evaluated.moment.log_ns, evaluated.others, strict=True):
        log.at(log_ns)
        for name, half, colour in (
            ("people", (0.22, 0.22, 0.85), (0, 114, 178)),
            ("forklifts", (0.8, 0.4, 0.9), (230, 159, 0)),
            ("pallets", (0.6, 0.4, 0.4), (132, 100, 58)),
        ):
            turns = [rr.RotationAxisAngle(axis=(0, 0, 1), radians=p[2]) for p in others[name]]
            boxes = rr.Boxes3D(
                centers=[(x, y, half[2]) for x, y, _ in others[name]],
                half_sizes=[half] * len(turns),
                rotation_axis_angles=turns,
                colors=[colour],
            )
            log.put(f"map/{name}", boxes)


class _Log:
    """Puts archetypes at the time that it is, and counts them."""

    def __init__(self, rr: Any, stream: Any) -> None:
        self.rr, self.stream, self.counts = rr, stream, dict[str, int]()
        self.below = ""  # the entity that all are put below

    def at(self, log_ns: int) -> None:
        self.stream.set_time(TIMELINE, timestamp=np.datetime64(log_ns, "ns"))

    def put(self, entity: str, what: Any, *, static: bool = False) -> None:
        entity = self.below + entity
        self.stream.log(entity, what, static=static)
        self.counts[entity] = self.counts.get(entity, 0) + 1


def _recorded(log: _Log, rr: Any, moment: Moment) -> None:
    """The scans, plans and goals that the profile read, where they are new."""
    if moment.seen is None:
        return
    seen, body, before, ordered, drawn = moment.seen, moment.task.body, None, None, -1
    for stamp_ns, scan, plan, goal in zip(
        seen.stamp_ns.tolist(), seen.scans, seen.plans_m, seen.goals_m, strict=True
    ):
        log.at(stamp_ns + moment.log_offset_ns)
        if scan is not None and scan.stamp_ns != drawn:
            drawn = scan.stamp_ns
            ends = _ends(scan, body.lidar_x_m, body.lidar_yaw_rad)
            log.put("map/robot/scan", _points(rr, "scan", ends))
        if plan is not None and plan is not before:
            before = plan
            line = np.column_stack([plan, np.zeros(len(plan))])
            log.put("map/plan", rr.LineStrips3D([line], colors=[_COLOURS["plan"]]))
        if goal is not None and goal != ordered:
            ordered = goal
            log.put("map/goal", rr.Points3D([(*goal, 0.0)], radii=[0.12], labels=["goal"]))


def _placed(rr: Any, step: dict[str, Any]) -> Any:
    yaw = float(step["pose_yaw_rad"])
    return rr.Transform3D(
        translation=(float(step["pose_x_m"]), float(step["pose_y_m"]), 0.0),
        rotation=rr.RotationAxisAngle(axis=(0, 0, 1), radians=yaw),
    )


def _ends(scan: SeenScan, lidar_x_m: float, lidar_yaw_rad: float) -> F64:
    """Where the beams ended, (B', 3) in the robot's frame; those without a return are left out."""
    back = np.isfinite(scan.ranges_m)
    bearing = scan.angle_min_rad + scan.angle_increment_rad * np.flatnonzero(back) + lidar_yaw_rad
    ranges = scan.ranges_m[back]
    ends = [
        lidar_x_m + ranges * np.cos(bearing),
        ranges * np.sin(bearing),
        np.full(len(ranges), 0.2),
    ]
    return np.column_stack(ends)


def _points(rr: Any, name: str, ends: F64) -> Any:
    radius = 0.03 if name == "scan" else 0.06
    return rr.Points3D(ends, colors=[_COLOURS[name]], radii=[radius])


def _blueprint(critic: Critic | None, beside: Beside | None) -> Any:
    import rerun.blueprint as rrb

    def plot(name: str, *entities: str) -> Any:
        below = [f"/evaluation{entity}" for entity in entities] if beside is not None else []
        return rrb.TimeSeriesView(origin="/", contents=[*entities, *below], name=name)

    plots = [plot("speed, m/s", "/speed/**"), plot("reward", "/reward")]
    if critic is not None:
        plots += [
            plot("the critic's value", "/critic/value", "/critic/best_value"),
            plot("TD error", "/critic/td_error"),
        ]
    labels = ["/labels/**", "/evaluation/labels/**"]
    right = rrb.Vertical(*plots, rrb.TextLogView(origin="/", contents=labels, name="labels"))
    floors, shares = [rrb.Spatial3DView(origin="/map", name="floor")], [5, 1]
    if beside is not None:
        floors.append(rrb.Spatial3DView(origin="/evaluation/map", name="evaluation"))
        shares.insert(0, 5)
    reported = rrb.TextDocumentView(origin="/moment", name="moment")
    left = rrb.Vertical(*floors, reported, row_shares=shares)
    return rrb.Blueprint(rrb.Horizontal(left, right, column_shares=[3, 2]), collapse_panels=True)
