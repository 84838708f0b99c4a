"""What `restock start` takes beside recordings: damaged ones, definitions, tags, a URDF, a map."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from support.driven_robot import Drive, write_bag
from support.paths import SHARED

from restock import cli
from restock.cli.start import stages
from restock.cli.start.stages import Settings
from restock.cli.start.work import Work
from restock.replay.store.store import Store

BUMP = "".join(f"uint8 {side}\n" for side in ("left_front", "left_side", "right_front"))
UP_TO_THE_PANEL = ("--mixture", "no_such.toml")


def start(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, Any]:
    """The exit code, and the document."""
    code = cli.main(["start", *argv, "--json"])
    return code, json.loads(capsys.readouterr().out)


def commands(document: Any) -> dict[str, str]:
    return {stage["name"]: stage["command"] for stage in document["stages"]}


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    """A recording that is cut short in the middle."""
    bag = write_bag(Drive(), tmp_path / "bags" / "damaged", storage="mcap")
    (file,) = bag.glob("*.mcap")
    os.truncate(file, int(0.8 * file.stat().st_size))
    return bag


def test_a_damaged_recording_is_read_as_far_as_it_is_intact_where_that_is_asked_for(
    tmp_path: Path, damaged: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    argv = (str(damaged), "--out", str(out), *UP_TO_THE_PANEL)
    code, document = start(capsys, *argv)
    assert code == 3
    assert document["stopped"]["why"] == "no recording can be read"
    assert document["stopped"]["remedies"][0].startswith("add --salvage to this command")
    tags = ("--tag", "robot=amr-7", "--tag", "site=north")
    code, document = start(capsys, *argv, "--salvage", *tags)
    assert document["stages"][-1]["name"] == "mix"  # and no further, by the mixture
    said = {stage["name"]: stage["outcome"] for stage in document["stages"]}
    assert any(line.startswith("damaged: ") for line in said["info"])
    assert any(line.startswith("lost: ") for line in said["ingest"])
    for name in ("info", "propose", "check", "ingest"):
        assert commands(document)[name].endswith("--salvage" if name != "ingest" else "site=north")
    assert "--salvage --tag robot=amr-7" in commands(document)["ingest"]
    with Store(out / "store") as store:
        found = store.sql("SELECT robot, site, count(*) FROM transitions GROUP BY ALL").fetchall()
    ((robot, site, rows),) = found
    assert (robot, site) == ("amr-7", "north")
    assert rows > 10


def test_one_damaged_recording_of_several_does_not_stop_the_others(
    tmp_path: Path, damaged: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bag(Drive(), damaged.parent / "whole")
    argv = (str(damaged.parent), "--out", str(tmp_path / "out"), *UP_TO_THE_PANEL)
    _, document = start(capsys, *argv)
    stages_ = {stage["name"]: stage for stage in document["stages"]}
    assert stages_["info"]["status"] == "failed"
    assert "--salvage" in stages_["info"]["errors"][0]
    assert stages_["propose"]["status"] == stages_["ingest"]["status"] == "done"
    assert any("not ingested" in line for line in stages_["ingest"]["outcome"])


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
def test_a_robots_own_types_are_read_by_their_definitions(tmp_path: Path) -> None:
    message = tmp_path / "definitions" / "neato2_interfaces" / "msg" / "Bump.msg"
    message.parent.mkdir(parents=True)
    message.write_text(BUMP + "uint8 right_side\n")
    bag = SHARED / "fleet-neato" / "2024-danpark" / "drive_square"
    to = Settings((str(bag),), tmp_path / "out", definitions=message.parents[2])
    work = Work(to.out, cli.main, lambda line: None)
    (recording,) = work.do(stages.info(to)).document["recordings"]
    assert recording["topics"]["/bump"]["skipped"] is None
    assert "--definitions" in recording["topics"]["/accel"]["skipped"]


def test_definitions_go_to_every_stage_that_reads_recordings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "my_msgs"
    folder.mkdir()
    (folder / "Level.msg").write_text("float64 value\n")
    out = str(tmp_path / "out")
    flag = ("--definitions", str(folder))
    assert cli.main(["start", "bags", "--out", out, "--dry-run", *flag]) == 0
    printed = capsys.readouterr().out.splitlines()
    given = [line.split()[2] for line in printed if f"--definitions {folder}" in line]
    assert given == ["info", "profile", "profile", "ingest", "twin"]


@pytest.mark.parametrize(
    ("flag", "value", "said"),
    [
        ("--tag", "north", "'north' is not KEY=VALUE"),
        ("--definitions", "nowhere", "no such folder of definitions"),
        ("--map", "no_map.yaml", "no_map.yaml: cannot be read: No such file"),
        ("--urdf", "box.urdf", "'box' has no wheels: none of its joints (none) turns without end"),
    ],
)
def test_what_cannot_be_used_is_refused_before_anything_is_written(
    flag: str,
    value: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("box.urdf").write_text("<robot name='box'><link name='base_link'/></robot>")
    assert cli.main(["start", "bags", "--out", "out", flag, value]) == 2
    assert said in capsys.readouterr().err
    assert not Path("out").exists()
