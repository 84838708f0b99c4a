"""The run directory: readable at any moment, never half-written, continued where it was."""

import json
from pathlib import Path

import duckdb
import numpy as np
import pyarrow.parquet as pq
import pytest

from restock.errors import RestockError, RunError
from restock.replay.places import open_place
from restock.train.run.run import Run, check_free
from restock.train.run.run_tables import EVAL_EPISODES, TABLES


def policies(step: int, rows: int) -> dict[str, object]:
    return {
        "env_steps": step,
        "gradient_steps": 0,
        "source": "logs",
        "behaviour_policy": "planner",
        "rows": rows,
    }


def test_a_new_run_has_every_table_before_any_row(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "a", {"seed": 3})
    assert json.loads((run.path / "config.json").read_text())["seed"] == 3
    for name, schema in TABLES.items():
        assert pq.read_schema(run.path / f"{name}.parquet").names == schema.names
    assert not [item for item in run.path.iterdir() if item.name.startswith(".")]


def test_rows_are_readable_by_others_after_a_flush(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "a", {})
    run.append("policies", [policies(1, 10), policies(2, 20)])
    run.append_columns(
        "policies",
        {**policies(3, 0), "rows": np.array([30, 40]), "behaviour_policy": ["planner", None]},
    )
    run.flush()
    total = duckdb.sql(f"SELECT sum(rows) FROM '{run.path}/policies.parquet'").fetchall()
    assert total == [(100,)]


def read_policies(run: Path) -> list[dict[str, object]]:
    return Run.open(run).table("policies").to_pylist()


def select_policies(run: Path) -> list[dict[str, object]]:
    with open_place(run) as connection:
        return connection.sql("FROM policies").to_arrow_table().to_pylist()


@pytest.mark.parametrize("read", [read_policies, select_policies])
def test_no_flipped_bit_of_a_table_is_read_in_silence(tmp_path, read):
    run = Run.create(tmp_path / "a", {})
    counts = {**policies(0, 0), "rows": np.arange(40) ** 2, "env_steps": np.arange(40)}
    run.append_columns("policies", counts)
    run.flush()
    file = run.path / "policies.parquet"
    whole, rows = file.read_bytes(), read(run.path)
    refused = []
    # DuckDB is not given the names of the columns, which stand in the footer.
    end = len(whole) - (8 + int.from_bytes(whole[-8:-4], "little")) * (read is select_policies)
    for place in range(4, end, 7):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << place % 8
        file.write_bytes(flipped)
        try:
            assert read(run.path) == rows
        except RestockError as error:
            refused.append(str(error))
    assert len(refused) > 40
    assert all("policies.parquet" in said for said in refused)


def test_reopening_truncates_to_the_checkpoint(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "a", {})
    run.append("policies", [policies(1, 10)])
    counts = run.row_counts()
    run.append("policies", [policies(2, 20)])
    run.flush()  # and here the run is killed

    again = Run.open(tmp_path / "a")
    again.truncate(counts)
    again.append("policies", [policies(2, 21)])
    again.flush()
    assert pq.read_table(run.path / "policies.parquet")["rows"].to_pylist() == [10, 21]


def test_a_table_shorter_than_the_checkpoint_is_an_error(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "a", {})
    with pytest.raises(RunError, match=r"audit.parquet: has 0 rows, the checkpoint .* after 5"):
        run.truncate({"audit": 5})


def test_every_column_of_every_table_is_documented() -> None:
    for name, schema in {**TABLES, "eval_episodes": EVAL_EPISODES}.items():
        assert schema.metadata[b"doc"], name
        for field in schema:
            assert field.metadata[b"meaning"], f"{name}.{field.name}"


def test_an_existing_directory_is_refused_with_a_remedy(tmp_path: Path) -> None:
    Run.create(tmp_path / "a", {})
    with pytest.raises(RunError, match=r"already exists\n.*--resume"):
        Run.create(tmp_path / "a", {})
    Run.create(tmp_path / "a b", {})
    with pytest.raises(RunError, match=r"`restock train --resume '.*a b'`"):  # to be pasted
        Run.create(tmp_path / "a b", {})
    (tmp_path / "empty").mkdir()
    Run.create(tmp_path / "empty", {})  # an empty directory is free


def test_a_place_where_no_run_can_be_made_or_stay_is_refused(tmp_path: Path) -> None:
    Run.create(tmp_path / "a", {})
    (tmp_path / "panel").mkdir()
    (tmp_path / "panel" / "panel.json").touch()
    (tmp_path / "store" / "transitions" / "_delta_log").mkdir(parents=True)
    (tmp_path / "file").touch()
    for within, why in {
        "a/eval/b": "is within the run",
        "panel/b": "is within the panel",
        "store/b": "is within the store",
        "file/b": "file is a file",
        "caf\udce9/b": "not UTF-8",
    }.items():
        with pytest.raises(RunError, match=why):
            check_free(tmp_path / within)
        assert not (tmp_path / within).exists()
    check_free(tmp_path / "new" / "b")


def test_a_directory_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"no config\.json"):
        Run.open(tmp_path)
    (tmp_path / "config.json").write_text('{"format": "restock-run/999"}')
    with pytest.raises(RunError, match="restock-run/999"):
        Run.open(tmp_path)
    (tmp_path / "config.json").write_text('{"format": "restock-run/1"}')
    with pytest.raises(RunError, match=r"by an earlier Restock .*\n.*train again with"):
        Run.open(tmp_path)
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(RunError, match="cannot be read"):
        Run.open(tmp_path)
