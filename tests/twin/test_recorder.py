"""Check the recorder: identical bytes for a seed, policies, options and interruptions."""

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from datetime import datetime
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from support.long import one_in

from restock import cli
from restock.errors import ConfigError, ExitCode
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store
from restock.train.twin.missions import NATURAL
from restock.train.twin.recording.fleet import BLOCK, FLEET, parse_shares, schedule
from restock.train.twin.recording.recorder import (
    HARDWARE,
    RecordingPlan,
    parse_rates,
    parse_start,
    record,
)


@pytest.mark.long
@pytest.mark.parametrize(("name", "file_format"), [("a.mcap", "mcap"), ("a", "rosbag2")])
def test_recording_keeps_tags_and_start_time(tmp_path, name, file_format):
    """Read tags and start time with ingest; tests/ingest/test_round_trip.py compares the drive."""
    tags, start_ns = {"robot": "amr-07", "line": "007"}, parse_start("2026-10-05T10:00+02:00")
    plan = RecordingPlan(format=file_format, missions=1, seed=3, tags=tags, start_ns=start_ns)
    record(tmp_path / name, plan)
    ingest(tmp_path / name, load_profile("warehouse_amr"), store=StoreWriter(tmp_path / "store"))
    with Store(tmp_path / "store") as store:
        query = "SELECT DISTINCT robot, tags, date_trunc('hour', logged_time) FROM transitions"
        assert store.sql(query).fetchall() == [("amr-07", tags, datetime(2026, 10, 5, 8))]


@pytest.mark.parametrize("name", one_in(2, ["a.mcap", "a"]))
def test_same_seed_gives_identical_files(tmp_path: Path, name: str) -> None:
    args = ["twin", "record", "--missions", "1", "--seed", "3", "--rates", "odom=10,imu=10,scan=5"]
    for folder in ("first", "second"):
        assert cli.main([*args, "--out", str(tmp_path / folder / name)]) == ExitCode.OK
    assert cli.main([*args[:5], "4", "--out", str(tmp_path / "third" / name)]) == ExitCode.OK
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


def test_record_prints_json_summary(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "bag"
    code = cli.main(
        ["twin", "record", "--out", str(out), "--minutes", "0.01", "--policy", "random", "--json"]
    )
    printed = json.loads(capsys.readouterr().out)
    assert code == ExitCode.OK
    assert printed["format"] == "rosbag2"
    assert printed["policy_steps"].keys() == {"random 1"}
    assert sorted(file.name for file in out.iterdir()) == ["bag.db3", "metadata.yaml"]
    with AnyReader([out]) as reader:
        assert reader.message_count == printed["messages"]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--conditions", "icy=1"], "'icy' is unknown"),
        (["--rates", "scan=7"], "scan must be 5 or 10, got 7"),
        (["--minutes", "1", "--missions", "1"], "cannot be combined"),
        (["--seed", "-1"], "seed must be 0 or more"),
        (["--policy", "onnx:nowhere.onnx"], "nowhere.onnx: no such file"),
        (["--policy", "random", "--epsilon", ".1"], "random already takes every action"),
        (["--layouts", "moon"], "moon"),
        (["--out", "drive.txt"], "ends in .mcap"),
    ],
)
def test_invalid_record_option_is_rejected(flags, message, tmp_path, capsys):
    code = cli.main(["twin", "record", "--out", str(tmp_path / "log.mcap"), *flags])
    captured = capsys.readouterr()
    assert code == ExitCode.USAGE
    assert captured.out == ""
    assert message in captured.err
    assert list(tmp_path.iterdir()) == []


def test_dated_name_is_a_folder(tmp_path: Path) -> None:
    dated = str(tmp_path / "drive.2026-10-05")
    assert cli.main(["twin", "record", "--out", dated, "--dry-run"]) == ExitCode.OK


def test_recording_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "log.mcap").write_text("precious")
    assert cli.main(["twin", "record", "--out", str(tmp_path / "log.mcap")]) == ExitCode.USAGE
    assert (tmp_path / "log.mcap").read_text() == "precious"


@pytest.mark.long
def test_ctrl_c_leaves_no_files(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "restock", "twin", "record", "--minutes", "600", "--out"]
    process = subprocess.Popen([*command, str(tmp_path / "log.mcap")], stderr=subprocess.PIPE)
    deadline = time.monotonic() + 240
    while not any(file.stat().st_size for file in tmp_path.rglob("log.mcap")):
        assert time.monotonic() < deadline, "nothing was ever written"
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=240)
    assert process.returncode == ExitCode.INTERRUPTED
    assert b"interrupted" in errors
    assert list(tmp_path.iterdir()) == []


def test_mission_schedule_meets_shares() -> None:
    missions = list(islice(schedule(9, NATURAL, "handover", HARDWARE), 10 * BLOCK))
    kinds = Counter(mission.spec.condition for mission in missions)
    drivers = Counter(f"{mission.driver} {mission.version}" for mission in missions)
    for counted, shares in ((kinds, NATURAL), (drivers, FLEET)):
        assert {k: n / len(missions) for k, n in counted.items()} == pytest.approx(shares, abs=0.01)
    assert {mission.spec.condition for mission in missions[:BLOCK]} == set(NATURAL)
    assert len({mission.spec.seed for mission in missions}) == len(missions)


def test_record_options_are_parsed() -> None:
    assert parse_shares("nominal=.5, wheel_slip=.5") == {"nominal": 0.5, "wheel_slip": 0.5}
    assert parse_rates("odom=20,scan=5").odom == 20
    assert parse_rates("").imu == 50
    assert parse_start("2026-10-05T08:00") == parse_start("2026-10-05T10:00+02:00")
    assert parse_start("1970-01-02") == 86_400 * 10**9
    with pytest.raises(ConfigError, match="'soon' is not a time"):
        parse_start("soon")
    with pytest.raises(ConfigError, match="between 1970 and 2200"):
        RecordingPlan(missions=1, start_ns=-1)
    with pytest.raises(ConfigError, match="not a name of a tag"):
        RecordingPlan(missions=1, tags={"": "x"})
    with pytest.raises(ConfigError, match="give either minutes or missions"):
        RecordingPlan()


class _Creeper:
    """Custom policy with a name and a version."""

    name, version = "creeper", "3"

    def act(self, env: object, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.full(len(observation), 1), np.full(len(observation), self.chance)

    chance = 1.0


def test_custom_policy_is_recorded_by_name(tmp_path: Path) -> None:
    done = record(tmp_path / "log.mcap", RecordingPlan(missions=1, seed=3), policy=_Creeper())
    assert set(done.policies) == {"creeper 3"}
    unsure = _Creeper()
    unsure.chance = 0.5
    with pytest.raises(ConfigError, match="is stochastic itself"):
        record(tmp_path / "b.mcap", RecordingPlan(missions=1, epsilon=0.1), policy=unsure)
