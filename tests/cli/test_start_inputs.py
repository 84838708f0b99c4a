"""Inputs of `restock start`: damaged recordings, definitions, tags, a URDF, a map."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.driven_robot import (
    Drive,
    columns,
    cut_bag,
    scans,
    typed_topics,
    up_to_the_panel,
    write_bag,
    write_topics,
)
from support.paths import SHARED
from support.profile_texts import WAREHOUSE

from restock import cli
from restock.cli.start import stages
from restock.cli.start.decisions import updates_settings
from restock.cli.start.stages import Settings, Stage
from restock.cli.start.start import Pipeline, StartCommand
from restock.cli.start.work import StageResult, Work
from restock.ingest.profile.profile import load_profile, profile_toml
from restock.ingest.propose import drives
from restock.replay.store.store import Store
from restock.train.twin.missions import DEFAULT_CONDITIONS


def commands(document: Any) -> dict[str, str]:
    return {stage["name"]: stage["command"] for stage in document["stages"]}


def test_salvage_reads_intact_part_of_recording(tmp_path, shell):
    """A map in another frame stops it at the floor stage."""
    damaged = cut_bag(tmp_path / "bags" / "damaged")
    out, hall = tmp_path / "out", tmp_path / "hall.yaml"
    Image.fromarray(np.pad(np.full((80, 300), 254, np.uint8), 2)).save(tmp_path / "hall.pgm")
    hall.write_text("image: hall.pgm\nresolution: 0.05\norigin: [200.0, -2.0, 0]\n")
    argv = (damaged, "--out", out, "--map", hall)
    document = shell.json("start", *argv, code=3)
    assert document["stopped"]["why"] == "no recording can be read"
    assert document["stopped"]["remedies"][0].startswith("add --salvage to this command")

    tags = ("--tag", "robot=amr-7", "--tag", "site=north")
    document = shell.json("start", *argv, "--salvage", *tags, code=3)
    outcomes = {stage["name"]: stage["outcome"] for stage in document["stages"]}
    assert any(line.startswith("damaged: ") for line in outcomes["info"])
    assert any(line.startswith("lost: ") for line in outcomes["ingest"])
    for name in ("info", "propose", "check", "ingest"):
        assert "--salvage" in commands(document)[name]
    assert "--salvage --tag robot=amr-7 --tag site=north" in commands(document)["ingest"]
    with Store(out / "store") as store:
        found = store.sql("SELECT robot, site, count(*) FROM transitions GROUP BY ALL").fetchall()
    ((robot, site, rows),) = found
    assert (robot, site) == ("amr-7", "north")
    assert rows > 10

    floor = document["stages"][-1]
    assert floor["name"] == "floor"
    assert "100% are off the map" in floor["errors"][0]
    assert "cannot be the floor" in document["stopped"]["why"]
    assert not (out / "floor.toml").exists()


CART = """<robot name='cart'><link name='base_link'>
<inertial><mass value='20'/></inertial>
<collision><geometry><box size='0.6 0.4 0.2'/></geometry></collision></link>{}</robot>"""
WHEEL = """<link name='{0}'><collision><geometry><cylinder radius='0.09' length='0.03'/></geometry>
</collision></link><joint name='{0}_joint' type='continuous'><parent link='base_link'/>
<child link='{0}'/><origin xyz='0 {1} -0.05'/><axis xyz='0 1 0'/></joint>"""


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_custom_urdf_and_map_reach_report(tmp_path, shell):
    urdf, hall, out = tmp_path / "cart.urdf", tmp_path / "hall.yaml", tmp_path / "out"
    urdf.write_text(CART.format(WHEEL.format("left", 0.22) + WHEEL.format("right", -0.22)))
    Image.fromarray(np.pad(np.full((80, 300), 254, np.uint8), 2)).save(tmp_path / "hall.pgm")
    hall.write_text("image: hall.pgm\nresolution: 0.05\norigin: [-1.0, -1.0, 0]\n")
    topics = typed_topics(Drive(20.0))
    topics["/scan"][1].fields["ranges"].values[:] = np.inf  # returns would contradict the map
    bag = write_topics(topics, tmp_path / "bag")
    argv = (bag, "--out", out, "--urdf", urdf, "--map", hall)
    document = shell.json("start", *argv, "--minutes", "0.1")
    assert Path(document["report"]).is_file()
    outcomes = {stage["name"]: stage["outcome"] for stage in document["stages"]}
    assert outcomes["floor"][0].startswith(f"made from {hall}: 15 x 4 m")
    robot = load_profile(str(out / "profile.toml")).robot
    assert robot is not None
    assert (robot.wheel_radius_m, robot.track_m, robot.mass_kg) == (0.09, 0.44, 20.0)
    assert robot.origin_of("track_m") == "urdf"
    # Once the profile is edited, options of the proposal are reported to have no effect.
    (out / "profile.toml").write_text((out / "profile.toml").read_text() + "\n# mine\n")
    assert "--urdf can only change a proposal" in shell.out(
        "start", *argv, *up_to_the_panel(tmp_path), code=3
    )


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
def test_custom_message_types_are_read_by_definitions(tmp_path) -> None:
    """A bumper of an unknown type is proposed once its definition is there."""
    message = tmp_path / "definitions" / "neato2_interfaces" / "msg" / "Bump.msg"
    message.parent.mkdir(parents=True)
    sides = ("left_front", "left_side", "right_front", "right_side")
    message.write_text("".join(f"uint8 {side}\n" for side in sides))
    bag = SHARED / "fleet-neato" / "2024-danpark" / "drive_square"
    definitions = str(message.parents[2])
    words = ["profile", "new", str(bag), "--hindsight-goals", "--out"]
    cli.main([*words, str(tmp_path / "without.toml")])
    assert load_profile(str(tmp_path / "without.toml")).inputs.bumper is None
    cli.main([*words, str(tmp_path / "with.toml"), "--definitions", definitions])
    bumper = load_profile(str(tmp_path / "with.toml")).inputs.bumper
    assert bumper is not None
    assert (bumper.topic, bumper.fields["pressed"]) == ("/bump", " or ".join(sides))
    to = Settings((str(bag),), tmp_path / "out", definitions=definitions)
    work = Work(to.out, cli.main, lambda line: None)
    (recording,) = work.do(stages.info(to)).document["recordings"]
    assert recording["topics"]["/bump"]["skipped"] is None
    assert "--definitions" in recording["topics"]["/accel"]["skipped"]


def test_invalid_recordings_are_refused_before_writing(tmp_path, monkeypatch, shell):
    monkeypatch.chdir(tmp_path)
    Path("text.mcap").write_text("text\n")
    Path("bags").mkdir()
    Path("bags", "empty.mcap").touch()
    Path("bare").mkdir()
    Path("bare", "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 9}\n")
    for paths, message in {
        ("nothing",): "restock: nothing: no such file or folder",
        ("text.mcap",): "restock: text.mcap: not a recording: neither an MCAP,",
        ("bags",): "restock: bags/empty.mcap: an empty file",
        ("bare",): "restock: bare: a bag without its storage files",
    }.items():
        out, err = shell.printed("start", *paths, "--out", "out", code=2)
        assert err.startswith(message)
        assert out == ""
        assert not Path("out").exists()


@pytest.mark.long
def test_unread_recordings_are_grouped_by_robot(tmp_path, monkeypatch, shell):
    """Regression: the small drive of another robot was ingested with the others."""
    monkeypatch.setattr(drives, "drives_by_kind", partial(drives.drives_by_kind, most=2))
    bags, out = tmp_path / "bags", tmp_path / "out"
    for name, seconds in (("a", 9.0), ("b", 4.0), ("c", 8.0)):
        write_bag(Drive(seconds), bags / name)
    write_bag(OtherLidar(3.0), bags / "small")
    document = shell.json("start", bags, "--out", out, code=3)
    mine = f"{bags / 'a'} {bags / 'b'} {bags / 'c'}"
    assert document["stopped"]["remedies"][:2] == [
        f"restock start {mine} --out {out}",
        f"restock start {bags / 'small'} --out {out}-2",
    ]
    argv = (bags, "--out", out, "--accept", *up_to_the_panel(tmp_path))
    document = shell.json("start", *argv, code=3)
    assert f"restock ingest {mine} --store" in commands(document)["ingest"]
    (proposed,) = [stage for stage in document["stages"] if stage["name"] == "propose"]
    assert "by the 2 largest of 3 recordings of this robot" in proposed["outcome"][0]


class OtherLidar(Drive):
    """The same drive with half the beams."""

    def topics(self) -> dict[str, Any]:
        tenth = np.arange(0, self.duration_s, 0.1)
        return super().topics() | {"/scan": columns(tenth, scans(np.full((len(tenth), 36), 3.0)))}


def test_task_without_goal_has_no_practice_by_success(tmp_path: Path) -> None:
    """Regression: training ended with the error that the rule "success" needs success."""
    file = tmp_path / "p.toml"
    for goal in ("route", "none"):
        file.write_text(WAREHOUSE.replace('goal = "route"', f'goal = "{goal}"'))
        requested = StartCommand(("bag",), tmp_path / "out", profile=str(file), twin="yes")
        way = Pipeline(requested, GoodStages(tmp_path / "out", cli.main, lambda line: None))
        assert way._twin() is not None
        assert ("practice.rule=success" in way.to.train) == (goal == "route")


@pytest.mark.parametrize(
    ("option", "value", "why"),
    [
        ("--mixture", "coverag", "one of coverage, uniform"),
        ("--profile", "no_such.toml", "no such profile"),
        ("--minutes", "nan", "--minutes"),
        ("--map", "no_map.yaml", "no_map.yaml: cannot be read: No such file"),
        ("--urdf", "box.urdf", "'box' has no wheels"),
    ],
)
def test_invalid_options_are_refused_before_first_stage(
    tmp_path, monkeypatch, shell, option, value, why
):
    monkeypatch.chdir(tmp_path)
    Path("box.urdf").write_text("<robot name='box'><link name='base_link'/></robot>")
    out, err = shell.printed("start", "no_bag", "--out", "out", option, value, code=2)
    assert why in err
    assert out == ""
    assert not Path("out").exists()


@pytest.mark.parametrize("lidar", [True, False])
def test_robot_without_lidar_has_no_blocked_aisles(tmp_path, lidar):
    profile = tmp_path / "robot.toml"
    text = profile_toml(load_profile("turtlebot3"))
    if not lidar:
        lines = text.replace("sectors = 36", "sectors = 0").splitlines()
        text = "\n".join(line for line in lines if not line.startswith("scan = "))
    profile.write_text(text)
    assert load_profile(profile).task.lidar is lidar
    driven = [kind for kind in DEFAULT_CONDITIONS if lidar or kind != "blocked_aisle"]
    requested = StartCommand(("bag",), tmp_path / "out", profile=str(profile), twin="yes")
    way = Pipeline(requested, GoodStages(tmp_path / "out", cli.main, lambda line: None))
    assert way._twin() is not None
    assert way.to.kinds == (() if lidar else tuple(driven))  # empty: every kind
    conditions = [one for one in way.to.train if one.startswith("env.conditions")]
    assert bool(conditions) is not lidar
    assert not any("blocked_aisle" in one for one in conditions)


class GoodStages(Work):
    """Fake stages: the floor has room for every mission, and the fit is good."""

    def do(self, stage: Stage) -> StageResult:
        return StageResult(stage.name, "", "done", document={"episodes": list(DEFAULT_CONDITIONS)})


def test_few_rows_leave_draws_for_twin() -> None:
    few = {"rows": 267, "max_replays_per_row": 400.0}
    allowed = 267 * 400 / 128  # updates
    settings = dict(one.split("=") for one in updates_settings(few, 1.0, twin=True, seconds=30.0))
    assert int(settings["schedule.offline_updates"]) == int(allowed / 2)
    assert int(settings["schedule.env_steps"]) == 15_000  # what 30 s allow, not 200,000
    many = {"rows": 12_000, "max_replays_per_row": 400.0}
    assert updates_settings(many, 1.0, twin=True, seconds=30.0) == []
    # Without the twin, all draws are for offline updates.
    (alone, _) = updates_settings(few, 9.0, twin=False)
    assert alone == f"schedule.offline_updates={int(allowed)}"
