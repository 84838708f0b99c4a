"""A proposal has the cameras of its recording in comments, with the size and rate of frames."""

from pathlib import Path

from support.cameras import FRONT, REAR, camera_bag, compressed, file_of, picture, raw

from restock.ingest.containers.open_recording import open_recording
from restock.ingest.profile.profile import parse_profile
from restock.ingest.propose.candidates import camera_topics
from restock.ingest.propose.propose import propose_profile


def test_an_uncommented_proposed_camera_works(tmp_path):
    with open_recording(camera_bag(tmp_path / "bag")) as recording:
        text = propose_profile(recording, "robot").toml
    assert parse_profile(text, where="test").cameras == {}
    lines = text.splitlines()
    first = next(n for n, line in enumerate(lines) if line.startswith("# Cameras: frames kept"))
    live = [line.removeprefix("# ") for line in lines[first:] if line.startswith("# [cameras.")]
    assert [line.split("  #")[0] for line in live] == ["[cameras.front]", "[cameras.rear]"]
    assert "10.0 Hz, jpeg, 48 x 32" in live[0]
    assert "10.0 Hz, rgb8, 48 x 32, 5 kB" in live[1]
    uncommented = text
    for line in lines[first:]:
        if line.startswith(("# [cameras", "# topic", "# max_hz")):
            uncommented = uncommented.replace(line, line.removeprefix("# "))
    cameras = parse_profile(uncommented, where="test").cameras
    assert {name: (one.topic, one.max_hz) for name, one in cameras.items()} == {
        "front": (FRONT, 5.0),
        "rear": (REAR, 5.0),
    }


def test_cameras_are_named_by_topics_that_have_frames(tmp_path: Path) -> None:
    whole = file_of(picture(1))
    topics = {
        "/camera/image_raw": raw([picture(0)] * 4),
        "/camera/image_raw/compressed": compressed([whole[:-9], whole, whole, whole]),
        "/camera/depth/compressedDepth": compressed([b"\x00" * 40] * 4, said="16UC1; png"),
        "/3D/Image": raw([picture(0)[:, :, :1]] * 4, "bayer_rggb8"),
    }
    with open_recording(camera_bag(tmp_path / "bag", topics)) as recording:
        found = {one.topic.name: one for one in camera_topics(recording, 2.0)}
    assert {topic: one.name for topic, one in found.items()} == {
        "/3D/Image": "camera_3d",
        "/camera/depth/compressedDepth": "camera_depth",
        "/camera/image_raw": "camera",
        "/camera/image_raw/compressed": "camera_2",
    }
    assert found["/camera/image_raw/compressed"].frame == "jpeg, 48 x 32"  # the first whole one
    assert not found["/3D/Image"].usable
    assert "unknown encoding 'bayer_rggb8'" in found["/3D/Image"].frame
    assert "neither JPEG nor PNG" in "\n".join(found["/camera/depth/compressedDepth"].lines())
