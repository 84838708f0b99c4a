"""Drift: the tests keep their significance level on correlated logs and find a worn wheel."""

from importlib.resources import files
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pytest
from scipy import stats
from support.fleets import SyntheticRobot, fleet, wander
from support.long import one_in

from restock.replay.store.definitions import install_named

WEEKS = ["2026-03-02", "2026-03-09", "2026-03-16", "2026-03-23"]
WORN = SyntheticRobot("b", changes={"odometry_scale": 0.94})


def rows(connection: duckdb.DuckDBPyConnection, query: str) -> list[dict[str, Any]]:
    install_named(connection, query)
    found: list[dict[str, Any]] = connection.sql(query).to_arrow_table().to_pylist()
    return found


def drift_views(signals: pa.Table, conditions: pa.Table | None = None) -> duckdb.DuckDBPyConnection:
    """Return the views of drift.sql over given samples."""
    connection = duckdb.connect()
    connection.register("episode_signals", signals)
    if conditions is None:
        connection.execute(
            "CREATE TABLE episode_conditions (robot TEXT, site TEXT, recording_id TEXT,"
            " episode_id TEXT, start_time TIMESTAMP, condition TEXT, zone TEXT, driven_h DOUBLE,"
            " steps BIGINT, events BIGINT)"
        )
    else:
        connection.register("episode_conditions", conditions)
    connection.execute(
        "CREATE VIEW drift_signals AS SELECT * FROM (VALUES ('scale', 'wheels', 'ratio', 1.02, 5),"
        " ('bias', 'gyro', 'difference', .1, 5))"
        " AS known (signal, part, compared, matters, min_steps)"
    )
    connection.execute((files("restock.replay.store") / "drift.sql").read_text("utf-8"))
    return connection


def samples(
    values: dict[tuple[str, str, int], list[np.ndarray]],
    *,
    part: str = "gyro",
    signal: str = "bias",
) -> pa.Table:
    """Return `episode_signals`; `values`: (robot, site, week) -> episode values by recording."""
    lines = [
        {
            "robot": robot,
            "site": site,
            "recording_id": f"{robot}-{week}-{number}",
            "episode_id": f"{robot}-{week}-{number}/{episode}",
            "start_time": np.datetime64(WEEKS[week], "us").item(),
            "part": part,
            "signal": signal,
            "value": float(value),
            "steps": 50,
        }
        for (robot, site, week), recordings in values.items()
        for number, episodes in enumerate(recordings)
        for episode, value in enumerate(episodes)
    ]
    return pa.Table.from_pylist(lines)


def correlated(
    rng: np.random.Generator, recordings: int, episodes: int, steps: int = 60
) -> list[np.ndarray]:
    """Return episode means of autocorrelated steps, with a random offset per recording."""
    return [
        np.array([wander(rng, steps, 1.0, 0.95).mean() + base for _ in range(episodes)])
        for base in rng.normal(0, 0.3, recordings)
    ]


@pytest.mark.parametrize("df", [1, 2, 3, 4, 7, 20, 51, 200])
def test_student_t_matches_scipy(df):
    connection = drift_views(samples({("a", "x", 0): [np.ones(1)]}))
    for t in (0.0, 0.4, -2.0, 5.0, 12.0):
        p = connection.sql(f"SELECT student_p({t}::DOUBLE, {df})").fetchall()[0][0]
        assert p == pytest.approx(max(2 * stats.t.sf(abs(t), df), 1e-15), rel=1e-6, abs=1e-14)
    if df >= 3:
        quantile = connection.sql(f"SELECT student_quantile({df})").fetchall()[0][0]
        assert quantile == pytest.approx(stats.t.ppf(0.975, df), rel=2e-3)


def test_trimmed_test_matches_scipy():
    rng = np.random.default_rng(3)
    early, late = rng.normal(0, 1, 24), rng.normal(0.9, 1, 31)
    table = samples({("a", "x", 0): [early], ("a", "x", 1): [late]})
    [row] = rows(drift_views(table), "FROM drift WHERE against = 'own reference'")
    trimmed = stats.ttest_ind(late, early, trim=0.1)
    low, high = trimmed.confidence_interval()
    assert row["p"] == pytest.approx(trimmed.pvalue, rel=1e-6)
    assert [row["change_low"], row["change_high"]] == pytest.approx([low, high], rel=1e-3)
    assert (row["n"], row["n_reference"], row["samples"]) == (31, 24, "episodes")


def test_p_correction_matches_scipy():
    rng = np.random.default_rng(4)
    values = {
        (f"r{robot}", f"r{robot}", week): [rng.normal(0.2 * robot * (week == 2), 1, 12)]
        for robot in range(12)
        for week in range(3)
    }
    found = rows(drift_views(samples(values)), "FROM drift WHERE against = 'own reference'")
    p = [row["p"] for row in found]
    assert len(p) == 12
    assert [row["q"] for row in found] == pytest.approx(stats.false_discovery_control(p))


@pytest.mark.parametrize("seed", one_in(2, [0, 1]))
def test_false_alarm_rate_with_correlated_steps(seed):
    rng, robots = np.random.default_rng(seed), 300
    values = {
        (f"r{robot}", f"r{robot}", week): correlated(rng, 3, 5)
        for robot in range(robots)
        for week in range(4)
    }
    connection = drift_views(samples(values))
    found = rows(connection, "FROM drift WHERE against = 'own reference' AND period = '2026-03-23'")
    assert {row["samples"] for row in found} == {"recordings"}
    alarms = sum(row["p"] < 0.05 for row in found)
    # 1 in 1,000 of binomial draws at the nominal level is outside
    assert stats.binom.ppf(0.001, robots, 0.05) <= alarms <= stats.binom.ppf(0.999, robots, 0.05)
    corrected = rows(connection, "SELECT count(*) AS n FROM drift WHERE q < .05")
    assert corrected[0]["n"] <= 2


def test_false_alarm_rate_with_overdispersed_events():
    rng = np.random.default_rng(5)
    robot, week, number, episode = (part.ravel() for part in np.indices((300, 4, 3, 5)))
    names = [f"r{one}" for one in robot]
    drives = [f"{name}-{at}-{one}" for name, at, one in zip(names, week, number, strict=True)]
    # Some drives meet far more events than others: overdispersed, not Poisson.
    rate = rng.gamma(2, 1.0, (300, 4, 3, 1)) * np.ones(5)
    conditions = {
        "robot": names,
        "site": names,
        "recording_id": drives,
        "episode_id": [f"{drive}/{one}" for drive, one in zip(drives, episode, strict=True)],
        "start_time": np.array(WEEKS, "datetime64[us]")[week],
        "condition": ["wheel_slip"] * len(names),
        "zone": pa.nulls(len(names), pa.string()),
        "driven_h": np.ones(len(names)),
        "steps": np.zeros(len(names), int),
        "events": rng.poisson(rate).ravel(),
    }
    nothing = samples({("none", "none", 0): [np.ones(1)]})
    connection = drift_views(nothing, pa.table(conditions))
    found = rows(connection, "FROM drift WHERE part = 'conditions' AND period = '2026-03-23'")
    assert len(found) == 300
    alarms = sum(row["p"] < 0.05 for row in found)
    assert stats.binom.ppf(0.0001, 300, 0.05) <= alarms <= stats.binom.ppf(0.9999, 300, 0.05)


@pytest.fixture(scope="module")
def worn() -> duckdb.DuckDBPyConnection:
    return fleet([SyntheticRobot("a"), WORN, SyntheticRobot("c")], recordings=3)


def test_worn_wheel_is_only_finding(worn):
    [found] = rows(worn, "FROM drift_findings WHERE part <> 'driving'")
    assert (found["robot"], found["part"], found["signal"]) == ("b", "wheels", "odometry_scale")
    assert (str(found["since"]), found["periods"], found["periods_tested"]) == (WEEKS[2], 2, 2)
    assert found["change_low"] < 0.94 < found["change_high"]
    assert found["scope"] == "robot"
    assert "0 of 2 other robots at this site changed alike" in found["finding"]


def test_worn_wheel_differs_from_other_robots(worn):
    query = (
        "SELECT period::VARCHAR AS period, verdict FROM drift WHERE against = 'other robots'"
        " AND robot = 'b' AND signal = 'odometry_scale' ORDER BY period"
    )
    verdicts = {row["period"]: row["verdict"] for row in rows(worn, query)}
    assert [verdicts[week] for week in WEEKS[2:]] == ["differs", "differs"]
    assert "differs" not in [verdicts[week] for week in WEEKS[:2]]


def test_change_of_all_robots_has_scope_site():
    slippery = {"odometry_scale": 0.92}
    robots = [SyntheticRobot(name, changes=slippery) for name in "abc"]
    found = rows(fleet(robots, recordings=3), "FROM drift_findings WHERE signal = 'odometry_scale'")
    assert {(row["robot"], row["scope"]) for row in found} == {(name, "site") for name in "abc"}


def test_robots_of_other_sites_are_not_compared():
    robots = [WORN, SyntheticRobot("a", site="other")]
    found = rows(fleet(robots, recordings=3), "FROM drift_findings WHERE part = 'wheels'")
    assert [(row["robot"], row["scope"]) for row in found] == [("b", "alone")]


def test_lidar_and_floor_changes_are_distinguished():
    robots = [
        SyntheticRobot("a", changes={"lidar_noise_m": 3.0}),
        SyntheticRobot("b", changes={"slips_per_step": 8.0}),
        SyntheticRobot("c", changes={"silent_sectors": 1}),
    ]
    found = rows(fleet(robots, recordings=3), "FROM drift_findings WHERE zone IS NULL")
    parts = {
        (row["robot"], row["part"], row["signal"]) for row in found if row["part"] != "driving"
    }
    assert parts == {
        ("a", "lidar", "lidar_noise_m"),
        ("b", "conditions", "wheel_slip"),
        ("c", "lidar", "silent_sectors"),
    }


def test_too_few_episodes_have_own_verdict():
    lone = fleet([SyntheticRobot("a")], recordings=1, episodes=3)
    verdicts = rows(lone, "SELECT DISTINCT verdict, p FROM drift WHERE part = 'wheels'")
    assert verdicts == [{"verdict": "too few", "p": None}]
    one_week = fleet([SyntheticRobot("a")], weeks=1)
    verdicts = rows(one_week, "SELECT DISTINCT verdict FROM drift WHERE against = 'own reference'")
    assert verdicts == [{"verdict": "too few"}]


def test_untagged_recordings_count_as_one_robot():
    mute = SyntheticRobot(None, site=None, changes={"odometry_scale": 0.9})
    [found] = rows(fleet([mute], recordings=3), "FROM drift_findings WHERE part = 'wheels'")
    assert (found["robot"], found["site"], found["scope"]) == ("untagged", "untagged", "alone")


def test_missing_signals_are_not_reported():
    blind = SyntheticRobot("a", localiser=False, gyro=False)
    found = rows(fleet([blind], recordings=3), "SELECT DISTINCT signal FROM drift")
    signals = {row["signal"] for row in found}
    assert "command_gain" in signals
    lacking = {"odometry_scale", "wheel_yaw_scale", "gyro_bias_radps", "localiser_jitter_mps"}
    assert not signals & (lacking | {"localised_speed_mps", "gyro_yaw_rate_radps"})


def test_custom_signals_are_compared():
    connection = fleet([SyntheticRobot("a"), SyntheticRobot("b")], recordings=3)
    install_named(connection, "transitions, recordings")
    # The battery of robot b is weaker from week three on.
    connection.execute(
        "CREATE TABLE volts AS SELECT *, (24 + sin(transition_id) - 2 * (robot = 'b' AND"
        f" logged_time >= '{WEEKS[2]}')::INT)::FLOAT AS battery_v, true AS lit FROM transitions"
    )
    connection.execute(
        "CREATE TABLE listed AS SELECT * REPLACE (list_transform(['battery_v', 'lit'], lambda name:"
        " {name: name}) AS signals) FROM recordings"
    )
    connection.execute("CREATE OR REPLACE VIEW transitions AS FROM volts")
    connection.execute("CREATE OR REPLACE VIEW recordings AS FROM listed")
    found = rows(connection, "FROM drift_findings WHERE part = 'custom'")
    assert [(row["robot"], row["signal"]) for row in found] == [("b", "battery_v")]
    lit = rows(connection, "SELECT DISTINCT value FROM episode_signals WHERE signal = 'lit'")
    assert lit == [{"value": 1.0}]


def test_constant_values_have_minimal_variance():
    table = samples({("a", "x", 0): [np.zeros(6)], ("a", "x", 1): [np.ones(5)]})
    [row] = rows(drift_views(table), "FROM drift WHERE against = 'own reference'")
    t = 1 / np.sqrt(0.01**2 * (1 / 6 + 1 / 5))
    assert row["verdict"] == "changed"
    assert row["p"] == pytest.approx(max(2 * stats.t.sf(t, 9), 1e-15), rel=1e-3)
    same = samples({("a", "x", 0): [np.zeros(6)], ("a", "x", 1): [np.zeros(5)]})
    [row] = rows(drift_views(same), "FROM drift WHERE against = 'own reference'")
    assert (row["p"], row["verdict"]) == (1, "unchanged")


def test_periods_other_than_weeks(worn):
    monthly = rows(worn, "FROM drift_by('month') WHERE against = 'own reference'")
    assert {row["verdict"] for row in monthly} == {"too few"}  # a month with nothing before it
    first = rows(
        worn,
        "FROM drift_by(reference := 1) WHERE robot = 'b' AND signal = 'odometry_scale'"
        " AND against = 'own reference'",
    )
    assert [row["verdict"] == "changed" for row in first] == [False, True, True]
