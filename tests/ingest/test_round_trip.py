"""Round trip: ingesting a recording of the twin gives the steps that the twin saw.

Compared row by row, for both formats, scripted and learned drivers, slip, blocks and traffic,
with sensor noise and latency. Rows may differ only by what a real robot's messages lose, too:

| quantity | largest error | reason |
| --- | --- | --- |
| action, episode, step, terminated, truncated, behaviour policy | 0 | |
| gyro_yaw_rate, slip_yaw_rate | 2^-11 rad/s | the gyroscope's resolution is 2^-10 rad/s |
| accel_x | 2^-9 / 5 | the accelerometer's is 2^-8 m/s2; the entry is a fifth of it |
| localised_speed, lateral_speed, slip_speed | 1e-5 m/s | single-precision poses 0.2 s apart |
| other scalars | 2e-6 | poses and odometry in single precision, headings as quaternions |
| clearance_* | 2^-10 m, in metres | the lidar's resolution is 2^-9 m, and float32 |
| closing_* | 1e-6 from the difference of the stored clearances | defined as their difference |
| reward | 1e-5 | as above; a clearance within the lidar's resolution of `tight_clearance_m` may
cost on one side only |
| action_probability | 1e-4 | published with four digits |

A range within the lidar's resolution of `range_max_m` may count as free on one side only. Only
these entries may differ by more, and they must be few.
"""

from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray
from support.kept_run import kept_run

from restock.cli.twin.record import load_policy
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store
from restock.train.twin.physics.perturbation import Perturbation, Schedule
from restock.train.twin.recording.bag_writer import Format
from restock.train.twin.recording.fleet import (
    HANDOVER,
    VERSIONS,
    BehaviourPolicies,
    DrivenMission,
    ExternalPolicy,
    Fleet,
    Mission,
    schedule,
)
from restock.train.twin.recording.publish import ACCEL_LSB_MPS2, GYRO_LSB_RADPS, LIDAR_LSB_M
from restock.train.twin.recording.recorder import HARDWARE, NOISELESS, RecordingPlan, record

TASK = load_profile("warehouse_amr").task
EQUAL = {"nominal": 1.0, "wheel_slip": 1.0, "blocked_aisle": 1.0, "near_collision": 1.0}
MISSIONS = 5
ROUGH = Schedule(
    name="rough",
    ranges={"latency_s": (0.1, 0.2), "lidar_dropout": (0.02, 0.1), "friction_scale": (0.5, 1.0)},
    base=Perturbation(
        payload_kg=40.0,
        wheel_radius_scale=0.97,
        lidar_noise_m=0.03,
        localisation_noise_m=0.01,
        localisation_drift_m=0.05,
        encoder_noise_radps=0.1,
        gyro_noise_radps=0.02,
        gyro_bias_radps=0.03,
        accel_noise_mps2=0.2,
        accel_bias_mps2=0.1,
        encoder_bias_radps=0.05,
        lidar_period_s=0.4,
        localisation_period_s=0.4,
    ),
)
SINGLE = 2e-6  # error of poses on this floor in single precision
SCALARS = {
    "gyro_yaw_rate": GYRO_LSB_RADPS / 2,
    "slip_yaw_rate": GYRO_LSB_RADPS / 2,
    "accel_x": ACCEL_LSB_MPS2 / 2 / 5,
    "localised_speed": 1e-5,
    "lateral_speed": 1e-5,
    "slip_speed": 1e-5,
}


@dataclass(frozen=True)
class RecordingCase:
    """One way to record: hardware, format and driver."""

    hardware: Perturbation | Schedule
    format: Format = "mcap"
    policy: str = HANDOVER
    epsilon: float | None = None


CASES = {
    "noiseless mcap": RecordingCase(NOISELESS),
    "stand-in rosbag2": RecordingCase(HARDWARE, "rosbag2"),
    "a run, perturbed, mcap": RecordingCase(ROUGH, "mcap", "run:", 0.25),
    "a run, stand-in, rosbag2": RecordingCase(HARDWARE, "rosbag2", "run:", 0.0),
}


@dataclass
class RoundTrip:
    """Recording that was driven, written and ingested."""

    case: RecordingCase
    folder: Path
    plan: RecordingPlan = field(init=False)
    driven: list[DrivenMission] = field(init=False)
    rows: pa.Table = field(init=False)

    def __post_init__(self) -> None:
        case, policy = self.case, self.case.policy
        if policy == "run:":
            policy += str(kept_run(self.folder / "learner"))
        self.plan = RecordingPlan(
            format=case.format,
            missions=MISSIONS,
            seed=7,
            conditions=EQUAL,
            policy=policy,
            epsilon=case.epsilon,
            hardware=case.hardware,
        )
        self.path = self.folder / ("log.mcap" if case.format == "mcap" else "log")
        loaded = load_policy(policy)
        self.summary = record(self.path, self.plan, policy=loaded)
        # Drive the same missions again: the twin is deterministic, and its states are not on disk.
        fleet = Fleet(case.hardware, stops=case.policy != HANDOVER, scan_hz=self.plan.rates.scan)
        external = loaded and ExternalPolicy(loaded, epsilon=case.epsilon or 0.0, seed=7)
        drivers = BehaviourPolicies(
            fleet.env.num_envs, seed=7, epsilon=case.epsilon, external=external
        )
        self.missions = list(islice(_missions(self.plan, loaded), MISSIONS))
        self.driven = list(fleet.drive(iter(self.missions), drivers))
        store = self.folder / "store"
        self.outcome = ingest(self.path, load_profile("warehouse_amr"), store=StoreWriter(store))
        query = "FROM transitions ORDER BY episode_index, step_index"
        self.rows = Store(store).sql(query).to_arrow_table()

    def twin_values(self, attribute: str, last: int | None = None, first: int = 0) -> NDArray[Any]:
        return np.concatenate([np.asarray(getattr(d, attribute))[first:last] for d in self.driven])

    def twin_signal(self, name: str) -> NDArray[Any]:
        return np.concatenate([d.drive.signals[name][1:] for d in self.driven])

    def row_values(self, name: str) -> NDArray[Any]:
        column = self.rows[name].to_numpy()
        return np.stack(column) if column.dtype == object and len(column) else column

    @property
    def steps(self) -> list[int]:
        return [len(driven.action) for driven in self.driven]


def _missions(plan: RecordingPlan, policy: Any) -> Any:
    driver, version = plan.policy, VERSIONS.get(plan.policy, "1")
    if policy is not None:
        driver, version = policy.name, policy.version
    return schedule(plan.seed, plan.conditions, driver, plan.hardware, version=version)


FAST_CASES = ("stand-in rosbag2", "a run, perturbed, mcap")  # they cover all differences
PARAMS = [
    pytest.param(case, id=name, marks=() if name in FAST_CASES else pytest.mark.long)
    for name, case in CASES.items()
]


@pytest.fixture(scope="module", params=PARAMS)
def trip(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RoundTrip:
    return RoundTrip(request.param, tmp_path_factory.mktemp("trip"))


def test_every_step_is_in_its_episode(trip: RoundTrip) -> None:
    assert trip.outcome.lost_messages == []
    assert trip.rows.num_rows == sum(trip.steps)
    episode = [index for index, steps in enumerate(trip.steps) for _ in range(steps)]
    assert trip.rows["episode_index"].to_pylist() == episode
    step = [step for steps in trip.steps for step in range(steps)]
    assert trip.rows["step_index"].to_pylist() == step
    assert set(trip.summary.missions) == set(EQUAL)


def test_episode_endings_match(trip: RoundTrip) -> None:
    last = np.cumsum(trip.steps) - 1
    reached = last[[driven.terminated for driven in trip.driven]]
    assert np.flatnonzero(trip.row_values("terminated")).tolist() == reached.tolist()
    cut = last[[not driven.terminated for driven in trip.driven]]
    assert np.flatnonzero(trip.row_values("truncated")).tolist() == cut.tolist()


def test_observations_match_twin(trip: RoundTrip) -> None:
    names = TASK.observation_names
    place = {name: index for index, name in enumerate(names)}
    near = [place[name] for name in names if name.startswith("clearance_")]
    closing = [place[name] for name in names if name.startswith("closing_")]
    others = [name for name in names if not name.startswith(("clearance_", "closing_"))]
    for column, seen in (
        ("observation", trip.twin_values("observation", last=-1)),
        ("next_observation", trip.twin_values("observation", first=1)),
    ):
        stored = trip.row_values(column)
        for name in others:
            error = np.abs(stored[:, place[name]] - seen[:, place[name]])
            assert error.max() <= SCALARS.get(name, SINGLE) + SINGLE, (column, name)
        # The entries are square roots of the share of the maximum range.
        metres = np.abs(stored[:, near] ** 2 - seen[:, near] ** 2) * TASK.range_max_m
        off = metres > LIDAR_LSB_M / 2 + 1e-5
        assert (np.maximum(stored[:, near], seen[:, near])[off] == 1.0).all(), column
        assert off.mean() < 1e-3, column
    before, after = trip.row_values("observation"), trip.row_values("next_observation")
    change = after[:, near] - before[:, near]
    np.testing.assert_allclose(after[:, closing], change, atol=1e-6)
    first = trip.row_values("step_index") == 0
    assert not before[first][:, closing].any()


def test_navigation_commands_match_twin(trip: RoundTrip) -> None:
    names = ("nav_speed_mps", "nav_yaw_rate_radps")
    seen = [np.concatenate([d.drive.signals[name][:-1] for d in trip.driven]) for name in names]
    for name, values in zip(names, seen, strict=True):
        np.testing.assert_array_equal(trip.row_values(name), values.astype(np.float32))
    # The planner drives as it proposes unless it explores; other drivers need not.
    given = np.concatenate([d.drive.command for d in trip.driven])
    same = (np.stack(seen, axis=-1) == given).all(axis=1)
    drivers = [entry for driven in trip.driven for entry in driven.drive.policy]
    planned = np.array([entry[:2] == ("planner", "1") and entry[2] > 0.5 for entry in drivers])
    assert same[planned].all()
    assert same[~planned].mean() < 0.9


def test_next_observation_equals_observation_of_next_row(trip: RoundTrip) -> None:
    same = np.diff(trip.row_values("episode_index")) == 0
    before, after = trip.row_values("observation"), trip.row_values("next_observation")
    np.testing.assert_array_equal(after[:-1][same], before[1:][same])


def test_actions_and_rewards_match_twin(trip: RoundTrip) -> None:
    assert trip.row_values("action").tolist() == trip.twin_values("action").tolist()
    clearance = trip.twin_signal("clearance_m")
    on_edge = np.abs(clearance - TASK.rewards.tight_clearance_m) < LIDAR_LSB_M
    error = np.abs(trip.row_values("reward") - trip.twin_values("reward"))
    assert error[~on_edge].max() < 1e-5
    assert error.max() <= abs(TASK.rewards.tight) + 1e-5
    assert on_edge.mean() < 0.05


def test_drivers_conditions_and_perturbations_match_twin(trip: RoundTrip) -> None:
    drives = [driven.drive for driven in trip.driven]
    drivers = [entry for drive in drives for entry in drive.policy]
    assert trip.rows["behaviour_policy"].to_pylist() == [name for name, _, _ in drivers]
    assert trip.rows["behaviour_version"].to_pylist() == [version for _, version, _ in drivers]
    assert trip.row_values("action_probability") == pytest.approx(
        [p for _, _, p in drivers], abs=1e-4
    )
    truth = [name for drive in drives for name in drive.true_condition]
    assert trip.rows["true_condition"].to_pylist() == truth
    assert len(set(truth)) > 2
    parameters = [_parameters(driven.mission) for driven in trip.driven]
    assert trip.rows["perturbation"].to_pylist() == [
        item.name for item, steps in zip(parameters, trip.steps, strict=True) for _ in range(steps)
    ]
    firsts = np.cumsum([0, *trip.steps[:-1]])
    for first, item in zip(firsts.tolist(), parameters, strict=True):
        assert dict(trip.rows["perturbation_values"][first].as_py()) == item.changed()
    if trip.case.policy == HANDOVER:
        assert len({name for name, _, _ in drivers}) > 1  # the operator took over in some episode
    else:
        assert {(name, version) for name, version, _ in drivers} == {("dqn", "learner@7")}
        greedy = 1 - trip.plan.epsilon + trip.plan.epsilon / len(TASK.actions)
        chances = {greedy, trip.plan.epsilon / len(TASK.actions)} - {0.0}
        assert {round(p, 5) for _, _, p in drivers} == {round(p, 5) for p in chances}


def _parameters(mission: Mission) -> Perturbation:
    assert mission.spec.perturbation is not None
    return mission.spec.perturbation
