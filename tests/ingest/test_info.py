"""`restock info`: right counts for every recording, and one clear message for what is none."""

import json
from pathlib import Path

import pytest
from support.bag_samples import TOPICS, write_bag, write_mcap

from restock.cli import main
from restock.cli.data.info import offered


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    write_mcap(folder / "one.mcap")
    write_bag(folder / "bag")
    return folder


def test_json_names_every_recording_and_topic(folder, capsys):
    assert main(["info", str(folder), "--json"]) == 0
    printed = capsys.readouterr()
    recordings = json.loads(printed.out)["recordings"]
    assert [entry["path"] for entry in recordings] == [
        str(folder / "bag"),
        str(folder / "one.mcap"),
    ]
    assert [entry["format"] for entry in recordings] == ["rosbag2-sqlite3", "mcap"]
    for entry in recordings:
        assert entry["messages"] == 140
        assert entry["start"] == entry["end"] == "2023-11-14T22:13:20Z"
        assert entry["duration_s"] == pytest.approx(0.950000006)
        assert {name: topic["type"] for name, topic in entry["topics"].items()} == TOPICS
        for topic in entry["topics"].values():
            assert topic["messages"] == 20
            assert topic["rate_hz"] == pytest.approx(20 / 0.95, rel=1e-3)
            assert topic["skipped"] is None


def test_one_bad_recording_does_not_hide_the_others(folder, tmp_path, capsys):
    empty = tmp_path / "empty.mcap"
    empty.touch()
    assert main(["info", str(empty), str(folder / "one.mcap"), "--json"]) == 2
    printed = capsys.readouterr()
    assert len(json.loads(printed.out)["recordings"]) == 1
    assert printed.err.startswith(f"restock: {empty}: an empty file")
    assert "Traceback" not in printed.err


OFFERED = {
    "": [],
    "not yaml: [": [],
    "- depth: 1\n  durability: 2\n  reliability: reliable\n  deadline:\n   sec: 9\n" * 2
    + "- reliability: 7\n": [
        {"reliability": "reliable", "durability": "volatile", "depth": 1},
        {"reliability": "7"},
    ],
}


@pytest.mark.parametrize("text", OFFERED)
def test_offered_qos_is_named_whatever_version_wrote_it(text):
    assert offered(text) == OFFERED[text]


def test_it_says_that_damage_is_unseen_until_messages_are_read(folder, capsys):
    path = folder / "one.mcap"
    content = bytearray(path.read_bytes())
    content[len(content) // 4] ^= 0xFF  # within the messages of a chunk
    path.write_bytes(content)
    assert main(["info", str(path), "--json"]) == 0
    (entry,) = json.loads(capsys.readouterr().out)["recordings"]
    assert (entry["integrity"], entry["damage"]) == (None, [])
    assert main(["info", str(path), "--clocks", "--json"]) == 3
    (entry,) = json.loads(capsys.readouterr().out)["recordings"]
    assert entry["integrity"] == "damaged"
    assert "is lost" in entry["damage"][0]
