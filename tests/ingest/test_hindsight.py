"""Goals in hindsight: where a drive got to is the goal of what led there."""

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


class Unguided(Drive):
    """Without goals and plans: 6 m out, 6 s of standing, 4 m on."""

    drop = ("/goal_pose", "/plan", "/behaviour_policy")

    def x_at(self, time_s):
        return 1.0 + 0.5 * (np.minimum(time_s, 12.0) + np.maximum(time_s - 18.0, 0.0))


class Turntable(Unguided):
    """It never leaves its place."""

    def x_at(self, time_s):
        return 1.0 + 0.0 * time_s


class Returning(Unguided):
    """5 m out, and 1.8 m back: it ends where it was on its way out."""

    def x_at(self, time_s):
        return 1.0 + 0.5 * (np.minimum(time_s, 10.0) - np.maximum(time_s - 10.0, 0.0))


class Waiting(Unguided):
    """It stands for a minute, and then drives 6 m."""

    def x_at(self, time_s):
        return 1.0 + 0.5 * np.maximum(time_s - 60.0, 0.0)


@pytest.fixture(scope="module")
def unguided(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of a bag without goals, its proposal `robot0.toml`, and its `store`."""
    folder = tmp_path_factory.mktemp("unguided")
    bag = write_bag(Unguided(26.0), folder / "bag")
    proposed(bag, folder / "robot0.toml")
    ingested(bag, folder / "robot0.toml", folder / "store").close()
    return folder


def test_a_bag_without_goals_becomes_missions_that_say_so(unguided, shell):
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
        for (x, furthest, sane), goal_x, length in zip(ends, (7.0, 11.0), (6.0, 4.0), strict=True):
            assert goal_x - profile.task.goal_radius_m - 0.3 <= x <= goal_x
            assert furthest == pytest.approx(length, abs=0.2)
            assert sane
        assert store.sql("SELECT sum(success_share) FROM coverage").fetchall() == [(None,)]
    said = shell.json("audit", unguided / "store", code={0, 1})["audits"]
    audits = {one["audit"]: one for one in said}
    assert audits["goals_by_hindsight"]["sample"][0]["arrived"] == 2
    assert audits["mixed_goal_sources"]["status"] == "pass"


def test_what_stands_on_the_driven_path_is_unknown_not_false(unguided, tmp_path):
    """The plan is what was driven: nothing stood on it, and of another plan nothing is known."""
    store = shutil.copytree(unguided / "store", tmp_path / "store")

    def unknown() -> list[str]:
        query = "SELECT condition FROM unknown_conditions WHERE because LIKE '%driven' ORDER BY 1"
        with Store(store) as opened:
            return [name for (name,) in opened.sql(query).fetchall()]

    assert unknown() == ["blocked_aisle", "plan_blocked"]
    with Store(store) as opened:
        held = dict(opened.sql("SELECT condition, rows_held FROM coverage_by_condition").fetchall())
    assert (held["blocked_aisle"], held["near_collision"]) == (None, 0)
    more = '[[condition]]\nname = "close"\ntiming = "pre"\nsql = "plan_gap_m < 9"\n'
    (tmp_path / "p.toml").write_text((unguided / "robot0.toml").read_text() + more)
    assert main(["store", "label", str(store), "--profile", str(tmp_path / "p.toml")]) == 0
    assert unknown() == ["blocked_aisle", "close", "plan_blocked"]


def test_only_goal_and_route_features_depend_on_the_future(unguided, tmp_path):
    bare = tmp_path / "none.toml"
    text = (unguided / "robot0.toml").read_text().replace('goal = "route"', 'goal = "none"')
    bare.write_text(text.replace('source = "hindsight"', 'source = "logged"'))
    measured = ("pose_", "wheel_", "gyro", "accel", "localised_", "clearance_m", "sector")
    with (
        Store(unguided / "store") as hindsight,
        ingested(unguided / "bag", bare, tmp_path / "b") as none,
    ):
        columns = hindsight.sql("FROM transitions LIMIT 0").columns
        names = [name for name in columns if name.startswith(measured)]
        assert len(names) > 8
        query = f"SELECT stamp_ns, action, {', '.join(names)} FROM transitions ORDER BY stamp_ns"
        every = {row[0]: row for row in none.sql(query).fetchall()}
        rows = hindsight.sql(query).fetchall()
    assert rows
    assert all(repr(row) == repr(every[row[0]]) for row in rows)


def test_a_robot_that_mostly_stood_has_goals_if_requested(tmp_path):
    turntable = write_bag(Turntable(20.0), tmp_path / "turntable")
    assert proposed(turntable, tmp_path / "a.toml").task.goal == "none"
    bag, file = write_bag(Waiting(72.0), tmp_path / "stood"), tmp_path / "c.toml"
    assert proposed(bag, tmp_path / "b.toml").task.goal == "none"
    assert proposed(bag, file, "--hindsight-goals").goal_source == "hindsight"
    with ingested(bag, file, tmp_path / "store") as store:
        query = "SELECT DISTINCT goal_source, count(*) OVER () BETWEEN 100 AND 120 FROM transitions"
        assert store.sql(query).fetchall() == [("hindsight", True)]


def found(xy: np.ndarray, leg: np.ndarray | None = None, located: np.ndarray | None = None):
    stamps = np.arange(len(xy)) * round(PERIOD_S * 1e9)
    leg = np.zeros(len(xy), np.int64) if leg is None else leg
    located = np.ones(len(xy), np.bool_) if located is None else located
    return missions(GoalRules(), TASK, xy, stamps, located, leg)


def line(x0: float, x1: float, speed: float = 0.5) -> np.ndarray:
    x = np.arange(x0, x1, np.sign(x1 - x0) * speed * PERIOD_S)
    return np.stack([x, np.zeros(len(x))], axis=1)


def test_no_goal_was_passed_before_its_mission_ends(tmp_path):
    """Half of a drive that ended on its way out had reached its goal while it drove on."""
    bag, file = write_bag(Returning(13.6), tmp_path / "bag"), tmp_path / "p.toml"
    proposed(bag, file)
    with ingested(bag, file, tmp_path / "store") as store:
        ((rows,),) = store.sql("SELECT count(*) FROM transitions").fetchall()
    assert 68 - rows <= 6  # the ends of its missions
    # Out, round, and back onto the way out: to where it passes first, to the far end, and back.
    turn = np.linspace(0, np.pi, 20)
    round_it = np.stack([4.4 + 0.6 * np.sin(turn), 0.6 - 0.6 * np.cos(turn)], axis=1)
    down = np.stack([np.full(13, 3.2), np.linspace(1.2, 0, 13)], axis=1)
    way = [line(0, 4.4), round_it, line(4.4, 3.2) + np.array([0, 1.2]), down]
    made = found(np.concatenate(way))
    assert made.ended_at == ["came back later", "turned back", "end of the recording"]
    assert made.goals_m[[0, 2]] == pytest.approx(np.array([[3.2, 0], [3.2, 0]]))
    assert set(made.problem) == {""}
    assert len(made.routes_m[0]) < 3.2 / (RADIUS_M / 2) + 2  # without the rest of the way


def test_a_long_drive_is_cut_where_it_is_far_enough():
    turn = np.linspace(0, 6 * np.pi, 600)
    circle = 6.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    made = found(circle)
    assert len(made.goals_m) >= 6
    assert set(made.ended_at) <= {"turned back", "far enough", "end of the recording"}
    assert "far enough" in made.ended_at
    assert made.problem.count("") > 0.95 * len(circle)


def test_loops_are_no_part_of_a_route():
    turn = np.linspace(0, 2 * np.pi, 40)
    loop = np.stack([3 + 0.4 * np.sin(turn), 0.4 - 0.4 * np.cos(turn)], axis=1)
    made = found(np.concatenate([line(0, 3), loop, line(3, 6)]))
    route = np.concatenate(made.routes_m)
    length = sum(np.hypot(*np.diff(route, axis=0).T).sum() for route in made.routes_m)
    assert length < 6.5
    assert np.abs(route[:, 1]).max() < 0.3


PATHS = st.lists(
    st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.integers(1, 40)),
    min_size=1,
    max_size=12,
)


@settings(max_examples=60)
@given(PATHS, st.integers(0, 2**31), st.floats(0, 0.05))
def test_every_mission_arrives_in_time_and_on_its_own_leg(moves, seed, noise):
    rng = np.random.default_rng(seed)
    steps = np.concatenate([np.tile(move[:2], (move[2], 1)) for move in moves])
    xy = np.cumsum(steps, axis=0) + rng.normal(0, noise, steps.shape)
    leg = np.cumsum(rng.random(len(xy)) < 0.02)
    located = rng.random(len(xy)) > 0.05
    made = found(xy, leg, located)
    assert len(made.goals_m) == len(made.routes_m) == len(made.ended_at)
    inside = (made.mission >= 0) & located & ~made.standing
    for number, goal in enumerate(made.goals_m):
        ticks = np.flatnonzero((made.mission == number) & inside)
        assert len(np.unique(leg[ticks])) == 1
        assert len(ticks) * PERIOD_S <= TASK.time_limit_steps * PERIOD_S
        after = ticks[-1] + 1 + np.flatnonzero(located[ticks[-1] + 1 :])[:1]  # the tick it ends on
        near = np.hypot(*(xy[[*ticks, *after]] - goal).T).min()
        assert near <= RADIUS_M + 1e-9
        assert np.allclose(made.routes_m[number][-1], goal)
        gap = np.hypot(*(xy[ticks] - goal).T)
        then = gap[(gap <= RADIUS_M).argmax() :]  # arrived, if it did before the last tick
        assert gap.min() > RADIUS_M or then.max() <= shortest_m(TASK)
        away = np.hypot(*(xy[ticks[0]] - goal))
        assert away >= shortest_m(TASK) - RADIUS_M / 2 - 1e-9
    assert all((made.mission >= 0) | (np.array(made.problem) != ""))
