"""The report: one page that opens offline, says what the run's tables say, and trusts no name."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from html import escape
from html.parser import HTMLParser
from itertools import combinations, pairwise
from pathlib import Path
from xml.etree import ElementTree

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import vl_convert
from PIL import Image
from support.page_scripts import charts_of
from support.panels import panel_of
from support.stores import TASK, recording_transitions, with_clear_view, write_store

from restock import cli
from restock.cli.learning.eval import show_measures
from restock.errors import RunError
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.panel import Panel
from restock.replay.store.audit import capacity_of_rows
from restock.replay.store.store import Store
from restock.report import build_report
from restock.report.look.charts import POLICY_COLOURS, POLICY_SPARES, colours, lines, scale
from restock.report.look.queries import ask, statements
from restock.report.look.theme import DARK
from restock.report.run import fed
from restock.report.run.facts import evaluation_bias, gather, mean_success
from restock.report.run.headline import headline
from restock.report.run.page import page, success, ways_section
from restock.stats import ConfidenceInterval
from restock.train.run.kept_evaluations import summary_rows
from restock.train.run.run import Run
from restock.train.run.run_tables import EVAL_EPISODES, TABLES
from restock.train.twin.calibration.twin_gap import TrustLimits, TwinGap, Verdict, write_gap
from restock.train.twin.floors.floor_files import write_floor
from restock.train.twin.floors.floors import open_floors
from restock.train.twin.floors.occupancy_grid import into_frame
from restock.words import policy_words

HOSTILE = "<script>alert(1)</script>"


def filled(table: str, **values: object) -> dict[str, object]:
    """Return a row of a run's table; what is not given is a plain value of the column's type."""
    row: dict[str, object] = {}
    for field in TABLES[table]:
        if pa.types.is_boolean(field.type):
            row[field.name] = False
        elif pa.types.is_floating(field.type):
            row[field.name] = 0.5
        elif pa.types.is_integer(field.type):
            row[field.name] = 1
        elif pa.types.is_list(field.type) or pa.types.is_map(field.type):
            row[field.name] = []
        else:
            row[field.name] = "x"
    return row | values


@pytest.fixture(scope="module")
def run(store_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run directory as training and `restock eval` leave it, over the synthetic store."""
    root = tmp_path_factory.mktemp("reported")
    mixture = parse_mixture(
        "[each_condition]\nshare = 'natural'\n[evaluation_split]\nby = 'none'\n"
    )
    panel = panel_of(store_path, mixture, root / "panel", task=TASK)
    config = {
        "target": {"rule": "hard", "every": 500},
        "replay": {"ring_capacity": 4096},
        "practice": {"rule": "success"},
    }
    began_ns = panel.header.newest_ns + 3 * 86_400 * 10**9
    document = {
        "config": config,
        "panel": {"path": str(root / "panel"), "id": panel.id},
        "created_ns": began_ns,
    }
    made = Run.create(root / "run", document)
    steps = (500, 1000)
    made.append(
        "progress",
        [filled("progress", gradient_steps=n, env_steps=4 * n, phase="online") for n in steps],
    )
    made.append(
        "strata",
        [
            filled("strata", gradient_steps=n, source=source, stratum=name, drawn_rows=rows)
            for n in steps
            for source in ("logs", "fresh")
            for name, rows in (("nominal", 90), (HOSTILE, 10))
        ],
    )
    made.append(
        "fed",
        [
            filled(
                "fed",
                gradient_steps=n,
                phase="online",
                stratum=name,
                wanted_share=0.5,
                drawn_share=rows / 100,
                logs_share=rows / 200,
                fresh_share=rows / 200,
                short_share=max(0.5 - rows / 100, 0.0),
                reason=f"too few rows of {HOSTILE}" if rows < 50 else None,
                drawn_rows=2 * rows,
            )
            for n in steps
            for name, rows in (("nominal", 90), (HOSTILE, 10))
        ],
    )
    # Of three actions the logs never have the last, which the policy takes in 18 of 60 rows.
    made.append(
        "actions",
        [
            filled(
                "actions",
                gradient_steps=1000,
                source=source,
                stratum=name,
                condition=name,
                action=action,
                name=("stop", "drive 1", HOSTILE)[action],
                drawn_rows=rows[action],
                audited_rows=60,
                greedy_rows=(2, 40, 18)[action],
            )
            for source, rows in (("logs", (500, 500, 0)), ("fresh", (300, 2, 698)))
            for name in ("nominal", HOSTILE)
            for action in range(3)
        ],
    )
    estimates = {"fqe": {"refused": None}, "pdwis": {"value": None, "refused": HOSTILE}}
    made.append(
        "off_policy",
        [
            filled("off_policy", condition=condition, estimator=name, **values)
            for condition in ("all", "nominal")
            for name, values in estimates.items()
        ],
    )
    made.append(
        "practice",
        [
            filled(
                "practice",
                env_steps=4 * n,
                rule="success",
                arm=arm,
                wanted_share=share if n == 500 else 0.5,
                episodes=episodes,
                success=None if episodes == 0 else 0.25,
            )
            for n in steps
            for arm, share, episodes in (("wheel_slip", 0.2, 12), (HOSTILE, 0.8, 0))
        ],
    )
    made.append("ages", [filled("ages", source="logs", unit="days", bucket=b) for b in (-1, 0, 3)])
    made.append("policies", [filled("policies", source="logs", behaviour_policy="planner")])
    made.append("probe", [filled("probe", gradient_steps=n, condition="nominal") for n in steps])
    made.append(
        "evaluations",
        [
            filled(
                "evaluations",
                env_steps=4 * n,
                gradient_steps=n,
                condition="nominal",
                block="none",
                success=n == 500,
                best=n == 500,
            )
            for n in steps
        ],
    )
    made.flush()
    episodes = [
        {
            "policy": policy,
            "perturbation": "none",
            "condition": condition,
            "block": "none",
            "episode_seed": seed,
            "success": seed % 10 < wins,
            "bumps": 0,
            "time_s": 10.0,
            "return": 1.0,
            "end_x_m": 1.0,
            "end_y_m": 2.0,
            "failure": None if seed % 10 < wins else "stuck",
        }
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


def test_the_replay_card_answers_every_question(run: Path, capsys) -> None:
    assert cli.main(["report", str(run), "--card", "--json"]) == 0
    card = json.loads(capsys.readouterr().out)
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


def test_the_replay_card_is_one_page_of_markdown_that_trusts_no_name(run: Path, capsys) -> None:
    assert cli.main(["report", str(run), "--card"]) == 0
    page = capsys.readouterr().out
    assert (run / "replay_card.md").read_text() == page
    assert len(page.splitlines()) < 60
    assert "<script" not in page
    for words in ("Capacity", "Sampling rule", "Target rule", "Corrections", "Age of the sampled"):
        assert words in page
    lines = page.splitlines()
    for before, line in pairwise(lines):  # every table has one width
        if before.startswith("|") and line.startswith("|"):
            assert before.replace("\\|", "").count("|") == line.replace("\\|", "").count("|")


class Outline(HTMLParser):
    """Tags, and everything that a browser would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.fetched: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attributes:
            if name in ("src", "href", "xlink:href", "srcset", "data") and value:
                self.fetched.append(value)


@pytest.fixture(scope="module")
def html(run: Path) -> str:
    return build_report(run).read_text(encoding="utf-8")


def outline(html: str) -> Outline:
    parser = Outline()
    parser.feed(html)
    return parser


def test_the_page_fetches_nothing(html: str) -> None:
    page = outline(html)
    assert [url for url in page.fetched if not url.startswith(("#", "data:"))] == []
    assert page.tags.count("script") == 3  # rows, Vega, and what draws with it
    assert "@import" not in html
    assert "url(http" not in html


def test_its_charts_are_drawn_again_by_vega_with_what_the_pointer_asks(html: str) -> None:
    page = charts_of(html)
    specs = [
        {**chart["spec"], "datasets": {name: page["rows"][name] for name in chart["rows"]}}
        for chart in page["charts"]
    ]
    assert len(specs) >= 14
    for spec in specs:  # each is one that Vega-Lite takes
        assert "Undefined" not in json.dumps(vl_convert.vegalite_to_vega(spec))
    text = json.dumps(specs)
    learnt = next(
        spec
        for spec in specs
        if '"environment steps"' in json.dumps(spec) and '"kept"' in json.dumps(spec["datasets"])
    )
    reported = learnt["layer"][-1]["encoding"]["tooltip"]
    assert [one["title"] for one in reported] == ["environment steps", "success"]
    success = next(spec for spec in specs if "facet" in spec and '"low"' in json.dumps(spec))
    (bars, _) = success["spec"]["layer"]
    assert bars["params"][0]["bind"] == "legend"
    reported = bars["encoding"]["tooltip"]
    assert [one["title"] for one in reported][-3:] == ["success", "95 %, low", "95 %, high"]
    assert reported[-1]["format"] == ".1~%"
    assert "alert(1)" in text  # a hostile name is text there, too


def test_a_policy_has_one_colour_in_all_charts(html: str) -> None:
    scales = re.findall(r'"scale":({"domain":\[[^]]*\],"range":\[[^]]*\]})', html)
    reported = [
        dict(zip(one["domain"], one["range"], strict=True)) for one in map(json.loads, scales)
    ]
    planner = [colours["planner"] for colours in reported if "planner" in colours]
    assert len(planner) >= 4  # success and behaviour, each at several widths
    assert set(planner) == {POLICY_COLOURS["planner"]}


def test_policies_look_unlike_each_other_in_both_themes() -> None:
    """The agent and a policy from the logs alone were two greens: .12 and in the dark .05 apart."""
    colours = (*POLICY_COLOURS.values(), *POLICY_SPARES)
    for theme in ({}, DARK):
        shown = [theme.get(colour, colour) for colour in colours]
        near = min((apart(a, b), a, b) for a, b in combinations(shown, 2))
        assert near[0] > 0.1, near
        ground = luminance(theme.get("#ffffff", "#ffffff"))
        for colour in shown[len(POLICY_COLOURS) :]:
            low, high = sorted((luminance(colour), ground))
            assert (high + 0.05) / (low + 0.05) >= 3, colour  # as WCAG asks of graphics
    drawn = scale(["agent", "fed uniformly", "logs alone"], POLICY_COLOURS).to_dict()["range"]
    assert len(set(drawn)) == 3
    assert set(drawn) <= set(colours)


def linear(colour: str) -> list[float]:
    """Red, green and blue of `#rrggbb`, as light."""
    values = (int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5))
    return [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in values]


def luminance(colour: str) -> float:
    return float(np.dot((0.2126, 0.7152, 0.0722), linear(colour)))


def apart(first: str, second: str) -> float:
    """How different two colours look: their distance in OKLab."""
    to_cones = [
        (0.4122214708, 0.5363325363, 0.0514459929),
        (0.2119034982, 0.6806995451, 0.1073969566),
        (0.0883024619, 0.2817188376, 0.6299787005),
    ]
    to_lab = [
        (0.2104542553, 0.7936177850, -0.0040720468),
        (1.9779984951, -2.4285922050, 0.4505937099),
        (0.0259040371, 0.7827717662, -0.8086757660),
    ]
    a, b = (np.dot(to_lab, np.cbrt(np.dot(to_cones, linear(one)))) for one in (first, second))
    return float(np.linalg.norm(a - b))


def test_a_policy_has_the_same_words_in_report_and_terminal(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    file = copy / "eval" / "episodes.parquet"
    other = {"planner": "run:demo/logs-alone"}
    rows = pq.read_table(file).to_pylist()
    rows = [{**row, "policy": other.get(row["policy"], row["policy"])} for row in rows]
    pq.write_table(pa.Table.from_pylist(rows, schema=EVAL_EPISODES), file)
    section = success(gather(copy))
    assert section is not None
    assert {row["policy"] for row in section.tables[0].rows} == {"agent", "logs alone"}
    svg = section.figures[0].widest
    assert "logs alone" in svg
    assert "run:demo" not in svg
    show_measures(summary_rows(rows))
    said = capsys.readouterr().out
    assert "logs alone" in said
    assert "run:demo" not in said


def test_policies_of_one_name_are_told_apart() -> None:
    assert policy_words(["agent", "run:a/x/quotas", "run:b/x/quotas", "onnx:x/quotas.onnx"]) == {
        "agent": "agent",
        "run:a/x/quotas": "a/x/quotas",
        "run:b/x/quotas": "b/x/quotas",
        "onnx:x/quotas.onnx": "x/quotas.onnx",
    }
    assert policy_words(["planner", "run:runs/planner", "limited:run:runs/no_practice"]) == {
        "planner": "planner",
        "run:runs/planner": "run:planner",
        "limited:run:runs/no_practice": "no practice, limited",
    }
    for name in ("run:.", "cloned:driver"):
        assert policy_words([name]) == {name: name}


def test_references_have_the_colours_of_reports_on_the_page_of_a_study() -> None:
    arms = [f"arm {number}" for number in range(6)]
    alone, beside = colours(arms), colours([*arms, "planner", "operator"])
    assert {name: beside[name] for name in arms} == alone  # in every chart of a page
    assert len(set(beside.values())) == 8
    for name in ("planner", "operator"):
        assert beside[name] == POLICY_COLOURS[name]


def test_nought_on_an_axis_of_thousands_is_nought() -> None:
    rows = [{"env_steps": n, "success": 0.5, "who": "agent"} for n in (0, 200_000)]
    drawn = lines(rows, x="env_steps", y="success", series="who", y_title="success")
    texts = [one.text for one in ElementTree.fromstring(drawn.svg[470]).iter() if one.text]
    assert {"0", "100k"} <= set(texts)
    assert "0k" not in texts


def test_names_that_begin_alike_are_told_apart_in_a_legend() -> None:
    names = [f"coverage-with-practice-where-it-fails-{seed}" for seed in (1, 2)]
    rows = [{"env_steps": n, "success": 0.5, "who": name} for name in names for n in (0, 2000)]
    drawn = lines(rows, x="env_steps", y="success", series="who", y_title="success", marker=0)
    texts = {one.text: one for one in ElementTree.fromstring(drawn.svg[470]).iter() if one.text}
    assert [text for text in texts if text.startswith("coverage")] == names
    assert texts["kept"].get("text-anchor") == "start"  # beside its line, not over the axis


def test_a_legends_names_have_room_in_a_wider_font() -> None:
    """In DejaVu Sans the first is 161 px wide, and it reached over the second one's mark."""
    names = ["coverage quotas, adaptive", "uniform replay, n steps 3"]
    rows = [{"env_steps": n, "success": 0.5, "who": name} for name in names for n in (0, 2000)]
    drawn = lines(rows, x="env_steps", y="success", series="who", y_title="success")
    _, entries = drawn.svg[470].split("role-legend-entry")
    first, second = re.findall(r'translate\(([\d.]+),[\d.]+\)"><path[^>]* d="M0,0h[1-9]', entries)
    label = re.search(r"role-legend-label.*?translate\(([\d.]+),", entries)
    assert label is not None
    assert float(second) - float(first) - float(label[1]) > 161


def test_a_hostile_name_is_text_and_no_markup(html: str) -> None:
    assert "alert(1)" in html  # it is shown …
    assert HOSTILE not in html  # … as text


def test_what_stands_in_backticks_is_set_as_code(html: str) -> None:
    sentences = re.findall(r'<(?:p|figcaption|div class="callout")[^>]*>(.*?)</', html, re.DOTALL)
    assert [text for text in sentences if "`" in text] == []
    assert "<code>restock " in html


def test_ages_say_how_old_the_newest_row_was(html: str) -> None:
    part = html.split('<section id="fed">')[1].split("</section>")[0]
    assert "the panel&#39;s newest row was 3.0 days old then" in part


def heading(html: str) -> str:
    found = re.search(r"<h1>(.*?)</h1>", html, re.DOTALL)
    assert found is not None
    return found[1]


def test_the_headline_is_a_comparison_with_its_interval(html: str) -> None:
    assert re.fullmatch(
        r"Worse than the planner in wheel slip \(−80 points \[−95, −6\d\]\);"
        r" no difference is shown in nominal",
        heading(html),
    )
    lead = html.split('<p class="lead">')[1].split("</p>")[0]
    assert "1,000 updates" in lead  # what it cost
    assert "between training seeds" in lead  # what the interval does not hold


def test_what_training_took_counts_the_steps_without_an_update(run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(run, tmp_path / "run")
    offline = filled("progress", gradient_steps=300, env_steps=0, phase="offline", wall_s=4.0)
    warmup = filled("progress", gradient_steps=300, env_steps=2016, phase="warmup", wall_s=11.0)
    schema = pa.schema(TABLES["progress"])
    rows = [offline, warmup | {"updates": 0, "loss": None}]
    pq.write_table(pa.Table.from_pylist(rows, schema), copy / "progress.parquet")
    html = build_report(copy).read_text(encoding="utf-8")
    assert (
        "trained on logs alone, without an update in the twin, for 2,016 environment steps and"
        " 300 updates in 11 s"
    ) in html
    assert '2,016</div><div class="label">environment steps' in html


def test_without_a_baseline_the_headline_says_so(run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(run, tmp_path / "run")
    file = copy / "eval" / "episodes.parquet"
    table = pq.read_table(file)
    pq.write_table(table.filter(pa.compute.equal(table["policy"], "agent")), file)
    said = heading(build_report(copy).read_text(encoding="utf-8"))
    assert said.startswith("No baseline drove the same episodes: success 90%")
    assert "20% [8%, 42%] in wheel slip" in said


def test_logged_ways_stand_beside_the_missions_that_were_drawn(run: Path, tmp_path: Path) -> None:
    assert ways_section(gather(run)) is None
    copy = shutil.copytree(run, tmp_path / "run")
    file = copy / "eval" / "episodes.parquet"
    drawn = pq.read_table(file).to_pylist()
    driven = [  # before the others, and of two ways in all
        {**row, "layouts": "hall.toml, ways of the logs", "success": row["policy"] == "agent"}
        for row in drawn
        if row["episode_seed"] < 2 and row["condition"] == "nominal"
    ]
    named = [{**row, "layouts": "hall.toml"} for row in drawn]
    pq.write_table(pa.Table.from_pylist([*driven, *named], schema=EVAL_EPISODES), file)
    facts = gather(copy)
    section = ways_section(facts)
    assert section is not None
    assert "4 of 84 episodes" in section.intro
    shown = {row["policy"]: row["success"] for row in section.tables[0].rows}
    assert shown == {"agent": "100% [34%, 100%]", "planner": "0% [0%, 66%]"}
    assert headline(facts) == headline(gather(run))  # of the drawn ones, as without them


def test_one_average_of_success_is_on_the_page(run: Path) -> None:
    """Conditions count the same; partly and wholly blocked aisles by half each."""
    cells = [
        {"cell": "nominal", "success": 1.0, "episodes": 100},
        {"cell": "blocked_aisle (partial)", "success": 0.2, "episodes": 3},
        {"cell": "blocked_aisle (full)", "success": 0.4, "episodes": 9},
    ]
    assert mean_success(cells) == pytest.approx(0.65)
    facts = gather(run)
    facts.logged = [
        {"condition": "nominal", "share": 0.1, "episodes": 1},
        {"condition": "wheel_slip", "share": 0.9, "episodes": 9},
    ]
    assert f"instead of {mean_success(facts.clean_cells()):.0%}" in evaluation_bias(facts)


def test_no_card_is_a_bare_average(run: Path) -> None:
    """The success on the episodes that chose the checkpoint was beside that of other episodes."""
    cards = page(gather(run))["cards"]
    assert all("success" not in card["label"] for card in cards)
    (kept,) = [card for card in cards if "kept policy" in card["label"]]
    assert kept == {
        "value": "2,000",
        "label": "environment step of the kept policy, the best of 2 evaluations in training",
    }


def test_a_table_of_many_columns_is_stacked_before_it_is_cut(html: str) -> None:
    """On a tablet it ended in the middle of a column, with no sign of more."""
    style = html.split("</style>")[0]
    assert re.search(r"@container \([^)]*\) and \(max-width: 780px\) {\s*\.wide,", style)
    assert re.search(r"\.scroll {[^}]*local", style)  # a shadow where more is to the right
    columns = re.findall(r"<table([^>]*)>\s*<thead>(.*?)</thead>", html, flags=re.DOTALL)
    for attributes, head in columns:
        assert ("wide" in attributes) == (head.count("<th ") > 6)
    assert any("wide" in attributes for attributes, _ in columns)


def test_a_condition_is_spelt_one_way(html: str) -> None:
    shown = re.sub(r"<(pre|code)>.*?</\1>", "", html.split("</style>")[1], flags=re.DOTALL)
    assert "wheel slip" in shown
    assert "wheel_slip" not in shown


def test_figures_are_drawn_at_the_size_of_a_phone_and_of_a_desktop(html: str) -> None:
    assert len(re.findall(r'<div class="drawing w300"[^>]*><svg[^>]* width="300"', html)) >= 7
    assert html.count('<div class="drawing w300"') == html.count(
        '<div class="drawing w470"'
    ) + html.count('<div class="drawing w1000"')
    sizes = set(re.findall(r'font-size="([\d.]+)px"', html))
    assert sizes == {"12"}
    ids = re.findall(r"<svg.*?</svg>", html, re.DOTALL)
    found = [name for svg in ids for name in set(re.findall(r' id="([^"]+)"', svg))]
    assert len(found) == len(set(found))


def test_every_colour_of_a_figure_has_one_for_a_dark_ground(html: str) -> None:
    """All but colours of marks that stand out on both."""
    figures = "".join(re.findall(r"<svg.*?</svg>", html, re.DOTALL))
    drawn = set(re.findall(r'(?:fill|stroke)="(#[0-9a-f]{6})"', figures))
    both = {"#1f2937", "#fdfdfd", "#e69f00", "#cc79a7", "#56b4e9"}
    assert drawn - both <= set(DARK)
    for colour in drawn & set(DARK):
        assert f'svg [fill="{colour}"]' in html


def test_figures_as_files(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "figures"
    page = build_report(run, tmp_path / "page.html", figures=folder)
    figures = page.read_text(encoding="utf-8").count("<figure")
    assert len(list(folder.glob("*.svg"))) == len(list(folder.glob("*.png"))) == figures
    with Image.open(folder / "success.png") as picture:
        assert picture.width > 1000
        assert picture.convert("RGB").getpixel((1, 1)) == (255, 255, 255)
    ElementTree.parse(folder / "map-where-the-logs-have-been.svg")


def test_a_clear_loss_to_the_planner_is_said(html: str) -> None:
    assert "Worse than the planner in wheel slip: 20% against 100%" in html
    assert "Worse than the planner in nominal" not in html


def test_headline_and_callout_tell_no_difference_of_few_episodes(run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(run, tmp_path / "run")
    file = copy / "eval" / "episodes.parquet"
    table = pq.read_table(file)
    slips = pa.compute.equal(table["condition"], "wheel_slip")
    late = pa.compute.greater(
        table["episode_seed"], pa.compute.min(table["episode_seed"]).as_py() + 3
    )
    pq.write_table(table.filter(pa.compute.invert(pa.compute.and_(slips, late))), file)
    html = build_report(copy).read_text(encoding="utf-8")
    assert re.fullmatch(
        r"No difference from the planner is shown in nominal \(.* points \[.*\]\);"
        r" too few episodes to tell a difference in wheel slip \(−\d+ points\)",
        heading(html),
    )
    assert "Worse than the planner" not in html


def test_headline_says_where_the_episodes_are_not_the_same(run: Path, tmp_path: Path) -> None:
    """As where the baseline drove more of them than the run's policy did."""
    copy = shutil.copytree(run, tmp_path / "run")
    file = copy / "eval" / "episodes.parquet"
    table = pq.read_table(file)
    (first, *_) = [r["episode_seed"] for r in table.to_pylist() if r["condition"] == "wheel_slip"]
    kept = [
        (row["policy"], row["condition"], row["episode_seed"]) != ("agent", "wheel_slip", first)
        for row in table.to_pylist()
    ]
    pq.write_table(table.filter(pa.array(kept)), file)
    assert re.fullmatch(
        r"No difference from the planner is shown in nominal \(.* points \[.*\]\);"
        r" not on the same episodes in wheel slip",
        headline(gather(copy)),
    )


def test_each_perturbation_has_a_table_and_the_clean_one_is_open(run: Path) -> None:
    facts = gather(run)
    facts.cells += [{**row, "perturbation": "friction"} for row in facts.cells]
    section = success(facts)
    assert section is not None
    clean, friction = section.tables
    assert not clean.folded
    assert friction.folded
    assert friction.title.endswith("friction")
    for table in (clean, friction):
        assert len(table.rows) == 4
        assert [row["kind of episode"] for row in table.rows] == ["nominal", "", "wheel slip", ""]
        # What no episode tells has no column.
        assert not {"least distance to people", "time lost to the planner"} & set(table.columns)


def test_what_is_no_better_than_chance_is_no_success(run: Path) -> None:
    facts = gather(run)
    assert page(facts)["headline"].startswith("Worse than the planner")
    facts.cells += [
        {**row, "policy": "random", "success": 0.6} for row in facts.clean_cells("agent")
    ]
    assert page(facts)["headline"] == (
        "Nothing was learned: no better than a random policy on the same episodes"
        " (55% against 60%, mean over conditions)"
    )


def test_every_section_has_its_figures(html: str) -> None:
    for section, figures in (
        ("success", 1),
        ("fed", 3),
        ("practice", 1),
        ("actions", 1),
        ("capacity", 1),
        ("learning", 2),
        ("critic", 2),
        ("map", 2),
    ):
        part = html.split(f'<section id="{section}">')[1].split("</section>")[0]
        assert part.count("<figure") == figures, section


def rows_of(html: str, section: str) -> list[list[str]]:
    """Return the cells of the rows of a section's tables."""
    part = html.split(f'<section id="{section}">')[1].split("</section>")[0]
    lines = re.findall(r"<tr>(.*?)</tr>", part, re.DOTALL)
    cell = r"<td[^>]*>(?:<span>)?(.*?)(?:</span>)?</td>"  # a phone's list has a cell in a span
    return [re.findall(cell, line, re.DOTALL) for line in lines]


def test_an_action_that_is_wanted_and_not_in_the_logs_is_on_the_page(html: str) -> None:
    table = [row for row in rows_of(html, "actions") if row]
    assert {(row[0], row[2], row[3], row[4]) for row in table if "alert" in row[1]} == {
        ("nominal", "30%", "0.0%", "70%"),
        (escape(HOSTILE.replace("_", " ")), "30%", "0.0%", "70%"),
    }
    assert not any(row[1] == "drive 1" for row in table)  # wanted, and in half of the logs
    part = html.split('<section id="actions">')[1].split("</section>")[0]
    assert "&lt;1%" in part  # 2 of 1,000 fresh rows: seldom …
    assert ">0<" in part  # … is not never


def test_the_curve_of_capacity_is_on_the_page(html: str, run: Path) -> None:
    found = capacity_of_rows(Panel.open(Path(Run.open(run).document["panel"]["path"])).meta)
    part = html.split('<section id="capacity">')[1].split("</section>")[0]
    assert "The ring holds 4,096 rows" in part
    assert found.reason in part
    last = found.curve[-1]
    assert rows_of(html, "capacity")[-1][:3] == [
        f"{last['capacity']:,}",
        str(last["cells"]),
        "100%",
    ]


def test_estimates_from_logs_are_on_the_page_with_what_was_refused(html: str) -> None:
    part = html.split('<section id="learning">')[1].split("</section>")[0]
    assert "Off-policy evaluation on held-out logs" in part
    assert "0.50 [0.50, 0.50]" in part
    assert "refused: &lt;script&gt;" in part


@pytest.mark.long
def test_a_measured_gap_is_a_section(run: Path, tmp_path: Path) -> None:
    position = {"condition": "nominal", "horizon_s": 3.0, "quantity": "position", "unit": "m"}
    position |= {"source": "nominal", "segments": 40, "episodes": 9}
    position |= {f"{q}{end}": 0.5 for q in ("median", "p90") for end in ("", "_low", "_high")}
    far = ConfidenceInterval(0.5, 0.4, 0.6)
    gap = TwinGap(
        about={
            "limits": msgspec.structs.asdict(TrustLimits()),
            "store_version": 7,
            "twins": {"nominal": {}},
        },
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
    for words in (
        *("Do not trust the twin in: nominal.", "it is far off", "0.50 m [0.40, 0.60]"),
        *("nominal twin", "measured at version 7", "No &lt;script&gt;alert(1)&lt;/script&gt; was"),
    ):
        assert words in part, words
    assert part.count("<figure") == 1
    (copy / "gap" / "gap.json").write_text("{}")
    page = build_report(copy).read_text(encoding="utf-8")
    assert '<section id="twin-gap">' not in page
    assert "contains no readable gap" in page


def test_drawn_shares_are_over_the_whole_run(run: Path) -> None:
    fed = {(r["source"], r["stratum"]): r for r in gather(run).sampled}
    assert fed["logs", "nominal"]["drawn_rows"] == 180
    assert fed["logs", "nominal"]["drawn_share"] == pytest.approx(0.9)
    assert fed["fresh", HOSTILE]["drawn_share"] == pytest.approx(0.1)


def test_shares_after_weights_count_intervals_by_what_was_drawn_in_them(tmp_path: Path) -> None:
    made = Run.create(tmp_path / "run", {"config": {}})
    made.append("progress", [filled("progress", phase="online")])
    made.append(
        "strata",
        [
            # A stratum that only the first, small interval held.
            filled("strata", gradient_steps=1, stratum="a", drawn_rows=50, effective_share=0.5),
            filled("strata", gradient_steps=1, stratum="b", drawn_rows=50, effective_share=0.5),
            filled("strata", gradient_steps=2, stratum="a", drawn_rows=900, effective_share=1.0),
        ],
    )
    made.flush()
    fed = {row["stratum"]: row["effective_share"] for row in gather(made.path).sampled}
    assert fed == pytest.approx({"a": 0.95, "b": 0.05})


def test_the_kept_evaluation_is_the_best_and_not_the_last(run: Path) -> None:
    kept = gather(run).policy
    assert kept is not None
    assert (kept.chosen, kept.env_steps, kept.gradient_steps) == ("best", 2000, 500)


def test_the_evaluation_bias_is_named(run: Path) -> None:
    facts = gather(run)
    facts.logged = [
        {"condition": "nominal", "share": 0.1, "episodes": 1},
        {"condition": "wheel_slip", "share": 0.9, "episodes": 9},
    ]
    # Half of the evaluation is nominal, which is easier, but a tenth of what was logged.
    assert "success would be 27% instead of 55%" in evaluation_bias(facts)
    assert "largest bias comes from nominal" in evaluation_bias(facts)


def test_a_young_run_without_evaluation_still_has_a_page(tmp_path: Path) -> None:
    made = Run.create(tmp_path / "run", {"config": {"target": {"rule": "polyak", "tau": 0.005}}})
    made.append("progress", [filled("progress", phase="offline")])
    made.flush()
    html = build_report(made.path).read_text(encoding="utf-8")
    assert "trained, not yet evaluated" in html
    assert "had no panel" in html


def _on_floors(run: Path, path: Path, layouts: str, ended_on: str) -> str:
    """Return the page of the run as if it had driven on other floors and ended on `ended_on`."""
    shutil.copytree(run, path)
    document = json.loads((path / "config.json").read_text())
    document["config"]["env"] = {"layouts": layouts}
    (path / "config.json").write_text(json.dumps(document))
    file = path / "eval" / "episodes.parquet"
    table = pq.read_table(file)
    column = pa.array([ended_on] * len(table))
    pq.write_table(table.set_column(table.column_names.index("layout"), "layout", column), file)
    return build_report(path).read_text(encoding="utf-8")


@pytest.mark.long
def test_the_floor_that_is_drawn_is_the_runs_own(run: Path, tmp_path: Path) -> None:
    hall = tmp_path / "hall.toml"
    hall.write_text("width_m = 20.0\ndepth_m = 5.0\nracks = [[1.0, 2.0, 8.0, 3.0]]\n")
    page = _on_floors(run, tmp_path / "a", str(hall), "hall.toml")
    assert 'rect width="800" height="200"' in page
    assert "floor, hall.toml" in page
    assert "18 failed clean episodes there" in page
    page = _on_floors(run, tmp_path / "b", str(hall), "default")
    assert "0 failed clean episodes there" in page


def test_logs_in_another_frame_are_counted_and_not_drawn(run: Path, tmp_path: Path) -> None:
    (floor,) = open_floors("default")
    away = replace(floor, name="away", map_origin=(900.0, 0.0, 0.0))
    write_floor(away, tmp_path / "away.toml")
    page = _on_floors(run, tmp_path / "a", str(tmp_path / "away.toml"), "away")
    assert "0 logged steps in cells" in page
    assert re.search(r"Not drawn: what was logged in other frames, \d+ recording", page)


def test_what_was_logged_is_drawn_in_the_floors_frame(tmp_path: Path) -> None:
    table = with_clear_view(recording_transitions(1))
    store = write_store(tmp_path / "store", [table])
    origin = (1.5, -2.0, 0.7)
    x_m, y_m, yaw_rad = origin
    recordings = [table["recording_id"][0].as_py(), "none"]
    query = statements("restock.report.run", "store.sql")["visited"]
    with Store(store) as opened:
        cells = ask(
            opened.connection, query, cell_m=1e-3, recordings=recordings,
            x_m=x_m, y_m=y_m, yaw_rad=yaw_rad,
        )  # fmt: skip
    poses = np.column_stack([table[name].to_numpy() for name in ("pose_x_m", "pose_y_m")])
    expected = into_frame(poses[np.isfinite(poses).all(axis=1)], origin)
    assert sum(row["rows"] for row in cells) == len(expected)
    found = np.array([(row["x_m"], row["y_m"]) for row in cells for _ in range(row["rows"])])
    for axis in (0, 1):
        np.testing.assert_allclose(np.sort(found[:, axis]), np.sort(expected[:, axis]), atol=2e-3)


@pytest.mark.parametrize(
    ("layouts", "said"),
    [
        ("generated:train:3", "drives on 3 floors"),
        ("gone.toml", "gone.toml: cannot be read"),
    ],
)
def test_a_floor_that_is_not_drawn_is_said(
    run: Path, tmp_path: Path, layouts: str, said: str
) -> None:
    page = _on_floors(run, tmp_path / "a", layouts, "default")
    assert said in page
    assert "Where did it happen?" not in page


def test_a_run_without_an_update_is_refused(tmp_path: Path) -> None:
    Run.create(tmp_path / "run", {"config": {}})
    with pytest.raises(RunError, match="no update to report on"):
        build_report(tmp_path / "run")


def test_the_verb_prints_where_the_page_is(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep" / "page.html"
    assert cli.main(["report", str(run), "--out", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said == {"report": str(out), "bytes": out.stat().st_size}


def test_no_file_of_a_command_is_written_into_a_store_nor_into_another_run(
    run: Path, store_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "run"
    shutil.copytree(run, own)
    before = sorted([*store_path.rglob("*"), *run.rglob("*")])
    store = str(store_path)
    for words, place in (
        (["report", str(own), "--out", str(run / "page.html")], f"the run {run}"),
        (["report", str(own), "--figures", str(store_path / "figures")], f"the store {store}"),
        (["coverage", store, "--out", str(store_path / "page.html")], f"the store {store}"),
        (["audit", store, "--junit", str(store_path / "x.xml")], f"the store {store}"),
        (["profile", "schema", "--out", store], f"the store {store}"),
        (["profile", "new", "a.mcap", "--out", f"{store}/p.toml"], f"the store {store}"),
        (
            ["store", "label", store, "--review", "3", "--out", f"{store}/l.csv"],
            f"the store {store}",
        ),
        (["sql", store, "--export", f"{store}/views.sql"], f"the store {store}"),
        (["coverage", "gaps", store, "--missions-out", f"{store}/m.toml"], f"the store {store}"),
        (["twin", "layout", "--png", f"{run}/floor.png"], f"the run {run}"),
        (["twin", "fit", store, "--out", f"{store}/fitted.toml"], f"the store {store}"),
    ):
        assert cli.main(words) == 2
        assert f"is within {place}:" in " ".join(capsys.readouterr().err.split())
    assert sorted([*store_path.rglob("*"), *run.rglob("*")]) == before
    assert cli.main(["report", str(own), "--out", str(own / "pages" / "page.html")]) == 0


def test_what_is_no_run_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for place, said in (
        (tmp_path / "nothing", "no such run"),
        (tmp_path, "is not a run directory"),
    ):
        assert cli.main(["report", str(place)]) == 2
        assert f"{place}: {said}" in "".join(capsys.readouterr().err.splitlines())


def test_shares_stand_side_by_side_and_what_is_short_or_lost_by_weights_is_said(run: Path) -> None:
    facts = gather(run)
    kinds = {row["kind"] for row in fed.share_bars(facts)}
    assert kinds == {"natural", "wanted", "drawn"}
    short, lost = fed.remarks(facts)
    assert "was short by 40.0% of the rows fed, of 50.0% wanted: too few rows of" in short
    assert "nominal (86.27% of the rows, 90.00% of the draws, 50.00% of the gradient)" in lost
    facts.sampled = [row | {"effective_share": row["drawn_share"]} for row in facts.sampled]
    assert fed.remarks(facts) == [short]
    figure = fed.shares_figure(facts)
    assert figure is not None
    assert "wanted" in figure.widest
    assert [row["drawn"] for row in fed.fed_table(facts).rows] == ["90%", "10%"]
