"""Robots with several lidars or one off centre: clearance equals that of one in the middle."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.driven_robot import Drive, columns, scans, seen_alike, transforms, without, write_bag
from support.ingested import proposed, steps_in
from support.profile_texts import WAREHOUSE

from restock.errors import ConfigError, RecordingError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import load_profile, parse_profile
from restock.ingest.steps.aligned_inputs import align_inputs
from restock.ingest.steps.episodes import Steps, steps_of
from restock.ingest.steps.needs import read_topics
from restock.ingest.task.surroundings import MovedMap, outline_reach, with_unseen
from restock.replay.trace.moment import seen_of

TASK = load_profile("warehouse_amr").task
LEFT_M, RIGHT_M = 2.0, 0.2  # y of the walls: the robot drives along y = 1
BEAMS = 720
Place = tuple[float, float, float]  # x ahead, y left, yaw of its zero angle
FRONT: Place = (0.28, 0.22, np.pi / 4)
REAR: Place = (-0.28, -0.22, -3 * np.pi / 4)
THREE_QUARTERS = 1.5 * np.pi


@dataclass
class CorridorDrive(Drive):
    """Drive between two walls, past a post, with lidars `mounted` by topic."""

    mounted: tuple[tuple[str, Place], ...] = (("/scan_front", FRONT), ("/scan_rear", REAR))
    field_rad: float = THREE_QUARTERS  # field of view of each lidar
    roll_rad: float = 0.0  # roll of the last lidar

    def topics(self) -> dict[str, TopicColumns]:
        found = super().topics()
        scan = found.pop("/scan")
        times_s = (scan.fields["header.stamp"] - 1_700_000_000 * 10**9) * 1e-9
        for index, (topic, place) in enumerate(self.mounted):
            hanging = self.roll_rad if index == len(self.mounted) - 1 else 0.0
            found[topic] = self.scan(times_s, place, f"laser{index}", upside_down=hanging != 0)
        edges = [("base_link", f"laser{n}", *place) for n, (_, place) in enumerate(self.mounted)]
        edges[-1] += (self.roll_rad,)
        found["/tf_static"] = transforms(np.zeros(1), *edges)[1]
        return found

    def scan(
        self, times_s: Any, place: Place, frame: str, *, upside_down: bool = False
    ) -> TopicColumns:
        step = self.field_rad / BEAMS
        bearing = np.arange(BEAMS) * step - self.field_rad / 2  # in the lidar's frame
        ranges = np.stack([cast_rays(self.x_at(time) - 1.0, place, bearing) for time in times_s])
        fields = scans(ranges)
        sign = -1 if upside_down else 1
        fields["angle_min"] = np.full(len(times_s), sign * bearing[0])
        fields["angle_max"] = np.full(len(times_s), sign * bearing[-1])
        fields["angle_increment"] = np.full(len(times_s), sign * step)
        fields["range_min"] = np.full(len(times_s), 0.05)
        fields["range_max"] = np.full(len(times_s), 8.0)
        fields["header.frame_id"] = np.full(len(times_s), frame, object)
        return columns(times_s, fields)

    def bag(self, folder: Path) -> Path:
        return write_bag(self, folder, storage="mcap")


def cast_rays(moved_m: float, place: Place, bearing: Any) -> Any:
    """Return ranges (B,) to the walls, a post beside the path and a post behind its start."""
    x, y = 1.0 + moved_m + place[0], 1.0 + place[1]
    way = np.stack([np.cos(bearing + place[2]), np.sin(bearing + place[2])])
    with np.errstate(divide="ignore"):
        ranges = np.abs(np.where(way[1] > 0, LEFT_M - y, RIGHT_M - y) / way[1])
    for post in ((5.0, 1.7), (0.1, 0.95)):
        to = np.array([post[0] - x, post[1] - y])
        along = to @ way
        half = np.sqrt(np.maximum(0.1**2 - (to @ to - along**2), 0.0))
        hit = (half > 0) & (along > half)
        ranges = np.where(hit, np.minimum(ranges, along - half), ranges)
    return np.where(ranges < 8.0, ranges, np.inf)


def two_lidars(front: str = "", rear: str = "") -> str:
    """Return the shipped profile with the two lidars of `CorridorDrive`."""
    start, end = WAREHOUSE.index("[inputs.scan]"), WAREHOUSE.index("[inputs.goal]")
    table = WAREHOUSE[start:end].replace("optional = true\n", "")

    def scan_table(name: str, topic: str, place: Place, more: str) -> str:
        at = f"lidar_at_m = [{place[0]}, {place[1]}]\nlidar_yaw_rad = {place[2]}\n{more}\n"
        return table.replace("[inputs.scan]", f"[inputs.{name}]\n{at}").replace('"/scan"', topic)

    both = scan_table("scan", '"/scan_front"', FRONT, front) + scan_table(
        "scan_2", '"/scan_rear"', REAR, rear
    )
    return WAREHOUSE[:start] + both + WAREHOUSE[end:]


def sectors_of(steps: Steps) -> Any:
    """Return clearance (T, K) at the usable ticks."""
    return steps.signals["sector_clearance_m"][[problem == "" for problem in steps.problem]]


@settings(max_examples=60)
@given(
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.4, 0.4), st.floats(-3.2, 3.2)),
    st.floats(-0.2, 0.2),
    st.integers(0, 99),
)
def test_beam_is_assigned_to_sector_of_its_end_point(place, ahead_m, seed):
    body = msgspec.structs.replace(TASK.body, lidar_x_m=ahead_m)
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(-1, 8, (3, 40))
    ranges[rng.random(ranges.shape) < 0.2] = rng.choice([np.inf, np.nan])
    bearings = -2.0 + 0.1 * np.arange(40)
    moved = MovedMap.build(bearings + place[2], 36, body, place[:2])
    found = moved.clearance(ranges, 0.1, 4.0)
    expected = np.full((3, 36), np.nan)
    farthest = 4.0 + float(np.hypot(place[0] - ahead_m, place[1]))
    for row in range(3):
        for bearing, reached in zip(bearings.tolist(), ranges[row].tolist(), strict=True):
            valid = 0.1 <= reached <= farthest
            reached = reached if valid else farthest
            x = place[0] + reached * np.cos(bearing + place[2]) - ahead_m
            y = place[1] + reached * np.sin(bearing + place[2])
            seen = float(np.arctan2(y, x))
            near = np.hypot(x, y) - outline_reach(np.array([seen]), body)[0]
            sector = min(int((seen + np.pi) * (36 / (2 * np.pi))), 35)
            near = min(max(near, 0.0), 4.0) if valid else 4.0
            expected[row, sector] = np.fmin(expected[row, sector], near)
    np.testing.assert_allclose(found, expected, atol=1e-9)


@settings(max_examples=60)
@given(st.lists(st.sampled_from([0.5, 1.5, None]), min_size=4, max_size=24))
def test_empty_sectors_take_nearest_neighbour_clearance(given):
    """Only gaps of a few sectors are filled, also across the first sector."""
    count = len(given)
    found = with_unseen(np.array([given], np.float64), 4.0)[0]
    for sector, value in enumerate(given):
        if value is not None:
            assert found[sector] == value
            continue
        sides = []
        for way in (-1, 1):
            steps = [
                d for d in range(1, count + 1) if given[(sector + way * d) % count] is not None
            ]
            sides.append(min(steps, default=99))
        if sum(sides) - 1 > 3:
            assert found[sector] == 4.0
        else:
            known = [given[(sector - sides[0]) % count], given[(sector + sides[1]) % count]]
            assert found[sector] == min(
                clearance_m for clearance_m in known if clearance_m is not None
            )


def test_two_corner_lidars_match_one_central_lidar():
    """Neither corner lidar alone matches."""

    def seen_in(drive: CorridorDrive, text: str) -> Any:
        return sectors_of(steps_of(parse_profile(text, where="p"), drive.topics()))

    central = CorridorDrive(mounted=(("/scan", (0.0, 0.0, 0.0)),), field_rad=2 * np.pi)
    expected, found = seen_in(central, WAREHOUSE), seen_in(CorridorDrive(), two_lidars())
    assert found.shape == expected.shape
    assert len(found) > 10
    apart_m = np.abs(found - expected)
    assert (apart_m < 0.1).mean() > 0.99  # the rest is at the edges of a post
    assert apart_m.mean() < 0.01
    for topic, place in (("/scan_front", FRONT), ("/scan_rear", REAR)):
        alone = two_lidars()
        start, end = alone.index("[inputs.scan_2]"), alone.index("[inputs.goal]")
        alone = alone[:start] + alone[end:]
        alone = alone.replace("/scan_front", topic)
        alone = alone.replace(f"[{FRONT[0]}, {FRONT[1]}]", f"[{place[0]}, {place[1]}]")
        alone = alone.replace(f"lidar_yaw_rad = {FRONT[2]}", f"lidar_yaw_rad = {place[2]}")
        seen = seen_in(CorridorDrive(), alone)
        assert (np.abs(seen - expected) < 0.05).mean() < 0.9


def test_tick_without_one_lidar_is_dropped(tmp_path):
    class Silenced(CorridorDrive):
        def topics(self) -> dict[str, TopicColumns]:
            found = super().topics()
            rear = found["/scan_rear"]
            early = rear.log_time_ns < rear.log_time_ns[0] + 2 * 10**9
            return found | {"/scan_rear": without(rear, early)}

    steps = steps_of(parse_profile(two_lidars(), where="p"), Silenced().topics())
    reasons = Counter(steps.problem)
    assert reasons["scan_2: stale"] > 10
    assert reasons[""] > 5
    absent = CorridorDrive(mounted=(("/scan_front", FRONT),)).bag(tmp_path / "absent")
    with pytest.raises(RecordingError, match="/scan_rear"):
        steps_in(absent, two_lidars())


def test_live_observer_and_ingest_agree_on_two_lidars(tmp_path):
    bag, text = CorridorDrive().bag(tmp_path / "bag"), two_lidars()
    assert seen_alike(bag, parse_profile(text, where="p"), steps_in(bag, text))[""] > 10


def test_moment_shows_joined_scan_from_centre(tmp_path):
    bag, profile = CorridorDrive().bag(tmp_path / "bag"), parse_profile(two_lidars(), where="p")
    with open_recording(bag) as recording:
        aligned = align_inputs(profile, read_topics(recording, profile, reduced=False))
        scans = seen_of(aligned, 1_700_000_001 * 10**9, 1_700_000_003 * 10**9).scans
    assert len(scans) > 5
    for scan in scans:
        assert scan is not None
        back = np.flatnonzero(np.isfinite(scan.ranges_m))
        assert len(back) > 500  # all around: a single lidar covers three quarters
        bearing = scan.angle_min_rad + scan.angle_increment_rad * back
        y = 1.0 + scan.ranges_m[back] * np.sin(bearing + profile.task.body.lidar_yaw_rad)
        assert y.min() > RIGHT_M - 0.05
        assert y.max() < LEFT_M + 0.05


def test_merged_scan_topic_is_preferred(tmp_path):
    class Joined(CorridorDrive):
        def topics(self) -> dict[str, TopicColumns]:
            found = super().topics()
            times_s = np.arange(0, self.duration_s, 0.1)
            return found | {"/z_scan": self.scan(times_s, (0.0, 0.0, 0.0), "base_link")}

    bag = Joined(12.0).bag(tmp_path / "bag")
    profile = proposed(bag, tmp_path / "p.toml", codes=(0, 3))
    assert {name: scan.topic for name, scan in profile.inputs.scans.items()} == {"scan": "/z_scan"}
    assert profile.inputs.scans["scan"].lidar_at_m is None


def test_off_centre_lidar_keeps_its_mounting(tmp_path):
    """The mounting off centre used to be reported and ignored."""
    bag = CorridorDrive(12.0, mounted=(("/scan", FRONT),)).bag(tmp_path / "bag")
    profile = proposed(bag, tmp_path / "p.toml", codes=(0, 3))
    scan = profile.inputs.scans["scan"]
    assert scan.lidar_at_m == pytest.approx(FRONT[:2], abs=1e-3)
    assert scan.optional
    lidar = profile.robot.lidar  # in the middle, with its own yaw
    middle = (lidar.angle_min_rad + lidar.angle_max_rad) / 2
    assert middle == pytest.approx(FRONT[2], abs=0.02)
    assert lidar.angle_max_rad - lidar.angle_min_rad == pytest.approx(THREE_QUARTERS, abs=0.02)
    usable = sectors_of(steps_in(bag, profile))
    clear_m = LEFT_M - 1 - profile.task.body.width_m / 2
    assert np.median(usable[:, 27]) == pytest.approx(clear_m, abs=0.01)


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        (two_lidars().replace("[inputs.scan]", "[inputs.scan_3]"), "without `inputs.scan`"),
        (two_lidars(rear="optional = true"), "inputs.scan_2.optional"),
        (two_lidars().replace("/scan_rear", "/scan_front"), "two lidars have the same topic"),
        (
            two_lidars().replace(f"lidar_at_m = [-0.28, -0.22]\nlidar_yaw_rad = {REAR[2]}\n", ""),
            "inputs.scan_2.lidar_at_m` is missing",
        ),
        (two_lidars().replace("[-0.28, -0.22]", "[280.0, 0.0]"), "lidar_at_m"),
        (two_lidars().replace(f"= {REAR[2]}", "= -135.0"), "lidar_yaw_rad"),
    ],
)
def test_inconsistent_lidars_are_rejected(text, reported):
    with pytest.raises(ConfigError) as error:
        parse_profile(text, where="p")
    assert reported in str(error.value)
