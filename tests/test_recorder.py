"""The recorder: what a recording holds is what the twin saw, and the same seed gives the same."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from restock import cli
from restock.errors import ConfigError, ExitCode
from restock.ingest.pipeline import ingest
from restock.ingest.profile import load_profile
from restock.ingest.store import StoreWriter
from restock.replay.store import Store
from restock.train.crew import FleetCrew
from restock.train.fleet import Driven, Fleet
from restock.train.missions import BLOCK, FLEET, NATURAL, parse_shares, schedule
from restock.train.perturbation import Perturbation
from restock.train.publish import LIDAR_LSB_M
from restock.train.recorder import HARDWARE, NOISELESS, Plan, parse_rates, record
from restock.train.robot_topics import TOPICS

EQUAL = {"nominal": 1.0, "wheel_slip": 1.0, "blocked_aisle": 1.0, "near_collision": 1.0}
TASK = load_profile("warehouse_amr").task


class Trip:
    """A recording's way: driven, written, ingested."""

    def __init__(self, hardware: Perturbation, folder: Path) -> None:
        self.plan = Plan(missions=5, seed=7, conditions=EQUAL, hardware=hardware)
        self.path = folder / "log.mcap"
        self.summary = record(self.path, self.plan)
        fleet = Fleet(hardware, scan_hz=self.plan.rates.scan)
        missions = schedule(self.plan.seed, EQUAL, "handover", hardware)
        crew = FleetCrew(fleet.env.num_envs, seed=self.plan.seed)
        self.driven: list[Driven] = list(fleet.drive(islice(missions, 5), crew))
        self.outcome = ingest(self.path, load_profile("warehouse_amr"), store=StoreWriter(folder))
        query = "FROM transitions ORDER BY episode_index, step_index"
        self.rows: pa.Table = Store(folder).sql(query).to_arrow_table()

    def saw(self, of: str, last: int | None = None, first: int = 0) -> NDArray[Any]:
        return np.concatenate([np.asarray(getattr(d, of))[first:last] for d in self.driven])

    def row(self, name: str) -> NDArray[Any]:
        column = self.rows[name].to_numpy()
        return np.stack(column) if column.dtype == object and len(column) else column


@pytest.fixture(scope="module", params=[NOISELESS, HARDWARE], ids=["noiseless", "hardware"])
def trip(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Trip:
    return Trip(request.param, tmp_path_factory.mktemp("trip"))


def test_ingest_finds_the_steps_that_were_driven(trip: Trip) -> None:
    steps = [len(driven.action) for driven in trip.driven]
    found = Counter(trip.rows["episode_index"].to_pylist())
    assert [found[index] for index in range(len(found))] == steps
    assert trip.outcome.losses == []
    ends = np.cumsum(steps) - 1
    assert np.flatnonzero(trip.row("terminated")).tolist() == [
        end
        for end, driven in zip(ends, trip.driven, strict=True)
        if driven.drive.signals["goal_distance_m"][-1] <= TASK.goal_radius_m
    ]


def test_observations_are_what_the_twin_saw(trip: Trip) -> None:
    """To the resolution of the sensors: 2 mm of the lidar, 1 mrad/s of the gyroscope, 4 mm/s2."""
    cut = 12 + len(TASK.actions)
    for name, seen in (
        ("observation", trip.saw("observation", last=-1)),
        ("next_observation", trip.saw("observation", first=1)),
    ):
        stored = trip.row(name)
        np.testing.assert_allclose(stored[:, :cut], seen[:, :cut], atol=6e-4)
        near, seen_near = stored[:, cut : cut + TASK.sectors], seen[:, cut : cut + TASK.sectors]
        metres = (near**2 - seen_near**2) * TASK.range_max_m  # the entries are roots of metres
        off = np.abs(metres) > LIDAR_LSB_M / 2 + 1e-5
        # A reading at the very end of the range counts as free beyond it: there, and only
        # there, rounding may make the difference.
        assert (np.maximum(near, seen_near)[off] == 1.0).all()
        assert off.mean() < 1e-3
        closing = np.abs(stored - seen)[:, cut + TASK.sectors :]
        assert np.quantile(closing, 0.999) < 2e-3


def test_actions_and_rewards_are_what_the_twin_gave(trip: Trip) -> None:
    assert trip.row("action").tolist() == trip.saw("action").tolist()
    # Only the cost of tightness is a threshold that the lidar's resolution can cross.
    clearance = np.concatenate([d.drive.signals["clearance_m"][1:] for d in trip.driven])
    on_edge = np.abs(clearance - TASK.rewards.tight_clearance_m) < LIDAR_LSB_M
    error = np.abs(trip.row("reward") - trip.saw("reward"))
    assert error[~on_edge].max() < 1e-5
    assert error.max() <= abs(TASK.rewards.tight) + 1e-5


def test_who_drove_and_what_was_true_come_through(trip: Trip) -> None:
    drives = [driven.drive for driven in trip.driven]
    who = [entry for drive in drives for entry in drive.policy]
    assert trip.rows["behaviour_policy"].to_pylist() == [name for name, _, _ in who]
    assert trip.rows["behaviour_version"].to_pylist() == [version for _, version, _ in who]
    assert trip.row("action_probability") == pytest.approx([p for _, _, p in who], abs=1e-4)
    truth = [name for drive in drives for name in drive.true_condition]
    assert trip.rows["true_condition"].to_pylist() == truth
    assert len({name for name, _, _ in who}) > 1  # the operator took over somewhere
    assert len(set(truth)) > 2


def test_missions_come_in_their_order_each_with_its_driver(trip: Trip) -> None:
    wanted = list(islice(schedule(trip.plan.seed, EQUAL, "handover", trip.plan.hardware), 5))
    assert [driven.mission for driven in trip.driven] == wanted
    assert len({len(driven.action) for driven in trip.driven}) > 1  # they did not end in order
    for driven in trip.driven:
        drivers = {(name, version) for name, version, _ in driven.drive.policy}
        assert (driven.mission.driver, driven.mission.version) in drivers
        assert drivers <= {(driven.mission.driver, driven.mission.version), ("operator", "1")}
        assert np.unique(driven.drive.command, axis=0).shape[0] > 1
        assert driven.drive.plans[0][1][-1] == pytest.approx(driven.drive.goal_m)


def test_the_summary_counts_what_is_in_the_file(trip: Trip) -> None:
    summary = trip.summary.describe()
    with AnyReader([trip.path]) as reader:
        assert summary["topics"] == {c.topic: c.msgcount for c in reader.connections}
        assert set(summary["topics"]) == {topic.name for topic in TOPICS}
        assert summary["messages"] == reader.message_count
    assert summary["minutes"] == pytest.approx(
        sum(len(d.action) for d in trip.driven) * 0.2 / 60, abs=1e-3
    )
    assert sum(summary["missions"].values()) == 5
    assert sum(summary["policy_steps"].values()) == len(trip.rows)


def test_both_formats_hold_the_same_drive(tmp_path: Path) -> None:
    tables = []
    for name, file_format in (("a.mcap", "mcap"), ("a", "rosbag2")):
        record(tmp_path / name, Plan(format=file_format, missions=1, seed=3))
        store = tmp_path / f"store_{file_format}"
        ingest(tmp_path / name, load_profile("warehouse_amr"), store=StoreWriter(store))
        columns = "observation, action, reward, next_observation, terminated, truncated, stamp_ns"
        query = (
            f"SELECT {columns}, condition, behaviour_policy FROM transitions ORDER BY step_index"
        )
        tables.append(Store(store).sql(query).to_arrow_table())
    assert len(tables[0]) > 20
    assert tables[0].equals(tables[1])


@pytest.mark.parametrize("policy", ["planner", "operator"])
def test_one_driver_alone_can_be_asked_for(tmp_path: Path, policy: str) -> None:
    summary = record(tmp_path / "log.mcap", Plan(missions=1, seed=3, policy=policy))
    assert set(summary.policies) == {f"{policy} 1"}
    assert summary.succeeded["nominal"] == summary.missions["nominal"] == 1


@pytest.mark.parametrize("name", ["a.mcap", "a"])
def test_the_same_seed_gives_the_same_bytes(tmp_path: Path, name: str) -> None:
    args = ["record", "--missions", "1", "--seed", "3", "--rates", "odom=10,imu=10,scan=5"]
    for folder in ("first", "second"):
        assert cli.main([*args, "--out", str(tmp_path / folder / name)]) == ExitCode.OK
    assert cli.main([*args[:4], "4", "--out", str(tmp_path / "third" / name)]) == ExitCode.OK
    first, second, third = (
        {
            str(file.relative_to(tmp_path / folder)): file.read_bytes()
            for file in (tmp_path / folder).rglob("*")
            if file.is_file()
        }
        for folder in ("first", "second", "third")
    )
    assert first == second
    assert first != third


def test_json_says_what_was_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "bag"
    code = cli.main(
        ["record", "--out", str(out), "--minutes", "0.01", "--policy", "random", "--json"]
    )
    said = json.loads(capsys.readouterr().out)
    assert code == ExitCode.OK
    assert said["format"] == "rosbag2"
    assert said["policy_steps"].keys() == {"random 1"}
    assert sorted(file.name for file in out.iterdir()) == ["bag.db3", "metadata.yaml"]
    with AnyReader([out]) as reader:
        assert reader.message_count == said["messages"]


def test_a_dry_run_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "log.mcap"
    assert cli.main(["record", "--out", str(out), "--dry-run", "--json"]) == ExitCode.OK
    said = json.loads(capsys.readouterr().out)
    assert (said["minutes"], said["format"], said["conditions"]) == (5.0, "mcap", NATURAL)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--conditions", "icy=1"], "'icy' is no kind of mission"),
        (["--conditions", "nominal=lots"], "'lots' is no share"),
        (["--conditions", "nominal=0"], "no condition has a share above 0"),
        (["--rates", "lidar=5"], "no rate named 'lidar'"),
        (["--rates", "scan=7"], "'7' is no rate"),
        (["--missions", "0"], "missions must be above 0"),
        (["--minutes", "1", "--missions", "1"], "exclude each other"),
        (["--seed", "-1"], "seed must be 0 or more"),
    ],
)
def test_a_wrong_value_is_one_clear_message(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = cli.main(["record", "--out", str(tmp_path / "log.mcap"), *flags])
    captured = capsys.readouterr()
    assert code == ExitCode.USAGE
    assert captured.out == ""
    assert message in captured.err
    assert list(tmp_path.iterdir()) == []


def test_a_recording_is_never_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "log.mcap").write_text("precious")
    assert cli.main(["record", "--out", str(tmp_path / "log.mcap")]) == ExitCode.USAGE
    assert "never overwritten" in capsys.readouterr().err
    assert (tmp_path / "log.mcap").read_text() == "precious"


def test_ctrl_c_leaves_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "restock", "record", "--minutes", "600", "--out"]
    process = subprocess.Popen([*command, str(tmp_path / "log.mcap")], stderr=subprocess.PIPE)
    deadline = time.monotonic() + 60
    while not any(file.stat().st_size for file in tmp_path.rglob("log.mcap")):
        assert time.monotonic() < deadline, "nothing was ever written"
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == ExitCode.INTERRUPTED
    assert b"interrupted" in said
    assert list(tmp_path.iterdir()) == []


def test_missions_come_at_their_shares_and_rare_ones_come_early() -> None:
    missions = list(islice(schedule(9, NATURAL, "handover", HARDWARE), 10 * BLOCK))
    kinds = Counter(mission.spec.condition for mission in missions)
    drivers = Counter(f"{mission.driver} {mission.version}" for mission in missions)
    for counted, shares in ((kinds, NATURAL), (drivers, FLEET)):
        assert {k: n / len(missions) for k, n in counted.items()} == pytest.approx(shares, abs=0.01)
    assert {mission.spec.condition for mission in missions[:BLOCK]} == set(NATURAL)
    assert len({mission.spec.seed for mission in missions}) == len(missions)


def test_flags_from_python() -> None:
    assert parse_shares("nominal=.5, wheel_slip=.5") == {"nominal": 0.5, "wheel_slip": 0.5}
    assert parse_rates("odom=20,scan=5").odom == 20
    assert parse_rates("").imu == 50
    with pytest.raises(ConfigError, match="give minutes or missions"):
        Plan()
