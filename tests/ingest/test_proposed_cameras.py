"""A proposal has the cameras of its recording in comments."""

from support.cameras import FRONT, REAR, camera_bag, front_and_rear, picture, raw

from restock.ingest.containers.open_recording import open_recording
from restock.ingest.profile.profile import parse_profile
from restock.ingest.propose.propose import propose_profile


def test_an_uncommented_proposed_camera_works(tmp_path):
    topics = front_and_rear() | {"/3D/Image": raw([picture(0)] * 6)}  # one frame a second
    with open_recording(camera_bag(tmp_path / "bag", topics)) as recording:
        text = propose_profile(recording, "robot").toml
    assert parse_profile(text, where="test").cameras == {}
    for line in text[text.index("# Cameras: frames kept") :].splitlines():
        if line.startswith(("# [cameras", "# topic", "# max_")):
            text = text.replace(line, line.removeprefix("# "))
    cameras = parse_profile(text, where="test").cameras
    assert {name: (one.topic, one.max_hz) for name, one in cameras.items()} == {
        "front_image_compressed": (FRONT, 5.0),
        "rear_image": (REAR, 5.0),
        "camera_3d_image": ("/3D/Image", None),
    }
    assert cameras["camera_3d_image"].max_age_s > 1.0
