"""Missions from the places robots really went: the goals that rows tell, and the floor's room."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.kept_run import TASK, kept_run
from support.panels import panel_of
from support.stores import recording_transitions, with_clear_view, write_store

from restock.arrays import F64
from restock.cli import main
from restock.errors import ConfigError
from restock.ingest.store.transitions import replaced
from restock.replay.panel.panel import Panel
from restock.train.evaluation.logged_ways import AGREE_M, goal_of, logged_missions
from restock.train.run.kept_evaluations import read_evaluations
from restock.train.twin.floors.floor_files import write_floor
from restock.train.twin.floors.floors import open_floors

MIXTURE = "[each_condition]\nshare = 'natural'\n[evaluation_split]\nshare = 0.4\n"
(FLOOR,) = open_floors("default")
STARTS = FLOOR.goals[[0, 5, 11, 17]]


def rows_toward(goal: F64, places: F64) -> F64:
    """Return what the signals say of a drive (N, 2) that looks at its goal."""
    offset = goal - places
    distance = np.hypot(*offset.T)
    yaw = np.arctan2(offset[:, 1], offset[:, 0])
    far = np.stack([np.minimum(distance, TASK.far_m), np.zeros(len(places))], axis=-1)
    return np.column_stack([places, yaw, far, distance, distance])


@given(
    goal=st.tuples(st.floats(-20, 20), st.floats(-20, 20)),
    bearing=st.floats(-3.1, 3.1),
    nearest=st.floats(0.1, 6.0),
)
def test_a_goal_is_told_by_the_last_look_or_by_distances(goal, bearing, nearest):
    at, ahead = np.array(goal), np.array([np.cos(bearing), np.sin(bearing)])
    along = np.linspace(12.0, nearest, 40)[:, None]
    curved = at - along * ahead + 0.8 * np.sin(along) * np.array([-ahead[1], ahead[0]])
    found = goal_of(rows_toward(at, curved), TASK.far_m)
    assert found is not None
    assert np.hypot(*(found - at)) < 0.01
    # A drive along a line that ends far from its goal might as well have gone to the mirrored one.
    straight = rows_toward(at, at - (along + 3.0) * ahead)
    assert goal_of(straight, TASK.far_m) is None
    # Where the plan ends elsewhere than at the goal, its end is not taken for the goal.
    curved_rows = rows_toward(at, curved)
    curved_rows[:, 3] *= 0.5
    again = goal_of(curved_rows, TASK.far_m)
    assert again is None or np.hypot(*(again - at)) < AGREE_M


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Panel:
    """Return a panel of three recordings: on the floor, elsewhere, and in another frame."""
    folder = tmp_path_factory.mktemp("ways")
    tables = []
    for recording, away_m, between_m in ((1, 0.0, 0.0), (2, 300.0, 0.0), (3, 0.0, 50.0)):
        table = with_clear_view(recording_transitions(recording, task=TASK), TASK)
        values = {name: table[name].to_numpy() for name in ("episode_index", "step_index")}
        columns = np.zeros((len(table), 7))
        for episode in np.unique(values["episode_index"]):
            own = np.flatnonzero(values["episode_index"] == episode)
            start, goal = STARTS[episode % 4], STARTS[(episode + 1) % 4]
            share = np.linspace(0.0, 0.95, len(own))[:, None]
            places = start + share * (goal - start) + away_m
            places[1:-1] += between_m
            columns[own] = rows_toward(goal + away_m, places)
        names = ("pose_x_m", "pose_y_m", "pose_yaw_rad", "waypoint_far_x_m", "waypoint_far_y_m")
        names += ("route_remaining_m", "goal_distance_m")
        tables.append(replaced(table, dict(zip(names, columns.T, strict=True))))
    return panel_of(write_store(folder / "store", tables, task=TASK), MIXTURE, folder / "panel")


def test_held_out_ways_are_missions_and_others_are_counted(panel: Panel) -> None:
    made = logged_missions(panel, (FLOOR,), ("nominal", "wheel_slip"), every=True)
    assert made.logged == 36
    assert made.ways == 12
    assert sum(made.left_out.values()) == 24
    assert "24 not: its recording is in another frame than the floor" in made.text
    for spec in made.specs["nominal"]:
        assert spec.way is not None
        ends = np.array(spec.way)
        assert np.hypot(*(STARTS - ends[:2]).T).min() < 0.01
        assert np.hypot(*(STARTS - ends[3:]).T).min() < 0.01
    held_out = logged_missions(panel, (FLOOR,), ("nominal",))
    assert "that the panel holds out" in held_out.text
    assert 0 < held_out.logged < 36


def test_routes_in_another_frame_than_the_floor_are_refused(panel: Panel) -> None:
    away = replace(FLOOR, map_origin=(900.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match="in another frame than the floor") as refused:
        logged_missions(panel, (away,), ("nominal",))
    assert "0 of " in refused.value.what


def test_each_way_is_a_mission_of_its_recordings_floor(panel: Panel) -> None:
    away = replace(FLOOR, name="away", map_origin=(300.0, 300.0, 0.0))
    made = logged_missions(panel, (FLOOR, away), ("nominal",), every=True)
    assert made.ways == 24
    layouts = [spec.layout for spec in made.specs["nominal"]]
    assert layouts == [FLOOR.name] * 12 + ["away"] * 12
    ends = np.array([spec.way for spec in made.specs["nominal"]])
    np.testing.assert_allclose(ends[:12], ends[12:], atol=2e-3)


def test_eval_drives_the_ways_of_the_logs(panel, tmp_path, capsys):
    run = kept_run(tmp_path / "run", panel=panel)
    line = ["eval", str(run), "--policies", "planner", "--perturbations", "none", "--json"]
    assert main([*line, "--missions", "logged", "--episodes", "nominal=3"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert document["missions"].startswith("missions of the logs: ")
    assert "missions of the logs: " in said.err
    driven = read_evaluations(run).to_pylist()
    assert {row["layouts"] for row in driven} == {"default, ways of the logs"}
    assert len({row["episode_seed"] for row in driven}) == len(driven) <= 3
    for row in driven:  # it arrived where a robot was once sent
        place = np.array([row["end_x_m"], row["end_y_m"]])
        assert row["success"]
        assert np.hypot(*(STARTS - place).T).min() <= TASK.goal_radius_m + 0.1
    assert main([*line, "--missions", "mine"]) == 2
    assert "choose from drawn, logged, logged:all" in capsys.readouterr().err
    away = replace(FLOOR, name="away", map_origin=(900.0, 0.0, 0.0))
    write_floor(away, tmp_path / "away.toml")
    assert main([*line, "--missions", "logged", "--layouts", str(tmp_path / "away.toml")]) == 2
    assert "0 of " in capsys.readouterr().err
    without = kept_run(tmp_path / "without")
    assert main(["eval", str(without), "--missions", "logged"]) == 2
    assert "did not learn from logs" in capsys.readouterr().err
