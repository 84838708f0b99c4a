"""A drive in two recordings is found by content, and never both trained on and held out."""

from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.panels import EVERY, NO_SPLIT, panel_of, planned
from support.paths import SHARED
from support.stores import TASK, recording_transitions, write_store

from restock.cli import main
from restock.errors import MixtureError
from restock.ingest.store.transitions import replaced
from restock.replay.store.same_drives import install_shared_rows
from restock.replay.store.store import Store
from restock.train.evaluation.ope_dataset import load_ope_dataset

NEATO = SHARED / "fleet-neato"


def copy_of(
    table: pa.Table, recording: int, *, later_ns: int = 0, jitter_ns: int = 0, first: int = 0
) -> pa.Table:
    """Return the same steps as another ingest would write them, from the row `first` on."""
    part = table.slice(first)
    rows, name = len(part), f"{recording:016x}"
    moved = np.random.default_rng(0).integers(-jitter_ns, jitter_ns + 1, rows) + later_ns
    values: dict[str, object] = {
        "recording_id": [name] * rows,
        "episode_id": [f"{name}/{index}" for index in part["episode_index"].to_pylist()],
        "transition_id": (np.int64(recording) << 25) + np.arange(rows),
        "ingest_id": [f"{name}-a"] * rows,
        "source_file": [f"logs/{recording}.mcap"] * rows,
        "stamp_ns": part["stamp_ns"].to_numpy() + moved,
    }
    return replaced(part, values)


@pytest.mark.long
@pytest.mark.skipif(not NEATO.is_dir(), reason="needs ../shared/bags/fleet-neato")
def test_drive_replayed_a_year_later_is_found(tmp_path, shell):
    profile, store = str(tmp_path / "neato.toml"), str(tmp_path / "store")
    (original,) = (NEATO / "2022-original").iterdir()
    assert main(["profile", "new", str(original), "--out", profile]) == 0
    folders = ["2022-original", "2023-replayed", "2024-danpark"]
    paths = [str(NEATO / folder) for folder in folders]
    assert main(["ingest", *paths, "--profile", profile, "--store", store]) in (0, 3)
    audits = {audit["audit"]: audit for audit in shell.json("audit", store, code=1)["audits"]}
    assert audits["repeated_steps"]["status"] == "fail"
    (found,) = audits["repeated_steps"]["sample"]
    names = {Path(str(found[name])).name for name in ("source_file", "same_as_file")}
    assert names == {"macfirst_floor_take_2", "mac_take_2_bag"}
    assert float(str(found["share"])) > 0.95


@pytest.mark.parametrize("later_s", [0, 33_194_320, -3600])
def test_copy_with_shifted_and_jittered_clock_is_found(tmp_path, later_s):
    drive = recording_transitions(1)
    copy = copy_of(drive, 5, later_ns=later_s * 10**9, jitter_ns=90_000_000, first=100)
    with Store(write_store(tmp_path / "store", [drive, copy])) as store:
        rows = store.sql("FROM repeated_rows(3)").fetchall()
    assert len(rows) == len(drive) - 100


def test_steps_at_other_clock_shifts_do_not_count(tmp_path):
    """Equal steps that are 1 s off the shift of the rest of the copy are a coincidence."""
    drive = recording_transitions(1)
    copy = copy_of(drive, 5)
    stamps = copy["stamp_ns"].to_numpy().copy()
    stamps[:40] += 10**9
    copy = replaced(copy, {"stamp_ns": stamps})
    with Store(write_store(tmp_path / "store", [drive, copy])) as store:
        assert len(store.sql("FROM repeated_rows(3)").fetchall()) == len(drive) - 40


def test_robots_standing_still_are_not_copies(tmp_path):
    def standing(recording: int) -> pa.Table:
        table, names = recording_transitions(recording), ("action", "pose_x_m", "pose_y_m")
        first = recording_transitions(1).select(["observation", *names]).to_pylist()[0]
        return replaced(table, {name: [value] * len(table) for name, value in first.items()})

    with Store(write_store(tmp_path / "store", [standing(1), standing(2)])) as store:
        assert store.sql("FROM repeated_rows(1)").fetchall() == []


def test_copies_of_evaluation_steps_are_left_out(tmp_path):
    drive, other = recording_transitions(1), recording_transitions(2)
    copy = copy_of(drive, 5, later_ns=10**15, jitter_ns=2000)
    store = write_store(tmp_path / "store", [drive, other, copy])
    panel = panel_of(store, EVERY + "[evaluation_split]\nshare = 0.2", tmp_path / "panel")
    kept = panel.meta
    held = pq.read_table(panel.path / "evaluation_split.parquet")
    held_steps, trained = (
        {divmod(number, 2**25) for number in table["transition_id"].to_pylist()}
        for table in (held, kept)
    )
    twins = {1: 5, 5: 1}
    shown = {(twins[number], step) for number, step in held_steps if number in twins} - held_steps
    assert shown
    assert not shown & trained
    assert panel.header.left_out["same steps as the evaluation split"] == len(shown)


def test_split_of_one_drive_stored_twice_is_refused():
    drive = recording_transitions(1)
    both = pa.concat_tables([drive, copy_of(drive, 5)])
    with pytest.raises(MixtureError, match="the same drive is in the store more than once"):
        planned(both, EVERY + "[evaluation_split]\nby = 'recording'\nshare = 0.4")


def test_copies_stay_without_evaluation_split():
    drive = recording_transitions(1)
    plan = planned(pa.concat_tables([drive, copy_of(drive, 5)]), EVERY + NO_SPLIT)
    assert len(plan.panel_rows) == 2 * len(drive)


def test_episodes_trained_under_other_id_are_not_held_out(tmp_path):
    drive, other = recording_transitions(1), recording_transitions(2)
    learnt = panel_of(write_store(tmp_path / "learnt", [drive]), EVERY + NO_SPLIT, tmp_path / "p")
    logs = write_store(tmp_path / "logs", [drive, other, copy_of(drive, 5, later_ns=10**12)])
    dataset = load_ope_dataset(learnt, TASK, str(logs))
    assert len(dataset.evaluation.rows) == len(other)
    assert f"{2 * len(drive['episode_id'].unique())} episodes left out" in dataset.notes[0]


def test_replaced_ingests_are_ignored():
    rows = pa.list_(pa.struct({"transition_id": pa.int64(), "content": pa.int64()}))
    lists = [
        [{"transition_id": 10 * place + n, "content": n} for n in (1, 2)] for place in (1, 2, 3)
    ]
    manifests = pa.table(
        {"ingest_id": ["a", "old", "b"], "distinctive_rows": pa.array(lists, rows)}
    )
    with duckdb.connect() as connection:
        current = {"a": "first", "b": "second"}
        install_shared_rows(connection, lambda _: [manifests.slice(1), manifests[:1]], current, 4)
        found = connection.sql("FROM shared_rows ORDER BY ALL").fetchall()
    assert found == [("first", 11, 1), ("first", 12, 2), ("second", 31, 1), ("second", 32, 2)]
