"""`restock start`: stages from a bag to a report, with stops if a person must decide."""

import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
from support.driven_robot import Drive, up_to_the_panel, write_bag
from support.long import one_in

from restock.cli.start import outcomes
from restock.cli.start.stages import Stage
from restock.cli.start.start import Pipeline, StartCommand
from restock.cli.start.work import StageResult, Work
from restock.errors import RestockError
from restock.replay.store.store import Store

SILENT = lambda line: None  # noqa: E731


class Verbs:
    """Fake command line: creates the output folders of a stage and records verbs."""

    def __init__(self) -> None:
        self.ran: list[str] = []
        self.codes: dict[str, int] = {}

    def __call__(self, command: list[str]) -> int:
        self.ran.append(command[0])
        for path in command[1:-1]:
            Path(path).mkdir(parents=True, exist_ok=True)
        sys.stdout.write(json.dumps({"made": command[0]}))
        return self.codes.get(command[0], 0)


def run_stages(out: Path, verbs: Verbs, bag: Path, number: int = 1) -> list[str]:
    """Run three stages, one of which can be resumed, and return their statuses."""
    work = Work(out, verbs, SILENT)
    store, run = out / "store", out / "run"
    stages = [
        Stage("ingest", "", ["ingest", str(store)], reads=(bag,), writes=(store,)),
        Stage("mix", "", ["mix", str(out / f"panel{number}")]),
        Stage(*("train", "", ["train", str(run)]), writes=(run,), resume=("train-on", str(run))),
    ]
    return [work.do(stage).status for stage in stages]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path = tmp_path / "a.bag"
    path.write_bytes(b"messages")
    return path


def test_stages_with_changed_input_run_again(tmp_path: Path, bag: Path) -> None:
    verbs, out = Verbs(), tmp_path / "out"
    run_stages(out, verbs, bag)
    assert run_stages(out, verbs, bag, number=2) == ["kept", "done", "done"]  # another command
    (out / "run" / "mine.txt").write_text("a note")
    bag.write_bytes(b"other messages")
    assert run_stages(out, verbs, bag, number=2) == ["done"] * 3
    # Training takes long, so its earlier output is moved aside, not removed.
    assert (out / "earlier" / "run-2" / "mine.txt").read_text() == "a note"
    (out / "store").rmdir()
    assert run_stages(out, verbs, bag, number=2) == ["done"] * 3


def test_interrupted_training_resumes_from_checkpoint(tmp_path: Path, bag: Path) -> None:
    verbs, out = Verbs(), tmp_path / "out"
    verbs.codes["train"] = 130
    with pytest.raises(KeyboardInterrupt):
        run_stages(out, verbs, bag)
    (out / "run" / "checkpoints").mkdir()  # without a checkpoint it would have to begin again
    (out / "run" / "checkpoints" / "latest.safetensors").touch()
    assert run_stages(out, verbs, bag) == ["kept", "kept", "done"]
    assert verbs.ran[-1] == "train-on"
    assert not (out / "earlier").exists()


def test_foreign_folder_is_refused(tmp_path: Path, bag: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(RestockError, match="not made by `restock start`"):
        run_stages(tmp_path, Verbs(), bag)


def test_dry_run_prints_commands_and_writes_nothing(tmp_path, shell):
    out, bags = tmp_path / "out", tmp_path / "bags"
    recording = write_bag(Drive(), bags / "drive")
    printed = shell.out("start", bags, "--out", out, "--dry-run")
    commands = [line for line in printed.splitlines() if line.startswith("$ restock ")]
    assert commands[0] == f"$ restock info {bags}"
    assert commands[1].startswith(f"$ restock profile new {bags} --out ")
    assert commands[2] == f"$ restock profile check {out / 'profile.toml'} {recording}"
    assert commands[-1] == f"$ restock report {out / 'run'}"
    assert not out.exists()
    out.mkdir()
    (out / "thesis.tex").touch()  # what the run would refuse
    assert shell.out("start", bags, "--out", out, "--dry-run", code=2) == ""


@pytest.mark.parametrize("fails", one_in(2, ["eval", "judge"]))
def test_failed_evaluation_stops_with_remedy(tmp_path: Path, fails: str) -> None:
    class Failing(Work):
        def do(self, stage: Stage) -> StageResult:
            ended = super().do(stage)
            if stage.name == fails:
                ended.status, ended.errors = "failed", ["no room"]
            return ended

    work = Failing(tmp_path / "out", Verbs(), SILENT, plan=True)
    stopped = Pipeline(StartCommand(("bags",), tmp_path / "out"), work).go()
    assert work.ended[-1].name == "report"
    assert stopped is not None
    assert "restock eval" in stopped.why
    assert stopped.remedies[0] == "no room"


class Parked(Drive):
    """A bag without commands."""

    def topics(self) -> dict[str, Any]:
        topics = super().topics()
        del topics["/cmd_vel"]
        return topics


def test_bag_without_commands_stops_at_proposal(tmp_path, shell):
    recording = write_bag(Parked(), tmp_path / "parked")
    out = tmp_path / "out"
    document = shell.json("start", recording, "--out", out, code=3)
    assert [stage["name"] for stage in document["stages"]] == ["info", "propose"]
    assert "no topic for command" in document["stopped"]["why"]
    assert str(out / "profile.toml") in document["stopped"]["remedies"][0]
    assert document["report"] is None


class Lost(Drive):
    """A bag with commands and no pose."""

    def topics(self) -> dict[str, Any]:
        topics = super().topics()
        return {name: topics[name] for name in ("/cmd_vel", "/scan")}


def test_commands_and_poses_in_separate_recordings_stop(tmp_path, shell):
    """Regression: one input was reported missing, though the other recording has it."""
    write_bag(Lost(), tmp_path / "bags" / "commands")
    write_bag(Parked(), tmp_path / "bags" / "poses")
    document = shell.json("start", tmp_path / "bags", "--out", tmp_path / "out", code=3)
    why = "bags/commands has a command (/cmd_vel) and no pose: one recording must hold both"
    assert why in document["stopped"]["why"]
    assert str(tmp_path / "out" / "profile.toml") in document["stopped"]["remedies"][0]


def test_edited_profile_is_used_and_kept(tmp_path, shell):
    recording = write_bag(Drive(), tmp_path / "drive")
    out = tmp_path / "out"
    argv = (recording, "--out", out, *up_to_the_panel(tmp_path))
    document = shell.json("start", *argv, code=3)
    assert document["stages"][-1]["name"] == "mix"
    assert all(stage["status"] == "done" for stage in document["stages"][:-1])
    *kept, _ = shell.json("start", *argv, code=3)["stages"]
    assert [stage["status"] for stage in kept] == ["kept"] * 6
    profile = out / "profile.toml"
    mine = profile.read_text().replace("range_max_m = ", "range_max_m = 1") + "\n# mine\n"
    profile.write_text(mine)
    document = shell.json("start", *argv, code=3)
    assert "propose" not in [stage["name"] for stage in document["stages"]]
    assert {s["name"]: s["status"] for s in document["stages"]}["ingest"] == "done"
    assert profile.read_text() == mine


def test_copied_recording_is_not_counted_twice(tmp_path, shell):
    """Regression: twice the transitions of the store were reported."""
    bags = tmp_path / "bags"
    recording = write_bag(Drive(), bags / "drive")
    shutil.copytree(recording, bags / "again")
    out = tmp_path / "out"
    document = shell.json("start", bags, "--out", out, *up_to_the_panel(tmp_path), code=3)
    (stage,) = [stage for stage in document["stages"] if stage["name"] == "ingest"]
    with Store(out / "store") as store:
        ((rows, episodes),) = store.sql(
            "SELECT count(*), count(DISTINCT episode_id) FROM transitions"
        ).fetchall()
    assert stage["outcome"][0].startswith(f"{rows:,} transitions in {episodes} episode")
    assert stage["outcome"][1] == "1 recording given again, as a copy: not counted"


@pytest.mark.long
def test_policy_is_from_logs_alone_without_trusted_twin(tmp_path, quick_models, shell):
    recording = write_bag(Drive(12.0), tmp_path / "drive")
    out = tmp_path / "out"
    argv = (recording, "--out", out, "--minutes", "0.02")
    document = shell.json("start", *argv)
    stages = {stage["name"]: stage for stage in document["stages"]}
    assert "env.twin=false" in stages["train"]["command"]
    assert "eval" not in stages
    assert document["report"] == str(out / "run" / "report.html")
    page = (out / "run" / "report.html").read_text("utf-8")
    assert "logs alone" in page.split("<h1>")[1].split("</h1>")[0]
    assert "Does it reach the goal?" not in page
    again = shell.json("start", *argv)["stages"]
    failed = {name for name, stage in stages.items() if stage["status"] == "failed"}
    assert {stage["name"] for stage in again if stage["status"] != "kept"} == failed


@pytest.mark.long
def test_several_command_topics_need_decision(tmp_path, shell):
    recording = write_bag(Drive(proposals="/base/cmd_vel"), tmp_path / "drive")
    out = tmp_path / "out"
    argv = (recording, "--out", out, *up_to_the_panel(tmp_path))
    document = shell.json("start", *argv, code=3)
    assert document["stages"][-1]["name"] == "propose"
    assert "/base/cmd_vel, /cmd_vel" in document["stopped"]["why"]
    document = shell.json("start", *argv, "--accept", code=3)
    assert document["stages"][-1]["name"] == "mix"


def test_single_held_out_episode_gives_no_verdict() -> None:
    """Regression: "fqe 4.18" stood beside "logged -1.05", as if it were a gain."""
    few = "1 episode, and weights need at least 5"
    rows = [
        {"measure": "return", "condition": "all", "episodes": 1, "low": None, "high": None}
        | {"estimator": name, "value": value, "refused": None if value else few}
        for name, value in (("logged", -1.05), ("fqe", 4.18), ("pdwis", None))
    ]
    (outcome,) = outcomes.on_logs({"results": rows, "notes": []})
    assert outcome.startswith(
        "return of 1 held-out episode: as the logs were driven -1.05 (no interval), "
    )
    assert outcome.endswith(f"(pdwis) refused: {few}")


def test_lidar_returns_inside_outline_stop_start(tmp_path, shell):
    """Regression: a robot of 4 x 3 m in a small room reached a policy."""
    recording, out = write_bag(Drive(), tmp_path / "drive"), tmp_path / "out"
    argv = (recording, "--out", out, *up_to_the_panel(tmp_path))
    shell.json("start", *argv, code=3)
    profile = out / "profile.toml"
    text = re.sub(r"(length_m|width_m) = [\d.]+", r"\1 = 8.0", profile.read_text())
    profile.write_text(text)  # the nearest return is 3 m away
    document = shell.json("start", *argv, code=3)
    assert document["stages"][-1]["name"] == "check"
    assert "the robot's outline (8 x 8 m) is wrong" in document["stopped"]["why"]
    assert "inside it at 100% of the ticks" in document["stopped"]["why"]
    assert "length_m and width_m of [task.body]" in document["stopped"]["remedies"][0]
    document = shell.json("start", *argv, "--accept", code=3)
    assert document["stages"][-1]["name"] == "mix"
