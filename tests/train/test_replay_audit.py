"""Read the replay audit record of a run in Python and in SQL."""

import json
from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.shell import Shell
from support.stores import recording_transitions, write_store
from support.toy_run import config, logs, run_to_end
from support.toy_twin import TASK

from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import Task
from restock.replay.store.store import Store
from restock.train import replay_audit
from restock.train.run.replay_audit import ReplayAuditRecord

FIELDS = (
    *("transition_id", "age_steps", "age_days", "condition"),
    *("behavior_policy", "action", "reward", "target_sync_step", "gradient_step"),
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "a"
    run_to_end(path, config(schedule={"env_steps": 800}))
    document = json.loads((path / "config.json").read_text("utf-8"))
    named = document | {"actions": TASK.action_names}
    (path / "config.json").write_text(json.dumps(named), "utf-8")
    return path


def test_every_audited_row_is_a_record(run: Path) -> None:
    records = replay_audit(run)
    audit = pq.read_table(run / "audit.parquet").sort_by(
        [("gradient_step", "ascending"), ("batch_row", "ascending")]
    )
    assert ReplayAuditRecord.__struct_fields__ == FIELDS
    assert records.to_arrow().column_names == list(FIELDS)
    assert len(records) == len(audit) == len(list(records)) > 500
    assert records[3:5][1] == records[4] == list(records)[4]
    assert records[-1] == list(records)[-1]
    with pytest.raises(IndexError):
        records[len(records)]
    for record, row in zip(records, audit.to_pylist(), strict=True):
        assert record.condition == row["condition"]
        assert record.behavior_policy == row["behaviour_policy"]
        assert record.action == TASK.action_names[row["action"]]
        assert record.reward == row["reward"]
        assert record.target_sync_step == row["last_target_sync"]
        assert (record.gradient_step, record.age_steps) == (
            row["gradient_step"],
            row["age_gradient_steps"],
        )
        assert (record.age_days is None) == (row["source"] == "fresh")


def test_record_dates_rows_against_last_sync(tmp_path, shell):
    hard = {"rule": "hard", "every": 30}
    path = tmp_path / "hard"
    run_to_end(path, config(schedule={"env_steps": 800}, target=hard))
    before = "gradient_step - age_steps < target_sync_step"
    query = f"SELECT source, {before} AS before, count(*) AS n FROM replay_audit GROUP BY ALL"
    found = shell.json("sql", path, query)
    assert {(row["source"], row["before"]) for row in found} == {
        *(("logs", before) for before in (True, False)),  # before the first sync, no row is older
        *(("fresh", before) for before in (True, False)),
    }
    for row in pq.read_table(path / "audit.parquet").to_pylist():
        assert row["last_target_sync"] == (row["gradient_step"] - 1) // 30 * 30
        if row["source"] == "fresh":  # the version of the acting policy is its update count
            acted = row["gradient_step"] - row["age_gradient_steps"]
            assert int(row["behaviour_version"]) == acted
    records = replay_audit(path)
    by_record = sum(
        record.gradient_step - record.age_steps < record.target_sync_step for record in records
    )
    assert by_record == sum(row["n"] for row in found if row["before"])


def test_fresh_rows_have_unique_negative_ids(run: Path) -> None:
    audit = pq.read_table(run / "audit.parquet").sort_by(
        [("gradient_step", "ascending"), ("batch_row", "ascending")]
    )
    fresh, known = {}, set(logs().transition_id.tolist())
    for record, row in zip(replay_audit(run), audit.to_pylist(), strict=True):
        if row["source"] == "logs":
            assert record.transition_id in known
        else:
            assert record.transition_id < 0
            key = row["episode"], row["episode_step"]
            assert fresh.setdefault(record.transition_id, key) == key
    assert len(fresh) == len(set(fresh.values())) > 100


def test_sql_view_equals_python_records(run: Path, shell: Shell) -> None:
    query = f"SELECT {', '.join(FIELDS)} FROM replay_audit LIMIT 40"
    shown = shell.json("sql", run, query)
    assert [ReplayAuditRecord(**row) for row in shown] == list(replay_audit(run)[:40])
    of_view = "SELECT column_name, meaning FROM columns WHERE view = 'replay_audit'"
    assert all(row["meaning"] for row in shell.json("sql", run, of_view))


@pytest.mark.parametrize(
    "actions",
    [load_profile("warehouse_amr").task.actions, ((0.0, 0.0), (-0.125, 0.3456), (12.0, -1 / 3))],
)
def test_store_and_run_name_actions_alike(tmp_path, actions):
    task = Task(body=load_profile("warehouse_amr").task.body, actions=actions)
    with Store(write_store(tmp_path / "store", [recording_transitions(1)])) as store:
        text = store.connection.sql("SELECT sql FROM duckdb_views() WHERE view_name = 'actions'")
        ((view,),) = text.fetchall()
    with duckdb.connect() as connection:
        commands = json.dumps({"actions": [list(action) for action in actions]})
        connection.register("recordings", pa.table({"task_hash": ["t"], "task_json": [commands]}))
        connection.execute(view)
        names = connection.sql("SELECT name FROM actions ORDER BY action").fetchall()
    assert [name for (name,) in names] == task.action_names
