"""Robots with only a 3-D lidar: a slice of the point clouds is read as a scan."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from support.driven_robot import Drive, seen_alike, write_bag
from support.ingested import ingested, steps_in
from support.profile_texts import WAREHOUSE

from restock.errors import ConfigError, RecordingError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.columns import Ragged, offsets_of
from restock.ingest.profile.profile import parse_profile
from restock.ingest.steps.aligned_inputs import align_inputs
from restock.ingest.steps.clouds import BEAM_RAD, cloud_reduction
from restock.ingest.steps.needs import read_topics
from restock.replay.trace.moment import seen_of

TYPES = get_typestore(Stores.ROS2_HUMBLE)
FIELDS = 'ranges_m = "ranges", angle_min_rad = "angle_min", angle_increment_rad = "angle_increment"'
CLOUD = f"""[inputs.scan]
topic = "/points"
type = "sensor_msgs/msg/PointCloud2"
max_age_s = 0.5
height_m = [-0.2, 0.6]
fields = {{ {FIELDS} }}

"""
PROFILE = re.sub(r"(?ms)^\[inputs\.scan\].*?(?=^\[)", CLOUD, WAREHOUSE)
SOURCE = parse_profile(PROFILE, where="cloud.toml").inputs.scan
PLAIN = [("x", "f4"), ("y", "f4"), ("z", "f4")]
KINDS = {"f4": 7, "f8": 8, "i2": 3}


def pack_points(
    xyz: np.ndarray,
    layout: Any = PLAIN,
    order: str = "<",
    step: int = 0,
    rows: int = 1,
    pad: int = 0,
) -> dict[str, Any]:
    """Return the fields of a cloud of points (P, 3) in this layout."""
    kind = np.dtype([(name, order + one) for name, one in layout])
    if step:
        formats, offsets = zip(*(kind.fields[name] for name in kind.names), strict=True)
        padded = {"names": kind.names, "formats": formats, "offsets": offsets, "itemsize": step}
        kind = np.dtype(padded)
    points = np.zeros(len(xyz), kind)
    for place, axis in enumerate("xyz"):
        if axis in kind.names:
            points[axis] = xyz[:, place]
    lines = points.reshape(rows, -1)
    data = b"".join(line.tobytes() + b"\xff" * pad for line in lines)
    return {
        "height": rows,
        "width": lines.shape[1],
        "fields": [(name, kind.fields[name][1], KINDS[one]) for name, one in layout],
        "is_bigendian": order == ">",
        "point_step": kind.itemsize,
        "row_step": lines.shape[1] * kind.itemsize + pad,
        "data": np.frombuffer(data, np.uint8),
    }


def read_scans(clouds: list[dict[str, Any]], source: Any = SOURCE) -> dict[str, np.ndarray]:
    """Return the scans read from the columns of these clouds."""
    columns: dict[str, Any] = {}
    for path, place in (("name", 0), ("offset", 1), ("datatype", 2)):
        values = [np.array([field[place] for field in cloud["fields"]]) for cloud in clouds]
        offsets = offsets_of(np.array([len(value) for value in values]))
        columns[f"fields[].{path}"] = Ragged(np.concatenate(values), offsets)
    for path in ("height", "width", "point_step", "row_step", "is_bigendian"):
        columns[path] = np.array([cloud[path] for cloud in clouds])
    data = [cloud["data"] for cloud in clouds]
    columns["data"] = Ragged(np.concatenate(data), offsets_of(np.array([len(d) for d in data])))
    return cloud_reduction(source, 0.05).apply(columns)


def random_points(count: int = 1200, seed: int = 0) -> np.ndarray:
    """Return points all around, from the floor to above the robot, some of them NaN."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform((-6, -6, -1), (6, 6, 2), (count, 3)).astype(np.float32)
    xyz[::7, 1] = np.nan
    return xyz


def test_beam_range_is_nearest_point_of_slice():
    xyz = random_points().astype(np.float64)
    expected = np.full(720, np.inf)
    for x, y, z in xyz[np.isfinite(xyz).all(axis=1)]:  # point by point, as the ROS node does
        if -0.2 <= z <= 0.6 and np.hypot(x, y) >= 0.05:
            beam = min(int((np.arctan2(y, x) + np.pi) / BEAM_RAD), 719)
            expected[beam] = min(expected[beam], np.hypot(x, y))
    found = read_scans([pack_points(xyz, [("x", "f8"), ("y", "f8"), ("z", "f8")])])
    np.testing.assert_allclose(found["ranges"][0], expected, rtol=1e-6)
    assert np.isfinite(expected).sum() > 100
    assert found["angle_min"][0] == pytest.approx(BEAM_RAD / 2 - np.pi)


def test_point_layout_does_not_change_scan():
    xyz = random_points()
    found = read_scans(
        [
            pack_points(xyz),
            pack_points(
                xyz, [("intensity", "f4"), ("z", "f4"), ("y", "f4"), ("ring", "i2"), ("x", "f4")]
            ),
            pack_points(xyz, step=32),
            pack_points(xyz, order=">"),
            pack_points(xyz, rows=16, pad=12),
            pack_points(xyz, [("x", "f8"), ("y", "f8"), ("z", "f8")], order=">"),
        ]
    )
    assert (found["ranges"] == found["ranges"][0]).all()


def test_bearing_limits_and_upside_down_lidar():
    wall = np.array([[2.0, 1.0, 0.5], [2.0, -1.0, 0.5], [-3.0, 0.0, 0.5]])
    ahead = {"angle_rad": (-np.pi / 2, np.pi / 2)}
    (seen,) = read_scans([pack_points(wall)], structs.replace(SOURCE, **ahead))["ranges"]
    assert seen.shape == (360,)
    assert np.isfinite(seen).sum() == 2
    turned = {"upside_down": True, "height_m": (-0.6, -0.4)}
    (seen,) = read_scans([pack_points(wall)], structs.replace(SOURCE, **turned))["ranges"]
    assert np.isfinite(seen).sum() == 3


WHOLE, NOTHING = pack_points(random_points()), np.full((4, 3), np.nan)
UNREAD = "cut short, or has no x, y, z as floats"
UNSEEN = "no beam has a valid range"
UNUSABLE = {
    "truncated": (WHOLE | {"data": WHOLE["data"][:-5]}, UNREAD),
    "without_z": (pack_points(random_points(), PLAIN[:2]), UNREAD),
    "integers": (pack_points(np.ones((64, 3)), [(axis, "i2") for axis in "xyz"]), UNREAD),
    "offset_beyond_point": (WHOLE | {"point_step": 8}, UNREAD),
    "overlapping_rows": (pack_points(random_points(), rows=16) | {"row_step": 0}, UNREAD),
    "empty": (pack_points(np.zeros((0, 3))), UNSEEN),
    "all_nan": (pack_points(NOTHING), UNSEEN),
}


def write_cloud_bag(folder: Path, spoilt: dict[str, Any] | None = None, frame: str = "") -> Path:
    """Write a drive whose scans are clouds; those after 3 s are `spoilt`."""
    folder.mkdir()
    drive, bag = write_bag(Drive(goals=[(0.0, 3.0, 1.0)]), folder / "drive"), folder / "bag"
    point = TYPES.types["sensor_msgs/msg/PointField"]
    writer = Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP)
    with AnyReader([drive]) as reader, writer:
        made = {
            c.id: writer.add_connection(c.topic, c.msgtype, typestore=TYPES)
            for c in reader.connections
            if c.topic != "/scan"
        }
        to = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=TYPES)
        for connection, now_ns, raw in reader.messages():
            if connection.topic != "/scan":
                writer.write(made[connection.id], now_ns, raw)
                continue
            scan = reader.deserialize(raw, connection.msgtype)
            bearing = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
            level = np.stack([scan.ranges * np.cos(bearing), scan.ranges * np.sin(bearing)], axis=1)
            low, high = ((level, z) for z in (0.1, 1.5))
            xyz = np.concatenate(
                [
                    np.column_stack([at * (1 if z < 1 else 0.1), np.full(len(at), z)])
                    for at, z in (low, high)
                ]
            ).astype(np.float32)
            late = now_ns - reader.start_time > 3 * 10**9
            cloud = spoilt if spoilt is not None and late else pack_points(xyz)
            names = [point(name=n, offset=o, datatype=k, count=1) for n, o, k in cloud["fields"]]
            message = TYPES.types["sensor_msgs/msg/PointCloud2"](
                header=replace(scan.header, frame_id=frame),
                is_dense=False,
                **cloud | {"fields": names},
            )
            writer.write(to, now_ns, TYPES.serialize_cdr(message, to.msgtype))
    return bag


def test_cloud_and_scan_give_same_clearance(tmp_path):
    bag = write_cloud_bag(tmp_path / "clouds")
    by_cloud = steps_in(bag, PROFILE)
    by_scan = steps_in(tmp_path / "clouds" / "drive", WAREHOUSE)
    assert by_cloud.problem == by_scan.problem
    for name in ("sector_clearance_m", "clearance_ahead_m", "plan_return_m"):
        np.testing.assert_allclose(by_cloud.signals[name], by_scan.signals[name], atol=0.02)
    # The scan that a row shows comes from the cloud, too.
    profile = parse_profile(PROFILE, where="cloud.toml")
    with open_recording(bag) as recording:
        start_ns = recording.span_ns[0]
        aligned = align_inputs(profile, read_topics(recording, profile, reduced=False))
        seen = seen_of(aligned, start_ns, start_ns + 2 * 10**9).scans
    assert all(scan is None or len(scan.ranges_m) == 720 for scan in seen)
    assert any(scan is not None for scan in seen)


@pytest.mark.parametrize("kind", UNUSABLE)
def test_unusable_cloud_drops_steps_with_reason(kind, tmp_path):
    spoilt, reason = UNUSABLE[kind]
    problems = steps_in(write_cloud_bag(tmp_path / "clouds", spoilt), PROFILE).problem
    assert set(problems) == {"", f"scan: {reason}"}


def test_cloud_in_fixed_frame_is_rejected(tmp_path):
    bag = write_cloud_bag(tmp_path / "clouds", frame="robot1/odom")
    with pytest.raises(RecordingError, match="its points in the frame robot1/odom"):
        steps_in(bag, PROFILE)


def test_live_observer_and_ingest_agree_on_clouds(tmp_path):
    bag = write_cloud_bag(tmp_path / "clouds", UNUSABLE["truncated"][0])
    alike = seen_alike(bag, parse_profile(PROFILE, where="p"), steps_in(bag, PROFILE))
    assert min(alike[""], alike[f"scan: {UNREAD}"]) > 5


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("height_m = [-0.2, 0.6]\n", "", r"height_m = \[LOW, HIGH\] above the lidar"),
        ("[-0.2, 0.6]", "[0.6, -0.2]", r"height_m` must be \[LOW, HIGH\]"),
        ('"ranges"', '"data"', 'fields = { ranges_m = "ranges"'),
        ("PointCloud2", "LaserScan", "height_m` applies only to sensor_msgs/msg/PointCloud2"),
    ],
)
def test_invalid_cloud_settings_are_rejected(old, new, message):
    with pytest.raises(ConfigError, match=message):
        parse_profile(PROFILE.replace(old, new, 1), where="cloud.toml")


def test_proposal_contains_cloud_settings(tmp_path, shell):
    bag, profile = write_cloud_bag(tmp_path / "clouds"), tmp_path / "robot.toml"
    assert "a slice can be read as a scan" in shell.err(
        "profile", "new", bag, "--out", profile, code=0
    )
    text = profile.read_text().replace("sectors = 0", "sectors = 36")
    table = re.search(r"(?m)^# \[inputs\.scan\].*(\n# .*)+", text)[0]
    own = table[2:].replace("\n# ", "\n").replace("[LOW, HIGH]", "[-0.2, 0.6]")
    profile.write_text(text.replace(table, own))
    with ingested(bag, profile, tmp_path / "s") as store:
        query = "SELECT count(*) > 10, count(clearance_m) = count(*) FROM transitions"
        assert store.sql(query).fetchall() == [(True, True)]
