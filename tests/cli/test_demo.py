"""The demo: stages in order, each a command that a user could type; `make test-slow` runs it."""

import json
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from restock import cli
from restock.cli.start import demo, outcomes
from restock.cli.start.demo import DemoCommand, plan_of
from restock.cli.start.stages import Settings, Stage
from restock.cli.start.work import Work

SILENT = lambda message: None  # noqa: E731


def plan(tmp_path: Path) -> list[Stage]:
    return plan_of(Settings((str(tmp_path / "logs"),), tmp_path / "out", episodes=1))


def test_every_stage_is_valid_command(tmp_path: Path) -> None:
    verbs = [stage.command[0] for stage in plan(tmp_path)]
    before = ["info", "ingest", "sql", "audit", "mix", "mix"]
    assert verbs == [*before, "train", "train", "eval", "eval", "report"]
    assert {stage.name for stage in plan(tmp_path)} <= demo.WHY.keys()
    for stage in plan(tmp_path):
        assert cli.main([*stage.command, "--help"]) == 0
        assert not stage.beside or cli.main([*stage.beside, "--help"]) == 0


def test_compared_trainings_differ_only_in_panel(tmp_path: Path) -> None:
    settings = ("practice.rule=success", "seed=3")
    to = Settings(("logs",), tmp_path, train=settings)
    (stage,) = [stage for stage in plan_of(to) if stage.beside]
    options = [dict(pairwise(words)) for words in (stage.command, stage.beside)]
    first, second = (
        {flag: value for flag, value in one.items() if flag.startswith("--")} for one in options
    )
    assert first.keys() == second.keys()
    differing = {flag for flag in first if first[flag] != second[flag]}
    assert differing == {"--panel", "--out"}
    assert {"practice.rule=success", "seed=3"} <= {*stage.command} & {*stage.beside}


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


def test_demo_refuses_foreign_folder(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    assert cli.main(["demo", "--out", str(tmp_path)]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
