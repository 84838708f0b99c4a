"""Check the reader of logged steps and the open-loop driver that fit and gap share."""

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.paths import ROOT, SHARED

from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import Profile, load_profile
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store
from restock.train.twin.calibration.logged_steps import LoggedSteps, logged_steps
from restock.train.twin.calibration.open_loop import (
    POSE,
    OpenLoopStart,
    drive_open_loop,
    log_segments,
)
from restock.train.twin.physics.perturbation import Perturbation

LATE = Perturbation(name="late", latency_s=0.15, wheel_radius_scale=0.96, gyro_bias_radps=0.01)


def with_slow_rate(profile: Profile) -> Profile:
    """Return the profile with steps .3 s apart, at a steady rate instead of one per command."""
    task = msgspec.structs.replace(profile.task, control_period_s=0.3)
    clock = msgspec.structs.replace(profile.clock, steps="rate")
    return msgspec.structs.replace(profile, task=task, clock=clock)


LOGS = {
    "sample log": (ROOT / "sample_logs" / "amr_tuesday", load_profile("warehouse_amr")),
    "steady rate": (
        ROOT / "sample_logs" / "amr_tuesday",
        with_slow_rate(load_profile("warehouse_amr")),
    ),
    "turtlebot3": (SHARED / "turtlebot3-sim-humble", load_profile("turtlebot3")),
}


@pytest.fixture(scope="module", params=LOGS)
def store(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    log, profile = LOGS[request.param]
    if not log.exists():
        pytest.skip(f"{log} is not here")
    folder = tmp_path_factory.mktemp("logged")
    ingest(log, profile, store=StoreWriter(folder))
    return folder


@pytest.fixture
def steps(store: Path) -> Iterator[LoggedSteps]:
    with Store(store) as opened:
        yield logged_steps(opened)


def start_of(steps: LoggedSteps, rows: np.ndarray, count: int) -> OpenLoopStart:
    """Return the start of a drive of `count` periods from these rows."""
    now = {name: column[rows] for name, column in steps.now.items()}
    pose = np.stack([now[name] for name in POSE], axis=-1)
    return OpenLoopStart(pose, now, steps.commands(rows, 0, count), past=steps.commands(rows, 5, 0))


def test_fit_and_gap_read_the_same_rows(store: Path, steps: LoggedSteps) -> None:
    cut = log_segments(steps, 1.2)
    rows = cut.row[:, None] + np.arange(cut.horizon_steps)
    with Store(store) as opened:
        table = opened.connection.sql(
            "SELECT transition_id, pose_x_m, wheel_speed_mps, command_speed_mps, primary_condition"
            " FROM transitions ORDER BY recording_id, episode_index, step_index"
        ).fetchnumpy()
    assert len(cut) > 5
    assert np.array_equal(table["transition_id"], steps.transition_id)
    assert np.array_equal(table["primary_condition"][rows].astype(str), cut.condition)
    for name in ("pose_x_m", "wheel_speed_mps"):
        stored = np.asarray(table[name], np.float64)
        assert np.array_equal(stored, steps.now[name])
        assert np.array_equal(stored[rows], cut.signals[name][:, :-1])
        # The gap's next step is the end of the fit's segment.
        assert np.array_equal(steps.after[name][rows[:, -1]], cut.signals[name][:, -1])
    commanded = np.asarray(table["command_speed_mps"], np.float64)
    assert np.array_equal(commanded[rows], cut.command[:, cut.warmup_steps :, 0])
    assert np.array_equal(steps.commands(cut.row, 0, cut.horizon_steps)[..., 0], commanded[rows])
    assert steps.followed[rows].all()


def test_single_step_equals_start_of_longer_drive(steps: LoggedSteps) -> None:
    rows = log_segments(steps, 1.2).row[::3]
    single, longer = (
        drive_open_loop(steps.task, start_of(steps, rows, count), [Perturbation(), LATE])
        for count in (1, 4)
    )
    assert single.pose.shape == (2, len(rows), 2, 3)
    assert np.array_equal(single.pose, longer.pose[:, :, :2])
    for name, values in single.signals.items():
        assert np.array_equal(values, longer.signals[name][..., :2]), name
    assert np.array_equal(single.sliding_mps, longer.sliding_mps[..., :2])
