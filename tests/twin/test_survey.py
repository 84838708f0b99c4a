"""Make floors from recordings: from the map, the scans or the driven corridor."""

import re
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from deltalake import DeltaTable
from PIL import Image
from support.driven_robot import typed_columns, write_topics
from support.profile_texts import WAREHOUSE
from support.stores import recording_transitions, with_clear_view, write_store

from restock.cli import main
from restock.errors import ConfigError, RecordingError
from restock.ingest.decoding.columns import Ragged, TopicColumns, offsets_of
from restock.ingest.profile.profile import parse_profile
from restock.ingest.profile.tables import Zone
from restock.ingest.propose.footprint import parse_footprint
from restock.ingest.store.transitions import replaced
from restock.toml import Checked, read_toml, typed
from restock.train.twin.env.drivers import PlannerFollower
from restock.train.twin.env.render import FLOOR_PIXELS, MAP_GOAL, MAP_WALL, ROBOT
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.floor_files import read_floor
from restock.train.twin.floors.layout import edges_of, within
from restock.train.twin.floors.occupancy_grid import OccupancyGrid, floor_of_grid, out_of_frame
from restock.train.twin.physics.episode import EpisodeSpec, describe_floor
from restock.train.twin.survey.survey import survey

CELL_M = 0.05


def hall() -> np.ndarray:
    """Return occupancy (X, Y) of 9 x 7 m: a ring of corridors 1.5 m wide around one block."""
    occupancy = np.full((180, 140), 100, np.int8)
    occupancy[4:176, 4:136] = 0
    occupancy[34:146, 34:106] = 100
    return occupancy


def lap(origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return poses (N, 3) of one lap in the middle of the hall's corridors, in the map frame."""
    corners = np.array([[0.95, 0.95], [8.05, 0.95], [8.05, 6.05], [0.95, 6.05], [0.95, 0.95]])
    parts = []
    for start, end in pairwise(corners):
        steps = int(np.hypot(*(end - start)) / 0.1)
        places = start + np.arange(steps)[:, None] / steps * (end - start)
        yaw = np.arctan2(*(end - start)[::-1])
        parts.append(np.column_stack([out_of_frame(places, origin), np.full(steps, yaw)]))
    poses = np.concatenate(parts)
    poses[:, 2] += origin[2]
    return poses


def topic(frame: str, count: int, fields: dict[str, Any], late_s: float = 0.0) -> TopicColumns:
    """Return messages every .2 s with stamps that are late by `late_s`."""
    log_ns = 10**9 + np.arange(count) * 2 * 10**8
    stamped = {"header.stamp": log_ns + int(late_s * 1e9)}
    return TopicColumns(
        log_ns, log_ns, stamped | {"header.frame_id": np.full(count, frame, object)} | fields
    )


def pose_fields(path: str, poses: np.ndarray) -> dict[str, Any]:
    x, y, yaw = np.transpose(poses)
    turned = {"orientation.z": np.sin(yaw / 2), "orientation.w": np.cos(yaw / 2)}
    fields = {"position.x": x, "position.y": y, **turned}
    return {f"{path}.{name}": column for name, column in fields.items()}


def write_bag(
    folder: Path,
    *,
    poses: np.ndarray | None = None,
    frame: str = "map",
    grid: OccupancyGrid | None = None,
    data: np.ndarray | None = None,
    scanned: bool = False,  # with /scan of 120 beams, on a lap of the hall
    scans_late_s: float = 0.0,
    scan_frame: str = "laser",
    clockwise: bool = False,  # like a lidar that is mounted upside down
) -> Path:
    """Write a rosbag2 folder with /amcl_pose every .2 s, and /map with the grid or `data`."""
    topics: dict[str, TopicColumns] = {}
    if grid is not None:
        width, height = grid.occupancy.shape
        info = {"resolution": grid.cell_m, "width": width, "height": height}
        fields = {f"info.{name}": np.array([value]) for name, value in info.items()}
        cells = np.ascontiguousarray(grid.occupancy.T).ravel() if data is None else data
        fields |= pose_fields("info.origin", np.array([grid.origin])) | {"data": cells[None]}
        topics["/map"] = topic("map", 1, fields)
    if poses is not None:
        topics["/amcl_pose"] = topic(frame, len(poses), pose_fields("pose.pose", poses))
    if scanned:
        seen = seen_on_lap()
        step = 2 * np.pi / (-120 if clockwise else 120)
        angles = {"angle_min": -60 * step, "angle_max": 60 * step, "angle_increment": step}
        given = angles | {"scan_time": 0.2, "range_min": 0.1, "range_max": 12.0}
        fields = {name: np.full(len(seen), value) for name, value in given.items()}
        fields["ranges"] = Ragged(np.concatenate(seen), offsets_of(np.full(len(seen), 120)))
        topics["/scan"] = topic(scan_frame, len(seen), fields, scans_late_s)
    return write_topics(typed_columns(topics), folder, storage="mcap")


@cache
def seen_on_lap() -> list[np.ndarray]:
    """Return ranges (120,) at each pose of a lap; 0 beyond 6 m, as a Neato reports."""
    occupancy, reach, seen = hall(), np.arange(0.0, 6.0, 0.01), []
    for pose in lap():
        bearing = pose[2] - np.pi + np.arange(120) * 2 * np.pi / 120
        x = pose[0] + np.cos(bearing)[:, None] * reach
        y = pose[1] + np.sin(bearing)[:, None] * reach
        cells = np.clip((np.stack([x, y]) / CELL_M).astype(int), 0, [[[179]], [[139]]])
        hit = occupancy[cells[0], cells[1]] > 0
        ranges = np.where(hit.any(axis=1), reach[hit.argmax(axis=1)], 0.0)
        seen.append(ranges.astype(np.float32))
    return seen


@pytest.mark.parametrize(
    ("late_s", "frame"), [(0.0, "laser"), (1.5, "laser"), (0.0, "base_link"), (0.0, "/base_scan")]
)
def test_scan_map_uses_best_matching_clock(tmp_path, late_s, frame):
    known = OccupancyGrid(hall(), CELL_M)
    scans: dict[str, Any] = {"scanned": True, "scans_late_s": late_s, "scan_frame": frame}
    bag = write_bag(tmp_path / "bag", poses=lap(), grid=known, **scans)
    made = survey(bag, by="scans", footprint=parse_footprint("0.4x0.4"))
    assert f"by {'log time' if late_s else 'header stamps'}" in made.source
    assert len(made.floor.segments) == 4
    assert survey(bag).by == "map"  # the map in the bag is preferred


def test_upside_down_lidar_gives_the_same_map(tmp_path: Path) -> None:
    """Read the mounting from the profile, since no transform gives it."""
    known = OccupancyGrid(hall(), CELL_M)
    bag = write_bag(tmp_path / "bag", poses=lap(), grid=known, scanned=True, clockwise=True)
    hanging = WAREHOUSE.replace("[inputs.scan]", "[inputs.scan]\nupside_down = true")
    right, wrong = (
        survey(bag, by="scans", profile=parse_profile(one, where="p"))
        for one in (hanging, WAREHOUSE)
    )
    pattern = re.compile(r"(\d+)% of their ends")
    shares = [int(pattern.findall(" ".join(made.notes))[0]) for made in (right, wrong)]
    assert shares[0] > 95 > shares[1]


def test_bag_map_becomes_drivable_floor(tmp_path, shell):
    origin = (-3.0, 2.0, 0.0)
    poses = lap(origin)[:-30]  # not the whole way round
    bag = write_bag(tmp_path / "bag", poses=poses, grid=OccupancyGrid(hall(), CELL_M, origin))
    arguments = ["twin", "layout", "--from", str(bag), "--out", str(tmp_path / "floor.toml")]
    assert "'a.txt' does not end in .toml or .png" in shell.err(
        *arguments, "--footprint", "0.6x0.5", "--out", tmp_path / "a.txt"
    )
    shown = shell.out(*arguments, "--footprint", "0.6x0.5", "--out", tmp_path / "a.png")
    assert re.search(r"map_origin +-2\.8, 2\.2, ", shown)
    assert re.search(r"one_way_rules +0$", shown, re.MULTILINE)
    floor = read_floor(tmp_path / "floor.toml")
    assert (floor.width_m, floor.depth_m) == pytest.approx((8.6, 6.6))
    assert floor.map_origin == pytest.approx((-2.8, 2.2, 0.0))
    assert len(floor.segments) == 4  # the four sides of the ring
    assert {segment.width_m for segment in floor.segments} == {1.5}
    # Missions start and end where the robot was.
    driven = poses[:, :2] - floor.map_origin[:2]
    for place in floor.goals_m + floor.starts_m:
        assert np.hypot(*(driven - place).T).min() < 0.1
    env = WarehouseVectorEnv(2, layouts=[floor], conditions={"nominal": 1.0})
    env.set_episodes([EpisodeSpec("nominal", seed) for seed in range(2)])
    _, info = env.reset()
    driver, done = PlannerFollower(epsilon=0.0), np.zeros(2, np.bool_)
    success = np.zeros(2, np.bool_)
    observation = env.observation
    while not done.all():
        action, _ = driver.act(env, observation)
        observation, _, terminated, truncated, info = env.step(action)
        success |= ~done & info["success"]
        done |= terminated | truncated
    assert success.all()


def test_poses_off_the_map_are_rejected_with_frames(tmp_path: Path) -> None:
    away = lap((40.0, 0.0, 0.0))
    bag = write_bag(tmp_path / "bag", poses=away, frame="odom", grid=OccupancyGrid(hall(), CELL_M))
    with pytest.raises(ConfigError, match=r"100% are off the map.*0 on its.*'map'.*'odom'"):
        survey(bag)


def test_map_contradicted_by_lidar_is_rejected(tmp_path, shell):
    """Reject a larger, empty room: all poses are on free floor, but the walls are elsewhere."""
    room = np.zeros((240, 200), np.int8)
    room[[0, -1]] = room[:, [0, -1]] = 100
    elsewhere = OccupancyGrid(room, CELL_M, (-1.5, -1.5, 0.0))
    bag = write_bag(tmp_path / "bag", poses=lap(), grid=elsewhere, scanned=True)
    floor = tmp_path / "floor.toml"
    arguments = ["twin", "layout", "--from", str(bag), "--out", str(floor)]
    error = " ".join(shell.err(*arguments).split())
    assert "only 0% of the lidar's returns are on walls of the map" in error
    assert "--by scans" in error
    assert not floor.exists()
    assert main([*arguments, "--by", "map", "--footprint", "0.4x0.4"]) == 0  # explicitly requested
    near = OccupancyGrid(hall(), CELL_M, (0.4, 0.4, 0.0))  # as with poor localisation
    made = survey(write_bag(tmp_path / "near", poses=lap(), grid=near, scanned=True))
    assert any("of the lidar's returns are on walls" in note for note in made.notes)


@pytest.mark.parametrize(
    ("shape", "resolution", "origin", "data", "message"),
    [
        ((0, 0), 0.05, (0.0, 0.0, 0.0), np.zeros(0, np.int8), "its map of 0 x 0 cells"),
        ((4, 4), 0.05, (float("nan"), 0.0, 0.0), None, "values, from nan"),
        (
            (60000, 60000),
            0.05,
            (0.0, 0.0, 0.0),
            np.zeros(3, np.int8),
            "1 to 40,000,000 cells",
        ),
        ((90, 90), 0.05, (0.0, 0.0, 0.0), np.full(8100, -1, np.int8), "8,100 unknown"),
    ],
)
def test_invalid_map_message_is_rejected(tmp_path, shape, resolution, origin, data, message):
    cells = np.broadcast_to(np.int8(0), shape)
    bag = write_bag(tmp_path / "bag", grid=OccupancyGrid(cells, resolution, origin), data=data)
    with pytest.raises((RecordingError, ConfigError), match=message):
        survey(bag)


def test_robot_larger_than_aisles_is_rejected(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", poses=lap(), grid=OccupancyGrid(hall(), CELL_M))
    arguments = ["twin", "layout", "--from", str(bag), "--out", str(tmp_path / "floor.toml")]
    assert main([*arguments, "--footprint", "2.5x1.8"]) == 2
    assert not (tmp_path / "floor.toml").exists()
    with pytest.raises(ConfigError, match=r"widest place leaves 0\.90 m .* needs 1\.30 m"):
        survey(bag, footprint=parse_footprint("3x2.5"))


def test_without_map_floor_is_driven_corridor(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", poses=lap((5.0, -1.0, 0.5)), frame="odom")
    made = survey(bag)
    assert made.by == "corridor"
    # The floor's axes follow the corridor, which is turned by half a radian.
    assert made.floor.map_origin[2] == pytest.approx(0.5, abs=0.01)
    # 7.1 x 5.1 m between corridor middles, plus .43 m to turn, .07 m and .25 m on each side.
    assert made.floor.width_m == pytest.approx(7.1 + 2 * 0.75, abs=0.15)
    assert made.floor.depth_m == pytest.approx(5.1 + 2 * 0.75, abs=0.15)
    assert len(made.floor.segments) == 4


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_exported_zones_are_in_map_frame(tmp_path: Path, yaw: float) -> None:
    bag = write_bag(tmp_path / "bag", poses=lap((5.0, -1.0, yaw)), frame="odom")
    arguments = ["twin", "layout", "--from", str(bag), "--zones", str(tmp_path / "zones.toml")]
    assert main(arguments) == 0
    floor = survey(bag).floor
    zones = typed(read_toml(tmp_path / "zones.toml"), _Zones, where="zones").zone
    assert {zone.name for zone in zones} == set(floor.zones)
    rng = np.random.default_rng(2)
    places = rng.uniform((0, 0), (floor.width_m, floor.depth_m), (500, 2))
    on_map = out_of_frame(places, floor.map_origin)
    for zone in zones:
        edges = edges_of([floor.zones[zone.name]])
        sure = within(edges, *places.T, 0.01)[:, 0]
        outside = ~within(edges, *places.T, -0.01)[:, 0]
        held = zone.holds(on_map[:, 0], on_map[:, 1])
        assert held[sure].all()
        assert not held[outside].any()
    # Zones without a turn do not change a profile's hash.
    assert msgspec.to_builtins(Zone("a", (0.0, 0.0, 1.0, 1.0))).keys() == {"name", "box_m"}


def test_floor_picture_is_to_scale(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", poses=lap(), grid=OccupancyGrid(hall(), CELL_M))
    assert main(["twin", "layout", "--from", str(bag), "--out", str(tmp_path / "floor.png")]) == 0
    pixels = np.asarray(Image.open(tmp_path / "floor.png")).astype(int)
    per_m = int(FLOOR_PIXELS / survey(bag).floor.width_m)

    def extent(color: tuple[int, ...]) -> list[float]:
        """Return the width and height of the area with this colour, in metres."""
        found = np.argwhere((pixels == color).all(axis=2))
        return (np.ptp(found, axis=0)[::-1] / per_m).tolist()

    assert extent(ROBOT) == pytest.approx((7.1, 5.1), abs=0.15)
    assert extent(MAP_GOAL) == pytest.approx((7.1, 5.1), abs=0.6)
    block = (pixels[20:-20, 20:-20] == MAP_WALL).all(axis=2)  # without the walls around it
    assert block.sum() / per_m**2 == pytest.approx(5.6 * 3.6, rel=0.05)


def rows_along(rows: pa.Table, poses: np.ndarray, rows_a_pose: int = 1) -> pa.Table:
    """Return rows at these poses (N, 3), and the remaining rows at the last pose."""
    pose_index = np.minimum(np.arange(len(rows)) // rows_a_pose, len(poses) - 1)
    names = ("pose_x_m", "pose_y_m", "pose_yaw_rad")
    return replaced(rows, dict(zip(names, poses[pose_index].T, strict=True)))


def test_store_gives_floor_of_its_recordings(tmp_path):
    bag = write_bag(tmp_path / "bag", poses=lap()[:60], grid=OccupancyGrid(hall(), CELL_M))
    recordings = []
    for recording, part in ((1, slice(0, 60)), (2, slice(60, 200))):
        rows = recording_transitions(recording, episodes=8)
        recordings.append(rows_along(rows, lap()[part], rows_a_pose=2))
    store = write_store(tmp_path / "store", recordings)
    gone = survey(store)
    assert gone.by == "corridor"
    assert "no longer exists" in gone.notes[0]
    manifests = DeltaTable(str(store / "recordings"))
    manifests.update(updates={"source_file": f"'{bag}'"})
    made = survey(store)
    assert made.by == "map"
    # Missions go to the places of all drives on this map.
    assert made.poses is not None
    assert "2 recordings" in made.poses.source


def lap_rows(recording: int, away_m: float) -> pa.Table:
    """Return the rows of a drive around the hall, in a frame shifted by this much."""
    rows = with_clear_view(recording_transitions(recording, episodes=8))
    return rows_along(rows, lap() + np.array([away_m, 0.0, 0.0]))


def test_recordings_in_other_frames_get_own_floors(tmp_path, shell):
    tables = [lap_rows(1, 0.0), lap_rows(2, 40.0)]
    store = write_store(tmp_path / "store", tables)
    names = [table["recording_id"][0].as_py() for table in tables]
    first = survey(store, recording=names[0])
    second = survey(store, recording=names[1])
    assert any("one of 2 recordings in the store" in note for note in first.notes)
    assert second.floor.map_origin[0] == pytest.approx(first.floor.map_origin[0] + 40.0, abs=0.2)
    assert second.floor.name != first.floor.name
    line = ["twin", "layout", "--from", str(store), "--recording"]
    assert shell.json(*line, names[1])["name"] == second.floor.name
    assert "no recording is 'no_such'" in shell.err(*line, "no_such")
    assert "--recording" in shell.err("twin", "layout", "default", "--recording", "x")


class _Zones(Checked, frozen=True):
    zone: list[Zone]


def test_missions_of_barely_moved_robot_use_seen_room() -> None:
    """Send missions into the room that the robot saw if its own positions are close together."""
    cells = np.full((120, 80), 100, np.int8)
    cells[2:-2, 2:-2] = 0
    around = np.array([(3.65, 2.65), (3.75, 2.65), (3.75, 2.75)])  # in three squares
    made = floor_of_grid(
        OccupancyGrid(cells, 0.1), name="hall", where="a test", room_m=0.15, turn_m=0.2,
        visited_m=around,
    )  # fmt: skip
    floor = made.floor
    assert any("missions start there and also go to" in note for note in made.notes)
    assert len(floor.goals_m) > 20
    assert all(np.hypot(*(around - start).T).min() < 0.3 for start in floor.starts_m)
    assert "nominal" in describe_floor(floor)["episodes"]
