"""Tags: whose drive a recording is, by who says so, and what becomes of it in a store."""

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
    """Return what is said of the bag."""
    profile = bag.parent / "amr.toml"
    (row,) = shell.json("ingest", bag, "--store", store, "--profile", profile, *options)[
        "recordings"
    ]
    return row


def test_tags_of_the_command_line_are_on_every_view(bag, tmp_path, shell):
    store = tmp_path / "store"
    row = ingest_with(shell, bag, store, "--tag", "robot=amr-07", "--tag", "line=b = c")
    tags = {"robot": "amr-07", "line": "b = c"}
    assert (row["status"], row["tags"]) == ("written", tags)
    for view in ("recordings", "transitions", "episodes"):
        query = f"SELECT DISTINCT robot, site, firmware, map, shift, tags FROM {view}"
        assert queried(store, query) == [("amr-07", None, None, None, None, tags)]


def test_times_are_the_nanoseconds_beside_them(bag, tmp_path, shell):
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


def test_new_tags_alone_change_no_row(bag, tmp_path, shell):
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
    )  # who says nothing changes nothing
    ingest_with(shell, bag, store, "--force")
    assert queried(store, "SELECT DISTINCT robot, site FROM recordings") == [("amr-07", "oslo")]
    ingest_with(shell, bag, store, "--tag", "site=")
    assert queried(store, "SELECT robot, site, tags FROM recordings") == [
        ("amr-07", None, {"robot": "amr-07"})
    ]


def test_relabelling_keeps_the_tags(bag, tmp_path, shell):
    store = tmp_path / "store"
    ingest_with(shell, bag, store, "--tag", "robot=amr-07")
    other = tmp_path / "other.toml"
    other.write_text(WAREHOUSE + '\n[[condition]]\nname = "never"\ntiming = "pre"\nsql = "false"\n')
    assert main(["store", "label", str(store), "--profile", str(other)]) == 0
    assert queried(store, "SELECT DISTINCT robot FROM transitions") == [("amr-07",)]


@pytest.mark.parametrize(
    ("texts", "says"),
    [
        (["robot"], "'robot' is not KEY=VALUE"),
        (["=amr"], "'' is not a name of a tag"),
        (["robot=a", "robot=b"], "robot is given twice, as 'a' and as 'b'"),
        ([f"robot={'x' * 257}"], "the value of robot has 257 characters, more than 256"),
        (["robot=\x1b[2J"], "the value of robot has control characters"),
    ],
)
def test_tags_of_another_form_are_refused(texts, says):
    with pytest.raises(ConfigError) as refused:
        parse_tags(texts)
    assert says in refused.value.what


def test_a_wrong_tag_writes_nothing(bag, tmp_path, shell):
    assert "such as --tag robot=amr-07" in shell.err(
        "ingest", bag, "--store", tmp_path / "store", "--tag", "robot"
    )
    assert not (tmp_path / "store").exists()


def mcap(path: Path, *records: tuple[str, dict[Any, Any]]) -> Path:
    """Return an MCAP file of one message, with these metadata records."""
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


def said(path: Path) -> tuple[list[tuple[str, str, dict[str, str]]], list[str]]:
    with open_recording(path) as recording:
        if path.suffix == ".mcap":
            assert [one for one in metadata_of(path) or [] if one.entries] == recording.metadata
        return [(*item[:2], dict(item.entries)) for item in recording.metadata], recording.notes


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_custom_data_is_read_without_metadata_yaml_too(tmp_path, plugin):
    """As it was written: `007`, a date and `~` inside are text."""
    data = {"robot": "007", "day": "2026-10-05", "note": "a: b\n# c", "on": "yes"}
    folder = with_custom_data(tmp_path / "bag", plugin, data)
    shown = {**data, "note": "a: b\\n# c"}  # control characters as everywhere
    (first, second), _ = said(folder)
    assert first == ("custom_data in metadata.yaml", "", shown)
    assert second == (f"custom_data in {next(folder.glob('bag.*')).name}", "", shown)
    assert said(next(folder.glob("bag.*")))[0] == [second]


def test_the_last_of_rosbag2_s_own_records_counts(tmp_path):
    texts = [f"version: 9\ncustom_data:\n  robot: {name}\nros_distro: x" for name in ("a", "b")]
    path = mcap(tmp_path / "a.mcap", *(("rosbag2", {"serialized_metadata": t}) for t in texts))
    assert said(path) == ([("custom_data in a.mcap", "", {"robot": "b"})], [])


def test_metadata_records_and_a_file_that_is_cut(tmp_path):
    records = [("device", {"robot": "amr-07"}), ("left", {"serial": "1"}), ("empty", {})]
    path = mcap(tmp_path / "a.mcap", *records)
    found = [
        ("metadata record 'device' of a.mcap", "device", {"robot": "amr-07"}),
        ("metadata record 'left' of a.mcap", "left", {"serial": "1"}),
    ]
    assert said(path)[0] == found
    path.write_bytes(path.read_bytes()[:-30])
    with open_recording(path, salvage=True) as recording:
        assert [(*item[:2], dict(item.entries)) for item in recording.metadata] == found


def test_hostile_metadata_is_bounded_and_counted(tmp_path):
    many = {f"key {number:05}": "x" for number in range(5_000)}
    path = mcap(
        tmp_path / "a.mcap",
        ("large", {"value": "x" * 10_000_000, "robot": "amr\x1b[2J"}),
        ("many", many),
    )
    raw = path.read_bytes().replace(b"key 00007", b"key \xff\xfe\xfd07")  # no UTF-8
    path.write_bytes(raw)
    (large, rest), notes = said(path)
    assert large[2] == {"robot": r"amr\x1b[2J"}
    assert len(rest[2]) == MAX_ENTRIES - 1
    assert r"key \xff\xfe\xfd07" in rest[2]
    left_out = 1 + 5_000 - (MAX_ENTRIES - 1)
    assert notes[0].startswith(f"{left_out:,} entries of its metadata: not text, longer than")
    reported = resolve_tags(TagRules(), path, [large, rest], {}, {})
    assert len(reported.tags) == MAX_TAGS
    assert f"{MAX_ENTRIES - MAX_TAGS:,} names in its metadata cannot be tags" in reported.notes[0]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("custom_data:\n  robot: [", "cannot be used: while parsing a flow node"),
        ("custom_data:\n  robot: " + "x" * 70_000, "has 70,022 characters: not read"),
    ],
)
def test_custom_data_that_cannot_be_used(tmp_path, text, says):
    with pytest.raises(ValueError, match=says):
        custom_data(text, "a bag")
    folder = with_custom_data(tmp_path / "bag", StoragePlugin.SQLITE3, {})
    with sqlite3.connect(folder / "bag.db3") as database:
        database.execute("UPDATE metadata SET metadata = ?", (text,))
    found, notes = said(folder)
    assert found == []
    assert any("its own metadata cannot be used: custom_data" in note for note in notes)


def test_entries_of_custom_data_that_are_no_text_are_counted():
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
def test_patterns_of_paths(pattern, path, tags):
    found = path_pattern(pattern).fullmatch(path)
    assert (found.groupdict() if found else None) == tags


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ('from_path = "*/x"', "must hold the names of tags in braces"),
        ('from_path = "{robot}/**"', "a pattern with ** must begin with a folder's name"),
        ('from_path = "{a b}/{c}/*"', "must hold the names of tags in braces"),
        ('from_path = ["{a}/*", "{a}/{a}"]', "'{a}/{a}' must hold the names of tags"),
        ('from_metadata = { "a=b" = "c" }', "'a=b' is not a name of a tag"),
    ],
)
def test_rules_that_cannot_be_used(table, says):
    with pytest.raises(ConfigError) as refused:
        parse_profile(f"{WAREHOUSE}\n[tags]\n{table}\n", where="amr.toml")
    assert "tags" in refused.value.what
    assert says in refused.value.what


PLACE = Path("/data/oslo/amr-07/run.mcap")
RULES = TagRules(from_path="{site}/{robot}/*")


def test_sources_that_agree_or_add_to_each_other():
    own = [("a", "", {"robot": "amr-07", "line": "B"}), ("b", "", {"robot": "amr-07"})]
    reported = resolve_tags(RULES, PLACE, own, {"shift": "night"}, {})
    assert reported.tags == {"robot": "amr-07", "line": "B", "site": "oslo", "shift": "night"}
    assert reported.notes == []


@pytest.mark.parametrize(
    ("name", "own", "says"),
    [
        ("robot", [("a", "", "x")], "'x' in a, but 'amr-07' in its path ({site}/{robot}/*)"),
        ("map", [("a", "", "x"), ("b", "", "y")], "'x' in a, but 'y' in b"),
    ],
)
def test_sources_that_contradict_each_other(name, own, says):
    said = [(source, record, {name: value}) for source, record, value in own]
    with pytest.raises(RecordingError) as refused:
        resolve_tags(RULES, PLACE, said, {}, {})
    assert f"its tag {name!r} is {says}" in refused.value.what
    assert f"choose one: --tag {name}=x or --tag {name}=" in str(refused.value.remedy)
    reported = resolve_tags(RULES, PLACE, said, {name: "decided"}, {})
    assert reported.tags[name] == "decided"


def test_records_that_mean_two_things_by_a_name():
    """Left out and said, until the profile says which is meant."""
    own = [("l", "left", {"serial": "1"}), ("r", "right", {"serial": "2"})]
    reported = resolve_tags(TagRules(), PLACE, own, {}, {})
    assert reported.tags == {}
    assert "1 names in its metadata cannot be tags ('serial')" in reported.notes[0]
    rules = TagRules(from_metadata={"lidar": "left.serial", "site": "nowhere"})
    assert resolve_tags(rules, PLACE, own, {}, {}).tags == {"lidar": "1", "serial": "2"}


def test_a_path_without_a_match_is_refused_unless_tags_are_given(tmp_path):
    place = tmp_path / "run.mcap"
    rules = TagRules(from_path=["never/{site}/{robot}/*", "nor/{robot}/*"])
    with pytest.raises(RecordingError, match=r"match 'never/{site}/{robot}/\*' nor") as no:
        resolve_tags(rules, place, [], {"robot": "amr-07"}, {})
    assert "--tag robot=… --tag site=…" in str(no.value.remedy)
    given = {"robot": "amr-07", "site": "oslo"}
    assert resolve_tags(rules, place, [], given, {}).tags == given


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet") / "oslo" / "amr-07"
    folder.mkdir(parents=True)
    return write_bag(Drive(), folder / "monday")


def test_an_ingest_by_the_path_writes_all_or_nothing(driven, tmp_path, monkeypatch, shell):
    profile = tmp_path / "amr.toml"
    profile.write_text(WAREHOUSE + '\n[tags]\nfrom_path = "{site}/amr-{robot}/*"\n')
    options = ["--store", str(tmp_path / "store"), "--profile", str(profile)]
    lost = tmp_path / "X" / "amr" / "monday"
    shutil.copytree(driven, lost)
    assert "does not match '{site}/amr-{robot}/*'" in shell.err("ingest", lost, *options)
    assert not (tmp_path / "store").exists()
    monkeypatch.chdir(driven.parent)  # the path as it is given says nothing of the site
    assert main(["ingest", "monday", *options]) == 0
    # A copy under another path is the same recording: it does not take the tags along.
    copy = shutil.copytree(driven, tmp_path / "old" / "amr-08" / "monday")
    kept, copied = shell.json("ingest", "monday", copy, *options)["recordings"]
    assert [kept["status"], copied["status"]] == ["unchanged", "unchanged"]
    assert copied["notes"] == [
        "the same recording as monday, whose tags it keeps: robot=07, site=oslo"
    ]
    with Store(tmp_path / "store") as store:
        found = store.sql("SELECT DISTINCT robot, site FROM episodes").fetchall()
    assert found == [("07", "oslo")]


def test_a_known_file_is_not_opened_but_its_tags_are_compared(tmp_path, monkeypatch):
    (file,) = write_bag(Drive(), tmp_path / "bag", storage="mcap").glob("*.mcap")
    profile, store = parse_profile(WAREHOUSE, where="a"), StoreWriter(tmp_path / "store")
    assert ingest(file, profile, store=store).status == "written"
    assert ingest(file, profile, store=store, tags={"robot": "a"}).status == "tagged"
    monkeypatch.setattr("restock.ingest.pipeline.open_recording", lambda *_, **__: 1 / 0)
    assert ingest(file, profile, store=store).manifest["tags"] == {"robot": "a"}
    for how in ({"tags": {"robot": "b"}}, {"force": True}):
        with pytest.raises(ZeroDivisionError):
            ingest(file, profile, store=store, **how)


def test_tag_rules_are_no_part_of_what_rows_depend_on():
    tagged = parse_profile(WAREHOUSE + '\n[tags]\nfrom_path = "{robot}/*"\n', where="a")
    assert tagged.hash == parse_profile(WAREHOUSE, where="a").hash
