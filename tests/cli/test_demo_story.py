"""What the demo tells at its end, of a store, a panel and runs as its stages leave them."""

from pathlib import Path
from typing import Any

import pytest
from support.paths import ROOT

from restock import cli
from restock.cli.output import stdout
from restock.cli.start import demo
from restock.cli.start.stages import Settings
from restock.replay.panel.panel import Panel
from restock.train.run.kept_evaluations import FILE
from restock.train.run.run import Run
from restock.train.run.run_tables import EVAL_EPISODES

LOGS = ROOT / "sample_logs" / "amr_tuesday"
STEPS = ROOT / "benchmarks" / "evidence" / "step-quotas.toml"


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Settings:
    to = Settings((str(LOGS),), tmp_path_factory.mktemp("demo"))
    for command in (
        ["ingest", str(LOGS), "--store", str(to.store)],
        ["mix", str(to.store), "--mixture", str(STEPS), "--out", str(to.panel)],
        ["train", "--panel", str(to.panel), "--out", str(to.run)]
        + [f"--set={setting}" for setting in ("env.twin=false", "teacher.source=none")]
        + ["--set=schedule.offline_updates=6", "--set=record.audit_share=1"],
    ):
        assert cli.main(command) in (0, 3), command
    return to


def test_a_stratum_is_shown_by_what_the_critic_was_fed_of_it(reported, capsys, monkeypatch):
    """The plan of the panel was printed, as if it had been drawn."""
    monkeypatch.setattr(demo, "before_and_after", lambda to: [])
    demo.tell(reported, stdout())
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    drawn_rows = Run.open(reported.run).table("strata").to_pylist()
    whole = sum(row["drawn_rows"] for row in drawn_rows)
    for stratum in Panel.open(reported.panel).strata:
        (shown,) = [line for line in lines if line[:1] == [stratum.name] and len(line) == 7]
        of_name = [row["drawn_rows"] for row in drawn_rows if row["stratum"] == stratum.name]
        drawn = f"{100 * sum(of_name) / whole:.1f}"
        assert shown[1] == f"{100 * stratum.natural_share:.1f}"
        assert shown[3:6] == [drawn, drawn, "0.0"]  # nothing was driven


def test_a_rare_event_is_followed_from_its_message_to_an_update(reported: Settings) -> None:
    lines = demo.rare_event(reported)
    links = [line.split()[0] for line in lines if not line.startswith(" ")]
    assert links == ["recording", *["message"] * 2, "row", "stratum", "update", "All"]
    assert str(LOGS) in lines[0]
    assert any("/scan" in line and "m away" in line for line in lines)
    assert "nominal" not in "".join(lines)
    command = lines[-1].removeprefix("All of it: restock ").split()
    assert cli.main([*command, "--json"]) == 0


def driven(policy: str, condition: str, success: bool | None, seed: int) -> dict[str, Any]:
    known = {
        "policy": policy,
        "perturbation": "none",
        "condition": condition,
        "success": success,
        "episode_seed": seed,
    }
    return {name: known.get(name) for name in EVAL_EPISODES.names}


def write(run: Path, rows: list[dict[str, Any]]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    (run / FILE).parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(rows, schema=EVAL_EPISODES), run / FILE)


def test_before_after_and_planner_stand_side_by_side(tmp_path: Path) -> None:
    to = Settings(("logs",), tmp_path)
    alone = f"run:{demo.logs_alone(to)}"
    after = [driven(alone, "wheel_slip", n < 1, n) for n in range(4)]
    after += [driven("agent", "wheel_slip", n < 3, n) for n in range(4)]
    easy = [driven("planner", "nominal", True, n) for n in range(2)]
    write(to.run, [*after, *easy, *(driven("planner", "wheel_slip", n < 2, n) for n in range(4))])
    easy_row, slip, rare = demo.before_and_after(to)
    assert (easy_row["mission"], slip["mission"], rare["mission"]) == (
        "nominal",
        "wheel_slip",
        demo.RARE,
    )
    assert slip["logs alone"].startswith("1 of 4 [")
    assert slip["agent"].startswith("3 of 4 [")
    assert slip["planner"] == rare["planner"]
    assert easy_row["planner"].startswith("2 of 2 [")
    assert easy_row["logs alone"] == ""
    assert "fed uniformly" not in slip
    uniform = f"run:{demo.fed_uniformly(to)}"
    write(to.run, [*after, *easy, *(driven(uniform, "wheel_slip", n < 2, n) for n in range(4))])
    beside = demo.before_and_after(to)[1]
    assert beside["fed uniformly"].startswith("2 of 4 [")
    assert list(beside)[1:] == ["logs alone", "fed uniformly", "agent", "planner"]


def test_without_a_goal_no_success_is_told(tmp_path: Path) -> None:
    to = Settings(("logs",), tmp_path)
    policies = f"run:{demo.logs_alone(to)}", "agent", "planner"
    write(to.run, [driven(policy, "nominal", None, 0) for policy in policies])
    assert demo.before_and_after(to) == []
