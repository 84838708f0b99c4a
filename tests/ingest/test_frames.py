"""Poses through /tf and /tf_static: hand values, holds, changed trees, missing transforms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.driven_robot import START_NS, Drive, columns
from support.paths import ROOT, SHARED
from support.profile_texts import framed

from restock.errors import ConfigError, RecordingError
from restock.ingest.decoding.columns import Ragged, TopicColumns, offsets_of
from restock.ingest.profile.profile import load_profile, parse_profile
from restock.ingest.profile.signal_paths import FIELDS
from restock.ingest.profile.tables import Clock, Frames
from restock.ingest.steps.align import NS, align
from restock.ingest.steps.episodes import steps_of
from restock.ingest.steps.frames import Edges, Tree, rotations

SAMPLE = ROOT / "sample_logs" / "amr_monday.mcap"

# (time s, parent, child, x, y, z, yaw)
Line = tuple[float, str, str, float, float, float, float]


def transforms(
    lines: list[Line], *, latency_s: float = 0.002, ahead_s: float = 0.0
) -> TopicColumns:
    """Return a topic with one transform per message, in the order of the lines."""
    singles = offsets_of(np.ones(len(lines), np.int64))
    stamp = START_NS + np.rint(np.array([line[0] for line in lines]) * 1e9).astype(np.int64)
    half = np.array([line[6] for line in lines]) / 2
    values = {
        "header.stamp": stamp + round(ahead_s * 1e9),
        "header.frame_id": np.array([line[1] for line in lines], object),
        "child_frame_id": np.array([line[2] for line in lines], object),
        **{f"transform.translation.{a}": np.array([line[3 + i] for line in lines])
           for i, a in enumerate("xyz")},
        "transform.rotation.x": np.zeros(len(lines)),
        "transform.rotation.y": np.zeros(len(lines)),
        "transform.rotation.z": np.sin(half),
        "transform.rotation.w": np.cos(half),
    }  # fmt: skip
    fields = {f"transforms[].{path}": Ragged(column, singles) for path, column in values.items()}
    assert set(fields) == set(FIELDS)
    log = stamp + round(latency_s * 1e9)
    return TopicColumns(log, log, fields)


def build_tree(frames: Frames, moving: list[Line], still: list[Line], **how: float) -> Tree:
    topics = {"/tf_static": transforms(still)}
    if moving:
        topics["/tf"] = transforms(moving, **how)
    edges = Edges.of(frames, topics)
    clock = columns(np.arange(-1, 11, 0.1), {})
    names = frozenset(edges.topics)
    segments, _ = align({"/clock": clock, **edges.topics}, Clock(), edges.static, names)
    return Tree(frames, edges, segments)


def stamps_at(*seconds: float) -> list[np.ndarray]:
    return [START_NS + np.rint(np.array(seconds) * 1e9).astype(np.int64)]


def test_chain_of_transforms_by_hand():
    """Odom is at (10, 0) turned left, the robot at (2, 1) in odom, its body 0.5 m ahead."""
    tree = build_tree(
        Frames(base="body"),
        [(0.0, "map", "odom", 10, 0, 0, np.pi / 2), (0.0, "odom", "base_link", 2, 1, 0, 0.0)],
        [(0.0, "base_link", "body", 0.5, 0, 0.2, 0.0)],
    )
    found = tree.place("body", stamps_at(0.1))
    assert found.problem.tolist() == [""]
    assert found.translation_m[0] == pytest.approx([9.0, 2.5, 0.2])
    assert found.yaw_rad[0] == pytest.approx(np.pi / 2)


def test_inverse_transform_by_hand():
    """The fixed frame may lie below the other frame in the tree."""
    lines: list[Line] = [
        (0.0, "odom", "map", 1, 2, 0, np.pi / 2),
        (0.0, "odom", "base", 1, 5, 0, 0),
    ]
    found = build_tree(Frames(base="base"), lines, []).place("base", stamps_at(0.1))
    # 3 m along y of odom, from the map's origin, is 3 m along x of the map.
    assert found.translation_m[0] == pytest.approx([3.0, 0.0, 0.0])
    assert found.yaw_rad[0] == pytest.approx(-np.pi / 2)


def test_rotations_match_quaternions():
    rng = np.random.default_rng(5)
    quaternion = rng.normal(size=(4, 50))
    found = rotations(*quaternion)
    assert np.einsum("nij,nkj->nik", found, found) == pytest.approx(np.tile(np.eye(3), (50, 1, 1)))
    assert np.linalg.det(found) == pytest.approx(np.ones(50))
    x, y, z, w = quaternion / np.linalg.norm(quaternion, axis=0)
    # Rotating e_x by q: the imaginary part of q i q*.
    expected = [w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)]
    assert pytest.approx(np.array(expected)) == found[:, :, 0].T
    assert np.isnan(rotations(*np.zeros((4, 1)))).all()


def test_transforms_are_held_from_their_stamp():
    moving: list[Line] = [(0.0, "map", "odom", 0, 0, 0, 0)]
    moving += [(t, "odom", "base_link", t, 0, 0, 0) for t in (0.0, 0.1, 0.2, 0.3)]
    tree = build_tree(Frames(max_age_s=1.0), moving, [])
    found = tree.place("base_link", stamps_at(-0.05, 0.0, 0.15, 0.29, 0.3, 1.0, 1.29, 1.31))
    assert found.translation_m[1:5, 0] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert found.problem[0] == "no transform from map to base_link yet"
    assert found.problem[5] == ""  # map -> odom is one second old
    assert found.problem[6] == "transform map -> odom: stale"
    assert set(found.problem[1:5]) == {""}
    assert found.stamp_ns[2] == START_NS + NS // 10  # stamp of the newest transform of the chain


def test_only_static_transforms_hold_across_clock_jump():
    log = np.arange(0, 10, 0.1)
    clock = columns(log, {})
    later = log >= 5
    clock.fields["header.stamp"][later] -= 100 * NS  # the clock is set back during the recording
    topics = {
        "/tf": transforms([(1.0, "map", "odom", 7, 0, 0, 0)]),
        "/tf_static": transforms([(-600.0, "odom", "base_link", 1, 0, 0, 0)]),
    }
    edges = Edges.of(Frames(), topics)
    segments, report = align(
        {"/clock": clock, **edges.topics}, Clock(), edges.static, frozenset(edges.topics)
    )
    assert report.jumps == 1
    tree = Tree(Frames(max_age_s=1e6), edges, segments)
    after = START_NS - 93 * NS
    found = tree.place("base_link", [*stamps_at(2.0), np.array([after])])
    assert found.problem.tolist() == ["", "no transform from map to odom yet"]
    assert found.translation_m[0, 0] == 8.0


def test_transform_with_future_stamp_counts_from_reception():
    """Localisation stamps map -> odom ahead, which must not affect the clock offset either."""
    moving: list[Line] = [(t, "map", "base_link", t, 0, 0, 0) for t in np.arange(0, 5, 0.5)]
    tree = build_tree(Frames(), moving, [], ahead_s=1.0)
    found = tree.place("base_link", stamps_at(0.1, 1.01, 2.6))
    assert found.translation_m[:, 0].tolist() == [0.0, 1.0, 2.5]
    assert tree.segments[0].clock_map.offset_ns == 2_000_000


def test_frame_with_new_parent_is_followed():
    moving: list[Line] = [
        (0.0, "map", "odom", 5, 0, 0, 0),
        (0.0, "map", "lift", 100, 0, 0, 0),
        *((t, "odom" if t < 1 else "lift", "base_link", 1, 0, 0, 0) for t in (0.0, 0.9, 1.0, 1.9)),
    ]
    tree = build_tree(Frames(max_age_s=5), moving, [])
    assert tree.edges.parent_changes == 1
    assert tree.place("base_link", stamps_at(0.5, 1.5)).translation_m[:, 0].tolist() == [6.0, 101.0]


def test_loop_of_frames_terminates():
    moving: list[Line] = [(0.0, "a", "base_link", 1, 0, 0, 0), (0.0, "base_link", "a", 1, 0, 0, 0)]
    assert (
        "no transform"
        in build_tree(Frames(), moving, []).place("base_link", stamps_at(0.1)).problem[0]
    )


@settings(max_examples=40)
@given(st.lists(st.tuples(*[st.sampled_from(["map", "/map", "odom", "/odom", "arm"])] * 2)))
def test_transforms_are_grouped_by_frame_in_order(pairs: list[tuple[str, str]]) -> None:
    lines: list[Line] = [(0.1 * n, *pair, n, 0, 0, 0) for n, pair in enumerate(pairs)]
    edges = Edges.of(Frames(), {"/tf": transforms(lines)})
    names = {child.strip("/") for _, child in pairs}
    assert list(edges.topics) == [f"/tf {name}" for name in sorted(names)]
    for name in names:
        own = [n for n, (_, child) in enumerate(pairs) if child.strip("/") == name]
        fields = edges.topics[f"/tf {name}"].fields
        assert fields["translation.x"].tolist() == own
        assert fields["parent"].tolist() == [pairs[n][0].strip("/") for n in own]


def test_zero_quaternion_is_reported_as_not_finite():
    topic = transforms([(0.0, "map", "base_link", 3, 0, 0, 0)])
    topic.fields["transforms[].transform.rotation.w"].values[:] = 0
    edges = Edges.of(Frames(), {"/tf": topic})
    clock = columns(np.arange(0, 1, 0.1), {})
    segments, _ = align(
        {"/c": clock, **edges.topics}, Clock(), frozenset(), frozenset(edges.topics)
    )
    found = Tree(Frames(), edges, segments).place("base_link", stamps_at(0.1))
    assert found.problem.tolist() == ["transform map -> base_link: not finite"]


# In a recording.


def drive_with_transforms(drive: Drive, *, until_s: float = 99.0) -> dict[str, TopicColumns]:
    """Return the drive with map -> odom -> base_link at 10 Hz and odom turned by half a turn."""
    times = [t for t in np.arange(0, drive.duration_s, 0.1).tolist() if t < until_s]
    lines: list[Line] = []
    for t in times:
        lines.append((t, "map", "odom", 20, 0, 0, np.pi))
        lines.append((t, "odom", "base_link", 20 - float(drive.x_at(t)), -1, 0, np.pi))
    return drive.topics() | {"/tf": transforms(lines)}


def test_steps_from_transforms_match_pose_topic():
    drive = Drive()
    topics = drive_with_transforms(drive)
    by_topic = steps_of(load_profile("warehouse_amr"), topics)
    del topics["/amcl_pose"]
    by_frames = steps_of(parse_profile(framed(), where="p"), topics)
    # differs at the border of two sectors
    for name in by_topic.signals.keys() - {"clearance_ahead_m"}:
        column = by_topic.signals[name]
        assert by_frames.signals[name] == pytest.approx(column, abs=1e-9, nan_ok=True), name
    assert by_frames.problem == by_topic.problem


def test_stale_transform_drops_ticks_and_is_named():
    steps = steps_of(
        parse_profile(framed(), where="p"), drive_with_transforms(Drive(), until_s=3.0)
    )
    reasons = [problem for problem in steps.problem if problem]
    assert set(reasons) == {"pose: transform odom -> base_link: stale"}
    assert reasons == steps.problem[-len(reasons) :]


def test_missing_transform_is_reported():
    topics = Drive().topics()
    del topics["/amcl_pose"]
    topics["/tf"] = transforms([(0.0, "odom", "base_footprint", 0, 0, 0, 0)])
    with pytest.raises(RecordingError) as error:
        steps_of(parse_profile(framed(), where="p"), topics)
    assert "no transform joins base_link (above base_link) to map" in str(error.value)
    assert "there are odom -> base_footprint" in str(error.value)


def test_goals_and_plans_are_transformed_to_fixed_frame():
    drive = Drive()
    topics = drive_with_transforms(drive)
    usual = steps_of(parse_profile(framed(), where="p"), topics)
    for topic in ("/goal_pose", "/plan"):
        fields = dict(topics[topic].fields)
        for axis in "xy":
            path = next(p for p in fields if p.endswith(f"position.{axis}"))
            column = fields[path]
            offset = 20.0 if axis == "x" else 0.0  # odom's origin, turned by half a turn
            fields[path] = (
                Ragged(offset - np.asarray(column.values), column.offsets)
                if isinstance(column, Ragged)
                else offset - column
            )
        fields["header.frame_id"] = np.array(["odom", None], object)[:-1]
        topics[topic] = TopicColumns(
            topics[topic].log_time_ns, topics[topic].publish_time_ns, fields
        )
    moved = steps_of(parse_profile(framed(), where="p"), topics)
    # The transform at the goal's own time is held, so there is no difference from its age.
    for name in ("goal_distance_m", "route_remaining_m", "waypoint_near_x_m"):
        assert moved.signals[name] == pytest.approx(usual.signals[name], abs=1e-9), name
    assert moved.route_problem == usual.route_problem


def test_goal_in_unconnected_frame_is_ignored():
    topics = drive_with_transforms(Drive())
    topics["/goal_pose"].fields["header.frame_id"] = np.array(["dock", None], object)[:-1]
    steps = steps_of(parse_profile(framed(), where="p"), topics)
    assert set(steps.route_problem) == {"goal: no transform from map to dock yet"}


def test_differing_frames_without_transforms_are_noted():
    topics = Drive().topics()
    for topic, frame in (("/goal_pose", "map"), ("/plan", "odom")):
        topics[topic].fields["header.frame_id"] = np.array([frame, None], object)[:-1]
    steps = steps_of(load_profile("warehouse_amr"), topics)
    assert "goal map; plan odom: they are treated as one frame" in steps.notes[0]


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ('[frames]\nbase = "map"\n[clock]', "fixed and base are the same frame"),
        ("[frames]\nmax_age_s = 0\n[clock]", "max_age_s must be above 0"),
        ("[frames]\nfixd = 3\n[clock]", "unknown key `frames.fixd`"),
        ("[clock]", "`inputs.pose` is missing, and so is `frames`"),
    ],
)
def test_invalid_frames_table_is_rejected(frames, message):
    with pytest.raises(ConfigError) as error:
        parse_profile(framed(frames=frames), where="p")
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        ("/odom", "/odom holds nav_msgs/msg/Odometry, not transforms (frames)"),
        ("/tff", "no message of /tff or /tff (pose, by [frames])"),
    ],
)
def test_wrong_transform_topic_is_reported(topic, message, tmp_path, shell):
    profile = tmp_path / "p.toml"
    frames = f'[frames]\ntopic = "{topic}"\nstatic_topic = "{topic}"\n[clock]'
    profile.write_text(framed(frames=frames))
    assert message in shell.err("profile", "check", profile, SAMPLE)


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
@pytest.mark.parametrize("bag", ["turtlebot3-sim-humble", "turtlebot3-sim-sparse-cmd"])
def test_turtlebot_transforms_match_odometry(bag):
    """odom -> base_footprint equals /odom, on both clocks; base_link is 1 cm above it."""
    from restock.ingest.containers.open_recording import open_recording

    pose = [f"pose.pose.position.{axis}" for axis in "xyz"]
    turn = [f"pose.pose.orientation.{axis}" for axis in "xyzw"]
    with open_recording(SHARED / bag) as recording:
        wanted = {"/tf": FIELDS, "/tf_static": FIELDS, "/odom": [*pose, *turn, "header.stamp"]}
        read = recording.read(wanted)
    frames = Frames(fixed="odom", max_age_s=0.001)
    edges = Edges.of(frames, read)
    assert edges.missing("base_link", "odom") is None
    assert "map" in str(edges.missing("base_link", "map"))
    segments, _ = align(
        {"/odom": read["/odom"], **edges.topics}, Clock(), edges.static, frozenset(edges.topics)
    )
    times = np.asarray(read["/odom"].fields["header.stamp"])
    found = Tree(frames, edges, segments).place("base_link", [times])
    known = found.problem == ""
    assert known.sum() > 0.95 * len(times)
    odometry_m = np.stack([np.asarray(read["/odom"].fields[path]) for path in pose], axis=1)
    assert found.translation_m[known, :2] == pytest.approx(odometry_m[known, :2], abs=1e-3)
    assert found.translation_m[known, 2] - odometry_m[known, 2] == pytest.approx(0.01, abs=1e-3)
    x, y, z, w = (np.asarray(read["/odom"].fields[path])[known] for path in turn)
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    assert np.abs(np.angle(np.exp(1j * (found.yaw_rad[known] - yaw)))).max() < 1e-3


def test_message_with_many_transforms_or_none():
    both = transforms([(0.0, "map", "odom", 1, 0, 0, 0), (0.0, "odom", "base_link", 2, 0, 0, 0)])
    fields = {
        path: Ragged(column.values, np.array([0, 2, 2], np.int64))
        for path, column in both.fields.items()
        if isinstance(column, Ragged)
    }
    topic = TopicColumns(both.log_time_ns, both.publish_time_ns, fields)
    edges = Edges.of(Frames(), {"/tf": topic})
    assert edges.parents == {"base_link": ["odom"], "odom": ["map"]}
    assert [len(columns) for columns in edges.topics.values()] == [1, 1]
    assert list(edges.only({"odom"}).parents) == ["odom"]
