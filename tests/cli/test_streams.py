"""Verbs complete their work even if their output cannot be shown, stored or read."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import IO

import pytest
from support.driven_robot import write_bags

from restock.replay.store.store import Store

FULL_DISK = Path("/dev/full")


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bags(tmp_path_factory.mktemp("bags"), 3)


def ingested(bags: Path, store: Path, stdout: IO[bytes]) -> subprocess.CompletedProcess[str]:
    words = ["ingest", str(bags), "--store", str(store)]
    command = [sys.executable, "-m", "restock", *words]
    return subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False)


def recordings(store: Path) -> int:
    with Store(store) as opened:
        return int(opened.sql("SELECT count(*) FROM recordings").fetchall()[0][0])


def test_closed_pipe_does_not_stop_ingest(bags: Path, tmp_path: Path) -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    with os.fdopen(write_end, "wb") as closed:
        done = ingested(bags, tmp_path / "store", closed)
    assert (done.returncode, done.stderr) == (0, "")
    assert recordings(tmp_path / "store") == 3


@pytest.mark.skipif(not FULL_DISK.exists(), reason="no /dev/full here")
def test_full_disk_for_stdout_is_reported_after_ingest(bags: Path, tmp_path: Path) -> None:
    with FULL_DISK.open("wb") as full:
        done = ingested(bags, tmp_path / "store", full)
    assert done.returncode == 2
    assert "what it prints (stdout): cannot be written: No space left on device" in done.stderr
    assert recordings(tmp_path / "store") == 3


@pytest.mark.long
def test_unencodable_characters_are_replaced(bags: Path, tmp_path: Path) -> None:
    store = str(tmp_path / "store")
    latin = os.environ | {"PYTHONIOENCODING": "ascii"}

    def output_of(*words: str) -> str:
        command = [sys.executable, "-m", "restock", *words]
        done = subprocess.run(command, env=latin, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout.decode("ascii")

    assert " topic " in output_of("ingest", str(bags), "--store", store, "--verbose")
    assert recordings(tmp_path / "store") == 3
    assert "------" in output_of("coverage", store)
    (row,) = json.loads(output_of("sql", store, "SELECT 'ä─𝄞' AS text", "--json"))
    assert row == {"text": "ä-𝄞"}
