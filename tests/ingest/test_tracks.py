"""Tracks of moving objects: discs in a square room, seen by a driving robot's lidar."""

from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.driven_robot import Drive
from support.profile_texts import WAREHOUSE
from support.rooms import Disc, ranges_in_room

from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile, parse_profile, profile_toml
from restock.ingest.steps.episodes import steps_of
from restock.ingest.steps.needs import as_recorded
from restock.ingest.task.task import (
    SIGNALS,
    TRACK_SIGNALS,
    Body,
    Mirror,
    Signals,
    Task,
    observe,
)
from restock.ingest.task.tracks import Lidar, Tracker

TASK = Task(body=Body(length_m=0.7, width_m=0.5), actions=((0.0, 0.0), (1.0, 0.0)), tracks=3)
BEARINGS = (np.arange(180) + 0.5) * (2 * np.pi / 180) - np.pi
LIDAR = Lidar(BEARINGS)
PERIOD_S = TASK.control_period_s
Array = NDArray[np.float64]


def steps(
    count: int,
    discs: Callable[[float], list[Disc]],
    speed: float = 0.0,
    turn: float = 0.0,
    noise_m: float = 0.01,
    seed: int = 0,
    walls_m: float = 4.5,
) -> list[tuple[Signals, Array, NDArray[np.int64]]]:
    """Return a drive's steps: signals, scans and scan stamps; `discs` is a function of time."""
    rng, pose, made = np.random.default_rng(seed), [-2.0, 0.0, 0.0], []
    for step in range(count):
        stamp_ns = np.array([round((step + 1) * PERIOD_S * 1e9)])
        at = (pose[0], pose[1], pose[2])
        seen = ranges_in_room(BEARINGS, at, discs(step * PERIOD_S), walls_m)
        values = (speed, turn, speed, 0.0)
        names = ("wheel_speed_mps", "gyro_yaw_rate_radps", "localised_speed_mps")
        now = {
            name: np.array([value])
            for name, value in zip((*names, "localised_lateral_mps"), values, strict=True)
        }
        scan_m = LIDAR.scan(seen + rng.normal(0, noise_m, seen.shape), TASK.range_min_m)
        made.append((now | {"stamp_ns": stamp_ns}, scan_m, stamp_ns))
        heading = pose[2] + turn * PERIOD_S / 2
        pose[0] += speed * PERIOD_S * np.cos(heading)
        pose[1] += speed * PERIOD_S * np.sin(heading)
        pose[2] += turn * PERIOD_S
    return made


def track_drive(drive: list[tuple[Signals, Array, NDArray[np.int64]]]) -> dict[str, Array]:
    """Return the tracks (T, K) of every step."""
    tracker = Tracker(TASK)
    rows = [tracker.begin(np.array([0]), *drive[0])]
    rows += [tracker.update(*step) for step in drive[1:]]
    return {name: np.concatenate([row[name] for row in rows]) for name in TRACK_SIGNALS}


@pytest.mark.parametrize(("speed", "turn"), [(0.0, 0.0), (0.4, 0.0), (0.2, 0.3)])
@pytest.mark.parametrize("velocity_mps", [(0.0, 0.9), (-0.8, 0.1), (0.7, -0.7)])
def test_walking_person_is_tracked_with_position_and_speed(velocity_mps, speed, turn):
    start = np.array([0.2, -1.0 if velocity_mps[1] > 0 else 0.8])

    def walker(at_s: float) -> list[Disc]:
        x, y = start + np.array(velocity_mps) * at_s
        return [(x, y, 0.25), (1.0, 2.5, 0.4), (-3.0, -1.5, 0.3)]

    count = 12
    found = track_drive(steps(count, walker, speed, turn))
    known = np.isfinite(found["track_x_m"])
    assert known[-1].tolist() == [True, False, False]
    yaw = turn * PERIOD_S * (count - 1)
    cos, sin = np.cos(yaw), np.sin(yaw)
    vx, vy = found["track_vx_mps"][-1, 0], found["track_vy_mps"][-1, 0]
    assert [cos * vx - sin * vy, sin * vx + cos * vy] == pytest.approx(velocity_mps, abs=0.2)
    if not speed:
        x, y = walker((count - 1) * PERIOD_S)[0][:2]
        assert found["track_x_m"][-1, 0] - 2.0 == pytest.approx(x, abs=0.15)
        assert found["track_y_m"][-1, 0] == pytest.approx(y, abs=0.15)
    assert (np.diff(found["track_age_s"][known[:, 0], 0]) > 0).all()


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 1000),
    speed=st.floats(-0.4, 1.0),
    turn=st.floats(-1.2, 1.2),
    discs=st.lists(
        st.tuples(st.floats(-0.5, 3.5), st.floats(-3.5, 3.5), st.floats(0.15, 0.6)), max_size=4
    ),
)
def test_static_scene_gives_no_tracks(seed, speed, turn, discs):
    clear = [disc for disc in discs if abs(disc[1]) > 1.2 or speed == 0]
    found = track_drive(steps(15, lambda at_s: clear, speed, turn, seed=seed))
    assert not np.isfinite(found["track_x_m"]).any()


def test_stopped_person_is_tracked_briefly_then_dropped():
    found = track_drive(steps(40, lambda at_s: [(0.0, min(at_s, 1.6) - 1.0, 0.25)]))
    known = np.isfinite(found["track_x_m"]).any(axis=1)
    speed = np.hypot(found["track_vx_mps"], found["track_vy_mps"])[:, 0]
    assert known[8:16].all()
    assert speed[15] < 0.4 < speed[7]
    assert not known[-5:].any()


def test_tracks_do_not_depend_on_later_steps():
    walk = steps(20, lambda at_s: [(0.0, at_s - 1.5, 0.25)])
    other = walk[:12] + steps(20, lambda at_s: [(1.0, 1.0 - at_s, 0.5)], seed=1)[12:]
    whole, changed = track_drive(walk), track_drive(other)
    for name, values in track_drive(walk[:12]).items():
        np.testing.assert_array_equal(values, whole[name][:12])
        np.testing.assert_array_equal(values, changed[name][:12])


def test_several_robots_are_tracked_independently():
    drives = [
        steps(20, lambda at_s, way=way: [(0.3, way * (at_s - 1.5), 0.25)], 0.1 * index, seed=index)
        for index, way in enumerate((1.0, -0.8, 0.0))
    ]
    tracker = Tracker(TASK, robots=len(drives))

    def together(step: int) -> tuple[Signals, Array, NDArray[np.int64]]:
        rows = [drive[step] for drive in drives]
        now = {name: np.concatenate([row[0][name] for row in rows]) for name in rows[0][0]}
        return now, np.concatenate([r[1] for r in rows]), np.concatenate([r[2] for r in rows])

    found = [tracker.begin(np.arange(3), *together(0))]
    found += [tracker.update(*together(step)) for step in range(1, 20)]
    for robot, drive in enumerate(drives):
        for name, values in track_drive(drive).items():
            np.testing.assert_array_equal(np.stack([row[name][robot] for row in found]), values)


def test_repeated_scan_is_not_counted_twice():
    once = steps(24, lambda at_s: [(0.0, at_s - 1.5, 0.25)])
    slow = [(now, *once[step - step % 2][1:]) for step, (now, _, _) in enumerate(once)]
    found = track_drive(slow)
    known = np.flatnonzero(np.isfinite(found["track_x_m"][:, 0]))
    assert len(known) > 8
    y, vy = found["track_y_m"][known[-1], 0], found["track_vy_mps"][known[-1], 0]
    assert vy == pytest.approx(1.0, abs=0.25)
    # position at the time of the step
    assert y == pytest.approx(known[-1] * PERIOD_S - 1.5, abs=0.25)


def test_off_centre_lidar_gives_same_positions():
    off = Lidar(BEARINGS, from_m=(0.3, -0.1))
    far = np.full((1, 180), np.inf)
    far[0, 90] = 1.0
    (sector,) = np.flatnonzero(np.isfinite(off.scan(far, 0.05)[0]))
    assert off.scan(far, 0.05)[0, sector] == pytest.approx(1.3, abs=0.02)


def test_tracks_are_last_entries_of_observation():
    plain = msgspec.structs.replace(TASK, tracks=msgspec.UNSET)
    assert TASK.observation_names[: plain.observation_size] == plain.observation_names
    assert len(TASK.observation_names) == TASK.observation_size
    assert TASK.hash != plain.hash
    now: Signals = {signal.name: np.zeros(1) for signal in SIGNALS}
    now["sector_clearance_m"] = np.ones((1, TASK.sectors))
    tracks = {name: np.array([[1.0, np.nan, np.nan]]) for name in TRACK_SIGNALS}
    seen = observe(TASK, now | tracks, now, np.array([0]))[0, plain.observation_size :]
    assert seen.reshape(6, 3)[:, 0] == pytest.approx([0.25, 0.25, 1, 1, 0.5, 1])
    assert not seen.reshape(6, 3)[:, 1:].any()
    tracking = msgspec.structs.replace(load_profile("warehouse_amr").task, tracks=4)
    mirror = Mirror.of(tracking).sign[-24:].reshape(6, 4)
    assert mirror[:, 0].tolist() == [1, -1, 1, -1, 1, 1]


def test_profile_without_tracks_omits_the_key():
    profile = load_profile("warehouse_amr")
    assert "tracks" not in profile_toml(profile)
    assert b"tracks" not in msgspec.json.encode(profile.task)


TRACKING = WAREHOUSE.replace("[task]\n", "[task]\ntracks = 2\n")


def test_recording_has_tracks_at_every_step():
    profile = parse_profile(TRACKING, where="tracking.toml")
    steps = steps_of(profile, Drive().topics())
    assert all(steps.signals[name].shape == (len(steps), 2) for name in TRACK_SIGNALS)


def test_tracks_without_lidar_are_rejected():
    start = TRACKING.index("[inputs.scan]")
    blind = TRACKING[:start] + TRACKING[TRACKING.index("[inputs.", start + 1) :]
    with pytest.raises(ConfigError, match="asks for tracks, which are made from lidar scans"):
        parse_profile(blind, where="blind.toml")
    with pytest.raises(ConfigError, match="tracks needs a lidar"):
        parse_profile(TRACKING.replace("sectors = 36", "sectors = 0"), where="none.toml")
    inputs = TRACKING[start:].replace("[inputs.scan]\n", "[inputs.scan]\noptional = true\n", 1)
    profile = parse_profile(TRACKING[:start] + inputs, where="optional.toml")
    with pytest.raises(ConfigError, match="asks for tracks"):
        as_recorded(profile, {})
