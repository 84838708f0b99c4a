"""LeRobot's dataset layout v3.0: `LeRobotDataset("restock/logs", root="OUT")`.

    meta/info.json  meta/stats.json  meta/tasks.parquet
    meta/episodes/chunk-000/file-000.parquet    one row per episode: its frames, its statistics
    data/chunk-000/file-000.parquet             one row per frame, one row group per episode
    meta/restock.json                           provenance

A frame is an observation and the action taken there. The layout has no frame for the observation
after the last action, so every frame has `next.observation.state`, unless a query chooses the
state. `observation.images.CAMERA` is the encoded picture that was the camera's latest at the step.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from restock.replay.export.images import ImageFeature, pictures
from restock.replay.export.selection import Selection
from restock.replay.export.trajectory import STATE, Counts, Trajectory, fixed_lists

CODEBASE_VERSION = "v3.0"
TASK = "Drive along the planned route to its goal without touching anything."
QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
OWN = "restock."  # prefix of columns that LeRobot does not define; they get no statistics
PATTERN = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
FILE = PATTERN.format(chunk_index=0, file_index=0)  # the only file

PICTURE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])  # image type of `datasets`
Stats = dict[str, dict[str, NDArray[np.float64]]]


def write_lerobot(
    selection: Selection, trajectories: Iterator[Trajectory], out: Path, counts: Counts
) -> list[str]:
    """Write the directory `out`."""
    data, about_episodes = (out / name / FILE for name in ("data", "meta/episodes"))
    for path in (data, about_episodes):
        path.parent.mkdir(parents=True)
    writer: pq.ParquetWriter | None = None
    episodes: list[dict[str, Any]] = []
    all_stats: list[Stats] = []
    frames = 0
    features: dict[str, dict[str, Any]] = {}
    fps = 1 / selection.task.control_period_s
    cameras = [ImageFeature(camera) for camera in selection.cameras]
    for number, trajectory in enumerate(trajectories):
        columns = _frames(trajectory, number, frames, fps)
        features = features or _features(selection, columns)
        stats = {
            name: _stats(np.asarray(values))
            for name, values in columns.items()
            if not name.startswith(OWN)
        }
        images: dict[str, pa.Array] = {}
        for feature, rows, some in pictures(selection.store, trajectory, cameras):
            images[feature.name] = pa.array(rows, PICTURE)
            stats[feature.name] = _image_stats(some)
        table = _table(columns, images)
        writer = writer or pq.ParquetWriter(data, table.schema)
        writer.write_table(table)
        all_stats.append(stats)
        length = len(trajectory)
        episodes.append(
            {
                "episode_index": number,
                "tasks": [TASK],
                "length": length,
                "dataset_from_index": frames,
                "dataset_to_index": frames + length,
                "data/chunk_index": 0,
                "data/file_index": 0,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                "restock/episode_id": trajectory.episode_id,
                "restock/first_step": trajectory.first_step,
                "restock/terminated": trajectory.terminated,
                "restock/cut": trajectory.cut,
                **{f"restock/{name}": label for name, label in trajectory.robot_and_site.items()},
                **{
                    f"stats/{name}/{kind}": value.tolist()
                    for name, kinds in stats.items()
                    for kind, value in kinds.items()
                },
            }
        )
        frames += length
    if writer is not None:
        writer.close()
    pq.write_table(pa.Table.from_pylist(episodes), about_episodes)
    _write_tasks(out / "meta/tasks.parquet")
    _write_json(out / "meta/stats.json", _json(_merge_stats(all_stats)))
    _write_json(out / "meta/restock.json", selection.provenance | {"counts": counts.describe()})
    _write_json(
        out / "meta/info.json",
        {
            "codebase_version": CODEBASE_VERSION,
            "robot_type": None,
            "total_episodes": len(episodes),
            "total_frames": frames,
            "total_tasks": 1,
            "chunks_size": 1000,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": round(fps) if abs(fps - round(fps)) < 1e-9 else fps,
            "splits": {"train": f"0:{len(episodes)}"},
            "data_path": f"data/{PATTERN}",
            "video_path": None,
            "features": features | {camera.name: camera.describe() for camera in cameras},
        },
    )
    return [camera.note() for camera in cameras]


def _frames(t: Trajectory, number: int, first_frame: int, fps: float) -> dict[str, Any]:
    """Return an episode's columns, (T,) or (T, k) each."""
    steps = np.arange(len(t))
    last = steps == len(t) - 1
    chosen = t.carried.get(STATE)  # the query's state: without `next.`, unknown after the last step
    return {
        STATE: t.observations[:-1] if chosen is None else chosen.astype(np.float32),
        "action": t.actions,
        **({"next.observation.state": t.observations[1:]} if chosen is None else {}),
        "next.reward": t.rewards,
        "next.done": last,
        "next.terminated": last & t.terminated,
        "next.truncated": last & t.truncated,
        **{
            f"{OWN}{name}": ["" if v is None else str(v) for v in column]
            if column.dtype == object
            else column
            for name, column in t.carried.items()
            if name != STATE
        },
        "timestamp": (steps / fps).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full(len(t), number),
        "index": first_frame + steps,
        "task_index": np.zeros(len(t), np.int64),
    }


def _features(selection: Selection, columns: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return info.json's `features`: dtype, shape and entry names of every column."""
    names = {
        STATE: selection.provenance["observation_names"],
        "next.observation.state": selection.provenance["observation_names"],
        "action": selection.provenance["action_names"] if selection.continuous else ["index"],
    }
    features = {}
    for name, values in columns.items():
        text = isinstance(values, list)
        shape = [1] if text or values.ndim == 1 else [values.shape[1]]
        dtype = "string" if text else str(values.dtype)
        features[name] = {"dtype": dtype, "shape": shape, "names": names.get(name)}
    return features


def _table(columns: dict[str, Any], images: dict[str, pa.Array]) -> pa.Table:
    return pa.table(
        images
        | {
            name: fixed_lists(values)
            if isinstance(values, np.ndarray) and values.ndim == 2
            else pa.array(values)
            for name, values in columns.items()
        }
    )


def _stats(values: NDArray[Any]) -> dict[str, NDArray[np.float64]]:
    """Compute the statistics of one episode's column, one entry per element, (k,) each."""
    wide = values.reshape(len(values), -1).astype(np.float64)
    stats = {
        "min": wide.min(axis=0),
        "max": wide.max(axis=0),
        "mean": wide.mean(axis=0),
        "std": wide.std(axis=0),
        "count": np.array([len(wide)]),
    }
    quantiles = np.quantile(wide, QUANTILES, axis=0)
    return stats | {f"q{int(q * 100):02d}": quantiles[i] for i, q in enumerate(QUANTILES)}


def _image_stats(images: NDArray[np.uint8]) -> dict[str, NDArray[np.float64]]:
    """Compute statistics of pictures (N, H, W, 3) by colour, from 0 to 1, (3, 1, 1) each."""
    stats = _stats(images.reshape(-1, 3) / 255)
    shaped = {name: value.reshape(3, 1, 1) for name, value in stats.items() if name != "count"}
    return shaped | {"count": np.array([len(images)])}


def _merge_stats(all_stats: list[Stats]) -> Stats:
    """Merge the episodes' statistics; quantiles are averaged, as in LeRobot."""
    whole: Stats = {}
    for name in all_stats[0]:
        parts = {
            kind: np.stack([stats[name][kind] for stats in all_stats])
            for kind in all_stats[0][name]
        }
        weight = parts["count"] / parts["count"].sum()  # (episodes, 1)
        weight = weight.reshape(-1, *[1] * (parts["mean"].ndim - 1))
        mean = (parts["mean"] * weight).sum(axis=0)
        variance = ((parts["std"] ** 2 + (parts["mean"] - mean) ** 2) * weight).sum(axis=0)
        whole[name] = {
            "min": parts["min"].min(axis=0),
            "max": parts["max"].max(axis=0),
            "mean": mean,
            "std": np.sqrt(variance),
            "count": parts["count"].sum(axis=0),
            **{k: (v * weight).sum(axis=0) for k, v in parts.items() if k.startswith("q")},
        }
    return whole


def _json(stats: Stats) -> dict[str, Any]:
    return {name: {k: v.tolist() for k, v in kinds.items()} for name, kinds in stats.items()}


def _write_tasks(path: Path) -> None:
    """Write the task table as a pandas frame indexed by the task's text, as LeRobot reads it."""
    index = {"name": "task", "field_name": "task", "pandas_type": "unicode"}
    about = {
        "index_columns": ["task"],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64"}
            | {"numpy_type": "int64", "metadata": None},
            index | {"numpy_type": "object", "metadata": None},
        ],
        "column_indexes": [],
    }
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": [TASK]})
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), path)


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
