"""Check the run directory: readable at any moment, and protected from damage and reuse."""

from pathlib import Path

import numpy as np
import pytest

from restock.errors import RestockError, RunError
from restock.replay.places import open_place
from restock.train.run.run import Run, check_free
from restock.train.run.run_tables import EVAL_EPISODES, TABLES


def read_policies(run: Path) -> list[dict[str, object]]:
    return Run.open(run).table("policies").to_pylist()


def select_policies(run: Path) -> list[dict[str, object]]:
    with open_place(run) as connection:
        return connection.sql("FROM policies").to_arrow_table().to_pylist()


@pytest.mark.parametrize("read", [read_policies, select_policies])
def test_flipped_bit_in_table_is_reported(tmp_path, read):
    run = Run.create(tmp_path / "a", {})
    counts = {"gradient_steps": 0, "source": "logs", "behaviour_policy": "planner"}
    counts |= {"rows": np.arange(40) ** 2, "env_steps": np.arange(40)}
    run.append_columns("policies", counts)
    run.flush()
    file = run.path / "policies.parquet"
    whole, rows = file.read_bytes(), read(run.path)
    refused = []
    # DuckDB does not use the column names in the footer.
    end = len(whole) - (8 + int.from_bytes(whole[-8:-4], "little")) * (read is select_policies)
    for place in range(4, end, 13):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << place % 8
        file.write_bytes(flipped)
        try:
            assert read(run.path) == rows
        except RestockError as error:
            refused.append(str(error))
    assert len(refused) > 40
    assert all("policies.parquet" in message for message in refused)


def test_table_shorter_than_checkpoint_is_rejected(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "a", {})
    with pytest.raises(RunError, match=r"audit.parquet: has 0 rows, the checkpoint .* after 5"):
        run.truncate({"audit": 5})


def test_every_table_column_is_documented() -> None:
    for name, schema in {**TABLES, "eval_episodes": EVAL_EPISODES}.items():
        assert schema.metadata[b"doc"], name
        for field in schema:
            assert field.metadata[b"meaning"], f"{name}.{field.name}"


def test_existing_run_is_rejected_with_resume_hint(tmp_path: Path) -> None:
    Run.create(tmp_path / "a", {})
    with pytest.raises(RunError, match=r"already exists\n.*--resume"):
        Run.create(tmp_path / "a", {})
    Run.create(tmp_path / "a b", {})
    with pytest.raises(RunError, match=r"`restock train --resume '.*a b'`"):  # quoted, to be pasted
        Run.create(tmp_path / "a b", {})
    (tmp_path / "empty").mkdir()
    Run.create(tmp_path / "empty", {})  # an empty directory is free


def test_run_inside_other_artifacts_is_rejected(tmp_path: Path) -> None:
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


def test_invalid_run_directory_is_rejected(tmp_path: Path) -> None:
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
