"""Data that a review page shows of an event: path, scans, plans, speeds, and the rule's values."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import duckdb
import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from restock.arrays import F32, F64
from restock.errors import ConfigError, RestockError, StoreError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.profile.profile import parse_profile
from restock.ingest.steps.aligned_inputs import AlignedInputs, align_inputs
from restock.ingest.steps.needs import read_topics
from restock.ingest.task.conditions import Condition, let_values, shipped, stored
from restock.ingest.task.task import Body, Task
from restock.replay.store.frames import camera_frames
from restock.replay.store.store import Store
from restock.replay.trace.moment import SeenScan, sector_ranges, seen_of

AROUND_S = 8.0  # seconds shown before and after an event
MAX_STEPS = 400  # largest number of steps shown
MAX_ROWS = 4_000  # largest number of the episode's rows that are read around the event
MAX_RECORDING_BYTES = 256 << 20  # scans and plans are not read from larger recordings
MAX_FRAMES = 12  # largest number of frames per camera
FRAME_PX = 400  # largest width and height of a frame
WALL_M, WALL_ROWS, MAX_WALLS, REACH_M = 0.1, 5_000, 6_000, 8.0
SPEEDS = {
    "wheels": "wheel_speed_mps",
    "localised": "localised_speed_mps",
    "commanded": "command_speed_mps",
}
CLEARANCES = {"nearest": "clearance_m", "ahead": "clearance_ahead_m"}
_EPISODE = """
SELECT * FROM transitions
WHERE episode_id = $episode AND step_index BETWEEN $low AND $high
ORDER BY step_index
"""
_WALLS = """
SELECT pose_x_m, pose_y_m, pose_yaw_rad, observation
FROM transitions
WHERE recording_id = $recording
    AND transition_id % greatest(
        (SELECT count(*) FROM transitions WHERE recording_id = $recording) // $rows, 1
    ) = 0
"""


class Moments:
    """Collects the data to show of a store's events. Not thread-safe."""

    def __init__(self, store: Store) -> None:
        self.store = store
        rows = store.connection.sql("FROM recordings").to_arrow_table().to_pylist()
        self._manifests = {row["recording_id"]: row for row in rows}
        # Cache results by recording, because successive events are often of the same recording.
        self._ends = cache(self._read_ends)
        self._walls = cache(self._read_walls)
        self._aligned: tuple[str, AlignedInputs | str] = ("", "")

    def show(self, event: Mapping[str, Any]) -> dict[str, Any]:
        """Return the data to show of an event as JSON values.

        Lengths are in metres, times in seconds after the recording's first step. Scans are points
        in the robot's frame, in centimetres: x, y, x, y, … Unknown values are null or absent;
        `notes` give reasons.
        """
        manifest = self._manifests[event["recording"]]
        task = msgspec.json.decode(manifest["task_json"], type=Task, strict=False)
        low = max(event["first_step"] - MAX_ROWS // 2, 0)
        rows = self.store.connection.sql(
            _EPISODE,
            params={"episode": event["episode_id"], "low": low, "high": low + MAX_ROWS},
        ).to_arrow_table()
        if not len(rows):
            raise StoreError(
                f"episode {event['episode_id']} is no longer in the store",
                where=str(self.store.path),
                remedy="end this review, and start it again",
            )
        around = round(AROUND_S / task.control_period_s)
        step = rows["step_index"].to_numpy()
        first = int(np.searchsorted(step, event["first_step"] - around))
        last = int(np.searchsorted(step, event["last_step"] + around, side="right"))
        part = slice(first, min(last, first + MAX_STEPS))
        window = rows.slice(part.start, part.stop - part.start)
        notes: list[str] = []
        if last > part.stop:
            notes.append(f"the event is long: its first {MAX_STEPS} steps are shown")
        condition = self._condition(manifest, event["condition"])
        names = [one.name for one in stored(manifest)]
        return {
            "steps": window["step_index"].to_pylist(),
            "t": self._times(event, window),
            **self._poses(rows, window, event["recording"], task),
            **self._seen(manifest, task, window, notes),
            "body": [task.body.length_m, task.body.width_m],
            "speeds": _columns(window, SPEEDS),
            "clearances": _columns(window, CLEARANCES) if task.lidar else {},
            "labels": _held(window, names),
            "probabilities": _probabilities(window, names),
            "rule": self._rule(manifest, condition, rows, part),
            "notes": notes,
        }

    def frames(self, event: Mapping[str, Any]) -> dict[str, Any]:
        """Return small pictures of the recording's cameras, each with its step, as data URIs."""
        cameras = self._manifests[event["recording"]]["cameras"] or []
        if not cameras:
            return {"cameras": {}, "notes": []}
        found: dict[str, list[tuple[int, str]]] = {one["camera"]: [] for one in cameras}
        ids = self.store.connection.sql(
            "SELECT transition_id, step_index FROM transitions WHERE episode_id = $episode"
            " AND step_index BETWEEN $first AND $last ORDER BY step_index",
            params={
                "episode": event["episode_id"],
                "first": event["first_step"] - 10,
                "last": event["last_step"] + 10,
            },
        ).fetchall()
        steps = dict(ids[:: max(-(-len(ids) // MAX_FRAMES), 1)])  # at most MAX_FRAMES
        notes = []
        try:
            for frame in camera_frames(self.store, list(steps)):
                uri = _jpeg(frame.image())
                found[frame.camera].append((steps[frame.transition_id], uri))
        except (StoreError, duckdb.Error) as error:
            notes.append(f"frames of its cameras cannot be shown: {error}")
        notes += [f"no frame of {name} is in force there" for name, own in found.items() if not own]
        return {"cameras": {name: own for name, own in found.items() if own}, "notes": notes}

    def _times(self, event: Mapping[str, Any], window: pa.Table) -> list[float]:
        """Return the times of steps (s) after the recording's first step, as in `start_s`."""
        stamps = window["logged_ns"].to_numpy()
        step = window["step_index"].to_numpy()
        own = stamps[np.searchsorted(step, event["first_step"])]
        return [round(float(s), 3) for s in (stamps - own) * 1e-9 + event["start_s"]]

    def _poses(
        self, rows: pa.Table, window: pa.Table, recording: str, task: Task
    ) -> dict[str, Any]:
        """Return the poses of the shown steps, the path around these steps, and nearby walls."""
        poses = [numbers(window[name], 3) for name in ("pose_x_m", "pose_y_m", "pose_yaw_rad")]
        way = np.stack([floats(rows[name]) for name in ("pose_x_m", "pose_y_m")], axis=1)
        way = way[:: max(len(way) // 1_000, 1)]
        walls: list[float] = []
        if task.lidar:
            cells = self._walls(recording, task)
            x, y = (floats(window[name]) for name in ("pose_x_m", "pose_y_m"))
            near = (cells >= (np.nanmin(x) - REACH_M, np.nanmin(y) - REACH_M)) & (
                cells <= (np.nanmax(x) + REACH_M, np.nanmax(y) + REACH_M)
            )
            walls = cells[near.all(axis=1)][:MAX_WALLS].round(2).ravel().tolist()
        return {
            "x": poses[0],
            "y": poses[1],
            "yaw": poses[2],
            "way": [one for x, y in way.tolist() for one in (_finite(x, 2), _finite(y, 2))],
            "walls": walls,
        }

    def _read_walls(self, recording: str, task: Task) -> F64:
        """Return the centres (K, 2) of the map cells that the recording's lidar beams hit.

        Cells hit most often come first; cells hit once are left out.
        """
        rows = self.store.connection.sql(
            _WALLS, params={"recording": recording, "rows": WALL_ROWS}
        ).to_arrow_table()
        x, y, yaw = (floats(rows[f"pose_{name}"]) for name in ("x_m", "y_m", "yaw_rad"))
        flat = rows["observation"].combine_chunks().flatten().to_numpy(zero_copy_only=False)
        observations: F32 = flat.reshape(len(rows), -1)
        bearing, ranges = sector_ranges(task, observations)
        angle = yaw[:, None] + bearing
        at_x = x + task.body.lidar_x_m * np.cos(yaw)
        at_y = y + task.body.lidar_x_m * np.sin(yaw)
        hits = np.stack(
            [
                at_x[:, None] + ranges * np.cos(angle),
                at_y[:, None] + ranges * np.sin(angle),
            ],
            axis=-1,
        )
        hits = hits[np.isfinite(hits).all(axis=-1)]
        cells, count = np.unique(np.floor(hits / WALL_M), axis=0, return_counts=True)
        order = np.argsort(-count, kind="stable")
        found: F64 = (cells[order][count[order] > 1] + 0.5) * WALL_M
        return found

    def _seen(
        self, manifest: Mapping[str, Any], task: Task, window: pa.Table, notes: list[str]
    ) -> dict[str, Any]:
        """Return the scan, plan and goal at each step, read from the recording.

        If the recording cannot be read, scans are taken from the observations.
        """
        stamps = window["stamp_ns"].to_numpy()
        aligned = self._align(manifest)
        near = [floats(window[f"waypoint_{name}"]) for name in ("near_x_m", "near_y_m")]
        far = [floats(window[f"waypoint_{name}"]) for name in ("far_x_m", "far_y_m")]
        ahead = np.stack([*near, *far], axis=1) if task.goal == "route" else None
        shown: dict[str, Any] = {
            "scan": [],
            "plan": [],
            "plans": [],
            "goal": [],
            "ahead": [] if ahead is None else [[_finite(v, 2) for v in one] for one in ahead],
        }
        if isinstance(aligned, str):
            if task.lidar:
                notes.append(f"scans are what the policy saw, a range a sector: {aligned}")
                flat = window["observation"].combine_chunks().flatten()
                observations = flat.to_numpy(zero_copy_only=False).reshape(len(window), -1)
                bearing, ranges = sector_ranges(task, observations)
                width = 2 * np.pi / task.sectors
                level = Body(task.body.length_m, task.body.width_m, task.body.lidar_x_m)
                shown["scan"] = [
                    points(SeenScan(0, row, float(bearing[0]), width), level) for row in ranges
                ]
            return shown
        seen = seen_of(aligned, int(stamps[0]), int(stamps[-1]))
        at = {stamp: number for number, stamp in enumerate(seen.stamp_ns.tolist())}
        plans: dict[int, int] = {}
        for stamp in stamps.tolist():
            number = at.get(stamp)
            scan, plan, goal = (
                (None, None, None)
                if number is None
                else (seen.scans[number], seen.plans_m[number], seen.goals_m[number])
            )
            shown["scan"].append([] if scan is None else points(scan, task.body))
            shown["goal"].append(None if goal is None else [_finite(v, 2) for v in goal])
            if plan is not None and id(plan) not in plans:
                plans[id(plan)] = len(plans)
                thin = plan[:: max(len(plan) // 200, 1)]
                shown["plans"].append([_finite(v, 2) for v in thin.ravel().tolist()])
            shown["plan"].append(None if plan is None else plans[id(plan)])
        return shown

    def _align(self, manifest: Mapping[str, Any]) -> AlignedInputs | str:
        """Return the aligned inputs of a recording, or the reason why they cannot be read."""
        recording = manifest["recording_id"]
        if self._aligned[0] != recording:
            self._aligned = (recording, _read_inputs(manifest))
        return self._aligned[1]

    @staticmethod
    def _condition(manifest: Mapping[str, Any], name: str) -> Condition:
        found = {one.name: one for one in stored(manifest)}[name]
        doc = ""
        with suppress(RestockError):
            own = parse_profile(manifest["profile_toml"], where="").definitions
            doc = {one.name: one.doc for one in own}.get(name, "")
        doc = doc or (shipped()[name].doc if name in shipped() else "")
        return msgspec.structs.replace(found, doc=doc)

    def _rule(
        self, manifest: Mapping[str, Any], condition: Condition, rows: pa.Table, part: slice
    ) -> dict[str, Any]:
        """Return a condition's definition, and the values of the signals and terms it uses."""
        steps = self._steps(manifest, rows)
        values = {
            name: rows[name]
            for name in rows.column_names
            if name in condition.words and _is_number(rows[name].type) and name[-3:] != "_ns"
        }
        with suppress(ConfigError):  # raised if a term is not a number
            terms = let_values(steps, condition)
            values |= {name: pa.chunked_array([pa.array(own)]) for name, own in terms.items()}
        return {
            "name": condition.name,
            "doc": condition.doc,
            "timing": condition.timing,
            "let": condition.let,
            "sql": condition.sql,
            "probability": condition.probability,
            "constants": {name: round(v, 4) for name, v in condition.constants.items()},
            "values": {
                name: numbers(column.slice(part.start, part.stop - part.start), 3)
                for name, column in values.items()
            },
        }

    def _steps(self, manifest: Mapping[str, Any], rows: pa.Table) -> pa.Table:
        """Return an episode's steps and its final step: conditions are evaluated from all."""
        ends = self._ends(manifest["recording_id"])
        if ends is None:
            return rows
        stored = rows.select(ends.column_names)
        own = ends.filter(pc.equal(ends["episode_index"], rows["episode_index"][0]))
        return pa.concat_tables([stored, own.cast(stored.schema)])

    def _read_ends(self, recording: str) -> pa.Table | None:
        return dict(self.store.episode_ends([recording])).get(recording)


def _read_inputs(manifest: Mapping[str, Any]) -> AlignedInputs | str:
    """Read and align the inputs of a recording; return the reason if that fails."""
    path = Path(manifest["source_file"])
    if not path.exists():
        return f"{path.name} is no longer at the path it was ingested from"
    files = path.rglob("*") if path.is_dir() else [path]
    if sum(file.stat().st_size for file in files) > MAX_RECORDING_BYTES:
        return f"{path.name} is larger than {MAX_RECORDING_BYTES >> 20} MB"
    try:
        profile = parse_profile(manifest["profile_toml"], where=manifest["profile"])
        with open_recording(path, salvage=True) as opened:
            if opened.recording_id != manifest["recording_id"]:
                return f"{path.name} is now another recording"
            return align_inputs(profile, read_topics(opened, profile, reduced=False))
    except RestockError as error:
        return f"{path.name} cannot be read: {error.what}"


def points(scan: SeenScan, body: Body) -> list[int]:
    """Return end points of a scan's beams in the robot's frame, in centimetres, as x, y, x, y, ….

    Larger scans are thinned to fewer than 720 points.
    """
    back = np.flatnonzero(np.isfinite(scan.ranges_m) & (scan.ranges_m > 0))
    back = back[:: max(len(back) // 360, 1)]
    bearing = scan.angle_min_rad + scan.angle_increment_rad * back + body.lidar_yaw_rad
    x = body.lidar_x_m + scan.ranges_m[back] * np.cos(bearing)
    y = scan.ranges_m[back] * np.sin(bearing)
    centimetres: list[int] = np.rint(np.stack([x, y], axis=1) * 100).astype(int).ravel().tolist()
    return centimetres


def floats(column: pa.ChunkedArray) -> F64:
    """Convert a column to float64, null to NaN."""
    values: F64 = column.cast(pa.float64()).combine_chunks().to_numpy(zero_copy_only=False)
    return values


def numbers(column: pa.ChunkedArray, digits: int) -> list[float | None]:
    """Convert a column to rounded JSON numbers; null if not finite."""
    return [_finite(value, digits) for value in floats(column).tolist()]


def _finite(value: float, digits: int) -> float | None:
    return round(value, digits) + 0.0 if np.isfinite(value) else None


def _is_number(kind: pa.DataType) -> bool:
    return bool(
        pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)
    )


def _columns(window: pa.Table, names: Mapping[str, str]) -> dict[str, list[float | None]]:
    """Return title -> values of the columns in `names`, without columns that are all unknown."""
    found = {title: numbers(window[name], 3) for title, name in names.items()}
    return {title: own for title, own in found.items() if any(v is not None for v in own)}


def _held(window: pa.Table, names: Sequence[str]) -> dict[str, list[int]]:
    lists = [frozenset(one or ()) for one in window["conditions"].to_pylist()]
    return {name: [int(name in one) for one in lists] for name in names}


def _probabilities(window: pa.Table, names: Sequence[str]) -> dict[str, list[float | None]]:
    rows = [dict(one or ()) for one in window["probabilities"].to_pylist()]
    found = {name: [row.get(name) for row in rows] for name in names}
    return {
        name: [None if value is None else _finite(value, 3) for value in own]
        for name, own in found.items()
        if any(value is not None for value in own)
    }


def _jpeg(image: np.ndarray[Any, Any]) -> str:
    """Return a picture as a small JPEG in a data URI; depth images in grey, with near dark."""
    from PIL import Image

    if image.dtype != np.uint8:
        far = float(np.nanpercentile(image, 95)) or 1.0
        image = (np.clip(np.nan_to_num(image / far), 0, 1) * 255).astype(np.uint8)
    picture = Image.fromarray(image).convert("RGB")
    picture.thumbnail((FRAME_PX, FRAME_PX))
    stream = io.BytesIO()
    picture.save(stream, "JPEG", quality=70)
    return f"data:image/jpeg;base64,{base64.b64encode(stream.getvalue()).decode()}"
