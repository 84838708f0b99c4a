"""Which way a lidar points is a guess where no transform says it: the profile and ingest say so."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.driven_robot import Drive, columns, ragged, typed_topics, write_topics

from restock.cli import main
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile, parse_profile

GUESS = "that the lidar's zero points straight ahead, as no transform places its frame, laser"
NOTE = "scan: no transform places laser, the frame of /scan"


def transforms(*edges: tuple[str, str, float], count: int = 1) -> tuple[str, TopicColumns]:
    """Parent, child and angle of each edge, in every one of so many messages."""
    parents, children, yaw = zip(*edges, strict=True)
    values: dict[str, Any] = {
        "header.frame_id": list(parents),
        "child_frame_id": list(children),
        "transform.rotation.z": np.sin(np.array(yaw) / 2),
        "transform.rotation.w": np.cos(np.array(yaw) / 2),
    }
    fields = {
        f"transforms[].{path}": ragged(
            [np.array([one] * count, object if path.endswith("_id") else None) for one in column]
        )
        for path, column in values.items()
    }
    return "tf2_msgs/msg/TFMessage", columns(np.arange(count) * 0.1, fields, stamped=False)


def drive(frame: str = "laser", **tf: tuple[str, TopicColumns]) -> dict[str, Any]:
    topics = typed_topics(Drive(6.0))
    scan = topics["/scan"][1]
    scan.fields["header.frame_id"] = np.full(len(scan), frame, object)
    for limit, value in (("range_min", 0.05), ("range_max", 8.0)):
        scan.fields[limit] = np.full(len(scan), value)
    return topics | {f"/{name}": one for name, one in tf.items()}


def notes_of(topics: Mapping[str, Any], folder: Path, profile: Any) -> list[str]:
    result = ingest(write_topics(topics, folder / "bag", storage="mcap"), profile, store=None)
    return [note for note in result.notes if "no transform places" in note]


MOVING = transforms(("odom", "base_link", 0.0), count=60)
STATIC = transforms(("base_link", "mast", 0.0), ("mast", "laser", np.pi / 2))


def test_a_proposal_says_that_the_direction_is_a_guess(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = {}
    for name, topics in (("lost", drive(tf=MOVING)), ("kept", drive(tf=MOVING, tf_static=STATIC))):
        bag = write_topics(topics, tmp_path / name, storage="mcap")
        out = tmp_path / f"{name}.toml"
        assert main(["profile", "new", str(bag), "--out", str(out)]) == 0
        found[name] = (
            " ".join(out.read_text().replace("\n# ", " ").split()),
            capsys.readouterr().err,
        )
    text, said = found["lost"]
    assert GUESS in text
    assert GUESS in said
    text, said = found["kept"]
    assert GUESS not in text + said
    assert "lidar_yaw_rad = 1.5708" in text
    # Of both together, the one that knows it.
    bags = [str(tmp_path / name) for name in ("lost", "kept")]
    assert main(["profile", "new", *bags, "--out", str(tmp_path / "both.toml")]) == 0
    assert GUESS not in capsys.readouterr().err
    assert load_profile(tmp_path / "both.toml").task.body.lidar_yaw_rad == pytest.approx(
        np.pi / 2, abs=1e-3
    )


def test_ingest_says_so_unless_profile_or_recording_tell(tmp_path: Path) -> None:
    profile = load_profile("warehouse_amr")
    (note,) = notes_of(drive(tf=MOVING), tmp_path / "lost", profile)
    assert note.startswith(NOTE)
    assert notes_of(drive(), tmp_path / "none", profile)
    assert not notes_of(drive(tf=MOVING, tf_static=STATIC), tmp_path / "kept", profile)
    assert not notes_of(drive("base_link", tf=MOVING), tmp_path / "base", profile)
    moving = transforms(("odom", "base_link", 0.0), ("base_link", "/laser", 0.0), count=60)
    assert not notes_of(drive(tf=moving), tmp_path / "moving", profile)


def test_a_profile_may_say_that_it_points_ahead(tmp_path: Path) -> None:
    from support.profile_texts import WAREHOUSE

    said = "[inputs.scan]\nlidar_at_m = [0.0, 0.0]\nlidar_yaw_rad = 0.0"
    profile = parse_profile(WAREHOUSE.replace("[inputs.scan]", said), where="p")
    assert not notes_of(drive(tf=MOVING), tmp_path, profile)
