"""Camera frames: the current frame of each step is kept as recorded, others are counted."""

import base64
import hashlib
import io
import os
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from support.bag_samples import write_channels
from support.cameras import (
    CAMERAS,
    FRONT,
    REAR,
    camera_bag,
    compressed,
    file_of,
    front_and_rear,
    picture,
    profile_with,
    raw,
)
from support.long import one_in

from restock.errors import ConfigError, RecordingError, StoreError
from restock.ingest.pipeline import IngestResult, ingest
from restock.ingest.relabel import relabel_store
from restock.ingest.steps.cameras import (
    COMPRESSED,
    ENCODINGS,
    ImageLayout,
    ImageProblem,
    compressed_layout,
    pixels,
    raw_layout,
)
from restock.ingest.store.writer import StoreWriter
from restock.replay.review.moments import Moments
from restock.replay.store.store import Store

FRONT_ONLY = CAMERAS.split("[cameras.rear]")[0]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return camera_bag(tmp_path_factory.mktemp("camera") / "bag")


def ingest_frames(
    path: Path, store: Path, cameras: str = CAMERAS
) -> tuple[IngestResult, list[Any]]:
    """Ingest a recording and return the result and the stored frame rows."""
    result = ingest(path, profile_with(cameras), store=StoreWriter(store))
    files = sorted((store / "frames").rglob("*.parquet"))
    return result, [row for file in files for row in pq.read_table(file).to_pylist()]


def counts(result: IngestResult, camera: str = "front") -> dict[str, Any]:
    (row,) = (row for row in result.manifest["cameras"] if row["camera"] == camera)
    assert row["decoded"] == sum(
        [row["kept"], row["thinned"], row["unused"], *(p["count"] for p in row["problems"])]
    )
    return dict(row)


@pytest.mark.parametrize("storage", one_in(2, ["sqlite3", "mcap"]))
def test_current_frame_is_stored_byte_for_byte(tmp_path, storage):
    result, frames = ingest_frames(
        camera_bag(tmp_path / "bag", storage=storage), tmp_path / "store"
    )
    # 10 frames and 5 ticks a second: every second frame is current at one tick, 5 ms after arrival.
    assert {counts(result, name)["kept"] for name in ("front", "rear")} == {30}
    assert counts(result)["unused"] == 30
    front = [row for row in frames if row["camera"] == "front"]
    assert [row["frame_index"] for row in front] == list(range(0, 60, 2))
    for row in front:
        sent = file_of(picture(row["frame_index"]))
        assert row["data"] == sent
        assert row["sha256"] == hashlib.sha256(sent).hexdigest()
        assert (row["encoding"], row["width"], row["height"]) == ("jpeg", 48, 32)
        assert row["log_time_ns"] - row["stamp_ns"] == result.manifest["clock_offset_ns"]
    ticks = [row["first_transition_id"] & ((1 << 25) - 1) for row in front]
    assert ticks == list(range(30))
    assert all(row["first_transition_id"] == row["last_transition_id"] for row in front)
    rear = [row for row in frames if row["camera"] == "rear"]
    assert [row["data"] for row in rear] == [picture(row["frame_index"]).tobytes() for row in rear]


def test_storing_frames_does_not_change_rows(bag, tmp_path):
    with_frames, _ = ingest_frames(bag, tmp_path / "a")
    without, no_frames = ingest_frames(bag, tmp_path / "b", "")
    assert no_frames == []
    left, right = (
        StoreWriter(tmp_path / name)
        .rows(result.manifest["recording_id"], result.manifest["ingest_id"])
        .drop_columns(["ingest_id", "profile_hash"])
        for name, result in (("a", with_frames), ("b", without))
    )
    assert left.equals(right)
    assert profile_with("").hash != profile_with().hash


def test_thinned_frames_are_counted_and_last_kept_is_held(bag, tmp_path):
    text = FRONT_ONLY + "max_hz = 2\nmax_age_s = 2.0\n"
    result, frames = ingest_frames(bag, tmp_path / "store", text)
    row = counts(result)
    assert (row["kept"], row["thinned"], row["steps"]) == (12, 48, 30)
    assert [frame["frame_index"] for frame in frames] == list(range(0, 60, 5))
    spans = [frame["last_transition_id"] - frame["first_transition_id"] + 1 for frame in frames]
    assert sum(spans) == 30
    assert set(spans) == {2, 3}


def test_frames_expire_after_their_maximum_age(tmp_path):
    times = np.concatenate([np.arange(10) * 0.1, 3 + np.arange(10) * 0.1])  # silent for two seconds
    files = [file_of(picture(number)) for number in range(20)]
    bag = camera_bag(tmp_path / "bag", {FRONT: compressed(files, times)})
    result, frames = ingest_frames(bag, tmp_path / "store", FRONT_ONLY)
    assert counts(result)["steps"] < 30
    last_before = next(row for row in frames if row["frame_index"] == 9)
    held = last_before["last_transition_id"] & ((1 << 25) - 1)
    assert held * 0.2 + 0.005 - 0.9 <= 0.5 < (held + 1) * 0.2 + 0.005 - 0.9


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda data: data[: len(data) // 2], "truncated JPEG"),
        (lambda data: b"\x00\x00\x00\x01\x67" + data, "neither JPEG nor PNG (its format is"),
    ],
)
def test_invalid_images_are_counted_with_the_reason(tmp_path, damage, reason):
    files = [file_of(picture(number)) for number in range(60)]
    files[20:23] = [damage(data) for data in files[20:23]]
    bag = camera_bag(tmp_path / "bag", {FRONT: compressed(files)})
    result, frames = ingest_frames(bag, tmp_path / "store", FRONT_ONLY)
    (problem,) = counts(result)["problems"]
    assert problem["reason"].startswith(reason)
    assert problem["count"] == 3
    assert any(line.startswith(f"cameras.front: {reason}") for line in result.lost_messages)
    assert {20, 21, 22}.isdisjoint(row["frame_index"] for row in frames)
    # The last valid frame is held over the damaged ones.
    (held,) = (row for row in frames if row["frame_index"] == 19)
    assert held["first_transition_id"] & ((1 << 25) - 1) == 10


def test_unknown_encoding_and_short_raw_image_are_counted(tmp_path):
    kind, columns = raw([picture(number) for number in range(60)])
    columns.fields["encoding"][10:12] = "bayer_rggb8"  # type: ignore[index]
    columns.fields["step"][30] = 10_000  # type: ignore[index]
    columns.fields["step"][31] = 3  # type: ignore[index]
    bag = camera_bag(tmp_path / "bag", {REAR: (kind, columns)})
    text = CAMERAS.replace(FRONT_ONLY, "")
    result, _ = ingest_frames(bag, tmp_path / "store", text)
    assert {
        problem["reason"]: problem["count"] for problem in counts(result, "rear")["problems"]
    } == {
        "unknown encoding 'bayer_rggb8'": 2,
        "cut short: fewer bytes than its rows have": 1,
        "rows shorter than their width": 1,
    }


def test_wrong_or_missing_image_topics_are_reported(bag):
    with pytest.raises(
        RecordingError, match=r"/odom holds nav_msgs/msg/Odometry, which is not an im"
    ):
        ingest(bag, profile_with('[cameras.front]\ntopic = "/odom"\n'), store=None)
    missing = ingest(bag, profile_with('[cameras.front]\ntopic = "/nowhere"\n'), store=None)
    assert {"input": "cameras.front", "instead": "no frame: no message of /nowhere"} in (
        missing.manifest["stand_ins"]
    )
    assert missing.manifest["cameras"] == []
    with pytest.raises(ConfigError, match=r"cameras\.Front"):
        profile_with('[cameras.Front]\ntopic = "/x"\n')
    with pytest.raises(ConfigError, match="max_hz"):
        profile_with('[cameras.front]\ntopic = "/x"\nmax_hz = 0\n')


@pytest.mark.parametrize(
    ("fields", "field"),
    [("string format\nstring data", "data"), ("uint32[] format\nuint8[] data", "format")],
)
def test_image_type_with_other_fields_is_rejected(tmp_path, fields, field):
    front = (FRONT, "cdr", COMPRESSED, "ros2msg", fields.encode(), [b"\0\1\0\0"])
    file = write_channels(tmp_path / "run.mcap", front)
    with pytest.raises(RecordingError, match=rf"`cameras\.front`: .* has no '{field}' as ROS de"):
        ingest(file, profile_with(FRONT_ONLY), store=None)


def test_reingest_replaces_frames_and_relabel_keeps_them(bag, tmp_path):
    store = tmp_path / "store"
    ingest_frames(bag, store)
    (first,) = (store / "frames").rglob("*.parquet")
    again, _ = ingest_frames(bag, store, FRONT_ONLY)
    files = set((store / "frames").rglob("*.parquet"))
    assert len(files) == 2
    writer = StoreWriter(store)
    assert writer.clean() == []  # still within the retention window
    relabel_store(writer, lambda name: profile_with().definitions[:1])
    (live,) = writer.live().to_pylist()
    assert live["ingest_id"] != again.manifest["ingest_id"]
    assert live["cameras"][0]["file"] == again.manifest["cameras"][0]["file"]
    old_s = time.time() - 3600
    for file in store.rglob("*.parquet"):
        os.utime(file, (old_s, old_s))
    writer.clean(retention_hours=0)
    kept = live["cameras"][0]["file"]
    assert not first.exists()
    assert set((store / "frames").rglob("*.parquet")) == {store / "frames" / kept}


def test_failed_commit_leaves_no_frame_files(bag, tmp_path, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise StoreError("no")

    monkeypatch.setattr(StoreWriter, "fit", fail)
    with pytest.raises(StoreError):
        ingest(bag, profile_with(), store=StoreWriter(tmp_path / "store"))
    assert list((tmp_path / "store").rglob("*.parquet")) == []


@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
@pytest.mark.parametrize("channels", [1, 3])
def test_compressed_image_round_trip(kind, channels):
    image = picture(7, channels)
    data = file_of(image, kind)
    layout = compressed_layout(data, "")
    assert (layout.encoding, layout.width, layout.height) == (kind.lower(), 48, 32)
    assert (layout.channels, layout.bits) == (channels, 8)
    decoded = pixels(data, layout)
    np.testing.assert_allclose(
        decoded.astype(int), image.squeeze(), atol=12 if kind == "JPEG" else 0
    )


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("big_endian", [False, True])
def test_raw_pixels_are_read_by_row_as_rgb(encoding, big_endian):
    kind, channels, order = ENCODINGS[encoding]
    colours = np.arange(2 * 3 * channels).reshape(2, 3, channels).astype(kind)
    stored = np.empty_like(colours)
    stored[..., list(order)] = colours  # BGR stores red last
    rows = stored.astype(np.dtype(kind).newbyteorder(">" if big_endian else "<")).tobytes()
    width_bytes = len(rows) // 2
    padded = b"".join(rows[i : i + width_bytes] + b"\xee" * 5 for i in (0, width_bytes))
    layout = raw_layout(len(padded), encoding, 3, 2, width_bytes + 5, big_endian)
    np.testing.assert_array_equal(pixels(padded, layout), colours.squeeze(axis=2)
                                  if channels == 1 else colours)  # fmt: skip


def test_huge_image_size_in_header_is_rejected():
    data = bytearray(file_of(picture(1), "PNG"))
    data[16:24] = struct.pack(">II", 100_000, 100_000)
    with pytest.raises(ImageProblem, match="more than 100,000,000 pixels"):
        compressed_layout(bytes(data), "png")
    with pytest.raises(ImageProblem, match="more than 100,000,000 pixels"):
        raw_layout(100, "mono8", 1 << 31, 1 << 31, 1 << 31, big_endian=False)


def test_damaged_pixel_data_fails_at_decoding():
    data = bytearray(file_of(picture(1), "PNG"))
    data[50:60] = b"\0" * 10
    layout = compressed_layout(bytes(data), "png")
    with pytest.raises(ImageProblem, match="cannot be decoded"):
        pixels(bytes(data), layout)
    small = file_of(picture(1)[:8, :8], "PNG")
    with pytest.raises(ImageProblem, match="its size differs"):
        pixels(small, layout)


@given(st.binary(max_size=64), st.sampled_from([b"", b"\xff\xd8", b"\x89PNG\r\n\x1a\n"]))
def test_arbitrary_bytes_give_layout_or_image_problem(data, start):
    for ending in (b"", b"\xff\xd9", b"IEND\xaeB`\x82"):
        try:
            layout = compressed_layout(start + data + ending, "jpeg")
        except ImageProblem:
            continue
        assert isinstance(layout, ImageLayout)
        with pytest.raises(ImageProblem):
            pixels(start + data + ending, layout)


def test_file_damage_is_counted_once(tmp_path):
    """Frames are read in a second pass, which must not count the damage again."""
    bag = camera_bag(tmp_path / "bag", front_and_rear(), storage="mcap")
    file = next(bag.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * 0.7)])
    profile = profile_with()
    plain = ingest(file, profile_with(""), store=None, salvage=True)
    result = ingest(file, profile, store=StoreWriter(tmp_path / "s"), salvage=True)
    file_losses = [line for line in result.lost_messages if line.startswith("the file")]
    assert file_losses == [line for line in plain.lost_messages if line.startswith("the file")]
    assert file_losses
    assert 0 < counts(result)["kept"] < 30


def test_review_moment_shows_current_frames(bag, tmp_path):
    result, _ = ingest_frames(bag, tmp_path / "store")
    with Store(tmp_path / "store") as store:
        ((episode,),) = store.sql("SELECT DISTINCT episode_id FROM transitions").fetchall()
        event = {"recording": result.manifest["recording_id"], "episode_id": episode}
        seen = Moments(store).frames(event | {"first_step": 12, "last_step": 14})
    assert seen["notes"] == []
    assert [step for step, _ in seen["cameras"]["front"]] == list(range(2, 25, 2))
    for step, uri in seen["cameras"]["front"]:
        image = Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1])))
        sent = picture(2 * step)[3, -3]  # its colour encodes the message number
        assert np.abs(np.array(image)[3, -3].astype(int) - sent).max() <= 4
