"""`restock coverage gaps`: missing rows, the missions that fill them, and confidence."""

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.stores import recording_transitions, write_store

from restock.cli import main
from restock.errors import ConfigError
from restock.ingest.store.transitions import replaced
from restock.replay.fleet.forecast import forecast, missions_to_see_one, probability_to_close
from restock.replay.fleet.gaps import Gap, Yields, find_gaps
from restock.replay.fleet.missions_file import MissionOrder, MissionsFile, as_toml, read_missions
from restock.replay.fleet.shopping_list import shopping_list
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.places import add_computed_tables
from restock.replay.store.store import Store

KINDS = ("nominal", "wheel_slip", "blocked_aisle")


def simulated(rows: pa.Table) -> pa.Table:
    """Return the rows with their labels as true conditions."""
    return replaced(rows, {"true_condition": rows["condition"].to_pylist()})


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    rows = [simulated(recording_transitions(number)) for number in range(3)]
    return write_store(tmp_path_factory.mktemp("gaps") / "store", rows)


ASKING = """
max_replays_per_row = 2
planned_draws = 1000
evaluation_split = { by = "none" }
[[strata]]
name = "nominal"
share = 0.5
[[strata]]
name = "wheel_slip"
share = 0.4
[each_condition]
share = "natural"
"""


def test_stratum_lacks_rows_for_its_share(store):
    with Store(store) as opened:
        yields, gaps = find_gaps(opened, parse_mixture(ASKING), name="mine", kinds=KINDS)
        slips = opened.sql(
            "SELECT count(*) FROM transitions WHERE primary_condition = 'wheel_slip'"
        )
        there = slips.fetchall()[0][0]
    (gap,) = gaps
    # Half of each batch is logged: 0.4 of 1000 x 0.5 draws, at most two per row.
    assert (gap.cell, gap.needed, gap.there) == ({"stratum": "wheel_slip"}, 100, there)
    assert gap.found.sum() == there
    assert set(gap.thinnest) <= {"aisle_1", "aisle_2", "cross"}
    found = shopping_list(yields, gaps)
    assert found.unit == "missions"
    (order,) = found.orders
    (filled,) = found.gaps
    assert order.supply == filled.best
    assert filled.forecast is not None
    assert filled.forecast.quantile(0.025) <= order.amount <= filled.forecast.quantile(0.975)
    assert filled.closes_with is not None
    assert 0.7 < filled.closes_with < 0.9  # 0.8 was requested


def test_audits_and_cells_report_gaps(store):
    mixture = parse_mixture(ASKING.replace("1000", "10"))
    limits = {
        "rare_condition": {"min_rows": 60, "min_episodes": 5},
        "missing_cells": {"min_rows": 1},
    }
    with Store(store) as opened:
        yields, gaps = find_gaps(
            opened, mixture, name="mine", kinds=KINDS, thresholds=limits, min_rows=1
        )
        rare = dict(
            opened.sql(
                "SELECT condition, rows_held FROM coverage_by_condition WHERE rows_held < 60"
            ).fetchall()
        )
    requested = {
        gap.cell["condition"]: gap.there for gap in gaps if gap.asked_by.endswith("condition")
    }
    assert requested == rare
    found = shopping_list(yields, gaps)
    for one in found.gaps:
        assert (one.best is None) == (one.gap.found.sum() == 0)
        if one.best is None:
            assert one.see_one is not None
            assert one.see_one[1] >= 1


@pytest.mark.parametrize(
    ("given", "near"),
    [
        ({"kinds": ["wheel_slips"]}, "'wheel_slip'"),
        ({"thresholds": {"rare_conditions": {"min_rows": 3}}}, "'rare_condition'"),
        ({"thresholds": {"rare_condition": {"min_row": 3}}}, "'min_rows'"),
        ({"thresholds": {"rare_condition": {"min_rows": "x"}}}, "rare_condition.min_rows"),
    ],
)
def test_unknown_names_suggest_nearest(given, near, store):
    own = {"my_own_audit": {"least": 3.0}}  # `restock audit --audits` reads the same file
    given["thresholds"] = own | given.get("thresholds", {})
    with Store(store) as opened, pytest.raises(ConfigError, match=near):
        find_gaps(opened, parse_mixture(ASKING), name="mine", **given)


def test_condition_without_primary_rows_has_no_audit_gap(tmp_path):
    rows = recording_transitions(0)
    rarer = {"wheel_slip": "blocked_aisle"}
    named = [rarer.get(name, name) for name in rows["condition"].to_pylist()]
    rows = replaced(rows, {"condition": named})
    with Store(write_store(tmp_path / "store", [rows])) as store:
        mixture, limits = (
            parse_mixture(ASKING),
            {"few_effective_episodes": {"min_effective_episodes": 5}},
        )
        _, gaps = find_gaps(store, mixture, name="mine", kinds=KINDS, thresholds=limits)
        query = "SELECT primary_rows, rows_held FROM coverage_by_condition"
        ((names, holds),) = store.sql(f"{query} WHERE condition = 'wheel_slip'").fetchall()
    assert names == 0 < holds
    by = {gap.asked_by for gap in gaps if "wheel_slip" in gap.cell.values()}
    assert by == {"mixture mine"}  # its stratum is empty


def test_gap_names_its_action(tmp_path, shell):
    rows = recording_transitions(1)
    turned = [
        "wheel_slip" in held and action == 3
        for held, action in zip(
            rows["conditions"].to_pylist(), rows["action"].to_pylist(), strict=True
        )
    ]
    path = write_store(tmp_path / "store", [rows.filter(pa.array([not one for one in turned]))])
    gaps = shell.json("coverage", "gaps", path)["gaps"]
    cells = [one for one in gaps if one["asked_by"] == "audit missing_cells"]
    (gap,) = [one for one in cells if (one["condition"], one["action"]) == ("wheel_slip", 3)]
    assert (gap["action_name"], gap["cell"]) == ("turn left 1.2", "wheel_slip, turn left 1.2")
    assert main(["coverage", str(path), "--out", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text("utf-8")
    assert "turn left 1.2" in page
    assert not re.search(r"action \d", page)


def test_gaps_without_true_conditions_are_in_hours(tmp_path):
    path = write_store(tmp_path / "store", [recording_transitions(1), recording_transitions(2)])
    with Store(path) as opened:
        yields, gaps = find_gaps(opened, parse_mixture(ASKING), name="mine", kinds=KINDS)
    found = shopping_list(yields, gaps)
    assert found.unit == "hours"
    (order,) = found.orders
    assert order.supply.kind is None
    assert order.amount == order.hours
    rate = gaps[0].there / yields.hours.sum()
    assert found.gaps[0].forecast is not None
    assert found.gaps[0].forecast.rate == pytest.approx(rate)


EQUAL = "[each_condition]\nshare = 'equal'\n"


@pytest.mark.parametrize(
    "text",
    [
        EQUAL,
        f"where = \"recording_id = '{1:016x}'\"\n{EQUAL}",
        f"evaluation_split = {{ by = 'time' }}\n{EQUAL}",
        "each_condition = { unit = 'episode', share = 'equal' }\n",
    ],
)
def test_mix_and_gaps_report_same_rows(text, tmp_path, shell):
    store = str(write_store(tmp_path / "store", [recording_transitions(n) for n in (1, 2, 3)]))
    (tmp_path / "mine.toml").write_text(f"max_replays_per_row = 40\nshortfall = 'shrink'\n{text}")
    chosen = (store, "--mixture", str(tmp_path / "mine.toml"))
    in_gaps = ["coverage", "gaps", *chosen, "--unit", "hours", "--thresholds", "none"]
    mixed = shell.json("mix", *chosen, "--dry-run")["strata"]
    gaps = {gap["stratum"]: gap for gap in shell.json(*in_gaps)["gaps"]}
    short = [line for line in mixed if line["missing_rows"]]
    assert short
    assert {line["stratum"] for line in short} == set(gaps)
    for line in short:
        gap = gaps[line["stratum"]]
        assert (line["rows"], line["missing_rows"]) == (gap["there"], gap["missing"])
        assert gap["amount_low"] <= gap["amount"] <= gap["amount_high"]
        assert gap["rate_low"] <= gap["missing"] / gap["amount"] <= gap["rate_high"]


def test_plan_is_smallest_that_fills_every_gap():
    """One kind of mission fills both gaps slowly, two kinds fill one gap each quickly."""
    kinds = ["a"] * 30 + ["b"] * 30 + ["both"] * 30
    yields = Yields([str(i) for i in range(90)], np.ones(90) / 60, kinds, True, pa.table({}))
    found = {
        name: np.array(
            [amount if kind == name else few * (kind == "both") for kind in kinds], float
        )
        for name, amount, few in (("a", 10, 6), ("b", 10, 6))
    }
    gaps = [Gap("test", {"stratum": n}, "rows", 120, 0, found[n]) for n in ("a", "b")]
    listed = shopping_list(yields, gaps)
    assert [order.supply.kind for order in listed.orders] == ["both"]
    assert 20 <= listed.total <= 24  # 120 / 6, and a little for chance
    # Without the shared kind, both single kinds are ordered.
    alone = [kind for kind in kinds if kind != "both"]
    apart = Yields([str(i) for i in range(60)], np.ones(60) / 60, alone, True, pa.table({}))
    gaps = [Gap("test", {"stratum": n}, "rows", 120, 0, found[n][:60]) for n in ("a", "b")]
    orders = shopping_list(apart, gaps).orders
    assert sorted(order.supply.kind or "" for order in orders) == ["a", "b"]


@pytest.mark.parametrize("share", [0.2, 0.8])
def test_forecast_quantiles_are_calibrated(share):
    """Compare the missions needed with the forecast's quantile, over simulated fleets."""
    rng, held = np.random.default_rng(3), 0
    for _ in range(120):

        def missions(count: int) -> np.ndarray:
            return rng.negative_binomial(2, 0.2, count) * (rng.random(count) < 0.7)

        past = missions(40).astype(float)
        enough = forecast(past, np.ones(40), 150, rng=rng, replicates=80).quantile(share)
        needed = int(np.searchsorted(np.cumsum(missions(400)), 150)) + 1
        held += needed <= enough
    assert abs(held / 120 - share) < 0.15


@settings(max_examples=40)
@given(
    st.lists(st.integers(0, 30), min_size=2, max_size=40).filter(any),
    st.integers(1, 5_000),
    st.integers(0, 2**32 - 1),
)
def test_forecast_grows_with_missing_rows(found, missing, seed):
    yields = np.array(found, float)

    def needed(amount: float) -> float:
        rng = np.random.default_rng(seed)
        return forecast(yields, np.ones(len(found)), amount, rng=rng, replicates=40).quantile(0.5)

    assert needed(missing) >= missing / max(found) - 1e-9 or missing / yields.mean() > 2000
    assert needed(missing) <= needed(100 * missing)


def test_forecast_of_rare_and_of_unseen_conditions():
    rng = np.random.default_rng(0)
    once = forecast(np.array([3.0] + [0.0] * 49), np.ones(50), 30, rng=rng)
    assert once.quantile(0.975) / once.quantile(0.5) > 3
    assert not forecast(np.zeros(50), np.ones(50), 30, rng=rng).known
    # (1 - rate)^n = 0.05 gives the highest likely rate: 0.632 after n = 3 missions without.
    assert missions_to_see_one(3) == 3  # 1 - .368^3 = .95
    assert missions_to_see_one(100) == 100
    assert missions_to_see_one(1) == 1
    always = probability_to_close([(np.ones(50) * 2, 30)], 30, rng=rng)
    assert always > 0.99
    assert probability_to_close([(np.zeros(50), 30)], 30, rng=rng) == 0


def test_missions_file_round_trip(store, tmp_path, shell):
    (tmp_path / "mine.toml").write_text(ASKING)
    args = ["coverage", "gaps", store, "--mixture", tmp_path / "mine.toml"]
    out = tmp_path / "next.toml"
    plan = shell.json(*args, "--missions-out", out)["plan"]
    read = read_missions(out)
    assert [order.missions for order in read.missions] == [o["missions"] for o in plan["orders"]]
    assert read.store.endswith("store@2")
    none = ["coverage", "gaps", str(store), "--thresholds", "none", "--mixture", "uniform"]
    for words, problem in (
        ([*args, "--missions-out", str(out)], "already there"),
        ([*none, "--missions-out", str(tmp_path / "none.toml")], "there are no gaps"),
    ):
        assert problem in shell.err(*words)
    assert not (tmp_path / "none.toml").exists()


def test_invalid_missions_files_are_refused(tmp_path):
    whole = MissionsFile(missions=(MissionOrder(kind="wheel_slip", missions=3, zone='"x"'),))
    (tmp_path / "good.toml").write_text(as_toml(whole))
    assert read_missions(tmp_path / "good.toml") == whole
    assert "`restock twin record --missions` drives it" in as_toml(whole)
    assert "restock twin record" not in as_toml(MissionsFile(missions=(MissionOrder(hours=8.8),)))
    for text, message in (
        ("[[missions]]\nkind = 'x'\n", "must be given"),
        ("[[missions]]\nkind = 'x'\nmissions = 0\n", "missions"),
        ("[[missions]]\nmission = 3\n", "unknown key"),
        ("missions = []\n", "contains no missions"),
        ("format = 'other/9'\n[[missions]]\nmissions = 1\n", "other/9"),
    ):
        (tmp_path / "bad.toml").write_text(text)
        with pytest.raises(ConfigError, match=message):
            read_missions(tmp_path / "bad.toml")


def test_gaps_can_be_queried_in_sql(store, tmp_path):
    (tmp_path / "mine.toml").write_text(ASKING)
    with Store(store) as opened:
        add_computed_tables(opened)
        query = f"FROM gaps('{tmp_path / 'mine.toml'}') WHERE asked_by LIKE 'mixture%'"
        rows = opened.sql(query).to_arrow_table().to_pylist()
        none = opened.sql("FROM gaps('uniform') WHERE asked_by LIKE 'mixture%'").fetchall()
    (row,) = rows
    assert (row["stratum"], row["needed"], row["unit"]) == ("wheel_slip", 100, "missions")
    assert row["missing"] == 100 - row["there"]
    assert row["amount_low"] <= row["amount"] <= row["amount_high"]
    assert none == []
