"""Ingest on a Ray cluster, started on this machine: the same results and the same errors."""

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.driven_robot import write_bags
from support.paths import ROOT

from restock.errors import ConfigError
from restock.ingest.batch import IngestJob, ingest_all, prepare_on_ray
from restock.ingest.profile.profile import load_profile
from restock.replay.store.store import Store

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags")
    write_bags(folder, 3)
    (folder / "cut.mcap").write_bytes(b"")
    return folder


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """One cluster for all tests: most of the time goes into starting it."""
    ray = pytest.importorskip("ray")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT / "tests"), *sys.path]))
        ray.init(address="local", num_cpus=2, include_dashboard=False, logging_level="error")
        yield
        ray.shutdown()


class _Broken(IngestJob):
    def prepare(self, path):
        if path.name == "drive1":
            os.kill(os.getpid(), signal.SIGKILL)
        return super().prepare(path)


def table(store: Path):
    with Store(store) as opened:
        return opened.sql(
            "SELECT * EXCLUDE (ingest_id) FROM transitions ORDER BY transition_id"
        ).to_arrow_table()


@pytest.mark.long
def test_the_store_and_the_answers_are_those_of_one_process(bags, tmp_path, cluster, monkeypatch):
    monkeypatch.chdir(bags)
    paths = [Path("drive0"), Path("cut.mcap"), Path("drive1"), Path("drive2")]
    found = {}
    for engine in ("processes", "ray"):
        job = IngestJob(load_profile("warehouse_amr"), tmp_path / engine)
        found[engine] = list(ingest_all(paths, job, engine=engine))
    for (path, ours), (same, theirs) in zip(*found.values(), strict=True):
        assert path == same
        if path.name == "cut.mcap":
            assert str(ours) == str(theirs)
        else:
            assert ours.status == theirs.status == "written"
            assert ours.conditions == theirs.conditions
    assert table(tmp_path / "processes").equals(table(tmp_path / "ray"))


@pytest.mark.long  # test_workers has that of processes
def test_a_task_that_dies_costs_its_recording_only(bags, tmp_path, cluster):
    job = _Broken(load_profile("warehouse_amr"), tmp_path / "s")
    results = dict(ingest_all([bags / f"drive{number}" for number in range(3)], job, engine="ray"))
    assert "the process that read it died" in str(results.pop(bags / "drive1"))
    assert {result.status for result in results.values()} == {"written"}


def test_without_ray_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"pip install .*\[ray\]'"):
        list(prepare_on_ray(IngestJob(load_profile("warehouse_amr"), None), [Path("x.mcap")]))


def test_a_cluster_that_is_not_there_is_said_so(monkeypatch):
    ray = pytest.importorskip("ray")
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(ConfigError, match=r"no Ray cluster at 127\.0\.0\.1:1: .*refused"):
        list(prepare_on_ray(IngestJob(load_profile("warehouse_amr"), None), [Path("x.mcap")]))
