"""Two threads that read from one opened store: the second is told so."""

import threading
from pathlib import Path

import pytest
from support.stores import one

from restock.errors import QueryError
from restock.ingest import StoreWriter
from restock.replay import Store


@pytest.fixture
def store(tmp_path: Path) -> Path:
    StoreWriter(tmp_path / "store").write_all([one(1)])
    return tmp_path / "store"


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
