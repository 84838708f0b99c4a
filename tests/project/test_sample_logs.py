"""The sample logs match their manifest, are small, varied and readable, and can be made again."""

import hashlib
import json
import subprocess
import sys
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from support.paths import ROOT

from restock.train.twin.recording.robot_topics import TOPICS

SAMPLES = ROOT / "sample_logs"
MAKE = SAMPLES / "make.py"
RECORDINGS = ("amr_monday.mcap", "amr_tuesday")
ALL = {topic.name for topic in TOPICS}


@pytest.fixture(scope="module")
def manifest() -> dict[str, Any]:
    return json.loads((SAMPLES / "manifest.json").read_text(encoding="utf-8"))


def test_sample_logs_match_their_manifest(manifest: dict[str, Any]) -> None:
    for name, entry in manifest["files"].items():
        assert hashlib.sha256((SAMPLES / name).read_bytes()).hexdigest() == entry["sha256"], name
    assert sum(entry["bytes"] for entry in manifest["files"].values()) <= 12_000_000


@pytest.mark.long
@pytest.mark.parametrize("name", RECORDINGS)
def test_sample_logs_have_all_topics_and_decode(name: str) -> None:
    with AnyReader([SAMPLES / name]) as reader:
        assert {connection.topic for connection in reader.connections} == ALL
        decoded = {
            connection.topic: reader.deserialize(data, connection.msgtype)
            for connection, _, data in reader.messages()
        }
    assert decoded.keys() == ALL
    assert decoded["/scan"].header.frame_id == "laser_link"


@pytest.mark.long
def test_mcap_library_finds_chunks_undamaged() -> None:
    with (SAMPLES / "amr_monday.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        count = sum(1 for _ in reader.iter_messages())
        assert count == summary.statistics.message_count
        assert {index.compression for index in summary.chunk_indexes} == {"zstd"}


def test_rosbags_reads_every_topic() -> None:
    with (SAMPLES / "amr_monday.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        seen = {
            channel.topic: message
            for _, channel, _, message in islice(reader.iter_decoded_messages(), 2000)
        }
    assert seen.keys() == ALL
    assert len(seen["/scan"].ranges) == 72


def test_sample_logs_have_every_condition_rarely(manifest: dict[str, Any]) -> None:
    monday = manifest["recorded"]["amr_monday.mcap"]
    assert min(monday["missions"].values()) >= 8
    assert 0.7 < monday["missions"]["nominal"] / sum(monday["missions"].values()) < 0.9
    assert set(monday["steps"]) == {
        *("nominal", "wheel_slip", "blocked_aisle", "near_collision", "recovery")
    }
    for made in manifest["recorded"].values():
        assert set(made["policy_steps"]) == {"planner 1", "planner 2", "operator 4"}
        assert made["handovers"] > 0
    assert sum(sum(m["missions"].values()) for m in manifest["recorded"].values()) > 60


def test_sample_logs_readme_says_simulated() -> None:
    text = (SAMPLES / "README.md").read_text(encoding="utf-8")
    assert "These recordings are simulated." in text
    assert all(name in text for name in RECORDINGS)


@pytest.mark.long  # test_recorder has a shorter recording
def test_recording_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    """Two missions of each; all of them: see the slow test."""
    made = []
    for folder in ("once", "again"):
        command = [sys.executable, str(MAKE), "--quick", "--out", str(tmp_path / folder)]
        subprocess.run(command, check=True, capture_output=True)
        made.append(json.loads((tmp_path / folder / "manifest.json").read_text()))
        assert not [p for p in (tmp_path / folder).iterdir() if p.name.startswith(".")]
    assert made[0] == made[1]
    assert len(made[0]["files"]) == 3


@pytest.mark.slow
def test_make_sample_logs_reproduces_the_bytes(tmp_path, manifest):
    command = [sys.executable, str(MAKE), "--out", str(tmp_path), "--check"]
    done = subprocess.run(command, capture_output=True, text=True)
    made = json.loads((tmp_path / "manifest.json").read_text(encoding="utf-8"))
    if made["libraries"] != manifest["libraries"]:
        pytest.skip(f"made with {manifest['libraries']}, here are {made['libraries']}")
    assert made == manifest
    assert done.returncode == 0, done.stderr
