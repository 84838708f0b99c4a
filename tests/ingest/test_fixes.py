"""Poses from satellite fixes: metres east and north, invalid fixes, and a causal heading."""

from pathlib import Path

import numpy as np
import pytest
from support.driven_robot import columns, write_topics
from support.profile_texts import WAREHOUSE

from restock.cli import main
from restock.errors import ConfigError
from restock.ingest.live.observer import LiveObserver
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile, parse_profile
from restock.ingest.steps.input_columns import Fixes, local_plane_m, track_yaw
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store

AXIS_M, FLATTENING = 6_378_137.0, 1 / 298.257223563
ORIGIN = (47.3769, 8.5417)
FIX, TWIST, IMU = "sensor_msgs/msg/NavSatFix", "geometry_msgs/msg/Twist", "sensor_msgs/msg/Imu"
RATE_S = 0.1


def degrees(x_m: np.ndarray, y_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return latitude and longitude of positions near the origin, by its radii of curvature."""
    phi, squared = np.radians(ORIGIN[0]), FLATTENING * (2 - FLATTENING)
    bend = 1 - squared * np.sin(phi) ** 2
    north_m, east_m = AXIS_M * (1 - squared) / bend**1.5, AXIS_M / np.sqrt(bend)
    return (
        ORIGIN[0] + np.degrees(y_m / north_m),
        ORIGIN[1] + np.degrees(x_m / east_m / np.cos(phi)),
    )


def drive(time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y and yaw: 2 s standing, 10 s east at 1 m/s, then a left circle of 4 m radius."""
    along = np.clip(time_s - 2, 0, None)
    turned = np.clip(along - 10, 0, None) / 4
    x = np.minimum(along, 10) + 4 * np.sin(turned)
    return x, 4 * (1 - np.cos(turned)), turned


def write_recording(folder: Path, *, heading: bool = False, seconds: float = 20.0) -> Path:
    """Return a bag of commands and fixes: invalid from 8 s to 9 s, and inaccurate once."""
    time_s = np.arange(0, seconds, RATE_S)
    x, y, yaw = drive(time_s)
    latitude, longitude = degrees(x, y)
    count = len(time_s)
    covariance = np.tile(np.diag([0.01, 0.01, 0.04]).ravel(), (count, 1))
    covariance[150] *= 1e5
    lost = (time_s >= 8) & (time_s < 9)
    ticks = np.arange(0.05, seconds, 0.2)
    going = ticks > 2
    turning = np.where(ticks > 12, 0.25, 0.0)
    topics = {
        "/cmd_vel": (
            TWIST,
            columns(
                ticks, {"linear.x": np.where(going, 1.0, 0.0), "angular.z": turning}, stamped=False
            ),
        ),
        "/gps/fix": (
            FIX,
            columns(
                time_s,
                {
                    "latitude": np.where(lost, np.nan, latitude),
                    "longitude": np.where(lost, np.nan, longitude),
                    "status.status": np.where(lost, -1, 0),
                    "position_covariance": covariance,
                    "position_covariance_type": np.full(count, 2),
                },
            ),
        ),
    }
    if heading:
        half = yaw / 2
        fields = {"orientation.z": np.sin(half), "orientation.w": np.cos(half)}
        topics["/imu"] = (IMU, columns(time_s, fields))
    return write_topics(topics, folder)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("fixes") / "bag")


@pytest.mark.parametrize(
    ("origin", "target", "length_m"),  # geodesic lengths by Vincenty's inverse formula (1975)
    [
        ((47.3769, 8.5417), (47.4369, 8.6417), 10_073.025),
        ((-33.45, -70.66), (-33.40, -70.73), 8_551.968),
        ((65.0, 25.5), (64.93, 25.62), 9_645.769),
        ((1.35, 103.82), (1.42, 103.88), 10_222.368),
    ],
)
def test_local_plane_matches_geodesic_length(origin, target, length_m):
    east, north = local_plane_m(np.array(target[:1]), np.array(target[1:]), origin)[0]
    assert np.hypot(east, north) == pytest.approx(length_m, abs=0.006)
    assert (east > 0, north > 0) == (target[1] > origin[1], target[0] > origin[0])


def test_invalid_fixes_give_no_pose_and_a_reason():
    count = 6
    covariance = np.tile(np.diag([1.0, 1.0, 4.0]).ravel(), (count, 1))
    covariance[4] *= 100
    fixes = Fixes(
        np.arange(count),
        np.array([0.0, 47.0, np.nan, 47.0, 47.0, 147.0]),
        np.array([0.0, 8.0, 8.0, 8.0, 8.0, 8.0]),
        status=np.array([0.0, -1.0, 0.0, 0.0, 0.0, 0.0]),
        covariance_m2=covariance,
        covariance_type=np.full(count, 2.0),
    )
    expected = ["no fix"] * 3 + [""] + ["fix too uncertain", "no fix"]
    assert fixes.problems(5.0).tolist() == expected
    assert fixes.problems(50.0)[4] == ""
    assert fixes.origin_deg() == (47.0, 8.0)
    assert np.isnan(fixes.poses().x_m).tolist() == [True, True, True, False, True, True]


def plain_track_yaw(x: np.ndarray, y: np.ndarray, track_m: float) -> np.ndarray:
    """Compute the track's yaw by searching every earlier position since the last turn."""
    yaw, held, back = np.full(len(x), np.nan), np.nan, 0
    for index in range(len(x)):
        far = np.flatnonzero(
            np.hypot(x[index] - x[: index + 1], y[index] - y[: index + 1]) >= track_m
        )
        far = far[far >= back]
        if len(far):
            back = int(far[-1])
            held = np.arctan2(y[index] - y[back], x[index] - x[back])
        yaw[index] = held
    return yaw


@pytest.mark.parametrize("scatter_m", [0.0, 0.02, 0.2, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_track_yaw_equals_full_search(seed, scatter_m):
    rng = np.random.default_rng(seed)
    speeds = np.repeat(rng.choice([0.0, 0.0, 0.05, 0.1, -0.1], 12), rng.integers(1, 120, 12))
    heading = np.cumsum(rng.normal(0, 0.15, len(speeds)))
    x, y = (np.cumsum(speeds * turn(heading)) for turn in (np.cos, np.sin))
    x, y = (column + rng.normal(0, scatter_m, len(column)) for column in (x, y))
    np.testing.assert_array_equal(track_yaw(x, y, 1.0), plain_track_yaw(x, y, 1.0))


def test_proposal_from_fixes_drops_ticks_without_fix(bag, tmp_path, shell):
    profile, store = tmp_path / "gps.toml", tmp_path / "store"
    assert main(["profile", "new", str(bag), "--out", str(profile)]) in (0, 3)
    text = profile.read_text()
    origin = degrees(*(column[:1] for column in drive(np.zeros(1))[:2]))
    assert f"origin_deg = [{origin[0][0]:.7f}, {origin[1][0]:.7f}]" in text
    assert f'type = "{FIX}"' in text
    (row,) = shell.json("ingest", bag, "--profile", profile, "--store", store)["recordings"]
    dropped = {drop["reason"]: drop["count"] for drop in row["drops"]}
    assert dropped["pose: no fix"] == 5  # one second of ticks
    assert dropped["pose: fix too uncertain"] == 1
    assert dropped["pose: heading unknown until the robot has driven"] >= 10
    with Store(store) as opened:
        rows = opened.sql("FROM transitions ORDER BY stamp_ns").to_arrow_table()
    at_s = (rows["pose_stamp_ns"].to_numpy() - 1_700_000_000 * 10**9) * 1e-9
    x, y, _ = drive(at_s)
    assert rows["pose_x_m"].to_numpy() == pytest.approx(x, abs=0.01)
    assert rows["pose_y_m"].to_numpy() == pytest.approx(y, abs=0.01)
    speeds = rows["wheel_speed_mps"].to_numpy()[(at_s > 6) & (at_s < 7.8)]
    assert speeds == pytest.approx(np.ones(len(speeds)), abs=0.02)


def test_imu_heading_replaces_track_heading(tmp_path):
    bag = write_recording(tmp_path / "bag", heading=True)
    main(["profile", "new", str(bag), "--out", str(tmp_path / "gps.toml")])
    heading = (
        f'[inputs.heading]\ntopic = "/imu"\ntype = "{IMU}"\n'
        'fields = { orientation = "orientation" }\nmax_age_s = 0.5\n'
    )
    text = (tmp_path / "gps.toml").read_text() + heading
    profile = parse_profile(text, where="gps.toml")
    outcome = ingest(bag, profile, store=StoreWriter(tmp_path / "store"))
    assert not any("heading" in drop["reason"] for drop in outcome.manifest["drops"])
    with Store(tmp_path / "store") as opened:
        rows = opened.sql("FROM transitions ORDER BY stamp_ns").to_arrow_table()
    at_s = (rows["pose_stamp_ns"].to_numpy() - 1_700_000_000 * 10**9) * 1e-9
    turned = rows["pose_yaw_rad"].to_numpy()
    assert turned == pytest.approx(drive(at_s)[2], abs=0.01)
    with pytest.raises(ConfigError, match="which has no heading"):
        parse_profile(WAREHOUSE + "\n" + heading, where="warehouse.toml")


def test_live_observer_rejects_satellite_fixes(bag, tmp_path):
    main(["profile", "new", str(bag), "--out", str(tmp_path / "gps.toml")])
    with pytest.raises(ConfigError, match="satellite fixes"):
        LiveObserver(load_profile(tmp_path / "gps.toml"))
