"""Tags: their sources, contradictions between them, and tags in a store."""

import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from support.driven_robot import Drive, write_bag
from support.ingested import queried
from support.profile_texts import WAREHOUSE
from support.shell import Shell

from restock.cli import main
from restock.errors import ConfigError, RecordingError
from restock.ingest.containers.mcap_file import metadata_of
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.containers.storage import MAX_ENTRIES, custom_data
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import parse_profile
from restock.ingest.profile.tag_rules import (
    MAX_TAGS,
    TagRules,
    parse_tags,
    path_pattern,
    resolve_tags,
)
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags")
    (folder / "amr.toml").write_text(WAREHOUSE)
    write_bag(Drive(), folder / "bag")
    return folder / "bag"


def ingest_with(shell: Shell, bag: Path, store: Path, *options: str) -> Any:
    """Return the result of ingesting the bag."""
    profile = bag.parent / "amr.toml"
    (row,) = shell.json("ingest", bag, "--store", store, "--profile", profile, *options)[
        "recordings"
    ]
    return row


def test_command_line_tags_are_in_every_view(bag, tmp_path, shell):
    store = tmp_path / "store"
    row = ingest_with(shell, bag, store, "--tag", "robot=amr-07", "--tag", "line=b = c")
    tags = {"robot": "amr-07", "line": "b = c"}
    assert (row["status"], row["tags"]) == ("written", tags)
    for view in ("recordings", "transitions", "episodes"):
        query = f"SELECT DISTINCT robot, site, firmware, map, shift, tags FROM {view}"
        assert queried(store, query) == [("amr-07", None, None, None, None, tags)]


def test_time_columns_equal_nanosecond_columns(bag, tmp_path, shell):
    store = tmp_path / "store"
    ingest_with(shell, bag, store)
    pairs = {
        "transitions": ["stamp", "logged", "pose_stamp"],
        "recordings": ["start_stamp", "end_stamp"],
        "episodes": ["start", "end"],
    }
    with Store(store) as opened:
        for view, names in pairs.items():
            for name in names:
                reported = f"SELECT epoch_us({name}_time) - {name}_ns // 1000, typeof({name}_time)"
                found = opened.sql(f"{reported} FROM {view} GROUP BY ALL").fetchall()
                assert found == [(0, "TIMESTAMP")]
        logged = opened.sql("SELECT min(logged_time), max(logged_time) FROM transitions")
        episode = opened.sql("SELECT logged_start_time, logged_end_time FROM episodes")
        assert logged.fetchall() == episode.fetchall()


def test_new_tags_do_not_change_rows(bag, tmp_path, shell):
    store, others = tmp_path / "store", "FROM (SELECT * EXCLUDE (ingest_id, tags, robot, site)"
    ingest_with(shell, bag, store, "--tag", "site=oslo")
    rows = queried(store, f"{others} FROM transitions) ORDER BY transition_id")
    row = ingest_with(shell, bag, store, "--tag", "robot=amr-07")
    assert (row["status"], row["version"]) == ("tagged", 2)
    assert row["tags"] == {"robot": "amr-07", "site": "oslo"}
    assert row["notes"] == [
        "tags kept from the earlier ingest: site=oslo (--tag NAME= removes one)"
    ]
    assert queried(store, f"{others} FROM transitions) ORDER BY transition_id") == rows
    assert queried(store, "SELECT DISTINCT robot, site FROM transitions") == [("amr-07", "oslo")]
    assert (
        ingest_with(shell, bag, store)["status"] == "unchanged"
    )  # an ingest without tags changes nothing
    ingest_with(shell, bag, store, "--force")
    assert queried(store, "SELECT DISTINCT robot, site FROM recordings") == [("amr-07", "oslo")]
    ingest_with(shell, bag, store, "--tag", "site=")
    assert queried(store, "SELECT robot, site, tags FROM recordings") == [
        ("amr-07", None, {"robot": "amr-07"})
    ]


def test_relabelling_keeps_tags(bag, tmp_path, shell):
    store = tmp_path / "store"
    ingest_with(shell, bag, store, "--tag", "robot=amr-07")
    other = tmp_path / "other.toml"
    other.write_text(WAREHOUSE + '\n[[condition]]\nname = "never"\ntiming = "pre"\nsql = "false"\n')
    assert main(["store", "label", str(store), "--profile", str(other)]) == 0
    assert queried(store, "SELECT DISTINCT robot FROM transitions") == [("amr-07",)]


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["robot"], "'robot' is not KEY=VALUE"),
        (["=amr"], "'' is not a name of a tag"),
        (["robot=a", "robot=b"], "robot is given twice, as 'a' and as 'b'"),
        ([f"robot={'x' * 257}"], "the value of robot has 257 characters, more than 256"),
        (["robot=\x1b[2J"], "the value of robot has control characters"),
    ],
)
def test_invalid_tags_are_rejected(texts, message):
    with pytest.raises(ConfigError) as error:
        parse_tags(texts)
    assert message in error.value.what


def test_invalid_tag_writes_nothing(bag, tmp_path, shell):
    assert "such as --tag robot=amr-07" in shell.err(
        "ingest", bag, "--store", tmp_path / "store", "--tag", "robot"
    )
    assert not (tmp_path / "store").exists()


def write_mcap_with_metadata(path: Path, *records: tuple[str, dict[Any, Any]]) -> Path:
    """Write an MCAP file of one message with these metadata records."""
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        for name, entries in records:
            writer.add_metadata(name, entries)
        channel = writer.register_channel("/a", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    return path


def with_custom_data(path: Path, plugin: StoragePlugin, data: dict[str, str]) -> Path:
    types = get_typestore(Stores.ROS2_JAZZY)
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/a", "std_msgs/msg/Bool", typestore=types)
        message = types.types["std_msgs/msg/Bool"](True)
        writer.write(connection, 1, types.serialize_cdr(message, "std_msgs/msg/Bool"))
        for name, value in data.items():
            writer.set_custom_data(name, value)
    return path


def metadata_and_notes(path: Path) -> tuple[list[tuple[str, str, dict[str, str]]], list[str]]:
    with open_recording(path) as recording:
        if path.suffix == ".mcap":
            assert [
                record for record in metadata_of(path) or [] if record.entries
            ] == recording.metadata
        return [(*item[:2], dict(item.entries)) for item in recording.metadata], recording.notes


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_custom_data_is_read_without_metadata_yaml(tmp_path, plugin):
    """Values such as `007`, a date and `~` are kept as text."""
    data = {"robot": "007", "day": "2026-10-05", "note": "a: b\n# c", "on": "yes"}
    folder = with_custom_data(tmp_path / "bag", plugin, data)
    shown = {**data, "note": "a: b\\n# c"}  # control characters are escaped, as everywhere
    (first, second), _ = metadata_and_notes(folder)
    assert first == ("custom_data in metadata.yaml", "", shown)
    assert second == (f"custom_data in {next(folder.glob('bag.*')).name}", "", shown)
    assert metadata_and_notes(next(folder.glob("bag.*")))[0] == [second]


def test_last_rosbag2_metadata_record_is_used(tmp_path):
    texts = [f"version: 9\ncustom_data:\n  robot: {name}\nros_distro: x" for name in ("a", "b")]
    path = write_mcap_with_metadata(
        tmp_path / "a.mcap", *(("rosbag2", {"serialized_metadata": t}) for t in texts)
    )
    assert metadata_and_notes(path) == ([("custom_data in a.mcap", "", {"robot": "b"})], [])


def test_metadata_records_of_intact_and_truncated_file(tmp_path):
    records = [("device", {"robot": "amr-07"}), ("left", {"serial": "1"}), ("empty", {})]
    path = write_mcap_with_metadata(tmp_path / "a.mcap", *records)
    found = [
        ("metadata record 'device' of a.mcap", "device", {"robot": "amr-07"}),
        ("metadata record 'left' of a.mcap", "left", {"serial": "1"}),
    ]
    assert metadata_and_notes(path)[0] == found
    path.write_bytes(path.read_bytes()[:-30])
    with open_recording(path, salvage=True) as recording:
        assert [(*item[:2], dict(item.entries)) for item in recording.metadata] == found


def test_oversized_metadata_is_limited_and_counted(tmp_path):
    many = {f"key {number:05}": "x" for number in range(5_000)}
    path = write_mcap_with_metadata(
        tmp_path / "a.mcap",
        ("large", {"value": "x" * 10_000_000, "robot": "amr\x1b[2J"}),
        ("many", many),
    )
    raw = path.read_bytes().replace(b"key 00007", b"key \xff\xfe\xfd07")  # not UTF-8
    path.write_bytes(raw)
    (large, rest), notes = metadata_and_notes(path)
    assert large[2] == {"robot": r"amr\x1b[2J"}
    assert len(rest[2]) == MAX_ENTRIES - 1
    assert r"key \xff\xfe\xfd07" in rest[2]
    num_dropped = 1 + 5_000 - (MAX_ENTRIES - 1)
    assert notes[0].startswith(f"{num_dropped:,} entries of its metadata: not text, longer than")
    resolved = resolve_tags(TagRules(), path, [large, rest], {}, {})
    assert len(resolved.tags) == MAX_TAGS
    assert f"{MAX_ENTRIES - MAX_TAGS:,} names in its metadata cannot be tags" in resolved.notes[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("custom_data:\n  robot: [", "cannot be used: while parsing a flow node"),
        ("custom_data:\n  robot: " + "x" * 70_000, "has 70,022 characters: not read"),
    ],
)
def test_unusable_custom_data_is_reported(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        custom_data(text, "a bag")
    folder = with_custom_data(tmp_path / "bag", StoragePlugin.SQLITE3, {})
    with sqlite3.connect(folder / "bag.db3") as database:
        database.execute("UPDATE metadata SET metadata = ?", (text,))
    found, notes = metadata_and_notes(folder)
    assert found == []
    assert any("its own metadata cannot be used: custom_data" in note for note in notes)


def test_non_text_custom_data_is_counted():
    (_, _, entries), more = custom_data("custom_data:\n  a: [1]\n  b: c\n  g: ~\n", "a bag")
    assert (entries, more) == ({"b": "c"}, 1)


@pytest.mark.parametrize(
    ("pattern", "path", "tags"),
    [
        ("{site}/{robot}/*", "/data/oslo/amr-07/run.mcap", {"site": "oslo", "robot": "amr-07"}),
        ("{site}/{robot}/*", "/amr-07/run.mcap", None),
        ("/data/{site}/*", "/mnt/data/oslo/run", None),
        ("{robot}_*", "/d/amr_07_20261005_a", {"robot": "amr"}),
        (
            "fleet/{site}/**/{robot}.mcap",
            "/a/fleet/oslo/x/y/7.mcap",
            {"site": "oslo", "robot": "7"},
        ),
        ("fleet/{site}/**/{robot}.mcap", "/a/fleet/oslo/7.mcap", {"site": "oslo", "robot": "7"}),
        ("a?c.{robot}/*", "/abc.7/run", {"robot": "7"}),
    ],
)
def test_path_patterns(pattern, path, tags):
    found = path_pattern(pattern).fullmatch(path)
    assert (found.groupdict() if found else None) == tags


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('from_path = "*/x"', "must hold the names of tags in braces"),
        ('from_path = "{robot}/**"', "a pattern with ** must begin with a folder's name"),
        ('from_path = "{a b}/{c}/*"', "must hold the names of tags in braces"),
        ('from_path = ["{a}/*", "{a}/{a}"]', "'{a}/{a}' must hold the names of tags"),
        ('from_metadata = { "a=b" = "c" }', "'a=b' is not a name of a tag"),
    ],
)
def test_invalid_tag_rules_are_rejected(table, message):
    with pytest.raises(ConfigError) as error:
        parse_profile(f"{WAREHOUSE}\n[tags]\n{table}\n", where="amr.toml")
    assert "tags" in error.value.what
    assert message in error.value.what


PLACE = Path("/data/oslo/amr-07/run.mcap")
RULES = TagRules(from_path="{site}/{robot}/*")


def test_agreeing_tag_sources_are_merged():
    records = [("a", "", {"robot": "amr-07", "line": "B"}), ("b", "", {"robot": "amr-07"})]
    resolved = resolve_tags(RULES, PLACE, records, {"shift": "night"}, {})
    assert resolved.tags == {"robot": "amr-07", "line": "B", "site": "oslo", "shift": "night"}
    assert resolved.notes == []


@pytest.mark.parametrize(
    ("name", "entries", "message"),
    [
        ("robot", [("a", "", "x")], "'x' in a, but 'amr-07' in its path ({site}/{robot}/*)"),
        ("map", [("a", "", "x"), ("b", "", "y")], "'x' in a, but 'y' in b"),
    ],
)
def test_contradicting_tag_sources_are_rejected(name, entries, message):
    records = [(source, record, {name: value}) for source, record, value in entries]
    with pytest.raises(RecordingError) as error:
        resolve_tags(RULES, PLACE, records, {}, {})
    assert f"its tag {name!r} is {message}" in error.value.what
    assert f"choose one: --tag {name}=x or --tag {name}=" in str(error.value.remedy)
    resolved = resolve_tags(RULES, PLACE, records, {name: "decided"}, {})
    assert resolved.tags[name] == "decided"


def test_ambiguous_metadata_name_is_dropped_and_noted():
    """Such names are dropped and noted until the profile selects one record."""
    records = [("l", "left", {"serial": "1"}), ("r", "right", {"serial": "2"})]
    resolved = resolve_tags(TagRules(), PLACE, records, {}, {})
    assert resolved.tags == {}
    assert "1 names in its metadata cannot be tags ('serial')" in resolved.notes[0]
    rules = TagRules(from_metadata={"lidar": "left.serial", "site": "nowhere"})
    assert resolve_tags(rules, PLACE, records, {}, {}).tags == {"lidar": "1", "serial": "2"}


def test_unmatched_path_is_rejected_unless_tags_are_given(tmp_path):
    place = tmp_path / "run.mcap"
    rules = TagRules(from_path=["never/{site}/{robot}/*", "nor/{robot}/*"])
    with pytest.raises(RecordingError, match=r"match 'never/{site}/{robot}/\*' nor") as error:
        resolve_tags(rules, place, [], {"robot": "amr-07"}, {})
    assert "--tag robot=… --tag site=…" in str(error.value.remedy)
    given = {"robot": "amr-07", "site": "oslo"}
    assert resolve_tags(rules, place, [], given, {}).tags == given


@pytest.fixture(scope="module")
def fleet_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet") / "oslo" / "amr-07"
    folder.mkdir(parents=True)
    return write_bag(Drive(), folder / "monday")


def test_ingest_with_path_tags(fleet_bag, tmp_path, monkeypatch, shell):
    profile = tmp_path / "amr.toml"
    profile.write_text(WAREHOUSE + '\n[tags]\nfrom_path = "{site}/amr-{robot}/*"\n')
    options = ["--store", str(tmp_path / "store"), "--profile", str(profile)]
    unmatched = tmp_path / "X" / "amr" / "monday"
    shutil.copytree(fleet_bag, unmatched)
    assert "does not match '{site}/amr-{robot}/*'" in shell.err("ingest", unmatched, *options)
    assert not (tmp_path / "store").exists()
    monkeypatch.chdir(fleet_bag.parent)  # the relative path does not contain the site
    assert main(["ingest", "monday", *options]) == 0
    # A copy under another path is the same recording, so it does not change the tags.
    copy = shutil.copytree(fleet_bag, tmp_path / "old" / "amr-08" / "monday")
    kept, copied = shell.json("ingest", "monday", copy, *options)["recordings"]
    assert [kept["status"], copied["status"]] == ["unchanged", "unchanged"]
    assert copied["notes"] == [
        "the same recording as monday, whose tags it keeps: robot=07, site=oslo"
    ]
    with Store(tmp_path / "store") as store:
        found = store.sql("SELECT DISTINCT robot, site FROM episodes").fetchall()
    assert found == [("07", "oslo")]


def test_known_file_is_not_opened_but_its_tags_are_compared(tmp_path, monkeypatch):
    (file,) = write_bag(Drive(), tmp_path / "bag", storage="mcap").glob("*.mcap")
    profile, store = parse_profile(WAREHOUSE, where="a"), StoreWriter(tmp_path / "store")
    assert ingest(file, profile, store=store).status == "written"
    assert ingest(file, profile, store=store, tags={"robot": "a"}).status == "tagged"
    monkeypatch.setattr("restock.ingest.pipeline.open_recording", lambda *_, **__: 1 / 0)
    assert ingest(file, profile, store=store).manifest["tags"] == {"robot": "a"}
    for options in ({"tags": {"robot": "b"}}, {"force": True}):
        with pytest.raises(ZeroDivisionError):
            ingest(file, profile, store=store, **options)


def test_tag_rules_do_not_change_profile_hash():
    tagged = parse_profile(WAREHOUSE + '\n[tags]\nfrom_path = "{robot}/*"\n', where="a")
    assert tagged.hash == parse_profile(WAREHOUSE, where="a").hash
