"""Time travel: verbs read a store as it was at a version or a time."""

from pathlib import Path

import pyarrow.parquet as pq
import pytest
from support.stores import one

import restock
from restock.cli import main
from restock.errors import StoreError
from restock.ingest.store.lineage import _read
from restock.ingest.store.writer import StoreWriter, compact
from restock.replay.store.store import Store


@pytest.fixture(scope="module")
def versions(tmp_path_factory) -> tuple[Path, int]:
    """Return a store of two recordings, and the version that had one."""
    path = tmp_path_factory.mktemp("versions") / "store"
    writer = StoreWriter(path)
    first = writer.write(*one(1))
    writer.write(*one(2))
    return path, first


def test_verbs_read_older_version(versions, tmp_path, shell):
    path, first = versions
    store = f"{path}@{first}"
    rows = one(1)[1]
    assert shell.json("sql", store, "SELECT count(*) AS n FROM transitions") == [{"n": len(rows)}]
    plan = shell.json("mix", store, "--mixture", "uniform", "--dry-run")
    assert isinstance(plan, dict)
    assert plan["store_version"] == first
    gaps = shell.json("coverage", "gaps", store, "--mixture", "uniform")
    assert isinstance(gaps, dict)
    assert (gaps["store_version"], gaps["episodes"]) == (first, 12)
    out = tmp_path / "rows.parquet"
    shell.json("export", store, "--to", "parquet", "--out", str(out))
    assert pq.read_metadata(out).num_rows <= len(rows)
    identity = rows["transition_id"][0].as_py()
    found = shell.json("trace", store, str(identity))
    assert isinstance(found, dict)
    assert found["store"]["version"] == first
    coverage = shell.json("coverage", store)
    assert isinstance(coverage, list)
    assert shell.json("audit", store, code={0, 1})
    with restock.open(store) as opened:
        assert opened.version == first
    with restock.open(str(path), version=first) as opened:
        assert opened.version == first
    with restock.open(str(path), version="2999-01-01T00:00Z") as opened:
        assert opened.version == first + 1


def test_version_is_refused_where_unsupported(versions, tmp_path, shell):
    path, first = versions
    assert main(["mix", str(path), "--out", str(tmp_path / "panel")]) == 0
    panel, out = f"{tmp_path / 'panel'}@1", str(tmp_path / "x.parquet")
    for args, problem in (
        (["sql", panel, "FROM rows"], "only a store has versions"),
        (["export", panel, "--to", "parquet", "--out", out], "is a panel, not a store"),
        (["store", "label", f"{path}@{first}"], "only the newest version can be changed"),
        (["store", "compact", f"{path}@{first}"], "only the newest version can be changed"),
        (["store", "verify", f"{path}@{first}"], "only the newest version can be changed"),
        (["sql", f"{path}@{first + 9}", "FROM recordings"], f"has no version {first + 9}"),
        (["sql", f"{path}@2026-13-01", "FROM recordings"], "neither the number of a version"),
        (["sql", f"{path}x@{first}", "FROM recordings"], "restock ingest"),
    ):
        assert problem in shell.err(*args)
    with pytest.raises(StoreError, match="neither the number"):
        restock.open(str(path), version="yesterday")


def test_removed_version_reports_retention(tmp_path):
    writer = StoreWriter(tmp_path / "store")
    first = writer.write(*one(1))
    writer.write(*one(1, ingest="b"))
    (tmp_path / "store/transitions").joinpath(f"{1:016x}", f"{1:016x}-a.parquet").unlink()
    with pytest.raises(StoreError, match="can no longer be read") as error:
        restock.open(str(tmp_path / "store"), version=first)
    assert "7 days" in str(error.value)


@pytest.mark.parametrize("version", [1, 2])
def test_removed_version_of_compacted_store(tmp_path, version):
    writer = StoreWriter(tmp_path / "store")
    writer.write_all([one(1), one(2)])
    compact(writer)
    writer.write(*one(1, "b"))
    writer.clean(retention_hours=0)
    _read.cache_clear()  # as in another process
    with pytest.raises(StoreError, match=f"its version {version} can no longer be read") as error:
        Store(tmp_path / "store", version=version)
    assert "7 days" in str(error.value)
