"""`restock sql` on recordings: values, names, laziness, folders, damage."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from support.bag_samples import TOPICS, write_bag, write_channels
from support.panels import panel_of
from support.paths import SHARED
from support.shell import Shell

import restock
from restock import cli
from restock.ingest.containers.recording import Recording
from restock.replay.mixture.mixture import load_mixture

BAGS = [
    "turtlebot3-sim-humble/rosbag_0.db3",
    "jazzy-mcap-backsteps",
    "ros1/husky_robot_localization.bag",
    "every-common-type/test_bag_mcap",
    "robots/neato-map-ros1/ac109_3_demo.bag",
    "fleet-turtlebot3/full-topics/rosbag2_2025_11_06-16_53_28",
]


def plain(value: Any) -> Any:
    """Convert a rosbags message to what SQL returns: dicts, lists, and times as nanoseconds."""
    if hasattr(value, "nanosec") and hasattr(value, "sec"):
        return value.sec * 10**9 + value.nanosec
    if dataclasses.is_dataclass(value):
        names = {one.name for one in dataclasses.fields(value)} - vars(type(value)).keys()
        return {name: plain(getattr(value, name)) for name in names if not name.startswith("__")}
    if isinstance(value, np.ndarray | list):
        return [plain(one) for one in (value if isinstance(value, list) else value.tolist())]
    return value


def read_by_rosbags(path: Path) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Yield topic, log time and fields of every message that rosbags can read."""
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, log_ns, data in reader.messages():
            try:
                message = reader.deserialize(data, connection.msgtype)
            except KeyError:  # a type without a definition
                continue
            yield connection.topic, log_ns, plain(message)


def expect_equal(shell: Shell, path: Path) -> int:
    """Compare every row of every topic with rosbags, and return the number of rows."""
    expected: dict[str, list[str]] = {}
    for topic, log_ns, fields in read_by_rosbags(path):
        stamp = fields.get("header", {}).get("stamp")
        own = {"log_time_ns": log_ns} | ({} if stamp is None else {"stamp_ns": stamp})
        expected.setdefault(topic, []).append(json.dumps(finite(own | fields), sort_keys=True))
    for topic, rows in expected.items():
        found = shell.json("sql", path, f'FROM "{topic}"')
        assert sorted(json.dumps(row, sort_keys=True) for row in found) == sorted(rows), topic
    return sum(map(len, expected.values()))


def finite(value: Any) -> Any:
    """Replace what JSON cannot hold, as --json does; leave out messages without fields."""
    if isinstance(value, dict):
        return {name: finite(one) for name, one in value.items() if one != {}}
    if isinstance(value, list):
        return [finite(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_values_match_rosbags(storage, tmp_path, shell):
    bag = write_bag(tmp_path / "bag", storage=storage)
    assert expect_equal(shell, bag) == 20 * len(TOPICS)


@pytest.mark.long
@pytest.mark.parametrize("name", BAGS)
def test_values_of_public_recordings_match_rosbags(name, shell):
    if not (SHARED / name).exists():
        pytest.skip("../shared/bags is absent")
    assert expect_equal(shell, SHARED / name)


def test_only_queried_topics_are_decoded(tmp_path, shell, monkeypatch):
    bag, decoded = write_bag(tmp_path / "bag"), []
    batches = Recording.batches

    def recorded(self: Recording, topic: str, fields: list[str]) -> Any:
        decoded.append(topic)
        return batches(self, topic, fields)

    monkeypatch.setattr(Recording, "batches", recorded)
    query = 'SELECT count(*) AS n FROM odom ASOF JOIN "/scan" s ON odom.stamp_ns >= s.stamp_ns'
    assert shell.json("sql", bag, query) == [{"n": 20}]
    assert sorted(decoded) == ["/odom", "/scan"]
    assert len(shell.json("sql", bag, "FROM topics")) == len(TOPICS)
    columns = shell.json("sql", bag, "FROM columns WHERE view = '/plan' ORDER BY ALL")
    assert columns[-1] == {"view": "/plan", "column_name": "stamp_ns", "type": "BIGINT"}
    assert "poses[].pose.position.x" in {row["column_name"] for row in columns}
    assert sorted(decoded) == ["/odom", "/scan"]


def test_missing_topic_suggests_nearest_names(tmp_path, shell):
    bag = write_bag(tmp_path / "bag")
    err = shell.err("sql", bag, 'FROM "/odm"')
    assert '"/odom"' in err
    assert "FROM columns" in err


def test_folder_is_union_with_file_column(tmp_path, shell):
    for name, count in (("a", 3), ("b's", 5)):
        write_bag(tmp_path / name, count=count)
    query = 'SELECT file, count(*) AS n FROM "/odom" GROUP BY ALL ORDER BY n'
    files = [str(tmp_path / "a"), str(tmp_path / "b's")]
    assert shell.json("sql", tmp_path, query) == [
        {"file": files[0], "n": 3},
        {"file": files[1], "n": 5},
    ]
    assert shell.json("sql", f"{tmp_path}/a*", query) == [{"file": files[0], "n": 3}]
    query = "SELECT DISTINCT file FROM topics ORDER BY ALL"
    assert [row["file"] for row in shell.json("sql", tmp_path, query)] == files
    assert "Did you mean" not in shell.err("sql", tmp_path, "FROM stord_odom")  # an internal table


def test_lost_data_is_reported_and_rest_returned(tmp_path, shell):
    whole = write_bag(tmp_path / "bag", storage="mcap", count=2000)
    (file,) = whole.glob("*.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    (tmp_path / "empty.mcap").touch()
    out, err = shell.printed("sql", cut, 'SELECT count(*) FROM "/odom"', "--csv", code=3)
    assert 0 < int(out.splitlines()[1]) < 2000
    assert err.startswith("lost: the file: cut short")
    out, err = shell.printed("sql", tmp_path, 'SELECT DISTINCT file FROM "/odom"', code=3)
    assert len(out.splitlines()) == 4
    assert f"lost: {tmp_path / 'empty.mcap'}: an empty file" in err
    assert cli.main(["sql", str(tmp_path / "empty.mcap"), "FROM topics"]) == 2


def write_json(path: Path, topics: dict[str, list[Any]]) -> Path:
    """Write an MCAP file of JSON messages without a schema, one a second."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, messages in topics.items():
            channel = writer.register_channel(topic, "json", 0)
            for second, message in enumerate(messages):
                data = json.dumps(message).encode()
                writer.add_message(channel, second * 10**9, data, second * 10**9)
        writer.finish()
    return path


def test_hostile_names_are_quoted(tmp_path, shell):
    name = """/a"b'; DROP TABLE x; --é \u202e\x1b[2J"""
    fields = {"x": 1.0, "X": 2.0, "": 3.0, "log_time_ns": 4.0, "in": {"y": "-2", "Y": "=1"}}
    topics = {name: [fields], "/Odom": [{"a": 1.0}], "/odom": [{"a": 2.0}], "columns": [{"a": 3.0}]}
    file = write_json(tmp_path / "hostile.mcap", topics)
    listed = shell.json("sql", file, "SELECT topic FROM topics")
    shown = next(row["topic"] for row in listed if row["topic"].startswith("/a"))
    assert shown.isprintable()
    query = f'FROM "{shown.replace(chr(34), 2 * chr(34))}"'
    (row,) = shell.json("sql", file, query)
    assert row["x"] == 1
    assert row["X_1"] == 2
    assert row["log_time_ns"] == 0
    assert row["log_time_ns_1"] == 4
    assert row["in"] == {"y": "-2", "Y_1": "=1"}
    assert shell.json("sql", file, 'SELECT a FROM "/Odom"') == [{"a": 1}]
    assert shell.json("sql", file, 'SELECT a FROM "/odom_1"') == [{"a": 2}]
    assert shell.json("sql", file, 'SELECT a FROM "columns_1"') == [{"a": 3}]
    assert shell.out("sql", file, f'SELECT "in".* FROM {query[5:]}', "--csv").splitlines() == [
        "y,Y_1",
        "-2,'=1",
    ]


def test_undecodable_topic_is_refused(tmp_path, shell):
    write_channels(
        tmp_path / "a.mcap", ("/own", "cbor", "own_msgs/msg/Own", "ros2msg", b"", [b"x"])
    )
    assert "/own cannot be decoded" in shell.err("sql", tmp_path / "a.mcap", 'FROM "/own"')


def test_open_takes_recording_panel_or_store(store_path, tmp_path, capsys):
    bag = write_bag(tmp_path / "bag")
    panel = panel_of(store_path, load_mixture("uniform"), tmp_path / "panel").path
    for place, shown in ((bag, "/odom"), (panel, "logs"), (store_path, "wheel_slip")):
        with restock.open(place) as opened:
            opened.show()
            assert shown in capsys.readouterr().out
            assert opened.sql("SELECT 1").fetchall() == [(1,)]
            if place != bag:
                assert {"nominal", "wheel_slip"} <= {row[0] for row in opened.coverage().fetchall()}
    with restock.open(bag) as opened:
        table = opened.sql("SELECT ranges FROM scan").to_arrow_table()
        assert len(table) == 20
        assert opened.lost == []
        with pytest.raises(restock.RestockError, match="has no labels"):
            opened.coverage()
    with pytest.raises(restock.RestockError, match="no such store"):
        restock.open(tmp_path / "nowhere")
