"""Reads a LeRobot v3.0 data set as a recording: one topic per feature, one message per frame.

    meta/info.json                          features (dtype, shape and names), number of frames
    data/chunk-*/file-*.parquet             one row per frame

A numeric feature becomes a topic with its name (`/action`), with a float64 field for each of its
`names` (`x.vel` is the field `x_vel`; without names `value_0`, `value_1`, …). Its messages are CDR
with a definition, so that the decoders of ROS 2 messages read them. `/frame` has the counters of
each frame. A feature of images becomes a topic of sensor_msgs/msg/CompressedImage. Videos are
listed but not read.

LeRobot has no dates. Time starts at 1970-01-01, and each episode starts `GAP_S` after the end of
the one before.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from restock.arrays import Bools, Ints
from restock.errors import RecordingError, counted
from restock.files import first_line, read_json
from restock.ingest.containers.storage import (
    LEROBOT_DATA,
    LEROBOT_INFO,
    Extra,
    Metadata,
    Storage,
    Watch,
    keep_entries,
    no_progress,
)
from restock.ingest.decoding.columns import Channel, MessageBatch

VERSION = "v3.0"
GAP_S = 10  # seconds between episodes: beyond the usual `max_gap_s` of a profile, which splits them
MAX_S, MAX_WIDTH = 1e6, 4096  # largest timestamp in seconds; most numbers in a feature
ROWS, IMAGES = 65_536, 256  # frames read at a time, without and with images
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
FRAME, IMAGE = "/frame", "sensor_msgs/msg/CompressedImage"
CDR = b"\x00\x01\x00\x00"
UNREADABLE = (pa.ArrowException, OSError, KeyError, TypeError, ValueError)
_NUMERIC = re.compile(r"bool|u?int(8|16|32|64)|float(16|32|64)")


class _Feature(NamedTuple):
    name: str
    fields: tuple[str, ...]  # names of its messages' fields; empty for images


class _Frames(NamedTuple):
    """A data file and the log times of its frames."""

    path: Path
    name: str
    stamp_ns: Ints  # (N,)


class LeRobotFolder(Storage):
    """The folder of a data set, read only. The format has no checksums, so it is never verified.

    Raises:
        RecordingError: `meta/info.json` is missing or of another version, or a data file cannot be
            read or is out of order (unless `salvage`).
    """

    def __init__(self, path: Path, *, salvage: bool = False, watch: Watch = no_progress) -> None:
        super().__init__()
        self._path, self._salvage, self._watch = path, salvage, watch
        info = read_json(path / LEROBOT_INFO, error=RecordingError)
        if (version := info.get("codebase_version")) != VERSION:
            raise RecordingError(
                f"a LeRobot data set of codebase_version {version!r}: only {VERSION} is read",
                where=str(path / LEROBOT_INFO),
                remedy="convert it: `python -m lerobot.datasets.v30.convert_dataset_v21_to_v30`"
                if version == "v2.1"
                else None,
            )
        robot = info.get("robot_type")
        entries = keep_entries({"robot_type": robot} if isinstance(robot, str) else {})[0]
        self.metadata = [Metadata(LEROBOT_INFO, "", entries)]
        self._features = dict(enumerate(self._read_features(info.get("features")), 2))
        self.channels = {1: Channel(1, FRAME, "lerobot/msg/Frame", "cdr", "ros2msg", _FRAME)}
        for number, feature in self._features.items():
            text = "".join(f"float64 {name}\n" for name in feature.fields).encode()
            kind, form = (_type(feature), "ros2msg") if text else (IMAGE, "")
            self.channels[number] = Channel(number, f"/{feature.name}", kind, "cdr", form, text)
        self._files = self._open_files()
        claimed, held = info.get("total_frames"), self.counts[1]
        if isinstance(claimed, int) and claimed != held:
            what = f"{LEROBOT_INFO} counts {claimed:,} frames, and there are {held:,}"
            if claimed < held:
                self.notes.append(what)
            else:
                self.damaged(what, dict.fromkeys(self.channels, claimed - held))
                self.counts = dict.fromkeys(self.channels, claimed)
        there = [file.stamp_ns for file in self._files if len(file.stamp_ns)]
        self.span_ns = (int(there[0][0]), int(there[-1][-1])) if there else None

    def _read_features(self, features: object) -> Iterator[_Feature]:
        """Yield the features that are read; list videos in `extras`, and note the others."""
        if not isinstance(features, dict):
            raise RecordingError("it has no features", where=str(self._path / LEROBOT_INFO))
        for name, about in features.items():
            about = about if isinstance(about, dict) else {}
            kind = str(about.get("dtype"))
            if name in (*COUNTERS, "timestamp"):
                continue
            if kind == "video":
                files = list(self._path.glob("videos/*/*/*.mp4"))
                size = sum(f.stat().st_size for f in files if f.parts[-3] == name)
                self.extras.append(Extra("attachment", name, "video/mp4", size))
            elif kind == "image":
                yield _Feature(name, ())
            elif not _NUMERIC.fullmatch(kind):
                self.notes.append(f"feature {name} is a {kind}: it is not read")
            elif (width := _width(about.get("shape"))) is None:
                self.notes.append(
                    f"feature {name} has the shape {about.get('shape')}: only one dimension is"
                    f" read, of up to {MAX_WIDTH:,} numbers"
                )
            else:
                yield _Feature(name, field_names(about.get("names"), width))
        if self.extras:
            self.notes.append(
                f"{counted(len(self.extras), 'feature')} of video: listed, and not read"
            )

    def _open_files(self) -> list[_Frames]:
        """Find the data files and the log times of their frames."""
        columns = ("timestamp", *COUNTERS, *(one.name for one in self._features.values()))
        found: list[tuple[Path, str]] = []
        parts: list[tuple[Ints, NDArray[Any]]] = []
        paths = sorted(self._path.glob(LEROBOT_DATA))
        for done, path in enumerate(paths):
            self._watch("looking through the data files", done, len(paths))
            name = path.relative_to(self._path).as_posix()
            try:
                file = pq.ParquetFile(path)
                if lacking := [one for one in columns if one not in file.schema_arrow.names]:
                    raise ValueError(f"it has no column {', '.join(lacking)}")
                table = file.read(columns=["timestamp", "episode_index"])
                episode = table["episode_index"].to_numpy().astype(np.int64)
                seconds = table["timestamp"].to_numpy().astype(np.float64)
                if not (np.abs(seconds) < MAX_S).all():  # False for NaN
                    raise ValueError("a timestamp is not a number, or implausible")
            except UNREADABLE as error:
                self._refuse(f"{name} cannot be read: {first_line(error)}")
                continue
            found.append((path, name))
            parts.append((episode, seconds))
        if not found:
            raise RecordingError("a LeRobot data set without data files", where=str(self._path))
        stamps, problem = log_times(*map(np.concatenate, zip(*parts, strict=True)))
        if problem is not None:
            ends = np.cumsum([len(episode) for episode, _ in parts])
            at = int(np.searchsorted(ends, problem[0], "right"))
            row = problem[0] - (ends[at] - len(parts[at][0]))
            self._refuse(f"{found[at][1]}: row {row:,} {problem[1]}")
        self.counts = dict.fromkeys(self.channels, len(stamps))
        cuts = np.cumsum([len(episode) for episode, _ in parts])[:-1]
        each = np.split(stamps, cuts)
        self.notes.append(
            f"LeRobot has no dates: time starts at 1970-01-01, with {GAP_S} s before each episode"
        )
        return [_Frames(*one, stamp_ns) for one, stamp_ns in zip(found, each, strict=True)]

    def _refuse(self, what: str) -> None:
        """Raise RecordingError, or note the damage if the folder is to be salvaged."""
        if not self._salvage:
            raise RecordingError(
                what,
                where=str(self._path),
                remedy="`--salvage` reads what can still be read of it",
            )
        self.damaged(what)

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """Yield the frames of each data file in order."""
        wanted = [number for number in self.channels if number in channels]
        names = [self._features[number].name for number in wanted if number != 1]
        names += [*COUNTERS, "timestamp"] if 1 in channels else []
        images = any(number != 1 and not self._features[number].fields for number in wanted)
        for file in self._files if wanted else ():
            done, short = 0, Counter[tuple[int, str]]()
            try:
                parts = pq.ParquetFile(file.path).iter_batches(
                    IMAGES if images else ROWS, columns=names
                )
                for part in parts:
                    stamp_ns = file.stamp_ns[done : done + len(part)]
                    for number in wanted:
                        yield number, self._batch(number, part, stamp_ns, short)
                    done += len(part)
            except UNREADABLE as error:
                lost = dict.fromkeys(wanted, len(file.stamp_ns) - done)
                self.damaged(f"{file.name} from row {done:,} on: {first_line(error)}", lost)
            for (number, why), count in short.items():
                self.damaged(f"{file.name}: frames with {why}", {number: count})

    def _batch(
        self, number: int, part: pa.RecordBatch, stamp_ns: Ints, short: Counter[tuple[int, str]]
    ) -> MessageBatch:
        """Build a channel's messages from these frames; count frames that give none in `short`."""
        if number == 1:
            counters = [
                part[name].cast(pa.int64()).to_numpy(zero_copy_only=False) for name in COUNTERS
            ]
            seconds = part["timestamp"].cast(pa.float64()).to_numpy(zero_copy_only=False)
            return cdr_batch(np.stack([*counters, seconds.view(np.int64)], axis=1), stamp_ns)
        feature = self._features[number]
        column = part[feature.name]
        if feature.fields:
            good, values = fixed_width_rows(column, len(feature.fields))
            why = f"another number of values than {len(feature.fields)}"
        else:
            pictures = column.field("bytes") if pa.types.is_struct(column.type) else column
            good, why = np.asarray(pictures.is_valid()), "no picture within the table"
        if not good.all():
            short[number, f"{why} in {feature.name}"] += int((~good).sum())
        kept = stamp_ns[good]
        if feature.fields:
            return cdr_batch(values, kept)
        payloads = map(image_cdr, pictures.drop_null().to_pylist(), kept.tolist())
        return MessageBatch.of(list(payloads), kept, kept)

    def close(self) -> None:
        """Do nothing: files are opened one by one while they are read."""


_FRAME = "".join([*(f"int64 {name}\n" for name in COUNTERS), "float64 timestamp\n"]).encode()


def _width(shape: object) -> int | None:
    """Return how many numbers a feature of this shape has; None if the shape is not supported."""
    if not isinstance(shape, list) or len(shape) > 1:
        return None
    width = shape[0] if shape else 1
    return width if isinstance(width, int) and 0 < width <= MAX_WIDTH else None


def _type(feature: _Feature) -> str:
    words = re.findall(r"[A-Za-z0-9]+", feature.name)
    return "lerobot/msg/" + ("".join(word[0].upper() + word[1:] for word in words) or "Feature")


def field_names(names: object, width: int) -> tuple[str, ...]:
    """Return a field name for each of a feature's `width` values, made from its `names`.

    `names` is a list, or maps the name of an axis to a list (`{"motors": [...]}`).
    """
    if isinstance(names, dict):
        lists = [value if isinstance(value, list) else [key] for key, value in names.items()]
        names = [name for some in lists for name in some]
    if not isinstance(names, list) or len(names) != width:
        names = [""] * width
    fields = list[str]()
    for at, name in enumerate(names):
        field = re.sub(r"[^a-z0-9]+", "_", str(name).lower()).strip("_")
        field = field if field[:1].isalpha() else f"value_{field or at}"
        fields.append(field if field not in fields else f"{field}_{at}")
    return tuple(fields)


def log_times(episode: Ints, seconds: NDArray[np.float64]) -> tuple[Ints, tuple[int, str] | None]:
    """Return a log time for each frame (N,), and the first frame out of order with the reason.

    Within an episode, log times follow its timestamps. Each episode begins GAP_S after the end of
    the one before. A frame that is out of order is treated as the start of an episode.
    """
    if not len(episode):
        return np.zeros(0, np.int64), None
    ahead, later = np.diff(episode), np.diff(seconds) > 0
    wrong = np.flatnonzero((ahead < 0) | ((ahead == 0) & ~later))
    first = np.concatenate([[0], np.flatnonzero((ahead != 0) | ~later) + 1])
    run = np.repeat(np.arange(len(first)), np.diff(first, append=len(episode)))
    within_ns = np.rint((seconds - seconds[first][run]) * 1e9).astype(np.int64)
    last_ns = within_ns[np.append(first[1:], len(episode)) - 1]
    begin_ns = np.cumsum(np.append(0, last_ns[:-1]) + GAP_S * 10**9)
    stamps = begin_ns[run] + within_ns
    if not len(wrong):
        return stamps, None
    at = int(wrong[0]) + 1
    before, now = episode[at - 1 : at + 1]
    if now != before:
        return stamps, (at, f"is of episode {now:,}, after episode {before:,}")
    return stamps, (at, f"of episode {now:,} is not later than the one before it")


def fixed_width_rows(column: pa.Array, width: int) -> tuple[Bools, NDArray[np.float64]]:
    """Return which rows have `width` values, (N,), and their values, (M, width), null as NaN."""
    good = np.ones(len(column), np.bool_)
    if hasattr(column.type, "value_type"):
        good = np.asarray(pc.fill_null(pc.equal(pc.list_value_length(column), width), False))
        column = column.filter(pa.array(good)).flatten()
    values = column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    return good, values.reshape(-1, width)


def cdr_batch(values: NDArray[Any], stamp_ns: Ints) -> MessageBatch:
    """Serialise rows (N, k) of eight-byte numbers as CDR, one message per row."""
    size = len(CDR) + 8 * values.shape[1]
    messages = np.empty((len(values), size), np.uint8)
    messages[:, : len(CDR)] = np.frombuffer(CDR, np.uint8)
    messages[:, len(CDR) :] = np.ascontiguousarray(values).view(np.uint8)
    start = np.arange(len(values), dtype=np.int64) * size
    return MessageBatch(messages.reshape(-1), start, start + size, stamp_ns, stamp_ns)


def image_cdr(picture: bytes, stamp_ns: int) -> bytes:
    """Serialise a PNG or JPEG file as sensor_msgs/msg/CompressedImage."""
    form = b"png\0" if picture.startswith(b"\x89PNG") else b"jpeg\0\0\0\0"
    head = struct.pack("<iIIII", *divmod(stamp_ns, 10**9), 1, 0, len(form.rstrip(b"\0")) + 1)
    return CDR + head + form + struct.pack("<I", len(picture)) + picture
