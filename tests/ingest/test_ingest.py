"""`restock ingest`: recordings in, a store out, its output and its exit codes."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.driven_robot import Drive, write_bag
from support.paths import ROOT, SHARED
from support.profile_texts import WAREHOUSE

from restock.cli import main
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store

BAGS = SHARED
TURTLEBOT = BAGS / "turtlebot3-sim-humble"

Run = Callable[..., tuple[int, Any, str]]


@pytest.fixture(scope="session")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a sqlite3 bag of a robot that reaches one goal and drives on to the next."""
    goals = [(0.0, 3.0, 1.0), (3.2, 11.0, 1.0)]
    return write_bag(Drive(goals=goals, truth="nominal"), tmp_path_factory.mktemp("bag") / "drive")


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Return a function that runs `restock ingest … --json`: exit code, document, stderr."""

    def ingest(*args: object) -> tuple[int, Any, str]:
        code = main(["ingest", *map(str, args), "--json"])
        out, err = capsys.readouterr()
        return code, json.loads(out) if out else None, err

    return ingest


def test_ingest_writes_transitions(bag, tmp_path, run):
    code, document, _ = run(bag, "--store", tmp_path / "s")
    assert code == 0
    (result,) = document["recordings"]
    assert (result["status"], result["transitions"], result["episodes"], result["ticks"]) == (
        "written", 29, 2, 30,
    )  # fmt: skip
    assert result["ticks"] == result["transitions"] + result["episode_ends"] + sum(
        drop["count"] for drop in result["drops"]
    )
    assert result["conditions"]["nominal"] == 29
    assert result["endings"] == {"goal": 1, "end of the recording": 1}
    topics = {topic["topic"]: topic for topic in result["topics"]}
    assert topics["/cmd_vel"]["expected"] == topics["/cmd_vel"]["decoded"] == 30
    assert result["messages"]["expected"] == result["messages"]["decoded"]
    with Store(tmp_path / "s") as store:
        rows = store.sql("SELECT count(*), count(*) FILTER (terminated) FROM transitions")
        assert rows.fetchall() == [(29, 1)]
        assert store.task() == load_profile("warehouse_amr").task
        assert [c.name for c in store.conditions()] == [
            c.name for c in load_profile("warehouse_amr").conditions
        ]


def test_known_recording_with_removed_profile_key_is_unchanged(bag, tmp_path, run, monkeypatch):
    store = tmp_path / "s"
    run(bag, "--store", store)
    manifest = StoreWriter.manifest

    def with_old_key(self: StoreWriter, recording_id: str) -> dict[str, Any] | None:
        found = manifest(self, recording_id)
        return found and found | {"profile_toml": "removed_key = 1\n" + found["profile_toml"]}

    monkeypatch.setattr(StoreWriter, "manifest", with_old_key)
    code, document, _ = run(bag, "--store", store)
    assert (code, document["recordings"][0]["status"]) == (0, "unchanged")


def test_unchanged_recording_is_skipped_and_changed_replaced(bag, tmp_path, run):
    store = tmp_path / "s"
    run(bag, "--store", store)
    code, document, _ = run(bag, "--store", store)
    assert (code, document["recordings"][0]["status"]) == (0, "unchanged")
    code, document, _ = run(bag, "--store", store, "--force")
    assert (code, document["recordings"][0]["status"]) == (0, "written")
    text = WAREHOUSE
    other = tmp_path / "other.toml"
    text = text.replace("time_limit_steps = 240", "time_limit_steps = 5")
    other.write_text(text.replace('name = "warehouse_amr"', 'name = "other"'))
    code, document, _ = run(bag, "--store", store, "--profile", other)
    assert (code, document["recordings"][0]["status"]) == (0, "written")
    # The same happens if a recording holds several robots, each with a profile.
    replaced = "replaces its 29 transitions of the profile 'warehouse_amr': a store keeps one set"
    assert [note for note in document["recordings"][0]["notes"] if note.startswith(replaced)]
    with Store(store) as opened:
        ((rows, hashes),) = opened.sql(
            "SELECT count(*), count(DISTINCT profile_hash) FROM transitions"
        ).fetchall()
    assert (rows, hashes) == (29, 1)


def test_dry_run_writes_nothing(bag, tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, document, _ = run(bag, "--dry-run")
    assert (code, document["recordings"][0]["status"]) == (0, "dry run")
    assert document["recordings"][0]["transitions"] == 29
    assert list(tmp_path.iterdir()) == []


def test_two_workers_write_the_same_store_as_one(tmp_path, run):
    bags = [write_bag(Drive(duration_s=2.0 + n), tmp_path / f"bag{n}") for n in range(3)]
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"")
    found = []
    for workers in (1, 2):
        store = tmp_path / f"store{workers}"
        code, document, err = run(bags[0], bad, *bags[1:], "--store", store, "--workers", workers)
        assert code == 3
        assert "bad.mcap" in err
        assert [row["path"] for row in document["recordings"]] == [*map(str, bags), str(bad)]
        with Store(store) as opened:
            found.append(
                opened.sql(
                    "SELECT * EXCLUDE (ingest_id) FROM transitions ORDER BY transition_id"
                ).to_arrow_table()
            )
    assert len(found[0]) > 20
    assert found[0].equals(found[1])


def test_invalid_recording_leaves_store_unchanged(bag, tmp_path, run):
    store, bad = tmp_path / "s", tmp_path / "bad.mcap"
    run(bag, "--store", store)
    bad.write_bytes(b"hello, I am no recording at all")
    before = {path: path.stat().st_mtime_ns for path in store.rglob("*")}
    code, _, err = run(bad, "--store", store)
    assert code == 2
    assert err.count("restock: ") == 1
    assert "bad.mcap" in err
    assert "Traceback" not in err
    assert {path: path.stat().st_mtime_ns for path in store.rglob("*")} == before


def test_wrong_profile_reports_missing_topics(bag, tmp_path, run):
    text = WAREHOUSE
    other = tmp_path / "other.toml"
    other.write_text(text.replace('"/scan"', '"/front/scan"').replace('"/imu"', '"/odom"'))
    code, _, err = run(bag, "--store", tmp_path / "s", "--profile", other)
    assert code == 2
    assert "no topic /front/scan (scan)" in err
    assert "/odom holds nav_msgs/msg/Odometry, not sensor_msgs/msg/Imu (imu)" in err
    assert "/amcl_pose" in err
    assert not (tmp_path / "s").exists()


def test_renamed_optional_topic_gets_suggestion(bag, tmp_path, run):
    """A renamed driver topic would otherwise leave rows that claim to lack the sensor."""
    other = tmp_path / "other.toml"
    other.write_text(WAREHOUSE.replace('topic = "/imu"', 'optional = true\ntopic = "/front/imu"'))
    _, document, _ = run(bag, "--dry-run", "--profile", other)
    notes = document["recordings"][0]["notes"]
    assert "imu: no topic /front/imu in this recording: did you mean /imu?" in notes


def test_no_usable_step_is_an_error_with_reasons(tmp_path, run):
    drive = write_bag(Drive(goals=[(0.0, 1.2, 1.0)]), tmp_path / "bag")  # starts at its goal
    code, _, err = run(drive, "--store", tmp_path / "s")
    assert code == 2
    assert "goal already reached: 30 of 30 ticks" in err
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ([], "no path given"),
        (["x.mcap"], "no store given"),
        (["x.mcap", "--store", "s", "--workers", "0"], "--workers must be 1 or more, got 0"),
        (["x.mcap", "--store", "s", "--profile", "warehouse"], "did you mean 'warehouse_amr'"),
    ],
)
def test_wrong_usage_is_reported(args, message, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, err = run(*args)
    assert code == 2
    assert message in err


@pytest.mark.skipif(not TURTLEBOT.is_dir(), reason=f"{TURTLEBOT.name} is not here")
def test_ingest_of_turtlebot3_sim_humble(tmp_path, run):
    """A recording from elsewhere: 29 s of driving at 5 Hz, no goal, simulated time."""
    code, document, _ = run(TURTLEBOT, "--store", tmp_path / "s", "--profile", "turtlebot3")
    assert code == 0
    (result,) = document["recordings"]
    assert result["ticks"] == 140  # one per command
    assert result["transitions"] == 138
    assert result["drops"] == [{"reason": "scan: not yet received", "count": 1}]
    assert result["clock_offset_ns"] * 1e-9 == pytest.approx(1_701_217_691.8, abs=0.05)
    topics = {topic["topic"]: topic for topic in result["topics"]}
    assert topics["/imu"]["decoded"] == 5636
    assert "unknown type" in topics["/performance_metrics"]["reason"]
    assert {item["input"] for item in result["stand_ins"]} >= {"goal", "plan", "bumper"}
    with Store(tmp_path / "s") as store:
        ((span_s, moved_m),) = store.sql(
            "SELECT (max(stamp_ns) - min(stamp_ns)) / 1e9, sum(progress_m) FROM transitions"
        ).fetchall()
    assert span_s == pytest.approx(27.5, abs=0.5)
    assert 1 < moved_m < 6  # 0.2 m/s with turns


def test_label_scores_of_sample_log_match_docs(run):
    code, document, _ = run(ROOT / "sample_logs" / "amr_monday.mcap", "--dry-run")
    assert code == 0
    page = (ROOT / "docs" / "ingest.md").read_text()
    scores = {score["condition"]: score for score in document["recordings"][0]["label_scores"]}
    for exposure in document["recordings"][0]["exposures"]:  # docs/profile.md covers exposures
        assert scores.pop(exposure)["support"] > 0
    for name, score in scores.items():
        found = re.search(rf"^\| `{name}` \| default \| ([.\d]+) / ([.\d]+) \|", page, re.M)
        assert found, name
        reported = [float(value) for value in found.groups()]
        assert reported == pytest.approx([score["precision"], score["recall"]], abs=0.1), (
            f"docs/ingest.md should say {score}"
        )
