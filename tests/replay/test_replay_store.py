"""The store's views: their counts, the rows they hide, and the documentation of every column."""

import gc
import json
import re
import threading
import weakref
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pytest
from deltalake import write_deltalake
from support.stores import TASK, manifest, one, recording_transitions, write_store

from restock.cli import main
from restock.errors import QueryError, StoreError
from restock.ingest.profile.tag_rules import NAMED
from restock.ingest.store.transitions import replaced
from restock.ingest.store.version import FORMAT
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.task import Task
from restock.replay.store.definitions import column_docs, view_docs
from restock.replay.store.store import Store, is_store


@pytest.fixture(scope="module")
def store(store_path) -> Store:
    return Store(store_path)


def rows(store: Store, query: str) -> list[dict[str, object]]:
    found: list[dict[str, object]] = store.sql(query).to_arrow_table().to_pylist()
    return found


def test_transitions_view_returns_written_rows(store, transitions):
    read = store.sql("FROM transitions ORDER BY transition_id").to_arrow_table()
    expected = transitions.sort_by("transition_id")
    expected = expected.rename_columns({"condition": "primary_condition"})
    expected = expected.drop_columns("logged_ns")  # null: by the manifest's offset
    added = ["logged_ns", "stamp_time", "logged_time", "pose_stamp_time", *NAMED, "tags"]
    assert read.column_names == [*expected.column_names, *added]
    for name in expected.column_names:
        assert read[name].to_pylist() == expected[name].to_pylist(), name
    assert pa.types.is_fixed_size_list(read.schema.field("observation").type)
    assert store.version == 2
    assert store.task() == TASK


@pytest.mark.parametrize("attached", [False, True])
def test_joins_do_not_hold_transitions_in_memory(store, attached):
    def held(node: dict[str, Any]) -> list[str]:
        """Return the right sides of a plan's hash joins, which are held in memory."""
        of_join = [str(node["children"][1])] if node["name"] == "HASH_JOIN" else []
        return of_join + [text for child in node["children"] for text in held(child)]

    other = duckdb.connect()
    store.attach(other, "a")
    where, ask = ("a.", other.sql) if attached else ("", store.sql)
    for query in (
        f"SELECT sum(reward) FROM {where}transitions",
        f"SELECT * FROM {where}transitions"
        f" WHERE recording_id IN (SELECT recording_id FROM {where}recordings)",
    ):
        [(_, plan)] = ask(f"EXPLAIN (FORMAT JSON) {query}").fetchall()
        joins = held(json.loads(plan)[0])
        assert joins, query
        assert not any("transitions" in text or "reward" in text for text in joins), query


def test_ingest_without_transitions_is_hidden(tmp_path):
    path = write_store(tmp_path / "Läger 7 (neu)" / "my store", [recording_transitions(1)])
    write_deltalake(str(path / "recordings"), manifest(recording_transitions(2)), mode="append")
    with Store(path) as store:
        assert store.sql("SELECT DISTINCT recording_id FROM recordings").fetchall() == [
            (f"{1:016x}",)
        ]


@pytest.mark.parametrize(
    ("found", "command"),
    [(None, "sql"), ("restock-store/1", "audit"), ("restock-store/99", "store compact")],
)
def test_store_of_other_format_is_refused(tmp_path, monkeypatch, shell, found, command):
    monkeypatch.setattr("support.stores.FORMAT", found)
    path = write_store(tmp_path / "store", [recording_transitions(1)])
    query = ["FROM recordings"] if command == "sql" else []
    err = shell.err(*command.split(), path, *query)
    assert str(path) in err
    assert "restock ingest RECORDINGS --store NEW" in err


def test_new_columns_are_null_in_older_rows(tmp_path):
    path = write_store(tmp_path / "store", [recording_transitions(1)])
    newer = recording_transitions(2)
    newer = newer.append_column("payload_kg", pa.array(np.full(len(newer), 3.0)))
    write_deltalake(str(path / "recordings"), manifest(newer), mode="append")
    write_deltalake(str(path / "transitions"), newer, mode="append", schema_mode="merge")
    with Store(path) as store:
        found = store.sql(
            "SELECT recording_id, any_value(payload_kg) FROM transitions GROUP BY ALL ORDER BY ALL"
        ).fetchall()
    assert found == [(f"{1:016x}", None), (f"{2:016x}", 3.0)]


def test_episodes_match_naive_computation(store, transitions):
    by_episode: dict[str, list[dict[str, object]]] = {}
    for row in transitions.to_pylist():
        by_episode.setdefault(row["episode_id"], []).append(row)
    found = rows(store, "FROM episodes")
    assert len(found) == len(by_episode)
    for episode in found:
        steps = by_episode[str(episode["episode_id"])]
        assert episode["steps"] == len(steps)
        assert episode["missing_steps"] == 0
        assert episode["return"] == pytest.approx(sum(s["reward"] for s in steps), abs=1e-4)
        assert episode["duration_s"] == pytest.approx(0.2 * (len(steps) - 1))
        assert episode["ended"] == ("terminated" if steps[-1]["terminated"] else "truncated")
        reached = steps[-1]["terminated"] and steps[-1]["reward"] > TASK.rewards.goal / 2
        assert episode["goal_source"] == "logged"
        assert episode["success"] == reached
        assert episode["conditions"] == sorted({c for s in steps for c in s["conditions"]})
        assert episode["bumped_steps"] == sum(s["bumped"] for s in steps)
        assert episode["handovers"] == 0


def test_handovers_and_missing_steps_are_counted(tmp_path):
    table = recording_transitions(1, episodes=1)
    policy = np.where(np.arange(len(table)) < 5, "planner", "operator")
    table = replaced(table, {"behaviour_policy": policy.tolist()})
    table = pa.concat_tables([table.slice(0, 3), table.slice(4)])
    with Store(write_store(tmp_path / "s", [table])) as store:
        (episode,) = rows(store, "FROM episodes")
    assert episode["handovers"] == 1
    assert episode["missing_steps"] == 1
    assert episode["first_policy"] == "planner"


def test_success_is_null_without_goal(tmp_path):
    task = Task(body=TASK.body, actions=TASK.actions, sectors=4, goal="none")
    path = write_store(tmp_path / "s", [recording_transitions(1, task=task)], task=task)
    with Store(path) as store:
        assert store.sql("SELECT DISTINCT success FROM episodes").fetchall() == [(None,)]
        assert store.sql("SELECT DISTINCT success_share FROM coverage").fetchall() == [(None,)]


def test_coverage_counts_each_row_once(store, transitions):
    found = rows(store, "FROM coverage")
    assert sum(row["primary_rows"] for row in found) == len(transitions)  # type: ignore[misc]
    assert sum(row["primary_share"] for row in found) == pytest.approx(1)  # type: ignore[misc]


def test_unseen_condition_has_line_and_empty_cells(tmp_path):
    table = recording_transitions(1)
    keep = [
        "wheel_slip" not in held and not ("recovery" in held and action == 2)
        for held, action in zip(
            table["conditions"].to_pylist(), table["action"].to_pylist(), strict=True
        )
    ]
    with Store(write_store(tmp_path / "s", [table.filter(pa.array(keep))])) as store:
        (slip,) = rows(store, "FROM coverage_by_condition WHERE condition = 'wheel_slip'")
        assert (slip["primary_rows"], slip["behaviour_policies"]) == (0, [])
        assert (slip["rows_held"], slip["episodes_held"]) == (0, 0)
        missing = {(row["condition"], row["action"]) for row in rows(store, "FROM missing_cells")}
        assert {("wheel_slip", action) for action in range(5)} | {("recovery", 2)} <= missing
        assert rows(store, "FROM cells_below(1)") == [
            row | {"rows": 0} for row in rows(store, "FROM missing_cells")
        ]


def test_row_counts_for_each_of_its_conditions(store, transitions):
    held = [conditions or ["nominal"] for conditions in transitions["conditions"].to_pylist()]
    lines = rows(store, "FROM coverage_by_condition")
    assert {line["condition"]: line["rows_held"] for line in lines} == {
        line["condition"]: sum(line["condition"] in names for names in held) for line in lines
    }
    assert any(line["rows_held"] > line["primary_rows"] for line in lines)
    names = transitions["condition"].to_pylist()
    assert all(line["primary_rows"] == names.count(line["condition"]) for line in lines)
    assert all(1 <= line["effective_episodes"] <= line["episodes_held"] for line in lines)
    rewards = transitions["reward"].to_pylist()
    for line in lines:
        name = line["condition"]
        mine = [r for r, names in zip(rewards, held, strict=True) if name in names]
        assert line["reward_mean"] == pytest.approx(sum(mine) / len(mine), abs=1e-6)
        assert line["held_share"] == pytest.approx(len(mine) / len(held))
        for question in (
            f"FROM held_conditions WHERE condition = '{name}'",
            f"FROM coverage SELECT * WHERE condition = '{name}'",
            f"FROM reward_mix WHERE condition = '{name}'",
            f"FROM ages WHERE condition = '{name}'",
        ):
            found = rows(store, question)
            assert sum(row.get("rows_held", 1) for row in found) == len(mine), question


def test_filter_by_condition_is_refused(store):
    for text in (
        "SELECT median(reward) FROM transitions WHERE condition = 'wheel_slip'",
        "SELECT t.condition, count(*) FROM transitions AS t GROUP BY ALL",
    ):
        with pytest.raises(QueryError) as refused:
            store.sql(text)
        (question,) = re.findall(
            r"`(FROM held_conditions WHERE condition = '…')`", str(refused.value)
        )
        assert store.sql(question.replace("…", "wheel_slip")).fetchall()
        assert "`primary_condition`" in str(refused.value)


def test_actions_are_named_unless_tasks_differ(store, tmp_path):
    for view in ("coverage", "cells_below(10000)"):
        named = store.sql(f"SELECT DISTINCT action, action_name FROM {view} ORDER BY 1").fetchall()
        assert dict(named).items() <= dict(enumerate(TASK.action_names)).items()
        assert len(named) > 1
    other = Task(body=TASK.body, actions=(TASK.actions[0], *reversed(TASK.actions[1:])), sectors=4)
    path = write_store(tmp_path / "s", [recording_transitions(1)])
    write_store(path, [recording_transitions(2, task=other)], task=other)
    question = "SELECT DISTINCT action_name FROM coverage WHERE action = 1"
    with Store(path) as of_two:
        assert of_two.sql(question).fetchall() == [(None,)]


def test_label_overlap_counts_both_directions(store, transitions):
    held = [set(conditions) for conditions in transitions["conditions"].to_pylist()]
    for row in rows(store, "FROM label_overlap"):
        both = sum({row["condition"], row["other"]} <= names for names in held)
        one = sum(row["condition"] in names for names in held)
        assert row["rows"] == both
        assert row["share"] == pytest.approx(both / one)


def test_near_duplicates_are_found(tmp_path):
    table = recording_transitions(1)
    observation = table["observation"].to_pylist()
    observation[9] = [value + 1e-7 for value in observation[4]]
    action = table["action"].to_pylist()
    action[9] = action[4]
    table = replaced(table, {"observation": observation, "action": action})
    with Store(write_store(tmp_path / "s", [table])) as store:
        found = rows(store, "FROM near_duplicates(4)")
    assert [row["copies"] for row in found] == [2]
    assert found[0]["transition_id"] == (1 << 25) + 4


def test_ages_at_given_time(store, transitions):
    newest = max(transitions["stamp_ns"].to_pylist())
    day = "make_timestamp_ns(" + str(newest + 3 * 86400 * 10**9) + ")"
    ages = rows(store, f"FROM ages_at({day})")
    assert min(row["age_min_days"] for row in ages) == pytest.approx(3, abs=1e-3)  # type: ignore[type-var]


def test_ages_use_log_time_for_simulated_stamps(tmp_path):
    simulated = np.arange(len(recording_transitions(1))) * 200_000_000
    table = replaced(recording_transitions(1), {"stamp_ns": simulated})
    row = replaced(manifest(table), {"clock_offset_ns": [1_700_000_000 * 10**9]})
    write_deltalake(str(tmp_path / "recordings"), row, description=FORMAT)
    write_deltalake(str(tmp_path / "transitions"), table, description=FORMAT)
    with Store(tmp_path) as store:
        ((oldest,),) = store.sql("SELECT min(oldest)::VARCHAR FROM ages").fetchall()
    assert oldest == "2023-11-14 22:13:20"


def test_every_view_column_is_documented(store):
    undocumented = rows(store, "FROM columns WHERE meaning IS NULL OR meaning = ''")
    assert undocumented == []
    views = {
        name
        for (name,) in store.sql(
            "SELECT view_name FROM duckdb_views() WHERE NOT internal"
        ).fetchall()
    } - {f"stored_{name}" for name in ("transitions", "recordings", "ingests", "frames")}
    assert views == set(view_docs())
    there = {(row["view"], row["column_name"]) for row in rows(store, "FROM columns")}
    assert {key for key in column_docs() if key[0] != "shared"} <= there


def test_queries_are_read_only(store, tmp_path):
    for text in (
        f"COPY transitions TO '{tmp_path}/out.parquet'",
        f"ATTACH '{tmp_path}/other.db'",
        f"EXPORT DATABASE '{tmp_path}/out'",
        "INSTALL httpfs",
        f"COPY (PIVOT transitions ON zone) TO '{tmp_path}/out.csv'",
        "DROP VIEW transitions",
        "DROP VIEW IF EXISTS drops; FROM drops",
        f"EXPLAIN ANALYZE COPY (SELECT 1) TO '{tmp_path}/out.csv'",
        f"/* */ explain -- \n ANALYZE /* ( */ COPY (SELECT 1) TO '{tmp_path}/out.csv'; SELECT 1",
        f"EXPLAIN (ANALYZE) COPY (SELECT 1) TO '{tmp_path}/out.csv'",
        f"EXPLAIN (ANALYZE /* ) */) COPY (SELECT 1) TO '{tmp_path}/out.csv'",
        "EXPLAIN ANALYZE CREATE TABLE x AS SELECT 1",
    ):
        with pytest.raises(QueryError, match="read-only"):
            store.sql(text)
    assert list(tmp_path.iterdir()) == []
    for text in (
        "FROM drops",
        "-- (\nEXPLAIN (FORMAT json) SELECT 1",
        "explain ANALYZE (SELECT 1)",
    ):
        assert store.sql(text).columns


def test_last_statement_must_give_rows(store_path, shell):
    for text in (
        "CREATE TABLE mine AS SELECT 1",
        "SET threads = 1",
        "SELECT 1; SET VARIABLE x = 2",
    ):
        out, err = shell.printed("sql", store_path, text, code=2)
        assert not out
        assert "the last statement gives no rows" in err
    assert main(["sql", str(store_path), "CREATE MACRO more(x) AS x + 1; SELECT more(1) AS n"]) == 0


def test_episode_kind_of_two_equal_conditions(tmp_path):
    steps = recording_transitions(1)
    both = pa.array([["wheel_slip", "near_collision"]] * len(steps), pa.list_(pa.string()))
    steps = replaced(steps, {"conditions": both})
    with Store(write_store(tmp_path / "store", [steps])) as store:
        kinds = store.sql("SELECT DISTINCT kind FROM episode_kinds(3)").fetchall()
    assert kinds == [("near_collision",)]


@pytest.mark.parametrize("before", ["", "SELECT 1; "])
def test_comma_joins_are_not_cross_products(store_path, before):
    text = f"""
        {before}SELECT count(*) FROM transitions AS t, recordings AS r, episodes AS e
        WHERE t.episode_id = e.episode_id AND e.recording_id = r.recording_id
    """
    with Store(store_path) as store:
        plan = store.sql(text).explain()
        assert "HASH_JOIN" in plan.upper().replace(" ", "_")
        assert "CROSS_PRODUCT" not in plan.upper().replace(" ", "_")
        every = store.sql("SELECT count(*) FROM transitions").fetchall()
        assert store.sql(text).fetchall() == every


def test_pivot_takes_columns_from_data(store):
    found = store.sql(
        "PIVOT (SELECT zone, primary_condition FROM transitions) ON primary_condition"
    )
    held = store.sql("SELECT DISTINCT primary_condition FROM transitions ORDER BY ALL").fetchall()
    assert found.columns == ["zone", *(name for (name,) in held)]
    total = store.sql(f"SELECT sum(nominal) FROM ({found.sql_query()})").fetchall()
    assert (
        total
        == store.sql(
            "SELECT count(*) FROM transitions WHERE primary_condition = 'nominal'"
        ).fetchall()
    )


def test_places_other_than_stores_are_refused(tmp_path):
    write_store(tmp_path / "s", [recording_transitions(1)])
    assert is_store(tmp_path / "s")
    for folder, file in (("empty", None), ("panel", "panel.json"), ("run", "config.json")):
        (tmp_path / folder).mkdir()
        if file:
            (tmp_path / folder / file).write_text("{}")
    assert not is_store(tmp_path / "empty")
    for place, problem in (
        ("empty", "not a store"),
        ("x", "no such store"),
        ("panel", "is a panel"),
        ("run", "is the folder of a run"),
        ("run/config.json", "is a file"),
        ("s@3", "has no version 3"),
    ):
        with pytest.raises(StoreError, match=problem) as refused:
            Store(tmp_path / place)
        assert str(refused.value.where) == str(tmp_path / place).removesuffix("@3")


@pytest.mark.parametrize("limit", ["lots", "5", "0 kib", "0%", "-1", "none"])
def test_invalid_memory_limit_is_refused(store_path, limit):
    with pytest.raises(StoreError, match="4GB"):
        Store(store_path, memory_limit=limit)


@pytest.mark.parametrize(("limit", "kept"), [("300MB", "286"), ("0.5 GB", "476"), ("2 GiB", "2.0")])
def test_memory_limit_is_applied(store_path, limit, kept):
    with Store(store_path, memory_limit=limit) as store:
        ((held,),) = store.sql("SELECT current_setting('memory_limit')").fetchall()
    assert held.startswith(kept)  # MiB, GiB


@pytest.mark.parametrize("closed", [True, False])
def test_store_is_freed(tmp_path, closed):
    StoreWriter(tmp_path / "s").write(*one(1))
    store = Store(tmp_path / "s")
    store.sql("SHOW TABLES").fetchall()  # makes every view, macro and function
    if closed:
        store.close()
    references = [weakref.ref(store), weakref.ref(store.bare)]
    del store
    gc.collect()
    assert [reference() for reference in references] == [None, None]


def test_store_in_use_by_other_thread_is_refused(store_path):
    opened, reading, go_on = Store(store_path), threading.Event(), threading.Event()

    def wait(value: int) -> int:
        reading.set()
        go_on.wait(60)
        return value

    opened.connection.create_function("wait_for", wait, ["INTEGER"], "INTEGER")
    answer = opened.sql("SELECT wait_for(7)")
    other = threading.Thread(target=lambda: answer.fetchall())
    other.start()
    try:
        assert reading.wait(60)
        with pytest.raises(QueryError, match="another thread is reading from it"):
            opened.sql("SELECT avg(reward) FROM transitions")
    finally:
        go_on.set()
        other.join()
    assert len(opened.sql("SELECT avg(reward) FROM transitions").fetchall()) == 1
