"""Goals in hindsight: a drive's later position becomes the goal of the steps before it."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.driven_robot import Drive, write_bag
from support.ingested import ingested, proposed

from restock.cli import main
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.hindsight import GoalRules, missions, shortest_m
from restock.ingest.task.task import Task
from restock.replay.store.store import Store

PERIOD_S = 0.2
TASK = Task(body={"length_m": 0.6, "width_m": 0.5}, actions=((0.0, 0.0), (0.4, 0.0)))  # type: ignore[arg-type]
RADIUS_M = TASK.goal_radius_m


class UnguidedDrive(Drive):
    """Drive without goals and plans: 6 m out, 6 s of standing, 4 m on."""

    drop = ("/goal_pose", "/plan", "/behaviour_policy")

    def x_at(self, time_s):
        return 1.0 + 0.5 * (np.minimum(time_s, 12.0) + np.maximum(time_s - 18.0, 0.0))


class StationaryDrive(UnguidedDrive):
    """Drive that never leaves its position."""

    def x_at(self, time_s):
        return 1.0 + 0.0 * time_s


class ReturningDrive(UnguidedDrive):
    """Drive of 5 m out and 1.8 m back, which ends where it had been on its way out."""

    def x_at(self, time_s):
        return 1.0 + 0.5 * (np.minimum(time_s, 10.0) - np.maximum(time_s - 10.0, 0.0))


class WaitingDrive(UnguidedDrive):
    """Drive that stands for a minute and then goes 6 m."""

    def x_at(self, time_s):
        return 1.0 + 0.5 * np.maximum(time_s - 60.0, 0.0)


@pytest.fixture(scope="module")
def unguided(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a bag without goals, its proposal `robot0.toml`, and its `store`."""
    folder = tmp_path_factory.mktemp("unguided")
    bag = write_bag(UnguidedDrive(26.0), folder / "bag")
    proposed(bag, folder / "robot0.toml")
    ingested(bag, folder / "robot0.toml", folder / "store").close()
    return folder


def test_bag_without_goals_gets_hindsight_missions(unguided, shell):
    profile = load_profile(unguided / "robot0.toml")
    assert (profile.goal_source, profile.inputs.goal, profile.task.goal) == (
        *("hindsight", None),
        "route",
    )
    with Store(unguided / "store") as store:
        found = store.sql(
            "SELECT goal_source, success, ended_by FROM episodes ORDER BY episode_index"
        ).fetchall()
        assert found == [("hindsight", None, "goal")] * 2
        ends = store.sql(
            "SELECT max(pose_x_m), max(goal_distance_m), min(route_remaining_m) >= 0"
            " FROM transitions GROUP BY episode_index ORDER BY episode_index"
        ).fetchall()
        for (x, furthest, has_route), goal_x, length in zip(
            ends, (7.0, 11.0), (6.0, 4.0), strict=True
        ):
            assert goal_x - profile.task.goal_radius_m - 0.3 <= x <= goal_x
            assert furthest == pytest.approx(length, abs=0.2)
            assert has_route
        assert store.sql("SELECT sum(success_share) FROM coverage").fetchall() == [(None,)]
    listed = shell.json("audit", unguided / "store", code={0, 1})["audits"]
    audits = {audit["audit"]: audit for audit in listed}
    assert audits["goals_by_hindsight"]["sample"][0]["arrived"] == 2
    assert audits["mixed_goal_sources"]["status"] == "pass"


def test_plan_conditions_are_unknown_with_hindsight_goals(unguided, tmp_path):
    """The plan is the driven path: nothing stood on it, and any other plan is unknown."""
    store = shutil.copytree(unguided / "store", tmp_path / "store")

    def unknown_conditions() -> list[str]:
        query = "SELECT condition FROM unknown_conditions WHERE because LIKE '%driven' ORDER BY 1"
        with Store(store) as opened:
            return [name for (name,) in opened.sql(query).fetchall()]

    assert unknown_conditions() == ["blocked_aisle", "plan_blocked"]
    with Store(store) as opened:
        held = dict(opened.sql("SELECT condition, rows_held FROM coverage_by_condition").fetchall())
    assert (held["blocked_aisle"], held["near_collision"]) == (None, 0)
    more = '[[condition]]\nname = "close"\ntiming = "pre"\nsql = "plan_gap_m < 9"\n'
    (tmp_path / "p.toml").write_text((unguided / "robot0.toml").read_text() + more)
    assert main(["store", "label", str(store), "--profile", str(tmp_path / "p.toml")]) == 0
    assert unknown_conditions() == ["blocked_aisle", "close", "plan_blocked"]


def test_hindsight_changes_only_goal_and_route(unguided, tmp_path):
    no_goal_profile = tmp_path / "none.toml"
    text = (unguided / "robot0.toml").read_text().replace('goal = "route"', 'goal = "none"')
    no_goal_profile.write_text(text.replace('source = "hindsight"', 'source = "logged"'))
    measured = ("pose_", "wheel_", "gyro", "accel", "localised_", "clearance_m", "sector")
    with (
        Store(unguided / "store") as hindsight,
        ingested(unguided / "bag", no_goal_profile, tmp_path / "b") as without_goals,
    ):
        columns = hindsight.sql("FROM transitions LIMIT 0").columns
        names = [name for name in columns if name.startswith(measured)]
        assert len(names) > 8
        query = f"SELECT stamp_ns, action, {', '.join(names)} FROM transitions ORDER BY stamp_ns"
        every = {row[0]: row for row in without_goals.sql(query).fetchall()}
        rows = hindsight.sql(query).fetchall()
    assert rows
    assert all(repr(row) == repr(every[row[0]]) for row in rows)


def test_mostly_standing_robot_gets_goals_on_request(tmp_path):
    turntable = write_bag(StationaryDrive(20.0), tmp_path / "turntable")
    assert proposed(turntable, tmp_path / "a.toml").task.goal == "none"
    bag, file = write_bag(WaitingDrive(72.0), tmp_path / "stood"), tmp_path / "c.toml"
    assert proposed(bag, tmp_path / "b.toml").task.goal == "none"
    assert proposed(bag, file, "--hindsight-goals").goal_source == "hindsight"
    with ingested(bag, file, tmp_path / "store") as store:
        query = "SELECT DISTINCT goal_source, count(*) OVER () BETWEEN 100 AND 120 FROM transitions"
        assert store.sql(query).fetchall() == [("hindsight", True)]


def find_missions(xy: np.ndarray, leg: np.ndarray | None = None, located: np.ndarray | None = None):
    stamps = np.arange(len(xy)) * round(PERIOD_S * 1e9)
    leg = np.zeros(len(xy), np.int64) if leg is None else leg
    located = np.ones(len(xy), np.bool_) if located is None else located
    return missions(GoalRules(), TASK, xy, stamps, located, leg)


def line(x0: float, x1: float, speed: float = 0.5) -> np.ndarray:
    x = np.arange(x0, x1, np.sign(x1 - x0) * speed * PERIOD_S)
    return np.stack([x, np.zeros(len(x))], axis=1)


def test_goal_is_not_passed_before_mission_ends(tmp_path):
    """Half of a drive that ended on its way out had reached its goal earlier."""
    bag, file = write_bag(ReturningDrive(13.6), tmp_path / "bag"), tmp_path / "p.toml"
    proposed(bag, file)
    with ingested(bag, file, tmp_path / "store") as store:
        ((rows,),) = store.sql("SELECT count(*) FROM transitions").fetchall()
    assert 68 - rows <= 6  # the ends of its missions
    # Out, around, and back onto the way out: to the first pass of that point, the far end, and
    # back.
    turn = np.linspace(0, np.pi, 20)
    arc = np.stack([4.4 + 0.6 * np.sin(turn), 0.6 - 0.6 * np.cos(turn)], axis=1)
    down = np.stack([np.full(13, 3.2), np.linspace(1.2, 0, 13)], axis=1)
    way = [line(0, 4.4), arc, line(4.4, 3.2) + np.array([0, 1.2]), down]
    result = find_missions(np.concatenate(way))
    assert result.ended_at == ["came back later", "turned back", "end of the recording"]
    assert result.goals_m[[0, 2]] == pytest.approx(np.array([[3.2, 0], [3.2, 0]]))
    assert set(result.problem) == {""}
    assert len(result.routes_m[0]) < 3.2 / (RADIUS_M / 2) + 2  # without the rest of the path


def test_long_drive_is_split_by_distance():
    turn = np.linspace(0, 6 * np.pi, 600)
    circle = 6.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    result = find_missions(circle)
    assert len(result.goals_m) >= 6
    assert set(result.ended_at) <= {"turned back", "far enough", "end of the recording"}
    assert "far enough" in result.ended_at
    assert result.problem.count("") > 0.95 * len(circle)


def test_routes_do_not_contain_loops():
    turn = np.linspace(0, 2 * np.pi, 40)
    loop = np.stack([3 + 0.4 * np.sin(turn), 0.4 - 0.4 * np.cos(turn)], axis=1)
    result = find_missions(np.concatenate([line(0, 3), loop, line(3, 6)]))
    route = np.concatenate(result.routes_m)
    length = sum(np.hypot(*np.diff(route, axis=0).T).sum() for route in result.routes_m)
    assert length < 6.5
    assert np.abs(route[:, 1]).max() < 0.3


PATHS = st.lists(
    st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.integers(1, 40)),
    min_size=1,
    max_size=12,
)


@settings(max_examples=60)
@given(PATHS, st.integers(0, 2**31), st.floats(0, 0.05))
def test_missions_arrive_in_time_within_one_leg(moves, seed, noise):
    rng = np.random.default_rng(seed)
    steps = np.concatenate([np.tile(move[:2], (move[2], 1)) for move in moves])
    xy = np.cumsum(steps, axis=0) + rng.normal(0, noise, steps.shape)
    leg = np.cumsum(rng.random(len(xy)) < 0.02)
    located = rng.random(len(xy)) > 0.05
    result = find_missions(xy, leg, located)
    assert len(result.goals_m) == len(result.routes_m) == len(result.ended_at)
    inside = (result.mission >= 0) & located & ~result.standing
    for number, goal in enumerate(result.goals_m):
        ticks = np.flatnonzero((result.mission == number) & inside)
        assert len(np.unique(leg[ticks])) == 1
        assert len(ticks) * PERIOD_S <= TASK.time_limit_steps * PERIOD_S
        # the tick that ends it
        after = ticks[-1] + 1 + np.flatnonzero(located[ticks[-1] + 1 :])[:1]
        near = np.hypot(*(xy[[*ticks, *after]] - goal).T).min()
        assert near <= RADIUS_M + 1e-9
        assert np.allclose(result.routes_m[number][-1], goal)
        gap = np.hypot(*(xy[ticks] - goal).T)
        # distance after arriving, if it arrived before the last tick
        then = gap[(gap <= RADIUS_M).argmax() :]
        assert gap.min() > RADIUS_M or then.max() <= shortest_m(TASK)
        away = np.hypot(*(xy[ticks[0]] - goal))
        assert away >= shortest_m(TASK) - RADIUS_M / 2 - 1e-9
    assert all((result.mission >= 0) | (np.array(result.problem) != ""))
