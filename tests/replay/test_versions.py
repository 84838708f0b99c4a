"""Time travel: every verb that reads a store answers as it was at a version or a time."""

from __future__ import annotations

import json
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

pytestmark = pytest.mark.usefixtures("summaries_once")

VERBS = ("sql", "audit", "mix", "export", "trace")
JOBS = ("coverage gaps", "coverage drift", "store label")


@pytest.fixture(scope="module")
def versions(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """Return a store of two recordings, and the version that had one."""
    path = tmp_path_factory.mktemp("versions") / "store"
    writer = StoreWriter(path)
    first = writer.write(*one(1))
    writer.write(*one(2))
    return path, first


@pytest.mark.parametrize("verb", [*VERBS, *JOBS, "twin fit", "twin gap"])
def test_the_flag_is_the_same_everywhere(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*verb.split(), "--help"]) == 0
    assert "--version N|TIME" in capsys.readouterr().out


def test_each_reads_what_was(
    versions: tuple[Path, int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, first = versions
    store, then = str(path), str(first)
    rows = one(1)[1]

    def requested(*args: str) -> object:
        assert main([*args, "--version", then, "--json"]) in (0, 1)
        return json.loads(capsys.readouterr().out)

    assert requested("sql", store, "SELECT count(*) AS n FROM transitions") == [{"n": len(rows)}]
    plan = requested("mix", store, "--mixture", "uniform", "--dry-run")
    assert isinstance(plan, dict)
    assert plan["store_version"] == first
    gaps = requested("coverage", "gaps", store, "--mixture", "uniform")
    assert isinstance(gaps, dict)
    assert (gaps["store_version"], gaps["episodes"]) == (first, 12)
    out = tmp_path / "rows.parquet"
    requested("export", store, "--to", "parquet", "--out", str(out))
    assert pq.read_metadata(out).num_rows <= len(rows)
    identity = rows["transition_id"][0].as_py()
    found = requested("trace", store, str(identity))
    assert isinstance(found, dict)
    assert found["store"]["version"] == first
    labelled = requested("store", "label", store, "--dry-run")
    assert isinstance(labelled, dict)
    assert len(labelled["recordings"]) == 1
    with restock.open(store, version=first) as opened:
        assert opened.version == first
    with restock.open(store, version="2999-01-01T00:00Z") as opened:
        assert opened.version == first + 1


def test_what_has_no_versions_says_so(
    versions: tuple[Path, int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, first = versions
    assert main(["store", "label", str(path), "--version", str(first)]) == 2
    assert "--dry-run" in capsys.readouterr().err
    assert main(["mix", str(path), "--out", str(tmp_path / "panel")]) == 0
    for args in (
        ["sql", str(tmp_path / "panel"), "FROM rows"],
        ["trace", str(tmp_path / "panel"), "3"],
        ["export", str(tmp_path / "panel"), "--to", "npz", "--out", str(tmp_path / "x.npz")],
    ):
        assert main([*args, "--version", "1"]) == 2
        assert "only a store has versions" in capsys.readouterr().err
    with pytest.raises(StoreError, match="neither the number"):
        restock.open(str(path), version="yesterday")


@pytest.mark.parametrize("verb", ["sql", "audit", "coverage", "store compact", *JOBS])
def test_a_version_after_an_at_is_said_to_be_an_option(
    verb: str, versions: tuple[Path, int], capsys: pytest.CaptureFixture[str]
) -> None:
    path, first = versions
    assert main([*verb.split(), f"{path}@{first}"]) == 2
    said = capsys.readouterr().err
    assert f"`{path}` is a store: name its version with --version {first}" in said
    assert "restock ingest" not in said
    assert main([*verb.split(), f"{path}x@{first}"]) == 2  # and that is no store
    assert "restock ingest" in capsys.readouterr().err


def test_a_version_whose_files_are_gone_says_for_how_long_they_are_kept(tmp_path: Path) -> None:
    writer = StoreWriter(tmp_path / "store")
    first = writer.write(*one(1))
    writer.write(*one(1, ingest="b"))
    (tmp_path / "store/transitions").joinpath(f"{1:016x}", f"{1:016x}-a.parquet").unlink()
    with pytest.raises(StoreError, match="can no longer be read") as error:
        restock.open(str(tmp_path / "store"), version=first)
    assert "7 days" in str(error.value)


@pytest.mark.parametrize("version", [1, 2])
def test_a_version_of_one_file_or_of_joined_ones_is_said_to_be_gone_alike(
    tmp_path: Path, version: int
) -> None:
    writer = StoreWriter(tmp_path / "store")
    writer.write_all([one(1), one(2)])
    compact(writer)
    writer.write(*one(1, "b"))
    writer.clean(retention_hours=0)
    _read.cache_clear()  # as in another process
    with pytest.raises(StoreError, match=f"its version {version} can no longer be read") as said:
        Store(tmp_path / "store", version=version)
    assert "7 days" in str(said.value)
