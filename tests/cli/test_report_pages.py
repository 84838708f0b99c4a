"""Pages of a study, a store and a folder of runs: figures of their data, and escaped names."""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from support.finished_runs import document, make_run
from support.page_scripts import Page
from support.stores import recording_transitions, write_store

from restock.cli import main
from restock.replay.store.store import Store
from restock.report import coverage_page, study_page, write_page
from restock.report.fleet.coverage import coverage_weeks
from restock.report.look import charts
from restock.report.look.write import Charts

HOSTILE = "</script><script>alert(1)</script><!--"


def read(page: Path) -> Page:
    found = Page(page.read_text(encoding="utf-8"))
    assert "wheel_slip" not in found.text
    return found


def test_study_page_shows_findings(tmp_path: Path) -> None:
    ends = {"success nominal": [0.9, 0.8, 1.1], "success wheel_slip": [0.5, None, None]}
    comparison = {
        "arm": HOSTILE,
        "baseline": "uniform",
        "treatment": "mixture",
        "verdict": "inconclusive",
        "why": "too few episodes to show that mix (whole run) are the same",
        "refused": [],
        "differences": [],
        "checks": [{"name": "mix", "verdict": "inconclusive"}],
        "outcomes": [],
    }
    curve = {"condition": "wheel_slip", "runs": 3, "success": 0.5, "low": 0.4, "high": 0.6}
    study = {
        "doc": "",
        "seeds": [0, 1, 2],
        "rare": ["wheel_slip"],
        "runs": {"uniform": ["a"], HOSTILE: ["b"]},
        "contrasts": [],
        "arms": [{"arm": name, "runs": 3, **ends} for name in ("uniform", HOSTILE)],
        "curves": [
            {**curve, "arm": name, "env_steps": step}
            for name in ("uniform", HOSTILE)
            for step in (100, 200)
        ],
        "cost": [],
        "comparisons": [comparison],
    }
    found = read(write_page(study_page(study), tmp_path / "study.html"))
    assert "gate refused 1 of 1 comparisons" in found.text
    assert "inconclusive: too few episodes to show that mix (whole run)" in found.text
    assert HOSTILE in found.text  # shown, as text


def test_coverage_page_has_sections(store_path, tmp_path, shell):
    page = tmp_path / "page.html"
    argv = ["coverage", str(store_path), "--out", str(page)]
    assert "rows that hold each condition" in shell.out(*argv)
    found, html = read(page), page.read_text(encoding="utf-8")
    for section in ("shelves", "shopping", "weeks", "robots", "map"):
        assert f'<section id="{section}">' in html
    assert "figure" in found.tags
    alone = ["--mixture", "uniform"]  # it needs --out
    assert main(["coverage", str(store_path), *alone]) == 2


def test_coverage_page_counts_rows_per_condition(store_path: Path) -> None:
    with Store(store_path) as store:
        sections = coverage_of(store)
        slips = "SELECT count(*) FROM transitions WHERE"
        ((held,),) = store.sql(f"{slips} list_contains(conditions, 'wheel_slip')").fetchall()
        ((named,),) = store.sql(f"{slips} primary_condition = 'wheel_slip'").fetchall()
    (table,) = sections["shelves"].tables
    (slip,) = [row for row in table.rows if row["condition"] == "wheel slip"]
    assert held > named
    assert slip["rows"] == str(held)
    assert slip["by priority"].startswith(f"{named} (")
    assert list(slip)[:2] == ["condition", "rows"]


CONTROL_PERIOD_S = 0.2
NO_PLAN = {"orders": [], "total": 0.0, "total_low": 0.0, "total_high": 0.0, "hours": 0.0}
NO_GAPS = {  # as `restock coverage gaps --json` prints it
    "store": "store",
    "store_version": 1,
    "mixture": "coverage",
    "confidence": 0.8,
    "unit": "missions",
    "closed": True,
    "gaps": [],
    "plan": NO_PLAN,
}


def coverage_of(store: Store) -> dict[str, Any]:
    """Return the sections of a store's page by id."""
    page = coverage_page(store, NO_GAPS, "nothing to compare")
    return {section.id: section for section in page["sections"] if section is not None}


def test_robot_hours_are_rows_times_control_period(tmp_path: Path) -> None:
    """Regression: a robot's hours were multiplied by the number of its conditions."""
    tables = [recording_transitions(number) for number in (1, 2, 3)]
    tags = [{"robot": "a"}, {"robot": "a"}, {"robot": "b"}]
    with Store(write_store(tmp_path / "store", tables, tags=tags)) as store:
        sections = coverage_of(store)
        (table,) = sections["robots"].tables
        weeks, _ = coverage_weeks(store)
        of_robot = (
            "SELECT robot, count(*), count(DISTINCT primary_condition) FROM transitions"
            " GROUP BY ALL"
        )
        counted = store.sql(of_robot).fetchall()
    assert all(conditions > 1 for _, _, conditions in counted)
    expected = {robot: f"{rows * CONTROL_PERIOD_S / 3600:.2f}" for robot, rows, _ in counted}
    assert {row["robot"]: row["hours"] for row in table.rows} == expected
    every = sum(rows for _, rows, _ in counted) * CONTROL_PERIOD_S / 3600
    assert {round(row["hours"], 9) for row in weeks} == {round(every, 9)}


def test_chart_has_gaps_for_non_finite_values() -> None:
    """Regression: a run whose TD error became NaN had no page."""
    values = [0.5, math.nan, np.float32("inf"), 1.0]
    rows = [{"step": step, "td": value} for step, value in enumerate(values)]
    drawing = charts.draw(lambda _: charts.plot(rows).mark_line().encode(x="step:Q", y="td:Q"))
    page = Charts(charts.CONFIG)
    for spec in drawing.spec.values():
        page.add(spec)
    text = re.search(r'id="charts">(.*?)</script>', page.blocks())
    assert text is not None
    (shown,) = json.loads(text[1])["rows"].values()
    assert [row["td"] for row in shown] == [0.5, None, None, 1.0]


def test_folder_page_shows_changes_between_runs(store_path, tmp_path, shell):
    folder = tmp_path / "night"
    wider = {"config__replay__batch_size": 7}
    make_run(folder / "runs" / "<b>monday", document(0, created_ns=1), success=0.2)
    make_run(folder / "runs" / "tuesday", document(1, created_ns=2, **wider), success=0.7)
    make_run(folder / "old", document(1, format="restock-run/1"))
    damaged = make_run(folder / "damaged", document(1)) / "fed.parquet"
    damaged.write_bytes(damaged.read_bytes()[:-9])
    (folder / "fleet").symlink_to(store_path)
    assert shell.out("report", folder) == f"{folder / 'report.html'}\n"
    text = read(folder / "report.html").text
    assert "tuesday, the latest run, against <b>monday: better in wheel slip" in text
    assert re.search(r"replay\.batch_size \d+ → 7\b", text)
    assert "was written by an earlier Restock" in text
    assert str(damaged) in text
    assert "fleet: week by week" in text
    assert main(["report", str(folder / "runs" / "nothing")]) == 2
