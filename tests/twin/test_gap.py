"""Measure the gap between twin and logs under a known perturbation, and its verdicts."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.page_scripts import charts_of
from support.paths import SHARED

from restock import cli
from restock.errors import RunError
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store
from restock.report import gap_page, write_page
from restock.stats import NOT_KNOWN, ConfidenceInterval
from restock.train.twin.calibration.gap import (
    AFTER,
    BEFORE,
    _ahead_m,
    _look_at_route,
    measure_gap,
    one_step,
)
from restock.train.twin.calibration.logged_steps import (
    logged_steps,
    observations,
    previous_action,
    sector_clearance,
)
from restock.train.twin.calibration.twin_gap import (
    TRUSTED,
    UNDECIDED,
    UNKNOWN,
    UNTRUSTED,
    GapConfig,
    TrustLimits,
    TwinGap,
    read_gap,
    trust_verdict,
    write_gap,
)
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.recording.recorder import RecordingPlan, record

pytestmark = pytest.mark.long

# Parameters of the recorded robot, which the nominal twin lacks.
TRUE = Perturbation(
    name="true", payload_kg=30.0, wheel_radius_scale=0.96, latency_s=0.15, gain=0.97
)
TURTLEBOT = SHARED / "turtlebot3-sim-humble"
CONFIG = GapConfig(max_segments=60, limits=TrustLimits(segments=10, episodes=3))


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of missions on dry and slippery floor, of a robot with the parameters TRUE."""
    folder = tmp_path_factory.mktemp("gap")
    shares = {"nominal": 0.5, "wheel_slip": 0.5}
    plan = RecordingPlan(missions=14, seed=5, conditions=shares, policy="planner", hardware=TRUE)
    record(folder / "log.mcap", plan)
    ingest(folder / "log.mcap", load_profile("warehouse_amr"), store=StoreWriter(folder / "store"))
    return folder / "store"


@pytest.fixture(scope="module")
def gap(stored: Path) -> TwinGap:
    with Store(stored) as store:
        return measure_gap(store, TRUE, CONFIG)


def position(gap: TwinGap, condition: str, source: str, horizon_s: float) -> dict[str, Any]:
    (row,) = [
        row
        for row in gap.paths
        if (row["condition"], row["source"], row["horizon_s"], row["quantity"])
        == (condition, source, horizon_s, "position")
    ]
    return row


@pytest.mark.parametrize("horizon_s", [3.0, 6.0])
def test_true_parameters_reduce_the_gap(gap, horizon_s):
    before, after = (
        position(gap, "nominal", source, horizon_s)["median"] for source in (BEFORE, AFTER)
    )
    assert after < 0.5 * before
    odometry = position(gap, "nominal", "odometry", horizon_s)["median"]
    assert after < odometry  # odometry assumes larger wheels


def test_slippery_floor_is_untrusted(gap: TwinGap) -> None:
    verdicts = {found.condition: found for found in gap.verdicts}
    assert verdicts["wheel_slip"].verdict == UNTRUSTED
    assert (
        "metres" in verdicts["wheel_slip"].reasons[0] or " m " in verdicts["wheel_slip"].reasons[0]
    )
    assert verdicts["nominal"].verdict == TRUSTED
    assert gap.untrusted == ["wheel_slip"]
    assert any("patches" in line for line in gap.not_done)


def test_true_parameters_reduce_one_step_gaps(gap: TwinGap) -> None:
    def of(component: str, source: str) -> float:
        return next(
            float(row["mean_gap"])
            for row in gap.observations
            if (row["component"], row["condition"], row["source"]) == (component, "nominal", source)
        )

    for component in ("wheel_speed", "gyro_yaw_rate", "near_sin"):
        assert of(component, AFTER) < min(of(component, BEFORE), of(component, "persistence"))
    terms = {row["term"] for row in gap.rewards}
    assert {"reward", "progress_per_m", "goal", "bump"} <= terms
    whole = {
        row["source"]: row["mean_gap"]
        for row in gap.rewards
        if (row["term"], row["condition"]) == ("progress_per_m", "nominal")
    }
    assert whole[AFTER] < whole[BEFORE]


def test_route_is_seen_from_the_twins_pose() -> None:
    """Place the twin 4 cm ahead of the log, 3 cm to the left and turned, on a plan to the north."""
    logged = {
        "pose_x_m": np.array([5.0]), "pose_y_m": np.array([2.0]),
        "pose_yaw_rad": np.array([np.pi / 2]),
        "waypoint_near_x_m": np.array([1.0]), "waypoint_near_y_m": np.array([0.0]),
        "waypoint_far_x_m": np.array([2.0]), "waypoint_far_y_m": np.array([0.0]),
        "route_remaining_m": np.array([6.0]), "goal_distance_m": np.array([0.03]),
    }  # fmt: skip
    twin = logged | {
        "pose_x_m": np.array([4.97]), "pose_y_m": np.array([2.04]),
        "pose_yaw_rad": np.array([np.pi / 2 + 0.1]),
    }  # fmt: skip
    assert _ahead_m(logged, logged, twin) == pytest.approx(0.04)
    _look_at_route(logged, twin)
    for point, away_m in (("near", 0.96), ("far", 1.96)):
        x, y = (float(twin[f"waypoint_{point}_{axis}_m"][0]) for axis in "xy")
        assert np.hypot(x, y) == pytest.approx(np.hypot(away_m, 0.03))
        assert np.arctan2(y, x) == pytest.approx(np.arctan2(-0.03, away_m) - 0.1)
    assert twin["route_remaining_m"] == pytest.approx(5.96)
    assert twin["goal_distance_m"] == 0.0  # it does not overshoot


def test_rebuilt_steps_match_the_log(stored: Path) -> None:
    with Store(stored) as store:
        steps = logged_steps(store)
        seen, after = observations(store, steps.transition_id, steps.task.observation_size)
    assert steps.followed.all()  # episode ends are stored in the files' metadata
    speed = steps.task.observation_names.index("wheel_speed")
    np.testing.assert_array_equal(after[:, speed], steps.after["wheel_speed_mps"])
    np.testing.assert_allclose(
        sector_clearance(steps.task, seen).min(axis=1),
        np.minimum(steps.now["clearance_m"], steps.task.range_max_m),
        atol=1e-5,
    )
    goes_on = ~steps.begins[1:]
    np.testing.assert_array_equal(
        previous_action(steps.task, seen)[1:][goes_on], steps.action[:-1][goes_on]
    )


def test_logged_reward_is_sum_of_terms(stored: Path) -> None:
    with Store(stored) as store:
        steps = logged_steps(store)
        rows = np.arange(0, len(steps), 5)
        found = one_step(store, steps, rows, {AFTER: TRUE}, GapConfig())
    assert found.unexplained == 0
    assert found.valid.all()
    np.testing.assert_allclose(sum(found.logged.terms.values()), found.logged.reward, atol=1e-3)


def test_gap_round_trips_and_renders(gap: TwinGap, tmp_path: Path) -> None:
    write_gap(gap, tmp_path / "gap")
    again = read_gap(tmp_path / "gap")
    assert again.verdicts == gap.verdicts
    assert again.about == json.loads(json.dumps(gap.about))
    assert again.paths == gap.paths
    page = write_page(gap_page(again), tmp_path / "gap" / "index.html").read_text()
    assert "Do not trust the twin in: wheel slip" in page
    assert charts_of(page)["charts"]
    write_gap(gap, tmp_path / "gap")  # a gap measured before is replaced
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").write_text("mine")
    with pytest.raises(RunError, match="already exists"):
        write_gap(gap, tmp_path / "other")
    with pytest.raises(RunError, match="no gap of the twin has been measured"):
        read_gap(tmp_path / "other")


def run(*args: object) -> int:
    return cli.main(["twin", "gap", *map(str, args)])


def test_gap_command_line(stored: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    few = ("--horizon-s", "3")
    (tmp_path / "true.toml").write_text('name = "true"\nwheel_radius_scale = 0.96\n')
    given = (stored, *few, "--perturbation", tmp_path / "true.toml", "--out", tmp_path / "gap")
    assert run(*given, "--json", "--check") == 1
    document = json.loads(capsys.readouterr().out)
    assert "wheel_slip" in document["untrusted"]
    assert document["about"]["twins"]["calibrated"]["wheel_radius_scale"] == 0.96
    assert (tmp_path / "gap" / "index.html").is_file()
    for wrong in (("--horizon-s", "0"), ("--segments", "0"), ("--trust-position-m", "-1")):
        assert run(stored, *wrong) == 2


@pytest.mark.skipif(not TURTLEBOT.is_dir(), reason=f"{TURTLEBOT.name} is not here")
def test_turtlebot3_gap_is_unknown(tmp_path: Path) -> None:
    ingest(TURTLEBOT, load_profile("turtlebot3"), store=StoreWriter(tmp_path))
    with Store(tmp_path) as store:
        gap = measure_gap(store)
    assert {found.verdict for found in gap.verdicts} == {UNKNOWN}  # one episode of half a minute
    text = " ".join(gap.not_done)
    assert "{" not in text
    for not_there in (
        "Lidar readings were not",
        "no goal and no plan",
        "wheel odometry",
        "no fitted",
    ):
        assert not_there in text, not_there
    assert position(gap, "nominal", BEFORE, 1.0)["median"] < 0.02
    assert not [row for row in gap.observations if row["component"].startswith("clearance_")]


GOOD, BAD, OPEN = (
    ConfidenceInterval(0.1, 0.05, 0.15),
    ConfidenceInterval(0.4, 0.3, 0.5),
    ConfidenceInterval(0.2, 0.1, 0.3),
)
FINE, WORSE = ConfidenceInterval(0.3, 0.2, 0.4), ConfidenceInterval(1.5, 1.2, 1.8)


@pytest.mark.parametrize(
    ("position_p90", "reward", "segments", "verdict"),
    [
        (GOOD, FINE, 50, TRUSTED),
        (BAD, FINE, 50, UNTRUSTED),
        (GOOD, WORSE, 50, UNTRUSTED),
        (GOOD, NOT_KNOWN, 50, TRUSTED),
        (OPEN, FINE, 50, UNDECIDED),
        (OPEN, WORSE, 50, UNTRUSTED),
        (BAD, WORSE, 19, UNKNOWN),
    ],
)
def test_trust_verdict_rule(position_p90, reward, segments, verdict):
    found = trust_verdict(
        "wheel_slip",
        limits=TrustLimits(),
        segments=segments,
        episodes=10,
        position_p90=position_p90,
        reward_ratio=reward,
    )
    assert found.verdict == verdict
    assert bool(found.reasons) == (verdict != TRUSTED)
