"""Check `restock twin fit`: log segments, their replay, and recovered parameters."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.paths import SHARED
from support.shell import Shell

from restock.errors import ConfigError, StoreError
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store
from restock.train.twin.calibration.fit import FitConfig, _least_squares, fit
from restock.train.twin.calibration.fit_solver import (
    DEFAULT,
    Coordinates,
    ReplayResiduals,
    position_gap_m,
)
from restock.train.twin.calibration.fitted_twin import (
    FittedTwin,
    ParameterEstimate,
    fleet_schedule,
    measure_uncertainty,
    unidentified,
    write_fit,
)
from restock.train.twin.calibration.logged_steps import logged_steps
from restock.train.twin.calibration.open_loop import (
    LoggedSegments,
    held_out_from,
    log_segments,
    ordinary_driving,
    replay_segments,
    split_at,
    warmup_steps,
)
from restock.train.twin.physics.perturbation import (
    RANGES,
    Perturbation,
    find_perturbation,
    load_perturbation,
)
from restock.train.twin.recording.recorder import HARDWARE, NOISELESS, RecordingPlan, record

BAGS = SHARED
# Latency, low gain and smaller wheels than the base assumes; sensors of the stand-in.
KNOWN = msgspec.structs.replace(
    HARDWARE,
    name="known",
    friction_scale=1.0,
    payload_kg=0.0,
    wheel_radius_scale=0.97,
    latency_s=0.12,
    gain=0.95,
    localisation_noise_m=0.002,
    localisation_drift_m=0.005,
    timestep_s=0.01,
)


def store_of(folder: Path, hardware: Perturbation, *, missions: int, seed: int = 3) -> Path:
    recording = folder / f"{seed}.mcap"
    record(
        recording,
        RecordingPlan(missions=missions, seed=seed, conditions={"nominal": 1.0}, hardware=hardware),
    )
    ingest(recording, load_profile("warehouse_amr"), store=StoreWriter(folder / "store"))
    return folder / "store"


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return store_of(tmp_path_factory.mktemp("known"), KNOWN, missions=4)


@pytest.fixture(scope="module")
def noiseless(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return store_of(tmp_path_factory.mktemp("noiseless"), NOISELESS, missions=1)


@pytest.fixture
def log(known: Path) -> Iterator[LoggedSegments]:
    with Store(known) as store:
        yield log_segments(logged_steps(store), 2.0)


def test_each_step_is_in_a_segment_or_has_a_reason(known: Path) -> None:
    with Store(known) as store:
        found = log_segments(logged_steps(store), 2.0)
        rows = store.sql("SELECT count(*) FROM transitions").fetchall()[0][0]
    assert len(found) * found.horizon_steps + sum(found.left_out.values()) == rows
    assert found.signals["pose_x_m"].shape == (len(found), found.horizon_steps + 1)
    assert found.command.shape == (len(found), found.warmup_steps + found.horizon_steps, 2)
    lasts = found.signals["stamp_ns"][:, -1] - found.signals["stamp_ns"][:, 0]
    assert np.abs(lasts * 1e-9 - 2.0).max() < 0.05


def test_late_pose_or_tick_shifts_segments(known: Path) -> None:
    """Keep segments if poses arrive in bursts, like a Neato's."""
    with Store(known) as store:
        steps = logged_steps(store)
    usual = log_segments(steps, 2.0)
    late = {name: column.copy() for name, column in steps.now.items()}
    late["pose_stamp_ns"][usual.row[::2]] -= 10**9
    found = log_segments(replace(steps, now=late), 2.0)
    assert len(found) >= len(usual) - len(np.unique(usual.episode_id))
    assert not set(found.row) & set(usual.row[::2])
    assert found.left_out["no fresh pose at the start"] >= 1
    covered = found.row[:, None] + np.arange(found.horizon_steps)
    assert len(np.unique(covered)) == covered.size  # none overlap
    assert covered.size + sum(found.left_out.values()) == len(steps)
    jittered = {name: column.copy() for name, column in steps.now.items()}
    jittered["stamp_ns"][usual.row[0] + 3] += 10**8  # half a control period
    moved = log_segments(replace(steps, now=jittered), 2.0)
    assert moved.left_out["ticks not a control period apart"] == usual.row[0] + 4 - usual.row[0]


def test_noiseless_recording_is_replayed_exactly(noiseless: Path) -> None:
    with Store(noiseless) as store:
        found = log_segments(logged_steps(store), 3.0)
    free = found.take(~found.signals["bumped"].any(axis=1))
    replayed = replay_segments(free, [NOISELESS, KNOWN])
    same, other = position_gap_m(free, replayed)[:, :, -1]
    assert same.max() < 0.005
    assert np.median(other) > 0.05
    speed = replayed.signals["wheel_speed_mps"][0] - free.signals["wheel_speed_mps"]
    assert np.abs(speed).max() < 0.01


def test_residuals_interpolate_between_latencies(log: LoggedSegments) -> None:
    low, middle, high = ReplayResiduals(log.take(np.arange(4)), ("wheel speed",)).of(
        [Perturbation(latency_s=value) for value in (0.11, 0.1125, 0.12)]
    )["wheel speed"]
    assert np.abs(high - low).max() > 0.01
    assert middle == pytest.approx(0.75 * low + 0.25 * high)


def fit_store(store: Path, names: tuple[str, ...], **options: object) -> FittedTwin:
    with Store(store) as opened:
        return fit(opened, FitConfig(parameters=names, **options))  # type: ignore[arg-type]


def test_search_and_warm_up_cover_every_latency_of_a_fast_controller() -> None:
    most = RANGES["latency_s"][1]
    assert Coordinates(("latency_s",)).values(np.ones(1)) == pytest.approx(most)
    task = msgspec.structs.replace(load_profile("warehouse_amr").task, control_period_s=0.05)
    assert warmup_steps(task) * task.control_period_s >= most


@pytest.mark.long
def test_known_latency_gain_and_wheels_are_recovered(known: Path, tmp_path: Path) -> None:
    found = fit_store(
        known,
        ("latency_s", "gain", "wheel_radius_scale"),
        horizon_s=2.0,
        search_points=4,
        max_segments=12,
    )
    for item in found.estimates:
        true = getattr(KNOWN, item.name)
        assert item.fitted
        assert item.low is not None
        assert item.high is not None
        assert item.low < item.value < item.high
        tolerance = {"latency_s": 0.006, "gain": 0.005, "wheel_radius_scale": 0.01}[item.name]
        assert item.value == pytest.approx(true, abs=tolerance)
    assert found.noise["wheel speed"]["after"] < 0.3 * found.noise["wheel speed"]["before"]
    gap = next(item for item in found.held_out if item.horizon_s == 3.0)
    assert gap.after_m < 0.5 * gap.before_m

    write_fit(tmp_path / "fitted.toml", [found])
    assert load_perturbation(tmp_path / "fitted.toml") == found.perturbation
    with pytest.raises(ConfigError, match="already exists"):
        write_fit(tmp_path / "fitted.toml", [found])


def test_friction_under_standing_wheels_is_not_identified(log: LoggedSegments) -> None:
    some = log.take(np.arange(8))
    standing = replace(
        some,
        command=np.zeros_like(some.command),
        still=np.ones(8, np.bool_),
        signals={name: np.zeros_like(values) for name, values in some.signals.items()},
    )
    residuals = ReplayResiduals(standing)
    coordinates = Coordinates(("friction_scale",))
    solution = _least_squares(residuals, coordinates, np.array([0.5]), lambda text: None)
    uncertainty = measure_uncertainty(solution, standing.episode_id, seed=0)
    lost = unidentified(residuals, solution, uncertainty)
    assert lost is not None
    assert not lost.fitted
    assert lost.value == 1.0
    assert lost.note == "0.05 to 2 explain the log as well (wheels slide in 0.0% of the steps)"


def test_fleet_schedule_spans_identified_parameters(tmp_path: Path) -> None:
    def one(gain: float, friction: bool) -> FittedTwin:
        perturbation = Perturbation(name="one", gain=gain, friction_scale=0.5)
        return FittedTwin(
            perturbation=perturbation,
            recordings=("r",),
            estimates=(
                ParameterEstimate("gain", "", gain, gain - 0.01, gain + 0.01, True),
                ParameterEstimate("friction_scale", "", 0.5, 0.4, 0.6, friction),
            ),
            warnings=(),
            held_out=(),
            noise={},
            segments=9,
            clusters=9,
        )

    fits = [one(0.9, True), one(0.96, False)]
    assert fleet_schedule(fits).ranges == {"gain": (0.9, 0.96)}
    write_fit(tmp_path / "fleet.toml", fits)
    assert find_perturbation(str(tmp_path / "fleet.toml"), where="test") == fleet_schedule(fits)


def test_bumps_and_slippery_patches_are_not_ordinary_driving(log: LoggedSegments) -> None:
    log.signals["bumped"][:] = False
    log.signals["clearance_m"][:] = 1.0
    log = replace(log, true_condition=np.full(log.true_condition.shape, "nominal", "<U20"))
    log.signals["bumped"][0, 3] = True
    log.signals["clearance_m"][1, 0] = 0.01
    log.true_condition[2, 1] = "wheel_slip"
    kept, left = ordinary_driving(log)
    assert len(kept) == len(log) - 3
    assert left == {
        "bumped into something": 1,
        "within 0.05 m of something": 1,
        "on a slippery patch": 1,
    }


def test_held_out_segments_are_later_and_disjoint(log: LoggedSegments) -> None:
    before, after = split_at(log, held_out_from(log, 0.25, seed=0))
    assert before.any()
    assert after.any()
    assert not (before & after).any()
    stamps = log.signals["stamp_ns"]
    assert stamps[before].max() <= stamps[after].min()


def test_invalid_fit_requests_are_rejected(known: Path, shell: Shell) -> None:
    for words, error in (
        (("--parameters", "gain,grip"), "'grip' cannot be fitted"),
        (("--parameters", " ,"), "'' cannot be fitted"),
        (("--horizon-s", "0"), "a horizon of 0 s"),
        (("--segments", "0"), "0 segments"),
        (("--out", "fitted.json"), "'fitted.json'"),
        (("--per-recording", "--task", "none"), "not of none"),
    ):
        assert error in shell.err("twin", "fit", known, *words)
    with Store(known) as store:
        with pytest.raises(ConfigError, match="no recording 'nobody'"):
            fit(store, FitConfig(recordings=("nobody",)))
        with pytest.raises(StoreError, match=r"fewer than 8 \(of \d+: \d+ held out"):
            fit(store, FitConfig(parameters=("gain",), horizon_s=10.0))
        with pytest.raises(StoreError, match="no segment of 60 s"):
            fit(store, FitConfig(parameters=("gain",), horizon_s=60.0))
        with pytest.raises(ConfigError, match="must be a multiple of the control period"):
            fit(store, FitConfig(parameters=("gain",), horizon_s=0.35))


@pytest.mark.skipif(not BAGS.is_dir(), reason="needs ../shared/bags")
def test_other_robot_rejects_stand_in_parameters(tmp_path: Path) -> None:
    bag = BAGS / "turtlebot3-sim-humble"
    ingest(bag, load_profile("turtlebot3"), store=StoreWriter(tmp_path / "store"))
    with Store(tmp_path / "store") as store:
        with pytest.raises(ConfigError, match="is not the twin's: its mass and its contacts"):
            fit(store, FitConfig(parameters=("payload_kg",)))
        with pytest.raises(ConfigError, match="the log's pose is the wheels' odometry"):
            fit(store, FitConfig(parameters=("wheel_radius_scale",)))


@pytest.mark.slow
def test_all_parameters_of_known_robot_are_recovered(tmp_path: Path) -> None:
    true = msgspec.structs.replace(
        KNOWN,
        friction_scale=0.275,  # times .8: .22
        payload_kg=60.0,
        track_scale=1.02,
        latency_s=0.13,
        gain=0.96,
    )
    found = fit_store(store_of(tmp_path, true, missions=23), DEFAULT, held_out=0.25)
    within = {
        "friction_scale": 0.01,
        "payload_kg": 6.0,
        "wheel_radius_scale": 0.008,
        "track_scale": 0.008,
        "latency_s": 0.005,
        "gain": 0.003,
        "gyro_bias_radps": 0.003,
    }
    for item in found.estimates:
        if item.name in within:
            true_value = getattr(true, item.name)
            assert item.value == pytest.approx(true_value, abs=within[item.name]), item
    assert found.held_out[-1].after_m < 0.25 * found.held_out[-1].before_m


def test_fit_command_prints_json(known, monkeypatch, shell: Shell) -> None:
    of = "restock.train.twin.calibration.fit.FitConfig"
    monkeypatch.setattr(of, partial(FitConfig, search_points=2))
    line = ["twin", "fit", str(known), "--parameters", "gain", "--horizon-s", "2"]
    document = shell.json(*line, "--segments", "8")
    assert [item["name"] for item in document["fits"][0]["estimates"]] == ["gain"]
    assert document["out"] is None
