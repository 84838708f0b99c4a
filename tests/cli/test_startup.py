"""Startup: a command imports only what it uses."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.driven_robot import Drive, write_bag
from support.stores import one

from restock.ingest.store.writer import StoreWriter

LEARNING = {"torch", "mujoco", "gymnasium", "scipy", "altair", "tensorboard", "onnxruntime"}
SLOW = LEARNING | {"pandas", "pyarrow.dataset", "typeguard", "asyncio", "rosbags", "ruamel.yaml"}


def loaded(*args: str, codes: tuple[int, ...] = (0, 1)) -> set[str]:
    """Return the modules that one command has imported when it ends."""
    code = (
        "import json, sys; from restock.cli import main; code = main(sys.argv[1:]);"
        "sys.stderr.write(json.dumps(sorted(sys.modules))); sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code, *args], capture_output=True, text=True)
    assert done.returncode in codes, done.stderr[-500:]
    return set(json.loads(done.stderr.splitlines()[-1]))


def test_help_imports_no_library() -> None:
    modules = loaded("--help")
    used = SLOW | {"numpy", "pyarrow", "duckdb", "deltalake", "msgspec", "rich"}
    assert modules & used == set()
    assert "importlib.metadata" not in modules


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("startup") / "store"
    StoreWriter(path).write_all([one(1)])
    return path


def test_query_imports_no_learning_or_readers(store: Path) -> None:
    modules = loaded("sql", str(store), "FROM coverage, transitions LIMIT 9", "--json")
    assert modules & (SLOW | {"pyarrow.compute", "rich"}) == set()
    assert "duckdb" in modules


def test_audit_imports_no_learning_or_readers(store: Path) -> None:
    unused = {"restock.replay.panel.build", "restock.replay.fleet.gaps"}
    assert loaded("audit", str(store)) & (SLOW | unused) == set()


def test_review_imports_no_learning_or_charts(store: Path, tmp_path: Path) -> None:
    modules = loaded("review", str(store), "--out", str(tmp_path / "review.csv"))
    assert modules & (LEARNING | {"vl_convert"}) == set()


def test_ingest_imports_no_learning_or_pandas(tmp_path: Path) -> None:
    command = ("ingest", str(write_bag(Drive(), tmp_path / "bag")), "--store", str(tmp_path / "s"))
    assert loaded(*command, "--json") & (LEARNING | {"pandas", "pyarrow.dataset"}) == set()
    assert loaded(*command) & {"asyncio", "duckdb", "pyarrow.compute"} == set()


@pytest.mark.parametrize(
    ("command", "unused"),
    [
        (
            ("ingest", "bag", "--store", "store", "--profile", "nowhere.toml"),
            {"deltalake", "restock.ingest.batch", "restock.ingest.pipeline"},
        ),
        (("sql", "nowhere", "FROM coverage"), {"restock.replay.panel.panel"}),
    ],
    ids=["ingest", "sql"],
)
def test_missing_paths_are_reported_before_heavy_imports(command, unused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert loaded(*command, codes=(2,)) & unused == set()


@pytest.mark.parametrize(
    ("module", "slow"),
    [
        ("restock.report", {"torch"}),
        ("restock.train.twin.env.vector_env", {"torch"}),
        ("restock.train.loop", set()),
    ],
)
def test_rarely_used_libraries_are_not_imported(module: str, slow: set[str]) -> None:
    """scipy.signal takes .6 s, scipy.stats .3 s and PyTorch more than 1 s."""
    code = f"import sys, {module}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) & (slow | {"scipy.signal", "scipy.stats"}) == set()


@pytest.mark.parametrize("order", ["import restock, gymnasium", "import gymnasium, restock"])
def test_environment_is_registered_in_either_order(order: str) -> None:
    code = f"{order}; print(gymnasium.spec('restock/Warehouse-v0').entry_point)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "restock.train.twin.env.vector_env:WarehouseEnv", done.stderr


def test_pandas_works_if_imported_later() -> None:
    """Stable-Baselines3 imports pandas; Arrow must still create data frames."""
    pytest.importorskip("pandas")
    code = (
        "from restock.cli import _settle_pandas; import sys, pyarrow as pa; _settle_pandas();"
        "pa.array([1]); assert 'pandas' not in sys.modules;"
        "import pandas; print(pa.table({'a': [1, 2]}).to_pandas().a.sum(),"
        " len(pa.array(pandas.Series([3]))))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["3", "1"], done.stderr


@pytest.mark.parametrize(
    ("verb", "environment", "threads"),
    [("audit", {}, "1"), ("audit", {"OPENBLAS_NUM_THREADS": "3"}, "3"), ("train", {}, "")],
)
def test_short_commands_start_no_blas_threads(verb, environment, threads):
    code = (
        "import os, sys; from restock.cli import main; main(sys.argv[1:]);"
        "sys.stderr.write(os.environ.get('OPENBLAS_NUM_THREADS', ''))"
    )
    inherited = {name: text for name, text in os.environ.items() if "_NUM_THREADS" not in name}
    done = subprocess.run(
        [sys.executable, "-c", code, verb, "--help"],
        capture_output=True,
        text=True,
        env=inherited | environment,
        check=True,
    )
    assert done.stderr == threads
