"""The demo: stages in order, each a command that a user could type; `make test-slow` runs it."""

import json
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from restock import cli
from restock.cli.start import demo, outcomes
from restock.cli.start.demo import DemoCommand, plan_of
from restock.cli.start.stages import Settings, Stage
from restock.cli.start.work import Work
from restock.train.run.run import FORMAT

SILENT = lambda message: None  # noqa: E731


def plan(tmp_path: Path) -> list[Stage]:
    return plan_of(Settings((str(tmp_path / "logs"),), tmp_path / "out", seconds=5, episodes=1))


def test_every_stage_is_valid_command(tmp_path: Path) -> None:
    verbs = [stage.command[0] for stage in plan(tmp_path)]
    before = ["info", "ingest", "sql", "audit", "mix", "mix"]
    assert verbs == [*before, "train", "train", "train", "eval", "eval", "report"]
    assert {stage.name for stage in plan(tmp_path)} <= demo.WHY.keys()
    for stage in plan(tmp_path):
        assert cli.main([*stage.command, "--help"]) == 0
        assert not stage.beside or cli.main([*stage.beside, "--help"]) == 0


def test_compared_trainings_differ_only_in_panel(tmp_path: Path) -> None:
    settings = ("practice.rule=success", "seed=3")
    to = Settings(("logs",), tmp_path, seconds=9, train=settings)
    (stage,) = [stage for stage in plan_of(to) if stage.beside]
    options = [dict(pairwise(words)) for words in (stage.command, stage.beside)]
    first, second = (
        {flag: value for flag, value in one.items() if flag.startswith("--")} for one in options
    )
    assert first.keys() == second.keys()
    differing = {flag for flag in first if first[flag] != second[flag]}
    assert differing == {"--panel", "--out"}
    assert {"practice.rule=success", "seed=3"} <= {*stage.command} & {*stage.beside}


def test_run_that_is_behind_catches_up(tmp_path: Path) -> None:
    to = Settings(("logs",), tmp_path, seconds=9)
    other = demo.fed_uniformly(to)

    def driven(run: int, uniform: int) -> list[str] | None:
        for path, steps in ((to.run, run), (other, uniform)):
            path.mkdir(exist_ok=True)
            (path / "config.json").write_text(json.dumps({"format": FORMAT}))
            table = pa.table({"env_steps": [0, steps]})
            pq.write_table(table, path / "progress.parquet")
        return demo.catch_up(to)

    assert driven(500, 500) is None
    behind = driven(480, 500)
    assert behind is not None
    assert behind[:5] == ["train", "--resume", str(to.run), "--env-steps", "500"]
    ahead = driven(512, 500)
    assert ahead is not None
    assert ahead[:5] == ["train", "--resume", str(other), "--env-steps", "512"]


def verb(command: list[str], code: int = 0) -> int:
    """Stand in for a verb that prints its document."""
    sys.stdout.write(json.dumps({"ran": command[0]}))
    return code


def test_failure_of_parallel_command_fails_stage(tmp_path: Path) -> None:
    def stage(*beside: str) -> Stage:
        return Stage("x", "x", ["info"], beside=beside, writes=())

    missing = stage("info", str(tmp_path / "nothing"))
    assert Work(tmp_path / "a", verb, SILENT).do(stage("info", "--help")).good
    ended = Work(tmp_path / "b", verb, SILENT).do(missing)
    assert (ended.status, ended.exit_code) == ("failed", 2)
    assert "nothing" in "".join(ended.errors)
    # If the stage's command fails, the parallel one is stopped.
    failing = Work(tmp_path / "c", lambda command: verb(command, 2), SILENT).do(missing)
    assert failing.exit_code == 2


def test_unexpected_exit_code_stops_demo(tmp_path, monkeypatch):
    ran: list[str] = []

    def dispatch(command: list[str]) -> int:
        ran.append(command[0])
        return verb(command, {"audit": 1, "mix": 2}.get(command[0], 0))

    monkeypatch.setattr(cli, "main", dispatch)
    monkeypatch.setattr(outcomes, "errors", lambda text: [])
    plain = [replace(stage, outcome=lambda document: []) for stage in plan(tmp_path)]
    monkeypatch.setattr(demo, "plan_of", lambda to: plain)
    # A failed audit is expected on sample logs; a mixture that is refused is not.
    assert DemoCommand(out=tmp_path / "out").run() == 2
    assert ran[-1] == "mix"


def test_stage_command_is_decided_when_stage_begins(tmp_path: Path) -> None:
    ran: list[list[str]] = []

    def dispatch(command: list[str]) -> int:
        ran.append(command)
        return verb(command)

    def stage(command: list[str] | None) -> Stage:
        return Stage("x", "x", ["train", "LATER"], decided=lambda: command)

    assert Work(tmp_path / "out", dispatch, SILENT).do(stage(["train", "now"])).good
    assert ran == [["train", "now", "--json"]]
    assert Work(tmp_path / "out", dispatch, SILENT).do(stage(["train", "then"])).status == "kept"
    assert Work(tmp_path / "none", dispatch, SILENT).do(stage(None)).good
    assert len(ran) == 1


def test_demo_refuses_foreign_folder(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    assert cli.main(["demo", "--out", str(tmp_path)]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
