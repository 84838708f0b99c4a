"""Arguments of another kind than a function takes: refused by name, before anything is written."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.paths import ROOT
from support.stores import one

import restock
from restock.errors import ArgumentError, ConfigError, QueryError
from restock.ingest import IngestJob, StoreWriter, ingest, ingest_all, load_profile, relabel_store
from restock.ingest.prepared import remove_recordings
from restock.replay import Store, build_panel, diff_stores, find_gaps, load_mixture, measure_drift
from restock.replay.fleet.panel_difference import diff_panels
from restock.train import compare, diagnose
from restock.twin import RecordingPlan

PROFILE = load_profile("warehouse_amr")
LOG = ROOT / "sample_logs" / "amr_tuesday"
ANY: Any = None  # what a type checker would refuse


@pytest.fixture
def store(tmp_path: Path) -> Path:
    StoreWriter(tmp_path / "store").write_all([one(1)])
    return tmp_path / "store"


def test_a_name_in_place_of_what_bears_it_is_refused_by_name(store: Path, tmp_path: Path) -> None:
    mixture, opened = load_mixture("coverage"), Store(store)
    calls: dict[str, Callable[[], object]] = {
        "profile must be a Profile, got 'warehouse_amr'": lambda: ingest(
            LOG, ANY or "warehouse_amr", store=None
        ),
        "store must be a StoreWriter, got 'store'": lambda: ingest(
            LOG, PROFILE, store=ANY or "store"
        ),
        "store must be a StoreWriter, got 'a'": lambda: remove_recordings(ANY or "a", ["x"]),
        "store must be a StoreWriter, got 'b'": lambda: relabel_store(
            ANY or "b", lambda name: PROFILE.definitions
        ),
        "transitions must be a Store or a table, got 'store'": lambda: build_panel(
            ANY or "store", mixture, tmp_path / "p"
        ),
        "transitions must be a Store or a table": lambda: build_panel(
            ANY or opened.sql("FROM transitions"), mixture, tmp_path / "p"
        ),
        "mixture must be a Mixture, got 'coverage'": lambda: build_panel(
            opened, ANY or "coverage", tmp_path / "p"
        ),
        "mixture must be a Mixture, got 'steps'": lambda: find_gaps(
            opened, ANY or "steps", name="steps"
        ),
        "store must be a Store, got 'c'": lambda: measure_drift(ANY or "c"),
        "first must be a Store, got 'd'": lambda: diff_stores(ANY or "d", opened),
        "second must be a Store, got 'e'": lambda: diff_stores(opened, ANY or "e"),
        "first must be a Panel, got 'f'": lambda: diff_panels(ANY or "f", ANY or "g"),
        "a run must be a Run, got 'runs/a'": lambda: diagnose([ANY or "runs/a"]),
        "first must be a list of runs, got 'runs/b'": lambda: compare("runs/b", "runs/c"),
        "a store's place must be a str or Path, got <": lambda: StoreWriter(
            ANY or StoreWriter(store)
        ),
        "a store's place must be a str or Path, got None": lambda: restock.open(ANY),
        "tags must be a Mapping": lambda: ingest(
            LOG, PROFILE, store=None, tags=ANY or ["robot=amr-07"]
        ),
        "the tag robot must be a str, got 7": lambda: ingest(
            LOG, PROFILE, store=None, tags={"robot": ANY or 7}
        ),
    }
    for says, call in calls.items():
        with pytest.raises(ArgumentError) as refused:
            call()
        assert refused.value.what.startswith(says)
        assert refused.value.remedy
        assert isinstance(refused.value, TypeError)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["store"]


def test_a_store_that_another_thread_reads_from_says_so(store: Path) -> None:
    opened, reading, go_on = Store(store), threading.Event(), threading.Event()

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


def test_a_job_of_many_recordings_says_it_of_each(tmp_path: Path) -> None:
    for job, says in (
        (IngestJob(ANY or "warehouse_amr", None), "profile must be a Profile"),
        (IngestJob(PROFILE, None, repeated=ANY or "refused"), "no rule for repeated: 'refused'"),
    ):
        ((_, error),) = ingest_all([LOG], job)
        assert isinstance(error, ConfigError)
        assert error.what.startswith(says)
    with pytest.raises(ArgumentError, match="a store's place must be a str or Path"):
        list(ingest_all([LOG], IngestJob(PROFILE, ANY or StoreWriter(tmp_path / "s"))))
    assert not list(tmp_path.iterdir())


def test_a_word_that_is_no_choice_is_refused() -> None:
    with pytest.raises(ConfigError, match="'Refuse'\n  give keep, refuse"):
        ingest(LOG, PROFILE, store=None, repeated=ANY or "Refuse")
    with pytest.raises(ConfigError, match="no format 'bag'\n  give mcap, rosbag2"):
        RecordingPlan(format=ANY or "bag", missions=1)
