"""Exposures: situations beside the conditions, which take no row's condition from them."""

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support.driven_robot import Drive, write_bag
from support.profile_texts import WAREHOUSE as TEXT
from support.step_tables import changed, steps

from restock.cli import main
from restock.ingest.profile.profile import load_profile, parse_profile, profile_toml
from restock.ingest.task.conditions import Condition, label, labels_version, primary, shipped
from restock.replay.store.store import Store

SHIPPED = list(shipped().values())
LISTED = 'exposures = ["closing_traffic", "plan_blocked", "slippery_floor"]'
assert LISTED in TEXT
OWN = """
[[condition]]
name = "far_out"
kind = "exposure"
timing = "pre"
sql = "pose_x_m > 2"
"""


def exposed(table: pa.Table, name: str) -> list[int]:
    return np.flatnonzero(label(table, [shipped(kind="exposure")[name]])[name]).tolist()


def test_each_situation_is_told_by_what_is_known_before_acting():
    assert exposed(steps(20), "closing_traffic") == []
    someone = steps(20, came_nearer_m=changed(0.1, 0.0, 20, slice(8, 10)))
    assert exposed(someone, "closing_traffic") == [9, 10, 11, *range(12, 17)]
    noise = steps(20, came_nearer_m=np.full(20, 0.03))
    assert exposed(noise, "closing_traffic") == []
    pallet = {"plan_return_m": changed(1.5, 4.0, 20, slice(5, 15))}
    assert exposed(steps(20, **pallet), "plan_blocked") == list(range(9, 15))
    walker = {"came_nearer_m": changed(0.15, 0.0, 20, slice(3, 5))}
    assert exposed(steps(20, **pallet, **walker), "plan_blocked") == []
    ice = steps(20, wheel_speed_mps=changed(1.0, 0.5, 20, slice(10, 12)))
    assert exposed(ice, "slippery_floor") == list(range(11, 17))
    assert exposed(steps(20), "slippery_floor") == []


def test_an_exposure_takes_no_row_from_a_condition():
    first = Condition("busy", "pre", "true", priority=0, kind="exposure")
    every = [*SHIPPED, first]
    table = steps(20, clearance_m=changed(0.05, 2.0, 20, slice(8, 10)))
    labels = label(table, every)
    assert labels["busy"].all()
    named = primary(labels, every)
    assert named == primary({name: labels[name] for name in labels if name != "busy"}, SHIPPED)
    assert {"nominal", "near_collision"} <= set(named)
    assert labels_version(every) != labels_version(SHIPPED)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of one drive, beside the profile `amr.toml` of its rows."""
    folder = tmp_path_factory.mktemp("exposures")
    bag, profile = write_bag(Drive(goals=[(0.0, 3.0, 1.0)]), folder / "a"), folder / "amr.toml"
    profile.write_text(TEXT.replace(LISTED, 'exposures = ["closing_traffic"]') + OWN)
    command = ["ingest", str(bag), "--profile", str(profile), "--store", str(folder / "store")]
    assert main(command) == 0
    return folder / "store"


@pytest.fixture
def profile(store: Path) -> Path:
    return store.parent / "amr.toml"


def test_a_store_lists_exposures_beside_its_conditions(store, profile):
    with Store(store) as opened:
        assert [one.name for one in opened.exposures()] == ["closing_traffic", "far_out"]
        assert "far_out" not in {one.name for one in opened.conditions()}
        held = opened.sql(
            "SELECT DISTINCT pose_x_m > 2, exposures, primary_condition FROM transitions"
            " ORDER BY ALL"
        ).fetchall()
        assert held == [(False, [], "nominal"), (True, ["far_out"], "nominal")]
        rows = {row[0]: row[1:] for row in opened.sql(
            "SELECT exposure, rows, episodes, episode_share, success_share"
                " FROM coverage_by_exposure"
        ).fetchall()}  # fmt: skip
        (count,) = opened.sql("SELECT count(*) FROM transitions WHERE pose_x_m > 2").fetchall()[0]
        assert rows == {"closing_traffic": (0, 0, 0.0, None), "far_out": (count, 1, 1.0, 1.0)}
        shelves = opened.sql("SELECT condition FROM coverage_by_condition").fetchall()
        assert not {"far_out", "closing_traffic"} & {name for (name,) in shelves}
        carried = opened.sql("SELECT profile_toml FROM recordings").fetchall()[0][0]
    assert parse_profile(carried, where="").exposures == load_profile(profile).exposures
    again = parse_profile(profile_toml(load_profile(profile)), where="")
    assert again.labels_version == load_profile(profile).labels_version


def test_changed_exposures_are_told_again_from_the_store(store, profile, tmp_path):
    store, text = shutil.copytree(store, tmp_path / "store"), profile.read_text()
    profile = tmp_path / "amr.toml"
    profile.write_text(text.replace("pose_x_m > 2", "pose_x_m > 2.2"))
    assert main(["store", "label", str(store), "--profile", str(profile)]) == 0
    with Store(store) as opened:
        assert opened.sql(
            "SELECT min(pose_x_m) > 2.2, any_value(primary_condition) FROM transitions"
            " WHERE len(exposures) > 0"
        ).fetchall() == [(True, "nominal")]
        assert "2.2" in opened.exposures()[-1].sql
