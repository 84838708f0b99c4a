"""The summary at the end of the demo, from a store, a panel and runs as its stages leave them."""

from pathlib import Path
from typing import Any

import pytest
from support.paths import ROOT

from restock import cli
from restock.cli.output import stdout
from restock.cli.start import demo
from restock.cli.start.stages import Settings
from restock.replay.panel.panel import Panel
from restock.train.run.run import Run

LOGS = ROOT / "sample_logs" / "amr_tuesday"
STEPS = ROOT / "benchmarks" / "evidence" / "step-quotas.toml"


@pytest.fixture(scope="module")
def finished_stages(tmp_path_factory: pytest.TempPathFactory) -> Settings:
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


def result_row(policy: str, condition: str, success: float | None) -> dict[str, Any]:
    ends = dict.fromkeys(("success_low", "success_high"))
    return {
        "policy": policy,
        "perturbation": "none",
        "condition": condition,
        "success": success,
    } | ends


def test_strata_are_shown_by_drawn_rows(finished_stages, capsys):
    """Regression: the panel's plan was printed as if it had been drawn."""
    demo.print_results(
        finished_stages, {"results": [result_row("agent", "nominal", 1.0)]}, stdout()
    )
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    drawn_rows = Run.open(finished_stages.run).table("strata").to_pylist()
    whole = sum(row["drawn_rows"] for row in drawn_rows)
    for stratum in Panel.open(finished_stages.panel).strata:
        (shown,) = [line for line in lines if line[:1] == [stratum.name] and len(line) == 7]
        of_name = [row["drawn_rows"] for row in drawn_rows if row["stratum"] == stratum.name]
        drawn = f"{100 * sum(of_name) / whole:.1f}"
        assert shown[1] == f"{100 * stratum.natural_share:.1f}"
        assert shown[3:6] == [drawn, drawn, "0.0"]  # nothing was driven


def test_rare_event_is_traced_from_message_to_update(finished_stages: Settings) -> None:
    lines = demo.rare_event(finished_stages)
    assert [line.split()[0] for line in lines] == ["recording", "row", "update", "All"]
    assert str(LOGS) in lines[0]
    assert "nominal" not in "".join(lines)
    command = lines[-1].partition(": restock ")[2].split()
    assert cli.main([*command, "--json"]) == 0


def test_policies_are_compared_by_mission_kind(tmp_path: Path) -> None:
    to = Settings(("logs",), tmp_path)
    alone, uniform = f"run:{demo.logs_alone(to)}", f"run:{demo.fed_uniformly(to)}"
    rows = [result_row(policy, "wheel_slip", 0.5) for policy in (alone, uniform, "agent", "random")]
    other = result_row("agent", "wheel_slip", 0.0) | {"perturbation": "friction"}
    rows += [result_row("planner", kind, 1.0) for kind in ("nominal", "wheel_slip")]
    slip, easy = demo.before_and_after({"results": [*rows, other]})
    success = {"logs alone": "0.50", "fed uniformly": "0.50", "agent": "0.50", "planner": "1.00"}
    assert slip == {"mission": "wheel_slip"} | success
    assert easy == {"mission": "nominal", "planner": "1.00"}
