"""Coverage of a fleet by week and robot: counts add up, and cells never seen are listed."""

from typing import Any

import pytest
from support.stores import recording_transitions, write_store

from restock.ingest.store.transitions import replaced
from restock.replay.store.store import Store

WEEK_NS = 7 * 86_400 * 10**9
TAGS = [{"robot": "a"}, {"robot": "a"}, {"robot": "b"}, {}]
# The synthetic recordings begin on a Tuesday; the second of robot a is three weeks later.
LATER = [0, 3, 0, 1]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory) -> Store:
    tables = []
    for number, weeks in enumerate(LATER, 1):
        table = recording_transitions(number)
        stamps = table["stamp_ns"].to_numpy() + weeks * WEEK_NS
        tables.append(replaced(table, {"stamp_ns": stamps}))
    path = tmp_path_factory.mktemp("fleet") / "store"
    return Store(write_store(path, tables, tags=TAGS))


def rows_of(store: Store, query: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = store.sql(query).to_arrow_table().to_pylist()
    return rows


def test_driven_weeks_list_every_condition(fleet):
    rows = rows_of(fleet, "FROM coverage_by_week")
    conditions = {row["condition"] for row in rows_of(fleet, "FROM conditions")}
    cells = {(row["robot"], str(row["week"]), row["condition"]) for row in rows}
    driven = {("a", "2023-11-13"), ("a", "2023-12-04"), ("b", "2023-11-13"), (None, "2023-11-20")}
    assert cells == {(*one, condition) for one in driven for condition in conditions}
    assert len(rows) == len(cells)


def test_weekly_counts_match_rows_and_events(fleet):
    week = "CAST(date_trunc('week', {}) AS DATE) AS week"
    rows = fleet.sql(
        f"SELECT robot, {week.format('logged_time')}, condition, count(*),"
        " count(DISTINCT episode_id), countif(condition = primary_condition)"
        " FROM held_conditions GROUP BY ALL"
    ).fetchall()
    events = fleet.sql(
        f"SELECT robot, {week.format('logged_onset_time')}, condition, count(*),"
        " count(*) FILTER (NOT recovered) FROM events GROUP BY ALL"
    ).fetchall()
    counted = {row[:3]: row[3:] for row in rows}
    event_counts = {row[:3]: row[3:] for row in events}
    for row in rows_of(fleet, "FROM coverage_by_week"):
        cell = row["robot"], row["week"], row["condition"]
        driven = sum(primary for other, (_, _, primary) in counted.items() if other[:2] == cell[:2])
        count, episodes, primary = counted.get(cell, (0, 0, 0))
        began, not_recovered = event_counts.get(cell, (0, 0))
        hours = driven * 0.2 / 3600
        expected = {
            "rows_held": count,
            "held_share": count / driven,
            "episodes_held": episodes,
            "primary_rows": primary,
            "primary_share": primary / driven,
            "hours": hours,
            "events": began,
            "not_recovered": not_recovered,
            "events_per_hour": began / hours,
        }
        assert {name: row[name] for name in expected} == pytest.approx(expected)
    assert sum(count for count, _ in event_counts.values()) > 50


def test_weeks_add_up_to_robot_totals(fleet):
    weeks = (
        "sum(rows_held), sum(episodes_held), sum(primary_rows), sum(goal_episodes), sum(successes),"
        " sum(events), sum(hours)"
    )
    totals = fleet.sql(
        f"SELECT robot, condition, {weeks}, count(*), min(week) FROM coverage_by_week"
        " GROUP BY ALL ORDER BY ALL"
    ).fetchall()
    robots = fleet.sql(
        "SELECT robot, condition, rows_held, episodes_held, primary_rows, goal_episodes, successes,"
        " events, hours, weeks, first_week FROM coverage_by_robot ORDER BY ALL"
    ).fetchall()
    assert [row[:2] for row in robots] == [row[:2] for row in totals]
    for robot, total in zip(robots, totals, strict=True):
        assert robot[2:-1] == pytest.approx(total[2:-1])
        assert robot[-1] == total[-1]
    assert {robot: weeks for robot, *_, weeks, _ in robots} == {"a": 2, "b": 1, None: 1}
    totals = "SELECT sum(primary_share) AS share, any_value(hours) AS hours FROM coverage_by_robot"
    shares = rows_of(fleet, f"{totals} GROUP BY robot")
    assert [row["share"] for row in shares] == pytest.approx([1.0, 1.0, 1.0])
    assert sum(row["hours"] for row in shares) == pytest.approx(
        rows_of(fleet, "SELECT count(*) * 0.2 / 3600 AS hours FROM transitions")[0]["hours"]
    )


def test_successes_count_episodes_with_condition(fleet):
    for row in rows_of(fleet, "FROM coverage_by_robot WHERE robot = 'a'"):
        (found,) = rows_of(
            fleet,
            "SELECT count(*) AS episodes, count(*) FILTER (success) AS successes FROM episodes"
            " SEMI JOIN (FROM held_conditions WHERE robot = 'a'"
            f" AND condition = '{row['condition']}') USING (episode_id)",
        )
        assert found["episodes"] == row["episodes_held"] == row["goal_episodes"]
        assert found["successes"] == row["successes"]
        assert row["success_share"] == pytest.approx(found["successes"] / found["episodes"])
