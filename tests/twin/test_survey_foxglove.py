"""Surveys of robots that record Foxglove's message types."""

from pathlib import Path

import numpy as np
import pytest
from support.foxglove_robot import BEAMS, FIELD_RAD, WALL_M, drive, write_robot

from restock.ingest.containers.open_recording import open_recording
from restock.train.twin.survey.mapping import placed_scans
from restock.train.twin.survey.poses import candidate_poses, choose_poses


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_scans_are_placed_at_robot_pose(tmp_path: Path, encoding: str) -> None:
    messages = drive()
    for _, _, kind, values in messages:
        if kind == "foxglove.LaserScan":
            values["frame_id"] = "base_link"
    path = write_robot(tmp_path / "run.mcap", encoding, messages)
    with open_recording(path) as recording:
        poses = choose_poses(candidate_poses(recording), lambda at_m: np.ones(len(at_m), np.bool_))
        assert poses is not None
        [scans] = placed_scans(recording, poses, None, None)
    assert len(scans) == 100  # of 200; the others were taken before the robot moved 5 cm
    assert scans.source.startswith("scans of /scan")
    centre = np.array([0.0, 2.0])  # of the driven circle
    radius = np.hypot(*(scans.origin_m - centre).T)
    assert radius == pytest.approx(2.0, abs=0.02)
    for origin, hit, order in zip(scans.origin_m, scans.hit_m, scans.order, strict=True):
        assert order.tolist() == list(range(BEAMS))
        beams = hit - origin
        assert np.hypot(*beams.T) == pytest.approx(WALL_M, abs=1e-6)
        angle = np.arctan2(*origin[::-1] - centre[::-1])
        bearing = angle + np.pi / 2 + np.linspace(-FIELD_RAD / 2, FIELD_RAD / 2, BEAMS)
        expected = np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        assert beams / WALL_M == pytest.approx(expected, abs=0.03)
