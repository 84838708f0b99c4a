"""The report: one offline page with the figures of the run's tables and escaped names."""

import json
import re
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import vl_convert
from support.page_scripts import Page, charts_of
from support.panels import EVERY, NO_SPLIT, panel_of
from support.stores import TASK

from restock import cli
from restock.errors import RunError
from restock.report import build_report
from restock.report.run.facts import Facts, evaluation_bias, gather
from restock.report.run.headline import headline
from restock.report.run.page import floor_section
from restock.stats import ConfidenceInterval
from restock.train.run.run import Run
from restock.train.run.run_tables import EVAL_EPISODES, TABLES
from restock.train.twin.calibration.twin_gap import TrustLimits, TwinGap, Verdict, write_gap

HOSTILE = "<script>alert(1)</script>"


def fill(run: Run, table: str, *rows: dict[str, Any], **values: Any) -> None:
    """Append rows to a run's table; other columns get a default value of their type."""
    plain = [
        (pa.types.is_boolean, False),
        (pa.types.is_floating, 0.5),
        (pa.types.is_integer, 1),
        (lambda kind: pa.types.is_list(kind) or pa.types.is_map(kind), []),
        (lambda _: True, "x"),
    ]
    row = {one.name: next(x for fits, x in plain if fits(one.type)) for one in TABLES[table]}
    run.append(table, [row | values | more for more in rows or ({},)])


@pytest.fixture(scope="module")
def run(store_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run directory as training and `restock eval` leave it, over the synthetic store."""
    root = tmp_path_factory.mktemp("reported")
    panel = panel_of(store_path, EVERY + NO_SPLIT, root / "panel", task=TASK)
    config = {
        "target": {"rule": "hard", "every": 500},
        "replay": {"ring_capacity": 4096},
        "practice": {"rule": "success"},
    }
    document = {
        "config": config,
        "panel": {"path": str(root / "panel"), "id": panel.id},
        "created_ns": panel.header.newest_ns + 3 * 86_400 * 10**9,
    }
    made = Run.create(root / "run", document)
    for n in (500, 1000):
        clocks = {"gradient_steps": n, "env_steps": 4 * n}
        fill(made, "progress", **clocks, phase="online")
        for name, rows in (("nominal", 90), (HOSTILE, 10)):
            sources = ({"source": "logs"}, {"source": "fresh"})
            fill(made, "strata", *sources, gradient_steps=n, stratum=name, drawn_rows=rows)
            shares = {
                "wanted_share": 0.5,
                "drawn_share": rows / 100,
                "logs_share": rows / 200,
                "fresh_share": rows / 200,
                "short_share": max(0.5 - rows / 100, 0.0),
                "reason": f"too few rows of {HOSTILE}" if rows < 50 else None,
                "drawn_rows": 2 * rows,
            }
            fill(made, "fed", gradient_steps=n, phase="online", stratum=name, **shares)
        for arm, share, episodes in (("wheel_slip", 0.2, 12), (HOSTILE, 0.8, 0)):
            known = {"episodes": episodes, "success": 0.25 if episodes else None}
            known |= {"arm": arm, "wanted_share": share if n == 500 else 0.5}
            fill(made, "practice", env_steps=4 * n, rule="success", **known)
        fill(made, "probe", gradient_steps=n, condition="nominal")
        best = {"success": n == 500, "best": n == 500}
        fill(made, "evaluations", **clocks, condition="nominal", block="none", **best)
    estimates = (
        {"estimator": "fqe", "refused": None},
        {"estimator": "pdwis", "value": None, "refused": HOSTILE},
    )
    for condition in ("all", "nominal"):
        fill(made, "off_policy", *estimates, condition=condition)
    fill(made, "ages", *({"bucket": n} for n in (-1, 0, 3)), source="logs", unit="days")
    fill(made, "policies", source="logs", behaviour_policy="planner")
    made.flush()
    plain = {"perturbation": "none", "block": "none", "bumps": 0, "time_s": 10.0, "return": 1.0}
    plain |= {"end_x_m": 1.0, "end_y_m": 2.0}
    episodes = [
        plain
        | {"policy": policy, "condition": condition, "episode_seed": seed}
        | {"success": seed % 10 < wins, "failure": None if seed % 10 < wins else "stuck"}
        for policy, condition, wins in (
            ("agent", "nominal", 9),
            ("agent", "wheel_slip", 2),
            ("planner", "nominal", 10),
            ("planner", "wheel_slip", 10),
        )
        for seed in range(20)
    ]
    (made.path / "eval").mkdir()
    table = pa.Table.from_pylist(episodes, schema=EVAL_EPISODES)
    pq.write_table(table, made.path / "eval" / "episodes.parquet")
    return made.path


def test_replay_card_has_figures_of_run(run: Path, shell) -> None:
    card = shell.json("report", run, "--card")
    assert card["capacity"]["ring_rows"] == 4096
    assert card["capacity"]["panel_rows"] > 0
    assert card["target"] == {"rule": "hard", "every": 500}
    assert card["sampling"]["logs"].startswith("quotas by stratum")
    assert card["ages"][0]["p50"] == "below 2"
    assert {row["stratum"] for row in card["strata"]} == {"nominal", HOSTILE}
    assert card["behaviour_policies"][0]["behaviour_policy"] == "planner"
    assert [(row["estimator"], row["value"]) for row in card["off_policy"]] == [
        ("fqe", 0.5),
        ("pdwis", None),
    ]
    assert card["practice"]["rule"] == "success"
    slip, other = card["practice"]["arms"]
    assert (slip["first_share"], slip["last_share"], slip["given_share"]) == (0.2, 0.5, 1.0)
    assert (slip["episodes"], slip["success"]) == (24, 0.25)
    assert (other["episodes"], other["success"]) == (0, None)
    assert "largest bias comes from" in card["imbalance"]
    assert json.loads((run / "replay_card.json").read_text()) == card


def test_replay_card_escapes_names(run: Path, shell) -> None:
    page = shell.out("report", run, "--card")
    assert (run / "replay_card.md").read_text() == page
    assert "<script" not in page


@pytest.fixture(scope="module")
def html(run: Path) -> str:
    return build_report(run).read_text(encoding="utf-8")


def test_charts_are_valid_vega_lite(html: str) -> None:
    page = charts_of(html)
    assert len(page["charts"]) >= 10
    for chart in page["charts"]:
        spec = {**chart["spec"], "datasets": {name: page["rows"][name] for name in chart["rows"]}}
        assert "Undefined" not in json.dumps(vl_convert.vegalite_to_vega(spec))


def test_page_is_offline_and_escapes_names(html: str) -> None:
    assert Page(html).tags.count("script") == 3  # rows, Vega, and the script that draws
    assert "alert(1)" in html  # it is shown …
    assert HOSTILE not in html  # … as text


def test_headline_is_comparison_with_interval(run: Path) -> None:
    found = headline(gather(run))
    assert re.match(r"Worse than the planner in wheel slip \(−80 points \[−95, −6\d\]\)", found)


@pytest.mark.long
def test_twin_gap_has_section(run: Path, tmp_path: Path) -> None:
    position = {"condition": "nominal", "horizon_s": 3.0, "quantity": "position", "unit": "m"}
    position |= {"source": "nominal", "segments": 40, "episodes": 9}
    position |= {f"{q}{end}": 0.5 for q in ("median", "p90") for end in ("", "_low", "_high")}
    far = ConfidenceInterval(0.5, 0.4, 0.6)
    gap = TwinGap(
        about={"limits": asdict(TrustLimits()), "store_version": 7, "twins": {"nominal": {}}},
        paths=[position],
        observations=[],
        rewards=[],
        verdicts=(Verdict("nominal", "untrusted", ("it is far off",), 40, 9, far, far),),
        not_done=(f"No {HOSTILE} was compared.",),
    )
    copy = shutil.copytree(run, tmp_path / "run")
    write_gap(gap, copy / "gap")
    page = build_report(copy).read_text(encoding="utf-8")
    part = page.split('<section id="twin-gap">')[1].split("</section>")[0]
    assert "Do not trust the twin in: nominal." in part
    assert HOSTILE not in part
    assert part.count("<figure") == 1
    (copy / "gap" / "gap.json").write_text("{}")
    page = build_report(copy).read_text(encoding="utf-8")
    assert '<section id="twin-gap">' not in page


def test_evaluation_bias_is_reported(run: Path) -> None:
    facts = gather(run)
    facts.logged = [
        {"condition": "nominal", "share": 0.1, "episodes": 1},
        {"condition": "wheel_slip", "share": 0.9, "episodes": 9},
    ]
    # Nominal is easier, and half of the evaluation, but only a tenth of the logs.
    assert "success would be 27% instead of 55%" in evaluation_bias(facts)
    assert "largest bias comes from nominal" in evaluation_bias(facts)


def test_run_without_evaluation_has_page(tmp_path: Path) -> None:
    made = Run.create(tmp_path / "run", {"config": {"target": {"rule": "polyak", "tau": 0.005}}})
    fill(made, "progress", phase="offline")
    made.flush()
    assert '<section id="fed">' in build_report(made.path).read_text(encoding="utf-8")


def _on_floors(run: Path, path: Path, layouts: str, ended_on: str) -> Facts:
    """Return the facts of the run as if it had driven on other floors and ended on `ended_on`."""
    shutil.copytree(run, path)
    document = json.loads((path / "config.json").read_text())
    document["config"]["env"] = {"layouts": layouts}
    (path / "config.json").write_text(json.dumps(document))
    file = path / "eval" / "episodes.parquet"
    table = pq.read_table(file)
    column = pa.array([ended_on] * len(table))
    pq.write_table(table.set_column(table.column_names.index("layout"), "layout", column), file)
    return gather(path)


def test_floor_drawing_uses_layout_of_run(run: Path, tmp_path: Path) -> None:
    hall = tmp_path / "hall.toml"
    hall.write_text("width_m = 20.0\ndepth_m = 5.0\nracks = [[1.0, 2.0, 8.0, 3.0]]\n")
    section = floor_section(_on_floors(run, tmp_path / "hall", str(hall), "hall.toml"))
    assert section is not None
    (figure,) = section.figures
    assert 'rect width="800" height="200"' in figure.drawing.svg[470]
    assert figure.drawing.svg[470].count('stroke-width="3.4"') == 18
    assert floor_section(_on_floors(run, tmp_path / "default", str(hall), "default")) is None


def test_report_verb_writes_page(run, tmp_path, shell):
    out = tmp_path / "deep" / "page.html"
    document = shell.json("report", run, "--out", out)
    assert document == {"report": str(out), "bytes": out.stat().st_size}


def test_missing_and_untrained_runs_are_refused(tmp_path: Path) -> None:
    Run.create(tmp_path / "run", {"config": {}})
    (tmp_path / "empty").mkdir()
    for place in (tmp_path / "nothing", tmp_path / "empty", tmp_path / "run"):
        with pytest.raises(RunError) as refused:
            build_report(place)
        assert refused.value.where == str(place)
        assert cli.main(["report", str(place)]) == 2


def test_chance_level_policy_is_not_called_better(run: Path) -> None:
    facts = gather(run)
    facts.cells += [
        {**row, "policy": "random", "success": 0.6} for row in facts.clean_cells("agent")
    ]
    assert headline(facts).startswith("Nothing was learned: no better than a random policy")
