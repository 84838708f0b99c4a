"""The demo: stages in order, each a command that a user could type; `make test-slow` runs it."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.text import Text
from support.panels import panel_of
from support.stores import recording_transitions

from restock import cli
from restock.cli.start import stages
from restock.cli.start.demo import MARKER, plan_of, prepare, run_demo
from restock.cli.start.stages import Settings, Stage
from restock.errors import RestockError
from restock.ingest.profile.profile import load_profile, profile_toml
from restock.train.run.run import FORMAT

SILENT = lambda message: None  # noqa: E731


def plan(tmp_path: Path) -> list[Stage]:
    return plan_of(Settings((str(tmp_path / "logs"),), tmp_path / "out", seconds=5, episodes=1))


def test_every_stage_is_a_verb_with_flags_that_exist(tmp_path: Path) -> None:
    verbs = [stage.command[0] for stage in plan(tmp_path)]
    before = ["info", "ingest", "sql", "audit", "mix", "mix"]
    assert verbs == [*before, "train", "train", "train", "eval", "eval", "eval", "report"]
    for stage in plan(tmp_path):
        assert cli.main([*stage.command, "--help"]) == 0
        assert not stage.beside or cli.main([*stage.beside, "--help"]) == 0


def test_two_feeds_differ_in_nothing_else(tmp_path: Path) -> None:
    settings = ("practice.rule=success", "seed=3")
    to = Settings(("logs",), tmp_path, seconds=9, train=settings)
    stage = stages.train_beside_uniform(to)
    reported = [dict(pairwise(words)) for words in (stage.command, stage.beside)]
    first, second = (
        {flag: value for flag, value in one.items() if flag.startswith("--")} for one in reported
    )
    assert first.keys() == second.keys()
    differing = {flag for flag in first if first[flag] != second[flag]}
    assert differing == {"--panel", "--out"}
    assert {"practice.rule=success", "seed=3"} <= {*stage.command} & {*stage.beside}


@pytest.mark.parametrize("drivers", [["operator", "planner"], ["joystick", "planner"]])
def test_the_policy_from_the_logs_alone_imitates_whom_there_is(
    tmp_path: Path, drivers: list[str]
) -> None:
    to = Settings(("logs",), tmp_path)
    rows = recording_transitions(1)
    at = rows.schema.get_field_index("behaviour_policy")
    names = pa.array([drivers[row % 2] for row in range(len(rows))])
    rows = rows.set_column(at, "behaviour_policy", names.cast(rows.schema.field(at).type))
    panel_of(rows, "[each_condition]\nshare = 'natural'\n", to.panel)
    decided = stages.train_on_logs(to).decided
    assert decided is not None
    command = decided()
    assert command is not None
    assert "teacher.source=logs" in command
    named = [word for word in command if word.startswith("teacher.policies")]
    assert named == ([] if "operator" in drivers else ['teacher.policies=["joystick", "planner"]'])


def test_the_run_that_is_behind_catches_up(tmp_path: Path) -> None:
    to = Settings(("logs",), tmp_path, seconds=9)

    def driven(run: int, uniform: int) -> list[str] | None:
        for path, steps in ((to.run, run), (to.uniform, uniform)):
            path.mkdir(exist_ok=True)
            (path / "config.json").write_text(json.dumps({"format": FORMAT}))
            table = pa.table({"env_steps": [0, steps]})
            pq.write_table(table, path / "progress.parquet")
        decided = stages.even_out(to).decided
        assert decided is not None
        return decided()

    assert driven(500, 500) is None
    behind = driven(480, 500)
    assert behind is not None
    assert behind[:5] == ["train", "--resume", str(to.run), "--env-steps", "500"]
    ahead = driven(512, 500)
    assert ahead is not None
    assert ahead[:5] == ["train", "--resume", str(to.uniform), "--env-steps", "512"]


def test_what_runs_beside_a_stage_ends_the_demo_where_it_fails(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def stage(*beside: str) -> Stage:
        return Stage("x", "x", "x", ["info"], beside=beside)

    assert run_demo([stage("info", "--help")], lambda command: 0, say=SILENT) == 0
    missing = stage("info", str(tmp_path / "nothing"))
    assert run_demo([missing], lambda command: 0, say=SILENT) == 2
    assert "nothing" in capfd.readouterr().err
    # What is beside one that fails does not go on.
    assert run_demo([missing], lambda command: 130, say=SILENT) == 130


def test_an_unexpected_exit_code_stops_the_demo(tmp_path: Path) -> None:
    ran: list[str] = []

    def dispatch(command: list[str]) -> int:
        ran.append(command[0])
        return {"audit": 1, "mix": 2}.get(command[0], 0)

    # A failed audit is expected on sample logs; a mixture that is refused is not.
    assert run_demo(plan(tmp_path), dispatch, say=SILENT) == 2
    assert ran[-1] == "mix"


def test_an_earlier_demo_is_replaced_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "out"
    prepare(out)
    (out / "old").write_text("old")
    prepare(out)
    assert sorted(path.name for path in out.iterdir()) == [MARKER]
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("precious")
    with pytest.raises(RestockError, match="not made by a demo"):
        prepare(mine)
    assert (mine / "thesis.tex").read_text() == "precious"


def test_demo_keeps_user_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    prepare(out)
    (out / "mine.mcap").write_text("precious")
    (tmp_path / "link").symlink_to(out)
    profile = out / "mine.toml"
    profile.write_text(profile_toml(load_profile("turtlebot3")))
    for given in (
        ["--logs", str(out / "mine.mcap")],
        ["--logs", str(tmp_path)],  # which has `out` within it
        ["--logs", str(tmp_path / "link" / "*.mcap")],
        ["--profile", str(profile)],
    ):
        assert cli.main(["demo", "--out", str(out), *given]) == 2
        assert "is inside --out" in capsys.readouterr().err
    for given in (["--logs", str(tmp_path / "lgos")], ["--profile", "turtelbot3"]):
        assert cli.main(["demo", "--out", str(out), *given]) == 2
    assert (out / "mine.mcap").read_text() == "precious"


@pytest.mark.parametrize("given", [("--seconds", "0"), ("--seconds", "nan"), ("--episodes", "0")])
def test_a_demo_that_could_not_end_does_not_begin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], given: tuple[str, str]
) -> None:
    assert cli.main(["demo", "--out", str(tmp_path / "out"), *given]) == 2
    assert capsys.readouterr().err.startswith(f"restock: {given[0]}: must be")
    assert not (tmp_path / "out").exists()


def test_a_name_in_brackets_is_said_as_it_is() -> None:
    said: list[str] = []
    run_demo([Stage("info", "", "", ["info", "a[old].mcap"])], lambda command: 0, say=said.append)
    assert "info 'a[old].mcap'" in "\n".join(Text.from_markup(line).plain for line in said)


def test_a_dry_run_prints_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert cli.main(["demo", "--out", str(out), "--dry-run"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1] == f"restock report {out / 'run'}"
    assert not out.exists()


def test_logs_of_another_robot_are_ingested_by_their_profile(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["--logs", str(tmp_path), "--profile", "mine.toml"]
    assert cli.main(["demo", "--out", str(tmp_path / "out"), *given, "--dry-run"]) == 0
    (ingest,) = [
        line for line in capsys.readouterr().out.splitlines() if line.startswith("restock ingest")
    ]
    assert ingest.endswith("--profile mine.toml")


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_demo_ends_with_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert (
        cli.main(["demo", "--out", str(out), "--seconds", "20", "--episodes", "2", "--json"]) == 0
    )
    said = capsys.readouterr().out
    parts = json.loads(said[said.rindex("{") :])
    page = Path(parts["report"]).read_text(encoding="utf-8")
    assert page.count("<svg") >= 10  # each figure at the widths of a phone and of a desk
