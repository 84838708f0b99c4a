"""Mixtures of a fleet: quotas by robot, and whole robots held out."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support.panels import EVERY, NO_SPLIT, panel_of, planned
from support.stores import recording_transitions, write_store

from restock.errors import ConfigError, MixtureError
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.panel import Panel
from restock.replay.places import open_place
from restock.replay.store.audit import run_audits, shipped_audits

TAGS = [{"robot": robot, "site": site} for robot, site in zip("abacd", "ooool", strict=True)]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory) -> Path:
    """Return a store of five recordings of four robots, one of them at another site."""
    tables = [recording_transitions(number) for number in range(1, 6)]
    return write_store(tmp_path_factory.mktemp("fleet") / "store", tables, tags=TAGS)


def query_panel(panel: Panel, query: str) -> list[tuple[object, ...]]:
    with open_place(panel.path) as connection:
        return connection.sql(query).fetchall()


@pytest.mark.parametrize("by", ["robot", "site"])
def test_whole_robots_and_sites_are_held_out(fleet, by):
    held_by_seed = set()
    for seed in range(3):
        plan = planned(fleet, f"seed = {seed}\n[evaluation_split]\nby = '{by}'\n" + EVERY)
        names = np.array(plan.rows[by].to_pylist())
        held, kept = set(names[plan.evaluation_split]), set(names[plan.panel_rows])
        assert held
        assert kept
        assert not held & kept
        assert held | kept == {tags[by] for tags in TAGS}
        held_by_seed |= held
    assert len(held_by_seed) > 1


def test_robots_are_held_out_by_name(fleet):
    text = "[evaluation_split]\nby = 'robot'\nrobots = ['c', 'd']\nshare = 0\n" + EVERY
    plan = planned(fleet, text)
    robots = np.array(plan.rows["robot"].to_pylist())
    assert set(robots[plan.evaluation_split]) == {"c", "d"}
    assert set(robots[plan.panel_rows]) == {"a", "b"}


@pytest.mark.parametrize(
    ("robots", "message"),
    [("['c', 'amr-99']", "admits no rows of amr-99"), ("['a','b','c','d']", "every")],
)
def test_invalid_held_out_robots_are_refused(fleet, robots, message):
    text = f"[evaluation_split]\nby = 'robot'\nrobots = {robots}\n" + EVERY
    with pytest.raises(MixtureError, match=message) as caught:
        planned(fleet, text)
    assert caught.value.remedy
    with pytest.raises(ConfigError, match='needs by = "robot"'):
        parse_mixture(text.replace("'robot'", "'site'"))


def test_rows_of_held_out_robot_are_leak(fleet, tmp_path):
    text = "[evaluation_split]\nby = 'robot'\n" + EVERY
    panel = panel_of(fleet, text, tmp_path / "panel")
    chosen = [audit for audit in shipped_audits() if audit.name == "leakage"]
    with open_place(fleet, beside={"panel": panel.path}) as connection:
        (finding,) = run_audits(connection, chosen, {}, beside={"panel"})
        assert finding.status == "pass"
        connection.execute(
            "CREATE OR REPLACE VIEW panel.evaluation_split AS"
            " SELECT * REPLACE ('x' AS episode_id), 'robot' AS split_by FROM panel.rows LIMIT 1"
        )
        (finding,) = run_audits(connection, chosen, {}, beside={"panel"})
    assert "a robot that is held out" in {row["leak"] for row in finding.sample}


@pytest.mark.parametrize("by", ["episode", "recording", "time", "within_episode"])
def test_only_admitted_episodes_are_held_out(fleet, by):
    # Regression: all held-out rows were of the latest recording, which is another robot's.
    text = f"where = \"robot = 'a'\"\n[evaluation_split]\nby = '{by}'\n" + EVERY
    plan = planned(fleet, text)
    robots = np.array(plan.rows["robot"].to_pylist())
    assert set(robots[plan.evaluation_split]) == set(robots[plan.panel_rows]) == {"a"}
    if by != "recording":  # one of two recordings is half
        assert plan.evaluation_split.sum() == pytest.approx(0.1 * (robots == "a").sum(), rel=0.5)


def test_split_by_robot_needs_known_robots(tmp_path):
    tables = [recording_transitions(number) for number in (1, 2, 3)]
    store = write_store(tmp_path / "store", tables, tags=[{}, {"robot": "a"}, {"robot": "b"}])
    text = "[evaluation_split]\nby = 'robot'\n" + EVERY
    message = f"{len(tables[0]):,} rows of 1 recording have no robot: they could belong to one that"
    with pytest.raises(MixtureError, match=message) as refused:
        panel_of(store, text, tmp_path / "panel")
    assert 'where = "robot IS NOT NULL"' in str(refused.value.remedy)
    panel = panel_of(store, 'where = "robot IS NOT NULL"\n' + text, tmp_path / "panel")
    assert {name for (name,) in query_panel(panel, "SELECT robot FROM rows")} < {"a", "b"}
    with pytest.raises(MixtureError, match="have no robot"):  # a table without a store
        planned(tables[0], text)


def test_oversized_evaluation_split_warns(tmp_path):
    two = pa.concat_tables([recording_transitions(1), recording_transitions(2)])
    text = EVERY + "[evaluation_split]\nby = 'recording'\nshare = 0.1"
    plan = planned(two, text)
    (warning,) = plan.warnings
    assert panel_of(two, text, tmp_path / "panel").warnings == [warning]
    assert Panel.open(tmp_path / "panel").warnings == [warning]
    assert f"holds out {plan.evaluation_split.mean():.0%} of the rows instead of 10%" in warning
    assert "1 of 2 recordings, whole" in warning
    assert not planned(two, EVERY + "[evaluation_split]\nby = 'recording'\nshare = 0.4").warnings


def test_mixture_combines_fleets_of_two_stores(fleet, tmp_path):
    other = write_store(tmp_path / "other", [recording_transitions(9)], tags=[{"robot": "z"}])
    text = f"[sources]\nlogs = 0.5\n[[sources.stores]]\nname = 'z'\npath = '{other}'\nshare = 0.3\n"
    panel = panel_of(fleet, text + NO_SPLIT + EVERY, tmp_path / "panel")
    robots = {name for (name,) in query_panel(panel, "SELECT DISTINCT robot FROM rows")}
    assert robots == {"a", "b", "c", "d", "z"}
