"""Camera frames of store rows: in SQL, decoded in Python, and exported as LeRobot images."""

import io
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image
from support.cameras import (
    CAMERAS,
    FRONT,
    REAR,
    camera_bag,
    compressed,
    file_of,
    picture,
    profile_with,
    raw,
)
from support.neighbours import read_with

from restock.errors import QueryError, StoreError
from restock.ingest.pipeline import ingest
from restock.ingest.store.writer import StoreWriter
from restock.replay import Store, camera_frames, export_dataset

FRONT_ONLY = CAMERAS.split("[cameras.rear]")[0]


@pytest.fixture(scope="module")
def store_path(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    ingest(camera_bag(folder / "bag"), profile_with(), store=StoreWriter(folder / "store"))
    return folder / "store"


def ingest_cameras(folder: Path, cameras: dict, text: str = FRONT_ONLY) -> Path:  # type: ignore[type-arg]
    ingest(camera_bag(folder / "bag", cameras), profile_with(text), store=StoreWriter(folder / "s"))
    return folder / "s"


def test_frames_are_views_of_store(store_path):
    with Store(store_path) as store:
        rows = store.sql(
            "SELECT camera, count(*), min(age_s), max(age_s) FROM transition_frames"
            " JOIN transitions USING (transition_id) GROUP BY ALL ORDER BY ALL"
        ).fetchall()
        assert [row[:2] for row in rows] == [("front", 29), ("rear", 29)]
        assert all(0 <= low <= high < 0.1 for _, _, low, high in rows)
        assert "data" not in store.sql("FROM frames").columns
        documented = store.sql(
            "SELECT count(*) FROM columns WHERE view IN ('frames', 'transition_frames')"
            " AND meaning = ''"
        ).fetchall()
        assert documented == [(0,)]


def test_frames_of_rows_are_decoded(store_path):
    with Store(store_path) as store:
        found = list(camera_frames(store, "FROM transitions WHERE step_index < 3", "rear"))
        for step, frame in enumerate(found):
            assert (frame.frame_index, frame.topic, frame.camera) == (2 * step, REAR, "rear")
            assert frame.source_file.endswith("bag")
            np.testing.assert_array_equal(frame.image(), picture(2 * step))
        (front,) = camera_frames(store, [found[1].transition_id], "front")
        np.testing.assert_allclose(front.image().astype(int), picture(2), atol=12)
        assert [f.camera for f in camera_frames(store, [front.transition_id])] == ["front", "rear"]
        with pytest.raises(StoreError, match="no frames of a camera 'side'"):
            list(camera_frames(store, "FROM transitions", "side"))
        with pytest.raises(QueryError, match="no transition_id"):
            list(camera_frames(store, "SELECT 1 AS x"))


def test_frame_with_changed_bytes_is_refused(store_path):
    import dataclasses

    with Store(store_path) as store:
        frame = next(camera_frames(store, "FROM transitions", "rear"))
    changed = dataclasses.replace(frame, data=b"\0" + frame.data[1:])
    with pytest.raises(StoreError, match="differ from those that were recorded"):
        changed.image()


def test_lerobot_export_keeps_recorded_frames(store_path, tmp_path):
    document = export_dataset(store_path, "lerobot", tmp_path / "a")
    assert (document["transitions"], document["left_out"]) == (29, {})
    info = json.loads((tmp_path / "a/meta/info.json").read_text())
    expected = {"dtype": "image", "shape": [32, 48, 3], "names": ["height", "width", "channels"]}
    assert info["features"]["observation.images.front"] == expected
    (file,) = (tmp_path / "a/data").rglob("*.parquet")
    rows = pq.read_table(file)
    front = [row["bytes"] for row in rows["observation.images.front"].to_pylist()]
    assert front == [file_of(picture(2 * step)) for step in range(29)]
    rear = rows["observation.images.rear"].to_pylist()[3]["bytes"]
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(rear))), picture(6))
    stats = json.loads((tmp_path / "a/meta/stats.json").read_text())["observation.images.rear"]
    pixels = np.stack([picture(2 * step) for step in range(29)]) / 255
    np.testing.assert_allclose(np.ravel(stats["mean"]), pixels.mean(axis=(0, 1, 2)), rtol=1e-6)
    assert np.shape(stats["q01"]) == (3, 1, 1)
    assert json.loads((tmp_path / "a/meta/restock.json").read_text())["cameras"] == [
        "front",
        "rear",
    ]


@pytest.mark.long  # starts another Python
def test_lerobot_reads_exported_images(store_path, tmp_path):
    export_dataset(store_path, "lerobot", tmp_path / "a")
    images = read_with("lerobot", tmp_path / "a")["images"]
    assert images.keys() == {"observation.images.front", "observation.images.rear"}
    rear = images["observation.images.rear"]
    assert rear["shape"] == [3, 32, 48]
    expected = [picture(2 * step)[0, -1] / 255 for step in range(29)]
    np.testing.assert_allclose(rear["corner"], expected, rtol=1e-6)
    np.testing.assert_allclose(images["observation.images.front"]["corner"], expected, atol=0.05)


def test_steps_without_frame_are_left_out_and_counted(tmp_path):
    times = 2 + np.arange(40) * 0.1  # the camera is late by two seconds
    files = [file_of(picture(number)) for number in range(40)]
    store = ingest_cameras(tmp_path, {FRONT: compressed(files, times)})
    document = export_dataset(store, "lerobot", tmp_path / "a")
    assert document["left_out"] == {"no frame of camera front": 10}
    assert document["rows"] == document["transitions"] + 10 == 29
    assert export_dataset(store, "lerobot", tmp_path / "b", cameras=[])["transitions"] == 29
    assert "images" not in (tmp_path / "b/meta/info.json").read_text()


def test_grey_frames_are_converted_16_bit_ones_refused(tmp_path):
    grey = [file_of(picture(number, 1)) for number in range(60)]
    depth = [np.full((4, 6), number * 500, np.uint16) for number in range(60)]
    store = ingest_cameras(tmp_path, {FRONT: compressed(grey), REAR: raw(depth, "16UC1")}, CAMERAS)
    document = export_dataset(store, "lerobot", tmp_path / "a", cameras=["front"])
    assert document["notes"] == [
        "observation.images.front: 0 pictures as they were recorded; 29 of jpeg, 1 channels as PNG"
    ]
    with pytest.raises(StoreError, match="16 bits a channel"):
        export_dataset(store, "lerobot", tmp_path / "b")
    assert not (tmp_path / "b").exists()
    with Store(store) as opened:
        frame = next(camera_frames(opened, "FROM transitions WHERE step_index = 2", "rear"))
        assert frame.image().dtype == np.uint16
        assert frame.image()[0, 0] == 2000


def test_frames_of_two_sizes_are_refused(tmp_path):
    files = [file_of(picture(number)[: 32 if number < 30 else 16]) for number in range(60)]
    store = ingest_cameras(tmp_path, {FRONT: compressed(files)})
    with pytest.raises(StoreError, match="48 x 16 and of 48 x 32 pixels"):
        export_dataset(store, "lerobot", tmp_path / "a")


def test_export_verb_takes_cameras(store_path, tmp_path, shell):
    export = ["export", str(store_path), "--out", str(tmp_path / "a"), "--to"]
    assert "observation.images.front: 29 pictures as they were recorded" in shell.out(
        *export, "lerobot", "--cameras", "front"
    )
    pytest.importorskip("minari")
    assert "holds no images" in shell.err(*export, "minari", "--cameras", "front")


def test_trace_lists_frames_of_row(store_path, shell):
    with Store(store_path) as store:
        (front, *_) = camera_frames(store, "FROM transitions WHERE step_index = 2", "front")
    argv = ["trace", str(store_path), str(front.transition_id)]
    found = {one["camera"]: one for one in shell.json(*argv)["frames"]}
    assert list(found) == ["front", "rear"]
    assert found["front"]["frame_index"] == front.frame_index
    assert found["front"]["age_s"] == pytest.approx(front.age_s)
    assert found["front"]["sha256"] == front.sha256
    held = pq.read_table(found["rear"]["file"]).to_pylist()
    assert found["rear"]["sha256"] in {one["sha256"] for one in held if one["camera"] == "rear"}
    out = shell.out(*argv)
    assert "the frames of its cameras" in out
    assert "48 x 32 jpeg" in out
