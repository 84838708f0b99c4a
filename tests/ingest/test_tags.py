"""Tags: whose drive a recording is, by who says so, and what becomes of it in a store."""

import json
from pathlib import Path

import pytest
from support.driven_robot import Drive, write_bag
from support.ingested import queried
from support.profile_texts import WAREHOUSE

from restock.cli import main
from restock.errors import ConfigError
from restock.ingest.profile.tag_rules import parse_tags
from restock.replay.store.store import Store


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags")
    (folder / "amr.toml").write_text(WAREHOUSE)
    write_bag(Drive(), folder / "bag")
    return folder / "bag"


def ingest(bag: Path, store: Path, *options: str) -> int:
    profile = str(bag.parent / "amr.toml")
    return main(["ingest", str(bag), "--store", str(store), "--profile", profile, *options])


def test_tags_of_the_command_line_are_on_every_view(bag, tmp_path, capsys):
    store = tmp_path / "store"
    assert ingest(bag, store, "--tag", "robot=amr-07", "--tag", "line=b = c", "--json") == 0
    (row,) = json.loads(capsys.readouterr().out)["recordings"]
    tags = {"robot": "amr-07", "line": "b = c"}
    assert (row["status"], row["tags"]) == ("written", tags)
    for view in ("recordings", "transitions", "episodes"):
        query = f"SELECT DISTINCT robot, site, firmware, map, shift, tags FROM {view}"
        assert queried(store, query) == [("amr-07", None, None, None, None, tags)]


def test_times_are_the_nanoseconds_beside_them(bag, tmp_path):
    store = tmp_path / "store"
    assert ingest(bag, store) == 0
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


def test_new_tags_alone_change_no_row(bag, tmp_path, capsys):
    store, others = tmp_path / "store", "FROM (SELECT * EXCLUDE (ingest_id, tags, robot, site)"
    assert ingest(bag, store, "--tag", "site=oslo") == 0
    rows = queried(store, f"{others} FROM transitions) ORDER BY transition_id")
    capsys.readouterr()
    assert ingest(bag, store, "--tag", "robot=amr-07", "--json") == 0
    (row,) = json.loads(capsys.readouterr().out)["recordings"]
    assert (row["status"], row["version"]) == ("tagged", 2)
    assert row["tags"] == {"robot": "amr-07", "site": "oslo"}
    assert row["notes"] == [
        "tags kept from the earlier ingest: site=oslo (--tag NAME= removes one)"
    ]
    assert queried(store, f"{others} FROM transitions) ORDER BY transition_id") == rows
    assert queried(store, "SELECT DISTINCT robot, site FROM transitions") == [("amr-07", "oslo")]
    capsys.readouterr()
    assert ingest(bag, store) == 0  # who says nothing changes nothing
    assert "unchanged" in capsys.readouterr().out
    assert ingest(bag, store, "--force") == 0
    assert queried(store, "SELECT DISTINCT robot, site FROM recordings") == [("amr-07", "oslo")]
    assert ingest(bag, store, "--tag", "site=") == 0
    assert queried(store, "SELECT robot, site, tags FROM recordings") == [
        ("amr-07", None, {"robot": "amr-07"})
    ]


def test_relabelling_keeps_the_tags(bag, tmp_path):
    store = tmp_path / "store"
    assert ingest(bag, store, "--tag", "robot=amr-07") == 0
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


def test_a_wrong_tag_writes_nothing(bag, tmp_path, capsys):
    assert ingest(bag, tmp_path / "store", "--tag", "robot") == 2
    assert "such as --tag robot=amr-07" in capsys.readouterr().err
    assert not (tmp_path / "store").exists()
