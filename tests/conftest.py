"""Fixtures that several rooms' tests share."""

import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pyarrow as pa
import pytest
from hypothesis import settings
from support import s3_server as s3
from support.shell import Shell
from support.stores import recording_transitions, summarised_once, write_store

# Times are not asserted: on a loaded machine the first example of a property may take long.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

# Tianshou has Numba compile loops over its buffer, which takes longer than they do for a few rows.
os.environ.setdefault("NUMBA_DISABLE_JIT", "1")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Started in the background of a script: processes that the tests interrupt would inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with files that have long tests: one at the end would keep the other processes idle."""
    marks = ("long", "docs")
    long = {item.path for item in items if any(map(item.get_closest_marker, marks))}
    items.sort(key=lambda item: item.path not in long)


@pytest.fixture(scope="session")
def transitions() -> pa.Table:
    """Three recordings' transitions in one table, about 1,200 rows."""
    return pa.concat_tables([recording_transitions(index) for index in (1, 2, 3)])


@pytest.fixture(scope="session")
def store_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of the same three recordings."""
    path = tmp_path_factory.mktemp("replay") / "store"
    return write_store(path, [recording_transitions(index) for index in (1, 2, 3)])


@pytest.fixture(scope="session")
def shell() -> Shell:
    """Run verbs as a user does."""
    return Shell()


@pytest.fixture
def quick_models(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fit off-policy evaluation by two updates, which is enough for tests of verbs."""
    from support.kept_run import QUICK

    from restock.train import loop
    from restock.train.evaluation import ope

    for module in (ope, loop):
        monkeypatch.setattr(module, "OpeConfig", partial(ope.OpeConfig, model=QUICK))


@pytest.fixture(scope="session", autouse=True)
def summaries_once() -> Iterator[None]:
    """Many tests write the same few recordings: each is summarised once a process."""
    from restock.ingest.store import writer

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "summarised", summarised_once)
        yield


@pytest.fixture(scope="session")
def s3_process() -> Iterator[str]:
    """Yield the address of a server, which takes seconds to start."""
    pytest.importorskip("boto3")
    pytest.importorskip("moto")
    with s3.s3_server() as address:
        yield address


@pytest.fixture(scope="module")
def s3_server(s3_process: str) -> Iterator[str]:
    """Yield a server with one bucket, that the environment names: its address."""
    import boto3

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", s3_process)
        patch.setenv("AWS_ACCESS_KEY_ID", "key")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
        patch.setenv("AWS_REGION", "us-east-1")
        boto3.client("s3").create_bucket(Bucket=s3.BUCKET)
        yield s3_process


@pytest.fixture(params=["folder", "s3"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Path | str:
    """Where a store may lie, of one test alone."""
    if request.param == "folder":
        return tmp_path / "s"
    request.getfixturevalue("s3_server")
    return s3.address(request)
